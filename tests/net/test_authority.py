"""Laws of ownership: claims have a total order, so any order, repetition and delay ends with one owner."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vinesim.net.replication import authority
from vinesim.net.replication.authority import NO_OWNER, SEQUENCE_COUNT, UNTOUCHED, Claim

sequence = st.integers(0, SEQUENCE_COUNT - 1)
name = st.sampled_from([NO_OWNER, "ada", "bob", "cleo"])
claims = st.builds(Claim, sequence, sequence, name)
# claims whose sequence numbers differ by less than half of their range, anywhere in it: also across the wrap
close = st.builds(
    lambda start, steps: [
        Claim((start + o) % SEQUENCE_COUNT, (start + a) % SEQUENCE_COUNT, owner) for o, a, owner in steps
    ],
    sequence,
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 30_000), name), min_size=1, max_size=6),
)


def winner(received: list[Claim], held: Claim) -> Claim:
    for claim in received:
        held = claim if authority.wins(claim, held) else held
    return held


@given(claims, claims)
def test_of_two_claims_exactly_one_wins(a, b):
    assert authority.wins(a, b) + authority.wins(b, a) == (a != b)


@given(close)
def test_winning_is_transitive(many):
    for a, b, c in itertools.permutations(many, 3):
        if authority.wins(a, b) and authority.wins(b, c):
            assert authority.wins(a, c)


@given(close, st.data())
def test_any_order_and_any_repetition_end_with_the_same_owner(many, data):
    first = many[0]
    rest = many[1:]
    shuffled = data.draw(st.permutations(rest))
    repeated = shuffled + data.draw(st.lists(st.sampled_from(many), max_size=6))
    assert winner(rest, first) == winner(repeated, first)


@given(close, st.data())
def test_a_client_that_lost_messages_agrees_after_receiving_the_winning_claim(many, data):
    """Loss, then resync: any part is lost, and the greatest claim arrives later."""
    first = many[0]
    rest = many[1:]
    received = [claim for claim in rest if data.draw(st.booleans())]
    everything = winner(rest, first)
    assert winner([everything], winner(received, first)) == everything


@given(sequence, st.integers(1, SEQUENCE_COUNT // 2 - 1))
def test_sequence_numbers_wrap(start, steps):
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
def test_a_touch_wins_over_the_held_claim_and_a_release_over_the_touch(held, name_):
    touch = authority.claim_by_touch(held, name_, owner_touches=False)
    assert touch.owner == name_
    assert touch == held or authority.wins(touch, held)
    assert authority.wins(authority.claim_by_grab(held, name_), held)
    rest = authority.release(touch)
    assert rest.owner == NO_OWNER
    assert authority.wins(rest, touch)
    assert authority.wins(authority.claim_by_touch(rest, "zoe", owner_touches=True), rest)


def test_a_touch_does_not_take_a_tree_from_an_owner_that_touches_it():
    held = authority.claim_by_touch(UNTOUCHED, "bob", owner_touches=False)
    assert authority.claim_by_touch(held, "ada", owner_touches=True) == held
    assert authority.claim_by_touch(held, "ada", owner_touches=False) == Claim(0, 2, "ada")


@given(claims, claims)
def test_a_tie_of_sequence_numbers_is_not_outdated(a, b):
    if authority.is_outdated(a, b):
        assert authority.wins(b, a)
    assert not authority.is_outdated(a, Claim(a.ownership, a.authority, "zoe"))


def test_the_successor_is_the_nearest_then_the_lowest_name():
    where = {"zoe": np.array([1.0, 0, 0]), "bob": np.array([0, 2.0, 0]), "ada": np.array([0, -2.0, 9.0])}
    assert authority.choose_successor(np.zeros(3), where) == "zoe"
    del where["zoe"]
    assert authority.choose_successor(np.zeros(3), where) == "ada"
    assert authority.choose_successor(np.zeros(3), {}) == NO_OWNER
