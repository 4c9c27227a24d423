"""Kernels of the articulation solver, each bound once to its arrays, and the transfers of rows around them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from vinesim.kernels.articulation import first_mode, structs
from vinesim.kernels.articulation.eight_trees import predict_groups
from vinesim.kernels.articulation.energy_budget import (
    CLOSELY,
    MIN_PHI,
    NO_LIMIT,
    begin_budget,
    choose_budget,
    keep_budget,
)
from vinesim.kernels.articulation.floating_components import correct_floating_momentum
from vinesim.kernels.articulation.impulse_response import apply_wrenches, impulse_response
from vinesim.kernels.articulation.integration import integrate
from vinesim.kernels.articulation.joint_wrench import joint_wrench
from vinesim.kernels.articulation.kinematics import forward_kinematics
from vinesim.kernels.articulation.lane_records import LANES, RECORD
from vinesim.kernels.articulation.lean_prediction import predict_lean
from vinesim.kernels.articulation.prediction import predict
from vinesim.kernels.launch import BoundLaunch as Launch
from vinesim.kernels.launch import bind_launch, bound, join_partitions
from vinesim.kernels.shared_launch import LaunchPool
from vinesim.physics.parameters import PhysicsParameters

if TYPE_CHECKING:
    from vinesim.physics.plants.articulation_solver import ArticulationSolver

TREES_PER_CHUNK = {"predict": 2, "integrate": 16, "wrenches": 4}
"""Trees that a thread takes at a time: work of 3 to 8 us, beside which taking them is nothing. DERIVED from the times
of one tree of 17 bodies."""
STEP_INPUTS = ("body_load", "body_wrench", "joint_x", "joint_xd", "joint_q", "joint_qd")
"""Rows that are carried to the device before every prediction."""
DEVICE_RESULTS = (
    "body_q", "body_qd", "joint_xd_free", "joint_qd_free", "body_acceleration", "body_qd_free", "body_impulse",
)  # fmt: skip
"""Rows that kernels write, or that are carried over when they are needed."""
TREE_INPUTS = (
    "stepping", "tree_moving", "tree_phi", "tree_euler_steps", "tree_steps", "tree_rate", "tree_awake", "tree_budget",
    "tree_air", "root_turn", "root_turn_rate", "tie_stiffness", "tie_damping", "tie_anchor", "tie_anchor_velocity",
)  # fmt: skip
"""Lists and numbers of trees and ties that kernels of a step read."""
TREE_RESULTS = ("tree_euler_steps", "phi_used", "tree_rate")
"""Numbers of trees that they write."""
SCRATCH = {
    wp.vec3: ("lever", "tension", "Du"),
    wp.quat: ("axes",),
    wp.mat33: ("J", "H", "M", "D", "DJ", "DH", "root_inverse_mass"),
    wp.transform: ("after_q",),
    wp.spatial_vector: (
        "bias", "subtree_wrench", "added_acceleration", "before", "after_qd", "impact_acceleration", "impact_velocity",
    ),
}  # fmt: skip
"""Rows that only kernels see."""


def kernel_parameters(
    p: PhysicsParameters, dt: float, fast_rate: float, max_rate: float, fault_rate: float, geometric_stiffness: bool
) -> dict[str, Any]:
    """Fields of :class:`vinesim.kernels.articulation.structs.SolverParameters`."""
    return {
        "dt": dt, "fast_rate": fast_rate, "max_rate": max_rate, "fault_rate": fault_rate,
        "contact_steps": max(1, round(p.contact_onset_duration / dt)) + 1,
        "geometric_stiffness": float(geometric_stiffness), "gravity": wp.vec3(0.0, 0.0, -p.gravity),
    }  # fmt: skip


BUDGET_PERIOD = 8
"""Steps in one of which energy is looked at while no tree is watched."""

MIN_CAPACITY = 16
"""Bodies that a list holds at least."""


@dataclasses.dataclass(frozen=True)
class JointWrenches:
    """Wrenches that joints carried in the last step."""

    places: np.ndarray
    """[joint] int32 bodies, where kernels find them: to be written by the caller."""
    carried: np.ndarray
    """[joint, 6] N, N m"""
    compute: Launch
    """Fills :attr:`carried` of the first joints."""


@dataclasses.dataclass(frozen=True)
class Step:
    """The launches of a step on the same arrays."""

    predict_groups: Launch
    """Over groups of trees; on a GPU each tree is a group."""
    predict: Launch
    integrate: Callable[..., None]
    correct_floating_momentum: Launch


class KernelLaunches:
    """Launches of the articulation kernels on the arrays of one solver.

    Arrays of the model are constants. What has a row for each body a GPU keeps a copy of, see
    :mod:`vinesim.physics.plants.device_buffers`: :data:`STEP_INPUTS`, :data:`DEVICE_RESULTS`, and all others, which
    :meth:`upload_changed` carries over when :attr:`changed` says so. Everything else a GPU reads where it is, which in
    many steps on end would cost more than the steps: those have copies of :data:`TREE_INPUTS` as well, and launches of
    their own (:attr:`resident`), with :meth:`upload_trees` before and :meth:`download_trees` after.
    """

    def __init__(
        self, solver: ArticulationSolver, parameters: dict[str, float], pool: LaunchPool, max_substeps: int
    ) -> None:
        """``parameters``: numbers of :class:`vinesim.kernels.articulation.structs.SolverParameters` but gravity;
        ``pool``: threads that share the launches over trees."""
        self.buffers, self._pool, self._max_substeps = solver.buffers, pool, max_substeps
        self._body_tree = solver.model.body_tree
        self.changed = False
        """Whether model rows (parents, masses, springs) differ from the device's copies."""
        self.substeps_due = False
        """Whether they have changed since the substeps of trees were counted."""
        self._budgeted = np.zeros(0, np.int32)
        self._keeps_budgets, self._watches_closely, self._budget_phase = False, False, -1
        self._seldom: list[str] = []
        self._register_arrays(solver)
        self._record_transfers()
        self._arrays = self.buffers.arrays
        self.parameters = self.fill(structs.SolverParameters, **parameters)
        self._record_step(self.parameters)
        self.shared = Step(
            self.predict_groups or self.predict, self.predict, self.integrate, self.correct_floating_momentum
        )
        """The launches of a step on what NumPy sees."""
        self.resident = self.shared
        """Those of steps between which nothing comes back to the host."""
        self.resident_arrays = self.buffers.arrays
        """The arrays that these work on."""
        if self.buffers.has_copies:
            self._record_resident(self.parameters)
        self._record_impact(
            self.fill(structs.SolverParameters, **(parameters | {"fast_rate": math.inf, "geometric_stiffness": 0.0}))
        )
        self.response_capacity = 0
        self._joint_wrenches = self.record_joint_wrenches(1)  # or the first bunch that is picked would wait for it

    # ------------------------------------------------------------------ arrays

    def _register_arrays(self, solver: ArticulationSolver) -> None:
        buffers, model = self.buffers, solver.model
        buffers.set_layout(model.tree_first, model.tree_size)
        buffers.add_constant("tree_pose", model.tree_pose, wp.transform)
        for dtype, arrays in solver.kernel_arrays().items():
            for name, data in arrays.items():
                if name.startswith(("body_", "joint_", "tie_span")):
                    buffers.add_body_rows(name, data, dtype, body_indices=name in ("body_parent", "body_root"))
                    self._seldom += [name] if name not in DEVICE_RESULTS + STEP_INPUTS else []
                else:
                    buffers.add_shared(name, data, dtype)
        for dtype, names in SCRATCH.items():
            for name in names:
                buffers.add_scratch(name, dtype)
        buffers.add_constant("body_branches", self._branching(model.body_parent), wp.bool)
        trees = len(model.tree_first)
        self.budget = structs.EnergyBudget()
        for name, field in structs.fields(structs.EnergyBudget).items():
            count = buffers.slot_count if name == "start_q" else trees
            setattr(self.budget, name, wp.zeros(count, dtype=field.type.dtype, device=buffers.device))
        self.budget.limit.fill_(NO_LIMIT)
        rows = (self.budget.limit, self.budget.watch)
        self._budget_rows = [array.numpy() for array in rows] if buffers.device.is_cpu else []
        buffers.arrays["impact_phi"] = wp.empty(trees, dtype=float, device=buffers.device)

    def _branching(self, parent: np.ndarray) -> np.ndarray:
        """[place] whether a body is the parent of another than the next one, where kernels look for it."""
        places = np.zeros(self.buffers.slot_count, np.bool_)
        apart = (parent >= 0) & (parent != np.arange(len(parent)) - 1)
        places[self.buffers.slots[parent[apart]]] = True
        return places

    def upload_changed(self) -> None:
        """Bring a device's copies of the model rows up to date, if :attr:`changed`."""
        if self.changed:
            self.buffers.upload(self._seldom)
            self.budget.limit.fill_(NO_LIMIT)
            self._budget_phase = -1
            self.changed, self.substeps_due = False, True

    def fill(self, struct: Any, **values: Any) -> Any:
        """A kernel argument struct: each field by its name in ``values`` (arrays by theirs), else the array named
        so."""
        return self._filled(struct, self._arrays, values)

    def fill_resident(self, struct: Any, **values: Any) -> Any:
        """The same with the arrays of :attr:`resident`."""
        return self._filled(struct, self.resident_arrays, values)

    def _filled(self, struct: Any, arrays: dict[str, wp.array], values: dict[str, Any]) -> Any:
        filled = struct()
        values = {"pitch": self.buffers.pitch} | values
        for field in structs.fields(struct):
            value = values.get(field, field)
            setattr(filled, field, arrays[value] if isinstance(value, str) else value)
        return filled

    def record(self, kernel: Any, *arguments: object, **options: Any) -> Launch:
        """Bind a kernel; a string among the arguments names an array."""
        given = [self._arrays[value] if isinstance(value, str) else value for value in arguments]
        return bind_launch(kernel, given, [], device=str(self.buffers.device), **options)

    def record_shared(self, kernel: Any, *arguments: object, chunk: int) -> Launch:
        """The same of a kernel whose list is ``trees``, shared in chunks of so many."""
        launch = self.record(kernel, *arguments, index_list="trees", partitions=self._pool.size)
        return self._pool.share([launch], chunk)

    # ------------------------------------------------------------------ transfers of the listed trees' rows

    def _record_transfers(self) -> None:
        def copier(trees: str, *names: str, to_host: bool = False) -> Callable[[int], None]:
            return self.buffers.row_copier(names, trees, to_host=to_host)

        self.upload_step = copier("stepping", *STEP_INPUTS)
        self.download_prediction = copier("stepping", "body_q", "body_qd", "body_qd_free", to_host=True)
        self.upload_subset_step = copier("subset", *STEP_INPUTS)
        self.download_subset_prediction = copier("subset", "body_q", "body_qd", "body_qd_free", to_host=True)
        self.upload_wrenches = copier("stepping", "body_wrench")
        self.download_joints = copier(
            "stepping", "joint_x", "joint_xd", "joint_q", "joint_qd", "body_acceleration", to_host=True
        )
        self.upload_subset_joints = copier("subset", "joint_x", "joint_xd", "joint_q", "joint_qd")
        self.download_subset_bodies = copier("subset", "body_q", "body_qd", to_host=True)
        self.upload_impact = copier("subset", *STEP_INPUTS, "body_impulse")
        self.upload_impact_rates = copier("subset", "joint_xd_free", "joint_qd_free")
        self.download_impact_rates = copier("subset", "joint_xd_free", "joint_qd_free", to_host=True)

    # ------------------------------------------------------------------ kernels

    def _record_step(self, parameters: Any) -> None:
        fill, record, s = self.fill, self.record, structs
        self._model, self._forces = fill(s.ArticulationModel), fill(s.AppliedForces)
        joints, self._bodies, self._factors = fill(s.JointState), fill(s.BodyState), fill(s.Factors)
        scratch, prediction = fill(s.Scratch), fill(s.Prediction)
        self.predict = self._record_predict(parameters, "stepping")
        self.predict_subset = self._record_predict(parameters, "subset")
        self.predict_groups = (
            None if self.buffers.has_copies else self._record_groups(parameters, joints, scratch, prediction)
        )
        """Predicts groups of trees, on a CPU."""
        self.integrate = self._record_integrate(parameters)
        self.forward_kinematics = record(forward_kinematics, self._model, "subset", joints, self._bodies)
        self.apply_wrenches = self.record_shared(
            apply_wrenches, parameters.dt, self._model, "subset", "body_wrench", self._factors, fill(s.WrenchScratch),
            scratch, prediction, chunk=TREES_PER_CHUNK["wrenches"],
        )  # fmt: skip
        self.correct_floating_momentum = self._record_momentum(parameters)
        self.choose_budget = record(choose_budget, parameters, self._model, "stepping", scratch, "tree_budget")
        self.count_substeps = record(
            first_mode.count_substeps, parameters.dt, first_mode.MAX_ANGLE, self._max_substeps, self._model, "stepping",
            scratch, fill(s.WrenchScratch), "tree_substeps",
        )  # fmt: skip

    def _record_predict(self, parameters: Any, trees: str) -> Launch:
        fill, s = self.fill, structs
        kernel = (predict_lean, ("body_branches",)) if self.buffers.has_copies else (predict, ())
        return self.record_shared(
            kernel[0], parameters, fill(s.ArticulationModel), *kernel[1], trees, "tree_phi", "tree_euler_steps",
            "tree_steps", fill(s.AppliedForces), fill(s.JointState), "phi_used", fill(s.BodyState), fill(s.Factors),
            fill(s.Scratch), fill(s.Prediction), chunk=TREES_PER_CHUNK["predict"],
        )  # fmt: skip

    def _record_integrate(self, parameters: Any) -> Callable[..., None]:
        """An integration, with the energy budgets around it."""
        fill, record, s = self.fill, self.record, structs
        model, forces, joints, prediction = (
            fill(struct) for struct in (s.ArticulationModel, s.AppliedForces, s.JointState, s.Prediction)
        )
        partitioned = {"index_list": "trees", "partitions": self._pool.size}
        apart = fill(s.BodyState, body_q="after_q", body_qd="after_qd")
        begin = record(
            begin_budget, parameters, model, "stepping", "tree_budget", "tree_phi", forces, joints,
            self.budget, apart, **partitioned,
        )  # fmt: skip
        move = record(
            integrate, parameters, model, "stepping", "tree_awake", "phi_used", "tree_steps", joints, prediction,
            "tree_rate", "tree_euler_steps", joints, **partitioned,
        )  # fmt: skip
        keep = record(
            keep_budget, parameters, model, "stepping", "tree_budget", "tree_phi", "tree_steps", "tree_rate",
            forces, self.budget, "tree_euler_steps", joints, apart, fill(s.Factors), fill(s.Scratch),
            fill(s.Prediction, body_acceleration="impact_acceleration", body_qd_free="impact_velocity"), **partitioned,
        )  # fmt: skip
        chunk = TREES_PER_CHUNK["integrate"]
        return self._keeping_budgets(self._pool.share([move], chunk), self._pool.share([begin, move, keep], chunk))

    def _record_momentum(self, parameters: Any) -> Launch:
        fill, s = self.fill, structs
        return self.record(
            correct_floating_momentum, parameters, fill(s.ArticulationModel), "floating", "phi_used", "tree_rate",
            "tree_steps", fill(s.AppliedForces), fill(s.BodyState), "body_acceleration", "lever",
            fill(s.FloatingScratch), fill(s.JointState), index_list="roots",
        )  # fmt: skip

    def _record_resident(self, parameters: Any) -> None:
        """The launches of a step once more, on copies of what there is of each tree."""
        device, shared = self.buffers.device, self.buffers.arrays
        names = dict.fromkeys(TREE_INPUTS + TREE_RESULTS)
        copies = {name: wp.empty_like(shared[name], device=device) for name in names}
        self.resident_arrays = self._arrays = shared | copies
        predict = self._record_predict(parameters, "stepping")
        self.resident = Step(predict, predict, self._record_integrate(parameters), self._record_momentum(parameters))
        self._arrays = shared

    def upload_trees(self) -> None:
        """Bring the arrays of :attr:`resident` up to those that NumPy sees."""
        for name in TREE_INPUTS if self.buffers.has_copies else ():
            wp.copy(self.resident_arrays[name], self.buffers.host_array(name))

    def download_trees(self) -> None:
        """The other way round, what kernels write."""
        for name in TREE_RESULTS if self.buffers.has_copies else ():
            wp.copy(self.buffers.host_array(name), self.resident_arrays[name])

    def list_budgets(self, trees: np.ndarray) -> None:
        """These trees [k] have energy budgets (:mod:`vinesim.kernels.articulation.energy_budget`), no others."""
        self._budgeted, self._budget_phase = trees, -1
        kind, phi = (self.buffers.host[name][trees] for name in ("tree_budget", "tree_phi"))
        self._watches_closely = bool(((kind == CLOSELY) | (phi < MIN_PHI)).any())

    def look_for_budgets(self, steps: int = 1) -> None:
        """Once before the integrations of a step or of so many: decide whether they keep energy budgets.

        Always on a GPU and in many steps. Otherwise in one step of eight, and in the seven that follow if a tree is
        watched closely after it.
        """
        self._budget_phase = (self._budget_phase + 1) % BUDGET_PERIOD if steps == 1 else 0
        if self._budget_phase == 0 or self.buffers.device.is_cuda:
            self._keeps_budgets = len(self._budgeted) > 0
        elif self._budget_phase == 1 and self._keeps_budgets:
            limit, watch = (row[self._budgeted].max() for row in self._budget_rows)
            self._keeps_budgets = self._watches_closely or bool(watch > 0 or limit >= NO_LIMIT)

    def _keeping_budgets(self, move: Launch, move_with_budgets: Launch) -> Callable[..., None]:
        """An integration, with what keeps the energy budgets around it in steps that do."""

        def launch(*which: int) -> None:
            (move_with_budgets if self._keeps_budgets else move)(*which)

        return launch

    def _record_groups(self, parameters: Any, joints: Any, scratch: Any, prediction: Any) -> Launch:
        """The prediction of up to eight trees at once, each thread with memory of its own."""
        size = LANES * RECORD * (self.buffers.max_tree_size + 2)
        launches = [
            self.record(
                predict_groups, parameters, self._model, "groups", "stepping", "tree_phi", "tree_euler_steps",
                "tree_steps", self._forces, joints, wp.zeros(size, dtype=float, device=self.buffers.device),
                "phi_used", self._bodies, self._factors, scratch, prediction, index_list="groups",
            )
            for _ in range(self._pool.size)
        ]  # fmt: skip
        return self._pool.share([join_partitions(launches)], 1)

    def _record_impact(self, parameters: Any) -> None:
        """An impact within no time: factors of inertia and springs alone, and wrenches that are impulses."""
        fill, s = self.fill, structs
        joints, scratch = fill(s.JointState), fill(s.Scratch)
        prediction = fill(s.Prediction, body_acceleration="impact_acceleration", body_qd_free="impact_velocity")
        self.factor_impact = self.record(
            predict, parameters, self._model, "subset", "tree_phi", "tree_euler_steps", "tree_steps", self._forces,
            joints, "impact_phi",
            self._bodies, self._factors, scratch, prediction, index_list="trees",
        )  # fmt: skip
        self.apply_impulses = self.record(
            apply_wrenches, 1.0, self._model, "subset", "body_impulse", self._factors, fill(s.WrenchScratch), scratch,
            prediction,
        )  # fmt: skip

    def impulse_response(self, bodies: np.ndarray) -> np.ndarray:
        """Response [n, 6, m, 6] of some bodies [n] to unit impulses on the listed bodies of the same tree (neighbours
        in the list, at most m); a view, good until the next call."""
        n, buffers = len(bodies), self.buffers
        if n > self.response_capacity or self.response_capacity == 0:
            self._record_response(max(2 * self.response_capacity, n, MIN_CAPACITY))
        self._response_bodies[:n] = buffers.slots[bodies]
        self._respond(n)
        buffers.synchronize()
        return self._response[:n]

    def dense_impulse_response(self, bodies: np.ndarray) -> np.ndarray:
        """The same [n, 6, n, 6] for bodies in any order, with the zeros between different trees."""
        bodies = np.asarray(bodies)
        order = np.argsort(bodies, kind="stable")
        _, tree_start, tree = np.unique(self._body_tree[bodies[order]], return_index=True, return_inverse=True)
        packed = self.impulse_response(bodies[order])
        dense = np.zeros((len(bodies), 6, len(bodies), 6), np.float32)
        for i, start in enumerate(tree_start):
            of_tree = np.flatnonzero(tree == i)
            block = packed[start : start + len(of_tree), :, : len(of_tree)]
            at = order[of_tree]
            dense[at[:, None], :, at] = block.transpose(0, 2, 1, 3)
        return dense

    def _record_response(self, capacity: int) -> None:
        self.response_capacity, buffers = capacity, self.buffers
        self._response_bodies = buffers.pinned(np.zeros(capacity, np.int32))
        self._response = buffers.pinned(np.zeros((capacity, 6, buffers.max_tree_size, 6), np.float32))
        buffers.add_shared("response_bodies", self._response_bodies, wp.int32)
        buffers.add_shared("response", self._response, float)
        stride = buffers.max_tree_extent
        matrix: Any = wp.mat33
        columns = {
            name: wp.empty(capacity * stride, dtype=matrix, device=buffers.device)
            for name in structs.fields(structs.ResponseColumns)
        }
        self._respond = self.record(
            impulse_response, self._model, stride, "response_bodies", self._factors,
            self.fill(structs.ResponseColumns, **columns), "response",
        )  # fmt: skip

    def joint_wrench(self, bodies: np.ndarray) -> np.ndarray:
        """Wrench [n, 6] N, N m that the joints of some bodies [n] carried in the last step."""
        wrenches = self._joint_wrenches
        if len(bodies) > len(wrenches.places):
            wrenches = self._joint_wrenches = self.record_joint_wrenches(2 * len(bodies))
        wrenches.places[: len(bodies)] = self.buffers.slots[bodies]
        wrenches.compute(len(bodies))
        return wrenches.carried[: len(bodies)].copy()

    def record_joint_wrenches(self, capacity: int) -> JointWrenches:
        """What computes the wrenches that up to so many joints carried in the last step."""
        buffers = self.buffers
        places = buffers.pinned(np.zeros(capacity, np.int32))
        carried = buffers.pinned(np.zeros((capacity, 6), np.float32))
        launch = self.record(
            joint_wrench, self.parameters, self._model, buffers.reach(places, wp.int32, "joint_bodies"), "phi_used",
            "tree_steps", self._forces, self._bodies, "body_acceleration",
            buffers.reach(carried, wp.spatial_vector, "joint_wrench"),
        )  # fmt: skip

        def launch_and_wait(count: int, first: int = 0, partition: int = 0) -> None:
            launch(count)
            buffers.synchronize()

        return JointWrenches(places, carried, bound(launch_and_wait) if buffers.has_copies else launch)
