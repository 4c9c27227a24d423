"""The constants of one generated vineyard: flat arrays, written once, shared by all packages.

Plants are *trees* of rigid *bodies* (Featherstone's term). A body is a segment of cane or peduncle, or a bunch.
The bodies of a tree are contiguous and in topological order: a parent comes before its children.
Every organ grows along its body's +x axis, from the joint at the body's origin.

A ball joint connects body ``b`` to its parent. The joint frame is fixed in the parent, with origin ``body_offset`` and
axes ``body_rest``. ``State.joint_q`` is the rotation of the body relative to the joint frame; the spring is slack at
``joint_q`` = identity. So ``world pose of b = pose of parent * (body_offset, body_rest) * (0, joint_q)``. For a root,
``tree_pose`` is used instead of the parent's pose.
"""

from __future__ import annotations

import dataclasses
import hashlib

import numpy as np

from vinesim.core import frames
from vinesim.core.array_fields import StructOfArrays, array
from vinesim.scene.ids import Organ
from vinesim.scene.look import Look
from vinesim.scene.nodes import DormantCanes, Nodes, no_canes, no_nodes
from vinesim.scene.terrain import Terrain

_UNIT_POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
_UNIT_QUAT = (0.0, 0.0, 0.0, 1.0)


@dataclasses.dataclass
class Model(StructOfArrays):
    """Constants of a vineyard. The field declarations contain units and shapes; the module docstring explains the
    frames."""

    # a tree is the smallest unit that wakes, sleeps, is owned and is transmitted
    tree_first: np.ndarray = array("tree", unit="1", dtype=np.int32)
    """Index of the tree's root body."""
    tree_size: np.ndarray = array("tree", unit="1", dtype=np.int32)
    """Number of bodies of the tree, from ``tree_first`` on."""
    tree_pose: np.ndarray = array("tree", 7, unit="m, 1", fill=_UNIT_POSE)
    """World pose of the frame in which the root's joint is placed."""
    tree_vine: np.ndarray = array("tree", unit="1", dtype=np.int32, fill=-1)
    tree_piece: np.ndarray = array("tree", unit="1", dtype=np.int32, fill=-1)
    """Index (into ``fixed_start``) of the piece of arm that the root's joint sits on; -1: the joint does not move."""
    tree_core: np.ndarray = array("tree", unit="1", dtype=np.int32)
    """Number of bodies in the tree's core, which come first. The other bodies are berry clusters: while no actor is
    close, the clusters of a bunch are fused to it as one *compound*, and only the core is simulated. A tree without
    clusters is all core."""
    tree_spares: np.ndarray = array("tree", unit="1", dtype=np.int32)
    """Number of spare bodies, the last ones of the core. A spare has no wood and carries nothing until a cut makes it a
    stump; see :mod:`vinesim.scene.spare_bodies`."""

    # bodies
    body_tree: np.ndarray = array("body", unit="1", dtype=np.int32)
    body_parent: np.ndarray = array("body", unit="1", dtype=np.int32, fill=-1)
    """Index of the parent body in the whole model, -1 for a root."""
    body_organ: np.ndarray = array("body", unit="1", dtype=np.int32, fill=int(Organ.CANE))
    body_offset: np.ndarray = array("body", 3, unit="m")
    """Position of the joint in the parent body's frame (for a root in the frame of ``tree_pose``)."""
    body_rest: np.ndarray = array("body", 4, unit="1", fill=_UNIT_QUAT)
    """Rest rotation: orientation of the joint frame in the parent body's frame."""
    body_mass: np.ndarray = array("body", unit="kg")
    body_com: np.ndarray = array("body", 3, unit="m")
    """Centre of mass in the body's frame."""
    body_inertia: np.ndarray = array("body", 3, unit="kg m^2")
    """Principal moments about the centre of mass, along the body's axes."""
    body_length: np.ndarray = array("body", unit="m")
    body_radius: np.ndarray = array("body", 2, unit="m")
    """Radius at the origin and at the tip."""
    body_drag: np.ndarray = array("body", unit="m^2")
    """Drag area Cd A of leaves and wood; the wind force acts at the centre of mass."""
    body_strength: np.ndarray = array("body", unit="Pa")
    """Modulus of rupture of the wood of a cane: stress in the outermost fibre at the joint at which it cracks. 0: it
    never breaks."""
    body_yield_strength: np.ndarray = array("body", unit="Pa")
    """Stress in the outermost fibre above which the wood keeps a set; 0: it keeps none before it cracks."""
    body_toughness: np.ndarray = array("body", unit="J/m^2")
    """Work that breaks the wood through, for each unit of its cross-section, after it has cracked."""
    joint_stiffness: np.ndarray = array("body", 3, unit="N m/rad")
    """Joint stiffness about the joint frame's axes: torsion, bending, bending."""
    joint_damping: np.ndarray = array("body", 3, unit="N m s/rad")
    joint_settled: np.ndarray = array("body", 4, unit="1", fill=_UNIT_QUAT)
    """``joint_q`` in the *drawn shape*, the shape that a generator or builder gave the tree. It is the equilibrium
    under gravity, except for shapes that were given as slack (:attr:`vinesim.scene.cane.CaneBuilder.shape`)."""

    # a bunch is a body of organ BUNCH at the end of its peduncle: one compound, filled with berries
    bunch_body: np.ndarray = array("bunch", unit="1", dtype=np.int32)
    bunch_variety: np.ndarray = array("bunch", unit="1", dtype=np.int32)
    """Index into ``vinesim.scene.berries.VARIETIES``."""
    bunch_seed: np.ndarray = array("bunch", unit="1", dtype=np.uint32)
    bunch_length: np.ndarray = array("bunch", unit="m")
    bunch_radius: np.ndarray = array("bunch", unit="m")
    """Largest radius of the bunch's hull, which is about an ellipsoid along the body's +x axis."""
    bunch_berries: np.ndarray = array("bunch", unit="1", dtype=np.int32)
    bunch_pull: np.ndarray = array("bunch", unit="N", fill=60.0)
    """Pulling force at which the peduncle breaks."""
    bunch_bend: np.ndarray = array("bunch", unit="N m", fill=2.0)
    """Bending moment at which the peduncle breaks."""
    bunch_cluster: np.ndarray = array("bunch", unit="1", dtype=np.int32, fill=-1)
    """First body of the bunch's berry clusters, which have organ BUNCH and follow the core of the tree. -1: the bunch
    has no clusters and is always one compound. ``body_mass``, ``body_com`` and ``body_inertia`` of ``bunch_body``
    describe the compound."""
    bunch_clusters: np.ndarray = array("bunch", unit="1", dtype=np.int32)
    """Number of clusters, from ``bunch_cluster`` on."""
    bunch_head_mass: np.ndarray = array("bunch", unit="kg")
    """Mass of the bunch's head, which is the part of the bunch that belongs to no berry cluster. The head and the
    clusters at ``joint_settled`` form the compound.
    """
    bunch_head_com: np.ndarray = array("bunch", 3, unit="m")
    bunch_head_inertia: np.ndarray = array("bunch", 3, unit="kg m^2")

    # ties bind canes to wires: springs between a point of a body and a point of a wire or the world, slack as drawn
    tie_body: np.ndarray = array("tie", unit="1", dtype=np.int32)
    """Body that is tied. Ties are sorted by this index."""
    tie_point: np.ndarray = array("tie", 3, unit="m")
    """Tied point in the body's frame."""
    tie_anchor: np.ndarray = array("tie", 3, unit="m")
    """Anchor point in the world while the wire is straight."""
    tie_wire: np.ndarray = array("tie", unit="1", dtype=np.int32, fill=-1)
    """Index (into ``fixed_start``) of the piece of wire that holds the tie; -1: the anchor does not move."""
    tie_stiffness: np.ndarray = array("tie", unit="N/m")
    tie_damping: np.ndarray = array("tie", unit="N s/m")
    tie_slip: np.ndarray = array("tie", unit="N")
    """Force along its wire at which a tie slips; 0: it never slips."""
    tie_strength: np.ndarray = array("tie", unit="N")
    """Force at which a tie breaks, or lets go of its wire; 0: it never breaks."""

    # leaves are fixed to bodies; visible to sensors, in physics only as drag and mass
    leaf_body: np.ndarray = array("leaf", unit="1", dtype=np.int32)
    leaf_base: np.ndarray = array("leaf", 3, unit="m")
    """Point where the petiole leaves the cane, in the body's frame."""
    leaf_pose: np.ndarray = array("leaf", 7, unit="m, 1", fill=_UNIT_POSE)
    """Blade frame in the body's frame: origin where petiole meets blade, x along the midrib, z the upper side."""
    leaf_size: np.ndarray = array("leaf", unit="m")
    """About half of the blade's width; it scales the outline, whose area is ``leaves.BLADE_AREA`` in this unit."""
    leaf_mass: np.ndarray = array("leaf", unit="kg")
    """Mass of the leaf, a point mass at the origin of ``leaf_pose``. It is a part of ``body_mass``."""
    leaf_drag: np.ndarray = array("leaf", unit="m^2")
    """Drag area of the leaf. It is a part of ``body_drag``."""
    leaf_age: np.ndarray = array("leaf", unit="1")
    """Age from 0 (young and green) to 1 (yellow)."""

    # fixed wood, posts and wires: round cones from ``fixed_start`` to ``fixed_end``
    fixed_start: np.ndarray = array("fixed", 3, unit="m")
    fixed_end: np.ndarray = array("fixed", 3, unit="m")
    fixed_radius: np.ndarray = array("fixed", 2, unit="m")
    fixed_organ: np.ndarray = array("fixed", unit="1", dtype=np.int32, fill=int(Organ.POLE))
    fixed_index: np.ndarray = array("fixed", unit="1", dtype=np.int32)
    """Index of the pole, wire, trunk or arm that this piece belongs to."""
    fixed_tension: np.ndarray = array("fixed", unit="N")
    """Tension of a piece of wire between its ends; 0: it does not deflect."""
    fixed_stretch: np.ndarray = array("fixed", unit="N/m")
    """Rise of a wire's tension for each metre by which deflection lengthens the piece; 0: its tension is constant."""
    fixed_strength: np.ndarray = array("fixed", unit="N")
    """Tension at which a piece of wire breaks; 0: it never breaks."""

    fixed_shear_modulus: np.ndarray = array("fixed", unit="Pa")
    """Shear modulus of the wood of an arm that its shoots can twist; 0: the piece does not twist. An arm is the
    sequence of pieces of organ ARM with the same ``fixed_index``. Its start is clamped, its end is free."""

    # picking boxes: open crates, dynamic
    box_pose: np.ndarray = array("box", 7, unit="m, 1", fill=_UNIT_POSE)
    """Start pose of the centre of the crate's bottom (x along the length)."""
    box_size: np.ndarray = array("box", 3, unit="m")
    """Outer length, width and height of the box."""
    box_mass: np.ndarray = array("box", unit="kg")

    terrain: Terrain | None = None
    """The uneven ground; None: the plane z = 0."""
    look: Look = dataclasses.field(default_factory=Look)
    """What sensors see and physics does not need. It is not part of the digest."""
    nodes: Nodes = dataclasses.field(default_factory=no_nodes)
    """Nodes and buds of dormant vines; empty in a vineyard without a dormant date."""
    canes: DormantCanes = dataclasses.field(default_factory=no_canes)
    """Canes of dormant vines; empty in a vineyard without a dormant date."""

    def copy(self) -> Model:
        """Returns a deep copy of the arrays, with the same terrain and look."""
        nodes, canes = self.nodes.copy(), self.canes.copy()
        return dataclasses.replace(super().copy(), terrain=self.terrain, look=self.look, nodes=nodes, canes=canes)

    def digest(self) -> str:
        """Returns a hash of all arrays (16 hex digits): two clients with equal digests hold the same vineyard."""
        h = hashlib.blake2b(digest_size=8)
        for name in self.array_fields():
            h.update(np.ascontiguousarray(getattr(self, name)).tobytes())
        for part in (self.nodes, self.canes):  # no bytes without dormant wood
            for name in part.array_fields():
                h.update(np.ascontiguousarray(getattr(part, name)).tobytes())
        if self.terrain is not None:
            h.update(repr((self.terrain.origin, self.terrain.cell, self.terrain.slope)).encode())
            h.update(self.terrain.residual.tobytes())
        return h.hexdigest()

    def bodies_of(self, tree: int) -> slice:
        """Returns the bodies of one tree."""
        first = int(self.tree_first[tree])
        return slice(first, first + int(self.tree_size[tree]))

    def forward_kinematics(self, joint_q: np.ndarray) -> np.ndarray:
        """Returns the world poses [body, 7] for joint rotations [body, 4]. The function loops in Python over the depth
        of the trees, so it is too slow for every step."""
        body_q = np.zeros((len(self.body_mass), 7))
        joint = np.concatenate([self.body_offset, frames.multiply(self.body_rest, joint_q)], -1).astype(float)
        depth = self.depth()
        for level in range(int(depth.max(initial=-1)) + 1):
            here = np.flatnonzero(depth == level)
            parent = self.body_parent[here]
            base = np.where((parent < 0)[:, None], self.tree_pose[self.body_tree[here]], body_q[parent])
            body_q[here] = frames.compose(base, joint[here])
        return body_q

    def bunch_of_body(self) -> np.ndarray:
        """[body] Index of the bunch to which the body belongs as bunch, cluster or peduncle; -1 for all other
        bodies."""
        owner = np.full(len(self.body_mass), -1, np.int32)
        owner[self.bunch_body] = bunch = np.arange(len(self.bunch_body), dtype=np.int32)
        for k in range(int(self.bunch_clusters.max(initial=0))):
            has = bunch[self.bunch_clusters > k]
            owner[self.bunch_cluster[has] + k] = has
        body = self.body_parent[self.bunch_body]
        while len(body):
            stalk = (body >= 0) & (self.body_organ[body] == int(Organ.PEDUNCLE))
            body = body[stalk]
            bunch = bunch[stalk]
            owner[body] = bunch
            body = self.body_parent[body]
        return owner

    def is_spare(self) -> np.ndarray:
        """Returns whether each body is a spare, which has no wood until a cut makes it a stump [body] bool."""
        number = np.arange(len(self.body_mass)) - self.tree_first[self.body_tree]
        core = self.tree_core[self.body_tree]
        return (number < core) & (number >= core - self.tree_spares[self.body_tree])

    def variety_of_trees(self) -> np.ndarray:
        """[tree] Variety of each tree's vine, as an index into ``vinesim.scene.berries.VARIETIES``: that of the vine's
        bunches; -1 for a vine without bunches."""
        vines = np.full(int(self.tree_vine.max(initial=-1)) + 2, -1, np.int32)  # the last entry is for trees of no vine
        vines[self.tree_vine[self.body_tree[self.bunch_body]]] = self.bunch_variety
        return vines[self.tree_vine]

    def is_on_arm(self) -> np.ndarray:
        """Whether the root of each tree sits on a piece of arm that can twist [tree] bool."""
        return np.append(self.arm_is_elastic(), False)[self.tree_piece]

    def arm_is_elastic(self) -> np.ndarray:
        """Whether each piece is a piece of arm that shoots can twist [fixed] bool."""
        return (self.fixed_organ == int(Organ.ARM)) & (self.fixed_shear_modulus > 0.0)

    def depth(self) -> np.ndarray:
        """[body] Number of joints between each body and its root.

        Raises :class:`ValueError` if a parent does not come before its child, as in a cycle.
        """
        depth = np.zeros(len(self.body_mass), np.int32)
        if (late := self.body_parent >= np.arange(len(depth))).any():
            body = int(np.argmax(late))
            raise ValueError(
                f"body {body} of tree {self.body_tree[body]}: parent {self.body_parent[body]}; a parent stands before "
                "its children (no cycles); reorder"
            )
        above = self.body_parent.copy()
        while (above >= 0).any():
            depth += above >= 0
            above = np.where(above >= 0, self.body_parent[above], -1)
        return depth
