"""The server's meshes: complete and right ones only, within bounds, as long as an actor needs them."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from tests.support.waiting import wait
from vinesim.net.codec.control import Hello, encode_hello, pack
from vinesim.net.codec.header import MAGIC, PROTOCOL, MessageError
from vinesim.net.codec.meshes import (
    MAX_PART,
    MESH_PART,
    MESH_REQUEST,
    MESH_WANTED,
    MeshPart,
    MeshWanted,
    decode_part,
    decode_request,
    decode_wanted,
    encode_part,
    encode_request,
)
from vinesim.net.server.mesh_store import MeshLimits, MeshStore
from vinesim.net.server.server import Server
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.scene.triangles import FACE_BYTES, MAX_BYTES, MAX_FACES, digest_of, encode_triangles

ANNA = ("vineyard", "anna")
BERT = ("vineyard", "bert")


def mesh(faces: int, seed: int = 0) -> bytes:
    return encode_triangles(np.random.default_rng(seed).normal(size=(faces, 3, 3)))


def upload(store: MeshStore, actor: tuple[str, str], payload: bytes, digest: str | None = None) -> MeshWanted:
    """Offer a mesh and send the parts that the store asks for."""
    digest = digest or digest_of(payload)
    wanted = store.offer(actor, MeshPart(digest, len(payload)))
    while not wanted.refused and wanted.offset < len(payload):
        data = payload[wanted.offset : wanted.offset + MAX_PART]
        wanted = store.offer(actor, MeshPart(digest, len(payload), wanted.offset, data))
    return wanted


def download(store: MeshStore, digest: str) -> bytes:
    arrived = b""
    while (part := store.part(digest, len(arrived))).size > len(arrived):
        arrived += part.data
    return arrived


def test_a_mesh_comes_back_as_it_was_and_is_sent_once() -> None:
    store = MeshStore()
    payload = mesh(5000)
    assert len(payload) > 2 * MAX_PART
    assert upload(store, ANNA, payload) == MeshWanted(len(payload))
    assert download(store, digest_of(payload)) == payload
    assert store.offer(BERT, MeshPart(digest_of(payload), len(payload))) == MeshWanted(len(payload))
    assert (len(store), store.counters.kept, store.bytes) == (1, 1, len(payload))


def test_lost_repeated_and_reordered_parts_do_no_harm() -> None:
    """Each reply tells what is missing, whatever has arrived."""
    store = MeshStore()
    payload = mesh(8000)
    random = np.random.default_rng(1)
    digest = digest_of(payload)
    wanted = MeshWanted(0)
    for _ in range(1000):
        offset = wanted.offset if random.random() < 0.5 else int(random.integers(len(payload)))
        part = MeshPart(digest, len(payload), offset, payload[offset : offset + MAX_PART])
        wanted = store.offer(ANNA, part)
        if wanted.offset == len(payload):
            break
    assert download(store, digest) == payload


@pytest.mark.parametrize("payload", [b"x" * 50, np.full(9, np.nan, "<f4").tobytes(), np.full(9, 2e6, "<f4").tobytes()])
def test_what_is_no_mesh_is_not_kept(payload: bytes) -> None:
    store = MeshStore()
    assert "corrupt" in upload(store, ANNA, payload).refused
    assert (len(store), store.bytes, store.counters.corrupt) == (0, 0, 1)


def test_a_mesh_of_another_digest_is_not_kept() -> None:
    """So no actor can put its triangles in the place of another's."""
    store = MeshStore()
    payload = mesh(5)
    assert "corrupt" in upload(store, ANNA, mesh(5, seed=1), digest_of(payload)).refused
    assert store.part(digest_of(payload), 0).size == 0
    assert not upload(store, BERT, payload).refused
    assert download(store, digest_of(payload)) == payload


