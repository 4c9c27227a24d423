"""Wood and ties that give: peduncles that break off at either end, canes that keep a set, crack and break, ties that
slip along their wires and break.

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
from vinesim.scene.strength import BendingLaw, stalk_ends

PULL = "pull"
BEND = "bend"
TWIST = "twist"
"""Causes of a break: the load that uses most of the strength."""
SLIP = "slip"
UNTIE = "untie"
CRACK = "crack"
NOTCH = "notch"
"""Kinds of :class:`~vinesim.scene.values.Breakage`."""
PATIENCE = 0.5
"""[s] Time for which the wood of a tree is watched after the tree was last pushed, held, blown or fast. DERIVED: longer
than a swing is slow at its turning point."""
SLIP_PAUSE = 0.2
"""[s] A tie that slips again after a shorter pause has not stopped: it is one event."""
PLASTIC = 0
FRACTURE = 1
"""Columns of :attr:`WoodMonitor.work`."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Overload:
    """A piece of wood that has broken or cracked in the last step. What has broken is still on its tree."""

    body: int
    """The body beyond the joint in which the wood broke."""
    bunch: int
    """Index of the bunch whose peduncle broke, -1 for a cane."""
    cause: str
    """:data:`PULL`, :data:`BEND` or :data:`TWIST`."""
    wrench: np.ndarray
    """[6] force [N] of the tree on the body when it broke, and moment [N m] about the joint, world axes."""
    late: float = 0.0
    """[s] Time from the break to the end of the step."""
    is_crack: bool = False
    """Whether the wood has only cracked."""


