"""Wire format of moving rigid objects: boxes and free bunches, 26 bytes each, with positions relative to a cell.

Position: 3 i16 in steps of 0.1 mm from the middle of the interest cell that the key names. Rotation: 32 bits (error
0.28 degrees). Linear and angular velocity: 3 i8 each, in steps of a power of two that the record states.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from vinesim.net.codec.header import HEADER, MAX_DATAGRAM, MessageError, pack_header, unpack_header
from vinesim.net.codec.json_values import NUMBER, POSE, THING, YES, list_of, named, object_of, pose_value
from vinesim.net.codec.rotation import pack_quaternions, unpack_quaternions
from vinesim.net.codec.trees import MAX_TREES, TOUCHED
from vinesim.net.replication.interest import CELL_SIZE, Cell
from vinesim.scene.ids import OBJECT_STRIDE, ObjectKind
from vinesim.scene.values import ObjectUpdate

OBJECTS = 5
"""Number of the kind of message with states of boxes and bunches, the fourth byte of the message."""

POSITION_LSB = 1e-4
"""Quantisation step of a position in its cell [m]. Positions are clipped at 3.2 m from the origin of their level in the
cell."""

LEVEL_HEIGHT = 4.0
"""[m] Distance between the levels in which heights on a slope are counted. On level ground every object is in level 0.
"""

_LEVEL_BIT = 4
"""Factor of the level in an object's flags, above the bits of the other flags."""

_HIGHEST_LEVEL = 31
"""Largest level; the lowest one is -32."""

CELL_ORIGIN_OFFSET = np.array([0.5 * CELL_SIZE, 0.5 * CELL_SIZE, 2.5])
"""Vector [3] m from the lower corner of a cell on the ground to the origin of the quantised positions in the cell."""

MIN_VELOCITY_LSB = np.array([2.0**-10, 2.0**-8])
"""Smallest quantisation steps of linear [m/s] and angular velocity [rad/s]. A record scales each by a power of two."""

MAX_EXPONENT = 9
"""Largest exponent of two that scales a quantisation step of velocity. So velocities are clipped at 64 m/s and 254
rad/s, twice the speed of anything that is thrown."""

_OBJECT = np.dtype(
    [
        ("object", "<u4"),
        ("ownership", "<u2"),
        ("authority", "<u2"),
        ("flags", "u1"),
        ("scale", "u1"),
        ("position", "<i2", 3),
        ("turn", "<u4"),
        ("velocity", "i1", 3),
        ("spin", "i1", 3),
    ]
)


@dataclasses.dataclass(frozen=True, slots=True)
class ObjectStates:
    """States of several boxes and free bunches of one owner at one instant; object ids strictly increase."""

    time: float
    """Network time of the states [s]."""
    object: np.ndarray
    """[k] object ids, by :func:`vinesim.scene.ids.object_id`"""
    ownership: np.ndarray
    """[k] ownership sequences (u16) of the owner's claims"""
    authority: np.ndarray
    """[k] authority sequences (u16) of the owner's claims"""
    flags: np.ndarray
    """[k] :data:`TOUCHED` if the owner is in contact with the object, else 0"""
    pose: np.ndarray
    """[k, 7] poses in the world: position [m], quaternion xyzw"""
    velocity: np.ndarray
    """[k, 6] velocities of the origins [m/s] and angular velocities [rad/s], world axes"""

    def updates(self, owner: str) -> list[ObjectUpdate]:
        """Returns one update per object. The arrays of an update are views of this batch's arrays."""
        columns = (self.object, self.ownership, self.authority)
        rows = zip(*(column.tolist() for column in columns), self.pose, self.velocity, strict=True)
        return [
            ObjectUpdate(object_id, owner, ownership, authority, self.time, pose, velocity)
            for object_id, ownership, authority, pose, velocity in rows
        ]