def test_bounds_in_bytes_and_number_of_one_actor_and_of_all() -> None:
    limits = MeshLimits(count=5, total=50 * FACE_BYTES, per_actor=25 * FACE_BYTES, count_per_actor=3)
    store = MeshStore(limits)
    assert "at most" in store.offer(ANNA, MeshPart(digest_of(b""), MAX_BYTES + 36)).refused
    assert not upload(store, ANNA, mesh(20)).refused
    assert "of one actor" in upload(store, ANNA, mesh(10, seed=1)).refused
    assert "of one actor" in upload(store, ANNA, mesh(26, seed=1)).refused
    assert not upload(store, ANNA, mesh(2, seed=2)).refused
    assert not upload(store, ANNA, mesh(2, seed=3)).refused
    assert "3 meshes" in upload(store, ANNA, mesh(1, seed=4)).refused
    assert "of one actor" in upload(store, ANNA, mesh(1, seed=4)).refused
    assert not upload(store, BERT, mesh(20, seed=5)).refused
    carl = ("vineyard", "carl")
    assert "no room" in upload(store, carl, mesh(24, seed=6)).refused
    store.release(BERT)  # what no actor offers any more makes room
    assert not upload(store, carl, mesh(24, seed=6)).refused
    assert store.part(digest_of(mesh(20, seed=5)), 0).size == 0
    assert store.part(digest_of(mesh(20)), 0).size == 20 * FACE_BYTES
    assert store.counters.refused == 6
    assert store.bytes <= limits.total


def test_incomplete_meshes_count_and_end_with_their_actor() -> None:
    store = MeshStore(MeshLimits(total=100 * FACE_BYTES))
    for i in range(20):  # one at a time: another one takes the place of the one that was begun
        assert not store.offer(ANNA, MeshPart(digest_of(bytes([i])), 90 * FACE_BYTES, 0, b"x" * 36)).refused
        assert store.bytes == 90 * FACE_BYTES
    assert "no room" in upload(store, BERT, mesh(95)).refused
    store.release(ANNA)
    assert store.bytes == 0
    assert not upload(store, BERT, mesh(20)).refused


def test_a_shared_mesh_stays_until_the_last_of_its_actors_has_left() -> None:
    store = MeshStore(MeshLimits(count=1))
    payload = mesh(5)
    for actor in (ANNA, BERT):
        assert not upload(store, actor, payload).refused
    store.release(ANNA)
    assert "no room" in upload(store, ("vineyard", "carl"), mesh(6)).refused
    store.release(BERT)
    assert download(store, digest_of(payload)) == payload
    assert not upload(store, ("vineyard", "carl"), mesh(6)).refused


def test_actors_that_fill_the_store_keep_no_other_from_it() -> None:
    """Whoever holds less than the largest group gets its room; groups are addresses, so many names do not help."""
    store = MeshStore(MeshLimits(total=100 * FACE_BYTES, per_actor=50 * FACE_BYTES))
    hoarders = [("vineyard", f"hoarder{number}") for number in range(5)]
    for number, hoarder in enumerate(hoarders):
        for part in range(4):
            upload(store, hoarder, mesh(5, seed=10 * number + part))
    assert store.bytes == 100 * FACE_BYTES
    assert not upload(store, ANNA, mesh(10, seed=90)).refused
    assert "no room" in upload(store, ANNA, mesh(30, seed=91)).refused
    store = MeshStore(MeshLimits(total=100 * FACE_BYTES, per_actor=50 * FACE_BYTES))
    for number in range(100):
        assert not store.offer(
            ("w", f"n{number}"), MeshPart(digest_of(mesh(1, number)), 36, 0, mesh(1, number)), "a"
        ).refused
    assert not upload(store, ANNA, mesh(40, seed=90)).refused
    assert download(store, digest_of(mesh(40, seed=90))) == mesh(40, seed=90)


DIGEST = digest_of(b"")


