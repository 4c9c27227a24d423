"""Sway in the wind of trees that are not simulated, against the same trees simulated."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.physics.test_wind import leafy
from tests.support.contact_scenes import bar
from tests.support.long_rows import long
from vinesim.core import frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spec import load_scene
from vinesim.scene.state import State
from vinesim.scene.values import WindState
from vinesim.scene.wind import Wind
from vinesim.wind import sway
from vinesim.wind.shelter import ATTENUATION, TreeDrag, height_profile
from vinesim.wind.sway import Sway, windblown
from vinesim.world import Physics


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path))


def simulated(model: Model, wind: Wind, steps: int, every: int = 1) -> np.ndarray:
    """Positions [n, body, 3] of trees that are all awake in the wind, in each ``every``-th of ``steps`` steps."""
    physics = Physics(model, parameters=PhysicsParameters(sleep=False))
    physics.wind = wind
    physics.plants.wake(np.arange(len(model.tree_first)))
    path = []
    for step in range(1, steps + 1):
        physics.step()
        if step % every == 0:
            path.append(physics.snapshot().body_q[:, :3].astype(float))
    return np.array(path)


def drawn(model: Model, wind: Wind, times: np.ndarray) -> np.ndarray:
    """Positions [n, body, 3] of the same trees asleep, as they are drawn."""
    view = windblown(model, Physics(model).snapshot(), wind, 0.0)
    eyes = Sway(model)
    view = dataclasses.replace(view, body_q=State.at_rest(model).body_q)
    assert view.wind is not None
    at = [dataclasses.replace(view, wind=dataclasses.replace(view.wind, time=time)) for time in times]
    return np.array([eyes.apply(one).body_q[:, :3].astype(float) for one in at])


def tips(model: Model, size: np.ndarray) -> np.ndarray:
    """The body of each tree [tree] that has the largest of some sizes [body]."""
    return np.array(
        [f + int(np.argmax(size[f : f + n])) for f, n in zip(model.tree_first, model.tree_size, strict=True)]
    )


def rest(model: Model) -> np.ndarray:
    return State.at_rest(model).body_q[:, :3].astype(float)


# ---- the air at the trees


def test_wind_falls_off_below_the_top_of_the_canopy_and_grows_above() -> None:
    assert height_profile(np.array([2.0]), 2.0) == pytest.approx(1.0)
    assert height_profile(np.array([1.0]), 2.0) == pytest.approx(np.exp(-0.5 * ATTENUATION))
    heights = np.linspace(0.0, 20.0, 200)
    assert (np.diff(height_profile(heights, 2.0)) > 0.0).all()
    double = height_profile(np.array([4.0, 8.0, 16.0]), 2.0)  # straight over the logarithm of the height, far up
    assert np.diff(double)[1] == pytest.approx(np.diff(double)[0], rel=0.25)


def test_trees_upwind_shelter_those_behind_them() -> None:
    model = leafy(20)  # along y, a metre apart
    drag = TreeDrag.of(model, State.at_rest(model).body_q)
    along, against, across = (drag.air_share(np.array(w)) for w in ([0.0, 3.0, 0.0], [0.0, -3.0, 0.0], [3.0, 0.0, 0.0]))
    assert (np.diff(along) < 0.0).all()
    np.testing.assert_allclose(against, along[::-1], rtol=1e-6)
    np.testing.assert_allclose(across, across[0])  # side by side none shelters another
    assert along[0] == pytest.approx(across[0])
    assert 0.2 < along[-1] / along[0] < 0.95
    np.testing.assert_array_equal(drag.air_share(np.zeros(3)), drag.profile)


# ---- against the simulation


@pytest.mark.parametrize("speed", [3.0, *long(1.0, 6.0)])
def test_steady_deflection_is_that_of_the_simulated_tree(speed: float) -> None:
    """Canes of three stiffnesses, up to a deflection of half their length."""
    for modulus in (3e8, 1e9, 3e9):
        model = leafy(2, modulus=modulus, damping=0.3)
        wind = Wind([0.6 * speed, 0.8 * speed, 0.0])
        there = simulated(model, wind, 500)[-1] - rest(model)
        seen = drawn(model, wind, np.array([0.0]))[0] - rest(model)
        tip = tips(model, np.linalg.norm(there, axis=1))
        off = np.linalg.norm(seen - there, axis=1)[tip] / np.linalg.norm(there, axis=1)[tip]
        assert off.max() < 0.1, (modulus, off)


def test_steady_deflection_in_a_vineyard() -> None:
    """All shoots of the demo with their leaves, bunches and ties: in the mean of the last two seconds within 10 %."""
    model = generate(load_scene("demo"))
    wind = Wind([2.0, 1.0, 0.0])
    there = simulated(model, wind, 500, every=10)[-20:].mean(0) - rest(model)
    seen = drawn(model, wind, np.array([0.0]))[0] - rest(model)
    tip = tips(model, np.linalg.norm(there, axis=1))
    error = np.linalg.norm(seen - there, axis=1)[tip]
    size = np.linalg.norm(there, axis=1)[tip]
    assert (error < 0.1 * size + 5e-4).all()
    assert np.percentile(error / size, 90) < 0.1


def test_gusts_move_a_drawn_tree_as_far_and_when_they_move_a_simulated_one() -> None:
    model = leafy(4, modulus=1e9, damping=0.03)
    wind = Wind([3.0, 1.0, 0.0], gusts=1.0, scale=2.0, seed=4)
    every = 5
    there = simulated(model, wind, 2400, every)[40:]
    seen = drawn(model, wind, 0.01 * every * np.arange(41, 2400 // every + 1))
    for tip in tips(model, np.linalg.norm(there.mean(0) - rest(model), axis=1)):
        a, b = (path[:, tip] - path[:, tip].mean(0) for path in (there, seen))
        assert 0.8 < np.sqrt((b**2).mean() / (a**2).mean()) < 1.25
        assert (a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum()) > 0.8


# ---- what is drawn


def test_what_is_drawn_depends_on_the_time_alone() -> None:
    """Two who have looked at other times and from elsewhere see the same to the bit."""
    model = leafy(5)
    wind = Wind([3.0, 0.0, 0.0], gusts=1.0)
    physics = Physics(model)
    first = Sway(model)
    second = Sway(model)
    blown = windblown(model, physics.snapshot(), wind, 0.0).wind
    assert blown is not None

    def at(time: float):
        return dataclasses.replace(physics.snapshot(), wind=dataclasses.replace(blown, time=time))

    for time in (1.0, 2.5):
        first.apply(at(time))
    second.apply(at(7.0), eye=np.array([3.0, 2.0, 1.0]))
    both = [one.apply(at(9.0)).body_q.tobytes() for one in (first, second)]
    assert both[0] == both[1]
    assert both[0] != first.apply(at(9.1)).body_q.tobytes()


def test_calm_air_changes_nothing() -> None:
    physics = Physics(leafy(2))
    snapshot = physics.snapshot()
    assert Sway(physics.model).apply(snapshot) is snapshot


def test_the_drawn_bodies_of_a_tree_stay_joined() -> None:
    model = leafy(2, modulus=3e8)
    body_q = windblown(model, Physics(model).snapshot(), Wind([6.0, 0.0, 0.0]), 0.0).body_q
    reach = np.linalg.norm(np.diff(body_q[:8, :3], axis=0), axis=1)
    np.testing.assert_allclose(reach, 0.5 / 8, rtol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(body_q[:, 3:], axis=1), 1.0, rtol=1e-5)


def test_nothing_jumps_when_trees_wake_fall_asleep_and_when_wind_begins_or_ends() -> None:
    """A robot comes and goes in gusts that begin and end: no drawn point moves by a millimetre more in a step than in
    the one before."""
    model = leafy(6, modulus=1e9, damping=0.05)
    physics = Physics(model)
    eyes = Sway(model)
    physics.add_robot(bar((30.0, 0.0, 0.2)))
    wind = Wind([2.0, 0.5, 0.0], gusts=0.4)
    path = []
    awake = []
    for step in range(2600):
        if step == 50:
            physics.wind = wind
        if step == 500:
            physics.add_robot(bar((1.0, 1.0, 0.2), name="near"))
        if step == 1200:
            physics.remove_robot("near")
        if step == 2000:
            physics.wind = None
        physics.step()
        path.append(eyes.apply(physics.snapshot()).body_q[:, :3].copy())
        awake.append(len(physics.plants.awake))
    assert max(awake[:500]) == 0
    assert max(awake[500:1200]) > 2
    moved = np.linalg.norm(np.diff(path, n=2, axis=0), axis=2).max(1)
    assert moved.max() < 1e-3, int(np.argmax(moved))
    assert np.linalg.norm(path[480] - path[49], axis=1).max() > 0.01
    np.testing.assert_allclose(path[-1], path[0], atol=2e-3)


def test_of_many_trees_those_are_drawn_whose_picture_is_most_out_of_date(monkeypatch) -> None:
    monkeypatch.setattr(sway, "MAX_TREES", 10)
    model = leafy(60)
    wind = Wind([3.0, 0.0, 0.0], gusts=1.0)
    physics = Physics(model)
    eyes = Sway(model)
    blown = windblown(model, physics.snapshot(), wind, 0.0).wind
    assert blown is not None
    times = np.zeros(60, int)
    for step in range(60):
        view = dataclasses.replace(physics.snapshot(), wind=dataclasses.replace(blown, time=0.1 * step))
        posed = eyes.apply(view, eye=np.zeros(3)).moved_trees
        assert len(posed) <= 10
        times[posed] += 1
    assert times.min() >= 2  # none is forgotten
    assert times[1] > 2 * times[-1]  # the near ones move more in the picture


def test_a_stump_sways_with_the_cane_that_it_is_on():
    """In the wind's drawn pose, a stump stays at the tip of its parent, and what was cut off does not sway."""
    model = generate(load_scene("vsp"))
    wind = Wind([3.0, 2.0, 0.0])
    physics = Physics(model)
    rest = physics.snapshot()
    sways = np.linalg.norm(windblown(model, rest, wind, 3.0).body_q[:, :3] - rest.body_q[:, :3], axis=1)
    number = np.arange(len(model.body_mass)) - model.tree_first[model.body_tree]
    segment = 1 + int(np.argmax(sways * ((number > 4) & (number < 12))))
    physics.cut(segment, 0.03)
    physics.step()
    snapshot = physics.snapshot()
    stump, parent = int(snapshot.stumps[0, 0]), segment - 1
    trees = len(model.tree_first)
    state = WindState(wind, 3.0, 1.0, np.zeros((trees, 3), np.float32), np.ones(trees, np.float32))
    drawn = Sway(model).apply(dataclasses.replace(snapshot, wind=state)).body_q.astype(float)
    tip = drawn[parent, :3] + frames.rotate(drawn[parent, 3:], model.body_offset[segment].astype(float))
    assert np.linalg.norm(drawn[parent, :3] - snapshot.body_q[parent, :3]) > 1e-3, "the parent sways"
    assert np.linalg.norm(drawn[stump, :3] - tip) < 1e-5
    np.testing.assert_allclose(drawn[segment, :3], snapshot.body_q[segment, :3], atol=1e-6)
