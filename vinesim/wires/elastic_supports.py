"""Elastic supports: wires that shoots are tied to, and arms that shoots stand on. They deform, so shoots on one support
move each other.

See :mod:`vinesim.kernels.wires.elastic_supports`. Only supports of trees that are awake are computed. The
anchors in the tie table follow the wires, and the rest poses of root springs turn with the arms. So the code of trees,
of their sleep and of joint wrenches needs no knowledge of supports.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.warp_arrays import SharedArrays, share
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.wires import elastic_supports as kernels
from vinesim.plants.articulation_solver import ArticulationSolver, spans
from vinesim.plants.equilibrium import EquilibriumFinder
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters

WAKE_SHARE = 0.25
"""[1] Displacement of a sleeping tree by a wire or arm at which the tree wakes, as a share of ``sleep_distance``. For a
wire it is the displacement of a tie, for an arm the displacement of the point of the tree that moves most. TUNED:
twenty shoots that sleep on a wire hold it with 2 N until they wake.
"""

LEAST_SHARE = 5e-4
"""[1] Smallest compliance between adjacent nodes, and between a node and an end of its support, as a share of the
support's compliance. Smaller values are replaced by this one."""

WIRE_DAMPING_TIME = 0.01
"""[s] Ratio of damping to stiffness of a wire at a contact. GUESSED: as ``tie_damping`` of the plants."""

_NO_TREES = _NO_SUPPORTS = np.zeros(0, np.int32)


