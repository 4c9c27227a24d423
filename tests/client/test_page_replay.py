"""A recording in a page: it pauses, goes back and forth, and shows at each time what was so then."""

import numpy as np
import pytest

from tests.support.recorded_pick import PICKED_AT, replay_of_a_pick
from tests.web.test_page_world import OnePage
from vinesim.web.array_message import decode
from vinesim.web.page_input import ReplayCommand

BEFORE = PICKED_AT - 0.6
AFTER = PICKED_AT + 0.6


@pytest.fixture(scope="module")
def picked(tmp_path_factory):
    replay, bunch = replay_of_a_pick(tmp_path_factory.mktemp("recorded") / "run.mcap")
    replay.world.scene()  # a page loads
    return replay, bunch


def play(replay, until):
    while replay.position < until - 1e-6:
        assert replay.step(OnePage())


def newest(replay, since=-1):
    """What a page that has drawn the tick ``since`` is sent."""
    found = replay.world.state(since)
    assert found is not None
    return decode(found[1])


def ask(replay, **changes):
    replay.take(ReplayCommand(**{"paused": True, "speed": 1.0} | changes))
    return replay.step(OnePage())


def test_a_recording_goes_to_the_times_that_a_page_asks_for(picked):
    replay, bunch = picked
    play(replay, BEFORE)
    before, arrays_before = newest(replay)
    assert len(arrays_before["picked"]) == 0
    play(replay, AFTER)
    after, arrays_after = newest(replay, before["tick"])
    assert arrays_after["picked"].tolist() == [bunch]

    assert not ask(replay)
    held = replay.position
    for _ in range(10):
        assert not replay.step(OnePage())
    assert replay.position == held
    paused, _ = newest(replay, after["tick"])
    assert paused["replay"]["paused"]

    assert not ask(replay, seek=BEFORE)
    again, arrays = newest(replay, paused["tick"])
    assert again["tick"] > paused["tick"]
    assert again["replay"]["jumps"] == after["replay"]["jumps"] + 1
    assert again["replay"]["position"] == pytest.approx(BEFORE, abs=0.02)
    assert len(arrays["picked"]) == 0, "the bunch hangs again"
    np.testing.assert_allclose(arrays["rigid_place"], arrays_before["rigid_place"], atol=0.01)
    tree = replay._spectator.model.body_tree[replay._spectator.model.bunch_body[bunch]]
    assert replay._spectator.model.tree_first[tree] in arrays["body"], "the page receives the bodies of its tree again"

    assert ask(replay, paused=False, seek=AFTER)
    assert newest(replay, again["tick"])[1]["picked"].tolist() == [bunch]


def test_speed_and_the_end(picked):
    replay, _ = picked
    ask(replay, seek=0.2)
    here = replay.position
    assert ask(replay, paused=False, speed=4.0)
    for _ in range(9):
        replay.step(OnePage())
    assert replay.position - here == pytest.approx(0.4, abs=0.01)
    while replay.step(OnePage()):
        pass
    assert replay.is_paused
    assert ask(replay, paused=False), "at the end it begins again"
    assert replay.position < 0.2
