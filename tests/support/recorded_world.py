"""Light clients and a tree that bends: what several files of tests record."""

from __future__ import annotations

import functools

import numpy as np

from vinesim.core import frames
from vinesim.net.codec.control import Hello
from vinesim.net.replication.receiver import Inbox
from vinesim.net.replication.replicator import Replicator
from vinesim.net.transport.bus import Bus
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.values import RobotUpdate, TreeUpdate

TICK = 0.01


@functools.cache
def vineyard() -> Model:
    """Three trees, a metre apart along x."""
    trees = []
    for number in range(3):
        tree = TreeBuilder(frames.pose(np.array([number + 0.5, 0.0, 1.5])))
        tree.add_rod(-1, 0.6, (0.006, 0.004), RodMaterial(2e9, 900.0), 6)
        trees.append(tree)
    return assemble(trees)


class MinimalClient:
    """A minimal client: a robot at ``x`` that bends trees on request and applies the updates it receives."""

    def __init__(self, bus: Bus, x: float, **hello) -> None:
        self.model = vineyard()
        self.bus = bus
        self.name = bus.name
        hello = {"scene": "rows", "digest": self.model.digest(), "joints": 2, "seed": 5} | hello
        self.replicator = Replicator(bus, Hello(bus.name, **hello), self.model)
        self.state = State.at_rest(self.model)
        joints = np.array([0.1, -0.2][: hello["joints"]])
        self.robot = RobotUpdate(bus.name, 0.0, frames.pose([x, 0.0, 0.0]), np.zeros(6), joints, np.zeros(len(joints)))
        self.touched: set[int] = set()
        self.moving: set[int] = set()
        self.inbox = Inbox()
        self.received: list[TreeUpdate] = []
        self.joined: list[str] = []

    def tick(self, now: float) -> None:
        self.inbox = self.replicator.receive(now)
        self.joined += [hello.name for hello in self.inbox.joined]
        self.received += self.inbox.trees
        for update in self.inbox.trees:
            bodies = self.model.bodies_of(update.tree)
            self.state.joint_q[bodies], self.state.joint_qd[bodies] = update.joint_q, update.joint_qd
        for update in self.replicator.send(now, self.robot, touched=self.touched, moving=self.moving, read=self.read):
            bodies = self.model.bodies_of(update.tree)
            self.state.joint_q[bodies], self.state.joint_qd[bodies] = update.joint_q, update.joint_qd

    def read(self, tree: int) -> tuple[np.ndarray, np.ndarray]:
        bodies = self.model.bodies_of(tree)
        return self.state.joint_q[bodies], self.state.joint_qd[bodies]

    def bend(self, tree: int, angle: float) -> None:
        """Turn every joint of a tree by ``angle`` [rad] from its equilibrium, and touch it."""
        bodies = self.model.bodies_of(tree)
        turn = frames.exp(np.array([0.0, angle, 0.0]))
        self.state.joint_q[bodies] = frames.multiply(turn, self.model.joint_settled[bodies])
        self.touched = {tree}

    def environment(self) -> int:
        """Bytes sent about plants."""
        counters = self.replicator.counters
        return counters.environment.bytes_out + counters.event.bytes_out
