"""What happens to bunches: the berry law against its own equations and published figures; forces, falls and time in
hands against scenes with known ones."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.contact_scenes import bunch_scene, grasp, gripper
from vinesim.interaction import fruit_damage as law
from vinesim.interaction.fruit_damage import FruitMonitor
from vinesim.scene.berries import VARIETIES
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import RigidBox
from vinesim.world import Physics

RADIUS = 0.01


# ---------------------------------------------------------------------- laws


@pytest.mark.parametrize("tension", [110.0, 265.0, 420.0])
def test_a_berry_bursts_at_laplaces_pressure_and_a_published_flattening(tension):
    """P = 2 T / R times the contact area 2 pi R^2 x is the force; berries burst at 0.35 to 0.47 of their thickness
    (Int. Agrophys. 1994 8:381)."""
    force = law.burst_force(RADIUS, tension)
    x = force / (2.0 * tension / RADIUS) / (2.0 * np.pi * RADIUS**2)
    assert 0.35 < x < 0.47
    assert 0.5 * law.SKIN_MODULUS_PER_TENSION * tension * x**2 == pytest.approx(tension, rel=1e-9)


def test_the_pressure_at_bursting_is_laplaces():
    force = law.burst_force(RADIUS, 265.0)
    assert law.berry_pressure(np.array(force), np.array(RADIUS)) == pytest.approx(2.0 * 265.0 / RADIUS, rel=1e-9)


def test_pressure_rises_with_the_two_thirds_power_of_force():
    low, high = law.berry_pressure(np.array([1.0, 8.0]), np.array(RADIUS))
    assert high / low == pytest.approx(4.0, rel=1e-12)


# ---------------------------------------------------------------------- monitor


def pressed() -> tuple[Physics, list]:
    """A gripper closes on a bunch; its contacts in each step."""
    model, _, middle = bunch_scene()
    physics = Physics(model)
    physics.add_robot(gripper(middle))
    seen = []
    for tick in range(200):
        target, _ = grasp(0.01 * min(tick, 130))
        physics.rigid.command("grip", target)
        physics.step()
        seen.append([c for c in physics.contacts if c.actor == "grip"])
    return physics, seen


def test_a_bunch_in_a_gripper_has_the_impulse_force_and_time_of_its_contacts():
    physics, seen = pressed()
    found = physics.fruit_monitor.history(0)
    normal = max(np.linalg.norm(c.force) for step in seen for c in step)
    most = max(sum(np.linalg.norm(c.force) for c in step) for step in seen)
    assert found.hand_time == pytest.approx(0.01 * sum(bool(step) for step in seen))
    total = 0.01 * sum(np.linalg.norm(c.force) for step in seen for c in step)
    assert 0.9 * total < found.impulse <= total, "friction is not pressure"
    assert 0.9 * normal < found.peak_force <= most
    assert found.peak_pressure > 0.0
    assert physics.fruit_monitor.handled() == (0,)


def test_a_bunch_that_nobody_touches_has_no_history():
    model, _, _ = bunch_scene()
    physics = Physics(model)
    for _ in range(20):
        physics.step()
    found = physics.fruit_monitor.history(0)
    assert (found.hand_time, found.peak_force, found.damage) == (0.0, 0.0, 0.0)
    assert physics.fruit_monitor.handled() == ()
    with pytest.raises(ValueError, match="bunch 7 does not exist"):
        physics.fruit_monitor.history(7)


def dropped() -> tuple[Physics, list]:
    model, _, _ = bunch_scene()
    physics = Physics(model)
    physics.pick(0)
    events = []
    for _ in range(150):
        physics.step()
        events += physics.fruit_monitor.events
    return physics, events


def test_a_bunch_that_falls_to_the_ground_has_the_height_of_its_fall():
    model, _, _ = bunch_scene()
    physics = Physics(model)
    physics.pick(0)
    start = physics.rigid.mj_data.xipos[physics.rigid._body_of_object("bunch/0", "bunch"), 2].copy()
    lowest = start
    while not physics.fruit_monitor.events:
        physics.step()
        assert physics.time < 2.0
    (event,) = [one for one in physics.fruit_monitor.events if one.what == "dropped"]
    lowest = physics.rigid.mj_data.xipos[physics.rigid._body_of_object("bunch/0", "bunch"), 2]
    assert event.value == pytest.approx(start - lowest, abs=0.02)
    found = physics.fruit_monitor.history(0)
    assert (found.drops, found.drop_height) == (1, event.value)
    assert found.hand_time == 0.0
    speed = np.sqrt(2.0 * 9.81 * event.value)
    assert 0.3 * speed / 0.01 < found.acceleration < 1.5 * speed / 0.01, "stopped within one to three steps"


def test_a_higher_fall_and_a_harder_press_do_more_damage_and_runs_are_equal():
    first, events = dropped()
    second, again = dropped()
    assert events == again
    assert first.fruit_monitor.history(0) == second.fruit_monitor.history(0)
    assert first.fruit_monitor.history(0).berries_lost > 0.0


@pytest.mark.parametrize("dt", [0.005, 0.001])
def test_the_figures_of_a_fall_depend_little_on_the_step(dt):
    """Within 20 %: the impact itself is softer in long steps."""
    found = []
    for step in (0.01, dt):
        physics = Physics(bunch_scene()[0], parameters=PhysicsParameters(dt=step))
        physics.pick(0)
        while physics.time < 0.8:
            physics.step()
        found.append(physics.fruit_monitor.history(0))
    assert found[1].drop_height == pytest.approx(found[0].drop_height, rel=0.03)
    assert found[1].peak_force == pytest.approx(found[0].peak_force, rel=0.2)
    assert found[1].acceleration == pytest.approx(found[0].acceleration, rel=0.2)


@pytest.mark.parametrize("speed", [1.0, 5.0])
def test_a_hanging_bunch_loses_berries_when_it_is_jerked(speed):
    """The bunch gets a velocity within one step; a robot's slow motion shakes no berry off."""
    model, _, _ = bunch_scene()
    physics = Physics(model)
    body = int(model.bunch_body[0])
    physics.step()
    physics.plants.state.joint_qd[body, 1] = speed / float(np.linalg.norm(model.body_com[body]))
    physics.plants.wake(np.array([0]))
    physics.step()
    physics.step()
    found = physics.fruit_monitor.history(0)
    mass = VARIETIES[int(model.bunch_variety[0])].mass
    expected = np.hypot(speed / 0.01, 9.81)
    low, high = law.PULL_OFF
    if mass * expected < low:
        assert found.acceleration == found.berries_lost == 0.0
        assert physics.fruit_monitor.handled() == ()
        return
    assert found.acceleration == pytest.approx(expected, rel=0.1)
    share = (mass * found.acceleration - low) / (high - low)
    assert found.berries_lost == pytest.approx(found.berries * share)
    assert physics.fruit_monitor.handled() == (0,)
    assert found.hand_time == 0.0