@pytest.mark.parametrize(
    "part",
    [
        MeshPart("../../etc/passwd", 36),
        MeshPart(DIGEST.upper(), 36),
        MeshPart(DIGEST, -1),
        MeshPart(DIGEST, 36, -1),
        MeshPart(DIGEST, 36, 1, b"x" * 36),
        MeshPart(DIGEST, MAX_BYTES + 1),
        MeshPart(DIGEST, 1 << 62, 1 << 61),
        MeshPart(DIGEST, MAX_BYTES, 0, bytes(MAX_PART + 1)),
    ],
)
def test_impossible_parts_are_malformed(part: MeshPart) -> None:
    with pytest.raises(MessageError):
        decode_part(encode_part(part))


@pytest.mark.parametrize("decode", [decode_part, decode_request, decode_wanted])
def test_random_bytes_are_malformed(decode) -> None:
    random = np.random.default_rng(2)
    kinds = [MESH_PART, MESH_REQUEST, MESH_WANTED]
    for _ in range(5000):
        value = random.bytes(int(random.integers(0, 60)))
        head = MAGIC + bytes((PROTOCOL, int(random.choice(kinds))))
        try:
            decode(head + value if random.random() < 0.9 else value)
        except MessageError:
            continue
    for value in (None, [], [1, 2, 3, 4, 5], [-1], [MAX_BYTES + 1], ["x"], {"offset": 0}, [[0]]):
        for kind in kinds:
            with pytest.raises(MessageError):
                decode(pack(kind, value))
    assert msgspec.msgpack.decode(encode_request(3)[4:]) == [3]


def test_only_an_actor_that_has_joined_offers_and_only_right_keys_are_answered() -> None:
    payload = mesh(2 * MAX_PART // FACE_BYTES)
    digest = digest_of(payload)
    begin = encode_part(MeshPart(digest_of(payload), len(payload)))
    with Server("tcp/127.0.0.1:0") as server, ZenohBus("anna", connect=server.endpoint) as anna:
        assert anna.fetch("offer/anna", begin) == []  # it has not joined
        anna.join(encode_hello(Hello("anna", digest="D", scene="demo")))
        assert anna.admissions  # it joins again if Zenoh reports only then that the server is there
        (reply,) = anna.fetch("offer/anna", begin)
        assert decode_wanted(reply) == MeshWanted(0)
        request = encode_request(0)
        for key, question in (
            ("offer/bert", begin),
            ("offer/*", begin),
            ("offer/anna", b"x"),
            ("offer/anna", request),
            ("mesh/*", request),
            ("mesh/nothing", request),
            (f"mesh/{digest}", begin),
            (f"mesh/{digest}", b""),
            (f"mesh/{digest}/a", request),
        ):
            assert anna.fetch(key, question) == [], key
        assert server.malformed >= 8
        (reply,) = anna.fetch(f"mesh/{digest}", request)
        assert decode_part(reply) == MeshPart(digest, 0)
        offset = 0
        while offset < len(payload):
            part = MeshPart(digest, len(payload), offset, payload[offset : offset + MAX_PART])
            (reply,) = anna.fetch("offer/anna", encode_part(part))
            offset = decode_wanted(reply).offset
        (reply,) = anna.fetch(f"mesh/{digest}", encode_request(MAX_PART))
        assert decode_part(reply).data == payload[MAX_PART : 2 * MAX_PART]
        figures = server.figures()
        assert (figures["meshes"], figures["mesh_bytes"]) == (1, len(payload))
        server.meshes.limits = dataclasses.replace(server.meshes.limits, count=1)
        anna.close()
        wait(lambda: not upload(server.meshes, BERT, mesh(1)).refused, "anna to leave and hers to make room")


def test_the_largest_mesh_fits() -> None:
    store = MeshStore()
    payload = np.zeros((MAX_FACES, 3, 3), "<f4").tobytes()
    assert not upload(store, ANNA, payload).refused
    assert store.bytes == MAX_BYTES
