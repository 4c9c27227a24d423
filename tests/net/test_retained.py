"""Facts: the greatest claim holds whatever the order, a thing lies in one cell, cuts only grow."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from vinesim.net.codec.messages import Fact
from vinesim.net.replication.retained import Facts
from vinesim.scene.ids import Kind, thing

BOX, BUNCH, TREE = thing(Kind.BOX, 1), thing(Kind.BUNCH, 7), thing(Kind.TREE, 3)


def at(x: float) -> tuple[float, ...]:
    return (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def test_a_thing_lies_where_the_greatest_claim_says():
    facts = Facts()
    assert facts.add((0, 0), Fact(BOX, 0, 1, "ada", at(1.0)))
    assert facts.add((0, 0), Fact(BUNCH, 1, 0, "bob", at(2.0), parent="box/1"))
    assert not facts.add((5, 5), Fact(BOX, 0, 1, "bob", at(30.0)))
    assert [fact.pose[0] for fact in facts.cell((0, 0))] == [2.0, 1.0]
    assert facts.add((1, 0), Fact(BOX, 0, 2, "bob", at(7.0)))
    assert [fact.thing for fact in facts.cell((0, 0))] == [BUNCH]
    assert [fact.pose[0] for fact in facts.cell((1, 0))] == [7.0]
    assert facts.cell((5, 5)) == []
    assert [(cell, fact.thing) for cell, fact in facts] == [((0, 0), BUNCH), ((1, 0), BOX)]
    assert len(facts) == 2


def test_sequences_wrap():
    facts = Facts()
    facts.add((0, 0), Fact(BOX, 65535, 65535, "ada"))
    assert facts.add((0, 0), Fact(BOX, 0, 65535, "ada", at(1.0)))
    assert facts.add((0, 0), Fact(BOX, 0, 0, "ada", at(2.0)))
    assert not facts.add((0, 0), Fact(BOX, 65535, 0, "ada", at(3.0)))
    assert facts.cell((0, 0))[0].pose[0] == 2.0


def test_what_was_cut_stays_cut_whoever_wins():
    facts = Facts()
    facts.add((0, 0), Fact(TREE, 1, 0, "ada", cut=(4,)))
    assert facts.add((0, 0), Fact(TREE, 1, 0, "bob", cut=(9,)))
    (fact,) = facts.cell((0, 0))
    assert (fact.author, fact.cut) == ("ada", (4, 9))
    assert facts.add((0, 0), Fact(TREE, 2, 0, "bob", cut=(9,)))
    assert facts.cell((0, 0))[0].cut == (4, 9)


said = st.builds(
    # under one claim an author says one thing
    lambda cell, thing, sequences, author: (
        (cell[0], cell[1]),
        Fact(
            thing, *sequences, author, at(float(sequences[0] % 7 + 10 * (sequences[1] % 7) + 100 * (author == "bob"))),
            cut=(sequences[0] % 5,) if thing == TREE else (),
        ),
    ),
    st.tuples(st.integers(-1, 1), st.integers(-1, 1)), st.sampled_from([BOX, BUNCH, TREE]),
    st.tuples(st.sampled_from([65534, 65535, 0, 1]), st.sampled_from([65535, 0, 1])), st.sampled_from(["ada", "bob"]),
)  # fmt: skip


@settings(deadline=None)
@given(st.lists(said, max_size=12, unique_by=lambda one: (one[1].thing, one[1].claim)), st.data())
def test_neither_order_nor_repetition_matters(told, data):
    one, other = Facts(), Facts()
    for cell, fact in told:
        one.add(cell, fact)
    for cell, fact in data.draw(st.permutations(told + told[:3])):
        other.add(cell, fact)
    assert list(one) == list(other)
    assert sum(len(one.cell((x, y))) for x in (-1, 0, 1) for y in (-1, 0, 1)) == len(one)
    for cell, fact in list(one):
        assert not one.add(cell, fact)
