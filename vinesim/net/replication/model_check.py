"""What peers send, held against the model of the scene before the simulation sees it.

The codecs see to it that a message is well formed. A well-formed message may still say what cannot be: a cut of a body
that there is not, or a box that lies in itself.
"""

from __future__ import annotations

import numpy as np

from vinesim.net.codec.control import RetainedRecord
from vinesim.net.codec.header import MessageError
from vinesim.net.codec.objects import check_object_id
from vinesim.net.codec.trees import TreeStates, decode_trees
from vinesim.scene.ids import is_tree, parse_object_name
from vinesim.scene.model import Model


def check_record(record: RetainedRecord, model: Model, counts: tuple[int, ...]) -> None:
    """Raise :class:`MessageError` unless the record can be true of the model; ``counts``: objects of each kind."""
    if is_tree(record.object):
        _check_tree_record(record, model)
    elif record.cut or record.trees:
        raise MessageError(f"record of object {record.object} with cuts or the state of a tree; it is none")
    parent = parse_object_name(record.parent)
    if parent is not None:
        check_object_id(parent, counts)
        if parent == record.object:
            raise MessageError(f"record of object {record.object} that rests on itself")


def _check_tree_record(record: RetainedRecord, model: Model) -> None:
    tree = record.object
    first = int(model.tree_first[tree])
    core = int(model.tree_core[tree])
    wrong = next((body for body in record.cut if not first <= body < first + core), None)
    if wrong is not None:
        raise MessageError(f"record of tree {tree} cut at body {wrong}; it has wood from {first} to {first + core - 1}")
    if record.trees:
        states = decode_trees(record.trees, model.tree_size)
        if states.tree.tolist() != [tree]:
            raise MessageError(f"record of tree {tree} with the state of {states.tree.tolist()}")
        check_tree_states(states, model)


def check_tree_states(states: TreeStates, model: Model) -> None:
    """Raise :class:`MessageError` unless all bodies that were cut off are wood; berry clusters fall with a bunch."""
    if len(states.root) and (states.root >= np.repeat(model.tree_core[states.tree], states.roots)).any():
        raise MessageError("a berry cluster that was cut off its bunch")
