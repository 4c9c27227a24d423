"""``python -m benchmarks sync`` at one delay."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import replication_delay
from benchmarks.replication_delay import buffered, count_reversals, extrapolation


@pytest.mark.long
def test_local_contact_acts_at_once_and_a_remote_authority_a_round_trip_later():
    """F12, F68, F81, F87."""
    rows = replication_delay.one_push(0.05)
    assert rows.seen(0) == 0.0, "the bunch moves in the tick of contact"
    assert 0.04 <= rows.seen(1) <= 0.08, "another client displays it one delay later"
    assert rows.seen(2) >= 0.10, "with a remote authority it moves a round trip later"
    assert np.percentile(rows.divergence(), 95) < 10.0
    _, (extrapolated, held) = extrapolation(rows, 0.1)
    assert extrapolated < 0.5 * held, "extrapolation halves the error at 100 ms delay"
    error_now, path_error = buffered(rows, 0.05, 0.02, 0.1)
    unbuffered, _ = buffered(rows, 0.05, 0.02, 0.0)
    assert path_error < 0.2 * unbuffered < unbuffered < error_now, "a buffer is accurate along the path, and delayed"


@pytest.mark.parametrize(("signal", "count"), [([0, 1, 0, 1], 2), ([0, 0.5, 0.2, 0.6], 0), ([0, 1, 2, 3], 0), ([1], 0)])
def test_reversals_above_a_threshold_are_counted(signal, count):
    assert count_reversals(np.array(signal, float), 0.9) == count
