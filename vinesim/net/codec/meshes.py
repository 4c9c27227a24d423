"""Wire formats, in msgpack, for requests of meshes from the server and for meshes that an actor offers the server.

A mesh travels in parts of at most :data:`MAX_PART`, one query and one reply for each. Its only name is its digest
(:func:`vinesim.scene.triangles.digest_of`).
"""

from __future__ import annotations

import msgspec

from vinesim.net.codec.control import pack, unpack
from vinesim.net.codec.header import MessageError
from vinesim.scene.triangles import MAX_BYTES, is_digest

MESH_PART = 19
MESH_REQUEST = 20
MESH_WANTED = 21
"""Numbers of the kinds of messages in this module. The fourth byte of a message is the number of its kind."""

MAX_PART = 64_000
"""Largest size of the part of a mesh in one message [B]."""


class MeshPart(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A part of a mesh, which the server sends in reply to a :class:`MeshRequest`, or which an actor offers the
    server."""

    digest: str
    size: int
    """Size of the whole mesh [B]; 0: the server has no mesh with this digest."""
    offset: int = 0
    """Position of ``data`` in the mesh [B]."""
    data: bytes = b""


class MeshRequest(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Request for the part of a mesh that begins at ``offset`` [B]. The key of the query contains the digest of the
    mesh."""

    offset: int


class MeshWanted(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The server's reply to a :class:`MeshPart` that an actor offers."""

    offset: int
    """Position in the mesh of the part that the actor shall send next [B]. Equal to the size of the
    mesh if the server has all parts."""
    refused: str = ""
    """Reason why the server does not accept the mesh now; empty if it accepts the mesh."""


def encode_part(part: MeshPart) -> bytes:
    """Encode a part of a mesh."""
    return pack(MESH_PART, part)


def decode_part(payload: bytes) -> MeshPart:
    """Decode a part of a mesh. Raises :class:`MessageError` if the part is outside of the mesh, or anything is too
    large."""
    part = unpack(payload, MESH_PART, "part of a mesh", _part_decoder)
    if not is_digest(part.digest):
        raise MessageError(f"part of a mesh with the digest {part.digest[:60]!r}")
    if not 0 <= part.size <= MAX_BYTES or not 0 <= part.offset <= part.size - len(part.data):
        raise MessageError(f"{len(part.data)} B at {part.offset} of a mesh of {part.size} B, of at most {MAX_BYTES} B")
    if len(part.data) > MAX_PART:
        raise MessageError(f"part of a mesh of {len(part.data)} B, at most {MAX_PART} B")
    return part


def encode_request(offset: int) -> bytes:
    """Encode a request for the part of a mesh that begins at ``offset`` [B]."""
    return pack(MESH_REQUEST, MeshRequest(offset))


def decode_request(payload: bytes) -> int:
    """Decode a request for a part of a mesh. Returns its offset [B]; raises :class:`MessageError` if it is invalid."""
    offset = unpack(payload, MESH_REQUEST, "request for a mesh", _request_decoder).offset
    if not 0 <= offset <= MAX_BYTES:
        raise MessageError(f"request for a mesh from {offset} B on")
    return offset


def encode_wanted(wanted: MeshWanted) -> bytes:
    """Encode the server's reply to a part that an actor offers."""
    return pack(MESH_WANTED, wanted)


def decode_wanted(payload: bytes) -> MeshWanted:
    """Decode the server's reply to a part that an actor offers. Raises :class:`MessageError` if it is invalid."""
    wanted = unpack(payload, MESH_WANTED, "reply to an offered mesh", _wanted_decoder)
    if not 0 <= wanted.offset <= MAX_BYTES:
        raise MessageError(f"reply that asks for a mesh from {wanted.offset} B on")
    return wanted


_part_decoder = msgspec.msgpack.Decoder(MeshPart)

_request_decoder = msgspec.msgpack.Decoder(MeshRequest)

_wanted_decoder = msgspec.msgpack.Decoder(MeshWanted)