class WoodMonitor:
    """Finds the wood of awake trees that gives under its load.

    A joint of a cane whose elastic moment passes its capacity (:class:`vinesim.scene.strength.BendingLaw`) keeps a set:
    its rest pose turns until the moment is the capacity, and its present pose stays. A joint that will pass its
    capacity in the next step turns its rest pose one step earlier, by phi (implicitness of the integrator) times the
    expected turn. So the next step is solved with a moment equal to the capacity: a fast hand does not feel more than
    the wood bears.
    A brittle joint breaks in the step in which its moment is nearest to its strength.

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
        self._any_held = False
        self.left = np.ones((bunches, 2))
        """[bunch, 2] Shares of the strengths of peduncles in tension and bending that cuts in part have left."""
        self._wrenches: dict[int, tuple[int, int, np.ndarray]] = {}
        """Tick, body and wrench of the overloaded end of each overloaded bunch in the last step."""
        self.law = cane_law(model)
        """[body] How the joints of canes give."""
        self._whole_law = self.law
        self._section = np.ones((count := len(model.body_mass), 2))
        """[body, 2] Shares of cross-section and section modulus that cuts in part have left of the canes' joints."""
        self.work = np.zeros((count, 2))
        """[body, 2] J, work that the wood at each joint has taken up so far: for its set, and for its crack."""
        self.given: set[int] = set()
        """Trees whose wood or ties gave in the last step."""
        self.tie_work = 0.0
        """[J] Work that ties have taken up so far by slipping and breaking."""
        self._slip_tick = np.full(len(model.tie_body), -(1 << 40), np.int64)
        self._bind()
        self.read_state()

    def _bind(self) -> None:
        plants = self.plants
        model = plants.model
        pull, bend = strengths(model, self._ends)
        buffers = plants.buffers
        self._stress = buffers.pinned(np.zeros((buffers.slot_count, 2), np.float32))
        self._watch = buffers.pinned(np.zeros(len(model.tree_first), np.int32))
        """[tree] Number of steps for which the wood of each tree will yet be watched."""
        self._is_held = buffers.pinned(np.zeros(len(model.tree_first), np.bool_))
        self._largest = buffers.pinned(np.zeros(3, np.float32))
        self._capacity = buffers.pinned(np.full(buffers.slot_count, np.inf, np.float32))

        def constant(values: np.ndarray, dtype: type) -> wp.array:
            there = np.zeros(buffers.slot_count, values.dtype)
            there[buffers.slots] = values
            return wp.array(there, dtype=dtype, device=buffers.device)

        wood = kernels.WoodStrength()
        wood.kind = constant(self._kind, wp.int32)
        wood.pull = constant(pull, wp.float32)
        wood.bend = constant(bend, wp.float32)
        wood.tie_slip, wood.tie_strength, wood.tie_axis = (
            buffers.arrays[name] for name in ("tie_slip", "tie_strength", "tie_axis")
        )
        self._strengths = wood
        self._find = plants.launches.wood_stress(
            wood,
            buffers.reach(self._capacity, wp.float32, "wood_capacity"),
            buffers.reach(self._is_held, wp.bool, "tree_held"),
            max(1, round(PATIENCE / plants.dt)),
            buffers.reach(self._watch, wp.int32, "wood_watch"),
            buffers.reach(self._stress, wp.vec2, "wood_stress"),
            buffers.reach(self._largest, wp.float32, "largest_stress"),
        )

    def read_state(self, bodies: np.ndarray | None = None) -> None:
        """Read from the state how far the wood of ``bodies`` [k] (default: all) has given."""
        bodies = np.arange(len(self._kind)) if bodies is None else bodies
        bodies = bodies[self._kind[bodies] == int(kernels.CANE)]
        capacity = self.law[bodies].capacity(self.plants.state.joint_flow[bodies])
        self._capacity[self.plants.buffers.slots[bodies]] = np.maximum(capacity, 1e-6)

    def _is_watched(self) -> np.ndarray:
        """Returns whether the stress of each tree in the last step is known [tree] bool."""
        return self.plants.state.tree_awake & (self._watch > 0)

    def used_strength(self) -> np.ndarray:
        """Returns for each cane of the watched trees the bending moment at its joint in the last step as a share of the
        moment that cracks it [body]; 0 for all other bodies."""
        model = self.plants.model
        live = (self._kind == int(kernels.CANE)) & self._is_watched()[model.body_tree]
        live &= ~self.plants.state.body_cut
        stress = self._stress[self.plants.buffers.slots, 0]
        return np.where(live, stress / np.maximum(self.law.breaks, 1e-12), 0.0)

    def update(self) -> list[Overload]:
        """Let wood give, and find the wood that has broken or cracked in the last step: peduncles, then canes, each
        sorted by number. Call it once after each step."""
        plants = self.plants
        if self.given:
            self.given = set()
        if len(plants.awake) == 0:
            return []
        self._largest[:] = 0.0
        held = plants.held_bodies
        if held or self._any_held:
            self._is_held[:] = False
            self._is_held[plants.model.body_tree[held]] = True
            self._any_held = bool(held)
        self._find(len(plants.awake))
        plants.buffers.synchronize()
        found = self._break_stalks() if self._largest[0] >= 1.0 or self._load_time.any() else []
        if self._largest[1] >= 1.0:
            found += self._bend_canes()
        return found

    def give_ties(self) -> list[tuple[str, int, np.ndarray]]:
        """Let ties slip and break that bear too much. Call it after :meth:`update`. Returns the kind, the tie and its
        force [3] N on its body for each tie that broke or began to slip, sorted by tie."""
        if self._largest[2] <= 1.0 or len(self.plants.awake) == 0:
            return []
        plants = self.plants
        model = plants.model
        state = plants.state
        ties = plants.ties
        tree = model.body_tree[model.tie_body]
        live = np.flatnonzero(self._is_watched()[tree] & ~self._is_remote[tree] & ~state.tie_broken)
        pose = state.body_q[model.tie_body[live]].astype(float)
        point = pose[:, :3] + frames.rotate(pose[:, 3:], model.tie_point[live].astype(float))
        stiffness = ties.stiffness[live].astype(float)
        pull = stiffness[:, None] * (ties.anchor[live] - point)
        size = np.linalg.norm(pull, axis=1)
        along = (pull * ties.axis[live]).sum(1)
        over = np.abs(along) - ties.slip[live]
        breaks = size > ties.strength[live]
        found = []
        for i in np.flatnonzero(breaks | (over > 0.0)).tolist():
            tie = int(live[i])
            self.given.add(int(tree[tie]))
            if breaks[i]:
                plants.break_tie(tie)
                self.tie_work += 0.5 * float(size[i]) ** 2 / float(stiffness[i])
                found.append((UNTIE, tie, pull[i]))
                continue
            way = float(over[i] / stiffness[i])
            plants.slide_tie(tie, -math.copysign(way, along[i]))
            self.tie_work += (abs(float(along[i])) - 0.5 * float(over[i])) * way
            if (plants.tick - self._slip_tick[tie]) * plants.dt > SLIP_PAUSE:
                found.append((SLIP, tie, pull[i]))
            self._slip_tick[tie] = plants.tick
        return found

    def _bend_canes(self) -> list[Overload]:
        """Let canes give whose moment passes their capacity, or will pass it in the next step. Returns those that crack
        or break."""
        plants = self.plants
        model = plants.model
        state = plants.state
        slots = plants.buffers.slots
        tree = model.body_tree
        live = (self._kind == int(kernels.CANE)) & self._is_watched()[tree] & ~state.body_cut & ~self._is_remote[tree]
        bodies = np.flatnonzero(live & (self._stress.max(1)[slots] >= self._capacity[slots])).astype(np.int32)
        if len(bodies) == 0:
            return []
        moment, ahead = self._stress[slots[bodies]].T.astype(float)
        further = np.maximum(ahead - moment, 0.0)
        turn = frames.log(whole := state.joint_q[bodies].astype(float))
        roots = model.body_parent[bodies] < 0
        turn[roots] -= plants.root_rests.turn[tree[bodies[roots]]]
        angle = np.maximum(np.linalg.norm(turn, axis=1), 1e-9)
        stiffness = np.maximum(moment / angle, 1e-9)
        law = self.law[bodies]
        flow = state.joint_flow[bodies].astype(float)
        end = (law.hardening + law.cracking) * (1.0 - 1e-9)
        after = law.give(flow, moment, stiffness)
        # the share of the next step's flow at which its equations have the moment that the law allows
        expected = law.give(after, moment - stiffness * (after - flow) + further, stiffness)
        phi = plants.phi_used[tree[bodies]]
        snaps = (after < end) & (expected >= end) & (2.0 * (law.capacity(after) - moment) < phi * further)
        after = np.where(expected < end, after + phi * (expected - after), np.where(snaps, expected, after))
        given = np.minimum(after - flow, angle)
        breaks = after >= end
        cracks = (after > law.hardening) & (flow <= law.hardening)
        brittle = np.maximum(after - np.maximum(flow, law.hardening), 0.0) / np.maximum(after - flow, 1e-30)
        lost = (moment - 0.5 * stiffness * given) * given
        self.work[bodies, PLASTIC] += np.where(breaks, 0.0, (1.0 - brittle) * lost)
        self.work[bodies, FRACTURE] += np.where(breaks, 0.5 * moment * angle, brittle * lost)
        events = np.flatnonzero(breaks | cracks)
        wrenches = plants.joint_wrench(bodies[events]).astype(float) if len(events) else np.zeros((0, 6))
        state.joint_flow[bodies] = after
        self._stress[slots[bodies], 0] = moment - stiffness * given
        turned = frames.exp(frames.log(whole) - (given / angle)[:, None] * turn)
        part = frames.multiply(whole, frames.conjugate(turned))
        plants.set_set(bodies, frames.multiply(state.joint_set[bodies].astype(float), part))
        self.read_state(bodies)
        self.given.update(tree[bodies].tolist())
        return [
            Overload(int(bodies[i]), -1, self._cause(int(bodies[i]), wrench), wrench, is_crack=not breaks[i])
            for i, wrench in zip(events.tolist(), wrenches, strict=True)
        ]

    def weaken(self, bunch: int, pull: float, bend: float) -> None:
        """Leave a peduncle, which is cut in part, the shares ``pull`` and ``bend`` [1] of its strength."""
        model = self.plants.model
        self.left[bunch] = pull, bend
        slots = self.plants.buffers.slots[self._ends[bunch]]
        for values, strength in (
            (self._strengths.pull, pull * model.bunch_pull[bunch]),
            (self._strengths.bend, bend * model.bunch_bend[bunch]),
        ):
            there = values.numpy()
            there[slots] = strength
            values.assign(there)

    def notch_cane(self, body: int, area: float, modulus: float) -> None:
        """Leave the wood at the joint of a cane, which is cut in part, the shares ``area`` [1] of its cross-section and
        ``modulus`` [1] of its section modulus. 1 and 1: the wood is whole."""
        model = self.plants.model
        if model.body_strength[body] <= 0.0:
            return
        self._section[body] = area, modulus
        self.law = self._whole_law.notched(self._section[:, 0], self._section[:, 1])
        pull = self._strengths.pull.numpy()
        whole = float(model.body_strength[body] * np.pi * model.body_radius[body, 0] ** 2)
        pull[self.plants.buffers.slots[body]] = max(area, 1e-6) * whole
        self._strengths.pull.assign(pull)
        self.read_state(np.array([body]))

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
        watched = self._is_watched()[tree] & state.bunch_attached & ~self._is_remote[tree]
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
                found.append(Overload(body, bunch, self._cause(body, wrench, bunch), wrench, late))
        return found

    def _cause(self, body: int, wrench: np.ndarray, bunch: int = -1) -> str:
        """Returns the load that uses most of the strength of a peduncle (of ``bunch``) or cane at the joint of
        ``body``."""
        model = self.plants.model
        wood = int(model.body_parent[body]) if model.body_organ[body] == int(Organ.BUNCH) else body
        if bunch >= 0:
            pull = float(model.bunch_pull[bunch])
            bend = float(model.bunch_bend[bunch])
        else:
            pull = float(model.body_strength[body] * np.pi * model.body_radius[body, 0] ** 2)
            bend = float(self.law.breaks[body])
        pose = self.plants.state.body_q[max(wood, 0)].astype(float)
        axis = frames.rotate(pose[3:], np.array([1.0, 0.0, 0.0]))
        twist = float(wrench[3:] @ axis)
        bending = float(np.linalg.norm(wrench[3:] - twist * axis))
        shares = {
            PULL: -float(wrench[:3] @ axis) / pull,
            BEND: bending / bend,
            TWIST: 0.5 * math.sqrt(3.0) * abs(twist) / bend,
        }
        return max(shares, key=lambda cause: shares[cause])


