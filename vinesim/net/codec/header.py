"""Header of every network message: protocol version and kind, and for frequent kinds a count and a time; errors.

Every message starts with four bytes: ``VS``, the protocol version and the kind
(:data:`vinesim.net.codec.messages.MESSAGES` lists all kinds). In messages of frequent kinds a u16 count and the network
time as f64 follow, little-endian (:data:`HEADER`). Messages of rare kinds continue in msgpack. A decoder raises
:class:`MessageError` and nothing else for a message that is malformed, truncated, too large, of another version or not
finite.
"""

from __future__ import annotations

import math
import struct

PROTOCOL = 11
"""Version of the wire format. Messages of any other version are refused."""

MAGIC = b"VS"

MAX_DATAGRAM = 1100
"""Largest size of a best-effort message [B], so that it fits one UDP datagram. A single large tree may exceed this."""

MAX_MESSAGE = 1 << 20
"""Largest size of a message that is decoded [B]. Larger messages are refused unread."""

MAX_COORDINATE = 1e5
"""Bound for the magnitude of each coordinate of a position [m]. Messages with larger ones are refused."""

LARGEST_COORDINATE = MAX_COORDINATE - 1.0
"""Magnitude to which the coordinates of positions are clipped before they are sent [m].

The margin to :data:`MAX_COORDINATE` is needed: without it an actor could accept an object near the bound and move it
beyond, and all other actors would refuse the new state."""

HEADER = struct.Struct("<2sBBHd")
"""Header of a message of a frequent kind: magic bytes, version, kind, count, network time [s]; 14 bytes."""


class MessageError(ValueError):
    """A message cannot be encoded or decoded; the text gives the reason."""


class WrongVersion(MessageError):
    """A message has another protocol version than this program. ``theirs``: that version."""

    def __init__(self, theirs: int) -> None:
        super().__init__(f"message of protocol version {theirs}, this program speaks {PROTOCOL}: use the same release")
        self.theirs = theirs


def pack_header(kind: int, count: int, time: float) -> bytes:
    """Encode the header of a message with a ``time`` [s]. Raises :class:`MessageError` if the time is not finite."""
    if not math.isfinite(time):
        raise MessageError(f"time {time} is not finite")
    return HEADER.pack(MAGIC, PROTOCOL, kind, count, time)


def kind_of(payload: bytes) -> int:
    """Check the size and the first four bytes of a message and return its kind, which may be unknown to this program.

    Raises :class:`WrongVersion` for another protocol version, and :class:`MessageError` for other faults.
    """
    if len(payload) > MAX_MESSAGE:
        raise MessageError(f"message of {len(payload)} B, at most {MAX_MESSAGE} B are read")
    if len(payload) < 4:
        raise MessageError(f"message of {len(payload)} B is cut off before its kind")
    if payload[:2] != MAGIC:
        raise MessageError(f"message starts with {payload[:2]!r} instead of {MAGIC!r}: not from vinesim")
    if payload[2] != PROTOCOL:
        raise WrongVersion(payload[2])
    return payload[3]


def unpack_header(payload: bytes, kind: int, name: str) -> tuple[int, float]:
    """Return count and time [s] of a message of a frequent ``kind``; raise :class:`MessageError` if it is of another
    kind.

    ``name``: what to call messages of this kind in the error.
    """
    if (found := kind_of(payload)) != kind:
        raise MessageError(f"message of kind {found} where {name} (kind {kind}) was expected")
    if len(payload) < HEADER.size:
        raise MessageError(f"{name} of {len(payload)} B is cut off in its header")
    _, _, _, count, time = HEADER.unpack_from(payload)
    if not math.isfinite(time):
        raise MessageError(f"{name} with time {time}")
    return count, time


def is_valid_name(name: str) -> bool:
    """Whether a name can be one chunk of a Zenoh key: 1 to 48 characters of ASCII letters, digits, ``_``, ``-``,
    ``.``."""
    return 1 <= len(name) <= 48 and all(c.isascii() and (c.isalnum() or c in "_-.") for c in name)
