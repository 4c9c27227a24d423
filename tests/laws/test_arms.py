"""Arms of a cordon twist: statics, reciprocity, modes, energy of its shoots; whom a push wakes, where all rest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.support.long_rows import each_once
from vinesim.api.energy import energy
from vinesim.core import frames
from vinesim.scene.builder import TreeBuilder, assemble, solve_rest_pose
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.world import Physics

pytestmark = pytest.mark.slow

SHOOT = 0.5
MASS = 0.05
"""A shoot here: a rod [m] of a mass [kg] that stands on a joint with a spring; far up a tie holds it to a post."""
STIFFNESS = np.array([15.0, 20.0, 20.0])
"""[N m/rad] of that spring, about the shoot and across."""
TIE = 20.0
"""[N/m] across, at the tip."""
LENGTH = 1.0
RADIUS = (0.016, 0.008)
MODULUS = 1e9
"""[m], [m] at the trunk and at the end, [Pa]: of the arm, which lies along x."""
ALONG = (0.2, 0.5, 0.55, 0.9)
"""[m] where four shoots stand on it."""


def cordon(
    along: tuple[float, ...] = ALONG,
    *,
    modulus: float = MODULUS,
    beta: float = 0.02,
    lean: float = 0.0,
    tie: float = TIE,
    weight: bool = False,
    others: int = 0,
) -> Model:
    """Shoots that ``lean`` [rad] along the arm; ``others`` stand on another arm beside it. ``weight``: in equilibrium
    with it as drawn."""
    trees = []
    places = [(x, 0.0) for x in along] + [(x, 0.3) for x in np.linspace(0.2, 0.8, others)]
    for x, y in places:
        tree = TreeBuilder(
            frames.pose(np.array([x, y, 1.0]), frames.from_x_axis([np.sin(lean), 0.0, np.cos(lean)], [0.6, 0.8, 0.0]))
        )
        tree.add_body(
            -1,
            mass=MASS,
            com=(SHOOT / 2, 0, 0),
            length=SHOOT,
            radius=(0.004, 0.004),
            inertia=np.full(3, MASS * SHOOT**2 / 12),
            stiffness=STIFFNESS,
            damping=beta * STIFFNESS,
        )
        trees.append(tree)
    count = len(trees)
    edges = np.linspace(0.0, LENGTH, 4)
    radius = RADIUS[0] + (RADIUS[1] - RADIUS[0]) * edges / LENGTH
    piece = [np.searchsorted(edges, x, side="right") - 1 + (3 if y else 0) for x, y in places]
    tip = [tree.pose[:3] + SHOOT * np.array([np.sin(lean), 0.0, np.cos(lean)]) for tree in trees]
    model = assemble(
        trees,
        tree_piece=piece,
        tie_body=np.arange(count),
        tie_point=np.tile([SHOOT, 0.0, 0.0], (count, 1)),
        tie_anchor=tip,
        tie_stiffness=np.full(count, tie),
        tie_damping=np.full(count, 0.5 * beta * tie),
        fixed_start=[[x, y, 1.0] for y in (0.0, 0.3) for x in edges[:-1]],
        fixed_end=[[x, y, 1.0] for y in (0.0, 0.3) for x in edges[1:]],
        fixed_radius=np.tile(np.stack([radius[:-1], radius[1:]], -1), (2, 1)),
        fixed_organ=[int(Organ.ARM)] * 6,
        fixed_index=np.repeat([0, 1], 3),
        fixed_shear_modulus=[modulus] * 6,
    )
    return solve_rest_pose(model) if weight else model


def world(model: Model, **parameters: Any) -> Physics:
    physics = Physics(model, parameters=PhysicsParameters(**{"gravity": 0.0, "sleep": False} | parameters))
    if not physics.parameters.sleep:
        physics.plants.wake(np.arange(len(model.tree_first)))
    return physics


def push(physics: Physics, shoot: int, force: np.ndarray) -> None:
    """Push the tip of a shoot with ``force`` [3] N from now on, as it lay at the start."""
    tip = physics.model.tie_anchor[shoot] - physics.model.tree_pose[shoot, :3]
    physics.plants.body_load[shoot] = [*force, *np.cross(tip, force)]


def tips(physics: Physics) -> np.ndarray:
    """Displacement of the tips from the start [shoot, 3] m."""
    physics.update_kinematics()
    pose = physics.state.body_q.astype(float)
    return pose[:, :3] + frames.rotate(pose[:, 3:], np.array([SHOOT, 0.0, 0.0])) - physics.model.tie_anchor


def compliance(along: tuple[float, ...], modulus: float = MODULUS) -> np.ndarray:
    """Twist of a tapered arm by unit moments on it [node, node] rad/(N m), by quadrature."""
    x = (np.arange(200_000) + 0.5) * LENGTH / 200_000
    radius = RADIUS[0] + (RADIUS[1] - RADIUS[0]) * x / LENGTH
    passed = np.cumsum(2.0 / (np.pi * modulus * radius**4)) * LENGTH / 200_000
    return np.interp(np.minimum.outer(along, along), x, passed)


def whole_stiffness(along: tuple[float, ...] = ALONG, modulus: float = MODULUS, tie: float = TIE) -> np.ndarray:
    """[node, node] N m/rad of joints and arm in series, beside ties, for upright shoots that turn across the arm."""
    series = np.linalg.inv(compliance(along, modulus) + np.eye(len(along)) / STIFFNESS[1])
    return series + tie * SHOOT**2 * np.eye(len(along))


def settle(physics: Physics, steps: int = 500) -> None:
    for _ in range(steps):
        physics.step()


def test_shoots_of_one_arm_move_each_other_as_a_dense_solve_says() -> None:
    """Tips by the inverse of joints, arm and ties [4, 4]; the arm by what joints bear. Along it nothing gives."""
    moved = np.zeros((4, 4))
    for shoot in range(4):
        physics = world(cordon())
        push(physics, shoot, np.array([0.0, 0.4, 0.0]))
        settle(physics)
        moved[shoot] = tips(physics)[:, 1] / 0.4
        borne = STIFFNESS[1] * (tips(physics)[:, 1] / SHOOT + physics.elastic_supports.deflection[:, 0])
        np.testing.assert_allclose(-physics.elastic_supports.deflection[:, 0], compliance(ALONG) @ borne, rtol=1e-3)
    np.testing.assert_allclose(moved, SHOOT**2 * np.linalg.inv(whole_stiffness()), rtol=2e-3, atol=1e-7)
    np.testing.assert_allclose(moved, moved.T, rtol=2e-3)
    assert moved[1, 2] > 0.1 * moved[1, 1]
    physics = world(cordon())
    push(physics, 1, np.array([0.4, 0.0, 0.0]))
    settle(physics)
    assert abs(physics.elastic_supports.deflection).max() < 1e-7


def test_what_one_leaning_shoot_does_to_another_that_does_to_it() -> None:
    """With springs unlike about different axes, and at angles that weight has bent."""
    moved = np.zeros((2, 2))
    for shoot in range(2):
        physics = world(cordon((0.5, 0.9), lean=0.8, weight=True), gravity=9.81)
        settle(physics, 100)
        assert abs(tips(physics)).max() < 2e-6
        push(physics, shoot, np.array([0.0, 0.2, 0.0]))
        settle(physics)
        moved[shoot] = tips(physics)[:, 1]
    assert moved[0, 1] > 0.05 * moved[0, 0]
    np.testing.assert_allclose(moved, moved.T, rtol=5e-3)


@pytest.mark.parametrize(("modulus", "sign"), each_once([1e8, 1e9, 1e11], [1.0, -1.0]))
def test_modes_of_two_shoots_on_an_arm(modulus: float, sign: float) -> None:
    """In step and opposed two equal shoots swing as joints and arm say, beside what the trapezoidal rule does to any
    oscillator: tan(w dt / 2) = dt/2 sqrt(K / M). M has (dt/2)^2 (k - S) beside the shoots' own."""
    along = (0.9, 0.9006)
    dt = 0.01
    physics = world(cordon(along, modulus=modulus, beta=0.0, tie=0.0), phi=0.5)
    physics.state.joint_qd[:] = frames.rotate(
        frames.conjugate(physics.model.tree_pose[:, 3:].astype(float)), np.array([0.05, 0.0, 0.0])
    ) * np.array([[1.0], [sign]])
    physics.wake(np.arange(2))
    held = np.linalg.eigvalsh(whole_stiffness(along, modulus, 0.0))[0 if sign > 0 else 1]
    inertia = MASS * SHOOT**2 / 3.0 + 0.25 * dt**2 * (STIFFNESS[1] - held)
    frequency = np.arctan(0.5 * dt * np.sqrt(held / inertia)) / (np.pi * dt)
    tip = []
    for _ in range(400):
        physics.step()
        tip.append(float(tips(physics)[0, 1]))
    turns = np.flatnonzero(np.diff(np.sign(tip)) != 0)
    exact = [i - tip[i] / (tip[i + 1] - tip[i]) for i in (turns[0], turns[-1])]
    assert 0.5 * (len(turns) - 1) / (dt * (exact[1] - exact[0])) == pytest.approx(frequency, rel=2e-3)


