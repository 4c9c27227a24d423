"""Triangles of a mesh as they travel between machines: one plain form, its digest, and checks of what was received.

The form is the corners of all triangles, 36 B each: 3 corners of 3 numbers, IEEE 754 binary32, little-endian. It has
no indices, no names and no header, so that nothing but its numbers can be wrong.
"""

from __future__ import annotations

import hashlib
import re
import struct

import numpy as np

MAX_FACES = 200_000
"""Most triangles of one mesh: the limit of MuJoCo's reader of STL files."""

FACE_BYTES = 36
"""Size of one triangle [B]."""

MAX_BYTES = MAX_FACES * FACE_BYTES
"""Size of the largest mesh [B]."""

MAX_COORDINATE = 1e6
"""Largest magnitude of a coordinate before it is scaled: files in millimetres have thousands."""

_DIGEST = re.compile(r"[0-9a-f]{40}")


class TrianglesError(ValueError):
    """Bytes that are no triangles; the text gives the reason."""


def digest_of(payload: bytes) -> str:
    """The digest of encoded triangles: 40 hex digits (BLAKE2b, 160 bits)."""
    return hashlib.blake2b(payload, digest_size=20).hexdigest()


def is_digest(text: str) -> bool:
    """Whether a text can be a digest."""
    return _DIGEST.fullmatch(text) is not None


def encode_triangles(corners: np.ndarray) -> bytes:
    """Encode ``corners`` [face, 3, 3]; :class:`TrianglesError` if there are none, too many, or not finite ones."""
    payload = np.ascontiguousarray(corners, "<f4").tobytes()
    decode_triangles(payload)
    return payload


def decode_triangles(payload: bytes) -> np.ndarray:
    """Corners [face, 3, 3] of encoded triangles; :class:`TrianglesError` if the bytes are none."""
    faces, rest = divmod(len(payload), FACE_BYTES)
    if rest or not 1 <= faces <= MAX_FACES:
        raise TrianglesError(f"{len(payload)} B are no 1 to {MAX_FACES} triangles of {FACE_BYTES} B")
    corners = np.frombuffer(payload, "<f4").reshape(faces, 3, 3)
    if not (np.abs(corners) <= MAX_COORDINATE).all():  # also false for NaN
        raise TrianglesError(f"a corner is not finite or beyond {MAX_COORDINATE:g}")
    return corners


def to_stl(corners: np.ndarray) -> bytes:
    """A binary STL file of ``corners`` [face, 3, 3], for programs that read files; its normals are zero."""
    facets = np.zeros(len(corners), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]))
    facets["corners"] = corners
    return bytes(80) + struct.pack("<I", len(corners)) + facets.tobytes()
