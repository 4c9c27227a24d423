"""Wire format of meshes in msgpack: questions for parts of one, and parts of one that an actor offers the server.

Both go in parts of at most :data:`MAX_PART`, one question each. A mesh is named by its digest
(:func:`vinesim.scene.triangles.digest_of`) alone.
"""

from __future__ import annotations

import msgspec

from vinesim.net.codec.control import pack, unpack
from vinesim.net.codec.header import MessageError
from vinesim.scene.triangles import MAX_BYTES, is_digest

MESH_PART = 19
MESH_REQUEST = 20
MESH_WANTED = 21
"""Kinds of the messages."""

MAX_PART = 64_000
"""Largest part of a mesh in one message [B]."""


class MeshPart(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A part of a mesh: the server's reply to a :class:`MeshRequest`, or what an actor offers it."""

    digest: str
    size: int
    """Of the whole mesh [B]; 0: the server has none of this digest."""
    offset: int = 0
    """Where ``data`` begins [B]."""
    data: bytes = b""


class MeshRequest(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Asks for the part of a mesh that begins at ``offset`` [B]; the key has its digest."""

    offset: int


class MeshWanted(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The server's reply to a :class:`MeshPart` that an actor offers."""

    offset: int
    """Where the next part must begin [B]; the size of the mesh: the server has all of it."""
    refused: str = ""
    """Empty, or why the server does not take the mesh now."""


def encode_part(part: MeshPart) -> bytes:
    """Encode a part."""
    return pack(MESH_PART, part)


def decode_part(payload: bytes) -> MeshPart:
    """Decode a part that lies within a mesh of an allowed size; :class:`MessageError`."""
    part = unpack(payload, MESH_PART, "part of a mesh", _part_decoder)
    if not is_digest(part.digest):
        raise MessageError(f"part of a mesh with the digest {part.digest[:60]!r}")
    if not 0 <= part.size <= MAX_BYTES or not 0 <= part.offset <= part.size - len(part.data):
        raise MessageError(f"{len(part.data)} B at {part.offset} of a mesh of {part.size} B, of at most {MAX_BYTES} B")
    if len(part.data) > MAX_PART:
        raise MessageError(f"part of a mesh of {len(part.data)} B, at most {MAX_PART} B")
    return part


def encode_request(offset: int) -> bytes:
    """Encode a request for the part that begins at ``offset`` [B]."""
    return pack(MESH_REQUEST, MeshRequest(offset))


def decode_request(payload: bytes) -> int:
    """The offset [B] of a request; :class:`MessageError`."""
    offset = unpack(payload, MESH_REQUEST, "request for a mesh", _request_decoder).offset
    if not 0 <= offset <= MAX_BYTES:
        raise MessageError(f"request for a mesh from {offset} B on")
    return offset


def encode_wanted(wanted: MeshWanted) -> bytes:
    """Encode the reply to an offer."""
    return pack(MESH_WANTED, wanted)


def decode_wanted(payload: bytes) -> MeshWanted:
    """Decode the reply to an offer; :class:`MessageError`."""
    wanted = unpack(payload, MESH_WANTED, "reply to an offered mesh", _wanted_decoder)
    if not 0 <= wanted.offset <= MAX_BYTES:
        raise MessageError(f"reply that asks for a mesh from {wanted.offset} B on")
    return wanted


_part_decoder = msgspec.msgpack.Decoder(MeshPart)

_request_decoder = msgspec.msgpack.Decoder(MeshRequest)

_wanted_decoder = msgspec.msgpack.Decoder(MeshWanted)