class ElasticSupports:
    """The supports of one model: pieces of wire under tension to which a tie is bound, and arms on which a shoot
    stands."""

    def __init__(self, plants: ArticulationSolver, parameters: PhysicsParameters = PhysicsParameters()) -> None:
        """``parameters``: ``sleep_distance`` decides when a tree wakes."""
        self._plants = plants
        model = plants.model
        wires = _wire_nodes(plants)
        arms = _arm_nodes(plants)
        plants.ties.axis[wires["tie"]] = wires["axis"]
        nodes = {name: np.concatenate([wires[name], arms[name]]) for name in wires}
        self._origin = nodes["origin"]
        self._node_of = {tie: node for node, tie in enumerate(wires["tie"].tolist())}
        plants.ties.on_slide = self._slide
        first = np.flatnonzero(np.diff(nodes["support"], prepend=-1))
        self._tree = model.body_tree[nodes["body"]].astype(np.int32)
        self._support = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(self._tree))))
        by_tree = np.argsort(self._tree, kind="stable")
        self._tree_supports = self._support[by_tree].astype(np.int32)
        trees = len(model.tree_first)
        self._tree_start = np.searchsorted(self._tree[by_tree], np.arange(trees + 1)).astype(np.int32)
        self.deflection = np.zeros((len(self._tree), 3))
        """[node, 3] For nodes of wires the displacement [m] from their position on the straight wire; for nodes of arms
        the twist, [rad, 0, 0]. Wires come first. The nodes of each support are in order from its start to its end.
        """
        self.count = len(first)
        """Number of supports."""
        piece = nodes["support"][first]
        self._piece = np.where(piece < len(model.fixed_start), piece, -1)
        """[support] Index of the piece of wire; -1 for an arm."""
        self._was_active = np.zeros(len(first), np.bool_)
        self._active = np.zeros(len(first), np.int32)
        self._is_moved = np.zeros(trees, np.bool_)
        self._active_count = np.zeros(1, np.int32)
        self._moved_count = np.zeros(1, np.int32)
        self.is_coupled = np.zeros(trees, np.bool_)
        """[tree] Whether the tree shares a support (a wire or an arm) with another awake tree."""
        self._is_placed = np.zeros(trees, np.bool_)
        self._awake = _NO_TREES
        self._placed = _NO_TREES
        self._is_listed = False
        self._loaded = self._unloaded = _NO_SUPPORTS
        self.load = np.zeros((len(self._tree), 3))
        """[node, 3] N: forces of contacts on the nodes of wires. The forces of ties are not included."""
        self._wire_ties = wires["tie"]
        self._strength = np.where(model.fixed_strength > 0.0, model.fixed_strength, np.inf)
        self._tie_changes = 0
        first_tie = np.searchsorted(model.tie_body, model.tie_body[wires["tie"]])
        stiffness, last_stiffness = _springs_in_series(nodes["compliance"], nodes["whole"], nodes["is_arm"], first)
        self._bind(
            {
                "first": np.append(first, len(self._tree)).astype(np.int32),
                "is_arm": nodes["is_arm"][first],
                "stiffness": stiffness,
                "last_stiffness": last_stiffness,
                "tree": self._tree,
                "piece": self._piece.astype(np.int32),
                "number": np.append(wires["tie"] - first_tie, 0 * arms["body"]).astype(np.int32),
                "wake_distance": WAKE_SHARE * parameters.sleep_distance / nodes["response"],
            }
            | {name: nodes[name] for name in ("axis", "body", "point", "origin")},
            self._wire_arrays(wires),
        )

    def _wire_arrays(self, nodes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Returns the arrays of the pieces of wire for :func:`kernels.wire_spring`. ``nodes``: nodes of the wires."""
        model = self._plants.model
        tension = model.fixed_tension.astype(float)
        way = (model.fixed_end - model.fixed_start).astype(float)
        support = np.full(len(tension), -1, np.int32)
        support[nodes["support"]] = self._support[: len(nodes["support"])]
        along = np.zeros(len(self._tree))
        along[: len(nodes["support"])] = nodes["compliance"] * tension[nodes["support"]]
        return {
            "tension": tension.copy(),
            "straight_tension": np.maximum(tension, 1e-9),
            "stretch": model.fixed_stretch.astype(float),
            "bulge": np.zeros(len(tension)),
            "resistance": np.zeros(len(tension)),
            "length": np.linalg.norm(way, axis=1),
            "support": support,
            "node_along": along,
        }

    def _bind(self, nodes: dict[str, np.ndarray], wires: dict[str, np.ndarray]) -> None:
        plants = self._plants
        count = len(self._tree)
        ties = plants.ties
        rests = plants.root_rests
        state = plants.state
        shape = {
            "load": self.load,
            "deflection": self.deflection,
            "reference": np.zeros((count, 3)),
            "ratio": np.zeros(count),
            "velocity": np.zeros((count, 3)),
            "share": np.zeros(count),
            "fall": np.zeros((count, 3)),
        }
        bodies = {
            "body_q": state.body_q,
            "body_qd": state.body_qd,
            "joint_q": state.joint_q,
            "joint_qd": state.joint_qd,
            "joint_stiffness": plants.joint_stiffness,
        }
        springs = {
            "span": ties.span,
            "stiffness": ties.stiffness,
            "anchor": ties.anchor,
            "anchor_velocity": ties.anchor_velocity,
            "softening": ties.softening,
            "root_turn": rests.turn,
            "root_turn_rate": rests.rate,
            "root_softening": rests.softening,
        }
        self._nodes = SharedArrays(kernels.SupportNodes, **nodes)
        node_struct = self._nodes.struct
        body_struct = SharedArrays(kernels.SupportedBodies, **bodies).struct
        spring_struct = SharedArrays(kernels.SupportedSprings, **springs).struct
        self._wires = SharedArrays(kernels.Wires, **wires)
        solve = KernelLaunch(
            kernels.balance_supports,
            [
                self._wires.struct,
                node_struct,
                share(self._active_count, wp.int32),
                share(self._active, wp.int32),
                share(state.tree_awake, wp.bool),
                share(self._is_placed, wp.bool),
                body_struct,
            ],
            [
                SharedArrays(kernels.SupportState, **shape).struct,
                spring_struct,
                share(self._wires.tension, wp.float64),
                share(self._wires.resistance, wp.float64),
                share(self._is_moved, wp.bool),
                share(self._moved_count, wp.int32),
            ],
        )
        self._solve = KernelGraph(solve)
        self.tension_arrays = [
            share(getattr(self._wires, name), wp.float64) for name in ("bulge", "tension", "resistance")
        ]
        """Arrays of ``kernels.Wires`` that change."""
        self.wire_structs = self._wires.struct, node_struct, body_struct, spring_struct
        """Arguments of :func:`kernels.wire_spring`, except the loads."""

    def _slide(self, tie: int, way: np.ndarray) -> None:
        """Let a tie that slips along its wire hold it further on. The node's place in the wire's equations stays."""
        if tie in self._node_of:
            self._origin[self._node_of[tie]] += way

    @property
    def tension(self) -> np.ndarray:
        """[piece] N, tension of each piece of wire now; 0 for a broken wire, and for pieces that are not taut wires."""
        return self._wires.tension

    def overloaded(self) -> np.ndarray:
        """Returns the pieces of wire [k] whose tension has passed their strength."""
        return np.flatnonzero(self._wires.tension > self._strength)

    def break_wire(self, piece: int) -> np.ndarray:
        """Let a piece of wire bear nothing any more. Returns the ties [k] that it held."""
        self._wires.tension[piece] = self._wires.bulge[piece] = self._wires.resistance[piece] = 0.0
        ties = self._wire_ties[self._plants.model.tie_wire[self._wire_ties] == piece]
        return ties[~self._plants.state.tie_broken[ties]]

    @property
    def tightening(self) -> float:
        """[J] Tension times lengthening of all wires, minus the work that lengthened them: their tension has grown
        with their length."""
        wires = self._wires
        rise = np.where(wires.stretch > 0.0, np.maximum(wires.tension - wires.straight_tension, 0.0), 0.0)
        return 0.5 * float((rise * rise / np.maximum(wires.stretch, 1e-9)).sum())

    def set_loaded(self, supports: np.ndarray) -> None:
        """Set the supports (wires or arms) [k] on which :attr:`load` acts until the next call."""
        if not np.array_equal(supports, self._loaded):
            self._unloaded = self._loaded
            self._loaded = supports.copy()
            self._is_listed = False

    @property
    def active(self) -> np.ndarray:
        """The supports (wires or arms) [k] that the last :meth:`update` computed."""
        return self._active[: self._active_count[0]]

    def moved_pieces(self) -> np.ndarray:
        """Returns the pieces of wire [k] that may have moved: those computed since the last call, and those that the
        next :meth:`update` computes."""
        pieces = self._piece[self._was_active]
        self._was_active[:] = False
        self._was_active[self.active] = True
        return pieces[pieces >= 0]

    def deflection_at(self, piece: int, x: float, at: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Returns the displacement [3] m of the point ``x`` [m] from the start of a piece of wire, which deflects by
        its ties and by ``force`` [k, 3] N at the points ``at`` [k] m."""
        wires, nodes = self._wires, self._nodes
        support = int(wires.support[piece])
        mine = slice(0, 0) if support < 0 else slice(*nodes.first[support : support + 2].tolist())
        places = np.concatenate([[0.0], wires.node_along[mine], wires.length[[piece]]])
        moved = np.concatenate([np.zeros((1, 3)), self.deflection[mine], np.zeros((1, 3))])
        right = int(np.clip(np.searchsorted(places, x), 1, len(places) - 1))
        low, high = places[right - 1 : right + 1]
        share = (x - low) / max(high - low, 1e-9)
        between = (at >= low) & (at <= high)
        lever = np.maximum(np.minimum(at, x) - low, 0.0) * np.maximum(high - np.maximum(at, x), 0.0)
        lever = np.where(between, lever, 0.0) / max(float(wires.tension[piece]) * (high - low), 1e-9)
        return (1.0 - share) * moved[right - 1] + share * moved[right] + lever @ force

    def place(self, trees: np.ndarray) -> None:
        """Mark sleeping trees [k] as moved to another pose, so that the next :meth:`update` computes the wires and arms
        that hold them.
        """
        self._placed = np.union1d(self._placed, trees).astype(np.int32)

    def update(self) -> None:
        """Compute the deflection of wires and arms in equilibrium with the forces of their trees, and wake sleeping
        trees that it moves. Poses and velocities of awake trees must be up to date.
        """
        plants = self._plants
        awake = self._plants.awake
        if plants.ties.changes != self._tie_changes:
            self._follow_stumps()
        if awake is not self._awake:
            self.place(self._awake)  # a tree that fell asleep was moved to its rest pose
            self._awake = awake
            self._is_listed = False
        if not self._is_listed or len(self._placed):
            self._is_listed = len(self._placed) == 0 and len(self._unloaded) == 0
            self._list_supports()
        count = int(self._active_count[0])
        if count == 0:
            return
        self._is_placed[self._placed] = True
        self._solve(count)
        self._is_placed[self._placed] = False
        self._placed = _NO_TREES
        self._unloaded = _NO_SUPPORTS
        if self._moved_count[0]:
            self._moved_count[0] = 0
            moved = np.flatnonzero(self._is_moved).astype(np.int32)
            self._is_moved[moved] = False
            plants.wake(moved)

    def _follow_stumps(self) -> None:
        """Find the bodies that ties hold and on which trees stand, after cuts have left stumps."""
        plants = self._plants
        self._tie_changes = plants.ties.changes
        nodes = self._nodes
        count = len(self._wire_ties)
        nodes.body[:count] = plants.ties.tie_body[self._wire_ties]
        nodes.number[:count] = plants.ties.number_on_body(self._wire_ties)
        for node, tree in enumerate(self._tree[count:].tolist(), count):
            root = plants.stumps.parts_of(int(plants.model.tree_first[tree]))[0][0]
            nodes.body[node] = root
            nodes.origin[node] = frames.log(plants.joint_settled[root].astype(float))

    def _list_supports(self) -> None:
        """List the supports (wires and arms) of the trees that are awake or marked by :meth:`place`, and find the awake
        trees that share a support.
        """
        trees = np.concatenate([self._awake, self._placed])
        count = self._tree_start[trees + 1] - self._tree_start[trees]
        support = self._tree_supports[spans(self._tree_start[trees], count)]
        supports = np.unique(np.concatenate([support, self._loaded, self._unloaded]))
        self._active_count[0] = len(supports)
        self._active[: len(supports)] = supports
        self._was_active[supports] = True
        of_awake = count[: len(self._awake)].sum()
        pairs = np.unique(np.stack([support, np.repeat(trees, count)])[:, :of_awake], axis=1)
        shared = np.bincount(pairs[0], minlength=len(self._active)) > 1
        self.is_coupled[:] = False
        self.is_coupled[pairs[1, shared[pairs[0]]]] = True


def _along_wires(model: Model, ties: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns for ties [k] to wires: unit vectors [k, 3] along the pieces of wire, the length [k] m of each piece, and
    the distance [k] m of the tie from its start."""
    piece = model.tie_wire[ties]
    start = model.fixed_start[piece].astype(float)
    way = (model.fixed_end - model.fixed_start)[piece].astype(float)
    length = np.linalg.norm(way, axis=1)
    axis = way / length[:, None]
    return axis, length, np.clip(((model.tie_anchor[ties] - start) * axis).sum(1), 0.0, length)


def wire_compliance(model: Model) -> np.ndarray:
    """Returns the compliance [tie] m/N across the wire of the wire at each tie, while no other tie loads it; 0 for an
    anchor that does not move."""
    compliance = np.zeros(len(model.tie_body))
    tied = np.flatnonzero((model.tie_wire >= 0) & (model.fixed_tension[model.tie_wire] > 0.0))
    _, length, along = _along_wires(model, tied)
    tension = model.fixed_tension[model.tie_wire[tied]].astype(float)
    compliance[tied] = along * (length - along) / (length * tension)
    return compliance


def _wire_nodes(plants: ArticulationSolver) -> dict[str, np.ndarray]:
    """Returns the nodes of wires as arrays by name. A node is a tie of a shoot to a wire under tension. Nodes are
    sorted by wire and along each wire.
    """
    model = plants.model
    tied = plants.ties.on_wire
    piece = model.tie_wire[tied]
    axis, length, along = _along_wires(model, tied)
    order = np.lexsort((along, piece))
    tie = tied[order]
    tension = model.fixed_tension[piece[order]].astype(float)
    return {
        "support": piece[order],
        "tie": tie,
        "is_arm": np.zeros(len(tie), bool),
        "axis": axis[order],
        "body": model.tie_body[tie].astype(np.int32),
        "point": model.tie_point[tie].astype(float),
        "origin": model.tie_anchor[tie].astype(float),
        "response": np.ones(len(tie)),
        "compliance": along[order] / tension,
        "whole": length[order] / tension,
    }


def arm_compliance(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns for the roots on arms that twist: body [k]; torsional compliance [k] rad/(N m) of the arm from its clamp
    to the root, and of the whole arm; axis [k, 3] of the arm in the middle axes of the root's joint in the drawn
    shape."""
    pieces = np.flatnonzero(model.arm_is_elastic())
    tree = np.flatnonzero(model.is_on_arm())
    body = model.tree_first[tree]
    here = np.searchsorted(pieces, model.tree_piece[tree])
    start = model.fixed_start[pieces].astype(float)
    way = (model.fixed_end - model.fixed_start)[pieces].astype(float)
    length = np.linalg.norm(way, axis=1)
    axis = (way / length[:, None])[here]
    thick, thin = model.fixed_radius[pieces].astype(float).T
    modulus = model.fixed_shear_modulus[pieces].astype(float)
    twist = _twist(length, thick, thin, modulus)
    _, first, number = np.unique(model.fixed_index[pieces], return_index=True, return_inverse=True)
    before = np.cumsum(twist) - twist
    before -= before[first][number]  # the pieces of an arm are adjacent
    along = np.clip(((model.tree_pose[tree, :3] - start[here]) * axis).sum(1), 0.0, length[here])
    wide = thick[here] + (thin - thick)[here] * along / length[here]
    compliance = before[here] + _twist(along, thick[here], wide, modulus[here])
    drawn = frames.log(model.joint_settled[body].astype(float))
    joint = frames.multiply(model.tree_pose[tree, 3:].astype(float), model.body_rest[body].astype(float))
    # the torque of a spring acts in the middle axes
    axis = frames.rotate(frames.conjugate(frames.multiply(joint, frames.exp(0.5 * drawn))), axis)
    return body, compliance, np.bincount(number, twist)[number][here], axis


def _arm_nodes(plants: ArticulationSolver) -> dict[str, np.ndarray]:
    """Returns the nodes of arms as arrays by name. A node is the root of a tree that stands on an elastic arm. Nodes
    are sorted by arm and along each arm.
    """
    model = plants.model
    body, compliance, whole, axis = arm_compliance(model)
    tree = model.body_tree[body]
    arm = model.fixed_index[model.tree_piece[tree]]
    order = np.lexsort((compliance, arm))
    nodes = {
        "support": len(model.fixed_start) + arm,
        "tie": np.full(len(tree), -1),
        "is_arm": np.ones(len(tree), bool),
        "axis": axis,
        "body": body.astype(np.int32),
        "point": np.zeros((len(tree), 3)),
        "origin": frames.log(model.joint_settled[body].astype(float)),
        "response": _tip_response(plants, tree, axis),
        "compliance": compliance,
        "whole": whole,
    }
    return {name: value[order] for name, value in nodes.items()}


def _twist(length: np.ndarray, thick: np.ndarray, thin: np.ndarray, shear_modulus: np.ndarray) -> np.ndarray:
    """Returns the torsional compliance [...] rad/(N m) of round cones: the integral of 2 / (pi G r^4) along their
    axes."""
    squares = thick * thick + thick * thin + thin * thin
    return 2.0 * length * squares / (3.0 * np.pi * shear_modulus * (thick * thin) ** 3)


def _tip_response(plants: ArticulationSolver, tree: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Returns for each tree the displacement [k] m/rad of the point that moves most, per rotation of the tree's rest
    pose by an arm about ``axis`` [k, 3]. Wires are held fixed."""
    if len(tree) == 0:
        return np.zeros(0)
    plants.root_rests.turn[tree] = axis
    _, distance, _ = EquilibriumFinder(plants).residual_motion(tree.astype(np.int32))
    plants.root_rests.turn[tree] = 0.0
    return np.maximum(distance.astype(float), 1e-9)


def _springs_in_series(
    compliance: np.ndarray, whole: np.ndarray, is_free: np.ndarray, first: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the stiffness [node] of the part of a support (wire or arm) between each node and the node before, and
    the stiffness [support] of the part after its last node, which is 0 for a free end.

    ``compliance`` [node]: compliance from the support's start to the node. ``whole`` [node]: compliance of the node's
    whole support. ``is_free`` [node]: whether the end of the node's support is free. ``first`` [support]: first node of
    each support.
    """
    before = np.append(0.0, compliance[:-1])[: len(compliance)]
    before[first] = 0.0
    last = np.append(first[1:], len(compliance))[: len(first)] - 1
    behind = np.maximum(whole[last] - compliance[last], LEAST_SHARE * whole[last])
    return 1.0 / np.maximum(compliance - before, LEAST_SHARE * whole), np.where(is_free[last], 0.0, 1.0 / behind)
