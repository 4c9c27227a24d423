"""Meshes of robots reach clients that do not have their files: seen and felt as they are, once they have arrived."""

from __future__ import annotations

import hashlib
import shutil
import struct
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.support.contact_scenes import cane
from tests.support.waiting import wait
from vinesim.client.client import Client
from vinesim.client.faults import count_faults
from vinesim.client.remote.mesh_exchange import MeshExchange
from vinesim.core import frames
from vinesim.net.codec.meshes import MAX_PART, MeshPart, decode_request, encode_part
from vinesim.net.server.server import Server
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.meshes import MAX_MESHES, list_meshes
from vinesim.scene.builder import assemble
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.triangles import MAX_FACES, digest_of, encode_triangles
from vinesim.sensors.primitives.rigid_primitives import rigid_batches

OPENED: list[str] = []
"""Names of the files that Python opened since the list was cleared."""
sys.addaudithook(lambda event, arguments: OPENED.append(str(arguments[0])) if event == "open" else None)

BOTTOM = 0.1
TOP = 1.1
CRATE = 0.3
"""Heights of the pyramid's base and tip, and the edge of the crate [m]."""
PYRAMID = trimesh.Trimesh(
    [[-0.5, -0.5, BOTTOM], [0.5, -0.5, BOTTOM], [0.5, 0.5, BOTTOM], [-0.5, 0.5, BOTTOM], [0, 0, TOP]],
    [[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]],
)
URDF = """<robot name="pyramid"><link name="base_footprint">
<inertial><mass value="80"/><inertia ixx="9" iyy="9" izz="9" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="package://pyramid_description/meshes/body.{form}"/></geometry></visual>
<collision><geometry><mesh filename="package://pyramid_description/meshes/body.{form}"/></geometry></collision>
</link></robot>"""


def package(folder: Path, form: str = "stl") -> RobotDescription:
    """A robot whose one link is a pyramid, from a ROS package in ``folder``."""
    meshes = folder / "pyramid_description" / "meshes"
    meshes.mkdir(parents=True)
    PYRAMID.export(meshes / f"body.{form}")
    file = folder / "pyramid_description" / "urdf" / "pyramid.urdf"
    file.parent.mkdir()
    file.write_text(URDF.format(form=form))
    return load_description(file)


class HeldBus(ZenohBus):
    """A bus that offers meshes only when it is told to."""

    def __init__(self, name: str, connect: str) -> None:
        self.may_offer = threading.Event()
        super().__init__(name, connect=connect)

    def fetch(self, key: str, payload: bytes = b"") -> list[bytes]:
        return [] if key.startswith("offer/") and not self.may_offer.is_set() else super().fetch(key, payload)


@pytest.fixture
def empty_cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def server():
    with Server("tcp/127.0.0.1:0") as running:
        yield running


def model() -> Model:
    crate = {"box_pose": [[20.0, 20.0, 0.001, 0, 0, 0, 1]], "box_size": [[CRATE] * 3], "box_mass": [2.0]}
    return assemble([cane((30.0, 30.0, 1.4))], **crate)


def drop_crate(client: Client) -> None:
    """Let the crate fall onto the edge of the pyramid, or onto the corner of its bounds."""
    rigid = client.physics.rigid
    address = rigid.mj_model.jnt_qposadr[rigid.mj_model.body("box/0").jntadr[0]]
    rigid.mj_data.qpos[address : address + 7] = [0.36, 0.36, TOP + CRATE + 0.05, 1.0, 0.0, 0.0, 0.0]
    rigid.mj_data.qvel[rigid.mj_model.body("box/0").dofadr[0] :][:6] = 0.0
    rigid.invalidate_kinematics()


def crate_height(client: Client) -> float:
    """[m] Of its origin."""
    client.physics.rigid.update_kinematics()
    return float(client.physics.rigid.mj_data.body("box/0").xpos[2])


def seen(client: Client, name: str) -> str:
    """Digest of all primitives of a robot, as cameras and lidars see them."""
    visuals = tuple(visual for visual in client.physics.visuals() if visual.name.startswith(f"{name}/"))
    digest = hashlib.sha256()
    for batch in rigid_batches(client.model, visuals, 0, 0, {}):
        for key in ("kind", "a", "b", "c"):
            digest.update(np.ascontiguousarray(getattr(batch, key)).tobytes())
    return digest.hexdigest()


