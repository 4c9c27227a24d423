"""Wood that gives: peduncles that break off at either end.

A kernel finds the stress in the wood of all awake trees (:mod:`vinesim.kernels.plants.wood_stress`). The rest of this
module deals with the few pieces of wood whose stress is near their strength. Only the client that owns a tree lets its
wood give; the other clients learn it from records.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.kernels.plants import wood_stress as kernels
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters

PULL = "pull"
BEND = "bend"
TWIST = "twist"
"""Causes of a break: the load that uses most of the strength."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Overload:
    """A piece of wood that has broken in the last step, before it is taken off its tree."""

    body: int
    """The body beyond the joint in which the wood broke."""
    bunch: int
    """Index of the bunch whose peduncle broke, -1 for a cane."""
    cause: str
    """:data:`PULL`, :data:`BEND` or :data:`TWIST`."""
    wrench: np.ndarray
    """[6] force [N] of the tree on the body when it broke, and moment [N m] about the joint, world axes."""
    late: float
    """[s] Time from the break to the end of the step."""


class WoodMonitor:
    """Finds the wood of awake trees that breaks under its load.

    A peduncle breaks at the end where its stress is larger, after it has been overloaded for ``detachment_duration``
    seconds without a pause. Time under load is counted within steps, from the moment at which the stress passed the
    strength if it grew evenly in the step.
    """

    def __init__(
        self,
        plants: ArticulationSolver,
        is_remote: np.ndarray,
        parameters: PhysicsParameters = PhysicsParameters(),
    ) -> None:
        """``is_remote``: [tree] bool, trees of other clients, whose wood does not break here. The array is read in
        every step."""
        self.plants = plants
        self._is_remote = is_remote
        self._duration = parameters.detachment_duration
        model = plants.model
        self._ends = stalk_ends(model)
        self._kind = wood_kinds(model, self._ends)
        bunches = len(model.bunch_body)
        self._load_time = np.zeros(bunches)
        self._used_before = np.zeros(bunches)
        self._wrenches: dict[int, tuple[int, int, np.ndarray]] = {}
        """Tick, body and wrench of the overloaded end of each overloaded bunch in the last step."""
        self._bind()

    def _bind(self) -> None:
        plants = self.plants
        model = plants.model
        count = len(model.body_mass)
        pull = np.full(count, np.inf, np.float32)
        bend = np.ones(count, np.float32)
        for end in self._ends.T:
            pull[end] = model.bunch_pull
            bend[end] = model.bunch_bend
        buffers = plants.buffers
        self._stress = buffers.pinned(np.zeros((buffers.slot_count, 2), np.float32))
        self._largest = buffers.pinned(np.zeros(2, np.float32))
        self._capacity = buffers.pinned(np.full(buffers.slot_count, np.inf, np.float32))

        def constant(values: np.ndarray, dtype: type) -> wp.array:
            there = np.zeros(buffers.slot_count, values.dtype)
            there[buffers.slots] = values
            return wp.array(there, dtype=dtype, device=buffers.device)

        wood = kernels.WoodStrength()
        wood.kind = constant(self._kind, wp.int32)
        wood.pull = constant(pull, wp.float32)
        wood.bend = constant(bend, wp.float32)
        self._find = plants.launches.wood_stress(
            wood,
            buffers.reach(self._capacity, wp.float32, "wood_capacity"),
            buffers.reach(self._stress, wp.vec2, "wood_stress"),
            buffers.reach(self._largest, wp.float32, "largest_stress"),
        )

    def update(self) -> list[Overload]:
        """Find the wood that has broken in the last step, sorted by body. Call it once after each step."""
        plants = self.plants
        if len(plants.awake) == 0:
            return []
        self._largest[:] = 0.0
        self._find(len(plants.awake))
        plants.buffers.synchronize()
        return self._break_stalks() if self._largest[0] >= 1.0 or self._load_time.any() else []

    def forget(self, bunch: int) -> None:
        """Forget the load on the peduncle of a bunch that was picked."""
        self._load_time[bunch] = self._used_before[bunch] = 0.0
        self._wrenches.pop(bunch, None)

    def _break_stalks(self) -> list[Overload]:
        """Count the time for which peduncles are overloaded. Returns those that break."""
        plants = self.plants
        model = plants.model
        state = plants.state
        tree = model.body_tree[model.bunch_body]
        watched = state.tree_awake[tree] & state.bunch_attached & ~self._is_remote[tree]
        stress = self._stress[plants.buffers.slots[self._ends], 0]
        used = np.where(watched, stress.max(1), 0.0)
        before = self._used_before
        share = np.where(before < 1.0, (used - 1.0) / np.maximum(used - before, 1e-9), 1.0)
        self._load_time = np.where(used > 1.0, self._load_time + share * plants.dt, 0.0)
        self._used_before = used
        loaded = np.flatnonzero(self._load_time > 0.0)
        end = self._ends[loaded, stress[loaded].argmax(1)]
        wrenches = plants.joint_wrench(end) if len(end) else np.zeros((0, 6))
        known, self._wrenches = self._wrenches, {}
        found = []
        for bunch, body, wrench in zip(loaded.tolist(), end.tolist(), wrenches.astype(float), strict=True):
            self._wrenches[bunch] = plants.tick, body, wrench
            late = float(self._load_time[bunch]) - self._duration
            if late >= -1e-9 * self._duration:
                late = max(late, 0.0)
                tick, same, old = known.get(bunch, (-1, -1, wrench))
                if (tick, same) == (plants.tick - 1, body):
                    wrench = wrench + (old - wrench) * min(late / plants.dt, 1.0)
                found.append(Overload(body, bunch, self._cause(bunch, body, wrench), wrench, late))
        return found

    def _cause(self, bunch: int, body: int, wrench: np.ndarray) -> str:
        """Returns the load that uses most of the strength of a peduncle at the joint of ``body``."""
        model = self.plants.model
        wood = body if model.body_organ[body] == int(Organ.PEDUNCLE) else int(model.body_parent[body])
        pose = self.plants.state.body_q[max(wood, 0)].astype(float)
        axis = frames.rotate(pose[3:], np.array([1.0, 0.0, 0.0]))
        twist = float(wrench[3:] @ axis)
        bending = float(np.linalg.norm(wrench[3:] - twist * axis))
        bend = float(model.bunch_bend[bunch])
        shares = {
            PULL: -float(wrench[:3] @ axis) / float(model.bunch_pull[bunch]),
            BEND: bending / bend,
            TWIST: 0.5 * math.sqrt(3.0) * abs(twist) / bend,
        }
        return max(shares, key=lambda cause: shares[cause])


