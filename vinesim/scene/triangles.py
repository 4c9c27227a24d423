"""Encoding of a mesh's triangles for the network, its digest, and checks of received triangles.

The encoding contains the corners of all triangles, 36 B per triangle: 3 corners of 3 numbers, IEEE 754 binary32,
little-endian. The encoding has no indices, names or header, so a check of its numbers is complete.
"""

from __future__ import annotations

import hashlib
import re
import struct

import numpy as np

MAX_FACES = 200_000
"""Largest number of triangles of one mesh: the limit of MuJoCo's reader of STL files."""

FACE_BYTES = 36
"""Size of one triangle [B]."""

MAX_BYTES = MAX_FACES * FACE_BYTES
"""Size of the largest mesh [B]."""

MAX_COORDINATE = 1e6
"""Largest magnitude of a coordinate before scaling; files in millimetres have coordinates in the thousands."""

_DIGEST = re.compile(r"[0-9a-f]{40}")


class TrianglesError(ValueError):
    """Raised for bytes that do not encode triangles. The message contains the reason."""


def digest_of(payload: bytes) -> str:
    """Returns the digest of encoded triangles: 40 hex digits (BLAKE2b, 160 bits)."""
    return hashlib.blake2b(payload, digest_size=20).hexdigest()


def is_digest(text: str) -> bool:
    """Returns whether ``text`` has the form of a digest."""
    return _DIGEST.fullmatch(text) is not None


def encode_triangles(corners: np.ndarray) -> bytes:
    """Encode ``corners`` [face, 3, 3]. Raises :class:`TrianglesError` if there are no triangles, too many, or
    non-finite numbers."""
    payload = np.ascontiguousarray(corners, "<f4").tobytes()
    decode_triangles(payload)
    return payload


def decode_triangles(payload: bytes) -> np.ndarray:
    """Returns the corners [face, 3, 3] of encoded triangles. Raises :class:`TrianglesError` if the bytes do not encode
    triangles."""
    faces, rest = divmod(len(payload), FACE_BYTES)
    if rest or not 1 <= faces <= MAX_FACES:
        raise TrianglesError(f"{len(payload)} B are no 1 to {MAX_FACES} triangles of {FACE_BYTES} B")
    corners = np.frombuffer(payload, "<f4").reshape(faces, 3, 3)
    if not (np.abs(corners) <= MAX_COORDINATE).all():  # also false for NaN
        raise TrianglesError(f"a corner is not finite or beyond {MAX_COORDINATE:g}")
    return corners


def to_stl(corners: np.ndarray) -> bytes:
    """Returns a binary STL file of ``corners`` [face, 3, 3] with zero normals, for programs that read files."""
    facets = np.zeros(len(corners), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]))
    facets["corners"] = corners
    return bytes(80) + struct.pack("<I", len(corners)) + facets.tobytes()
