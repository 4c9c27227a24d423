"""Wires give to what presses on them: robots, crates, canes, several at a time; the shoots tied to them go along."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from tests.laws.test_over_wires import RADIUS, Crossings, borne, weight, wires
from tests.laws.test_wires import (
    ALONG,
    LENGTH,
    SPRING,
    TENSION,
    compliance,
    row_of_shoots,
    stiffness_of_ties,
    tips,
    world,
)
from tests.laws.test_wires import ARM as SHOOT
from tests.support.contact_scenes import cane, probe
from tests.support.long_rows import each_once, long
from vinesim.api.energy import energy
from vinesim.core import frames
from vinesim.rigid.mujoco_contacts import WIRE_MASS
from vinesim.scene.builder import assemble
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.wires.elastic_supports import WIRE_DAMPING_TIME
from vinesim.world import Physics

pytestmark = pytest.mark.slow

G = 9.81
BEYOND = 0.3
"""[m] from the tips of the shoots to their wire: no robot that presses on it is near them."""
TIE = 2000.0
"""[N/m]"""
THICK = 0.006
"""[m] A wire is as thick for rigid bodies: see ``MIN_STATIC_RADIUS``."""


def level_wires(places: list[tuple[float, float]], tension: float = TENSION, **boxes: object) -> Model:
    """Taut wires of 2 m along y at (x, z) m, and nothing that grows."""
    return assemble([], fixed_tension=[tension] * len(places), **wires(places), **boxes)


def press(
    physics: Physics, x: float, force: float, name: str = "probe", *, below: float = 0.05, z: float = 1.0
) -> None:
    """Let the rod of a robot, which lies ``below`` a wire along x at height ``z`` [m], push up with ``force`` [N]."""
    physics.add_robot(probe((x, SHOOT + BEYOND, z - below), name, mass=0.5))
    physics.rigid.set_gains(name, np.array([5000.0, 0.0]), np.array([300.0, 2.0]), np.array([0.0, force]))


def rod(physics: Physics, name: str = "probe") -> float:
    """Height of the upper side of the rod [m]."""
    return float(physics.rigid.link_pose(name, "rod")[2]) + 0.02


def run(physics: Physics, steps: int) -> Physics:
    for _ in range(steps):
        physics.step()
    return physics


def force_on(physics: Physics, name: str) -> float:
    """[N] upward, of the robot's drive, less what its rod weighs: nothing, since its weight is compensated."""
    return float(physics.rigid.contact_force[physics.rigid.robot(name).v][1])


@pytest.mark.parametrize(("at", "tension"), each_once([0.1, 0.5, 1.0], [200.0, 900.0, 5000.0]))
def test_a_wire_that_a_robot_presses_gives_by_the_string_law(at: float, tension: float) -> None:
    """F a b / (T L) with F = 20 N within 1 %, and the robot feels 20 N; let go, the wire is straight again."""
    physics = world(row_of_shoots((), beyond=BEYOND, tension=tension))
    press(physics, at, 20.0)
    run(physics, 300)
    expected = 20.0 * at * (LENGTH - at) / (tension * LENGTH)
    assert rod(physics) - (1.0 - THICK) == pytest.approx(expected, rel=0.01)
    assert force_on(physics, "probe") == pytest.approx(-20.0, rel=1e-3)
    np.testing.assert_allclose(physics.wires.offset[0], [[0, 0, expected]] * 2, atol=0.01 * expected)
    physics.rigid.set_gains("probe", np.array([5000.0, 0.0]), np.array([300.0, 2.0]), np.array([0.0, -20.0]))
    run(physics, 100)
    assert len(physics.wires.deflected) == 0
    assert np.all(physics.wires.offset == 0.0)


