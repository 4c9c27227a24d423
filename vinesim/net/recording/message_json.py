"""Network messages as JSON objects, for people and tools: what ``vinesim record`` writes beside the raw bytes.

Poses carry the fields of ``foxglove.PoseInFrame``, so that Foxglove draws them.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from vinesim.net.codec import messages
from vinesim.net.codec.couplings import decode_couplings
from vinesim.net.codec.human import decode_pose
from vinesim.net.codec.wrenches import decode_wrenches
from vinesim.net.keys import sender_of
from vinesim.scene.ids import split_object_id
from vinesim.scene.values import POINT_NAMES, HumanUpdate


def _stamp(seconds: float) -> dict[str, int]:
    nanoseconds = round(seconds * 1e9)
    return {"sec": nanoseconds // 1_000_000_000, "nsec": nanoseconds % 1_000_000_000}


def _pose(pose: np.ndarray) -> dict[str, dict[str, float]]:
    x, y, z, qx, qy, qz, qw = pose.tolist()
    return {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": qx, "y": qy, "z": qz, "w": qw}}


def _named(object_id: int) -> dict[str, Any]:
    kind, index = split_object_id(object_id)
    return {"kind": kind.name.lower(), "index": index}


def _describe_pose(payload: bytes, key: str) -> dict[str, Any]:
    update = decode_pose(payload, sender_of(key))
    here = {"timestamp": _stamp(update.time), "frame_id": "map", "pose": _pose(update.base_q)}
    if isinstance(update, HumanUpdate):
        points = {name: _pose(at) for name, at in zip(POINT_NAMES, update.pose.points, strict=True)}
        return here | {"points": points, "intention": update.intention}
    return here | {
        "velocity": update.base_qd.tolist(),
        "joint_position": update.position.tolist(),
        "joint_velocity": update.velocity.tolist(),
        "lights": {"pattern": update.lights.pattern.name.lower(), "color": list(update.lights.color)},
    }


def _describe_trees(payload: bytes, _: str) -> dict[str, Any]:
    trees = messages.decode_trees(payload)
    columns = (trees.tree, trees.ownership, trees.authority, trees.flags, trees.bodies)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return {
        "timestamp": _stamp(trees.time),
        "trees": [
            {
                "tree": tree,
                "ownership": ownership,
                "authority": authority,
                "bodies": bodies,
                "touched": bool(flags & messages.TOUCHED),
                "resting": bool(flags & messages.RESTING),
            }
            for tree, ownership, authority, flags, bodies in rows
        ],
    }


def _describe_objects(payload: bytes, key: str) -> dict[str, Any]:
    _, x, y, _ = key.split("/")
    objects = messages.decode_objects(payload, (int(x), int(y)))
    return {
        "timestamp": _stamp(objects.time),
        "things": [
            {
                **_named(update.object),
                "ownership": update.ownership,
                "authority": update.authority,
                "touched": bool(flags & messages.TOUCHED),
                "pose": _pose(update.pose),
                "velocity": update.velocity.tolist(),
            }
            for update, flags in zip(objects.updates(sender_of(key)), objects.flags.tolist(), strict=True)
        ],
    }


def _describe_claims(payload: bytes, _: str) -> dict[str, Any]:
    return {
        "claims": [
            {
                **_named(object_id),
                "ownership": claim.ownership,
                "authority": claim.authority,
                "owner": claim.owner,
                "touched": touching,
            }
            for object_id, claim, touching in messages.decode_claims(payload)
        ]
    }


def _describe_records(payload: bytes, _: str) -> dict[str, Any]:
    return {
        "facts": [
            {
                **_named(record.object),
                "ownership": record.ownership,
                "authority": record.authority,
                "author": record.author,
                "moving": record.moving,
                "pose": _pose(np.array(record.pose)),
                "parent": record.parent,
                "cut": list(record.cut),
            }
            for record in messages.decode_records(payload)
        ]
    }


def _describe_wrenches(payload: bytes, _: str) -> dict[str, Any]:
    push = decode_wrenches(payload)
    return {
        "timestamp": _stamp(push.time),
        "links": [{"link": link, "wrench": wrench.tolist()} for link, wrench in sorted(push.wrenches.items())],
    }


def _describe_couplings(payload: bytes, _: str) -> dict[str, Any]:
    message = decode_couplings(payload)
    return {
        "timestamp": _stamp(message.time),
        "couplings": [
            {"body": one.body, "point": one.point.tolist(), "anchor": one.anchor.tolist()} for one in message.couplings
        ],
    }


def _describe_hello(payload: bytes, _: str) -> dict[str, Any]:
    return msgspec.to_builtins(messages.decode_hello(payload))


_DESCRIBE: dict[int, Callable[[bytes, str], dict[str, Any]]] = {
    messages.MessageKind.ROBOT: _describe_pose,
    messages.MessageKind.TREES: _describe_trees,
    messages.MessageKind.CLAIMS: _describe_claims,
    messages.MessageKind.RETAINED: _describe_records,
    messages.MessageKind.OBJECTS: _describe_objects,
    messages.MessageKind.HUMAN: _describe_pose,
    messages.MessageKind.WRENCHES: _describe_wrenches,
    messages.MessageKind.COUPLINGS: _describe_couplings,
    messages.MessageKind.HELLO: _describe_hello,
}


def describe_message(key: str, payload: bytes) -> dict[str, Any]:
    """The JSON object of one message, with its bytes in base64 under ``raw``; of undecodable bytes only those and the
    error."""
    raw = base64.b64encode(payload).decode()
    if key.startswith("live/"):
        return {"actor": sender_of(key), "live": bool(payload), "raw": raw}
    try:
        describe = _DESCRIBE.get(messages.kind_of(payload))
        return {"actor": sender_of(key), **(describe(payload, key) if describe is not None else {}), "raw": raw}
    except ValueError as error:  # a key that names no cell among them
        return {"actor": sender_of(key), "error": str(error), "raw": raw}
