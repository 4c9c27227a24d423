"""Wires give: string law, reciprocity, modes, energy of shoots on one wire; whom a push wakes, and where all rest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.support.long_rows import each_once
from vinesim.api.energy import energy
from vinesim.core import frames
from vinesim.scene.builder import TreeBuilder, assemble
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spec import load_scene
from vinesim.world import Physics

pytestmark = pytest.mark.slow

ARM = 0.5
MASS = 0.05
SPRING = 4.0
"""A shoot here: a rod [m] of a mass [kg] that leans on a joint [N m/rad]; its tip is tied to the wire."""
LENGTH = 2.0
TENSION = 900.0
"""[m], [N] of the wire."""
ALONG = (0.3, 0.7, 0.85, 1.6)
"""[m] where four shoots are tied to it."""
INERTIA = MASS * ARM**2 / 3.0


def row_of_shoots(
    along: tuple[float, ...] = ALONG,
    *,
    tie: float = 2000.0,
    tension: float = TENSION,
    beta: float = 0.02,
    spring: float = SPRING,
    others: int = 0,
    beyond: float = 0.1,
) -> Model:
    """Level rods along y whose tips are tied to a wire along x; ``others`` are tied to another wire behind it.

    The geoms of both wires are ``beyond`` [m] the tips, out of reach; the ties are what this is about.
    """
    trees = []
    for x in (*along, *np.linspace(0.2, 1.8, others)):
        tree = TreeBuilder(frames.pose(np.array([x, 0.0, 1.0]), frames.from_yaw(np.pi / 2)))
        tree.add_body(
            -1,
            mass=MASS,
            com=(ARM / 2, 0, 0),
            length=ARM,
            radius=(0.004, 0.004),
            inertia=np.full(3, MASS * ARM**2 / 12),
            stiffness=np.full(3, spring),
            damping=np.full(3, beta * spring),
        )
        trees.append(tree)
    count = len(trees)
    there = ARM + beyond
    return assemble(
        trees,
        tie_body=np.arange(count),
        tie_point=np.tile([ARM, 0.0, 0.0], (count, 1)),
        tie_anchor=[[tree.pose[0], tree.pose[1] + ARM, 1.0] for tree in trees],
        tie_stiffness=np.full(count, tie),
        tie_damping=np.full(count, 0.5 * beta * tie),
        tie_wire=np.repeat([0, 1], [len(along), others]),
        fixed_start=[[0.0, there, 1.0], [0.0, there + 0.5, 1.0]],
        fixed_end=[[LENGTH, there, 1.0], [LENGTH, there + 0.5, 1.0]],
        fixed_radius=np.full((2, 2), 0.0014),
        fixed_organ=[int(Organ.WIRE)] * 2,
        fixed_index=[0, 1],
        fixed_tension=[tension] * 2,
    )


def world(model: Model, **parameters: Any) -> Physics:
    physics = Physics(model, parameters=PhysicsParameters(**{"gravity": 0.0, "sleep": False} | parameters))
    if not physics.parameters.sleep:
        physics.plants.wake(np.arange(len(model.tree_first)))
    return physics


def set_turning(physics: Physics, rates: list[float]) -> None:
    """Let the shoots turn up or down [rad/s]."""
    physics.state.joint_qd[:, 1] = rates
    physics.wake(np.arange(len(rates)))


def push(physics: Physics, shoot: int, force: np.ndarray) -> None:
    """Push the tip of a shoot with ``force`` [3] N from now on, as it lay at the start."""
    physics.plants.body_load[shoot] = [*force, *np.cross([0.0, ARM, 0.0], force)]


def tips(physics: Physics) -> np.ndarray:
    """Displacement of the tips from the start [shoot, 3] m."""
    physics.update_kinematics()
    pose = physics.state.body_q.astype(float)
    return pose[:, :3] + frames.rotate(pose[:, 3:], np.array([ARM, 0.0, 0.0])) - physics.model.tie_anchor


def compliance(along: tuple[float, ...], tension: float = TENSION) -> np.ndarray:
    """Deflections of a string by unit forces across it [node, node] m/N: a (L - b) / (T L), a <= b."""
    a = np.minimum.outer(along, along)
    b = np.maximum.outer(along, along)
    return a * (LENGTH - b) / (tension * LENGTH)


def stiffness_of_ties(along: tuple[float, ...], tie: float = 2000.0, tension: float = TENSION) -> np.ndarray:
    """[node, node] N/m of ties and wire in series."""
    return np.linalg.inv(compliance(along, tension) + np.eye(len(along)) / tie)


@pytest.mark.parametrize("at", [0.001, 0.3, 1.0, 1.7])
def test_a_wire_gives_by_the_string_law(at: float) -> None:
    """A push of 2 N: the wire moves by F a b / (T L), F being what the tie bears."""
    physics = world(row_of_shoots((at,)))
    push(physics, 0, np.array([0.0, 0.0, 2.0]))
    for _ in range(500):
        physics.step()
    tip = tips(physics)[0]
    deflection = physics.elastic_supports.deflection[0]
    held = 2000.0 * (tip[2] - deflection[2])
    assert deflection[2] == pytest.approx(held * at * (LENGTH - at) / (TENSION * LENGTH), rel=1e-4)
    assert held + SPRING / ARM**2 * tip[2] == pytest.approx(2.0, rel=2e-3)


def test_shoots_of_one_wire_move_each_other_as_a_dense_solve_says() -> None:
    """Tips by the inverse of joints, ties and wire [4, 4]; what i does to j, j does to i. Not along the wire."""
    whole = np.linalg.inv(stiffness_of_ties(ALONG) + np.eye(4) * SPRING / ARM**2)
    moved = np.zeros((4, 4))
    for shoot in range(4):
        physics = world(row_of_shoots())
        push(physics, shoot, np.array([0.0, 0.0, 1.5]))
        for _ in range(600):
            physics.step()
        moved[shoot] = tips(physics)[:, 2] / 1.5
    np.testing.assert_allclose(moved, whole, rtol=2e-3, atol=1e-7)
    np.testing.assert_allclose(moved, moved.T, rtol=2e-3)
    assert moved[1, 2] > 0.3 * moved[1, 1]
    physics = world(row_of_shoots())
    push(physics, 1, np.array([1.5, 0.0, 0.0]))
    for _ in range(600):
        physics.step()
    assert abs(physics.elastic_supports.deflection).max() < 1e-6
    assert tips(physics)[1, 0] == pytest.approx(1.5 / (2000.0 + SPRING / ARM**2), rel=2e-3)


@pytest.mark.parametrize(
    ("springs", "sign"), each_once([(2000.0, 900.0), (10_000.0, 100.0), (500.0, 1e5)], [1.0, -1.0])
)
def test_modes_of_two_shoots_on_a_wire(springs: tuple[float, float], sign: float) -> None:
    """In step and against each other two equal shoots swing as joint, ties and wire say, beside what the trapezoidal
    rule does to any oscillator: tan(w dt / 2) = dt/2 sqrt(K / M). M has (dt/2)^2 (k - S) beside the shoots' own."""
    along = (0.8, 1.2)
    dt = 0.01
    tie, tension = springs
    physics = world(row_of_shoots(along, tie=tie, tension=tension, beta=0.0), phi=0.5)
    set_turning(physics, [-0.05, -0.05 * sign])
    series = stiffness_of_ties(along, tie, tension)
    held = series[0, 0] + sign * series[0, 1]
    mass = INERTIA / ARM**2 + 0.25 * dt**2 * (tie - held)
    frequency = np.arctan(0.5 * dt * np.sqrt((held + SPRING / ARM**2) / mass)) / (np.pi * dt)
    angle = []
    for _ in range(600):
        physics.step()
        angle.append(float(physics.state.joint_q[0, 1]))
    turns = np.flatnonzero(np.diff(np.sign(angle)) != 0)
    exact = [i - angle[i] / (angle[i + 1] - angle[i]) for i in (turns[0], turns[-1])]
    assert 0.5 * (len(turns) - 1) / (dt * (exact[1] - exact[0])) == pytest.approx(frequency, rel=2e-3)