def touched(client: Client, name: str) -> tuple[np.ndarray, np.ndarray]:
    """MuJoCo types of the geoms of a robot, and the vertices of their meshes, sorted."""
    m = client.physics.rigid.mj_model
    bodies = list(client.physics.rigid.robot(name).bodies.values())
    geoms = np.flatnonzero(np.isin(m.geom_bodyid, bodies))
    corners = [m.mesh_vert[m.mesh_vertadr[i] :][: m.mesh_vertnum[i]] for i in m.geom_dataid[geoms] if i >= 0]
    vertices = np.concatenate([np.zeros((0, 3)), *corners]).round(6)
    return m.geom_type[geoms], vertices[np.lexsort(vertices.T)]


def until(condition: Callable[[], object], description: str, *clients: Client) -> None:
    """Step all clients until a condition holds."""

    def step() -> object:
        for client in clients:
            client.tick()
        return condition()

    wait(step, description)


def test_a_robot_is_seen_and_felt_where_its_files_do_not_exist(tmp_path, empty_cache, server):
    """One client has the package, the other none: first boxes, then the same triangles in its pictures and contacts."""
    description = package(tmp_path / "workspace")
    scene = load_scene("demo")
    far = frames.pose([12.0, 12.0, 0.0])
    with HeldBus("anna", server.endpoint) as hers, ZenohBus("bert", connect=server.endpoint) as his:
        anna = Client(scene, model(), description, hers, name="anna", pose=frames.pose(np.zeros(3)))
        bert = Client(scene, model(), None, his, name="bert", pose=far)
        until(lambda: "anna" in bert.remote_actors, "anna's robot at bert's", anna, bert)
        assert touched(bert, "anna")[0].tolist() == [6]  # a box
        assert seen(bert, "anna") != seen(anna, "anna")
        drop_crate(bert)
        for _ in range(200):  # it falls, and comes to rest
            bert.tick()
        assert crate_height(bert) > TOP - 0.02  # it stands on the box
        state = bert.physics.rigid.base_state("anna")[0]

        hers.may_offer.set()
        wait(lambda: len(server.meshes) == 1, "the mesh at the server")
        shutil.rmtree(tmp_path / "workspace")
        OPENED.clear()
        until(lambda: touched(bert, "anna")[0].tolist() == [7], "the mesh in bert's contacts", bert)
        assert seen(bert, "anna") == seen(anna, "anna")
        np.testing.assert_allclose(touched(bert, "anna")[1], touched(anna, "anna")[1], atol=2e-6)
        np.testing.assert_allclose(bert.physics.rigid.base_state("anna")[0], state, atol=1e-3)
        until(lambda: crate_height(bert) < 0.5 * TOP, "the crate to slide down the pyramid", bert)
        assert not [name for name in OPENED if "pyramid_description" in name or name.endswith(".stl")]
        assert list(empty_cache.glob("mesh-*.npz"))
        assert not {"meshes_refused", "meshes_not_taken"} & (count_faults(bert).keys() | count_faults(anna).keys())
        anna.leave()
        bert.leave()


def test_a_mesh_that_is_in_the_cache_is_not_sent_again(tmp_path, empty_cache, server):
    """Here of another file format: what is sent, seen and touched does not depend on it."""
    description = package(tmp_path, "obj")
    scene = load_scene("demo")
    served = []
    with ZenohBus("anna", connect=server.endpoint) as hers:
        anna = Client(scene, model(), description, hers, name="anna", pose=frames.pose(np.zeros(3)))
        for name in ("bert", "carl"):
            with ZenohBus(name, connect=server.endpoint) as bus:
                client = Client(scene, model(), None, bus, name=name, pose=frames.pose([12.0, 12.0, 0.0]))
                until(
                    lambda client=client: "anna" in client.remote_actors and seen(client, "anna") == seen(anna, "anna"),
                    "the mesh",
                    anna,
                    client,
                )
                np.testing.assert_allclose(touched(client, "anna")[1], touched(anna, "anna")[1], atol=2e-6)
                client.leave()
            served.append(server.meshes.counters.served)
        anna.leave()
    assert served[0] == served[1] > 0


# ---------------------------------------------------------------- corrupt, oversized, of another digest


class LyingBus:
    """A bus whose server replies with what ``reply(key, payload)`` makes."""

    name = "bert"
    admissions = 1

    def __init__(self, reply: Callable[[str, bytes], list[bytes]]) -> None:
        self.fetch = reply


def exchange_over(reply: Callable[[str, bytes], list[bytes]]) -> MeshExchange:
    exchange = MeshExchange()
    exchange.bus = LyingBus(reply)  # pyright: ignore[reportAttributeAccessIssue] only what the exchange uses
    return exchange


