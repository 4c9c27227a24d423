"""Named arrays and a few values in one binary message: what the page loads, and what it receives.

Layout, little-endian: length of the header [u32]; the header, JSON in ASCII, padded by spaces; the arrays, each from a
multiple of 8 bytes on. The header holds the values, and under ``arrays`` for each array its NumPy type, its shape and
where it begins, counted from the header's end.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

_ALIGNMENT = 8
_LENGTH = struct.Struct("<I")


def encode(values: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """One message. Raises ValueError for an array type that browsers lack (64-bit integers, objects)."""
    blocks = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    for name, block in blocks.items():
        if block.dtype.kind not in "iuf" or (block.dtype.kind != "f" and block.dtype.itemsize == 8):
            raise ValueError(f"array {name!r} of {block.dtype}: browsers read integers to 32 bits and floats")
    places = {}
    size = 0
    for name, block in blocks.items():
        places[name] = [block.dtype.str[1:], list(block.shape), size]
        size = _aligned(size + block.nbytes)
    text = json.dumps({**values, "arrays": places}).encode("ascii")
    start = _aligned(_LENGTH.size + len(text))
    message = bytearray(start + size)
    message[:start] = _LENGTH.pack(start - _LENGTH.size) + text.ljust(start - _LENGTH.size)
    for name, block in blocks.items():
        first = start + places[name][2]
        message[first : first + block.nbytes] = block.tobytes()
    return bytes(message)


def decode(message: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Values and arrays of a message, as the page reads it."""
    (length,) = _LENGTH.unpack_from(message)
    start = _LENGTH.size + length
    header = json.loads(message[_LENGTH.size : start])
    arrays = {}
    for name, (kind, shape, offset) in header.pop("arrays").items():
        count = int(np.prod(shape))
        arrays[name] = np.frombuffer(message, f"<{kind}", count, start + offset).reshape(shape)
    return header, arrays


def _aligned(offset: int) -> int:
    return -(-offset // _ALIGNMENT) * _ALIGNMENT
