"""Wires that get tighter as they deflect, and break: force over deflection, under robots and ties, and energy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from tests.laws.test_pressed_wires import BEYOND, THICK, press, rod, run
from tests.laws.test_wires import ARM, LENGTH, SPRING, TENSION, push, row_of_shoots, tips, world
from vinesim.api.energy import energy
from vinesim.client.vine_events import events_of
from vinesim.scene.generation.fixed_structure import wire_stretch
from vinesim.scene.model import Model
from vinesim.world import Physics

pytestmark = pytest.mark.slow

STRETCH = float(wire_stretch(np.array([LENGTH]), 0.0025, 2e11, 5e4)[0])
"""[N/m] of 2 m of steel wire, 2.5 mm thick, between posts of 50 kN/m."""


def tight(model: Model, stretch: float = STRETCH, strength: float = 0.0) -> Model:
    model.fixed_stretch[:] = stretch
    model.fixed_strength[:] = strength
    return model


def force_over(deflection: float, at: float) -> float:
    """[N] across a string of tension T0 + stretch * lengthening, with a small slope: T (1 / a + 1 / b) u."""
    rest = LENGTH - at
    longer = 0.5 * deflection**2 * (1.0 / at + 1.0 / rest)
    return (TENSION + STRETCH * longer) * (1.0 / at + 1.0 / rest) * deflection


def press_slowly(physics: Physics, at: float, force: float) -> None:
    """Press on a wire with a force [N] that grows for two seconds."""
    press(physics, at, 5.0)
    gains = np.array([5000.0, 0.0]), np.array([300.0, 2.0])
    for step in range(600):
        physics.rigid.set_gains("probe", *gains, np.array([0.0, 5.0 + (force - 5.0) * min(step / 200.0, 1.0)]))
        physics.step()


@pytest.mark.parametrize(("at", "force"), [(1.0, 20.0), (1.0, 150.0), (0.5, 300.0), (1.0, 600.0)])
def test_a_wire_that_a_robot_presses_gets_tighter(at: float, force: float) -> None:
    physics = world(tight(row_of_shoots((), beyond=BEYOND)))
    press_slowly(physics, at, force)
    expected = brentq(lambda u: force_over(u, at) - force, 0.0, 1.0)
    constant = force * at * (LENGTH - at) / (TENSION * LENGTH)
    assert rod(physics) - (1.0 - THICK) == pytest.approx(expected, rel=0.01)
    assert force < 100.0 or expected < 0.95 * constant
    lengthened = 0.5 * expected**2 * (1.0 / at + 1.0 / (LENGTH - at))
    assert physics.elastic_supports.tension[0] == pytest.approx(TENSION + STRETCH * lengthened, rel=0.01)


@pytest.mark.parametrize(("at", "force"), [(1.0, 20.0), (0.5, 150.0), (1.0, 400.0)])
def test_a_wire_that_a_tie_pulls_gets_tighter(at: float, force: float) -> None:
    """A push on a shoot that a stiff tie holds: force over deflection is the closed form's, at the wire."""
    physics = world(tight(row_of_shoots((at,), tie=2e4)))
    push(physics, 0, np.array([0.0, 0.0, force]))
    run(physics, 500)
    moved = float(physics.elastic_supports.deflection[0, 2])
    held = 2e4 * (float(tips(physics)[0, 2]) - moved)
    assert held > 0.9 * force - SPRING / ARM**2
    assert force_over(moved, at) == pytest.approx(held, rel=0.01)


def test_a_wire_that_is_pushed_with_shoots_on_it_balances() -> None:
    """Beside four shoots: the tension that the step finds lengthens the wire as far as it says."""
    physics = world(tight(row_of_shoots(beyond=BEYOND)))
    press_slowly(physics, 1.0, 300.0)
    nodes = physics.elastic_supports.deflection
    places = np.array([0.0, *(0.3, 0.7, 0.85), 1.0, 1.6, LENGTH])
    up = np.array([0.0, *nodes[:3, 2], rod(physics) - (1.0 - THICK), nodes[3, 2], 0.0])
    longer = 0.5 * float((np.diff(up) ** 2 / np.diff(places)).sum())
    assert longer > 1e-3
    assert physics.elastic_supports.tension[0] == pytest.approx(TENSION + STRETCH * longer, rel=0.01)


def test_a_stronger_push_breaks_the_wire_and_frees_its_ties() -> None:
    """The force grows until the wire breaks at its strength: one event, ties loose, nothing resists any more."""
    strength = 1500.0
    physics = world(tight(row_of_shoots(beyond=BEYOND), strength=strength))
    press(physics, 1.0, 20.0)
    gains = np.array([5000.0, 0.0]), np.array([300.0, 2.0])
    broken = []
    for step in range(400):
        physics.rigid.set_gains("probe", *gains, np.array([0.0, 20.0 + 2.5 * step]))
        physics.step()
        broken += physics.wire_breaks
        if broken:
            break
    (one,) = broken
    assert one.piece == 0
    assert strength <= one.tension < 1.05 * strength
    assert one.ties == (0, 1, 2, 3)
    (row,) = [event for event in events_of(physics) if event["event"] == "wire"]
    assert row == {"event": "wire", "piece": 0, "tension_n": one.tension, "ties": [0, 1, 2, 3]}
    assert physics.state.tie_broken.all()
    assert [event.kind for event in physics.detachment_monitor.breakages] == ["untie"] * 4
    physics.rigid.set_gains("probe", *gains, np.array([0.0, 5.0]))
    height = rod(physics)
    run(physics, 100)
    assert physics.wire_breaks == ()
    assert rod(physics) > height + 0.5
    assert np.isfinite(physics.state.joint_q).all()


@pytest.mark.parametrize("force", [30.0, 150.0])
def test_shoots_on_a_wire_that_gets_tighter_gain_no_energy(force: float) -> None:
    """Shoots that push their wire aside by centimetres and are let go, undamped, at phi 0.55: never more energy than at
    the start."""
    physics = world(tight(row_of_shoots(beta=0.0)))
    for shoot in range(4):
        push(physics, shoot, np.array([0.0, 0.0, force * (-1) ** shoot * (1 + shoot)]))
    run(physics, 400)
    assert force < 100.0 or physics.elastic_supports.tension[0] > 1.1 * TENSION
    for shoot in range(4):
        push(physics, shoot, np.zeros(3))
    seen = []
    for _ in range(300):
        physics.update_kinematics()
        physics.elastic_supports.update()
        seen.append(energy(physics.plants, 0.0).total + physics.wires.energy)
        physics.step()
    assert max(seen) <= 1.001 * seen[0]
    assert seen[0] > 0.05
