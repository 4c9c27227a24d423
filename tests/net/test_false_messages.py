"""Broken and well-formed false messages to a client with physics and to the server's store: no law is broken.

Few here; ``python -m benchmarks fuzz --messages N --false-messages N`` sends as many as are wanted.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.message_fuzz import attack
from benchmarks.support.false_messages import send_false_messages
from benchmarks.support.fuzz_world import ATTACKER, FuzzWorld, LawBroken
from tests.support.long_rows import long


@pytest.mark.parametrize(("kind", "is_stranger"), [("human", False), *long(("robot", False), ("human", True))])
def test_broken_messages_break_no_law(kind, is_stranger):
    done = attack(3_000, seed=5, kind=kind, is_stranger=is_stranger)
    assert done.sent == 3_000
    assert done.arrived > 1_500
    assert done.records > 200
    assert (done.malformed > 500) != is_stranger, "a stranger's messages are dropped before they are decoded"


@pytest.mark.parametrize("kind", ["human", *long("robot")])
def test_well_formed_false_messages_break_no_law(kind):
    assert send_false_messages(20, seed=2, kind=kind) > 30


def test_the_laws_notice_what_they_forbid():
    with FuzzWorld() as world:
        world.check()
        assert ATTACKER in world.client.remote_actors
        state = world.client.physics.state
        state.joint_qd[3, 1] = np.nan
        with pytest.raises(LawBroken, match="not finite"):
            world.check()
        state.joint_qd[3, 1] = 0.0
        cluster = int(world.model.tree_first[1] + world.model.tree_core[1])
        state.body_cut[cluster] = True
        with pytest.raises(LawBroken, match="berry cluster"):
            world.check()
        state.body_cut[cluster] = False
        world.store.counters.errors = 1
        with pytest.raises(LawBroken, match="store"):
            world.check()
