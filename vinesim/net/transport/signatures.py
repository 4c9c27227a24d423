"""Signatures of messages: only the session that holds an actor's name can speak under it, on every transport.

Each session makes a pair of keys (Ed25519, RFC 8032) when it opens. The id of the session is the first half of the
BLAKE2b digest of its public key. So whoever knows the id of the session that holds a name, from its liveliness token or
from the server, can check that a message comes from that session. No program has to be trusted for that, and no key has
to be exchanged: the public key travels with the messages.

A signature covers the key of the message, a number that rises with each message of the session, and the payload.
Messages are not encrypted. Costs and alternatives: ``docs/decisions/signatures.md``.
"""

from __future__ import annotations

import hashlib
import itertools
import struct
import threading
import time

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

KEY_PERIOD = 1.0
"""Time between two best-effort messages of one publisher that contain the public key [s]."""

MAX_SESSIONS = 1024
"""Largest number of sessions whose public keys are kept."""

MAX_KEYS = 16_384
"""Largest number of keys of messages whose last number is kept."""

_NUMBER = struct.Struct("<Q")
_SIGNATURE_SIZE = 64
_PUBLIC_SIZE = 32
_SHORT = _NUMBER.size + _SIGNATURE_SIZE
"""Size of a seal without the public key [B]."""
SEAL_SIZE = _SHORT + _PUBLIC_SIZE
"""Size of a seal with the public key [B]."""


def session_id(public: bytes) -> str:
    """Returns the id of the session with a ``public`` key: 128 bits in hexadecimal digits, of which the first is not 0,
    because Zenoh refuses leading zeros."""
    digest = bytearray(hashlib.blake2b(public, digest_size=16).digest())
    digest[0] |= 0x80
    return digest.hex()


class Identity:
    """The pair of keys of one session, which signs its messages. May be used from several threads."""

    def __init__(self) -> None:
        self._private = Ed25519PrivateKey.generate()
        self._public = self._private.public_key().public_bytes_raw()
        self.session = session_id(self._public)
        """Id of the session, for Zenoh's configuration."""
        self._numbers = itertools.count(1)

    def seal(self, key: str, payload: bytes, *, with_key: bool = True) -> bytes:
        """Returns what a message carries beside its payload: its number, the signature and, ``with_key``, the public
        key.

        ``key``: whole key of the message.
        """
        number = _NUMBER.pack(next(self._numbers))
        signature = self._private.sign(_signed(key, number, payload))
        return number + signature + (self._public if with_key else b"")


class Sealer:
    """Seals the best-effort messages of one publisher. The public key is in one message a :data:`KEY_PERIOD`."""

    def __init__(self, key: str) -> None:
        """``key``: whole key of the messages."""
        self._key = key
        self._due = -1.0
        self._identity: Identity | None = None

    def seal(self, identity: Identity, payload: bytes) -> bytes:
        """Returns the seal of the next message under the ``identity`` of the present session."""
        now = time.monotonic()
        with_key = now >= self._due or identity is not self._identity
        if with_key:
            self._due = now + KEY_PERIOD
            self._identity = identity
        return identity.seal(self._key, payload, with_key=with_key)


class SealCheck:
    """Checks seals of received messages. May be used from several threads."""

    def __init__(self, max_sessions: int = MAX_SESSIONS) -> None:
        """``max_sessions``: largest number of sessions whose public keys are kept."""
        self._max_sessions = max_sessions
        self._lock = threading.Lock()
        self._sessions: dict[str, Ed25519PublicKey] = {}
        """Public keys of sessions, by id."""
        self._last: dict[tuple[str, str], int] = {}
        """Number of the last message, by session and key."""

    def is_early(self, session: str, seal: bytes | None) -> bool:
        """Whether a seal cannot be checked yet, because it has no public key and its ``session`` has shown none: this
        receiver has just come."""
        return seal is not None and len(seal) == _SHORT and session not in self._sessions

    def is_from(self, session: str, key: str, payload: bytes, seal: bytes | None, *, once: bool = True) -> bool:
        """Whether a message was sealed by a ``session``, and is not older than another one under the same ``key``.

        ``session``: id; empty: nobody's. ``once``: False for queries and replies, which have no order. A message whose
        session has not shown its public key yet counts as not sealed.
        """
        if seal is None or not session or len(seal) not in (_SHORT, SEAL_SIZE):
            return False
        public = self._public_key(session, seal[_SHORT:])
        if public is None:
            return False
        number = seal[: _NUMBER.size]
        (count,) = _NUMBER.unpack(number)
        if once and count < self._last.get((session, key), 0):
            return False
        try:
            public.verify(seal[_NUMBER.size : _SHORT], _signed(key, number, payload))
        except InvalidSignature:
            return False
        if once:
            with self._lock:
                self._last.pop((session, key), None)
                self._last[session, key] = count
                if len(self._last) > MAX_KEYS:
                    del self._last[next(iter(self._last))]
        return True

    def _public_key(self, session: str, shown: bytes) -> Ed25519PublicKey | None:
        """Returns the public key of a session; None if it is unknown. ``shown``: key in a message; empty if none."""
        if (known := self._sessions.get(session)) is not None or not shown:
            return known
        if session_id(shown) != session:
            return None
        with self._lock:
            if len(self._sessions) >= self._max_sessions:
                del self._sessions[next(iter(self._sessions))]
            self._sessions[session] = public = Ed25519PublicKey.from_public_bytes(shown)
        return public


def _signed(key: str, number: bytes, payload: bytes) -> bytes:
    """Returns the bytes that a signature covers."""
    name = key.encode()
    return len(name).to_bytes(2, "little") + name + number + payload