def test_burst_berries_follow_from_the_forces_on_their_cells():
    model, _, _ = bunch_scene()
    physics = Physics(model)
    monitor = FruitMonitor(physics.plants, physics.rigid, physics.contact_solver)
    monitor._add_rows(np.array([0]))
    radius = float(monitor._radius[0])
    middle = law.burst_force(radius, 265.0)
    monitor._berry_force[0, :2] = middle, law.burst_force(radius, 500.0)
    found = monitor.history(0)
    assert found.berries_burst == pytest.approx(1.5 + 3.0)
    assert found.peak_pressure > 2.0 * 265.0 / radius
    monitor._tell()
    assert [(event.what, event.bunch) for event in monitor.events] == [("burst", 0)]


def test_what_other_clients_simulate_is_not_recorded():
    model, _, _ = bunch_scene()
    physics = Physics(model)
    physics.fruit_monitor.remote[0] = True
    physics.pick(0)
    for _ in range(150):
        physics.step()
    assert physics.fruit_monitor.history(0).drops == 0


def test_a_bunch_that_rests_in_a_crate_gets_no_further_drops_and_no_time_in_hands():
    physics, _ = dropped()
    before = physics.fruit_monitor.history(0)
    physics.rigid.add_box(50, RigidBox(np.array([3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), np.array([0.6, 0.4, 0.3]), 1.0))
    for _ in range(300):
        physics.step()
    after = physics.fruit_monitor.history(0)
    assert after.drops == before.drops
    assert after.hand_time == 0.0
