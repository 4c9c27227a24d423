"""A crowd of actors with bodies in one world: more than had a collision bit of their own once."""

from __future__ import annotations

import pytest

from benchmarks.many_actors import run_crowd
from vinesim.robot.description.loader import load_description


@pytest.mark.long
def test_all_clients_of_a_crowd_agree_on_what_its_actors_moved():
    """26 robots and people of two clients, each with a body on both: every bunch was picked, every box pushed."""
    found = run_crowd(26, load_description("vinebot"), clients=2)
    assert (found.bodies, found.owned, found.faults) == (26, 0, {})
    assert found.objects >= 26 + 13, "bunches and boxes that were moved have the same record on all clients"
    assert found.position < 5e-3, "bodies settle by themselves, and beside copies of robots that lean on them"
