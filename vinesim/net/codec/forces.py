"""Wire formats of forces on objects that another client simulates: wrenches and couplings.

A wrench is the force and moment of a person's hands on one link of a robot. A coupling is the force of an actor on one
body of a tree that another actor owns, sent as a spring.
"""

from __future__ import annotations

import dataclasses
import struct
from typing import Any

import numpy as np

from vinesim.net.codec.header import HEADER, MAX_COORDINATE, MessageError, pack_header, unpack_header
from vinesim.net.codec.json_values import COUNT, NUMBER, TEXT, list_of, object_of

WRENCHES = 7
COUPLINGS = 8
"""Numbers of the kinds of messages in this module. The fourth byte of a message is the number of its kind."""

MAX_WRENCH = 2000.0
"""Largest magnitude of a component of a wrench [N, N m]. A message with a larger one is refused. GUESSED."""

MAX_LINKS = 64
"""Largest number of links in one message of wrenches."""

_WRENCH = struct.Struct("<6f")


@dataclasses.dataclass(frozen=True, slots=True)
class WrenchMessage:
    """Wrenches of one person on the links of one robot, each averaged over one sending period (1/60 s)."""

    time: float
    """Network time [s]."""
    wrenches: dict[str, np.ndarray]
    """By link name: force [N] and moment about the link's centre of mass [N m], world axes [6]. Empty: the contact
    ended."""


def encode_wrenches(message: WrenchMessage) -> bytes:
    """Encode wrenches in 14 bytes and, for each link, 25 bytes and the link's name.

    Raises :class:`MessageError` for too many links, too long a name, or a wrench that is too large or not finite.
    """
    if len(message.wrenches) > MAX_LINKS:
        raise MessageError(f"wrenches on {len(message.wrenches)} links, at most {MAX_LINKS}")
    payload = [pack_header(WRENCHES, len(message.wrenches), message.time)]
    for link, wrench in sorted(message.wrenches.items()):
        name = link.encode()
        if len(name) > 255 or not (np.abs(wrench) <= MAX_WRENCH).all():
            raise MessageError(f"wrenches on {link[:60]!r} with {wrench}: not finite, too strong, or too long a name")
        payload += [bytes((len(name),)), name, _WRENCH.pack(*wrench)]
    return b"".join(payload)


def decode_wrenches(payload: bytes) -> WrenchMessage:
    """Decode wrenches and check every number. The caller has to check that the robot has these links."""
    count, time = unpack_header(payload, WRENCHES, "wrenches")
    if count > MAX_LINKS:
        raise MessageError(f"wrenches on {count} links, at most {MAX_LINKS}")
    at = HEADER.size
    wrenches = {}
    for _ in range(count):
        end = at + 1 + (payload[at] if at < len(payload) else 0)
        if end + _WRENCH.size > len(payload):
            raise MessageError(f"wrenches on {count} links is cut off at {len(payload)} B")
        wrench = np.array(_WRENCH.unpack_from(payload, end))
        if not (np.abs(wrench) <= MAX_WRENCH).all():
            raise MessageError(f"wrenches with {wrench}: not finite or stronger than {MAX_WRENCH} N")
        try:
            wrenches[payload[at + 1 : end].decode()] = wrench
        except UnicodeDecodeError as error:
            raise MessageError(f"wrenches on a link whose name is no text: {error}") from error
        at = end + _WRENCH.size
    if at != len(payload):
        raise MessageError(f"wrenches of {len(payload)} B, {count} links take {at} B")
    return WrenchMessage(time, wrenches)


WRENCHES_FIELDS = {
    "links": list_of(
        object_of(
            "link",
            "one that is pushed",
            link=TEXT,
            wrench=list_of(NUMBER, "force [N], moment about its centre of mass [N m], world axes"),
        )
    )
}
"""JSON schema of what :func:`describe_wrenches` returns."""


def describe_wrenches(payload: bytes, _: str) -> dict[str, Any]:
    """Decode wrenches for the JSON of a recording."""
    wrenches = decode_wrenches(payload).wrenches
    return {"links": [{"link": link, "wrench": wrench.tolist()} for link, wrench in sorted(wrenches.items())]}


