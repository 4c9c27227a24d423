"""Events of the vineyard as JSON, and the report of what happened to the fruit."""

import json

import numpy as np
import pytest

from tests.physics.test_cut_canes import level_cane
from tests.physics.test_cutting import close, on_cane
from tests.support.contact_scenes import bar, bunch_scene
from vinesim.client.vine_events import events_of, fruit_report
from vinesim.core import frames
from vinesim.world import Physics


def test_a_stalled_blade_is_an_event_with_its_reason():
    physics, blade, body = on_cane(force=500.0)
    close(physics, blade)
    row, notch = json.loads(json.dumps(events_of(physics)))
    assert (row["event"], row["outcome"], row["actor"], row["body"]) == ("blade", "stalled", "bar", body)
    assert (notch["event"], notch["cause"], notch["actor"], notch["body"]) == ("notch", "blade", "bar", body)
    assert row["force_n"] == pytest.approx(500.0)
    assert row["needed_n"] == pytest.approx(1033.6, rel=1e-3)
    assert row["text"] == blade.outcome


def test_a_cut_a_fall_and_the_lost_berries_are_events_and_in_the_report():
    model, body, _ = bunch_scene()
    physics = Physics(model)
    stalk = physics.snapshot().body_q[body - 1, :3]
    physics.add_robot(bar(stalk + np.array([0.0, -0.5, -0.2])))
    blade = physics.add_blade("bar", "bar", frames.pose(np.array([0.0, 0.5, 0.18])), np.array([0.03, 0.03, 0.002]))
    assert fruit_report(physics) == {"bunches": [], "berries": 0, "berries_burst": 0, "berries_lost": 0}
    blade.close()
    rows = []
    for _ in range(120):
        physics.step()
        rows += json.loads(json.dumps(events_of(physics)))
    kinds = [(row["event"], row.get("outcome", row.get("cause", row.get("what")))) for row in rows]
    assert kinds[:3] == [("blade", "cut"), ("detached", "blade"), ("fruit", "dropped")]
    assert rows[2]["height_m"] == pytest.approx(1.8, abs=0.1)
    report = json.loads(json.dumps(fruit_report(physics)))
    (bunch,) = report["bunches"]
    assert (bunch["bunch"], bunch["drops"], bunch["berries"]) == (0, 1, report["berries"])
    assert bunch["damage"] == pytest.approx((report["berries_burst"] + report["berries_lost"]) / 80)
    assert kinds.count(("fruit", "lost")) >= 1


def test_wood_and_ties_that_give_are_events():
    """A cane is pressed until it cracks: the row has the moment of the crack, and its place from the base."""
    model = level_cane(shape="equilibrium", strength=50e6, yield_strength=40e6, toughness=2e4)
    physics = Physics(model)
    tip = len(model.body_mass) - 3
    rows = []
    for _ in range(400):
        physics.plants.body_load[tip, 2] -= 0.5
        physics.plants.wake(0)
        physics.step()
        rows += json.loads(json.dumps(events_of(physics)))
        if rows:
            break
    assert (rows[0]["event"], rows[0]["cause"], rows[0]["tie"]) == ("crack", "bend", -1)
    assert np.linalg.norm(rows[0]["moment"]) == pytest.approx(physics.detachment_monitor.wood.law.breaks[0], rel=0.1)
    assert rows[0]["place_m"] == pytest.approx(0.1 * rows[0]["body"])