def test_it_swings_as_mass_and_string_say() -> None:
    """A rod of 5 kg presses on the middle with 60 N, then 40: it swings with w^2 = K / m, damped by the wire and, as
    much again, by the step, which takes the wire's spring as it is at its end. Within 7 % of the change."""
    physics = world(row_of_shoots((), beyond=BEYOND))
    physics.add_robot(probe((1.0, SHOOT + BEYOND, 0.95), mass=5.0))
    gains = np.array([5000.0, 0.0]), np.array([300.0, 0.0])
    physics.rigid.set_gains("probe", *gains, np.array([0.0, 60.0]))
    run(physics, 400)
    physics.rigid.set_gains("probe", *gains, np.array([0.0, 40.0]))
    height = []
    for _ in range(40):
        physics.step()
        height.append(rod(physics))
    stiffness = 4.0 * TENSION / LENGTH
    mass = 5.0 + WIRE_MASS
    decay = 0.5 * (WIRE_DAMPING_TIME + physics.dt) * stiffness / mass
    turning = np.sqrt(stiffness / mass - decay**2)
    t = physics.dt * np.arange(1, 41)
    swing = np.exp(-decay * t) * (np.cos(turning * t) + decay / turning * np.sin(turning * t))
    expected = 1.0 - THICK + (40.0 + 20.0 * swing) / stiffness
    np.testing.assert_allclose(height, expected, rtol=0.0, atol=0.07 * 20.0 / stiffness)


@pytest.mark.parametrize("mass", [0.2, 20.0, *long(1.0, 5.0)])
def test_a_crate_rests_on_two_wires(mass: float) -> None:
    """Each of its four edges where it crosses a wire bears a quarter: the mean deflection of both within 1 %, no step
    without force, until it sleeps."""
    y = 0.3
    model = level_wires(
        [(-0.1, 1.0), (0.1, 1.0)],
        box_pose=[[0, y, 1.0 + THICK, 0, 0, 0, 1]],
        box_size=[[0.4, 0.3, 0.2]],
        box_mass=[mass],
    )
    physics = Physics(model)
    forces = []
    for step in range(1500):
        physics.step()
        if step > 300 and physics.rigid.mj_data.tree_asleep[0] < 0:
            forces.append(physics.rigid.contact_force[2])
    assert physics.rigid.mj_data.tree_asleep[0] >= 0
    # from the wires' starts
    a = 1.0 + y - 0.15
    b = 1.0 + y + 0.15
    deflection = compliance((a, b)) @ np.full(2, 0.25 * mass * G)
    assert 1.0 + THICK - physics.rigid.mj_data.qpos[2] == pytest.approx(deflection.mean(), rel=0.01)
    if forces:
        np.testing.assert_allclose(forces, mass * G, rtol=0.01)


@pytest.mark.parametrize(("drop", "tension"), each_once([0.0, 0.3], [200.0, 900.0, 5000.0]))
def test_a_cut_cane_lies_on_wires_that_give(drop: float, tension: float) -> None:
    """It passes none, they bear its weight within 0.1 %, and each gives by the string law and what the contact does."""
    places = [(0.2, 0.99 - drop), (0.8, 0.99 - drop)]
    model = assemble([cane((0.0, 0.0, 1.0))], fixed_tension=[tension] * 2, **wires(places))
    physics = Physics(model)
    force = np.zeros(3)
    physics.cut(0)
    crossings = [Crossings(physics, place) for place in places]
    for _ in range(2500):
        physics.step()
        if len(physics.plants.awake) == 0:
            break
        force = borne(physics)
    assert len(physics.plants.awake) == 0
    assert [c.count for c in crossings] == [0, 0]
    np.testing.assert_allclose(force, [0.0, 0.0, weight(physics)], atol=1e-3 * weight(physics))
    half = 0.5 * weight(physics)
    given = half * (0.25 * LENGTH / tension)
    assert -physics.wires.offset[:, 0, 2] == pytest.approx(given, abs=0.02 * given + half / 1.5e4)


def test_a_cane_that_sleeps_on_wires_holds_them_down_until_it_is_put_elsewhere() -> None:
    """Asleep, the wires stay where it pressed them to; when its owner tells that it rests in another pose, they are
    straight again."""
    places = [(0.2, 0.99), (0.8, 0.99)]
    physics = Physics(assemble([cane((0.0, 0.0, 1.0))], fixed_tension=[TENSION] * 2, **wires(places)))
    physics.cut(0)
    while len(physics.plants.awake):
        physics.step()
    run(physics, 20)
    held = physics.wires.offset.copy()
    assert held[:, :, 2].max() < -1e-4
    run(physics, 20)
    np.testing.assert_array_equal(physics.wires.offset, held)
    physics.apply_remote_rest([0], [physics.model.joint_settled])
    run(physics, 100)
    assert np.all(physics.wires.offset == 0.0)