MAX_COUPLINGS = 8
"""Largest number of couplings (:class:`Coupling`) in one message; there is one for each body that the actor touches."""

MAX_LEVER = 10.0
"""Largest coordinate of a coupling's point in the frame of its body [m]."""

_COUPLING = np.dtype([("body", "<u4"), ("point", "<f4", 3), ("anchor", "<f4", 3)])


@dataclasses.dataclass(frozen=True, slots=True)
class Coupling:
    """Force of an actor on one body of a tree that another client owns, sent as the anchor of a spring.

    The stiffness of the spring is fixed. If the body is at the same place in both simulations, the spring pulls with
    the force of the actor's contact.
    """

    body: int
    """Index of the plant body in the model."""
    point: np.ndarray
    """Point [3] m at which the spring is attached, in the body's frame."""
    anchor: np.ndarray
    """Position [3] m to which the spring pulls ``point``, in the world."""


@dataclasses.dataclass(frozen=True, slots=True)
class CouplingMessage:
    """All couplings (virtual springs, :class:`Coupling`) of one actor to the trees that one other actor owns."""

    time: float
    """Network time [s]."""
    couplings: tuple[Coupling, ...]
    """The couplings, in increasing order of ``body``. Empty: the contact ended."""


def encode_couplings(message: CouplingMessage) -> bytes:
    """Encode couplings in 14 bytes, and 28 more for each coupling. Raises :class:`MessageError` if they are invalid."""
    rows = np.zeros(len(message.couplings), _COUPLING)
    for row, coupling in zip(rows, message.couplings, strict=True):
        row["body"], row["point"], row["anchor"] = coupling.body, coupling.point, coupling.anchor
    _check_couplings(rows)
    return pack_header(COUPLINGS, len(rows), message.time) + rows.tobytes()


def decode_couplings(payload: bytes) -> CouplingMessage:
    """Decode couplings and check every number. The caller has to check that the model has these bodies."""
    count, time = unpack_header(payload, COUPLINGS, "couplings")
    if len(payload) != HEADER.size + count * _COUPLING.itemsize:
        raise MessageError(f"{count} couplings in {len(payload)} B")
    with np.errstate(invalid="ignore"):  # signalling NaNs would warn; they are refused below
        rows = np.frombuffer(payload, _COUPLING, count, HEADER.size)
        _check_couplings(rows)
        points = rows["point"].astype(float)
        anchors = rows["anchor"].astype(float)
    return CouplingMessage(time, tuple(map(Coupling, rows["body"].tolist(), points, anchors)))


def _check_couplings(rows: np.ndarray) -> None:
    """Raise :class:`MessageError` unless couplings, as rows of their wire format, are within all limits."""
    if len(rows) > MAX_COUPLINGS:
        raise MessageError(f"{len(rows)} couplings, at most {MAX_COUPLINGS}")
    if not ((np.abs(rows["point"]) <= MAX_LEVER).all() and (np.abs(rows["anchor"]) < MAX_COORDINATE).all()):
        raise MessageError("a coupling with a number that is not finite or out of range")
    if (np.diff(rows["body"].astype(np.int64)) <= 0).any():
        raise MessageError("couplings whose bodies do not increase")


COUPLINGS_FIELDS = {
    "couplings": list_of(
        object_of(
            "coupling",
            "a spring that holds a body of a tree",
            body=COUNT,
            point=list_of(NUMBER, "in the body's frame [m]"),
            anchor=list_of(NUMBER, "where it is pulled to, in the world [m]"),
        )
    )
}
"""JSON schema of what :func:`describe_couplings` returns."""


def describe_couplings(payload: bytes, _: str) -> dict[str, Any]:
    """Decode couplings for the JSON of a recording."""
    return {
        "couplings": [
            {"body": one.body, "point": one.point.tolist(), "anchor": one.anchor.tolist()}
            for one in decode_couplings(payload).couplings
        ],
    }
