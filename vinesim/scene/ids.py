"""Names and numbers that stay the same on every client: organs, and ids of objects.

Clients exchange only the scene hash and these ids. Tree 17 is the same tree on every client, because generation from
(scene file, seed) is deterministic.
"""

from __future__ import annotations

import enum


class Organ(enum.IntEnum):
    """Class of an object: its class in label images and its row in the table of materials."""

    NOTHING = 0
    GROUND = 1
    POLE = 2
    WIRE = 3
    TRUNK = 4
    ARM = 5
    CANE = 6
    LEAF = 7
    PEDUNCLE = 8
    BUNCH = 9
    BOX = 10
    ROBOT = 11
    HUMAN = 12
    SPUR = 13
    """Two-year wood of dormant vines: spurs and fruiting cane. In the physics its bodies are canes."""
    NODE = 14
    """Node (swelling) of dormant wood, without its bud; part of a cane in the physics."""
    BUD = 15
    """Bud of a dormant cane; part of the cane in the physics."""


PARTS_OF_CANE = (Organ.SPUR, Organ.NODE, Organ.BUD)
"""Classes of labels whose surface and substance are those of canes."""


class ObjectKind(enum.IntEnum):
    """Kinds of objects that an actor can own and move, with the same ids on all clients."""

    TREE = 0
    BUNCH = 1
    """A picked bunch; a hanging bunch is part of its tree."""
    BOX = 2


FIXED_PIECES = -1
"""Number of the fixed pieces (wood, wires, poles), all together, in lists of the trees that a bunch passes through."""

OBJECT_STRIDE = 1 << 24
"""Factor of the kind in an object id, which is ``kind * OBJECT_STRIDE + index``. Ids of trees equal their indices."""


def object_id(kind: ObjectKind, index: int) -> int:
    """Returns the id of a tree, a free bunch or a box. ``index`` counts the objects of each kind from 0."""
    return int(kind) * OBJECT_STRIDE + index


def split_object_id(value: int) -> tuple[ObjectKind, int]:
    """Returns kind and index of an object id. Raises :class:`ValueError` for a number that is not an object id."""
    return ObjectKind(value // OBJECT_STRIDE), value % OBJECT_STRIDE


def is_tree(value: int) -> bool:
    """Returns whether an object id belongs to a tree; all other objects are rigid."""
    return value < OBJECT_STRIDE


def object_name(value: int) -> str:
    """Returns the link name of a box or a free bunch, such as ``box/3``."""
    kind, index = split_object_id(value)
    return f"{kind.name.lower()}/{index}"


def parse_object_name(name: str) -> int | None:
    """Returns the object id of the box or free bunch with a name such as ``box/3``; None for other names."""
    kind, _, index = name.partition("/")
    rigid = {"bunch": ObjectKind.BUNCH, "box": ObjectKind.BOX}
    return object_id(rigid[kind], int(index)) if kind in rigid and index.isdecimal() else None


LABEL_STRIDE = 1 << 20
"""Factor of the organ in a pixel of a label image. The pixel is one int32, ``organ * LABEL_STRIDE + index``."""

NO_OBJECT = LABEL_STRIDE - 1
"""Index in the labels of parts that belong to no object: a leaf of no tree, a band around no wire."""


def label(organ: Organ, index: int) -> int:
    """Returns the label of one object in a label image. ``index`` counts bunches, boxes, trees or actors from 0."""
    return int(organ) * LABEL_STRIDE + index


def unlabel(value: int) -> tuple[Organ, int]:
    """Returns the organ and index of a label."""
    return Organ(value // LABEL_STRIDE), value % LABEL_STRIDE
