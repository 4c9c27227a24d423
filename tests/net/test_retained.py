"""Retained records: the greatest claim wins in any order, an object is in one cell, the set of cuts only grows."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from vinesim.net.codec.control import RetainedRecord
from vinesim.net.replication.retained import RetainedState
from vinesim.scene.ids import ObjectKind, object_id

BOX = object_id(ObjectKind.BOX, 1)
BUNCH = object_id(ObjectKind.BUNCH, 7)
TREE = object_id(ObjectKind.TREE, 3)


def at(x: float) -> tuple[float, ...]:
    return (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def test_an_object_is_in_the_cell_of_the_greatest_claim():
    state = RetainedState()
    assert state.merge((0, 0), RetainedRecord(BOX, 0, 1, "ada", at(1.0)))
    assert state.merge((0, 0), RetainedRecord(BUNCH, 1, 0, "bob", at(2.0), parent="box/1"))
    assert not state.merge((5, 5), RetainedRecord(BOX, 0, 1, "bob", at(30.0)))
    assert [record.pose[0] for record in state.in_cell((0, 0))] == [2.0, 1.0]
    assert state.merge((1, 0), RetainedRecord(BOX, 0, 2, "bob", at(7.0)))
    assert [record.object for record in state.in_cell((0, 0))] == [BUNCH]
    assert [record.pose[0] for record in state.in_cell((1, 0))] == [7.0]
    assert state.in_cell((5, 5)) == []
    assert [(cell, record.object) for cell, record in state] == [((0, 0), BUNCH), ((1, 0), BOX)]
    assert len(state) == 2


def test_sequence_numbers_wrap():
    state = RetainedState()
    state.merge((0, 0), RetainedRecord(BOX, 65535, 65535, "ada"))
    assert state.merge((0, 0), RetainedRecord(BOX, 0, 65535, "ada", at(1.0)))
    assert state.merge((0, 0), RetainedRecord(BOX, 0, 0, "ada", at(2.0)))
    assert not state.merge((0, 0), RetainedRecord(BOX, 65535, 0, "ada", at(3.0)))
    assert state.in_cell((0, 0))[0].pose[0] == 2.0


def test_cuts_remain_whichever_claim_wins():
    state = RetainedState()
    state.merge((0, 0), RetainedRecord(TREE, 1, 0, "ada", cut=(4,)))
    assert state.merge((0, 0), RetainedRecord(TREE, 1, 0, "bob", cut=(9,)))
    (record,) = state.in_cell((0, 0))
    assert (record.author, record.cut) == ("ada", (4, 9))
    assert state.merge((0, 0), RetainedRecord(TREE, 2, 0, "bob", cut=(9,)))
    assert state.in_cell((0, 0))[0].cut == (4, 9)


submissions = st.builds(
    # under one claim an author publishes one record
    lambda cell, number, sequences, author: (
        (cell[0], cell[1]),
        RetainedRecord(
            number,
            *sequences,
            author,
            at(float(sequences[0] % 7 + 10 * (sequences[1] % 7) + 100 * (author == "bob"))),
            cut=(sequences[0] % 5,) if number == TREE else (),
        ),
    ),
    st.tuples(st.integers(-1, 1), st.integers(-1, 1)),
    st.sampled_from([BOX, BUNCH, TREE]),
    st.tuples(st.sampled_from([65534, 65535, 0, 1]), st.sampled_from([65535, 0, 1])),
    st.sampled_from(["ada", "bob"]),
)


@given(st.lists(submissions, max_size=12, unique_by=lambda one: (one[1].object, one[1].claim)), st.data())
def test_order_and_repetition_do_not_matter(records, data):
    one = RetainedState()
    other = RetainedState()
    for cell, record in records:
        one.merge(cell, record)
    for cell, record in data.draw(st.permutations(records + records[:3])):
        other.merge(cell, record)
    assert list(one) == list(other)
    assert sum(len(one.in_cell((x, y))) for x in (-1, 0, 1) for y in (-1, 0, 1)) == len(one)
    for cell, record in list(one):
        assert not one.merge(cell, record)
