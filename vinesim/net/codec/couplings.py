"""Wire format of virtual couplings: forces of an actor on bodies of trees that another actor owns, as springs."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.net.codec.header import HEADER, MAX_COORDINATE, MessageError, MessageKind, pack_header, unpack_header
from vinesim.scene.values import Coupling

MAX_COUPLINGS = 8
"""Couplings in one message: bodies of one owner's trees that one actor touches."""

MAX_LEVER = 10.0
"""Farthest point of a body from its origin [m]."""

_COUPLING = np.dtype([("body", "<u4"), ("point", "<f4", 3), ("anchor", "<f4", 3)])


@dataclasses.dataclass(frozen=True, slots=True)
class CouplingMessage:
    """All couplings of one actor to the trees of one owner."""

    time: float
    """Network time [s]."""
    couplings: tuple[Coupling, ...]
    """In increasing order of bodies; empty: the contact has ended."""


def encode_couplings(message: CouplingMessage) -> bytes:
    """Encode couplings: 14 bytes, and 28 for each. Raises :class:`MessageError` beyond the limits."""
    rows = np.zeros(len(message.couplings), _COUPLING)
    for row, coupling in zip(rows, message.couplings, strict=True):
        row["body"], row["point"], row["anchor"] = coupling.body, coupling.point, coupling.anchor
    _check(rows)
    return pack_header(MessageKind.COUPLINGS, len(rows), message.time) + rows.tobytes()


def decode_couplings(payload: bytes) -> CouplingMessage:
    """Decode couplings and check every number; whether there are such bodies is for the caller to check."""
    count, time = unpack_header(payload, MessageKind.COUPLINGS, "couplings")
    if len(payload) != HEADER.size + count * _COUPLING.itemsize:
        raise MessageError(f"{count} couplings in {len(payload)} B")
    with np.errstate(invalid="ignore"):  # of signalling NaNs, which are refused below
        rows = np.frombuffer(payload, _COUPLING, count, HEADER.size)
        _check(rows)
        points = rows["point"].astype(float)
        anchors = rows["anchor"].astype(float)
    return CouplingMessage(time, tuple(map(Coupling, rows["body"].tolist(), points, anchors)))


def _check(rows: np.ndarray) -> None:
    if len(rows) > MAX_COUPLINGS:
        raise MessageError(f"{len(rows)} couplings, at most {MAX_COUPLINGS}")
    if not ((np.abs(rows["point"]) <= MAX_LEVER).all() and (np.abs(rows["anchor"]) < MAX_COORDINATE).all()):
        raise MessageError("a coupling with a number that is not finite or out of range")
    if (np.diff(rows["body"].astype(np.int64)) <= 0).any():
        raise MessageError("couplings whose bodies do not increase")
