"""The evaluation of ``vinesim bench ros``: lateness, losses and counts of messages that are known."""

from __future__ import annotations

import numpy as np
import pytest

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
    before, after = sum(range(count)), sum(10 - i for i in range(count))
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
        goal | {"right": True}, goal | {"right": False, "off": 0.2}, {"kind": "cancel", "right": True, "drift": 0.0},
        {"kind": "preempt", "right": True, "off": 0.0}, {"kind": "end", "sent": 5, "known": 1, "s": 60.0},
    ]  # fmt: skip
    found = {row.case: row for row in action_rows(rows)}
    assert found["goals: right codes"].value == 1
    assert found["goals: right codes"].ratio == 0.5
    assert found["goals: farthest joint from its goal"].value == 0.2
    leaked = found["goals whose handles a server knows for good"]
    assert (leaked.value, leaked.peer_value) == (1, 0.0)