def test_what_presses_on_a_wire_moves_the_shoots_tied_to_it() -> None:
    """10 N between two of four shoots: all tips within 1 % of the dense solve of joints, ties and wire."""
    at = 1.0
    force = 10.0
    physics = world(row_of_shoots(beyond=BEYOND))
    press(physics, at, force)
    run(physics, 800)
    every = (*ALONG, at)
    order = np.argsort(every)
    flexible = compliance(tuple(np.sort(every)))
    wire = np.linalg.inv(flexible[np.argsort(order)][:, np.argsort(order)])
    ties = np.diag([TIE] * 4 + [0.0])
    whole = np.block([[wire + ties, -ties[:, :4]], [-ties[:4], TIE * np.eye(4) + SPRING / SHOOT**2 * np.eye(4)]])
    moved = np.linalg.solve(whole, np.append(force * np.eye(5)[4], np.zeros(4)))
    np.testing.assert_allclose(tips(physics)[:, 2], moved[5:], rtol=0.01)
    assert rod(physics) - (1.0 - THICK) == pytest.approx(moved[4], rel=0.01)
    np.testing.assert_allclose(
        np.linalg.inv(stiffness_of_ties(ALONG)), compliance(ALONG) + np.eye(4) / TIE, rtol=1e-9
    )  # the tests of this file and of test_wires.py mean the same wire


def test_a_wire_bears_the_same_whether_or_not_its_world_is_looked_at() -> None:
    """A rod that strikes a wire with four shoots, with and without a snapshot after each step: equal bits. The spring
    of a wire follows from the poses of its shoots at the start of the step, not of the step before."""
    worlds = [world(row_of_shoots(beyond=BEYOND)) for _ in range(2)]
    for physics in worlds:
        press(physics, 1.0, 20.0)
    for _ in range(60):
        for physics in worlds:
            physics.step()
        worlds[1].snapshot()
        assert worlds[0].state.joint_qd.tobytes() == worlds[1].state.joint_qd.tobytes()
        assert worlds[0].rigid.mj_data.qvel.tobytes() == worlds[1].rigid.mj_data.qvel.tobytes()
    assert abs(tips(worlds[0])).max() > 1e-3


def test_the_energy_of_a_pressed_wire_is_half_of_force_times_way() -> None:
    """A rod that presses with 20 N beside four shoots, at rest: springs of shoots, ties and wire hold what a load of 20
    N stores as it grows from nothing; the rod has moved by a dense solve's way."""
    physics = world(row_of_shoots(beyond=BEYOND))
    press(physics, 1.0, 20.0)
    run(physics, 600)
    physics.update_kinematics()
    stored = energy(physics.plants, 0.0).total + physics.wires.energy
    assert stored == pytest.approx(0.5 * 20.0 * (rod(physics) - (1.0 - THICK)), rel=0.01)


def test_sleeping_shoots_wake_when_something_presses_on_their_wire() -> None:
    """10 N move all ties of the wire by more than a quarter of ``sleep_distance``, those of the other wire not at all;
    and they fall asleep with it, where the dense solve says."""
    physics = world(row_of_shoots(others=3, beyond=BEYOND), sleep=True)
    run(physics, 200)
    assert len(physics.plants.awake) == 0
    press(physics, 1.0, 10.0, below=0.022)
    woken = set()
    for _ in range(1500):
        physics.step()
        woken |= set(physics.plants.awake.tolist())
    assert woken == {0, 1, 2, 3}
    assert len(physics.plants.awake) == 0
    awake = run(world(row_of_shoots(others=3, beyond=BEYOND)), 1)
    press(awake, 1.0, 10.0, below=0.022)
    run(awake, 1500)
    np.testing.assert_allclose(tips(physics)[:4], tips(awake)[:4], atol=1e-4)


