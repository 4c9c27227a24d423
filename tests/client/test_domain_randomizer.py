"""Random scenes of a data set: actors, free places, and that all follows from the random numbers."""

from __future__ import annotations

import numpy as np

from tests.support import sensor_scenes
from vinesim.client.composition.domain_randomizer import FOOTPRINT_RADIUS, SceneRandomizer, random_composition
from vinesim.scene.ids import Organ
from vinesim.scene.state import State


def test_everybody_has_room() -> None:
    """Discs of all that comes overlap neither trunks nor poles nor each other."""
    model = sensor_scenes.demo()
    wood = np.isin(model.fixed_organ, [Organ.POLE, Organ.TRUNK])
    for seed in range(60):
        stage = random_composition(model, np.array([2.5, 1.2]), np.random.default_rng(seed))
        discs = [((one.x, one.y), FOOTPRINT_RADIUS[one.robot]) for one in stage.robots]
        discs += [((one.x, one.y), FOOTPRINT_RADIUS["person"]) for one in stage.people]
        discs += [((one.x, one.y), FOOTPRINT_RADIUS["crate"]) for one in stage.crates]
        for k, (spot, reach) in enumerate(discs):
            assert np.hypot(*(model.fixed_start[wood, :2] - spot).T).min() > reach
            assert all(np.hypot(*np.subtract(spot, other)) > reach + far for other, far in discs[:k])


def test_the_same_numbers_give_the_same_life_and_others_another() -> None:
    model, seen = sensor_scenes.demo(), []
    for seed in (1, 1, 2):
        happens = SceneRandomizer(1.0).snapshot(model, np.random.default_rng(seed))
        assert happens is not None
        view, near, record = happens
        seen.append((view.visual_q.tobytes(), view.body_q.tobytes(), near.tobytes(), str(record)))
    assert seen[0] == seen[1] != seen[2]


def test_wind_sways_the_plants() -> None:
    """Some leaves have moved by centimetres when wind blows, and nothing has when it does not."""
    model = sensor_scenes.demo()
    rest, moved = State.at_rest(model).body_q[:, :3], {True: [], False: []}
    for seed in range(8):
        happens = SceneRandomizer(1.0).snapshot(model, np.random.default_rng(seed))
        assert happens is not None
        view, _, record = happens
        hanging = np.ones(len(rest), bool)
        hanging[model.bunch_of_body() >= 0] = False
        moved["wind" in record].append(np.linalg.norm(view.body_q[:, :3] - rest, axis=1)[hanging].max())
    assert max(moved[False]) < 0.02
    assert max(moved[True]) > 0.02


def test_nothing_happens_in_the_other_images() -> None:
    assert SceneRandomizer(0.0).snapshot(sensor_scenes.demo(), np.random.default_rng(1)) is None
    lively = [SceneRandomizer(0.3).snapshot(sensor_scenes.empty(), _Fixed(share)) is None for share in (0.31, 0.9)]
    assert lively == [True, True]


class _Fixed(np.random.Generator):
    """Says one number for ever."""

    def __init__(self, value: float) -> None:
        super().__init__(np.random.PCG64(0))
        self.value = value

    def uniform(self, *_: float, **__: float) -> float:
        return self.value
