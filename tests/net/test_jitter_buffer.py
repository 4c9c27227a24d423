"""The buffer against jitter: what it shows does not depend on how the samples came."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vinesim import frames
from vinesim.bench.support.fake_client import FakeClient, tree_row
from vinesim.net.codec import messages
from vinesim.net.codec.messages import Hello
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
def test_any_order_and_any_repetition_shows_the_same(sent, data):
    shuffled = data.draw(st.permutations(sent))
    again = data.draw(st.lists(st.sampled_from(sent), max_size=10))
    one, other = filled(0.1, sorted(sent)), filled(0.1, shuffled + again)
    for now in np.linspace(-0.5, 3.0, 30):
        np.testing.assert_array_equal(one.sample(now), other.sample(now))


@given(times, st.floats(0.0, MAX_DELAY))
def test_at_the_time_of_a_sample_it_is_shown_and_between_two_what_lies_between(sent, delay):
    buffer, sent = filled(delay, sent), sorted(sent)
    for time in sent:
        np.testing.assert_allclose(buffer.sample(time + delay), sample(time)[1], atol=1e-9)
    for a, b in itertools.pairwise(sent):
        middle = buffer.sample(0.5 * (a + b) + delay)
        low, high = np.sort([sample(a)[1], sample(b)[1]], axis=0)
        assert (middle >= low - 1e-9).all()
        assert (middle <= high + 1e-9).all()


@given(st.integers(0, 2**31), st.floats(0.02, 0.3))
def test_jitter_within_the_delay_is_not_seen(seed, delay):
    """Two journeys of the same samples, all of them shorter than the buffer: at every instant the same is shown."""
    chance = np.random.default_rng(seed)
    sent = np.arange(60) / 60.0
    # what is shown now lies between samples sent before now - delay and after it: the later one needs a period more
    arrivals = [sent + chance.uniform(0.0, max(delay - 1.0 / 60.0, 0.0), len(sent)) for _ in range(2)]
    for now in np.linspace(delay, 0.95, 40):
        shown = [
            filled(delay, [float(t) for t in sent[arrived <= now + 1e-12]]).sample(now) for arrived in arrivals
        ]  # fmt: skip
        np.testing.assert_allclose(shown[0], shown[1], atol=1e-12)


@given(times, st.floats(0.0, 5.0))
def test_after_the_newest_it_goes_on_for_as_long_as_anybody_extrapolates(sent, later):
    buffer = filled(0.05, sent)
    time, state, rate = sample(max(sent))
    expected = state + rate * min(later, dead_reckoning.MAX_EXTRAPOLATION)
    np.testing.assert_allclose(buffer.sample(time + 0.05 + later), expected, atol=1e-9)


def test_it_forgets_what_is_old_and_refuses_what_is_too_long():
    buffer = filled(0.1, [tick / 60.0 for tick in range(500)])
    assert len(buffer.times) == len(buffer.states) == len(buffer.rates) == MAX_SAMPLES
    assert buffer.times[-1] == 499 / 60.0
    with pytest.raises(ValueError, match="jitter buffer of 900 ms: give 0 to 500 ms"):
        JitterBuffer(0.9)
    with pytest.raises(ValueError, match="jitter buffer"):
        JitterBuffer(-0.1)


def test_an_exchange_with_a_buffer_shows_a_swinging_robot_late_and_exactly():
    """Jitter of 40 ms to both sides: with a buffer the joints are where they were 120 ms before, as far as
    the clock is known; without one they are extrapolated, and the worst of it is worse."""

    def errors(buffer: float) -> np.ndarray:
        hub = MemoryHub(delay=0.05, jitter=0.04, seed=3)
        server = hub.bus("server")
        server.declare_queryable("clock", lambda asked: messages.encode_time(messages.decode_time(asked)[0], hub.time))
        model = tree_row(1)
        hello = Hello("bob", digest="fake_clients", joints=0)
        ada = FakeClient(hub.bus("ada"), model, (1.0, 0.0))
        bob = Replicator(hub.bus("bob"), hello, model, jitter_buffer=buffer)
        here = RobotUpdate("bob", 0.0, frames.pose([2.0, 0.0, 0.0]), np.zeros(6), np.zeros(0), np.zeros(0))
        found = []
        for tick in range(400):
            hub.advance(0.01)
            ada.tick(hub.time)
            shown = bob.receive(hub.time).robots.get("ada")
            bob.send(hub.time, here, read=ada.read)
            if tick > 200 and shown is not None:
                then = ada.pose(hub.time - buffer)
                found.append(np.abs(shown.position - then.position).max())
                assert np.abs(shown.velocity - then.velocity).max() < 0.2
        return np.array(found)

    with_, without = errors(0.12), errors(0.0)
    assert np.median(with_) < 0.01
    assert with_.max() < without.max()