def test_two_that_press_on_one_wire_feel_each_other() -> None:
    """Each finds the wire where both deflect it to within 0.2 %, whether their forces are equal or not."""
    places = (0.6, 1.4)
    law = compliance((0.6, 1.4))
    for first, second in ((15.0, 15.0), (15.0, 5.0)):
        physics = world(row_of_shoots((), beyond=BEYOND))
        press(physics, places[0], first, "first")
        press(physics, places[1], second, "second")
        run(physics, 600)
        found = np.array([rod(physics, "first"), rod(physics, "second")]) - (1.0 - THICK)
        np.testing.assert_allclose(found, law @ [first, second], rtol=2e-3)


def test_wires_bear_the_same_when_an_actor_joins_and_leaves() -> None:
    """A robot that presses on a wire to which shoots are tied, to the bit: the world is compiled anew around it."""
    found = []
    for joins in (False, True):
        physics = world(row_of_shoots(beyond=BEYOND))
        press(physics, 1.0, 10.0)
        heights = []
        for step in range(150):
            if joins and step == 60:
                physics.add_robot(probe((0.0, 40.0, 3.0), "far"))
            if joins and step == 100:
                physics.remove_robot("far")
            physics.step()
            heights.append([rod(physics), force_on(physics, "probe"), *physics.wires.offset[0].ravel()])
        found.append(heights)
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("below", [0.1, *long(0.0)])
def test_a_cane_on_a_wire_and_a_robot_under_it(below: float) -> None:
    """A cut cane lies across a wire which a robot lifts with 12 N, ``below`` [m] from it: one solve has the cane, the
    other the robot, and still the wire lies where both deflect it to; nothing swings."""
    places = [(0.2, 0.99), (0.8, 0.99)]
    model = assemble([cane((0.0, 0.0, 1.0))], fixed_tension=[TENSION] * 2, **wires(places))
    physics = Physics(model, parameters=PhysicsParameters(sleep=False))
    physics.cut(0)
    run(physics, 200)
    spec = probe((0.2, 0.0, 0.9), mass=0.5)
    turned = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    spec.pose[:] = [0.2, below, 0.963, *turned]
    physics.add_robot(spec)
    physics.rigid.set_gains("probe", np.array([5000.0, 0.0]), np.array([300.0, 2.0]), np.array([0.0, 12.0]))
    run(physics, 1000)
    height = []
    force = []
    for _ in range(50):
        physics.step()
        height.append(rod(physics))
        force.append(sum(c.force[2] for c in physics.contacts if c.link == "fixed/0"))
    assert np.ptp(height) < 1e-5
    law = compliance((1.0, 1.0 + below))
    deflection = law @ [np.mean(force), 12.0]
    assert np.mean(force) == pytest.approx(-0.5 * weight(physics), rel=0.01)
    assert height[-1] - (0.99 - THICK) == pytest.approx(deflection[1], rel=1e-3)
    cane_axis = physics.snapshot().body_q[3, 2] - 0.006 - RADIUS
    assert cane_axis - 0.99 == pytest.approx(deflection[0], abs=3e-4)


@pytest.mark.parametrize(("height", "mass"), each_once([0.1, 0.5, 1.5], [0.5, 2.0]))
def test_a_crate_that_falls_on_wires_stays_on_them(height: float, mass: float) -> None:
    """At up to 5.4 m/s, 54 mm a step: it goes no deeper than the wires' springs take its energy, as one at 4 T / L each
    where it has both its edges, and comes to rest on them."""
    pose = [0.0, 0.0, 1.0 + THICK + height, 0.0, 0.0, 0.0, 1.0]
    model = level_wires([(-0.1, 1.0), (0.1, 1.0)], box_pose=[pose], box_size=[[0.4, 0.3, 0.2]], box_mass=[mass])
    physics = Physics(model)
    lowest = 1.0 + height
    for _ in range(300):
        physics.step()
        lowest = min(lowest, physics.rigid.mj_data.qpos[2])
    stiffness = 2.0 * 4.0 * TENSION / LENGTH
    deepest = mass * G / stiffness + np.sqrt((mass * G / stiffness) ** 2 + 2.0 * mass * G * height / stiffness)
    assert 1.0 + THICK - lowest < deepest
    assert physics.rigid.mj_data.qpos[2] - 1.0 == pytest.approx(THICK - mass * G / stiffness, abs=2e-3)


