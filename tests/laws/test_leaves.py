"""Leaves that touch give way by their petioles: force, energy, sleep, cuts and equal bits."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from tests.laws.test_contact_stability import energy
from tests.laws.test_determinism import digest
from tests.support.contact_scenes import cane, probe
from vinesim import Simulation
from vinesim.core import frames
from vinesim.scene import leaves
from vinesim.scene.builder import assemble
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import ParameterError, PhysicsParameters
from vinesim.scene.spare_bodies import with_spares
from vinesim.scene.values import Drive
from vinesim.world import Physics

pytestmark = pytest.mark.slow

SIZE = 0.08
PETIOLE = 0.08
RADIUS = 0.02
REACH = leaves.BLADE_RADIUS * SIZE + RADIUS
"""[m] Distance of a ball of :data:`RADIUS` from the axis of a leaf's capsule at which they begin to touch."""


def leafy(radius: float = 0.02, bodies: tuple[int, ...] = (4,), beta: float = 0.01) -> Model:
    """A level cane of 1 m along x at a height of 2 m. Leaves stand on ``bodies``, 8 cm above it; their midribs are
    level and across the cane.

    A cane of the ``radius`` 2 cm gives way to a leaf by less than a hundredth of what the petiole does.
    """
    tree = cane((0.0, 0.0, 2.0), radius=radius, beta=beta)
    at = np.array([0.03, 0.0, PETIOLE])
    for body in bodies:
        pose = frames.pose(at, frames.from_yaw(0.5 * np.pi))
        tree.leaves.append({"body": body, "base": at * [1.0, 1.0, 0.0], "pose": pose, "size": SIZE})
    return assemble([tree])


def touching(dt: float = 0.01, damping: float = 0.02) -> PhysicsParameters:
    return PhysicsParameters(leaves="touch", dt=dt, contact_damping_time=damping)


def middle(simulation: Simulation) -> np.ndarray:
    """The middle [3] m of the axis of the first leaf's capsule."""
    model = simulation.model
    blade = frames.compose(simulation.body_pose(int(model.leaf_body[0])), model.leaf_pose[0].astype(float))
    return blade[:3] + 0.5 * leaves.BLADE_LENGTH * SIZE * frames.rotate(blade[3:], np.array([1.0, 0.0, 0.0]))


def stiffness() -> float:
    """N/m, of a cantilever with a rigid blade, by the sum of its curvatures M / (E I) times their lever."""
    lever = 0.5 * leaves.BLADE_LENGTH * SIZE
    flexural = PhysicsParameters().petiole_modulus * np.pi * (leaves.PETIOLE_DIAMETER * SIZE) ** 4 / 64.0
    arm = np.linspace(lever, lever + PETIOLE, 2001)
    return float(1.0 / np.trapezoid(arm * arm / flexural, arm))


def test_a_leaf_gives_way_as_its_petiole_bends() -> None:
    """A ball that is held in a leaf feels the overlap times the stiffness of the petiole, within 2 %."""
    for depth in (0.01, 0.03, 0.05):
        simulation = Simulation(leafy(), parameters=touching())
        at = middle(simulation) + np.array([0.0, 0.0, REACH - depth])
        simulation.add_pusher(size=(RADIUS,), position=at, mass=5.0, force=500.0)
        simulation.step(100)
        (contact,) = simulation.contacts
        assert contact.force[2] == pytest.approx(stiffness() * depth, rel=0.02)
        assert contact.body == 4


def test_a_hand_passes_through_a_leaf_which_springs_back() -> None:
    """The largest force is k (r + R) within 5 %, against the hand at first and with it later. In all the hand does as
    much work as the damping of the contact takes, a small share of what bends the petiole."""
    simulation = Simulation(leafy(), parameters=touching())
    speed = 0.05
    start = middle(simulation) - np.array([REACH + 0.01, 0.0, 0.0])
    ball = simulation.add_pusher(size=(RADIUS,), position=start, mass=5.0, force=500.0)
    ball.follow(start + np.array([2.0 * REACH + 0.02, 0.0, 0.0]), speed=speed)
    force = []
    for _ in range(round((2.0 * REACH + 0.02) / speed / 0.01) + 50):
        simulation.step()
        force.append(-float(sum(contact.force[0] for contact in simulation.contacts)))
    assert max(force) == pytest.approx(stiffness() * REACH, rel=0.05)
    assert min(force) == pytest.approx(-stiffness() * REACH, rel=0.1)
    work = float(np.sum(force)) * speed * 0.01
    assert 0.0 < work < 0.15 * 0.5 * stiffness() * REACH**2
    assert len(simulation.contacts) == 0


