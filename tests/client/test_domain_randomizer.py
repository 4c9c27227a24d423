"""Random scenes of a data set: actors, free places, and determinism by the seed."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.client.composition.domain_randomizer import FOOTPRINT_RADIUS, SceneRandomizer, random_composition
from vinesim.scene.ids import Organ
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State

pytestmark = pytest.mark.slow


def test_placed_objects_do_not_overlap() -> None:
    """Footprints of added objects overlap neither trunks nor poles nor each other."""
    model = sensor_scenes.demo()
    wood = np.isin(model.fixed_organ, [Organ.POLE, Organ.TRUNK])
    for seed in range(60):
        composition = random_composition(model, np.array([2.5, 1.2]), np.random.default_rng(seed))
        discs = [((one.x, one.y), FOOTPRINT_RADIUS[one.robot]) for one in composition.robots]
        discs += [((one.x, one.y), FOOTPRINT_RADIUS["person"]) for one in composition.people]
        discs += [((one.x, one.y), FOOTPRINT_RADIUS["crate"]) for one in composition.crates]
        for k, (xy, radius) in enumerate(discs):
            assert np.hypot(*(model.fixed_start[wood, :2] - xy).T).min() > radius
            assert all(
                np.hypot(*np.subtract(xy, other_xy)) > radius + other_radius for other_xy, other_radius in discs[:k]
            )


def test_the_same_seed_gives_the_same_scene_and_another_seed_another() -> None:
    model = sensor_scenes.demo()
    results = []
    for seed in (1, 1, 2):
        randomised = SceneRandomizer(1.0).snapshot(model, np.random.default_rng(seed))
        assert randomised is not None
        snapshot, nearby, record = randomised
        results.append((snapshot.visual_q.tobytes(), snapshot.body_q.tobytes(), nearby.tobytes(), str(record)))
    assert results[0] == results[1] != results[2]


@pytest.mark.long
def test_wind_moves_the_plants() -> None:
    """Some leaves move by centimetres in wind, and none without."""
    model = sensor_scenes.demo()
    rest = State.at_rest(model).body_q[:, :3]
    moved = {True: [], False: []}
    for seed in range(8):
        randomised = SceneRandomizer(1.0).snapshot(model, np.random.default_rng(seed))
        assert randomised is not None
        snapshot, _, record = randomised
        hanging = np.ones(len(rest), bool)
        hanging[model.bunch_of_body() >= 0] = False
        moved["wind" in record].append(np.linalg.norm(snapshot.body_q[:, :3] - rest, axis=1)[hanging].max())
    assert max(moved[False]) < 0.02
    assert max(moved[True]) > 0.02


@pytest.mark.long
def test_the_parameters_of_the_scene_are_used() -> None:
    """The same number of steps of wind lasts twice as long with steps twice as long."""
    model = sensor_scenes.demo()
    seconds = []
    for dt in (0.01, 0.02):
        physics = PhysicsParameters(dt=dt)
        records = [SceneRandomizer(1.0).snapshot(model, np.random.default_rng(seed), physics) for seed in (1, 2)]
        seconds.append([record[2]["wind"]["seconds"] for record in records if record and "wind" in record[2]])
    assert seconds[0]
    assert seconds[1] == [2.0 * duration for duration in seconds[0]]


def test_other_images_are_not_randomised() -> None:
    assert SceneRandomizer(0.0).snapshot(sensor_scenes.demo(), np.random.default_rng(1)) is None
    snapshots = [SceneRandomizer(0.3).snapshot(sensor_scenes.empty(), _Fixed(value)) is None for value in (0.31, 0.9)]
    assert snapshots == [True, True]


class _Fixed(np.random.Generator):
    """A generator that always returns one number."""

    def __init__(self, value: float) -> None:
        super().__init__(np.random.PCG64(0))
        self.value = value

    def uniform(self, *_: float, **__: float) -> float:
        return self.value
