"""Wires that shoots are tied to: they give, and so the shoots of one wire move each other.

See :mod:`vinesim.kernels.articulation.wires`. Only wires of trees that are awake are computed. Their anchors in the tie
table are the wires' places, so that the trees, the sleep of trees and joint wrenches need not know of wires.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.kernels.articulation import wires as kernels
from vinesim.kernels.launch import bind_launch
from vinesim.physics.contact.warp_arrays import SharedArrays, share
from vinesim.physics.parameters import PhysicsParameters
from vinesim.physics.plants.articulation_solver import ArticulationSolver
from vinesim.physics.plants.berry_clusters import spans

WAKE_SHARE = 0.25
"""[1] A sleeping tree wakes when a wire has moved one of its ties by this share of ``sleep_distance``. TUNED: twenty
shoots that sleep on a wire hold it with 2 N until then."""

_NO_TREES = np.zeros(0, np.int32)


class Wires:
    """The wires of one model: pieces of wire under tension, of which at least one tie says that it is bound to them."""

    def __init__(self, plants: ArticulationSolver, parameters: PhysicsParameters = PhysicsParameters()) -> None:
        """``parameters``: ``sleep_distance`` says when a tree wakes."""
        self._plants, model = plants, plants.model
        tied = plants.ties.on_wire
        piece = model.tie_wire[tied]
        start, way = model.fixed_start[piece].astype(float), (model.fixed_end - model.fixed_start)[piece].astype(float)
        length = np.linalg.norm(way, axis=1)
        axis = way / length[:, None]
        along = np.clip(((model.tie_anchor[tied] - start) * axis).sum(1), 0.0, length)
        order = np.lexsort((along, piece))
        self.tie = tied[order]
        """[node] The model's tie that is bound there; wire by wire, from its start to its end."""
        self.pieces, first = np.unique(piece[order], return_index=True)
        """[wire] Which piece of the model's fixed structure it is, sorted."""
        body = model.tie_body[self.tie]
        self._tree = model.body_tree[body].astype(np.int32)
        self._wire = np.repeat(np.arange(len(first)), np.diff([*first, len(order)]))
        by_tree = np.argsort(self._tree, kind="stable")
        self._tree_wires = self._wire[by_tree].astype(np.int32)
        trees = len(model.tree_first)
        self._tree_start = np.searchsorted(self._tree[by_tree], np.arange(trees + 1)).astype(np.int32)
        self.deflection = np.zeros((len(order), 3))
        """[node, 3] m from where the wire is when nothing has moved."""
        self._active, self._is_moved = np.zeros(len(first), np.int32), np.zeros(trees, np.bool_)
        self._active_count, self._moved_count = 0, np.zeros(1, np.int32)
        self.is_coupled = np.zeros(trees, np.bool_)
        """[tree] Whether another tree that is awake is tied to one of its wires."""
        self._is_placed = np.zeros(trees, np.bool_)
        self._awake, self._placed, self._is_listed = _NO_TREES, _NO_TREES, False
        first_tie = np.searchsorted(model.tie_body, model.tie_body)
        arrays = {
            "wire_first": np.append(first, len(order)).astype(np.int32),
            "wire_length": length[order][first],
            "wire_tension": model.fixed_tension[self.pieces].astype(float),
            "wire_axis": axis[order][first],
            "along": along[order],
            "body": body.astype(np.int32),
            "tree": self._tree,
            "number": (self.tie - first_tie[self.tie]).astype(np.int32),
            "point": model.tie_point[self.tie].astype(float),
            "anchor": model.tie_anchor[self.tie].astype(float),
        }
        self.along = arrays["along"]
        """[node] m from the wire's start."""
        plants.ties.axis[self.tie] = axis[order]
        self._bind(arrays, WAKE_SHARE * parameters.sleep_distance)

    def _bind(self, nodes: dict[str, np.ndarray], wake_distance: float) -> None:
        plants, ties, count = self._plants, self._plants.ties, len(self.tie)
        state = plants.state
        shape = {
            "deflection": self.deflection, "reference": np.zeros((count, 3)), "ratio": np.zeros(count),
            "velocity": np.zeros((count, 3)), "share": np.zeros(count),
        }  # fmt: skip
        table = {
            "span": ties.span, "stiffness": ties.stiffness, "anchor": ties.anchor,
            "anchor_velocity": ties.anchor_velocity, "softening": ties.softening,
        }  # fmt: skip
        self._solve = bind_launch(
            kernels.deflect_wires,
            [SharedArrays(kernels.WireNodes, **nodes).struct, wake_distance, share(self._active, wp.int32),
             share(state.tree_awake, wp.bool), share(self._is_placed, wp.bool), share(state.body_q, wp.transform),
             share(state.body_qd, wp.spatial_vector)],
            [SharedArrays(kernels.WireShape, **shape).struct, SharedArrays(kernels.WireTies, **table).struct,
             share(self._is_moved, wp.bool), share(self._moved_count, wp.int32)],
        )  # fmt: skip

    @property
    def active(self) -> np.ndarray:
        """The wires [k] that the last :meth:`update` computed."""
        return self._active[: self._active_count]

    def place(self, trees: np.ndarray) -> None:
        """Let the next :meth:`update` see that sleeping trees [k] were put somewhere else."""
        self._placed = np.union1d(self._placed, trees).astype(np.int32)

    def update(self) -> None:
        """Bring the wires to where the trees hold them, and wake the trees whose ties they move. Poses and velocities
        of awake trees must be up to date."""
        plants, awake = self._plants, self._plants.awake
        if awake is not self._awake:
            self.place(self._awake)  # what fell asleep was put to its resting place by that
            self._awake, self._is_listed = awake, False
        if not self._is_listed or len(self._placed):
            self._is_listed = len(self._placed) == 0
            self._list_wires()
        if self._active_count == 0:
            return
        self._is_placed[self._placed] = True
        self._solve(self._active_count)
        self._is_placed[self._placed] = False
        self._placed = _NO_TREES
        if self._moved_count[0]:
            self._moved_count[0] = 0
            moved = np.flatnonzero(self._is_moved).astype(np.int32)
            self._is_moved[moved] = False
            plants.wake(moved)

    def _list_wires(self) -> None:
        """List the wires of the trees that are awake or were put somewhere; note who shares them."""
        trees = np.concatenate([self._awake, self._placed])
        count = self._tree_start[trees + 1] - self._tree_start[trees]
        wire = self._tree_wires[spans(self._tree_start[trees], count)]
        wires = np.unique(wire)
        self._active_count = len(wires)
        self._active[: len(wires)] = wires
        of_awake = count[: len(self._awake)].sum()
        pairs = np.unique(np.stack([wire, np.repeat(trees, count)])[:, :of_awake], axis=1)
        shared = np.bincount(pairs[0], minlength=len(self.pieces)) > 1
        self.is_coupled[:] = False
        self.is_coupled[pairs[1, shared[pairs[0]]]] = True