def stalk_ends(model: Model) -> np.ndarray:
    """Returns for each bunch the bodies beyond the two joints at which its peduncle ends [bunch, 2]: the first segment
    of the peduncle, at the shoot, and the bunch. A bunch without a peduncle has its own body twice."""
    base = model.bunch_body.copy()
    above = model.body_parent[base]
    while (is_stalk := (above >= 0) & (model.body_organ[above] == int(Organ.PEDUNCLE))).any():
        base = np.where(is_stalk, above, base)
        above = np.where(is_stalk, model.body_parent[above], above)
    return np.stack([base, model.bunch_body], 1).astype(np.int32)


def wood_kinds(model: Model, ends: np.ndarray) -> np.ndarray:
    """Returns for each body what the wood at its joint is [body] int32, as a number of
    :mod:`vinesim.kernels.plants.wood_stress`. ``ends``: result of :func:`stalk_ends`."""
    kind = np.zeros(len(model.body_mass), np.int32)
    kind[ends[:, 0]] = int(kernels.STALK_BASE)
    kind[ends[:, 1]] = int(kernels.STALK_END)
    alone = model.body_parent[model.bunch_body] < 0  # tension is measured along the bunch itself
    kind[model.bunch_body[alone]] = int(kernels.STALK_BASE)
    return kind


def distance_from_base(model: Model, body: int) -> float:
    """Returns the distance [m] along the wood from the base of a tree to the joint of ``body``."""
    way = 0.0
    while model.body_parent[body] >= 0:
        way += float(np.linalg.norm(model.body_offset[body].astype(float)))
        body = int(model.body_parent[body])
    return way