@pytest.mark.parametrize("dt", [0.01, 0.001])
@pytest.mark.parametrize("speed", [0.02, 0.1, 0.5])
def test_leaves_add_no_energy(speed: float, dt: float) -> None:
    """A rod coasts into three leaves of a thin cane, without damping: rod and plant never have more energy than before.
    At 2 cm/s the first leaf throws it back."""
    model = leafy(0.004, (4, 7, 10), 0.0)
    physics = Physics(model, parameters=touching(dt, 0.0))
    height = float(model.forward_kinematics(model.joint_settled)[4, 2]) + PETIOLE
    drives = (Drive("along", 0.0, 0.0, 1000.0, 5.0, -5.0, 5.0), Drive("press", 5000.0, 300.0, 1000.0, 5.0, -5.0, 5.0))
    physics.add_robot(probe((0.2, 0.0, height), drives=drives))
    dof = physics.rigid.robot("probe").v
    physics.rigid.mj_data.qvel[dof] = [speed, 0.0]
    start = energy(physics) + 2.0 * speed**2
    gain, touched = -np.inf, set()
    for _ in range(round(0.45 / speed / dt)):
        physics.step()
        moving = physics.rigid.mj_data.qvel[dof]
        gain = max(gain, energy(physics) + 2.0 * float(moving[0]) ** 2 - start)
        touched |= {contact.body for contact in physics.contacts}
    assert len(touched) == (1 if speed == 0.02 else 3)
    assert (physics.rigid.mj_data.qvel[dof][0] < 0.0) == (speed == 0.02)
    assert gain < 1e-6


def test_a_hand_of_many_geoms_bends_a_petiole_once() -> None:
    """Of two balls that overlap the same leaf, the deeper one pushes it aside."""
    simulation = Simulation(leafy(), parameters=touching())
    at = middle(simulation) + np.array([0.0, 0.0, REACH])
    for name, depth in (("shallow", 0.02), ("deep", 0.04)):
        beside = np.array([0.0, 0.025 if name == "deep" else -0.025, -depth])
        simulation.add_pusher(size=(RADIUS,), position=at + beside, mass=5.0, force=500.0, name=name)
    simulation.step(100)
    (contact,) = [contact for contact in simulation.contacts if contact.body == 4]
    assert contact.actor == "deep"
    assert contact.force[2] == pytest.approx(stiffness() * 0.04, rel=0.02)


def test_only_a_near_leaf_wakes_its_vine() -> None:
    """A vine sleeps until a hand is at one of its leaves, which are outside the box around its wood. With leaves that
    are only seen it sleeps on."""
    for kind, distance, wakes in (("touch", REACH + 0.02, False), ("touch", REACH, True), ("ghost", REACH, False)):
        simulation = Simulation(leafy(), parameters=PhysicsParameters(leaves=kind))
        at = middle(simulation) + np.array([0.0, 0.0, distance])
        simulation.add_pusher(size=(RADIUS,), position=at, mass=5.0, force=500.0)
        simulation.step(20)
        assert (len(simulation.awake) > 0) == wakes, (kind, distance)


def test_leaves_stay_on_the_part_of_a_cane_on_which_they_grow() -> None:
    """A leaf below a cut in its segment stays on the stump, one above it falls."""
    model = with_spares(leafy(0.004, (4, 4)))
    model.leaf_base[1, 0] = 0.05
    physics = Physics(model, parameters=touching())
    shapes = physics.contact_solver.capsules
    segment = int(model.leaf_body[0])
    physics.cut(segment, 0.04)
    parts = physics.plants.stumps.parts_of(segment)
    assert len(parts) == 2
    np.testing.assert_array_equal(shapes.body[shapes.tree_start[-1] :], [parts[0][0], segment])


def test_two_runs_are_equal_to_the_bit() -> None:
    hashes = []
    for _ in range(2):
        physics = Physics(leafy(0.004, (4, 7, 10)), parameters=touching())
        drives = tuple(Drive(name, 5000.0, 300.0, 1e3, 5.0, -5.0, 5.0) for name in ("along", "press"))
        physics.add_robot(probe((0.2, 0.0, 2.07), drives=drives))
        h = hashlib.blake2b(digest_size=16)
        count = 0
        for step in range(200):
            physics.rigid.command("probe", np.array([0.003 * step, 0.0]))
            physics.step()
            count += len(physics.contacts)
            digest(physics, h)
        assert count > 50
        hashes.append(h.hexdigest())
    assert hashes[0] == hashes[1]


def test_an_unknown_kind_of_leaves_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"physics.leaves is 'solid'; give 'ghost' or 'touch'"):
        PhysicsParameters(leaves="solid")
