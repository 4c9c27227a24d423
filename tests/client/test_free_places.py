"""Actors that join a world start where nobody stands."""

import numpy as np
import pytest

from vinesim.client.tasks.free_places import TAKEN, choose_places
from vinesim.client.tasks.start_poses import BASE_CLEARANCE, ground_clearance, start_pose
from vinesim.net.codec.human import encode_pose
from vinesim.net.replication import interest
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.scene.values import POINT_NAMES, HumanUpdate, RobotUpdate

SCENE = load_scene("demo")
MODEL = generate(SCENE)
PLACES = [start_pose(SCENE, number) for number in (0, 1)]


class World:
    """A world in memory, in which time passes while an actor waits: live actors publish their poses."""

    def __init__(self):
        self.hub = MemoryHub(delay=0.03)
        self.actors = {}
        self.time = 0.0

    def join(self, name, pose=None, update=None):
        """Returns the bus of a new live actor, which stands at ``pose`` [7]; without a pose it is starting."""
        bus = self.hub.bus(name)
        self.hub.advance(0.1)
        if pose is not None:
            self.stand(bus, pose, update)
        return bus

    def stand(self, bus, pose, update=None):
        update = update or RobotUpdate(bus.name, 0.0, pose, np.zeros(6), np.zeros(2), np.zeros(2))
        region = interest.region_chunks(interest.cell_of(update.base_q, interest.REGION_SIZE))
        key = interest.POSE_LAYERS[0].key.format(region=region, actor=bus.name)
        self.actors[bus.name] = bus.publisher(key), encode_pose(update)

    def wait(self, seconds):
        for publisher, payload in self.actors.values():
            publisher.put(payload)
        self.hub.advance(seconds)
        self.time += seconds

    def choose(self, bus, **given):
        return choose_places(SCENE, MODEL, bus, wait=self.wait, **given)


@pytest.fixture
def world():
    return World()


def test_an_actor_alone_starts_at_the_first_place_at_once(world):
    assert world.choose(world.join("anna")) == [0]
    assert world.time == 0.0


@pytest.mark.parametrize("kind", ["robot", "person"])
def test_the_second_actor_takes_the_next_place_and_says_so(world, caplog, kind):
    person = HumanUpdate("picker", 0.0, standing_pose(PLACES[0]), np.zeros((len(POINT_NAMES), 6)))
    world.join("picker", PLACES[0], person if kind == "person" else None)
    assert world.choose(world.join("anna")) == [1]
    assert caplog.messages == ["taken start places: 0 (left) by picker; anna starts at 1 (right)"]


def test_an_actor_beside_a_place_leaves_it_free(world, caplog):
    beside = PLACES[0].copy()
    beside[1] -= TAKEN + 0.05
    world.join("picker", beside)
    assert world.choose(world.join("anna")) == [0]
    assert not caplog.messages


def test_eyes_of_a_spectator_take_no_place(world):
    eyes = RobotUpdate("eve", 0.0, PLACES[0], np.zeros(6), np.zeros(0), np.zeros(0))
    world.join("eve", PLACES[0], eyes)
    assert world.choose(world.join("anna")) == [0]


def test_if_all_places_are_taken_an_actor_starts_behind_them_with_room(world, caplog):
    stand = []
    for name, place in zip("ab", PLACES, strict=True):
        world.join(name, place)
    for name in "efg":
        bus = world.join(name)
        (queue,) = world.choose(bus)
        stand.append(start_pose(SCENE, 0, queue=queue))
        world.stand(bus, stand[-1])
        assert "m behind" in caplog.messages[-1]
    places = np.array([*PLACES, *stand])[:, :2]
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + 9.0 * np.eye(len(places))
    assert apart.min() > TAKEN
    assert ground_clearance(MODEL, places[2:]).min() > BASE_CLEARANCE


def test_a_given_place_stays_and_the_actor_there_is_named(world, caplog):
    world.join("picker", PLACES[1])
    assert world.choose(world.join("anna"), number=1) == [0]
    (said,) = caplog.messages
    assert said.startswith("taken start places: 1 (right) by picker; anna starts at 1 (right)")
    assert "--spawn" in said
    assert world.choose(world.join("bob"), number=0) == [0]
    assert len(caplog.messages) == 1


def test_actors_that_start_at_once_choose_different_places(world):
    buses = [world.join(name) for name in ("carl", "anna", "bob")]
    chosen = [world.choose(bus)[0] for bus in buses]
    assert sorted(chosen) == sorted(set(chosen))
    assert chosen[1] == 0  # the first by name


def test_robots_of_one_client_share_no_place_with_others(world):
    world.join("picker", PLACES[0])
    first, second = world.choose(world.join("pair_1"), count=2)
    places = [start_pose(SCENE, 0, queue=queue)[:2] for queue in (first, second)]
    assert first == 1
    assert min(np.linalg.norm(place - PLACES[0][:2]) for place in places) > TAKEN
    assert np.linalg.norm(places[1] - places[0]) > TAKEN
