"""Gradients through time: how a loss on the motion of trees depends on their springs, dampers, masses and first state.

The kernels are those that :class:`vinesim.plants.articulation_solver.ArticulationSolver` launches, compiled once more
with their adjoints. Each tick has arrays of its own, so that the backward pass finds the values of the forward pass.
Checkpoints bound the memory: the forward pass keeps only the joints, every ``checkpoint`` ticks; the backward pass
runs each segment forward once more before its adjoint. The caller computes the loss, in NumPy, in PyTorch or by hand.
:meth:`Rollout.run` returns poses and velocities, and :meth:`Rollout.gradient` takes the loss's derivatives with respect
to these poses and velocities. docs/gradients.md has examples.

A rollout always takes whole steps, while the solver divides the steps of trees that swing above 5 Hz: use a shorter
``dt`` for such trees.
A rollout keeps no energy budget (:mod:`vinesim.kernels.plants.energy_budget`).

The gradient is that of the numerical scheme, so it is exact where the scheme is smooth. The scheme is not smooth at the
tick in which a joint passes ``fast_rate``: phi (implicitness of the integrator, 0.5 trapezoidal to 1 backward Euler)
then becomes 1. Damping below ``(2 phi - 1) dt`` times stiffness has no gradient: the scheme itself damps that much, and
less damping changes nothing.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
from typing import Any

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.warp_arrays import struct_fields
from vinesim.kernels.plants import integration, kinematics, prediction, structs
from vinesim.plants.articulation_solver import ArticulationSolver, kernel_parameters
from vinesim.plants.device_buffers import DeviceBuffers, find_device
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State

_PREDICT, _INTEGRATE, _FORWARD_KINEMATICS = (
    wp.kernel(inspect.unwrap(kernel), module="vinesim.plants.rollout", enable_backward=True)
    for kernel in (prediction.predict, integration.integrate, kinematics.forward_kinematics)
)
_STRUCT = type(structs.JointState)
_DEFAULTS = PhysicsParameters()
_ZERO_INPUTS = ("body_load", "body_wrench")
"""Input arrays that are zero unless they are arguments of :meth:`Rollout.run`."""
_COUNTER = "tree_euler_steps"
"""State array with the number of backward Euler steps (phi = 1) that each tree still has to take. It has no
gradient."""
_PARAMETERS = ("joint_stiffness", "joint_damping", "body_mass", "body_inertia", "body_product", "body_load")


@dataclasses.dataclass(frozen=True, slots=True)
class Trajectory:
    """Motion of the watched bodies: at the start, and after each tick."""

    body_q: np.ndarray
    """[tick + 1, watched, 7] World poses: position [m] and quaternion xyzw."""
    body_qd: np.ndarray
    """[tick + 1, watched, 6] velocity of the origin [m/s] and angular velocity [rad/s], world axes."""
    phi: np.ndarray
    """[tick, tree] phi (implicitness of the integrator, 0.5 trapezoidal to 1 backward Euler) with which each tick was
    stepped: 1 once a joint has turned faster than ``fast_rate``."""


@dataclasses.dataclass(frozen=True, slots=True)
class Gradient:
    """Derivative of a loss with respect to the inputs of a rollout. Units: unit of the loss divided by unit of the
    input."""

    stiffness: np.ndarray
    """[body, 3] With respect to ``joint_stiffness``."""
    damping: np.ndarray
    """[body, 3] With respect to ``joint_damping``."""
    mass: np.ndarray
    """[body] With respect to ``body_mass``; the moments of inertia scale with the mass."""
    load: np.ndarray
    """[body, 6] With respect to ``load``."""
    rotation: np.ndarray
    """[body, 3] With respect to a small rotation vector v [rad] in the axes of the joint frame: the first ``joint_q``
    is replaced by exp(v) ``joint_q``."""
    joint_qd: np.ndarray
    """[body, 3] With respect to the first ``joint_qd``."""


class RolloutDiverged(ValueError):
    """Raised if a tree turns faster than ``fault_rate``. The message names the tree and the tick."""


class Rollout:
    """A number of ticks of all trees of a model without contacts, and their adjoint.

    Args:
        model: constants, and default values for the inputs of :meth:`run`. It is not modified.
        ticks: number of ticks.
        watched: bodies [k] whose motion the loss depends on; all moving bodies unless given.
        fine: let the berry clusters of bunches move.
        dt: duration of a tick [s].
        phi: implicitness of the integrator, 0.5 trapezoidal to 1 backward Euler; see
            :class:`vinesim.plants.articulation_solver.ArticulationSolver`, likewise for ``fast_rate``, ``max_rate``,
            ``fault_rate`` and ``geometric_stiffness``.
        checkpoint: number of ticks between two states that the forward pass keeps. Memory is about 1.2 kB for each body
            and tick of one segment, and 56 B for each body and checkpoint.
        device: ``cpu``, ``cuda`` or ``cuda:N``.
    """

    def __init__(
        self,
        model: Model,
        ticks: int,
        *,
        watched: np.ndarray | None = None,
        fine: bool = False,
        dt: float = _DEFAULTS.dt,
        phi: float = _DEFAULTS.phi,
        checkpoint: int = 50,
        device: str = "cpu",
        fast_rate: float = _DEFAULTS.fast_joint_rate,
        max_rate: float = _DEFAULTS.max_joint_rate,
        fault_rate: float = _DEFAULTS.fault_joint_rate,
        geometric_stiffness: bool = True,
    ) -> None:
        if ticks < 1 or checkpoint < 1 or not 0.0 < dt < math.inf or not 0.5 <= phi <= 1.0:
            raise ValueError(
                f"{ticks} ticks of {dt} s, a checkpoint every {checkpoint}, phi {phi}: need 1 or more, a finite dt "
                "above 0, phi from 0.5 to 1"
            )
        self.model = model
        self.ticks = ticks
        self.dt = dt
        self.fault_rate = fault_rate
        self.device = find_device(device)
        self.state = State.at_rest(model)
        plants = ArticulationSolver(model, self.state, buffers=DeviceBuffers("cpu"))  # provides the kernels' arrays
        if fine:
            plants.refine(np.arange(len(model.tree_first)))
        self._host = plants.buffers.host
        moving = np.arange(len(model.body_mass)) - model.tree_first[model.body_tree]
        moving = moving < self._host["tree_moving"][model.body_tree]
        self.watched = np.flatnonzero(moving) if watched is None else np.asarray(watched)
        if not moving[self.watched].all():
            body = int(self.watched[~moving[self.watched]][0])
            raise ValueError(f"body {body} is a berry cluster that rides on its bunch: watch that, or give fine=True")
        self._slots = min(checkpoint, ticks)
        trees = len(model.tree_first)
        parameters = kernel_parameters(_DEFAULTS, dt, fast_rate, max_rate, fault_rate, geometric_stiffness)
        self._given: dict[str, Any] = parameters | {"pitch": 1}
        self._arrays = {
            "count": wp.array([trees], dtype=wp.int32, device=self.device),
            "trees": wp.array(np.arange(trees), dtype=wp.int32, device=self.device),
            "tree_phi": wp.array(np.full(trees, phi), dtype=float, device=self.device),
            "tree_awake": wp.array(np.ones(trees), dtype=wp.bool, device=self.device),
        }
        self._stacks: dict[str, wp.array] = {}
        """Arrays with one entry for each tick of a segment [slot, tree or body], by name. Arrays of states have one
        slot more."""
        self._record()
        self._checkpoints: list[dict[str, np.ndarray]] = []
        self._at = -1
        """Number of the segment whose values ``_stacks`` holds; -1 for none."""

    # forward

    def run(
        self,
        *,
        stiffness: np.ndarray | None = None,
        damping: np.ndarray | None = None,
        mass: np.ndarray | None = None,
        load: np.ndarray | None = None,
        joint_q: np.ndarray | None = None,
        joint_qd: np.ndarray | None = None,
    ) -> Trajectory:
        """Simulate all ticks, and return the motion of the watched bodies.

        Args:
            stiffness: [body, 3] N m/rad, replaces ``joint_stiffness``.
            damping: [body, 3] N m s/rad, replaces ``joint_damping``.
            mass: [body] kg, replaces ``body_mass``; moments of inertia scale with it.
            load: [body, 6] N, N m: a steady wrench at each body's origin, world axes; none unless given.
            joint_q: [body, 4] joint rotations at the start; the authored shape unless given.
            joint_qd: [body, 3] rad/s joint rates at the start; at rest unless given.
        """
        model = self.model
        mass = self._host["body_mass"] if mass is None else self._sound("mass", mass, model.body_mass.shape, 1e-9)
        self._set("body_mass", mass)
        for name in ("body_inertia", "body_product"):
            self._set(name, self._host[name] * (mass / self._host["body_mass"])[:, None])
        for name, value, default, least in (
            ("joint_stiffness", stiffness, model.joint_stiffness, 0.0),
            ("joint_damping", damping, model.joint_damping, 0.0),
            ("body_load", load, np.zeros((len(model.body_mass), 6)), -np.inf),
        ):
            self._set(name, default if value is None else self._sound(name, value, default.shape, least))
        start = {name: getattr(self.state, name) for name in self._states}
        start[_COUNTER] = np.zeros(len(model.tree_first), np.int32)
        if joint_q is not None:
            start["joint_q"] = self._sound("joint_q", joint_q, start["joint_q"].shape)
            bad = np.flatnonzero(abs(np.linalg.norm(start["joint_q"], axis=-1) - 1.0) > 1e-3)
            if len(bad):
                given = start["joint_q"][bad[0]].tolist()
                raise ValueError(f"joint_q[{bad[0]}] is {given}; give a unit quaternion xyzw")
            start["joint_q"] = frames.normalize(start["joint_q"])
        if joint_qd is not None:
            start["joint_qd"] = self._sound("joint_qd", joint_qd, start["joint_qd"].shape)
        poses = np.empty((self.ticks + 1, len(self.watched), 7), np.float32)
        motions = np.empty((self.ticks + 1, len(self.watched), 6), np.float32)
        phi = np.empty((self.ticks, len(model.tree_first)), np.float32)
        self._checkpoints = [start]
        for segment, first, count in self._segments():
            self._replay(segment, count)
            rows = slice(first, first + count)
            poses[rows] = self._stacks["body_q"].numpy()[:count, self.watched]
            motions[rows] = self._stacks["body_qd"].numpy()[:count, self.watched]
            phi[rows] = self._stacks["tree_phi"].numpy()[:count]
            self._checkpoints.append({name: self._stacks[name].numpy()[count].copy() for name in start})
            self._refuse(first, self._stacks["tree_rate"].numpy()[:count])
        poses[-1] = self._last[0].numpy()[self.watched]
        motions[-1] = self._last[1].numpy()[self.watched]
        return Trajectory(poses, motions, phi)

    # backward

    def gradient(self, by_q: np.ndarray | None = None, by_qd: np.ndarray | None = None) -> Gradient:
        """Returns the gradient of a loss, from the loss's derivatives with respect to the last run's trajectory.

        Args:
            by_q: [tick + 1, watched, 7] derivative with respect to ``body_q``; the four numbers of a quaternion count
                as independent.
            by_qd: [tick + 1, watched, 6] derivative with respect to ``body_qd``.
        """
        if not self._checkpoints:
            raise ValueError("there is no run to differentiate; call run() first")
        shape = (self.ticks + 1, len(self.watched))
        by_q = np.zeros((*shape, 7)) if by_q is None else self._sound("by_q", by_q, (*shape, 7))
        by_qd = np.zeros((*shape, 6)) if by_qd is None else self._sound("by_qd", by_qd, (*shape, 6))
        for name in _PARAMETERS:
            self._arrays[name].grad.zero_()
        carried = {name: np.zeros_like(self._checkpoints[-1][name]) for name in self._states}
        for segment, first, count in reversed(self._segments()):
            if segment != self._at:
                self._replay(segment, count)
            last = first + count == self.ticks
            for name, seed, end in zip(("body_q", "body_qd"), (by_q, by_qd), self._last, strict=True):
                self._seed(self._stacks[name].grad, seed[first : first + count])
                self._seed(end.grad, seed[-1:] * last)
            for name in self._states:
                there = np.zeros((self._slots + 1, *carried[name].shape), np.float32)
                there[count] = carried[name]
                _fill(self._stacks[name].grad, there)
            self._ends[count - 1][1].launch()
            for predict, integrate in reversed(self._steps[:count]):
                integrate[1].launch()
                predict[1].launch()
            carried = {name: self._stacks[name].grad.numpy()[0].copy() for name in self._states}
        by = {name: self._arrays[name].grad.numpy().astype(float) for name in _PARAMETERS}
        start = self._checkpoints[0]["joint_q"].astype(float)
        axes = np.concatenate([0.5 * np.eye(3), np.zeros((3, 1))], -1)  # d exp(v) / dv at v = 0
        turned = frames.multiply(axes, start[:, None])  # [body, 3, 4]
        along = sum((by[name] * self._host[name]).sum(-1) for name in ("body_inertia", "body_product"))
        return Gradient(
            stiffness=by["joint_stiffness"],
            damping=by["joint_damping"],
            mass=by["body_mass"] + along / self._host["body_mass"],
            load=by["body_load"],
            rotation=(turned * carried["joint_q"][:, None]).sum(-1),
            joint_qd=carried["joint_qd"].astype(float),
        )

    # memory and launches

    def _record(self) -> None:
        """Allocate arrays for every step of a segment, and record the forward and adjoint launches that work on
        them."""
        self._states = tuple(struct_fields(structs.JointState))
        for name, field in struct_fields(structs.JointState).items():
            self._stacks[name] = self._zeros(name, field.dtype, self._slots + 1)
        self._stacks[_COUNTER] = self._zeros(_COUNTER, wp.int32, self._slots + 1)
        self._steps = [(self._launch(_PREDICT, slot), self._launch(_INTEGRATE, slot)) for slot in range(self._slots)]
        self._ends = [self._launch(_FORWARD_KINEMATICS, slot + 1, end=True) for slot in range(self._slots)]
        self._last = (self._arrays["end body_q"], self._arrays["end body_qd"])

    def _launch(self, kernel: Any, slot: int, end: bool = False) -> tuple[Any, Any]:
        """Returns the forward launch and the adjoint launch of one kernel in one step. ``slot``: index of the step in
        its segment. ``end``: the kernel runs once after the last step."""
        types = inspect.get_annotations(kernel)
        values = [self._argument(kernel, name, kind, slot, end) for name, kind in types.items()]
        adjoints = [self._adjoint(kind, value) for kind, value in zip(types.values(), values, strict=True)]
        common: dict[str, Any] = {"dim": len(self.model.tree_first), "inputs": values, "device": self.device}
        common |= {"record_cmd": True}
        return wp.launch(kernel, **common), wp.launch(kernel, adj_inputs=adjoints, adjoint=True, **common)

    def _argument(self, kernel: Any, name: str, kind: Any, slot: int, end: bool) -> Any:
        """Returns the value of the kernel argument ``name`` in one step: a filled struct, an array or a number.
        ``kind``: annotated type of the argument."""
        written = name.endswith("_out")
        if not isinstance(kind, _STRUCT):
            return self._value(kernel, name.removesuffix("_out"), kind, written, slot, end)
        filled = kind()
        for field, field_type in struct_fields(kind).items():
            setattr(filled, field, self._value(kernel, field, field_type, written, slot, end))
        return filled

    def _adjoint(self, kind: Any, value: Any) -> Any:
        """Returns the adjoint argument for one kernel argument: the gradient array of an array, or an empty struct for
        a struct, because its arrays carry their own gradients."""
        if isinstance(kind, _STRUCT):
            return kind()
        return value.grad if isinstance(value, wp.array) else None

    def _value(self, kernel: Any, name: str, kind: Any, written: bool, slot: int, end: bool) -> Any:
        """Returns the value in one step of the kernel argument or struct field ``name``. Values that no step changes
        come from the solver's arrays."""
        if name in self._given:
            return self._given[name]
        dtype = kind.dtype
        if name in self._states or name == _COUNTER:
            return self._stacks[name][slot + written]
        counter = dtype in (wp.int32, wp.bool)
        if written and end:
            name = "end " + name
            self._arrays.setdefault(name, self._zeros(name, dtype))
        elif written and not counter:
            if name not in self._stacks:
                self._stacks[name] = self._zeros(name, dtype, self._slots)
            return self._stacks[name][slot]
        elif kernel is _INTEGRATE and name in self._stacks:  # results of the prediction
            return self._stacks[name][slot]
        if name not in self._arrays:
            self._arrays[name] = self._input(name, dtype)
        return self._arrays[name]

    def _input(self, name: str, dtype: Any) -> wp.array:
        if name in _ZERO_INPUTS:
            return self._zeros(name, dtype)
        return wp.array(self._host[name], dtype=dtype, device=self.device, requires_grad=name in _PARAMETERS)

    def _zeros(self, name: str, dtype: Any, slots: int = 0) -> wp.array:
        count = len(self.model.tree_first) if name.startswith("tree_") else len(self.model.body_mass)
        shape = (slots, count) if slots else (count,)
        return wp.zeros(shape, dtype=dtype, device=self.device, requires_grad=dtype not in (wp.int32, wp.bool))

    def _segments(self) -> list[tuple[int, int, int]]:
        """Returns index, first tick and number of ticks of each segment."""
        starts = range(0, self.ticks, self._slots)
        return [(i, start, min(self._slots, self.ticks - start)) for i, start in enumerate(starts)]

    def _replay(self, segment: int, count: int) -> None:
        """Run the ticks of one segment again from the state at its checkpoint, because the backward pass needs their
        values.
        """
        for name, value in self._checkpoints[segment].items():
            _fill(self._stacks[name][0], value)
        counter = self._stacks[_COUNTER]
        for slot, (predict, integrate) in enumerate(self._steps[:count]):
            predict[0].launch()
            wp.copy(counter[slot + 1], counter[slot])
            integrate[0].launch()
        self._ends[count - 1][0].launch()
        self._at = segment

    def _seed(self, grad: wp.array, rows: np.ndarray) -> None:
        """Write the loss's derivatives ``rows`` with respect to the watched bodies into ``grad``, and zero for all
        other bodies."""
        seed = np.zeros((*grad.shape, rows.shape[-1]), np.float32)
        rows_of: Any = (slice(0, len(rows)), self.watched)
        np.add.at(seed.reshape(-1, *seed.shape[-2:]), rows_of, rows)
        _fill(grad, seed)

    def _set(self, name: str, value: np.ndarray) -> None:
        _fill(self._arrays[name], value)

    def _sound(self, what: str, value: np.ndarray, shape: tuple[int, ...], least: float = -np.inf) -> np.ndarray:
        value = np.asarray(value, float)
        if value.shape != shape:
            raise ValueError(f"{what} of shape {value.shape}; this rollout needs {shape}")
        bad = np.argwhere(~(np.isfinite(value) & (value >= least)))
        if len(bad):
            at = tuple(bad[0].tolist())
            floor = f", {least} or more" * bool(np.isfinite(least))
            raise ValueError(f"{what}{list(at)} is {value[at]}; give finite numbers{floor}")
        return value

    def _refuse(self, first: int, rate: np.ndarray) -> None:
        bad = np.argwhere(~(rate <= self.fault_rate))
        if len(bad):
            tick, tree = bad[0].tolist()
            raise RolloutDiverged(
                f"tree {tree} turned at {rate[tick, tree]} rad/s in tick {first + tick}; start it slower, or give it "
                "more stiffness, damping or shorter ticks"
            )


def _fill(array: wp.array, data: np.ndarray) -> None:
    """Copy NumPy numbers into a Warp array, or into a slice of one."""
    array.assign(np.ascontiguousarray(data, np.float32))
