"""Vines, boxes and carts with a hand, several clients on one bus in memory, and a server of retained records."""

from __future__ import annotations

import functools
import pathlib
import tempfile

import numpy as np
import pytest

from tests.support.contact_scenes import cane
from vinesim.client.client import Client
from vinesim.core import frames
from vinesim.net.codec.control import decode_records, encode_records
from vinesim.net.replication.retained import RetainedState
from vinesim.net.transport.bus import KEEP_ALL
from vinesim.net.transport.memory_bus import MemoryBus, MemoryHub
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.scene.builder import assemble
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene as load_scene

DT = 0.01
SIZE = (0.5, 0.3, 0.2)
"""Of a box [m]."""
DECK = 0.25
"""Height of a cart's deck [m]."""
REACH = 0.75
"""How far before a cart's middle its hand is [m]."""


def _inertial(mass: float) -> str:
    i = 0.05 * mass
    return (
        f'<inertial><mass value="{mass}"/><inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _slab(at: str, size: str) -> str:
    return f'<collision><origin xyz="{at}"/><geometry><box size="{size}"/></geometry></collision>'


def _slide(name: str, parent: str, child: str, axis: str, origin: str) -> str:
    return (
        f'<joint name="{name}" type="prismatic"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}"/><axis xyz="{axis}"/><limit lower="-2" upper="2" effort="400" velocity="2"/></joint>'
    )


CART = f"""<robot name="cart"><link name="base_footprint">{_inertial(80)}
{_slab("0 0 0.2", "0.6 0.5 0.1")}{_slab("-0.262 0 0.28", "0.02 0.5 0.06")}{_slab("0.262 0 0.28", "0.02 0.5 0.06")}
{_slab("0 -0.162 0.28", "0.5 0.02 0.06")}{_slab("0 0.162 0.28", "0.5 0.02 0.06")}</link>
<link name="hand">{_inertial(2)}</link>
{_slide("lift", "base_footprint", "hand", "0 0 1", f"{REACH} 0 1.0")}
<link name="left">{_inertial(0.2)}{_slab("0 0 0", "0.06 0.02 0.08")}</link>
<link name="right">{_inertial(0.2)}{_slab("0 0 0", "0.06 0.02 0.08")}</link>
{_slide("close_left", "hand", "left", "0 -1 0", "0 0.10 0")}
{_slide("close_right", "hand", "right", "0 1 0", "0 -0.10 0")}
</robot>"""
SIDECAR = """[base]
linear = 1.0
[groups.lift]
joints = ["lift"]
stiffness = [20000.0]
damping = [1000.0]
[groups.fingers]
joints = ["close_left", "close_right"]
stiffness = [2000.0, 2000.0]
damping = [80.0, 80.0]
rotor = [0.5, 0.5]
"""


@functools.cache
def cart() -> RobotDescription:
    """A flat cart with a rim around its deck, and before it a hand of two fingers that goes up and down."""
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "cart.urdf"
        file.write_text(CART)
        file.with_suffix(".toml").write_text(SIDECAR)
        return load_description(file)


@functools.cache
def vineyard(trees: int = 2, boxes: int = 2, gap: float = 1.0) -> Model:
    """Canes along y, ``gap`` m apart, whose bunches hang at x = 1; boxes on the ground along y at x = -2."""
    poses = [[-2.0, gap * i, 0.001, 0.0, 0.0, 0.0, 1.0] for i in range(boxes)]
    return assemble(
        [cane((0.0, gap * i, 1.4), bunch=0.5) for i in range(trees)],
        box_pose=poses,
        box_size=[SIZE] * boxes,
        box_mass=[2.0] * boxes,
    )


class Server:
    """A server of retained records: it keeps the latest record of each object and publishes it."""

    CELLS = range(-4, 6)

    def __init__(self, hub: MemoryHub) -> None:
        self.hub = hub
        self.open()
        self.records = RetainedState()

    def open(self) -> None:
        self.bus: MemoryBus = self.hub.bus("server")
        self.bus.subscribe("fact/**", KEEP_ALL)
        for x in self.CELLS:
            for y in self.CELLS:
                self.bus.declare_queryable(f"snap/{x}/{y}", functools.partial(self.reply, (x, y)))

    def reply(self, cell: tuple[int, int], _: bytes) -> bytes:
        return encode_records(self.records.in_cell(cell))

    def tick(self) -> None:
        for key, payload in self.bus.poll():
            _, x, y, _ = key.split("/")
            for record in decode_records(payload):
                self.records.merge((int(x), int(y)), record)


class World:
    """Clients of one vineyard on one bus, ticked in turn by one clock; every client moves a cart."""

    def __init__(self, model: Model | None = None, *, delay: float = 0.02, jitter: float = 0.005, loss: float = 0.0):
        self.now = 100.0
        self.model = vineyard() if model is None else model
        self.scene = load_scene("demo")
        self.hub = MemoryHub(delay=delay, jitter=jitter, loss=loss, seed=1)
        self.server = Server(self.hub)
        self.clients: dict[str, Client] = {}

    def join(self, name: str, x: float, y: float, heading: float = 0.0) -> Client:
        pose = frames.pose([x, y, 0.0], frames.from_yaw(heading))
        scene = self.scene
        client = Client(scene, self.model, cart(), self.hub.bus(name), name=name, pose=pose, clock=lambda: self.now)
        client.physics.wind = None
        self.clients[name] = client
        return client

    def leave(self, name: str) -> None:
        self.clients.pop(name).replicator.bus.close()

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / DT)):
            for client in self.clients.values():
                client.tick()
            self.server.tick()
            self.hub.advance(DT)
            self.now += DT

    def until(self, condition, limit: float = 10.0) -> None:
        for _ in range(round(limit / DT)):
            self.run(DT)
            if condition():
                return
        pytest.fail(f"condition false after {limit} s of simulated time")


BUNCH = functools.partial(object_id, ObjectKind.BUNCH)
BOX = functools.partial(object_id, ObjectKind.BOX)


def pose_of(client: Client, number: int) -> np.ndarray:
    return client.physics.support_tracker.object_state(number)[0]


def put(client: Client, number: int, pose: np.ndarray) -> None:
    """Put a box or a free bunch at a pose [7], where it moves freely and at first stands still."""
    client.objects.forget(number)
    client.physics.support_tracker.set_state(number, pose, np.zeros(6))


def position_difference(a: Client, b: Client, number: int) -> float:
    """[m] Distance between the positions of an object on two clients."""
    return float(np.linalg.norm(pose_of(a, number)[:3] - pose_of(b, number)[:3]))


def bytes_sent(client: Client) -> int:
    """Bytes sent about trees, boxes and bunches: streams, ownership events and retained records."""
    counters = client.replicator.counters
    return sum(family.bytes_out for family in (counters.environment, counters.event, counters.retained))


def bytes_received(client: Client) -> int:
    counters = client.replicator.counters
    return sum(family.bytes_in for family in (counters.environment, counters.event, counters.retained))
