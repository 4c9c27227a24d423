"""Clock synchronisation: wrong by at most half the shortest round trip, and monotonic once it runs."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from vinesim.net.replication import clock_sync
from vinesim.net.replication.clock_sync import ClockEstimate, Ping

delays = st.floats(0.001, 0.2)


@given(st.floats(-1e6, 1e6), st.lists(st.tuples(delays, delays), min_size=1, max_size=8))
def test_the_estimate_is_wrong_by_at_most_half_the_shortest_round_trip(offset, delays_each_way):
    pings = tuple(Ping(k, k + there + offset, k + there + back) for k, (there, back) in enumerate(delays_each_way))
    error = abs(clock_sync.estimate(pings) - offset)
    assert error <= 0.5 * min(there + back for there, back in delays_each_way) + 1e-6


def test_the_first_pings_set_the_offset_and_later_ones_slew_it():
    state = ClockEstimate()
    for k in range(8):
        state = state.with_ping(Ping(k, k + 100.0 + 0.01, k + 0.02))
    assert abs(state.offset - 100.0) < 1e-9
    better = state
    for k in range(8, 16):
        better = better.with_ping(Ping(k, k + 100.2, k))
    assert better.offset == state.offset
    assert abs(better.advanced(1.0).offset - (state.offset + 0.01)) < 1e-9
    assert abs(better.advanced(100.0).offset - 100.2) < 1e-9


def test_a_large_offset_change_is_applied_at_once():
    assert clock_sync.slew(0.0, 1e9, 0.01) == 1e9
    assert clock_sync.slew(0.0, 0.4, 0.01) == 1e-4


@given(st.integers(0, 2**31))
def test_network_time_increases_while_it_is_slewed(seed):
    rng = random.Random(seed)
    state = ClockEstimate()
    for k in range(8):
        state = state.with_ping(Ping(k, k + 5.0 + rng.uniform(0, 0.02), k + 0.02))
    last = -1.0
    now = 8.0
    for _ in range(200):
        if rng.random() < 0.1:
            there = rng.uniform(0, 0.1)
            back = rng.uniform(0, 0.1)
            state = state.with_ping(Ping(now, now + there + 5.0 + rng.uniform(-0.05, 0.05), now + there + back))
        state = state.advanced(0.01)
        now += 0.01
        assert now + state.offset > last
        last = now + state.offset


def test_without_pings_the_offset_is_zero():
    assert clock_sync.estimate(()) is None
    assert ClockEstimate().advanced(5.0) == ClockEstimate()
