"""What ``vinesim bench sync`` measures, on one delay: what the whole design is for."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.bench import replication_delay
from vinesim.bench.replication_delay import buffered, count_reversals, extrapolation


def test_a_touch_moves_at_once_here_and_late_through_an_authority_far_away():
    """F12, F68, F81, F87."""
    rows = replication_delay.one_push(0.05)
    assert rows.seen(0) == 0.0, "the tick of the touch is the tick of the motion"
    assert 0.04 <= rows.seen(1) <= 0.08, "another sees it one way later"
    assert rows.seen(2) >= 0.10, "an authority far away answers a round trip later"
    assert np.percentile(rows.divergence(), 95) < 10.0
    _, (told, held) = extrapolation(rows, 0.1)
    assert told < 0.5 * held, "a robot known 100 ms late is known twice as well with its velocities"
    now, path = buffered(rows, 0.05, 0.02, 0.1)
    bare, _ = buffered(rows, 0.05, 0.02, 0.0)
    assert path < 0.2 * bare < bare < now, "a buffer is on the path, and late"


@pytest.mark.parametrize(("signal", "count"), [([0, 1, 0, 1], 2), ([0, 0.5, 0.2, 0.6], 0), ([0, 1, 2, 3], 0), ([1], 0)])
def test_turns_are_counted_beyond_their_least(signal, count):
    assert count_reversals(np.array(signal, float), 0.9) == count