def test_a_slow_mode_is_right_within_two_percent() -> None:
    """At the shipped stiffness of ties, dt and phi, of a shoot that nothing but its tie holds: the rule's own 0.6 % and
    the mass that wires add."""
    model = row_of_shoots((1.0,), beta=0.0, spring=0.1)
    model.body_mass[:] *= 80.0
    model.body_inertia[:] *= 80.0
    physics = world(model)
    frequency = np.sqrt((stiffness_of_ties((1.0,))[0, 0] * ARM**2 + 0.1) / (80.0 * INERTIA)) / (2.0 * np.pi)
    assert 3.0 < frequency < 5.0
    set_turning(physics, [-0.1])
    angle = []
    for _ in range(200):
        physics.step()
        angle.append(float(physics.state.joint_q[0, 1]))
    turns = np.flatnonzero(np.diff(np.sign(angle)) != 0)
    exact = [i - angle[i] / (angle[i + 1] - angle[i]) for i in (turns[0], turns[-1])]
    assert 0.5 * (len(turns) - 1) / (0.01 * (exact[1] - exact[0])) == pytest.approx(frequency, rel=0.02)


@pytest.mark.parametrize(("tie", "tension", "phi"), each_once((2000.0, 5e4), (50.0, 900.0, 1e5), (0.5, 0.55)))
def test_shoots_on_a_wire_gain_no_energy(tie: float, tension: float, phi: float) -> None:
    """Undamped, at 100 Hz, with ties and wires of any stiffness: energy, with that of the mass that the scheme adds
    (see :mod:`vinesim.kernels.wires.elastic_supports`), is kept for phi 1/2 and falls beyond."""
    physics = world(row_of_shoots(tie=tie, tension=tension, beta=0.0), phi=phi)
    set_turning(physics, [0.25, -0.15, 0.05, 0.2])
    added = (phi * physics.dt) ** 2 * (tie * np.eye(4) - stiffness_of_ties(ALONG, tie, tension))
    seen = []
    for step in range(1000):
        physics.update_kinematics()
        physics.elastic_supports.update()
        if step % 5 == 0:
            tip = ARM * physics.state.joint_qd[:, 1].astype(float)
            seen.append(energy(physics.plants, 0.0).total + 0.5 * tip @ added @ tip)
        physics.step()
    if phi == 0.5:
        # 50 kN/m: a unit in the last place of a position is a thousandth of the stretch, and so walks the energy
        np.testing.assert_allclose(seen, seen[0], rtol=0.05 if tie > 1e4 else 0.02)
    else:
        assert max(seen) <= 1.001 * seen[0]
        assert seen[-1] < 0.5 * seen[0]


