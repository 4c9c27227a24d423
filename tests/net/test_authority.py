"""Laws of ownership: a total order, so every order, repetition and delay ends with one owner everywhere."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vinesim.net.replication import authority
from vinesim.net.replication.authority import NOBODY, SEQUENCE_COUNT, UNTOUCHED, Claim

sequence = st.integers(0, SEQUENCE_COUNT - 1)
name = st.sampled_from([NOBODY, "ada", "bob", "cleo"])
claims = st.builds(Claim, sequence, sequence, name)
# claims whose sequences lie within less than half of the circle of each other, somewhere on it: also across the wrap
close = st.builds(
    lambda start, steps: [
        Claim((start + o) % SEQUENCE_COUNT, (start + a) % SEQUENCE_COUNT, owner) for o, a, owner in steps
    ],
    sequence,
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 30_000), name), min_size=1, max_size=6),
)


def hold(heard: list[Claim], held: Claim) -> Claim:
    for claim in heard:
        held = claim if authority.wins(claim, held) else held
    return held


@given(claims, claims)
def test_of_two_claims_exactly_one_wins(a, b):
    assert authority.wins(a, b) + authority.wins(b, a) == (a != b)


@given(close)
def test_winning_is_transitive(several):
    for a, b, c in itertools.permutations(several, 3):
        if authority.wins(a, b) and authority.wins(b, c):
            assert authority.wins(a, c)


@given(close, st.data())
def test_any_order_and_any_repetition_end_with_the_same_owner(several, data):
    first, rest = several[0], several[1:]
    shuffled = data.draw(st.permutations(rest))
    repeated = shuffled + data.draw(st.lists(st.sampled_from(several), max_size=6))
    assert hold(rest, first) == hold(repeated, first)


@given(close, st.data())
def test_who_missed_something_agrees_after_hearing_one_holder(several, data):
    """Loss, then resync: any part is lost, and the greatest claim arrives later."""
    first, rest = several[0], several[1:]
    heard = [claim for claim in rest if data.draw(st.booleans())]
    everything = hold(rest, first)
    assert hold([everything], hold(heard, first)) == everything


@given(sequence, st.integers(1, SEQUENCE_COUNT // 2 - 1))
def test_sequences_wrap(start, steps):
    later = (start + steps) % SEQUENCE_COUNT
    assert authority.is_newer(later, start)
    assert not authority.is_newer(start, later)
    assert not authority.is_newer(start, start)


def test_ownership_before_authority_before_name():
    assert authority.wins(Claim(1, 0, "zoe"), Claim(0, 9, "ada"))
    assert authority.wins(Claim(0, 9, "zoe"), Claim(0, 8, "ada"))
    assert authority.wins(Claim(0, 8, "ada"), Claim(0, 8, "zoe"))
    assert authority.wins(Claim(0, 0, "zoe"), Claim(SEQUENCE_COUNT - 1, 0, "ada"))


@given(claims, st.sampled_from(["ada", "bob"]))
def test_a_touch_wins_over_what_was_held_and_rest_over_the_touch(held, me):
    touch = authority.claim_by_touch(held, me, owner_touches=False)
    assert touch.owner == me
    assert touch == held or authority.wins(touch, held)
    assert authority.wins(authority.claim_by_grab(held, me), held)
    rest = authority.release(touch)
    assert rest.owner == NOBODY
    assert authority.wins(rest, touch)
    assert authority.wins(authority.claim_by_touch(rest, "zoe", owner_touches=True), rest)


def test_who_presses_the_same_cane_does_not_take_it_back():
    held = authority.claim_by_touch(UNTOUCHED, "bob", owner_touches=False)
    assert authority.claim_by_touch(held, "ada", owner_touches=True) == held
    assert authority.claim_by_touch(held, "ada", owner_touches=False) == Claim(0, 2, "ada")


@given(claims, claims)
def test_outdated_is_an_older_sequence_not_a_mere_tie(a, b):
    if authority.is_outdated(a, b):
        assert authority.wins(b, a)
    assert not authority.is_outdated(a, Claim(a.ownership, a.authority, "zoe"))


def test_the_nearest_takes_over_then_the_lowest_name():
    where = {"zoe": np.array([1.0, 0, 0]), "bob": np.array([0, 2.0, 0]), "ada": np.array([0, -2.0, 9.0])}
    assert authority.choose_successor(np.zeros(3), where) == "zoe"
    del where["zoe"]
    assert authority.choose_successor(np.zeros(3), where) == "ada"
    assert authority.choose_successor(np.zeros(3), {}) == NOBODY
