import time

import numpy as np
import pytest

from tests.support.waiting import wait
from vinesim.client import rate_loop as module
from vinesim.client.pace import LONGEST_GAP, Limit, OwnPace, RealTime
from vinesim.client.rate_loop import RateLoop


class FakeTime:
    """A clock that advances only by sleep and work."""

    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture
def clock(monkeypatch):
    fake = FakeTime()
    monkeypatch.setattr(module, "time", fake)
    return fake


def own_pace(clock):
    loop = RateLoop(0.01, max_lag=np.inf)
    loop.clock = OwnPace("picker", clock.now, loop.report)
    return loop


def run(loop, clock, works):
    starts = []
    for work in works:
        loop.begin()
        starts.append(clock.now)
        clock.now += work
        loop.end()
    return np.array(starts) - starts[0]


def test_a_late_tick_does_not_shift_later_deadlines(clock):
    """It is made up for at 200 steps a second."""
    loop = RateLoop(0.01)
    starts = run(loop, clock, [0.001, 0.025, 0.001, 0.001, 0.001, 0.001])
    assert starts == pytest.approx([0.0, 0.01, 0.035, 0.04, 0.045, 0.05])
    assert loop.overruns == 1
    assert loop.dropped == 0
    assert loop.hz == pytest.approx(100.0)


def test_real_time_factor_is_simulated_over_wall_time(clock):
    loop = RateLoop(0.01)
    run(loop, clock, [0.002] * 101)
    assert loop.real_time_factor == pytest.approx(1.01 / 1.002)
    slow = RateLoop(0.01)
    run(slow, clock, [0.02] * 20)
    assert slow.real_time_factor == pytest.approx(0.5)
    assert slow.overruns == 20


def test_a_lower_factor_spaces_the_steps_and_their_deadlines(clock):
    """At a quarter of real time a step of 10 ms is due every 40 ms, and 25 ms of work are no overrun."""
    loop = RateLoop(0.01, RealTime(0.25))
    starts = run(loop, clock, [0.025, 0.1, 0.001, 0.001, 0.001])
    assert starts == pytest.approx([0.0, 0.04, 0.14, 0.145, 0.16])
    assert loop.overruns == 1
    run(loop, clock, [0.002] * 100)
    assert loop.real_time_factor == pytest.approx(0.25, rel=0.01)
    log = loop.log().between(0.0, np.inf)
    assert log["overruns"] == loop.overruns
    assert log["real_time_factor"] == pytest.approx(0.25, rel=0.01)
    clock.now += 40.0
    run(loop, clock, [0.0] * 2)
    assert loop.dropped in (999, 1000)


def test_steps_of_a_long_stall_are_skipped_and_counted(clock):
    loop = RateLoop(0.01)
    starts = run(loop, clock, [0.001, 3.0] + [0.001] * 10)
    assert loop.dropped in (298, 299)
    assert np.diff(starts)[-5:] == pytest.approx([0.01] * 5)


class AskedClock:
    """A world's clock that is known only since its last answer, and told again ``answer_after`` s after a stop."""

    cause = ""
    factor = 1.0

    def __init__(self, fake, answer_after):
        self.fake = fake
        self.answer_after = answer_after
        self.kept = fake.now
        self.stopped_at = None
        self.slower = 0.0

    def time(self, now):
        return now - (self.slower if self.is_current(now) else 0.0)

    def is_current(self, now):
        return self.stopped_at is None or now - self.stopped_at >= self.answer_after

    def keep(self, now):
        if now - self.kept > 1.0:
            self.stopped_at = now
            self.slower = 2.5
        self.kept = now


@pytest.mark.parametrize(("answer_after", "skipped"), [(0.03, 750), (1e9, 1300)])
def test_a_stopped_client_skips_to_the_time_that_the_world_has_now(clock, answer_after, skipped):
    """The world ran slower while the client was stopped for 10 s, so what the client extrapolates is 2.5 s too far.

    It waits for an answer and then runs at once in real time. A server that does not answer is waited for
    for three seconds.
    """
    loop = RateLoop(0.01, AskedClock(clock, answer_after), max_lag=1.0)
    run(loop, clock, [0.001] * 20)
    clock.now += 10.0
    starts = run(loop, clock, [0.001] * 20)
    assert loop.dropped == pytest.approx(skipped, abs=6)
    assert np.diff(starts)[10:] == pytest.approx([0.01] * 9)


def test_a_client_alone_on_a_slow_machine_slows_its_time_and_skips_nothing(clock):
    """Steps that take 25 ms of wall time follow each other evenly, at 0.36 of real time after two seconds."""
    loop = own_pace(clock)
    run(loop, clock, [0.025] * 400)
    starts = run(loop, clock, [0.025] * 100)
    assert loop.dropped == 0
    assert loop.target_factor == pytest.approx(0.36, abs=0.01)
    assert np.diff(starts) == pytest.approx(0.01 / loop.target_factor, abs=0.002)
    assert loop.clock.cause == "picker: steps"


@pytest.mark.parametrize("stall", [0.4, 2.5, 600.0])
def test_a_client_alone_stops_its_time_while_it_is_stalled_and_skips_nothing(clock, stall):
    """Nobody else follows its time. After the stall it is late by a quarter of a second at most."""
    loop = own_pace(clock)
    run(loop, clock, [0.002] * 100)
    since = loop.next_time
    run(loop, clock, [stall, *[0.002] * 99])
    assert loop.dropped == 0
    assert loop.next_time - since == pytest.approx(1.0)
    assert loop.clock.time(clock.now) - loop.next_time < LONGEST_GAP