@pytest.mark.parametrize(("modulus", "phi", "lean"), each_once((1e7, 1e9, 1e11), (0.5, 0.55), (0.0, 0.8)))
def test_shoots_on_an_arm_gain_no_energy(modulus: float, phi: float, lean: float) -> None:
    """Undamped, at 100 Hz, on arms of any stiffness: energy, with that of the mass that the scheme adds (see
    :mod:`vinesim.kernels.wires.elastic_supports`), is kept for phi 1/2 and falls beyond."""
    model = cordon(modulus=modulus, beta=0.0, lean=lean)
    physics = world(model, phi=phi)
    rates = np.random.default_rng(3).normal(size=(4, 3)) * [0.02, 0.2, 0.2]
    physics.state.joint_qd[:] = rates
    physics.wake(np.arange(4))
    axis = frames.rotate(frames.conjugate(model.tree_pose[:, 3:].astype(float)), np.array([1.0, 0.0, 0.0]))
    gradient = STIFFNESS * axis
    stiffness = (gradient * axis).sum(1)
    left_out = (phi * physics.dt) ** 2 * np.linalg.inv(np.linalg.inv(compliance(ALONG, modulus)) + np.diag(stiffness))
    seen = []
    for step in range(1000):
        physics.update_kinematics()
        physics.elastic_supports.update()
        if step % 5 == 0:
            pull = (gradient * physics.state.joint_qd).sum(1)
            seen.append(energy(physics.plants, 0.0).total + 0.5 * pull @ left_out @ pull)
        physics.step()
    if phi == 0.5:
        np.testing.assert_allclose(seen, seen[0], rtol=0.02)
    else:
        assert max(seen) <= 1.001 * seen[0]
        assert seen[-1] < 0.5 * seen[0]


