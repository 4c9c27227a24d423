"""Faults are counted where a user sees them, and logged once."""

from __future__ import annotations

import logging
import types

import numpy as np
import pytest

from tests.support.contact_scenes import cane
from vinesim.cli.client_session import status_line
from vinesim.cli.robot_client import complete_report
from vinesim.client.client import Client
from vinesim.client.faults import DESCRIPTIONS
from vinesim.client.pace import RealTime
from vinesim.client.processes.robot_processes import loop_status, network_status
from vinesim.client.rate_loop import RateLoop
from vinesim.client.status import Status
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.replication.clock_sync import Ping
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene


@pytest.fixture
def client() -> Client:
    scene = load_scene("demo")
    hub = MemoryHub()
    model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
    return Client(scene, model, load_description("vinebot"), hub.bus("robot"), name="robot", pose=spawn_pose(scene, 0))


def test_a_client_without_faults_has_none(client) -> None:
    client.tick()
    values = Status(client, RateLoop(0.01)).current()
    assert values["faults"] == {}
    assert status_line(values).endswith("  alone")
    values |= {"frames_dropped": 359, "frame_rate": 29.0, "frame_rate_asked": 30.0}
    assert status_line(values).endswith("  alone"), "one late picture in a second needs no attention"
    values |= {"frame_rate": 21.4, "sound_dropped": 1}
    slow = "  alone  pictures and scans: 21 of the 30 a second that subscribers ask for  dropped: 1 frames of sound"
    assert status_line(values).endswith(slow)


def test_the_rate_of_pictures_is_that_since_the_last_status(client) -> None:
    sensors = {"frames_delivered": 0, "frames_dropped": 0}
    loop = RateLoop(0.01)
    status = Status(client, loop, sensors=lambda: dict(sensors))
    assert status.current()["frame_rate_asked"] == 0.0
    sensors |= {"frames_delivered": 20, "frames_dropped": 10}
    first = status.current()
    assert first["frame_rate"] == pytest.approx(2 / 3 * first["frame_rate_asked"])
    sensors |= {"frames_delivered": 30}
    second = status.current()
    assert second["frame_rate"] == second["frame_rate_asked"] > 0.0, "of the last second, not of the whole run"


def test_a_tree_that_is_stopped_is_counted_shown_and_logged_once(client, caplog) -> None:
    caplog.set_level(logging.WARNING)
    status = Status(client, RateLoop(0.01))
    for _ in range(2):
        client.physics.plants.wake(0)
        client.physics.state.joint_qd[0] = np.nan
        client.tick()
        values = status.current()
    assert values["faults"] == {"trees_stopped": 2}
    assert status_line(values).endswith("FAULTS: 2 trees stopped")
    assert status.report()["faults"] == {"trees_stopped": 2}
    assert [r.getMessage() for r in caplog.records if "trees_stopped" in r.getMessage()] == [
        f"1 {DESCRIPTIONS['trees_stopped']} (further ones are only counted: trees_stopped)"
    ]


def test_diagnostics_warn_of_what_occurred_lately_and_always_count_it(client, monkeypatch) -> None:
    loop = RateLoop(0.01)
    status = Status(client, loop)
    now = 1.0
    monkeypatch.setattr(RateLoop, "elapsed", property(lambda _: now))
    client.replicator.counters.malformed = 3
    for now, malformed, trouble in (
        (1.0, 3, "messages refused"),
        (60.0, 3, "messages refused"),
        (61.0, 3, ""),
        (1000.0, 3, ""),
        (1001.0, 4, "messages refused"),
        (1061.0, 4, ""),
    ):
        client.replicator.counters.malformed = malformed
        loop.ticks = round(now / loop.dt)  # no step was missed
        shown = loop_status(status.current())
        assert (shown.level, shown.message) == ("warning" if trouble else "ok", trouble or "well"), now
        assert shown.values["messages_refused"] == malformed


def test_diagnostics_warn_while_a_loop_is_behind_and_no_longer(client, monkeypatch) -> None:
    loop = RateLoop(0.01)
    status = Status(client, loop)
    now = 1.0
    monkeypatch.setattr(RateLoop, "elapsed", property(lambda _: now))
    for now, loop.ticks, message in ((1.0, 100, "well"), (2.0, 150, "behind"), (3.0, 250, "well")):  # noqa: B007
        assert loop_status(status.current()).message == message


