"""Wire format of how one tree has changed for good besides cuts: sets and cracks of joints, slips and breaks of ties,
cuts that did not go through, ties that actors have made or opened, and leaves that they have taken off.

Rotations and distances are sent to the bit, so that all clients have the same springs. Two states of one tree join
without regard to their order (:func:`joined_wood`): nothing that was done on one client is lost on another.
"""

from __future__ import annotations

import numpy as np

from vinesim.net.codec.header import MessageError
from vinesim.scene.values import GivenWood

_JOINT = np.dtype([("place", "<u2"), ("turn", "<f4", 4), ("flow", "<f4")])
_TIE = np.dtype([("place", "<u2"), ("slid", "<f4"), ("way", "<f4"), ("broken", "u1")])
_NOTCH = np.dtype([("place", "<u2"), ("at", "<f4"), ("depth", "<f4")])
_BOUND = np.dtype([("place", "<u2"), ("at", "<u2"), ("to", "<f4", 3), ("opened", "u1")])
_LEAF = np.dtype([("place", "<u2")])
_TABLES = (_JOINT, _TIE, _NOTCH, _BOUND, _LEAF)
_COUNTS = np.dtype(("<u2", len(_TABLES)))

MAX_SLID = 100.0
"""[m] Longest distance by which a tie can have slipped; and [rad] largest flow of a joint; and [m] longest segment."""
MAX_ANCHOR = 1e5
"""[m] Largest coordinate of a point to which a tie pulls."""


def encode_wood(wood: GivenWood) -> bytes:
    """Encode how a tree has changed; empty bytes if it has not."""
    columns = (
        (wood.joints, wood.turns, wood.flows),
        (wood.ties, wood.slid, wood.slid_in_all, wood.broken),
        (wood.notched, wood.notch_at, wood.notch_depth),
        (wood.tied, wood.tied_at, wood.tied_to, wood.opened),
        (wood.bare,),
    )
    tables = []
    for kind, values in zip(_TABLES, columns, strict=True):
        table = np.zeros(len(values[0]), kind)
        for name, value in zip(kind.names or (), values, strict=True):
            table[name] = value
        tables.append(table)
    return _pack(tables)


def _pack(tables: list[np.ndarray]) -> bytes:
    if not any(map(len, tables)):
        return b""
    counts = np.array([len(table) for table in tables], "<u2")
    return counts.tobytes() + b"".join(table.tobytes() for table in tables)


def _unpack(payload: bytes) -> list[np.ndarray]:
    """Returns the tables of a message. Raises :class:`MessageError` unless their rows fill it."""
    if not payload:
        return [np.zeros(0, kind) for kind in _TABLES]
    counts = np.frombuffer(payload, "<u2", len(_TABLES)).tolist() if len(payload) >= _COUNTS.itemsize else []
    if len(payload) != _COUNTS.itemsize + sum(n * kind.itemsize for n, kind in zip(counts, _TABLES, strict=False)):
        raise MessageError(f"wood of {counts} rows in {len(payload)} B")
    tables = []
    start = _COUNTS.itemsize
    for count, kind in zip(counts, _TABLES, strict=True):
        tables.append(np.frombuffer(payload, kind, count, start))
        start += count * kind.itemsize
    return tables


def decode_wood(payload: bytes) -> GivenWood:
    """Decode how a tree has changed. Raises :class:`MessageError` if the message is invalid; whether the tree has such
    bodies, ties and leaves is not checked."""
    joints, ties, notches, bound, leaves = tables = _unpack(payload)
    for rows in tables:
        keys = rows["place"].astype(np.int64)
        if rows is bound:
            keys = (keys << 16) + rows["at"]
        if (np.diff(keys) <= 0).any():
            raise MessageError("wood with joints, ties or leaves in an order that does not increase")
    lengths = np.linalg.norm(joints["turn"].astype(float), axis=1)
    sound = [
        abs(lengths - 1.0) < 1e-3,
        _is_within(joints["flow"], 0.0, MAX_SLID),
        _is_within(ties["slid"], -MAX_SLID, MAX_SLID),
        _is_within(ties["way"], 0.0, MAX_SLID),
        _is_within(notches["at"], 0.0, MAX_SLID),
        _is_within(notches["depth"], 0.0, 1.0),
        _is_within(bound["to"], -MAX_ANCHOR, MAX_ANCHOR).ravel(),
    ]
    if not np.concatenate(sound).all():
        raise MessageError("wood with a set that is no rotation, or a number out of range")
    return GivenWood(
        joints["place"].astype(int),
        joints["turn"].copy(),
        joints["flow"].copy(),
        ties["place"].astype(int),
        ties["slid"].copy(),
        ties["way"].copy(),
        ties["broken"] > 0,
        notches["place"].astype(int),
        notches["at"].copy(),
        notches["depth"].copy(),
        bound["place"].astype(int),
        bound["at"].astype(int),
        bound["to"].copy(),
        bound["opened"] > 0,
        leaves["place"].astype(int),
    )


def _is_within(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Returns whether each value is finite and from ``low`` to ``high``."""
    return (values >= low) & (values <= high)


def joined_wood(one: bytes, other: bytes) -> bytes:
    """Join two states of one tree: of each joint the one that has given more, of each tie the one that has slipped
    further in all, of each segment the deeper notch; broken and opened ties stay so, leaves stay off. The result does
    not depend on the order. Both must be valid."""
    if one == other or not other:
        return one
    if not one:
        return other
    joints, ties, notches, bound, leaves = map(_joined_rows, _unpack(one), _unpack(other))
    return _pack(
        [
            _best(joints, ("place",), ("flow",)),
            _best(ties, ("place",), ("way", "slid"), "broken"),
            _best(notches, ("place",), ("depth", "at")),
            _best(bound, ("place", "at"), (), "opened"),
            _best(leaves, ("place",), ()),
        ]
    )


def _joined_rows(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.concatenate([one, other])


def _best(rows: np.ndarray, keys: tuple[str, ...], ranks: tuple[str, ...], flag: str = "") -> np.ndarray:
    """Returns for each value of ``keys`` the row with the greatest ``ranks``, then the greatest bytes; ``flag`` is set
    if it is set in any row of the value."""
    found: dict[tuple[int, ...], tuple[tuple, np.void]] = {}
    flags: dict[tuple[int, ...], int] = {}
    for row in rows:
        key = tuple(int(row[name]) for name in keys)
        rank = (*(float(row[name]) for name in ranks), row.tobytes())
        if key not in found or rank > found[key][0]:
            found[key] = rank, row
        if flag:
            flags[key] = flags.get(key, 0) | int(row[flag])
    best = np.array([found[key][1] for key in sorted(found)], rows.dtype)
    if flag:
        best[flag] = [flags[key] for key in sorted(found)]
    return best
