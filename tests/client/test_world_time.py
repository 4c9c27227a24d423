"""World time: stamps of clients that started at different moments compare, never run back, and are smooth."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.client.world_time import MAX_LAG, OffsetHistory, WorldTime

DT = 0.01


def stamps(clock: np.ndarray) -> np.ndarray:
    """What a client stamps its steps with that begin at these times of the server's clock [step] s."""
    world = WorldTime(DT)
    found = []
    for step, now in enumerate(clock):
        world.follow(step * DT, now)
        found.append(step * DT + world.offset)
    return np.array(found)


def test_clients_agree_and_jitter_is_smoothed() -> None:
    """Two that started 7 s apart, with steps late by up to 8 ms: 2 ms apart, and steps of 10 ms within 0.2 ms."""
    random = np.random.default_rng(3)
    begin = 1.7e9
    one = begin + np.arange(3000) * DT + random.exponential(2e-3, 3000).clip(0.0, 8e-3)
    other = begin + 7.0 + np.arange(2300) * DT + random.exponential(2e-3, 2300).clip(0.0, 8e-3)
    first = stamps(one)
    second = stamps(other)
    apart = first[1200:] - second[500:2300]
    assert np.abs(apart).max() < 2e-3
    assert np.abs(np.diff(first[300:]) - DT).max() < 2e-4


def test_a_slow_client_keeps_up_and_no_time_runs_back() -> None:
    """At 70 % of real time, and after it stood for 3 s, stamps are at most 50 ms behind and always rise."""
    clock = 100.0 + np.cumsum(np.full(2000, DT / 0.7))
    clock[1000:] += 3.0
    found = stamps(clock)
    assert (np.diff(found) > 0.0).all()
    assert (clock - found).max() <= MAX_LAG + 1e-9
    assert (found - clock).max() < 1e-3


def test_a_client_that_catches_up_is_not_ahead() -> None:
    """25 steps in 75 ms, after it stood for 250 ms: stamps are at most 60 ms ahead, and always rise."""
    passed = np.full(2000, DT)
    passed[1000] = 0.25
    passed[1001:1025] = 3e-3
    clock = 100.0 + np.cumsum(passed)
    found = stamps(clock)
    assert (np.diff(found) > 0.0).all()
    assert (clock - found).max() <= MAX_LAG + 1e-9
    assert (found - clock).max() < MAX_LAG + DT


def test_a_clock_that_is_set_back_a_little_is_waited_for() -> None:
    """Two seconds back (another server): time goes on at nine tenths of its rate until it is met, and never back."""
    clock = 100.0 + np.arange(4000) * DT
    clock[500:] -= 2.0
    found = stamps(clock)
    rise = np.diff(found)
    assert rise.min() > 0.89 * DT
    assert abs(found[-1] - clock[-1]) < 0.05


def test_without_a_server_it_is_simulated_time() -> None:
    assert WorldTime(DT).offset == 0.0
    assert not WorldTime(DT).is_shared


def test_what_is_ready_late_is_stamped_as_its_step_was() -> None:
    """Also where the client stood for 250 ms and then caught up, so that its offset jumped up and fell since."""
    passed = np.full(400, DT)
    passed[200], passed[201:225] = 0.25, 3e-3
    world = WorldTime(DT)
    history = OffsetHistory(len(passed))
    found = []
    for step, now in enumerate(100.0 + np.cumsum(passed)):
        world.follow(step * DT, now)
        history.add(step * DT, world.offset)
        found.append(step * DT + world.offset)
    late = [history.world_time(step * DT) for step in range(400)]
    assert late == pytest.approx(found, abs=1e-9)
    between = [history.world_time(time) for time in np.linspace(-0.1, 4.1, 1000)]
    assert (np.diff(between) > 0.0).all()


def test_offsets_after_a_time_that_is_set_back_are_forgotten() -> None:
    history = OffsetHistory(4)
    for time, offset in ((0.0, 7.0), (1.0, 7.0), (2.0, 7.0), (0.5, 9.0)):
        history.add(time, offset)
    assert [history.world_time(time) for time in (0.0, 0.5, 2.0)] == [7.0, 9.5, 11.0]
