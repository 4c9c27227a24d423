"""Laws of the clock of a world that waits for slow clients."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.net.pace import FREE_LAG, MIN_FACTOR, SILENCE, STOP_LAG, PaceReport, WorldClock, describe

PERIOD = 0.2
"""Between two reports [s]."""


class Client:
    """Steps as fast as its machine lets it, and reports nine tenths of that."""

    def __init__(self, name: str, capacity: float) -> None:
        self.name = name
        self.capacity = capacity
        self.time = 0.0
        self.is_stopped = False

    def run(self, clock: WorldClock, now: float) -> None:
        if not self.is_stopped:
            self.time = min(self.time + self.capacity * PERIOD, clock.time(now))
            clock.report(self.name, now, PaceReport(self.time, 0.9 * self.capacity, "steps"))


def run(clock: WorldClock, clients: list[Client], begin: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Factors, and how far the last client was behind at most [s], after each report."""
    factors = []
    behind = []
    for now in begin + PERIOD * np.arange(1, round(seconds / PERIOD) + 1):
        clock.advance(now)
        for client in clients:
            client.run(clock, now)
        factors.append(clock.factor)
        behind.append(max((clock.time(now) - client.time for client in clients), default=0.0))
    return np.array(factors), np.array(behind)


@pytest.mark.parametrize("capacity", [0.7, 0.3, 0.05])
def test_time_falls_within_two_seconds_to_what_the_slowest_can_follow(capacity: float) -> None:
    clock = WorldClock(0.0)
    clients = [Client("quick", 3.0), Client("slow", capacity)]
    factors, behind = run(clock, clients, 0.0, 20.0)
    assert (factors[10:] < 0.95 * capacity).all()
    assert factors[-1] == pytest.approx(0.9 * capacity, rel=0.01)
    assert behind.max() < STOP_LAG + 0.2
    assert behind[-1] < FREE_LAG
    assert clock.cause == "slow: steps"


def test_time_rises_slowly_and_does_not_swing() -> None:
    clock = WorldClock(0.0)
    client = Client("ada", 0.3)
    run(clock, [client], 0.0, 10.0)
    client.capacity = 3.0
    factors, _ = run(clock, [client], 10.0, 20.0)
    assert (np.diff(factors) >= 0.0).all()
    assert factors[10] < 0.7, "after two seconds"
    assert factors[-1] == 1.0
    assert clock.cause == ""


def test_time_that_is_real_time_stays_so() -> None:
    """A client that needs most of its time, and is late now and then by what messages take."""
    clock = WorldClock(0.0)
    client = Client("ada", 1.15)
    factors, _ = run(clock, [client], 0.0, 10.0)
    assert (factors == 1.0).all()
    assert clock.time(10.0) == pytest.approx(10.0, abs=1e-6)


def test_a_client_that_stops_slows_the_others_for_three_seconds_at_most() -> None:
    clock = WorldClock(0.0)
    ada = Client("ada", 2.0)
    bob = Client("bob", 2.0)
    run(clock, [ada, bob], 0.0, 5.0)
    bob.is_stopped = True
    factors, _ = run(clock, [ada], 5.0, 10.0)
    slow = PERIOD * np.flatnonzero(factors < 0.9)
    assert len(slow), "the clock waits for it first"
    assert factors.min() < 0.1
    assert slow.max() <= SILENCE + PERIOD
    assert clock.left_behind == ["bob"]
    bob.is_stopped = False
    bob.time = clock.time(15.0)  # it has skipped what it missed
    factors, _ = run(clock, [ada, bob], 15.0, 5.0)
    assert clock.left_behind == []
    assert factors.min() > 0.9


def test_a_clock_that_was_starved_itself_leaves_nobody_behind() -> None:
    """It got a processor once in two seconds only: so may its clients, which are not stopped."""
    clock = WorldClock(0.0)
    ada = Client("ada", 2.0)
    run(clock, [ada], 0.0, 5.0)
    for now in (7.0, 9.0, 11.0):
        clock.advance(now)
    assert clock.left_behind == []
    assert clock.time(11.0) - ada.time < STOP_LAG + 1.0, "but it waits for them"


def test_a_client_that_comes_back_far_behind_is_not_waited_for() -> None:
    clock = WorldClock(0.0)
    ada = Client("ada", 2.0)
    bob = Client("bob", 2.0)
    run(clock, [ada, bob], 0.0, 5.0)
    run(clock, [ada], 5.0, 10.0)
    bob.capacity = 0.5
    factors, _ = run(clock, [ada, bob], 15.0, 5.0)
    assert clock.left_behind == ["bob"]
    assert factors[2:].min() == 1.0


def test_a_client_that_is_late_although_it_says_otherwise_brakes_the_clock() -> None:
    clock = WorldClock(0.0)
    for number in range(1, 26):
        clock.report("ada", PERIOD * number, PaceReport(0.1 * PERIOD * number, 2.0, "steps"))
    assert clock.time(5.0) - 0.5 < STOP_LAG + 0.2
    assert clock.cause == "ada: behind"


def test_those_who_leave_are_not_waited_for() -> None:
    clock = WorldClock(0.0)
    client = Client("ada", 0.1)
    run(clock, [client], 0.0, 5.0)
    clock.forget("ada")
    factors, _ = run(clock, [], 5.0, 20.0)
    assert factors[-1] == 1.0


def test_time_never_stands_nor_runs_back() -> None:
    clock = WorldClock(0.0, 1e6)
    random = np.random.default_rng(4)
    before = 1e6
    for number in range(1, 400):
        now = 0.1 * number
        clock.report("ada", now, PaceReport(1e6 + random.uniform(0.0, now), random.uniform(0.0, 3.0)))
        assert before + 0.99 * 0.1 * MIN_FACTOR <= clock.time(now) <= before + 0.1 + 1e-9
        before = clock.time(now)


def test_a_fixed_factor_waits_for_nobody() -> None:
    clock = WorldClock(0.0, 0.0, 0.5)
    for number in range(1, 50):
        clock.report("ada", 0.1 * number, PaceReport(0.0, 0.0, "steps"))
    assert clock.time(10.0) == pytest.approx(5.0, abs=0.1)
    assert clock.factor == 0.5


def test_a_pace_is_described_only_below_real_time() -> None:
    assert describe(1.0, "") == ""
    assert describe(0.431, "ada: sensors") == "0.43 of real time (ada: sensors)"


def test_a_new_clock_goes_on_from_the_latest_time_that_clients_report_and_not_beyond_real_time() -> None:
    clock = WorldClock(0.0, 1000.0, open_until=10.0)
    assert clock.awaits_report(0.5)
    clock.report("bob", 1.0, PaceReport(200.0, 1.0))
    assert clock.time(1.0) == 200.0
    assert not clock.awaits_report(1.0)
    clock.report("ada", 2.0, PaceReport(300.0, 1.0))
    assert clock.time(2.0) == 300.0
    clock.report("bob", 3.0, PaceReport(201.0, 1.0))
    assert clock.time(3.0) > 300.0, "it does not go back"
    clock.report("eve", 3.0, PaceReport(1e12, 1.0))
    assert clock.time(3.0) == 1003.0
    clock.report("bob", 11.0, PaceReport(1011.0, 1.0))
    assert clock.time(11.0) < 1011.0, "later reports only brake it"
    hostile = WorldClock(0.0, 1000.0, open_until=10.0)
    hostile.report("eve", 1.0, PaceReport(-1e300, 1.0))
    assert hostile.time(1.0) == 0.0