def test_a_push_wakes_those_that_the_arm_moves_and_no_others() -> None:
    """A light push twists the arm by less than a sleeping shoot notices; a strong one wakes its arm, not the next."""
    for force, awake in ((1e-3, [0]), (1.0, [0, 1, 2, 3])):
        physics = world(cordon(others=4), sleep=True)
        before = physics.state.body_q.copy()
        push(physics, 0, np.array([0.0, force, 0.0]))
        physics.wake(np.array([0]))
        woken = set()
        for _ in range(100):
            physics.step()
            woken |= set(physics.plants.awake.tolist())
        assert sorted(woken) == awake
        asleep = np.setdiff1d(np.arange(8), awake)
        np.testing.assert_array_equal(physics.state.body_q[asleep], before[asleep])
        push(physics, 0, np.zeros(3))
        physics.sleep_monitor.wake(np.array([0]))
        settle(physics, 1000)
        assert len(physics.plants.awake) == 0
        assert len(physics.elastic_supports.active) == 0
        assert abs(tips(physics)).max() < 5e-5


def test_shoots_that_twist_an_arm_sleep_where_they_rest() -> None:
    """Under a lasting push they fall asleep within 0.1 mm of where a dense solve has them."""
    physics = world(cordon(), sleep=True)
    push(physics, 1, np.array([0.0, 1.0, 0.0]))
    physics.wake(np.array([1]))
    settle(physics, 1000)
    assert len(physics.plants.awake) == 0
    exact = SHOOT**2 * np.linalg.inv(whole_stiffness())[1]
    np.testing.assert_allclose(tips(physics)[:, 1], exact, atol=1e-4)


def test_a_shoot_that_is_cut_off_lets_its_arm_go() -> None:
    """What is left turns back as a dense solve without the shoot says."""
    physics = world(cordon())
    push(physics, 1, np.array([0.0, 0.4, 0.0]))
    push(physics, 3, np.array([0.0, 0.4, 0.0]))
    settle(physics, 200)
    physics.cut(3)
    settle(physics)
    exact = 0.4 * SHOOT**2 * np.linalg.inv(whole_stiffness(ALONG[:3]))[1]
    np.testing.assert_allclose(tips(physics)[:3, 1], exact, rtol=2e-3)


def test_a_shoot_that_another_client_lays_aside_turns_the_arm_here() -> None:
    physics = world(cordon(), sleep=True)
    turn = frames.rotate(frames.conjugate(physics.model.tree_pose[1, 3:].astype(float)), np.array([-0.02, 0.0, 0.0]))
    physics.apply_remote_rest([1], [frames.exp(turn[None])])
    physics.step()
    assert physics.elastic_supports.deflection[1, 0] < -1e-3
    assert physics.plants.awake.tolist() == [0, 2, 3]