def test_a_push_wakes_those_whose_ties_the_wire_moves_and_no_others() -> None:
    """A light push moves the wire by less than a sleeping shoot notices; a strong one wakes its wire, not the next."""
    for force, awake in ((0.02, [0]), (8.0, [0, 1, 2, 3])):
        physics = world(row_of_shoots(others=4), sleep=True)
        before = physics.state.body_q.copy()
        push(physics, 0, np.array([0.0, 0.0, force]))
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
        for _ in range(1000):
            physics.step()
        assert len(physics.plants.awake) == 0
        assert len(physics.elastic_supports.active) == 0
        assert abs(tips(physics)).max() < 5e-5


def test_shoots_that_hold_a_loaded_wire_sleep_where_they_rest() -> None:
    """Under a lasting push the shoots of a wire fall asleep within 0.1 mm of where a dense solve has them."""
    physics = world(row_of_shoots(), sleep=True)
    push(physics, 1, np.array([0.0, 0.0, 8.0]))
    physics.wake(np.array([1]))
    for _ in range(1000):
        physics.step()
    assert len(physics.plants.awake) == 0
    exact = np.linalg.inv(stiffness_of_ties(ALONG) + np.eye(4) * SPRING / ARM**2)[1] * 8.0
    np.testing.assert_allclose(tips(physics)[:, 2], exact, atol=1e-4)


def test_a_shoot_that_another_client_lays_aside_moves_the_wire_here() -> None:
    physics = world(row_of_shoots(), sleep=True)
    physics.apply_remote_rest([1], [frames.exp(np.array([[0.0, -0.02, 0.0]]))])
    physics.step()
    assert physics.elastic_supports.deflection[1, 2] > 1e-3
    assert physics.plants.awake.tolist() == [0, 2, 3]


def test_a_shoot_does_not_bear_on_the_wire_that_its_tie_is_bound_to() -> None:
    """On the wire below it, pressed down: the tie alone holds it. A shoot that is not tied to the wire bears on it."""
    model = row_of_shoots(beyond=-0.02)
    model.fixed_start[:, 2] = model.fixed_end[:, 2] = [1.0 - 0.0054, 0.5]
    for is_tied in (True, False):
        if not is_tied:
            model.tie_wire[:] = -1
        physics = world(model)
        assert physics.rigid.mj_model.geom("fixed/0").id == 1
        push(physics, 1, np.array([0.0, 0.0, -20.0]))
        for _ in range(100):
            physics.step()
            assert not (physics.contacts and is_tied)
        assert bool(physics.contacts) is not is_tied
        assert bool(tips(physics)[1, 2] < -0.015) is is_tied


@pytest.mark.long
def test_pulled_shoots_of_the_demo_gain_no_energy_at_the_shipped_phi() -> None:
    """Every sixth shoot pulled with 2 N, across or down, and released without damping, wind or contacts: no budget
    holds trees on wires, but over 10 s they never have more than at the start, and calm down."""
    model = generate(load_scene("demo"))
    pulled = np.arange(0, len(model.tree_first), 6)
    bent = Physics(model)
    bent.plants.body_load[model.tree_first[pulled[::2]] + 8, 1] = 2.0
    bent.plants.body_load[model.tree_first[pulled[1::2]] + 8, 2] = -2.0
    bent.wake(pulled)
    for _ in range(500):
        bent.step()
    for values in (model.joint_damping, model.tie_damping, model.body_drag):
        values[:] = 0.0
    physics = world(model, gravity=9.81)
    at_rest = energy(physics.plants, 9.81).total
    physics.state.joint_q[:] = bent.state.joint_q
    physics.wake(np.arange(len(model.tree_first)))
    seen = []
    nothing = (np.zeros(0, np.int32), np.zeros((0, 6), np.float32))
    for step in range(1000):
        physics.plants.forward_kinematics()
        physics.elastic_supports.update()
        if step % 5 == 0:
            seen.append(energy(physics.plants, 9.81).total - at_rest)
        physics.plants.predict()
        physics.plants.integrate(*nothing)
    assert max(seen[1:]) < seen[0]
    assert max(seen[100:]) < 0.1 * seen[0]
    assert physics.plants.tree_rate.max() < 1.0