def text_of(*digests: str, faces: int = 6) -> str:
    """A URDF that offers meshes of these digests."""
    meshes = "".join(
        f'<visual><geometry><mesh filename="/etc/passwd" bounds="0 0 0 1 1 1" digest="{digest}" faces="{faces}"/>'
        "</geometry></visual>"
        for digest in digests
    )
    return f'<robot name="r"><link name="base_footprint">{meshes}</link></robot>'


PAYLOAD = encode_triangles(PYRAMID.triangles)
DIGEST = digest_of(PAYLOAD)
NAN = struct.pack("<9f", *[0.0] * 8, np.nan)


@pytest.mark.parametrize(
    ("payload", "digest"),
    [
        (PAYLOAD[:-36] + bytes(36), DIGEST),
        (PAYLOAD + PAYLOAD, DIGEST),
        (b"x" * 50, digest_of(b"x" * 50)),
        (NAN, digest_of(NAN)),
        (struct.pack("<9f", *[2e6] * 9), digest_of(struct.pack("<9f", *[2e6] * 9))),
    ],
    ids=["another digest", "too long", "no whole triangle", "not finite", "beyond all bounds"],
)
def test_a_mesh_that_is_not_what_its_digest_says_is_counted_and_never_used(payload, digest, empty_cache):
    def reply(key: str, question: bytes) -> list[bytes]:
        offset = decode_request(question)
        part = MeshPart(digest, len(payload), offset, payload[offset : offset + MAX_PART])
        return [encode_part(part)]

    exchange = exchange_over(reply)
    exchange.want("anna", text_of(digest))
    wait(lambda: exchange.refused_count == 1, "the refusal")
    assert not exchange.received("anna")
    assert exchange.changed() == []
    assert not list(empty_cache.glob("*.npz"))
    exchange.close()


def test_random_replies_never_end_the_exchange(empty_cache):
    """Bytes of any kind, replies cut short or with other numbers: no mesh comes, the thread goes on, then a right one
    arrives."""
    random = np.random.default_rng(3)
    right = encode_part(MeshPart(DIGEST, len(PAYLOAD), 0, PAYLOAD))
    asked = 0

    def reply(key: str, question: bytes) -> list[bytes]:
        nonlocal asked
        asked += 1
        if key.endswith(DIGEST):
            return [right] if asked > 200 else []
        kind = asked % 3
        if kind == 0:
            return [random.bytes(int(random.integers(0, 300)))]
        damaged = bytearray(right)
        for at in random.integers(0, len(damaged), 3):
            damaged[at] = random.integers(256)
        return [bytes(damaged[: int(random.integers(len(damaged)))] if kind == 1 else damaged)]

    exchange = exchange_over(reply)
    others = [digest_of(bytes([i])) for i in range(240)]
    exchange.want("eve", text_of(*others))
    exchange.want("anna", text_of(DIGEST))
    wait(lambda: exchange.refused_count == len(others), "all to be refused")
    wait(lambda: exchange.received("anna"), "the mesh of anna")
    np.testing.assert_array_equal(exchange.received("anna")[DIGEST], PYRAMID.triangles.astype(np.float32))
    assert not exchange.received("eve")
    exchange.close()


def test_a_broken_cache_is_filled_anew(empty_cache):
    reply = [encode_part(MeshPart(DIGEST, len(PAYLOAD), 0, PAYLOAD))]
    for broken in (b"no archive", None):
        empty_cache.mkdir(exist_ok=True)
        file = empty_cache / f"mesh-{DIGEST}.npz"
        if broken is None:
            np.savez(file, corners=np.zeros((3, 3, 3)))
        else:
            file.write_bytes(broken)
        exchange = exchange_over(lambda key, question: reply)
        exchange.want("anna", text_of(DIGEST))
        wait(lambda exchange=exchange: exchange.received("anna"), "the mesh")
        exchange.close()
        np.testing.assert_array_equal(np.load(file)["corners"], PYRAMID.triangles.astype(np.float32))


def test_what_a_text_asks_for_is_bounded():
    many = [digest_of(bytes([i % 256, i // 256])) for i in range(MAX_MESHES + 50)]
    assert len(list_meshes(text_of(*many))) == MAX_MESHES
    assert len(list_meshes(text_of(*many, faces=MAX_FACES))) == (64 << 20) // (36 * MAX_FACES)
    for text in (
        text_of(many[0], faces=MAX_FACES + 1),
        text_of(many[0], faces=0),
        text_of(many[0], faces=-1),
        text_of("../../x"),
        text_of(many[0].upper()),
        text_of(many[0] + "0"),
        "no xml",
        '<!DOCTYPE r [<!ENTITY e SYSTEM "x">]><r>&e;</r>',
    ):
        assert not list_meshes(text)