def encode_objects(objects: ObjectStates, cell: Cell) -> tuple[list[bytes], ObjectStates]:
    """Encode objects that are published under ``cell``. Returns the messages, and the batch as receivers decode it.

    A message has at most :data:`MAX_DATAGRAM` bytes. Raises :class:`MessageError` if ids do not increase or a value is
    not finite.
    """
    ids = objects.object
    if not len(ids) or (len(ids) > 1 and not (ids[1:] > ids[:-1]).all()):
        raise MessageError("objects of a batch must be at least one, in strictly increasing order")
    if not (np.isfinite(objects.pose).all() and np.isfinite(objects.velocity).all()):
        raise MessageError("state of an object is not finite")
    records = np.empty(len(ids), _OBJECT)
    for name in ("object", "ownership", "authority", "flags"):
        records[name] = getattr(objects, name)
    level = _levels(objects.pose[:, 2])
    records["flags"] += (level % (256 // _LEVEL_BIT) * _LEVEL_BIT).astype(np.uint8)
    origin = _cell_origin(cell) + level[:, None] * [0.0, 0.0, LEVEL_HEIGHT]
    records["position"] = np.clip(np.rint((objects.pose[:, :3] - origin) / POSITION_LSB), -32767, 32767)
    records["turn"] = pack_quaternions(objects.pose[:, 3:])
    velocity = objects.velocity.reshape(-1, 2, 3)
    fastest = np.maximum(np.abs(velocity).max(2) / (127.0 * MIN_VELOCITY_LSB), 1.0)
    exponent = np.minimum(np.ceil(np.log2(fastest)), MAX_EXPONENT)
    steps = np.clip(np.rint(velocity / (MIN_VELOCITY_LSB * 2.0**exponent)[:, :, None]), -127.0, 127.0)
    records["velocity"], records["spin"] = steps[:, 0], steps[:, 1]
    records["scale"] = exponent[:, 0] + 16.0 * exponent[:, 1]
    count = (MAX_DATAGRAM - HEADER.size) // _OBJECT.itemsize
    parts = [records[first : first + count] for first in range(0, len(records), count)]
    payloads = [pack_header(OBJECTS, len(part), objects.time) + part.tobytes() for part in parts]
    return payloads, _read_objects(objects.time, records, cell)


def decode_objects(payload: bytes, cell: Cell) -> ObjectStates:
    """Decode objects that were published under ``cell``. Raises :class:`MessageError` if the message is invalid.

    The caller has to check that the scene has these objects (:func:`check_object_id`).
    """
    count, time = unpack_header(payload, OBJECTS, "objects")
    if not 1 <= count <= MAX_TREES or len(payload) != HEADER.size + count * _OBJECT.itemsize:
        raise MessageError(f"{count} objects announced (1 to {MAX_TREES}) in {len(payload)} B")
    records = np.frombuffer(payload, _OBJECT, count, HEADER.size)
    ids = records["object"].astype(np.int64)
    if (ids[1:] <= ids[:-1]).any() or ids[0] < OBJECT_STRIDE or ids[-1] >= len(ObjectKind) * OBJECT_STRIDE:
        raise MessageError("objects that are trees, of no kind, or in an order that does not increase")
    if (records["flags"] % _LEVEL_BIT > TOUCHED).any():
        raise MessageError("objects with unknown flags")
    if (np.maximum(records["scale"] % 16, records["scale"] // 16) > MAX_EXPONENT).any():
        raise MessageError("objects that are faster than anything in a vineyard")
    return _read_objects(time, records, cell)


def _read_objects(time: float, records: np.ndarray, cell: Cell) -> ObjectStates:
    """Decode the valid records of a message about objects in ``cell``."""
    pose = np.empty((len(records), 7))
    level = records["flags"].view(np.int8) // _LEVEL_BIT
    pose[:, :3] = records["position"] * POSITION_LSB + _cell_origin(cell) + level[:, None] * [0.0, 0.0, LEVEL_HEIGHT]
    pose[:, 3:] = unpack_quaternions(records["turn"])
    exponent = np.stack([records["scale"] % 16, records["scale"] // 16], -1).astype(float)
    unit = np.repeat(MIN_VELOCITY_LSB * 2.0**exponent, 3, axis=1)
    velocity = np.concatenate([records["velocity"], records["spin"]], -1) * unit
    ids = records["object"].astype(np.int64)
    flags = records["flags"] % _LEVEL_BIT
    return ObjectStates(time, ids, records["ownership"], records["authority"], flags, pose, velocity)


OBJECTS_FIELDS = {
    "things": list_of(
        object_of("thing", "a box or a loose bunch", touched=YES, pose=POSE, velocity=list_of(NUMBER), **THING)
    )
}
"""JSON schema of what :func:`describe_objects` returns."""


def describe_objects(payload: bytes, key: str) -> dict[str, Any]:
    """Decode objects for the JSON of a recording. Raises ValueError if the key names no cell."""
    _, x, y, _ = key.split("/")
    objects = decode_objects(payload, (int(x), int(y)))
    return {
        "things": [
            {
                **named(update.object),
                "ownership": update.ownership,
                "authority": update.authority,
                "touched": bool(flags & TOUCHED),
                "pose": pose_value(update.pose),
                "velocity": update.velocity.tolist(),
            }
            for update, flags in zip(objects.updates(""), objects.flags.tolist(), strict=True)
        ],
    }


def _cell_origin(cell: Cell) -> np.ndarray:
    """Returns the origin of the quantised positions in a cell: a position [3] m in the world."""
    return np.array([cell[0] * CELL_SIZE, cell[1] * CELL_SIZE, 0.0]) + CELL_ORIGIN_OFFSET


def _levels(height: np.ndarray) -> np.ndarray:
    """Returns the level [k] of objects at ``height`` [k] m: 0 for all that a position in level 0 can express."""
    above = height - CELL_ORIGIN_OFFSET[2]
    level = np.rint(above / LEVEL_HEIGHT)
    level = np.clip(level, -1 - _HIGHEST_LEVEL, _HIGHEST_LEVEL)
    return np.where(np.abs(above) <= 32767 * POSITION_LSB, 0.0, level).astype(int)


def check_object_id(object_id: int, counts: tuple[int, ...] | None = None) -> None:
    """Raise :class:`MessageError` unless an object with this id can exist.

    ``counts``: number of objects of each kind in the scene; None: unknown.
    """
    kind, index = divmod(object_id, OBJECT_STRIDE)
    if not 0 <= kind < len(ObjectKind):
        raise MessageError(f"object {object_id} is of no kind")
    if counts is not None and index >= counts[kind]:
        raise MessageError(f"{ObjectKind(kind).name.lower()} {index}, this scene has {counts[kind]}")
