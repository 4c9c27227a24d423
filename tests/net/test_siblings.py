"""Several actors of one client own objects of one simulation: one owner of each, and none takes what another has."""

from __future__ import annotations

import numpy as np

from benchmarks.support.fake_client import tree_row
from vinesim.core import frames
from vinesim.net.codec.control import Hello
from vinesim.net.replication.replicator import Replicator
from vinesim.net.replication.sender import ADOPTION_DELAY
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.values import RobotUpdate

TICK = 0.01
BOX = object_id(ObjectKind.BOX, 1)
TREE = 1


class Shared:
    """A client whose actors stand along x; it ticks their replicators in turn, as :class:`Client` does."""

    def __init__(self, hub: MemoryHub, places: dict[str, float]) -> None:
        self.hub = hub
        self.model = tree_row(3)
        self.replicators = {
            name: Replicator(hub.bus(name), Hello(name, scene="rows", digest="same", joints=0), self.model)
            for name in places
        }
        self.places = places
        self.moving = set()
        self.present = list(places)
        self._share()

    def _share(self) -> None:
        present = [self.replicators[name] for name in self.present]
        for one in present:
            one.share_client(other for other in present if other is not one)

    def leave(self, name: str) -> None:
        """One actor ends; the others go on."""
        self.present.remove(name)
        self.replicators[name].bus.close()
        self._share()

    def tick(self, **actions: dict[str, set[int]]) -> None:
        now = self.hub.time
        for name in self.present:
            self.replicators[name].receive(now)
        for name in self.present:
            pose = RobotUpdate(name, 0.0, frames.pose([self.places[name], 0.0, 0.0]), np.zeros(6), *np.zeros((2, 0)))
            self.replicators[name].send(now, pose, read=self.read, moving=self.moving, **actions.get(name, {}))

    def read(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        if number == TREE:
            joint_q = self.model.joint_settled[self.model.bodies_of(TREE)]
            return joint_q, np.zeros((len(joint_q), 3))
        return frames.pose([1.5, 0.5, 0.12]), np.zeros(6)

    def owners(self, number: int) -> list[str]:
        return [name for name in self.present if number in self.replicators[name].owned]


def run(clients: list[Shared], seconds: float, *actions: dict) -> None:
    """Tick all; the last ``actions``, one for each client, go on."""
    for _ in range(round(seconds / TICK)):
        clients[0].hub.advance(TICK)
        for client, acts in zip(clients, actions or [{}] * len(clients), strict=True):
            client.tick(**acts)


def test_what_moves_is_not_adopted_from_an_actor_of_the_same_client_until_that_has_left():
    hub = MemoryHub(delay=0.02)
    farm = Shared(hub, {"ada": 0.0, "ann": 1.5, "eva": 4.0})
    visitor = Shared(hub, {"bob": 3.0})
    run([farm, visitor], 0.5)
    farm.moving = {BOX, TREE}
    run([farm, visitor], TICK, {"ada": {"grabbed": {BOX}, "touched": {TREE}}}, {})
    run([farm, visitor], 3.0 * ADOPTION_DELAY)
    assert farm.owners(BOX) == ["ada"], "ann is nearer and sees it move, but it has an owner"
    for client in (farm, visitor):
        for name in client.present:
            assert client.replicators[name].owner(BOX) == "ada"
            assert client.replicators[name].owner(TREE) == "ada"
    claim = visitor.replicators["bob"].claim(BOX)
    run([farm, visitor], 3.0 * ADOPTION_DELAY)
    assert visitor.replicators["bob"].claim(BOX) == claim, "not claimed again and again"
    farm.leave("ada")
    run([farm, visitor], 3.0 * ADOPTION_DELAY)
    assert farm.owners(BOX) == ["ann"], "the nearest that is left, and it alone"
    assert visitor.replicators["bob"].owner(BOX) == "ann"


def test_a_touch_does_not_take_what_an_actor_of_the_same_client_touches_but_a_grab_does():
    hub = MemoryHub(delay=0.02)
    farm = Shared(hub, {"ada": 0.0, "ann": 1.5})
    visitor = Shared(hub, {"bob": 3.0})
    run([farm, visitor], 0.5)
    farm.moving = {TREE}
    both = {name: {"touched": {TREE}} for name in ("ada", "ann")}
    run([farm, visitor], 1.0, both, {})
    assert farm.owners(TREE) == ["ada"]
    assert visitor.replicators["bob"].owner(TREE) == "ada"
    run([farm, visitor], 0.2, {"ann": {"touched": {TREE}}}, {})
    assert farm.owners(TREE) == ["ann"], "ada has let go"
    run([farm, visitor], TICK, {"ada": {"grabbed": {TREE}}}, {})
    run([farm, visitor], 0.2)
    assert farm.owners(TREE) == ["ada"]
    for name in ("ada", "ann"):
        assert farm.replicators[name].claim(TREE) == visitor.replicators["bob"].claim(TREE)