def test_a_loop_that_was_asked_to_run_slowly_is_not_behind(client, monkeypatch) -> None:
    """At a fifth of real time 20 steps are due in a second."""
    loop = RateLoop(0.01, RealTime(0.2))
    pace = "0.20 of real time"
    status = Status(client, loop)
    now = 1.0
    monkeypatch.setattr(RateLoop, "elapsed", property(lambda _: now))
    for now, loop.ticks, message in ((1.0, 20, pace), (2.0, 30, f"behind, {pace}"), (3.0, 50, pace)):  # noqa: B007
        assert loop_status(status.current()).message == message


def test_what_cannot_be_read_from_another_actor_is_counted(client) -> None:
    client.replicator.counters.malformed += 3
    assert Status(client, RateLoop(0.01)).current()["faults"] == {"messages_refused": 3}
    assert set(client.physics.faults) <= set(DESCRIPTIONS)


def test_what_the_parts_of_a_client_count_is_added_up(client) -> None:
    """Commands that were refused, of each robot; and none is shown as long as there is none."""
    counts = [0, 0]
    client.other_faults += [lambda: {"commands_refused": counts[0]}, lambda: {"commands_refused": counts[1]}]
    status = Status(client, RateLoop(0.01))
    assert status.current()["faults"] == {}
    counts[:] = 2, 3
    assert status.current()["faults"] == {"commands_refused": 5}
    assert "commands_refused" in DESCRIPTIONS


def test_what_the_network_lost_refused_or_came_under_a_false_name_is_counted(client) -> None:
    counters = client.replicator.counters
    counters.lost = 1
    counters.foreign = 2
    counters.network_failures = 3
    values = Status(client, RateLoop(0.01)).current()
    assert values["faults"] == {"messages_lost": 1, "messages_foreign": 2, "network_failures": 3}
    assert set(values["faults"]) <= set(DESCRIPTIONS)
    assert status_line(values).endswith("FAULTS: 1 messages lost, 2 messages foreign, 3 network failures")


def test_a_server_that_is_gone_is_told_while_it_is_gone(client) -> None:
    """By status line, status and diagnostics; not only by a line of the log when it went."""
    status = Status(client, RateLoop(0.01))
    hub = client.replicator.bus.hub
    for hub.down, text in ((False, ""), (True, "the hub is down"), (False, "")):
        client.tick()
        values = status.current()
        assert values["network"] == text
        assert status_line(values).endswith(f"  alone  NETWORK: {text}" if text else "  alone")
        shown = network_status(values)
        assert (shown.name, shown.level, shown.message) == ("network", "warning" if text else "ok", text or "well")


def test_the_round_trip_to_the_server_is_shown(client) -> None:
    status = Status(client, RateLoop(0.01))
    assert network_status(status.current()).values["round_trip_ms"] is None
    for sent, received in ((1.0, 1.5), (2.0, 2.25), (3.0, 3.5)):
        clock = client.replicator._state.peers.clock
        clock.estimate = clock.estimate.with_ping(Ping(sent, 10.0 + 0.5 * (sent + received), received))
    assert network_status(status.current()).values["round_trip_ms"] == 250.0


def test_the_report_of_several_robots_has_the_losses_of_each() -> None:
    lost = {"picker_1": {}, "picker_2": {"/picker_2/tf": 3}}
    processes = {
        name: types.SimpleNamespace(
            report=lambda dropped=dropped: {
                "frames": {},
                "ros_dropped": dropped,
                "sensor_restarts": len(dropped),
                "ros_restarts": 1,
            }
        )
        for name, dropped in lost.items()
    }
    report = complete_report({"faults": {}, "sensor_restarts": 0, "ros_restarts": 0}, processes)
    assert (report["sensor_restarts"], report["ros_restarts"], report["ros_dropped"]) == (1, 2, {})
    assert {name: one["ros_dropped"] for name, one in report["robots"].items()} == lost
    alone = complete_report({"faults": {}}, {"picker": processes["picker_1"]})
    assert "robots" not in alone
    assert alone["ros_restarts"] == 1


def test_processes_that_were_started_again_are_shown(client) -> None:
    restarts = {"sensor_restarts": 2, "ros_restarts": 1}
    values = Status(client, RateLoop(0.01), sensors=lambda: restarts).current()
    assert status_line(values).endswith("  alone  restarted: 2 sensor processes, 1 ROS processes")