@pytest.mark.parametrize("seed", [0, 1, *long(*range(2, 16))])
def test_falling_on_wires_gains_no_energy(seed: int) -> None:
    """Crates of 0.05 to 20 kg, flat or tilted, on wires of 100 to 10,000 N, wherever they go from there: less energy
    than at the start, always."""
    rng = np.random.default_rng(seed)
    tension = 10 ** rng.uniform(2.0, 4.0)
    mass = 10 ** rng.uniform(-1.3, 1.3)
    turn = frames.exp(rng.normal(0.0, 0.1, 3) if seed % 2 else np.zeros(3))
    pose = [0, rng.uniform(-0.5, 0.5), 1.05 + rng.uniform(0.0, 0.03), *turn]
    model = level_wires(
        [(-0.1, 1.0), (0.1, 1.0)], tension, box_pose=[pose], box_size=[[0.4, 0.3, 0.2]], box_mass=[mass]
    )
    physics = Physics(model)
    m = physics.rigid.mj_model
    d = physics.rigid.mj_data
    mujoco.mj_forward(m, d)
    before = energy_of(physics)
    for step in range(400):
        physics.step()
        assert energy_of(physics) < before + 1e-6 * mass, step


def energy_of(physics: Physics) -> float:
    """[J] kinetic and potential, of rigid bodies."""
    m = physics.rigid.mj_model
    d = physics.rigid.mj_data
    copy = mujoco.MjData(m)
    copy.qpos[:] = d.qpos
    copy.qvel[:] = d.qvel
    m.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    mujoco.mj_forward(m, copy)
    m.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    return float(copy.energy.sum())


def wire_in_pictures(physics: Physics, primitives: Primitives, piece: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Both ends [k, 3] m of the cones that cameras and lidars see of a wire."""
    primitives.update(physics.snapshot())
    cones = np.flatnonzero(primitives.label == label(Organ.WIRE, int(physics.model.fixed_index[piece])))
    return tuple(getattr(primitives.shapes, end).numpy()[cones, :3].astype(float) for end in "ab")


def test_cameras_and_lidars_see_a_pressed_wire_where_the_string_law_says() -> None:
    """To 2e-5 m at the ends of its segments, which hang together; let go, it is seen where it was drawn."""
    at = 0.5
    force = 20.0
    physics = world(row_of_shoots((), beyond=BEYOND))
    primitives = Primitives(physics.model, grass=0.0)
    drawn = wire_in_pictures(physics, primitives)
    press(physics, at, force)
    run(physics, 300)
    pressed = wire_in_pictures(physics, primitives)
    for before, after in zip(drawn, pressed, strict=True):
        x = before[:, 0]
        expected = force * np.minimum(x, at) * (LENGTH - np.maximum(x, at)) / (TENSION * LENGTH)
        np.testing.assert_allclose(after - before, expected[:, None] * [0.0, 0.0, 1.0], atol=2e-5)
    np.testing.assert_allclose(pressed[0][1:], pressed[1][:-1], atol=5e-5)  # it is a little longer than drawn
    physics.rigid.set_gains("probe", np.array([5000.0, 0.0]), np.array([300.0, 2.0]), np.array([0.0, -20.0]))
    run(physics, 100)
    for before, after in zip(drawn, wire_in_pictures(physics, primitives), strict=True):
        np.testing.assert_array_equal(after, before)


def test_a_wire_is_seen_to_pass_its_ties_where_the_shoots_hold_it() -> None:
    """At each tie it is seen within 0.1 mm of where the tie's anchor has gone, which moves with the wire."""
    places = (0.5, 1.0, 1.5)
    physics = world(row_of_shoots(places, beyond=BEYOND))
    primitives = Primitives(physics.model, grass=0.0)
    press(physics, 0.75, 30.0)
    run(physics, 200)
    start, end = wire_in_pictures(physics, primitives)
    line = np.concatenate([start, end[-1:]])
    ties = physics.plants.ties
    seen = np.stack([np.interp(places, line[:, 0], line[:, k]) for k in range(3)], axis=1)
    moved = ties.anchor[ties.on_wire].astype(float) - physics.model.tie_anchor[ties.on_wire]
    assert moved[:, 2].max() > 0.01
    np.testing.assert_allclose(seen - [[x, SHOOT + BEYOND, 1.0] for x in places], moved, atol=1e-4)