def test_a_client_alone_that_makes_a_step_in_five_seconds_skips_nothing(clock):
    """The clock goes at a hundredth of real time at least, five times as fast as this client."""
    loop = own_pace(clock)
    run(loop, clock, [0.002])
    since = loop.next_time
    run(loop, clock, [5.0] * 300)
    assert loop.dropped == 0
    assert loop.next_time - since == pytest.approx(3.0)


def test_its_time_rises_again_slowly_and_does_not_swing(clock):
    loop = own_pace(clock)
    run(loop, clock, [0.025] * 100)
    factors = []
    for _ in range(2000):
        run(loop, clock, [0.004])
        factors.append(loop.target_factor)
    assert factors[-1] == 1.0
    assert (np.diff(factors)[100:] >= 0.0).all()
    assert np.argmax(np.array(factors) > 0.9) * 0.01 > 2.0, "it rises over several seconds"


def test_what_holds_a_step_slows_time_and_is_its_cause(clock):
    """A part that lets a step begin only every 50 ms: time passes at a fifth, whatever the steps themselves take."""
    loop = own_pace(clock)
    free = [clock.now]
    loop.hold = lambda: "" if clock.now >= free[0] else "sensors"
    for _ in range(200):
        run(loop, clock, [0.001])
        free[0] = max(free[0], clock.now - 0.05) + 0.05
    assert loop.dropped == 0
    assert loop.target_factor == pytest.approx(0.2, rel=0.15)
    assert loop.clock.cause == "picker: sensors"


def test_a_part_that_knows_its_limit_slows_time_before_it_holds_a_step(clock):
    loop = own_pace(clock)
    loop.meter.limits.append(lambda: Limit(0.5, "sensors"))
    run(loop, clock, [0.001] * 300)
    assert loop.target_factor == pytest.approx(0.5)


def test_another_clock_is_followed_at_once_and_skips_nothing(clock):
    """As when the server is heard for the first time after the first step."""
    loop = RateLoop(0.01)
    run(loop, clock, [0.001] * 3)
    offset = 1.7e9
    loop.clock.time = lambda now: now + offset
    run(loop, clock, [0.001] * 3)
    assert loop.dropped == 0
    assert abs(loop.next_time - clock.now - offset) < 0.02


def test_a_clock_that_is_set_back_a_little_slows_the_steps_until_it_has_come(clock):
    loop = RateLoop(0.01)
    run(loop, clock, [0.001] * 3)
    behind = 2.0
    loop.clock.time = lambda now: now - behind
    starts = run(loop, clock, [0.001] * 3000)
    assert np.diff(starts).max() < 0.03, "no stop"
    assert loop.next_time - loop.clock.time(clock.now) < 0.06


def test_percentiles_are_those_of_the_work_time(clock):
    loop = RateLoop(0.01)
    run(loop, clock, [0.001] * 99 + [0.009])
    median, maximum = loop.work_ms(50, 100)
    assert median == pytest.approx(1.0)
    assert maximum == pytest.approx(9.0)


def test_steps_run_at_100_hz_by_the_real_clock():
    """F91: never faster, and again on time whenever the machine lets it; deadlines that are dropped are counted."""
    loop = RateLoop(0.01)
    start = time.monotonic()
    late = []

    def step() -> bool:
        loop.begin()
        lateness = time.monotonic() - start - 0.01 * (loop.ticks + loop.dropped)
        late.append(lateness)
        loop.end()
        return loop.ticks > 100 and lateness < 0.005

    wait(step, "a step on time after a second")
    assert min(late) > -1e-3


def test_a_log_gives_the_statistics_of_a_part_of_the_run(clock, tmp_path):
    loop = RateLoop(0.01)
    run(loop, clock, [0.002] * 50 + [0.015] + [0.004] * 50)
    loop.log().save(tmp_path / "ticks.npz")
    log = module.TickLog.load(tmp_path / "ticks.npz")
    start = log.begins[0]
    early = log.between(start, start + 0.4)
    late = log.between(start + 0.6, np.inf)
    assert early["tick_p99_ms"] == pytest.approx(2.0, rel=1e-3)
    assert late["tick_p50_ms"] == pytest.approx(4.0, rel=1e-3)
    assert late["tick_hz"] == pytest.approx(100.0)
    assert log.between(start, np.inf)["overruns"] == 1
    with pytest.raises(ValueError, match="0 steps"):
        log.between(start - 2.0, start - 1.0)


def test_a_log_that_is_full_keeps_the_newest_in_order(clock):
    loop = RateLoop(0.01, capacity=8)
    starts = run(loop, clock, [0.001] * 11)
    log = loop.log()
    assert log.begins - log.begins[0] == pytest.approx(starts[3:] - starts[3])


def test_there_is_no_rate_before_the_second_step():
    """In the first step its begin lies after the start, and no period has passed."""
    loop = RateLoop(0.01)
    assert loop.hz == 0.0
    loop.begin()
    assert loop.hz == 0.0
    loop.end()
    loop.begin()
    assert 0.0 <= loop.hz <= 100.5
