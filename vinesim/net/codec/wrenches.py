"""Wire format of the wrenches that a person's hands apply to the links of another client's robot."""

from __future__ import annotations

import dataclasses
import struct

import numpy as np

from vinesim.net.codec.header import HEADER, MessageError, MessageKind, pack_header, unpack_header

MAX_WRENCH = 2000.0
"""Largest component of a wrench [N, N m]; a message with a larger one is refused. GUESSED."""

MAX_LINKS = 64
"""Links of one robot in one message."""

_WRENCH = struct.Struct("<6f")


@dataclasses.dataclass(frozen=True, slots=True)
class WrenchMessage:
    """Mean wrenches of one person on the links of one robot over one sending period (1/60 s)."""

    time: float
    """Network time [s]."""
    wrenches: dict[str, np.ndarray]
    """Link name: force [N] and moment about its centre of mass [N m], world axes [6]. Empty: the contact has ended."""


def encode_wrenches(message: WrenchMessage) -> bytes:
    """Encode wrenches: 14 bytes, and for each link 25 bytes and its name. Raises :class:`MessageError` beyond the
    limits."""
    if len(message.wrenches) > MAX_LINKS:
        raise MessageError(f"wrenches on {len(message.wrenches)} links, at most {MAX_LINKS}")
    payload = [pack_header(MessageKind.WRENCHES, len(message.wrenches), message.time)]
    for link, wrench in sorted(message.wrenches.items()):
        name = link.encode()
        if len(name) > 255 or not (np.abs(wrench) <= MAX_WRENCH).all():
            raise MessageError(f"wrenches on {link[:60]!r} with {wrench}: not finite, too strong, or too long a name")
        payload += [bytes((len(name),)), name, _WRENCH.pack(*wrench)]
    return b"".join(payload)


def decode_wrenches(payload: bytes) -> WrenchMessage:
    """Decode wrenches and check every number; whether the robot has such links is for the caller to check."""
    count, time = unpack_header(payload, MessageKind.WRENCHES, "wrenches")
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
