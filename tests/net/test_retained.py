"""Facts: the greatest claim holds whatever the order, a thing lies in one cell, cuts only grow."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from vinesim.net.codec.messages import RetainedRecord
from vinesim.net.replication.retained import RetainedState
from vinesim.scene.ids import ObjectKind, object_id

BOX, BUNCH, TREE = object_id(ObjectKind.BOX, 1), object_id(ObjectKind.BUNCH, 7), object_id(ObjectKind.TREE, 3)


def at(x: float) -> tuple[float, ...]:
    return (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def test_a_thing_lies_where_the_greatest_claim_says():
    facts = RetainedState()
    assert facts.merge((0, 0), RetainedRecord(BOX, 0, 1, "ada", at(1.0)))
    assert facts.merge((0, 0), RetainedRecord(BUNCH, 1, 0, "bob", at(2.0), parent="box/1"))
    assert not facts.merge((5, 5), RetainedRecord(BOX, 0, 1, "bob", at(30.0)))
    assert [fact.pose[0] for fact in facts.in_cell((0, 0))] == [2.0, 1.0]
    assert facts.merge((1, 0), RetainedRecord(BOX, 0, 2, "bob", at(7.0)))
    assert [fact.object for fact in facts.in_cell((0, 0))] == [BUNCH]
    assert [fact.pose[0] for fact in facts.in_cell((1, 0))] == [7.0]
    assert facts.in_cell((5, 5)) == []
    assert [(cell, fact.object) for cell, fact in facts] == [((0, 0), BUNCH), ((1, 0), BOX)]
    assert len(facts) == 2


def test_sequences_wrap():
    facts = RetainedState()
    facts.merge((0, 0), RetainedRecord(BOX, 65535, 65535, "ada"))
    assert facts.merge((0, 0), RetainedRecord(BOX, 0, 65535, "ada", at(1.0)))
    assert facts.merge((0, 0), RetainedRecord(BOX, 0, 0, "ada", at(2.0)))
    assert not facts.merge((0, 0), RetainedRecord(BOX, 65535, 0, "ada", at(3.0)))
    assert facts.in_cell((0, 0))[0].pose[0] == 2.0


def test_what_was_cut_stays_cut_whoever_wins():
    facts = RetainedState()
    facts.merge((0, 0), RetainedRecord(TREE, 1, 0, "ada", cut=(4,)))
    assert facts.merge((0, 0), RetainedRecord(TREE, 1, 0, "bob", cut=(9,)))
    (fact,) = facts.in_cell((0, 0))
    assert (fact.author, fact.cut) == ("ada", (4, 9))
    assert facts.merge((0, 0), RetainedRecord(TREE, 2, 0, "bob", cut=(9,)))
    assert facts.in_cell((0, 0))[0].cut == (4, 9)


said = st.builds(
    # under one claim an author says one thing
    lambda cell, thing, sequences, author: (
        (cell[0], cell[1]),
        RetainedRecord(
            thing, *sequences, author, at(float(sequences[0] % 7 + 10 * (sequences[1] % 7) + 100 * (author == "bob"))),
            cut=(sequences[0] % 5,) if thing == TREE else (),
        ),
    ),
    st.tuples(st.integers(-1, 1), st.integers(-1, 1)), st.sampled_from([BOX, BUNCH, TREE]),
    st.tuples(st.sampled_from([65534, 65535, 0, 1]), st.sampled_from([65535, 0, 1])), st.sampled_from(["ada", "bob"]),
)  # fmt: skip


@settings(deadline=None)
@given(st.lists(said, max_size=12, unique_by=lambda one: (one[1].object, one[1].claim)), st.data())
def test_neither_order_nor_repetition_matters(told, data):
    one, other = RetainedState(), RetainedState()
    for cell, fact in told:
        one.merge(cell, fact)
    for cell, fact in data.draw(st.permutations(told + told[:3])):
        other.merge(cell, fact)
    assert list(one) == list(other)
    assert sum(len(one.in_cell((x, y))) for x in (-1, 0, 1) for y in (-1, 0, 1)) == len(one)
    for cell, fact in list(one):
        assert not one.merge(cell, fact)
