"""The jitter buffer: its output does not depend on the order in which samples arrive."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.support.fake_client import FakeClient, tree_row
from vinesim.core import frames
from vinesim.net.codec.control import Hello, decode_time, encode_time
from vinesim.net.replication import dead_reckoning
from vinesim.net.replication.jitter_buffer import MAX_DELAY, MAX_SAMPLES, JitterBuffer
from vinesim.net.replication.replicator import Replicator
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.values import RobotUpdate

times = st.lists(st.integers(0, 200), min_size=1, max_size=40, unique=True).map(
    lambda ticks: [tick / 100.0 for tick in ticks]
)


def sample(time: float) -> tuple[float, np.ndarray, np.ndarray]:
    return time, np.array([np.sin(3.0 * time), time]), np.array([3.0 * np.cos(3.0 * time), 1.0])


def filled(delay: float, order: list[float]) -> JitterBuffer:
    buffer = JitterBuffer(delay)
    for time in order:
        buffer = buffer.insert(*sample(time))
    return buffer


@given(times, st.data())
def test_order_and_repetition_of_samples_do_not_matter(sent, data):
    shuffled = data.draw(st.permutations(sent))
    again = data.draw(st.lists(st.sampled_from(sent), max_size=10))
    one = filled(0.1, sorted(sent))
    other = filled(0.1, shuffled + again)
    for now in np.linspace(-0.5, 3.0, 30):
        np.testing.assert_array_equal(one.sample(now), other.sample(now))


@given(times, st.floats(0.0, MAX_DELAY))
def test_output_interpolates_the_samples(sent, delay):
    buffer = filled(delay, sent)
    sent = sorted(sent)
    for time in sent:
        np.testing.assert_allclose(buffer.sample(time + delay), sample(time)[1], atol=1e-9)
    for a, b in itertools.pairwise(sent):
        middle = buffer.sample(0.5 * (a + b) + delay)
        low, high = np.sort([sample(a)[1], sample(b)[1]], axis=0)
        assert (middle >= low - 1e-9).all()
        assert (middle <= high + 1e-9).all()


@given(st.integers(0, 2**31), st.floats(0.02, 0.3))
def test_jitter_below_the_delay_does_not_change_the_output(seed, delay):
    """The same samples with two sets of delays, all below that of the buffer: the output is the same at every time."""
    rng = np.random.default_rng(seed)
    sent = np.arange(60) / 60.0
    # the output is interpolated from samples sent before and after now - delay: the later one needs a period more
    arrivals = [sent + rng.uniform(0.0, max(delay - 1.0 / 60.0, 0.0), len(sent)) for _ in range(2)]
    for now in np.linspace(delay, 0.95, 40):
        output = [filled(delay, [float(t) for t in sent[arrival <= now + 1e-12]]).sample(now) for arrival in arrivals]
        np.testing.assert_allclose(output[0], output[1], atol=1e-12)


@given(times, st.floats(0.0, 5.0))
def test_output_after_the_newest_sample_is_extrapolated_up_to_the_limit(sent, later):
    buffer = filled(0.05, sent)
    time, state, rate = sample(max(sent))
    expected = state + rate * min(later, dead_reckoning.MAX_EXTRAPOLATION)
    np.testing.assert_allclose(buffer.sample(time + 0.05 + later), expected, atol=1e-9)


def test_old_samples_are_dropped_and_invalid_delays_refused():
    buffer = filled(0.1, [tick / 60.0 for tick in range(500)])
    assert len(buffer.times) == len(buffer.states) == len(buffer.rates) == MAX_SAMPLES
    assert buffer.times[-1] == 499 / 60.0
    with pytest.raises(ValueError, match="jitter buffer of 900 ms: give 0 to 500 ms"):
        JitterBuffer(0.9)
    with pytest.raises(ValueError, match="jitter buffer"):
        JitterBuffer(-0.1)


def test_a_buffered_robot_is_delayed_and_accurate():
    """Jitter of +-40 ms: with a buffer the joints are where they were 120 ms before, within the error of the clock;
    without one they are extrapolated, with a larger maximum error."""

    def errors(buffer: float) -> np.ndarray:
        hub = MemoryHub(delay=0.05, jitter=0.04, seed=3)
        server = hub.bus("server")
        server.declare_queryable("clock/*", lambda payload: encode_time(decode_time(payload)[0], hub.time))
        model = tree_row(1)
        hello = Hello("bob", digest="fake_clients", joints=0)
        ada = FakeClient(hub.bus("ada"), model, (1.0, 0.0))
        bob = Replicator(hub.bus("bob"), hello, model, jitter_buffer=buffer)
        here = RobotUpdate("bob", 0.0, frames.pose([2.0, 0.0, 0.0]), np.zeros(6), np.zeros(0), np.zeros(0))
        differences = []
        for tick in range(400):
            hub.advance(0.01)
            ada.tick(hub.time)
            output = bob.receive(hub.time).robots.get("ada")
            bob.send(hub.time, here, read=ada.read)
            if tick > 200 and output is not None:
                then = ada.pose(hub.time - buffer)
                differences.append(np.abs(output.position - then.position).max())
                assert np.abs(output.velocity - then.velocity).max() < 0.2
        return np.array(differences)

    buffered = errors(0.12)
    extrapolated = errors(0.0)
    assert np.median(buffered) < 0.01
    assert buffered.max() < extrapolated.max()
