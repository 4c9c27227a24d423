"""Binary messages to the page with named arrays and a few values.

Layout, little-endian: length of the header [u32]; the header, JSON in ASCII, padded with spaces; the arrays, each
aligned to 8 bytes. The header contains the values, and under ``arrays`` the NumPy type, shape and offset of each array,
counted from the end of the header.
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
    """Encode one message. Raises ValueError for an array type that browsers lack (64-bit integers, objects)."""
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
    """Decode the values and arrays of a message, as the page does."""
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
