"""Well-formed records and states that say what the model forbids: dropped, counted, and nothing else lost."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from benchmarks.support.fake_client import FakeClient, tree_row
from tests.net.test_replicator import TICK, Client, run, vineyard
from vinesim.core import frames
from vinesim.net.codec.control import RetainedRecord, decode_records, encode_records
from vinesim.net.codec.header import MessageError
from vinesim.net.codec.trees import TreeStates, decode_trees, encode_trees
from vinesim.net.replication.receiver import check_record, check_tree_states
from vinesim.net.transport.bus import KEEP_ALL
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import FIXED_PIECES, ObjectKind, object_id
from vinesim.scene.spec import load_scene

TREE = 2
BOX = object_id(ObjectKind.BOX, 0)
BUNCH = object_id(ObjectKind.BUNCH, 0)
COUNTS = (8, 4, 4)


def state_of(tree: int, **others) -> bytes:
    """A tree at rest as a message of one tree."""
    model = vineyard()
    size = int(model.tree_size[tree])
    here = model.bodies_of(tree)
    states = TreeStates(
        1.0,
        np.array([tree]),
        np.array([1]),
        np.array([1]),
        np.array([0]),
        np.array([size]),
        model.joint_settled[here].astype(float),
        np.zeros((size, 3)),
        **others,
    )
    return encode_trees(states)[0][0]


def record(**values) -> RetainedRecord:
    return msgspec.structs.replace(RetainedRecord(TREE, 1, 1, "ada"), **values)


LIES = {
    "a body that there is not": record(cut=(1_000_000,)),
    "a body of another tree": record(cut=(0,)),
    "no state": record(trees=b"abc"),
    "another tree's state": record(trees=state_of(1)),
    "a box that is cut": record(object=BOX, cut=(1,)),
    "a box with a tree's state": record(object=BOX, trees=state_of(TREE)),
    "a box that passes through a tree": record(object=BOX, passed=(1,)),
    "a bunch that passes through a tree that there is not": record(
        object=BUNCH, passed=(1, len(vineyard().tree_first))
    ),
    "a box that lies in itself": record(object=BOX, parent="box/0"),
    "a parent that there is not": record(object=BOX, parent="box/99"),
    "a parent beyond all numbers": record(object=BOX, parent="box/" + "9" * 60),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_record_that_cannot_be_true_is_refused(lie: str) -> None:
    with pytest.raises(MessageError):
        check_record(LIES[lie], vineyard(), COUNTS)


@pytest.mark.parametrize(
    "truth",
    [
        record(),
        record(cut=(int(vineyard().tree_first[TREE]) + 3,), trees=state_of(TREE)),
        record(object=BUNCH, passed=(FIXED_PIECES, 0, len(vineyard().tree_first) - 1)),
        record(object=BOX, parent="box/1"),
        record(object=BOX, parent="ada/gripper"),
    ],
)
def test_a_record_that_may_be_true_is_accepted(truth: RetainedRecord) -> None:
    check_record(truth, vineyard(), COUNTS)


def test_a_stump_must_be_a_spare_body_of_a_cane_that_was_cut() -> None:
    model = generate(load_scene("demo"))
    tree = 5
    first = int(model.tree_first[tree])
    spare = first + int(model.tree_core[tree]) - 1
    check_record(RetainedRecord(tree, 1, 1, "ada", cut=(first + 3,), stumps=((spare, first + 3, 250),)), model, COUNTS)
    for cut, stump, why in (
        (first + 3, (first + 4, first + 3, 250), "no spare body"),
        (first + 3, (spare + 1, first + 3, 250), "no spare body"),
        (first + 3, (spare, first + 2, 250), "no cane that was cut"),
        (spare, (spare, spare, 250), "no cane that was cut"),
        (first + 3, (spare, first + 3, 9999), "beyond its end"),
    ):
        with pytest.raises(MessageError, match=why):
            check_record(RetainedRecord(tree, 1, 1, "ada", cut=(cut,), stumps=(stump,)), model, COUNTS)
    with pytest.raises(MessageError, match="it is none"):
        check_record(record(object=BOX, stumps=((spare, first + 3, 250),)), model, COUNTS)


def test_a_berry_cluster_cannot_be_cut_off_alone() -> None:
    model = generate(load_scene("demo"))
    tree = int(np.flatnonzero(model.tree_size > model.tree_core)[0])
    core = int(model.tree_core[tree])
    first = int(model.tree_first[tree])
    with pytest.raises(MessageError, match="it has wood from"):
        check_record(RetainedRecord(tree, 1, 1, "ada", cut=(first + core,)), model, COUNTS)
    states = TreeStates(
        1.0,
        np.array([tree]),
        *(np.array([1]) for _ in range(3)),
        np.array([model.tree_size[tree]]),
        np.zeros((0, 4)),
        np.zeros((0, 3)),
        np.array([1]),
        np.array([core]),
        np.zeros((1, 3)),
        np.zeros((1, 3)),
    )
    with pytest.raises(MessageError, match="berry cluster"):
        check_tree_states(states, model)


def test_what_moves_beyond_the_range_of_positions_is_still_published() -> None:
    """Another actor may leave an object 10 m before the bound. The record of who moves it on is read by all."""
    hub = MemoryHub()
    server = hub.bus("server", live=False)
    server.subscribe("fact/**", KEEP_ALL)
    ada = FakeClient(hub.bus("ada"), tree_row(), (1.0, 0.0))
    bunch = object_id(ObjectKind.BUNCH, 1)
    ada.carried_state = lambda _: (frames.pose([1e5 + 5.0, -1e9, 0.5]), np.zeros(6))  # type: ignore[method-assign]
    ada.picking = {bunch}
    records = []
    for step in range(200):
        hub.advance(TICK)
        ada.carrying -= {bunch} if step == 100 else set()
        ada.tick(hub.time)
        records += [one for _, payload in server.poll() for one in decode_records(payload)]
    positions = [one.pose[:3] for one in records if one.object == bunch]
    assert positions == 2 * [(99_999.0, -99_999.0, 0.5)], "when it was picked, and at rest"


def test_a_body_beyond_the_range_of_positions_is_still_published() -> None:
    far = state_of(
        TREE, roots=np.array([1]), root=np.array([3]), root_x=np.array([[1e9, 0.0, -1e5]]), root_xd=np.zeros((1, 3))
    )
    check_record(record(trees=far), vineyard(), COUNTS)
    assert decode_trees(far).root_x.tolist() == [[99_999.0, 0.0, -99_999.0]]


def test_the_other_records_of_a_message_are_received() -> None:
    """A peer says two lies and a truth about trees in one message: the lies never reach the client."""
    hub = MemoryHub()
    ada = Client(hub, "ada", 1.0)
    bob = Client(hub, "bob", 2.0)
    run(hub, [ada, bob], 0.5)
    body = int(vineyard().tree_first[TREE]) + 3
    truth = record(object=TREE, cut=(body,))
    lies = [record(object=1, cut=(1_000_000,)), record(object=3, trees=b"abc")]
    publisher = ada.bus.publisher("fact/0/0/ada", reliable=True)
    received = []
    publisher.put(encode_records([lies[0], truth, lies[1]]))
    for _ in range(100):
        run(hub, [ada, bob], TICK)
        received += bob.inbox.records
    assert [(one.object, one.cut) for one, _ in received] == [(TREE, (body,))]
    assert bob.replicator.record(TREE) == truth
    assert bob.replicator.record(1) is None
    assert bob.replicator.record(3) is None
    assert bob.replicator.counters.malformed == len(lies)
