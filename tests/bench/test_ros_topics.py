"""The evaluation of ``vinesim bench ros``: lateness, losses and counts of messages that are known."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.bench.process_memory import ProcessHistory, ProcessSample
from vinesim.bench.ros_resets import growth_by_reset, reset_rows
from vinesim.bench.ros_topics import PERIOD, TOPICS, Arrivals, action_rows, delay_ms, loss_rows, share_on_time

STEP = round(1e9 * PERIOD)


def heard(count: int, late: dict[int, float] | None = None, lost: tuple[int, ...] = (), first: int = 1) -> Arrivals:
    """Messages every 10 ms, 2 ms on the way; some ``late`` by so many ms more, some ``lost``, by their number."""
    number = np.array([i for i in range(first, first + count) if i not in lost])
    extra = np.array([round(1e6 * (late or {}).get(int(i), 0.0)) for i in number])
    sent = 10**18 + number * STEP
    return Arrivals(sent + 2_000_000 + extra, sent, number * STEP, number)


def test_a_message_is_as_late_as_it_came_after_the_quickest() -> None:
    clock = heard(300)
    delays = delay_ms(heard(300, {50: 4.0, 60: 25.0}), clock)
    np.testing.assert_allclose(delays[[49, 59]], [4.0, 25.0], atol=1e-3)
    assert np.count_nonzero(delays > 1e-3) == 2
    slow = Arrivals(clock.arrival + 3_000_000, clock.sent, clock.stamp, clock.number)
    np.testing.assert_allclose(delay_ms(slow, clock), 3.0, atol=1e-3)


def test_lost_messages_are_not_on_time() -> None:
    clock = heard(300)
    messages = heard(300, {50: 9.9, 60: 25.0}, lost=(100, 101))
    assert share_on_time(delay_ms(messages, clock), 3.0) == pytest.approx(99.0)
    assert share_on_time(delay_ms(clock, clock), 3.0) == 100.0
    assert messages.lost == 2


def test_every_message_is_in_one_count() -> None:
    topics = {topic: heard(200, lost=(50, 60 + i), first=1 + i) for i, topic in enumerate(TOPICS)}
    rows = {
        row.case: row.value for row in loss_rows(topics, dict.fromkeys(TOPICS, 210), 0)
    }  # the last of each were sent and never came
    count = len(TOPICS)
    before = sum(range(count))
    after = sum(10 - i for i in range(count))
    assert rows["whole run: sent by the publisher's count"] == 210 * count
    assert rows["whole run: received"] == 198 * count
    assert rows["whole run: lost on the way, by gaps in the numbers"] == 2 * count
    assert rows["whole run: sent before the subscription was there"] == before
    assert rows["whole run: sent after the last that was received"] == after
    assert rows["whole run: in neither count"] == 0


def test_goals_that_ended_wrongly_are_not_counted_as_right() -> None:
    goal = {
        "kind": "goal",
        "off": 0.001,
        "wanted_velocity_off": 0.0,
        "velocity_off": 0.01,
        "waypoints": 2,
        "fastest": 1.0,
    }
    rows = [
        goal | {"right": True},
        goal | {"right": False, "off": 0.2},
        {"kind": "cancel", "right": True, "drift": 0.0},
        {"kind": "preempt", "right": True, "off": 0.0},
        {"kind": "end", "sent": 5, "known": 1, "s": 60.0},
    ]
    found = {row.case: row for row in action_rows(rows)}
    assert found["goals: right codes"].value == 1
    assert found["goals: right codes"].ratio == 0.5
    assert found["goals: farthest joint from its goal"].value == 0.2
    leaked = found["goals whose handles a server knows for good"]
    assert (leaked.value, leaked.peer_value) == (1, 0.0)


@pytest.mark.ros
def test_velocities_are_compared_where_the_joints_are_not_when() -> None:
    pytest.importorskip("rclpy")
    from vinesim.bench.goal_sender import Plan

    times = np.array([1.0, 2.5])
    positions = np.array([[0.4, -0.2], [0.1, 0.3]])
    plan = Plan("head_controller", ["a", "b"], times, positions, np.array([[0.3, -0.1], [0.0, 0.0]]))
    begin = np.array([0.0, 0.1])
    for time in (0.0, 0.313, 1.0, 2.2, 2.5):
        place, velocity = (values[0] for values in plan.at(begin, np.array([time])))
        assert plan.velocity_off(begin, place, velocity) < 5e-3
        assert plan.velocity_off(begin, place, velocity + np.array([0.0, 0.2])) > 0.15
    ahead = 1e-5  # the splines' velocity is the derivative of their position
    low, high = plan.at(begin, np.array([1.7 - ahead, 1.7 + ahead]))[0]
    np.testing.assert_allclose(plan.at(begin, np.array([1.7]))[1][0], (high - low) / (2.0 * ahead), atol=1e-6)
    np.testing.assert_allclose(plan.at(begin, np.r_[0.0, times])[0], [begin, *positions], atol=1e-12)


def test_what_a_reset_leaves_behind_is_counted() -> None:
    reset = {"right": True, "s": 0.4, "sensors_s": 0.3, "stamps_back": 0, "nodes": 3, "publishers": 70, "services": 20}
    leaks = ProcessHistory([float(i) for i in range(8)], [ProcessSample(90.0, 50.0 + 2.0 * i, 9, 40) for i in range(8)])
    assert growth_by_reset(leaks) == pytest.approx(2.0)
    rows = [reset] * 6 + [reset | {"right": False, "publishers": 71, "stamps_back": 1}] * 2
    found = {row.case: row.value for row in reset_rows(rows, {"client": leaks})}
    assert found["resets: world as in the beginning, goal aborted"] == 6
    assert found["resets: publishers in the ROS graph, more in the second half"] == 1
    assert found["resets: nodes in the ROS graph, more in the second half"] == 0
    assert found["resets: stamps that went back"] == 1
    assert found["resets: handles of client, more in the second half"] == 0