def cane_law(model: Model) -> BendingLaw:
    """Returns how the joints of canes give [body]."""
    return BendingLaw.of(
        model.body_radius[:, 0],
        model.joint_stiffness[:, 2],
        model.body_strength,
        model.body_yield_strength,
        model.body_toughness,
    )


def strengths(model: Model, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the tension [body] N float32 at which the wood at each joint breaks, and the bending moment [body] N m at
    which a peduncle breaks there; 1 for canes. ``ends``: see :func:`wood_kinds`."""
    pull = np.full(len(model.body_mass), np.inf, np.float32)
    bend = np.ones(len(pull), np.float32)
    strong = model.body_strength > 0.0
    pull[strong] = (model.body_strength * np.pi * model.body_radius[:, 0] ** 2)[strong]
    for end in ends.T:
        pull[end] = model.bunch_pull
        bend[end] = model.bunch_bend
    return pull, bend


def wood_kinds(model: Model, ends: np.ndarray) -> np.ndarray:
    """Returns for each body what the wood at its joint is [body] int32, as a number of
    :mod:`vinesim.kernels.plants.wood_stress`. ``ends``: result of :func:`vinesim.scene.strength.stalk_ends`."""
    kind = np.zeros(len(model.body_mass), np.int32)
    kind[(model.body_organ == int(Organ.CANE)) & (model.body_strength > 0.0)] = int(kernels.CANE)
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
