"""``python -m benchmarks link`` on two clients whose people pull at one bunch, from records with a known answer."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.two_pullers import Seen, outcome

BEGIN = 100.0
SECONDS = 27.0


def seen(way, owner: str, *, phase: float = 0.0, held: bool = True) -> Seen:
    """A client at 100 Hz whose bunch has the way ``way(seconds)`` [m]."""
    clock = BEGIN - 5.0 + phase + np.arange(0.0, SECONDS + 5.0, 0.01)
    names = np.full(len(clock), owner)
    flags = np.zeros(len(clock), bool)
    return Seen(clock, way(clock - BEGIN), names, flags | held, flags)


def test_clients_that_agree_and_rest():
    """One is 4 ms out of step, and 1 mm off while both pull."""
    first = seen(lambda t: 0.01 * (t > 6.0) * (t < 8.0), "ada")
    second = seen(lambda t: 0.011 * (t > 6.0) * (t < 8.0), "ada", phase=0.004)
    found = outcome(BEGIN, {"ada": first, "bob": second})
    assert (found.owners, found.held, found.alone) == (("ada",), True, 0.0)
    assert found.moving == pytest.approx(1e-3)
    assert found.resting == found.off == max(found.spans) == 0.0
    assert found.rate == pytest.approx(100.0, rel=0.01)


def test_clients_with_two_owners_that_oscillate_ever_more():
    ways = {"ada": lambda t: 0.002 * t * np.sin(5.0 * t), "bob": lambda t: -0.002 * t * np.sin(5.0 * t)}
    found = outcome(BEGIN, {name: seen(way, name, held=name == "ada") for name, way in ways.items()})
    assert (found.owners, found.held) == (("ada", "bob"), False)
    assert found.spans[1] > 1.3 * found.spans[0]
    assert found.resting > 0.05
    assert found.off == pytest.approx(0.002 * SECONDS, rel=0.05)
