"""Articulation solver: all plants of a vineyard as trees of bodies on ball joints, stepped with implicit springs.

One step of the plants alone is ``predict()`` then ``integrate()``. Between the two calls a contact solver reads
``state.body_q`` and ``velocity_free``, and computes contact wrenches with the ``impulse_response()`` of the bodies in
contact. It passes these wrenches to ``integrate()``. Sleeping trees take no time.

A tree with berry clusters is *coarse* or *fine*. In a coarse tree each bunch is one compound body, to which its
clusters are locked. In a fine tree the clusters move. ``refine()`` makes a tree fine, ``coarsen()`` makes it coarse
again. ``cut()`` detaches a body from its parent; the body becomes a floating root that carries its descendants. A cut
within a segment leaves a stump, for which the tree has spare bodies. All three are called between steps, after
``integrate()`` and before the next ``predict()``.

The scheme (:mod:`vinesim.kernels.plants`) damps as if every joint's beta (damping / stiffness) were larger by
``(2 phi - 1) dt``, with phi the implicitness of the integrator (0.5 trapezoidal to 1 backward Euler). So the solver
subtracts that amount from the model's damping, down to zero. The total damping is then the model's.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
import weakref
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.errors import checked_index
from vinesim.core.warp_arrays import share, struct_fields
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.plants import first_mode, structs
from vinesim.kernels.plants.eight_trees import LANES, RECORD, predict_groups
from vinesim.kernels.plants.energy_budget import (
    CLOSELY,
    MIN_PHI,
    NO_BUDGET,
    NO_LIMIT,
    begin_budget,
    choose_budget,
    keep_budget,
)
from vinesim.kernels.plants.fast_motion import move_fast_trees
from vinesim.kernels.plants.first_mode import MAX_SUBSTEPS, begin_substep, substeps_for
from vinesim.kernels.plants.floating_components import correct_floating_momentum
from vinesim.kernels.plants.impulse_response import apply_wrenches, impulse_response, respond_to_blows
from vinesim.kernels.plants.integration import integrate
from vinesim.kernels.plants.joint_wrench import joint_wrench
from vinesim.kernels.plants.kinematics import forward_kinematics
from vinesim.kernels.plants.lean_prediction import predict_lean
from vinesim.kernels.plants.prediction import predict
from vinesim.kernels.plants.tree_checks import find_fastest
from vinesim.kernels.plants.wood_stress import WoodStrength, find_stress
from vinesim.plants.contact_loads import ContactLoads
from vinesim.plants.device_buffers import DeviceBuffers
from vinesim.plants.segment_parts import (
    Part,
    grows_between,
    joint_compliance,
    part_of,
    place_between,
    relaxed_joint,
    without_leaves,
)
from vinesim.plants.ties import RootRests, TieTable, turning_damping
from vinesim.plants.validation import checked_trees, validate
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State

# Places in the array of counts. A count is the number of entries that kernels take from a list.
_STEPPING = 0
_SUBSET = 1
_GROUPS = 2
_WHOLE = 3
_FLOATING = 4
_DIVIDED = 5
_DIVIDED_FLOATING = 6
_NEXT_LEVEL = 7
_LEVELS = 8
_COUNTS = 9
"""Length of the array of counts. The entry :data:`_NEXT_LEVEL` is the number of the next substep, the entry
:data:`_LEVELS` the number of substeps of the step."""

ROCKING_TIME = 0.3
"""[s] Time constant with which cut wood on the ground, a wire or a post stops to turn. GUESSED: contacts have no
resistance to rolling, and a bent cane that lies on two points would rock for minutes."""
_log = logging.getLogger(__name__)
_NO_TREES = np.zeros(0, np.int32)
_NO_WRENCHES = np.zeros((0, 6), np.float32)


def _launch_nothing() -> None:
    pass


class Beside(NamedTuple):
    """Launches of others that neither read nor write what the trees do in the same half of a step."""

    predict: Callable[[], None]
    """Launches what runs beside the prediction of the trees."""
    integrate: Callable[[], None]
    """Launches what runs beside their integration."""
    end: Callable[[], None] = _launch_nothing
    """Launches what runs after each step, alone."""


_NOTHING_BESIDE = Beside(_launch_nothing, _launch_nothing)


class ArticulationSolver:
    """The trees of one model and their state, in memory shared by NumPy and Warp.

    ``predict()`` chooses each tree's phi (implicitness of the integrator, 0.5 trapezoidal to 1 backward Euler). phi is
    1 while a joint turns faster than ``fast_rate``. After a joint turned faster than a tenth of ``max_rate``, phi stays
    1 until all joints have been slower than 0.06 ``max_rate`` for a second. phi is also 1 for the time
    ``contact_onset_duration`` after contact began. Otherwise it is the argument ``phi``. ``impulse_response()`` and
    ``integrate()`` use the results of the last ``predict()``.

    Args:
        model: constants. Raises :class:`ValueError` if a tree cannot be simulated.
        state: its arrays are read and written in place.
        parameters: numbers of the scheme; the arguments that follow replace single numbers and may be infinite.
        dt: duration of a step [s].
        phi: implicitness of the integrator, 0.5 (trapezoidal, adds no damping) to 1 (backward Euler).
        device: ``"cpu"`` or ``"cuda"``. With a GPU the arrays of ``state`` are replaced by arrays that the GPU can
        reach, so read them from ``state`` after this call. Results agree with the CPU's to rounding, not to the bit.
        fast_rate, max_rate, fault_rate: [rad/s] see ``fast_joint_rate``, ``max_joint_rate`` and ``fault_joint_rate`` of
            ``PhysicsParameters``, and :mod:`vinesim.plants.fault_guard`.
        geometric_stiffness: include in the implicit solve the geometric stiffness of hanging bodies, due to weight and
        pull.
            Without it a heavy bunch on a soft peduncle gains energy every step. Switch it off only to compare with
            solvers without it.
        substeps: divide the step of trees whose first mode is too fast for it. Switch it off only to compare with other
            solvers.
        buffers: memory for the arrays; by default chosen for ``device``."""

    def __init__(
        self,
        model: Model,
        state: State,
        parameters: PhysicsParameters = PhysicsParameters(),
        *,
        dt: float | None = None,
        phi: float | None = None,
        device: str = "cpu",
        fast_rate: float | None = None,
        max_rate: float | None = None,
        fault_rate: float | None = None,
        geometric_stiffness: bool = True,
        substeps: bool = True,
        buffers: DeviceBuffers | None = None,
    ) -> None:
        p = parameters
        dt = p.dt if dt is None else dt
        phi = p.phi if phi is None else phi
        buffers = DeviceBuffers(device) if buffers is None else buffers
        if not 0.0 < dt < math.inf or not 0.5 <= phi <= 1.0:
            raise ValueError(f"dt {dt} s, phi {phi}: need a finite dt above 0 and phi from 0.5 to 1")
        validate(model, state)
        self.model = model
        self.state = state
        self._dt = dt
        self._gravity = p.gravity
        self.fast_rate = p.fast_joint_rate if fast_rate is None else fast_rate
        self.max_rate = p.max_joint_rate if max_rate is None else max_rate
        self.fault_rate = p.fault_joint_rate if fault_rate is None else fault_rate
        self.buffers = buffers
        """The solver's arrays, for NumPy and for kernels."""
        self.tick = 0
        """Number of integrations so far."""
        self.ties = TieTable(model, p.max_held_bodies, p.max_hands_per_body)
        self.root_rests = RootRests(model)
        self._allocate(phi)
        self.phi[model.body_tree[model.tie_body[model.tie_stiffness * dt**2 > p.stiff_tie_mass]]] = 1.0
        self._pin_arrays()
        numbers = kernel_parameters(p, dt, self.fast_rate, self.max_rate, self.fault_rate, geometric_stiffness)
        self.onset_steps = numbers["contact_steps"] - 1  # steps with phi = 1 after contact began
        self.launches = KernelLaunches(self, numbers, MAX_SUBSTEPS if substeps else 1)
        """The solver's kernels, bound to its arrays."""
        self._runner = StepRunner(
            buffers,
            self.launches,
            tree_substeps=self.tree_substeps,
            tree_steps=self._steps,
            tree_rate=self.tree_rate,
            tree_budget=self.tree_budget,
            lists={
                "stepping": self._stepping,
                "divided": self._divided,
                "groups": self._groups,
                "floating": self._floating,
                "divided_floating": self._divided_floating,
                "levels": self._levels,
            },
            counts=self._counts,
            topologies=Topologies(model, state.body_cut, self.tree_moving),
            whole=np.isin(np.arange(len(model.tree_first)), model.body_tree[model.tie_body[self.ties.on_wire]])
            | model.is_on_arm(),
        )
        self._loads = ContactLoads(
            body_tree=model.body_tree,
            place_in_tree=self._place_in_tree,
            is_stepped=self._runner.is_stepped,
            tree_moving=self.tree_moving,
            body_wrench=self._wrench,
            touched=self._subset,
            touched_count=self._counts[_SUBSET : _SUBSET + 1],
            euler_steps=self._euler_steps,
            onset=self.onset_steps + 1,  # the first step counts
            then=() if buffers.has_copies else (self.launches.wrenches,),
        )
        self._list_awake()
        self.stumps = Stumps(self)
        """The stumps that cuts have left, and the spare bodies for more."""
        self._detach_joints(self.bodies_of(np.unique(model.body_tree[state.body_cut])))
        self.berry_clusters = BerryClusters(self)
        """Locks and unlocks berry clusters. :class:`DetachmentMonitor` also uses it for bunches that it detaches."""

    @property
    def dt(self) -> float:
        """[s] Duration of a step. It is fixed, because kernels, damping and counts of steps are derived from it at the
        start."""
        return self._dt

    def _allocate(self, phi: float) -> None:
        """Allocate the solver's own arrays. Other arrays belong to the model and the state."""
        model = self.model
        state = self.state
        trees = len(self.model.tree_first)
        bodies = len(self.model.body_mass)
        self.phi = np.full(trees, phi, np.float32)
        """[tree] Requested phi (implicitness of the integrator, 0.5 trapezoidal to 1 backward Euler) of each tree;
        callers may change it. Trees with a stiff tie (``stiff_tie_mass``) have 1."""
        self.phi_used = np.zeros(trees, np.float32)
        """[tree] Value of :attr:`phi` that the last ``predict()`` of each tree used; 1 where it had to use backward
        Euler."""
        self.awake_list = np.zeros(trees, np.int32)
        self.awake_count = np.zeros(1, np.int32)
        """[1] Number n of awake trees. The first n entries of ``awake_list`` [tree] are the indices of these trees.
        Kernels are bound to both arrays.
        """
        self.tree_rate = np.zeros(trees, np.float32)
        """[tree] sqrt(a^2 + b^2) of the fastest joint rate a [rad/s] and the fastest speed b [m/s] of a floating root
        in the last step. If it is NaN or above ``fault_rate``, the tree was stopped."""
        self._fastest = np.zeros(1, np.float32)
        self.tree_substeps = np.ones(trees, np.int32)
        """[tree] Number of substeps into which the step of each awake tree is divided while the tree has no contact."""
        self._moved = np.zeros(trees, np.bool_)
        self._fast_steps = np.zeros(trees, np.int32)
        self.tree_budget = np.zeros(trees, np.int32)
        """[tree] How closely the energy of each awake tree is watched: see
        :mod:`vinesim.kernels.plants.energy_budget`."""
        self.tree_air = np.zeros((trees, 3), np.float32)
        """Velocity of the air around each tree [tree, 3] m/s; see :mod:`vinesim.wind.plant_wind`."""
        self.body_load = np.zeros((bodies, 6), np.float32)
        """[body, 6] Wrenches that last until they are changed (wind, a rope): force [N] and moment about the body's
        origin [N m], world axes."""
        self.velocity_free = np.zeros((bodies, 6), np.float32)
        """[body, 6] m/s, rad/s: velocity of each body of an awake tree at the end of the step, without contacts."""
        self.acceleration = np.zeros((bodies, 6), np.float32)
        """Acceleration over the last step [body, 6] m/s^2, rad/s^2, world axes."""
        self.body_mass = model.body_mass.copy()
        self.body_com = model.body_com.copy()
        self.body_inertia = model.body_inertia.copy()
        self.body_drag = model.body_drag.copy()
        """[body] m^2: drag area of each body as it is now.

        The arrays from ``body_mass`` to ``body_drag`` are mass, centre of mass, inertia and drag of the bodies as they
        are now, in the model's units. The body of a bunch has the values of the whole bunch while its tree is coarse
        (the berry clusters are locked to it), and the values of the bunch's head while the tree is fine. The body of a
        picked bunch is a stub.
        """
        self.body_product = np.zeros((bodies, 3), np.float32)
        """[body, 3] kg m^2: entries yz, zx, xy of the inertia in the body's axes. The inertia of a compound is not
        diagonal."""
        self.joint_stiffness = model.joint_stiffness.copy()
        self.joint_damping = model.joint_damping.copy()
        """The model's damping, but zero where a body has been cut off. If ties hold the cut-off part, the entry is the
        damping with which the ties resist its rotation."""
        self.core_moving = model.tree_core - model.tree_spares
        """[tree] Number of bodies of each tree's core that move: all except the spare bodies that are not yet used."""
        self.tree_moving = np.where(state.tree_fine, model.tree_size, self.core_moving).astype(np.int32)
        """[tree] Number of bodies of each tree that move: all bodies, or those of the core that move."""
        self.body_parent = model.body_parent.copy()
        """[body] Parent of each body, also of stumps. A body that was cut off keeps its former parent here."""
        self.body_start = np.zeros(bodies, np.float32)
        self.body_end = np.where(model.is_spare(), 0.0, model.body_length).astype(np.float32)
        """[body] m: distance from each body's origin to the end of its wood.

        ``body_start`` [body] m: distance to the beginning of its wood, which is 0 unless a cut has left a stump.
        """
        self.joint_settled = model.joint_settled.copy()
        """[body, 4] ``Model.joint_settled`` of each joint, also of stumps."""
        self.body_impulse = np.zeros((bodies, 6), np.float32)
        """[body, 6] N s, N m s: scratch for the impulses of a plastic impact."""
        self.joint_xd_free = np.zeros((bodies, 3), np.float32)
        self.joint_qd_free = np.zeros((bodies, 3), np.float32)
        """[body, 3] rad/s: predicted rates of joints at the end of the step without contacts.

        ``joint_xd_free`` [body, 3] m/s: predicted velocities of floating roots.
        """
        self._place_in_tree = (np.arange(bodies) - model.tree_first[model.body_tree]).astype(np.int32)
        # the trees as the kernels use them: a cut-off body has no parent and no lever
        self._parent = model.body_parent.copy()
        self._root = np.full(bodies, -1, np.int32)
        self._offset = model.body_offset.copy()
        self._rest = model.body_rest.copy()
        if len(bent := np.flatnonzero((state.joint_set[:, :3] != 0.0).any(1))):
            self._rest[bent] = frames.normalize(frames.multiply(model.body_rest[bent], state.joint_set[bent]))
        self._grown_rest = model.body_rest.copy()
        """[body, 4] Rest rotation of each joint without its set (``State.joint_set``)."""
        self._falls = np.zeros(bodies, np.bool_)  # whether no tie holds the body's floating component
        self._floating, self._divided_floating = (np.zeros(bodies, np.int32) for _ in range(2))
        self._falling_roots = np.zeros(0, np.int32)
        self._wrench = np.zeros((bodies, 6), np.float32)
        self._euler_steps = np.zeros(trees, np.int32)
        self._steps = np.ones(trees, np.int32)
        self._stepping, self._divided, self._subset = (np.zeros(trees, np.int32) for _ in range(3))
        self._groups = np.zeros((trees, 2), np.int32)
        self._levels = np.zeros((MAX_SUBSTEPS, 2), np.int32)
        self._counts = np.zeros(_COUNTS, np.int32)

    def _pin_arrays(self) -> None:
        """Move the arrays of solver, ties and state to memory that the device can reach."""
        for owner in (self, self.ties, self.root_rests, self.state):
            for name, value in vars(owner).items():
                if isinstance(value, np.ndarray):
                    setattr(owner, name, self.buffers.pinned(value))

    def kernel_arrays(self) -> dict[Any, dict[str, np.ndarray]]:
        """Returns all arrays that kernels read or write, by element type and name."""
        model = self.model
        state = self.state
        ties = self.ties
        rests = self.root_rests
        return {
            wp.int32: {
                "tree_moving": self.tree_moving,
                "body_tree": model.body_tree,
                "body_parent": self._parent,
                "body_root": self._root,
                "stepping": self._stepping,
                "divided": self._divided,
                "subset": self._subset,
                "counts": self._counts,
                "levels": self._levels,
                "tree_euler_steps": self._euler_steps,
                "tree_steps": self._steps,
                "floating": self._floating,
                "divided_floating": self._divided_floating,
                "tree_substeps": self.tree_substeps,
                "tree_budget": self.tree_budget,
                "tree_fast_steps": self._fast_steps,
            },
            float: {
                "body_mass": self.body_mass,
                "body_drag": self.body_drag,
                "tie_stiffness": ties.stiffness,
                "tie_damping": ties.damping,
                "tie_softening": ties.softening,
                "tie_slip": ties.slip,
                "tie_strength": ties.strength,
                "tree_phi": self.phi,
                "phi_used": self.phi_used,
                "tree_rate": self.tree_rate,
                "fastest": self._fastest,
            },
            wp.vec2i: {"tie_span": ties.span, "groups": self._groups},
            wp.bool: {"tree_awake": state.tree_awake, "tree_moved": self._moved, "body_falls": self._falls},
            wp.vec3: {
                "body_offset": self._offset,
                "body_com": self.body_com,
                "body_inertia": self.body_inertia,
                "body_product": self.body_product,
                "joint_stiffness": self.joint_stiffness,
                "joint_damping": self.joint_damping,
                "tie_point": ties.point,
                "tie_anchor": ties.anchor,
                "tie_anchor_velocity": ties.anchor_velocity,
                "tie_axis": ties.axis,
                "tree_air": self.tree_air,
                "root_turn": rests.turn,
                "root_turn_rate": rests.rate,
                "root_softening": rests.softening,
                "joint_x": state.joint_x,
                "joint_xd": state.joint_xd,
                "joint_qd": state.joint_qd,
                "joint_xd_free": self.joint_xd_free,
                "joint_qd_free": self.joint_qd_free,
            },
            wp.quat: {"body_rest": self._rest, "joint_q": state.joint_q},
            wp.transform: {"body_q": state.body_q},
            wp.spatial_vector: {
                "body_qd": state.body_qd,
                "body_load": self.body_load,
                "body_wrench": self._wrench,
                "body_impulse": self.body_impulse,
                "body_acceleration": self.acceleration,
                "body_qd_free": self.velocity_free,
            },
        }

    # ------------------------------------------------------------------ awake and asleep

    @property
    def awake(self) -> np.ndarray:
        """Ids of the awake trees, sorted [k] int32."""
        return self._awake

    def wake(self, trees: np.ndarray | int) -> None:
        """Wake trees; they move from the next ``predict()`` on. Raises :class:`ValueError` if there is no such tree."""
        trees = checked_trees(trees, len(self.state.tree_awake))
        if not self.state.tree_awake[trees].all():
            self.state.tree_awake[trees] = True
            self._list_awake()

    def put_to_sleep(self, trees: np.ndarray | int) -> None:
        """Put trees to sleep in their present pose with zero rates, and update ``body_q`` and ``body_qd``.

        :class:`ValueError` if there is no such tree.
        """
        trees = checked_trees(trees, len(self.state.tree_awake))
        if len(trees) == 0:
            return
        bodies = self.bodies_of(trees)
        for rows in (self.state.joint_qd, self.state.joint_xd, self.velocity_free, self.acceleration, self._wrench):
            rows[bodies] = 0.0
        self.tree_rate[trees] = 0.0
        self._euler_steps[trees] = 0
        self._fast_steps[trees] = 0
        self.forward_kinematics(trees)
        self.state.tree_awake[trees] = False
        self._list_awake()

    def _list_awake(self) -> None:
        self._awake = np.flatnonzero(self.state.tree_awake).astype(np.int32)
        self.awake_count[0] = len(self._awake)
        self.awake_list[: len(self._awake)] = self._awake

    def awake_trees(self) -> list[wp.array]:
        """Returns the number of awake trees [1] and the list of awake trees [tree], as Warp arrays for kernels on a
        CPU."""
        return [share(self.awake_count, wp.int32), share(self.awake_list, wp.int32)]

    def bodies_of(self, trees: np.ndarray) -> np.ndarray:
        """Returns the indices [k] of all bodies of ``trees``, tree by tree."""
        return spans(self.model.tree_first[trees], self.model.tree_size[trees])

    # ------------------------------------------------------------------ topology and mass

    def refine(self, trees: np.ndarray | int) -> None:
        """Unlock the berry clusters of these trees' bunches. Each cluster starts with the pose and velocity that it has
        as part of its bunch.

        Pose, velocity and momentum are continuous. Trees that are fine or have no clusters do not change. No tree
        wakes. :class:`ValueError` if there is no such tree.
        """
        self.berry_clusters.refine(trees)

    def coarsen(self, trees: np.ndarray | int) -> None:
        """Lock the berry clusters of these trees' bunches in their present pose: each bunch becomes one compound body.

        No pose changes. The clusters' motion against their bunch ends in a plastic impact that lasts a step. A bunch
        keeps its angular momentum about its origin. The impulse on its joint moves the rest of the tree, and springs
        resist as in any step (without springs a light peduncle would be flung about). A floating tree keeps all
        momentum. Kinetic energy does not grow if it is measured with the scheme's implicit inertia.
        """
        self.berry_clusters.coarsen(trees)

    def cut(self, body: int, at: float = 0.0) -> int:
        """Cut a body of wood. What is beyond the cut, with its descendants, falls with its present pose and velocity.

        ``at``: place of the cut [m] from the body's origin; 0: at the joint between the body and its parent. The wood
        before the cut becomes a stump, whose body is returned; -1 if there is none. If the tree has no spare body for a
        stump, or the wood cannot be split, the cut is made at the joint, and the log says why. The tree wakes. Indices
        of bodies never change. Raises :class:`ValueError` if the body cannot be cut there.
        """
        model = self.model
        state = self.state
        body = checked_index("body", body, len(model.body_mass))
        tree = int(model.body_tree[body])
        if body - model.tree_first[tree] >= model.tree_core[tree]:
            raise ValueError(f"body {body} of tree {tree} is a berry cluster; cut off its bunch")
        if self.body_end[body] <= self.body_start[body]:
            raise ValueError(f"body {body} of tree {tree} is a spare without wood")
        spare = -1
        if at != 0.0:
            at = place_between(float(self.body_start[body]), float(self.body_end[body]), at, body)
            spare = self.stumps.spare_for(body, at)
        if spare < 0 and state.body_cut[body]:
            raise ValueError(f"body {body} of tree {tree} has been cut off already")
        self.forward_kinematics(tree)
        if spare >= 0:
            self.stumps.leave(spare, self.stumps.segment_of(body), at, floats=bool(state.body_cut[body]))
        self._cut_off(body)
        self._detach_joints(self.bodies_of(np.array([tree])))
        self.wake(tree)
        return spare

    def leave_stump(self, spare: int, segment: int, at: float, *, floats: bool) -> None:
        """Make a spare body the stump of a cut that another client has made ``at`` [m] along ``segment``, with the
        present pose of that wood. The caller cuts off what is beyond.

        ``floats``: whether the stump has no parent. Raises :class:`ValueError` if the wood cannot be split there.
        """
        tree = np.array([self.model.body_tree[spare]])
        self.forward_kinematics(tree)
        self.stumps.leave(spare, segment, at, floats=floats)
        self._detach_joints(self.bodies_of(tree))

    def withdraw_stump(self, spare: int) -> None:
        """Make a stump a spare body again: another client has made another cut with it. The wood beyond, which stays
        cut off, begins at the joint."""
        tree = np.array([self.model.body_tree[spare]])
        self.stumps.withdraw(spare)
        self._detach_joints(self.bodies_of(tree))
        self.forward_kinematics(tree)

    def _cut_off(self, body: int) -> None:
        """Make a body a floating root in its present pose."""
        state = self.state
        if not state.body_cut[body]:
            state.joint_x[body] = state.body_q[body, :3]
            state.joint_q[body] = state.body_q[body, 3:]
            state.joint_xd[body] = state.body_qd[body, :3]
            state.joint_qd[body] = state.body_qd[body, 3:]
            state.body_cut[body] = True
            state.joint_set[body] = frames.IDENTITY
            state.joint_flow[body] = 0.0

    def _detach_joints(self, bodies: np.ndarray) -> None:
        """Read from the state which bodies are cut off. ``bodies``: all bodies of some trees."""
        cut = bodies[self.state.body_cut[bodies]]
        held = bodies[~self.state.body_cut[bodies]]
        self._parent[held] = self.body_parent[held]
        self._parent[cut] = -1
        self._offset[cut] = 0.0
        self._rest[cut] = frames.IDENTITY
        self.joint_stiffness[cut] = 0.0
        self.joint_damping[cut] = 0.0
        up = bodies
        while ((above := self._parent[up]) >= 0).any():
            up = np.where(above >= 0, above, up)
        self._root[bodies] = np.where(self.state.body_cut[up], up, -1)
        self._find_falling(bodies)

    def _find_falling(self, bodies: np.ndarray) -> None:
        """Find the floating components that no tie holds, and set the damping with which ties resist the rotation of
        the held ones. ``bodies``: all bodies of some trees."""
        root = self._root[bodies]
        is_cut = self.state.body_cut[bodies]
        tied = self.ties.are_tied(bodies)
        self._falls[bodies] = (root >= 0) & ~np.isin(root, root[tied])
        if is_cut.any():
            damping = turning_damping(self.model, bodies, root, tied, self._gravity)
            self.joint_damping[bodies[is_cut]] = damping[is_cut, None]
        self._falling_roots = np.flatnonzero(self.state.body_cut & self._falls).astype(np.int32)
        self.launches.changed = True

    def set_mass(self, body: int, mass: float) -> None:
        """Set the mass [kg] of one body, for example of a picked bunch or a pruned leaf. The body's inertia scales with
        the mass.

        For a bunch with clusters ``mass`` is the mass of the whole bunch, also in a fine tree. Head and clusters keep
        their shares of it.
        """
        if not 0.0 < mass < math.inf:
            raise ValueError(f"body {body}: mass {mass} kg; leave a stub of a gram")
        self.berry_clusters.set_mass(body, mass)

    def set_set(self, bodies: np.ndarray, kept: np.ndarray) -> None:
        """Change the set (``State.joint_set``) of ``bodies`` [k] to ``kept`` [k, 4] xyzw. Their poses and velocities do
        not change, only what their springs pull towards.

        A body that has been cut off has no joint, and keeps no set.
        """
        state = self.state
        bodies, kept = bodies[held := ~state.body_cut[bodies]], frames.normalize(np.asarray(kept, float)[held])
        before = state.joint_set[bodies].astype(float)
        turn = frames.multiply(frames.conjugate(kept), before)
        state.joint_set[bodies] = kept
        self._rest[bodies] = frames.normalize(frames.multiply(self._grown_rest[bodies].astype(float), kept))
        state.joint_q[bodies] = frames.normalize(frames.multiply(turn, state.joint_q[bodies].astype(float)))
        state.joint_qd[bodies] = frames.rotate(turn, state.joint_qd[bodies].astype(float))
        self.buffers.upload(["body_rest"])

    def _set_rest(self, body: int) -> None:
        """Set the rest rotation of a joint from that of its wood and its set."""
        kept = self.state.joint_set[body].astype(float)
        grown = self._grown_rest[body].astype(float)
        self._rest[body] = frames.normalize(frames.multiply(grown, kept)) if kept[:3].any() else grown

    def set_inertia(self, body: int, mass: float, com: np.ndarray, inertia: np.ndarray) -> None:
        """Set mass [kg], centre of mass [3] m and moments of inertia about it [3] kg m^2 of one piece of wood, in its
        frame, for example of the stump that a cut leaves."""
        if not (0.0 < mass < math.inf and (np.asarray(inertia) > 0.0).all()):
            raise ValueError(f"body {body}: mass {mass} kg, moments of inertia {inertia} kg m^2; both must be positive")
        self.body_mass[body] = mass
        self.body_com[body] = com
        self.body_inertia[body] = inertia
        self.launches.changed = True

    # ------------------------------------------------------------------ one step

    def predict(self, trees: np.ndarray | None = None) -> None:
        """Compute ``body_q`` and ``body_qd`` at the start of the step, and the motion over the step without contacts.

        ``trees`` [k]: repeat the prediction for only these trees, because they were woken, or their phi (implicitness
        of the integrator, 0.5 trapezoidal to 1 backward Euler) was changed, after all trees were predicted.
        """
        launches = self.launches
        self._runner.list_trees(self._awake)
        if trees is None:
            launches.upload_step(count := len(self._runner.stepped))
            self._runner.predict()
            launches.download_prediction(count)
        else:
            self.list_subset(trees)
            launches.upload_subset_step(count := len(trees))
            launches.predict_subset(count)
            launches.download_subset_prediction(count)
        self.buffers.synchronize()

    def impulse_response(self, bodies: np.ndarray) -> np.ndarray:
        """Returns the velocity changes of bodies by unit impulse wrenches: [n, 6, n, 6] in 1/kg, 1/(kg m), 1/(kg m^2).

        ``impulse_response[u, :, t, :] @ impulse`` is the velocity that an impulse wrench (N s, N m s, at the origin of
        body ``t``) adds to body ``u`` of ``bodies`` [n]. Symmetric; zero between different trees.
        """
        self.require_stepped(bodies)
        return self.launches.dense_impulse_response(bodies)

    def blow_response(self, bodies: np.ndarray, points: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """Returns the velocities [n, n] of points of ``bodies`` [n] along ``axes`` [n, 3] by unit impulses on each of
        the points along its axis, after :data:`BLOW_DURATION`: 1/kg. Call it between steps.

        ``points`` [n, 3] m, in the world. In so short a time a blow moves only the bodies nearby: the diagonal is the
        inverse of the mass that each blow meets. Nothing else changes.
        """
        self.list_subset(np.unique(self.model.body_tree[bodies]))
        return self.launches.blow_response(bodies, points, axes)

    def integrate(self, bodies: np.ndarray | None = None, wrenches: np.ndarray | None = None) -> None:
        """End the step: integrate the joints with ``wrenches`` [N, N m] that act over the step, at the bodies' origins,
        in world axes.

        ``bodies`` [n] may name one body several times; ``wrenches`` has the shape [n, 6].
        """
        launches = self.launches
        touched = _NO_TREES
        count = len(self._runner.stepped)
        if bodies is not None and len(bodies):
            touched = self._load(bodies, np.asarray(wrenches))
        elif len(self._loads):
            self._load(_NO_TREES, _NO_WRENCHES)
        self._fastest[0] = 0.0
        self._runner.integrate(touched, *self._floating_roots())
        launches.download_joints(count)
        self.buffers.synchronize()
        self.tick += 1

    def slow_turning(self, bodies: np.ndarray, share: float) -> None:
        """Between steps: multiply the angular velocities of the cut-off parts to which ``bodies`` [k] belong by
        ``share``. Bodies that are not cut off stay as they are."""
        roots = np.unique(self._root[bodies])
        self.state.joint_qd[roots[roots >= 0]] *= share

    def fastest_rate(self) -> float:
        """Returns the largest entry of :attr:`tree_rate` after the last ``integrate()``, or an upper bound of that
        entry; infinity if an entry is NaN."""
        if self.buffers.has_copies:
            return float(np.nan_to_num(self.tree_rate[self._awake], nan=math.inf).max(initial=0.0))
        return float(self._fastest[0])

    def _load(self, bodies: np.ndarray, wrenches: np.ndarray) -> np.ndarray:
        """Replace the contact wrenches of the last step by ``wrenches`` [n, 6] on ``bodies`` [n]. Returns the trees [k]
        of these bodies."""
        touched = self._loads.replace(bodies, wrenches, self.tick)
        if self.buffers.has_copies:
            self.launches.upload_wrenches(len(self._runner.stepped))
            self.launches.apply_wrenches(len(touched))
        return touched

    def _floating_roots(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the floating roots that move in this step: their places in the kernels' arrays [k], and their trees
        [k]."""
        if len(self._falling_roots) == 0:
            return _NO_TREES, _NO_TREES
        tree = self.model.body_tree[self._falling_roots]
        roots = self._falling_roots[self.state.tree_awake[tree] & np.isin(tree, self._runner.stepped)]
        return self.buffers.slots[roots], self.model.body_tree[roots]

    def advance(
        self, steps: int, between: Callable[[], None] = _launch_nothing, beside: Beside = _NOTHING_BESIDE
    ) -> None:
        """Take many steps of the awake trees without sleep and fault guard. ``between`` launches the kernels that run
        between prediction and integration, such as contacts. ``beside``: what a GPU does at the same time as prediction
        and integration, such as the steps of rigid bodies.

        A GPU works on its own copies of all arrays: call :meth:`upload` after each change of an array on the host, and
        :meth:`download` after the steps. During the steps nothing is copied between host and GPU. Afterwards
        ``velocity_free`` and ``acceleration`` hold the values of the last step. A tree whose motion became invalid
        (``tree_rate`` NaN or above ``fault_rate``) keeps its last valid pose.
        """
        self._runner.list_trees(self._awake)
        floating = self._floating_roots()
        if len(self._loads) and steps > 0:  # the next prediction still has the last contacts
            self._runner.predict()
            self._load(_NO_TREES, _NO_WRENCHES)
            self._runner.integrate(_NO_TREES, *floating)
            self.buffers.synchronize()
            self._runner.advance(steps - 1, *floating, between, beside)
        else:
            self._runner.advance(steps, *floating, between, beside)
        self.tick += steps

    def let_kernels_cut(self, cuts: int) -> None:
        """Let kernels cut trees during :meth:`advance`, by changing the solver's arrays as :meth:`cut` does.

        They write the floating roots to the first ``cuts`` times [tree] entries of the list ``floating``, with -1 for
        none. The host's state does not learn of these cuts. Every tree counts as a topology of its own.
        """
        self._runner.let_kernels_cut(cuts * len(self.model.tree_first))

    def upload(self) -> None:
        """Copy the host's arrays of the awake trees to the device; on a CPU there is nothing to copy."""
        self._runner.list_trees(self._awake)
        self._runner.uploaded = None
        self.launches.upload_step(len(self._runner.stepped))
        self.buffers.synchronize()

    def download(self) -> None:
        """Copy the device's arrays of the awake trees to the host, after calls of :meth:`advance` or after kernels have
        changed the device's arrays. :meth:`upload` comes before the first such call."""
        self.launches.download_trees()
        self.launches.download_prediction(len(self._runner.stepped))
        self.launches.download_joints(len(self._runner.stepped))
        self.buffers.synchronize()

    def use_backward_euler(self, trees: np.ndarray) -> None:
        """Integrate trees with backward Euler (phi = 1) for the time ``contact_onset_duration``.

        Call it for trees that are about to be touched. For trees that are already touched, ``integrate()`` does the
        same.
        """
        self._euler_steps[trees] = np.maximum(self._euler_steps[trees], self.onset_steps)

    def forward_kinematics(self, trees: np.ndarray | int | None = None) -> None:
        """Compute ``body_q`` and ``body_qd`` of ``trees`` (default: the awake trees) from their joints, without a
        step."""
        trees = self._awake if trees is None else np.atleast_1d(trees)
        self.list_subset(trees)
        self.launches.upload_changed()
        self.launches.upload_subset_joints(len(trees))
        self.launches.forward_kinematics(len(trees))
        self.launches.download_subset_bodies(len(trees))
        self.buffers.synchronize()

    def list_subset(self, trees: np.ndarray) -> None:
        """Write ``trees`` [k] to the list from which the kernels for a subset of the trees read their trees."""
        self._subset[: len(trees)] = trees
        self._counts[_SUBSET] = len(trees)

    def require_stepped(self, bodies: np.ndarray) -> None:
        """Raises :class:`ValueError` unless all ``bodies`` [k] can move and their trees were in the last prediction."""
        self._loads.require_stepped(np.asarray(bodies))

    def blend_towards(self, tree: int, joint_q: np.ndarray, joint_qd: np.ndarray, blend: float) -> None:
        """Change the joint state of one tree towards the state that another client has sent: joint rotations by the
        share ``blend`` (0 to 1) of the way to ``joint_q`` [k, 4]; joint rates are set to ``joint_qd`` [k, 3].
        """
        blend_towards(self, tree, joint_q, joint_qd, blend)

    # ------------------------------------------------------------------ ties, wrenches, damping

    @property
    def tie_anchor(self) -> np.ndarray:
        """[tie, 3] m, in the world: the fixed end of each tie (a spring and damper on a point of a body). Callers may
        move it. See :meth:`add_tie`.
        """
        return self.ties.anchor

    @property
    def tie_stiffness(self) -> np.ndarray:
        """[tie] N/m: stiffness of each tie (a spring and damper on a point of a body). A tie of zero stiffness does
        nothing.
        """
        return self.ties.stiffness

    @property
    def tie_damping(self) -> np.ndarray:
        """[tie] N s/m: damping of each tie (a spring and damper on a point of a body)."""
        return self.ties.damping

    @property
    def held_bodies(self) -> list[int]:
        """Bodies that ties of :meth:`add_tie` hold."""
        return self.ties.held_bodies

    def add_tie(self, body: int, point: np.ndarray, stiffness: float, damping: float, *, is_bound: bool = False) -> int:
        """Hold a body at ``point`` [3] m, in its own frame, by a spring [N/m] and damper [N s/m]; returns the tie.
        ``is_bound``: the tie stays without a hand, so that the tree may fall asleep.

        The spring pulls the point to the tie's ``tie_anchor``, which starts at the point; callers may move it.
        Raises :class:`TieLimitError` if too many bodies are held, or this body in too many places, and
        :class:`ValueError` for a berry cluster and for numbers that are not finite.
        """
        body = checked_index("body", body, len(self.model.body_mass))
        if body - self.model.tree_first[tree := self.model.body_tree[body]] >= self.model.tree_core[tree]:
            raise ValueError(f"body {body} is a berry cluster, which cannot be held; hold its bunch")
        self.forward_kinematics(np.array([tree]))
        pose = self.state.body_q[body].astype(float)
        tie = self.ties.add(body, point, pose, stiffness, damping, is_bound=is_bound)
        self._find_falling(self.bodies_of(np.array([tree])))
        return tie

    def break_tie(self, tie: int) -> None:
        """Let a tie of the model hold nothing any more (``State.tie_broken``). The tree does not wake."""
        self.state.tie_broken[tie] = True
        self.ties.release(tie)
        self._find_falling(self.bodies_of(self.model.body_tree[self.model.tie_body[[tie]]]))

    def slide_tie(self, tie: int, way: float) -> None:
        """Move a tie of the model by ``way`` [m] along its wire (``State.tie_slid``)."""
        self.state.tie_slid[tie] += way
        self.state.tie_flow[tie] += abs(way)
        self.ties.slide(tie, way * self.ties.axis[tie])

    def remove_tie(self, body: int, tie: int) -> None:
        """Remove a tie that :meth:`add_tie` added."""
        self.ties.remove(body, tie)
        self._find_falling(self.bodies_of(self.model.body_tree[[body]]))

    def joint_wrench(self, bodies: np.ndarray) -> np.ndarray:
        """Returns the wrench [n, 6] that the parent of each of the ``bodies`` [n] exerted on the body through its joint
        in the last step: force [N], and moment [N m] about the body's origin, world axes.

        The result is valid only for bodies of trees that were awake in the last step. If the tree does not move, the
        force is upwards and equals the weight of the body and its descendants.
        """
        return self.launches.joint_wrench(bodies)

    def damping_floor(self, frequency: float, phi: float | None = None) -> float:
        """Returns the least damping ratio [1] that the integrator permits for a first mode of ``frequency`` f [Hz]:
        pi f (2 phi - 1) dt / substeps. ``phi``: implicitness of the integrator, 0.5 trapezoidal to 1 backward Euler;
        the largest one of all trees unless given."""
        phi = float(self.phi.max(initial=0.5)) if phi is None else phi
        return math.pi * frequency * (2.0 * phi - 1.0) * self.dt / substeps_for(frequency, self.dt)


# Berry clusters: in a fine tree they move, in a coarse tree they are locked to their bunch as one compound body.
# Locking ends the clusters' motion relative to their bunch in an instantaneous plastic impact. The joints respond to
# its impulse through the factors of inertia and springs alone.


def spans(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Returns the numbers ``first[i] ... first[i] + count[i] - 1`` of each span i, concatenated [sum of count]."""
    end = np.cumsum(count)
    return np.repeat(first - (end - count), count) + np.arange(end[-1] if len(end) else 0)


class BerryClusters:
    """Locks the berry clusters of bunches to their bunch, and unlocks them, in the trees of one solver; see
    :meth:`ArticulationSolver.refine`.
    """

    def __init__(self, solver: ArticulationSolver) -> None:
        self._solver: ArticulationSolver = weakref.proxy(solver)  # no cycle of references
        model = solver.model
        clustered = np.flatnonzero(model.bunch_clusters > 0)
        tree = model.body_tree[model.bunch_body[clustered]]
        order = np.argsort(tree, kind="stable")
        self.bunches = clustered[order]
        self._bunch_tree = tree[order]
        """[k] Tree of each entry of ``bunches``. ``bunches`` [k] lists the bunches that have berry clusters, sorted by
        tree.
        """
        self.head_mass = model.bunch_head_mass.copy()
        self.head_inertia = model.bunch_head_inertia.copy()
        """[bunch, 3] kg m^2: moments of inertia of each bunch's head, the part of the bunch that belongs to no cluster.
        ``head_mass`` [bunch] kg: its mass."""
        fine = solver.state.tree_fine[self._bunch_tree]
        self.lock(self.bunches[~fine])
        self.unlock(self.bunches[fine])

    def clustered_trees(self, trees: np.ndarray | int, *, fine: bool) -> np.ndarray:
        """Returns the trees [k] among ``trees`` that have berry clusters and are in the given level of detail, sorted.

        ``fine``: true for trees in which the clusters move, false for trees in which they are locked (coarse).
        """
        model = self._solver.model
        trees = np.unique(checked_trees(trees, len(self._solver.state.tree_fine)))
        return trees[(self._solver.state.tree_fine[trees] == fine) & (model.tree_core[trees] < model.tree_size[trees])]

    def clusters_of(self, trees: np.ndarray) -> np.ndarray:
        """Returns the bodies [k] of the berry clusters of ``trees``."""
        model = self._solver.model
        core = model.tree_core[trees]
        return spans(model.tree_first[trees] + core, model.tree_size[trees] - core)

    def bunches_of(self, trees: np.ndarray) -> np.ndarray:
        """Returns the bunches [k] of ``trees`` that have berry clusters."""
        start, end = (np.searchsorted(self._bunch_tree, trees, side=side) for side in ("left", "right"))
        return self.bunches[spans(start, end - start)]

    def refine(self, trees: np.ndarray | int) -> None:
        """Unlock the berry clusters of trees; see :meth:`ArticulationSolver.refine`."""
        solver = self._solver
        trees = self.clustered_trees(trees, fine=False)
        if len(trees) == 0:
            return
        self.unlock(self.bunches_of(trees))
        solver.state.tree_fine[trees] = True
        solver.tree_moving[trees] = solver.model.tree_size[trees]
        solver.state.joint_qd[self.clusters_of(trees)] = 0.0
        solver.forward_kinematics(trees)

    def coarsen(self, trees: np.ndarray | int) -> None:
        """Lock the berry clusters of trees to their bunches; see :meth:`ArticulationSolver.coarsen`."""
        solver = self._solver
        trees = self.clustered_trees(trees, fine=True)
        if len(trees) == 0:
            return
        bunches = self.bunches_of(trees)
        riding = self.clusters_of(trees)
        impulse = self.lock(bunches)
        solver.state.tree_fine[trees] = False
        solver.tree_moving[trees] = solver.core_moving[trees]
        solver.state.joint_qd[riding] = 0.0
        solver.velocity_free[riding] = 0.0
        solver.acceleration[riding] = 0.0
        if impulse.any():
            self._apply_impact(trees, solver.model.bunch_body[bunches], impulse)
        solver.forward_kinematics(trees)

    def _apply_impact(self, trees: np.ndarray, bodies: np.ndarray, impulse: np.ndarray) -> None:
        """Change the joint rates of trees by impulses [k, 6] N s, N m s on the ``bodies`` of bunches [k]. The impulses
        are given about each body's origin, in its axes."""
        solver = self._solver
        state = self._solver.state
        launches = self._solver.launches
        solver.forward_kinematics(trees)
        axes = state.body_q[bodies, 3:].astype(float)
        solver.body_impulse[bodies, :3] = frames.rotate(axes, impulse[:, :3])
        solver.body_impulse[bodies, 3:] = frames.rotate(axes, impulse[:, 3:])
        springs = solver.joint_stiffness[bodies], solver.joint_damping[bodies]
        solver.joint_stiffness[bodies] = 0.0
        solver.joint_damping[bodies] = 0.0
        solver.list_subset(trees)
        launches.changed = True
        launches.upload_changed()
        launches.upload_impact(len(trees))
        launches.factor_impact(len(trees))
        solver.buffers.synchronize()
        solver.joint_stiffness[bodies], solver.joint_damping[bodies] = springs
        launches.changed = True
        moving = spans(solver.model.tree_first[trees], solver.model.tree_core[trees])
        solver.joint_qd_free[moving] = state.joint_qd[moving]
        solver.joint_xd_free[moving] = state.joint_xd[moving]
        launches.upload_impact_rates(len(trees))
        launches.apply_impulses(len(trees))
        launches.download_impact_rates(len(trees))
        solver.buffers.synchronize()
        solver.body_impulse[bodies] = 0.0
        state.joint_qd[moving] = solver.joint_qd_free[moving]
        roots = moving[state.body_cut[moving]]
        state.joint_xd[roots] = solver.joint_xd_free[roots]

    def set_mass(self, body: int, mass: float) -> None:
        """Set the mass [kg] of one body; see :meth:`ArticulationSolver.set_mass`."""
        solver = self._solver
        model = self._solver.model
        bunches = self.bunches[model.bunch_body[self.bunches] == body]
        parts = spans(model.bunch_cluster[bunches], model.bunch_clusters[bunches])
        whole = solver.body_mass[body]
        if len(bunches):
            whole = self.head_mass[bunches].sum() + solver.body_mass[parts].sum()
        share = mass / float(whole)
        self.head_mass[bunches] *= share
        self.head_inertia[bunches] *= share
        parts = np.append(parts, body)
        solver.body_mass[parts] *= share
        solver.body_inertia[parts] *= share
        solver.body_product[parts] *= share
        solver.launches.changed = True

    def fuse(self, bunch: int) -> np.ndarray:
        """Give one bunch's body the mass of its head and clusters together. Returns the velocity [6] m/s, rad/s of the
        body's frame, in world axes, with which this compound has the momentum of its parts.

        The state does not change. Call it for a bunch that is detached from its tree, before :meth:`release`. The
        bunch's poses and velocities must be up to date.
        """
        solver = self._solver
        body = int(self._solver.model.bunch_body[bunch])
        pose = solver.state.body_q[body].astype(float)
        velocity = solver.state.body_qd[body].astype(float)
        if not solver.state.tree_fine[solver.model.body_tree[body]] or solver.model.bunch_clusters[bunch] == 0:
            return velocity
        momentum = self.lock(np.array([bunch]))[0]
        mass = float(solver.body_mass[body])
        com = solver.body_com[body].astype(float)
        x, y, z = solver.body_product[body].astype(float)
        tensor = np.diag(solver.body_inertia[body].astype(float)) + np.array([[0, z, y], [z, 0, x], [y, x, 0]])
        spin = np.linalg.solve(tensor, momentum[3:] - np.cross(com, momentum[:3]))
        change = np.stack([momentum[:3] / mass - np.cross(spin, com), spin])
        return velocity + frames.rotate(pose[3:], change).ravel()

    def release(self, bunch: int) -> None:
        """Undo :meth:`fuse` for one bunch of a fine tree: its clusters move again."""
        self.unlock(np.array([bunch] if self._solver.model.bunch_clusters[bunch] else [], np.int64))

    def unlock(self, bunches: np.ndarray) -> None:
        """Give each bunch's body the mass and inertia of the bunch's head alone, so that the clusters move on their
        own."""
        solver = self._solver
        model = self._solver.model
        bodies = model.bunch_body[bunches]
        solver.body_mass[bodies] = self.head_mass[bunches]
        solver.body_com[bodies] = model.bunch_head_com[bunches]
        solver.body_inertia[bodies] = self.head_inertia[bunches]
        solver.body_product[bodies] = 0.0
        solver.launches.changed = True

    def lock(self, bunches: np.ndarray) -> np.ndarray:
        """Make each bunch's body a compound of its head and clusters, in their present poses.

        Returns the momentum [bunch, 6] of the clusters' motion relative to the body: N s, and N m s about the body's
        origin, in its axes.
        """
        solver = self._solver
        model = self._solver.model
        state = self._solver.state
        n = len(bunches)
        bodies = model.bunch_body[bunches]
        most = int(model.bunch_clusters[bunches].max(initial=0))
        # in the bunch's frame; the head first
        here = np.zeros((n, most + 1, 7))
        speed = np.zeros((n, most + 1, 6))
        here[..., 6] = 1.0
        mass = np.zeros((n, most + 1))
        com = np.zeros((n, most + 1, 3))
        inertia = np.zeros((n, most + 1, 3))
        mass[:, 0] = self.head_mass[bunches]
        com[:, 0] = model.bunch_head_com[bunches]
        inertia[:, 0] = self.head_inertia[bunches]
        for number in range(most):  # over the 4 to 8 clusters of one bunch
            has = np.flatnonzero(model.bunch_clusters[bunches] > number)
            body = model.bunch_cluster[bunches[has]] + number
            parent = model.body_parent[body]
            above = np.where(parent == bodies[has], 0, parent - model.bunch_cluster[bunches[has]] + 1)
            base = here[has, above]
            motion = speed[has, above]
            frame = frames.compose(base, frames.pose(model.body_offset[body].astype(float), model.body_rest[body]))
            turn = frames.rotate(frame[:, 3:], state.joint_qd[body].astype(float))
            here[has, number + 1, :3] = frame[:, :3]
            here[has, number + 1, 3:] = frames.multiply(frame[:, 3:], state.joint_q[body].astype(float))
            speed[has, number + 1, :3] = motion[:, :3] + np.cross(motion[:, 3:], frame[:, :3] - base[:, :3])
            speed[has, number + 1, 3:] = motion[:, 3:] + turn
            mass[has, number + 1] = solver.body_mass[body]
            com[has, number + 1] = solver.body_com[body]
            inertia[has, number + 1] = solver.body_inertia[body]
        axes = frames.to_matrix(here[..., 3:])
        tensor = np.einsum("...ij,...j,...kj->...ik", axes, inertia, axes)
        arm = np.einsum("...ij,...j->...i", axes, com)
        linear = mass[..., None] * (speed[..., :3] + np.cross(speed[..., 3:], arm))
        arm += here[..., :3]
        angular = np.cross(arm, linear) + np.einsum("...ij,...j->...i", tensor, speed[..., 3:])
        whole = mass.sum(1)
        center = (mass[..., None] * arm).sum(1) / whole[:, None]
        arm -= center[:, None]
        tensor += mass[..., None, None] * (
            (arm * arm).sum(-1)[..., None, None] * np.eye(3) - arm[..., :, None] * arm[..., None, :]
        )
        tensor = tensor.sum(1)
        solver.body_mass[bodies] = whole
        solver.body_com[bodies] = center
        solver.body_inertia[bodies] = np.diagonal(tensor, axis1=1, axis2=2)
        solver.body_product[bodies] = tensor[:, [1, 2, 0], [2, 0, 1]]
        solver.launches.changed = True
        return np.concatenate([linear.sum(1), angular.sum(1)], -1)


# Stumps: the parts of segments of wood before a cut, for which each tree has a few spare bodies.


class Stumps:
    """Makes spare bodies stumps, in the trees of one solver; see :meth:`ArticulationSolver.cut`.

    The cuts of a segment divide it into parts. The last part is the segment's own body, which carries what grows at its
    tip; the other parts are stumps. All have the frame of the segment. Which part is where follows from
    ``State.stump_of`` and ``State.stump_end`` alone.
    """

    def __init__(self, solver: ArticulationSolver) -> None:
        self._solver: ArticulationSolver = weakref.proxy(solver)  # no cycle of references
        self.missing = 0
        """Number of cuts that were made at a joint because no spare body was left, or the wood could not be split."""
        self.table = np.zeros((0, 3))
        """[k, 3] Body of each stump, segment that was cut, and end of the stump [m]. A cut makes a new table."""
        self._compliance = np.ones(len(solver.model.body_mass))
        """[body] Compliance of each joint, relative to that of the model's joint."""
        self._spares = np.flatnonzero(solver.model.is_spare())
        used = self._spares[solver.state.stump_of[self._spares] >= 0]
        for segment in np.unique(solver.state.stump_of[used]).tolist():
            self._restore(segment)

    def segment_of(self, body: int) -> int:
        """Returns the segment of which a body is a part: the body itself, unless it is a stump."""
        of = int(self._solver.state.stump_of[body])
        return body if of < 0 else of

    def parts_of(self, segment: int) -> list[tuple[int, float, float]]:
        """Returns body, start [m] and end [m] of each part of a segment's wood, from its joint to its tip."""
        state = self._solver.state
        spares = self._spares_of(segment)
        stumps = spares[state.stump_of[spares] == segment]
        stumps = stumps[np.argsort(state.stump_end[stumps], kind="stable")]
        bodies = [*stumps.tolist(), segment]
        edges = [0.0, *state.stump_end[stumps].tolist(), float(self._solver.model.body_length[segment])]
        return list(zip(bodies, edges[:-1], edges[1:], strict=True))

    def _spares_of(self, body: int) -> np.ndarray:
        """Returns the spare bodies of the tree of a body."""
        model = self._solver.model
        tree = model.body_tree[body]
        end = int(model.tree_first[tree] + model.tree_core[tree])
        return np.arange(end - int(model.tree_spares[tree]), end)

    def spare_for(self, body: int, at: float) -> int:
        """Returns the spare body that can become the stump of a cut ``at`` [m] along ``body``. Returns -1 and writes a
        line to the log if there is none."""
        solver = self._solver
        model = solver.model
        segment = self.segment_of(body)
        spares = self._spares_of(body)
        free = spares[solver.state.stump_of[spares] < 0]
        tree = f"tree {model.body_tree[body]}"
        if len(spares) == 0:
            why = f"{tree} has no spare body for a stump; vinesim.with_spares adds them"
        elif len(free) == 0:
            why = f"the {len(spares)} spare bodies of {tree} are stumps already"
        elif not (why := self._obstacle(segment, body, at)):
            return int(free[0])
        self.missing += 1
        _log.warning("cut %.1f mm along body %d is at its joint: %s", 1e3 * at, body, why)
        return -1

    def can_leave(self, segment: int, at: float) -> bool:
        """Returns whether a stump can be left by a cut ``at`` [m] along a segment, if there is a spare body."""
        body = next((body for body, start, end in self.parts_of(segment) if start < at < end), -1)
        return body >= 0 and not self._obstacle(segment, body, at)

    def _obstacle(self, segment: int, body: int, at: float) -> str:
        """Returns why the part ``body`` of a segment cannot be split ``at`` [m] along it; empty if it can be."""
        model = self._solver.model
        grown = model.body_parent == segment
        if model.body_organ[segment] != int(Organ.CANE):
            return "it is no cane"
        if (model.body_offset[grown, 0] < at).any():
            return "something grows on it before the cut"
        if not self._solver.ties.can_split(body, at):
            return "its ties are not in order along it"
        try:
            part_of(model, segment, 0.0, at)
        except ValueError as reason:
            return str(reason)
        return ""

    def leave(self, spare: int, segment: int, at: float, *, floats: bool) -> None:
        """Make ``spare`` the stump of a cut ``at`` [m] along ``segment``. Its body, and the part that was there, get
        their shares. The caller cuts off that part, and calls ``_detach_joints``. ``floats``: the stump has no parent.

        Raises :class:`ValueError` if the wood cannot be split there.
        """
        solver = self._solver
        state = solver.state
        old, start, end = next(part for part in self.parts_of(segment) if part[1] < at < part[2])
        before = self.part(segment, start, end)
        parts = self.part(segment, start, at), self.part(segment, at, end)
        share = float(solver.body_mass[old]) / before.mass  # not 1 after set_mass
        share = 1.0 if abs(share - 1.0) < 1e-5 else share
        state.stump_of[spare] = segment
        state.stump_end[spare] = at
        was_cut = bool(state.body_cut[old])
        state.body_q[spare] = state.body_q[old]
        state.body_qd[spare] = state.body_qd[old]
        solver.body_load[spare] = 0.0
        if floats:
            solver._cut_off(spare)
        elif was_cut:  # the piece left before its stump was known
            self._take_joint(spare, segment)
        else:
            state.joint_q[spare] = state.joint_q[old]
            state.joint_qd[spare] = state.joint_qd[old]
            solver.joint_stiffness[spare] = solver.joint_stiffness[old]
            solver.joint_damping[spare] = solver.joint_damping[old]
            solver._rest[spare] = solver._rest[old]
            solver._grown_rest[spare] = solver._grown_rest[old]
            state.joint_set[spare] = state.joint_set[old]
            state.joint_flow[spare] = state.joint_flow[old]
            self._compliance[spare] = self._compliance[old]
        for body, part in zip((spare, old), parts, strict=True):
            self._shape(body, part, share)
        self._attach(spare, segment)
        self._set_spans(segment)
        solver.ties.split(old, spare, at)
        for joint, of in [(spare, segment), *(self._joints_on(segment) if old == segment else [])]:
            if not state.body_cut[joint]:
                self._adjust_joint(joint, of, turns=not (joint == spare and was_cut))
        if was_cut and not floats:
            state.joint_q[spare] = solver.joint_settled[spare]
            state.joint_qd[spare] = 0.0

    def withdraw(self, spare: int) -> None:
        """Make a stump a spare body again. Its wood returns to the part beyond it, which stays cut off. The caller
        calls ``_detach_joints``."""
        solver = self._solver
        model = solver.model
        state = solver.state
        segment = self.segment_of(spare)
        parts = self.parts_of(segment)
        number = next(i for i, part in enumerate(parts) if part[0] == spare)
        beyond, begin, end = parts[number + 1]
        share = float(solver.body_mass[beyond]) / self.part(segment, begin, end).mass
        self._shape(beyond, self.part(segment, parts[number][1], end), share)
        state.stump_of[spare] = -1
        state.stump_end[spare] = 0.0
        state.body_cut[spare] = False
        for row, rest in (
            (state.joint_q, frames.IDENTITY),
            (state.joint_qd, 0.0),
            (state.joint_x, 0.0),
            (state.joint_xd, 0.0),
            (solver._offset, 0.0),
            (solver._rest, frames.IDENTITY),
            (solver._grown_rest, frames.IDENTITY),
            (state.joint_set, frames.IDENTITY),
            (state.joint_flow, 0.0),
            (solver.joint_settled, frames.IDENTITY),
            (solver.joint_stiffness, 0.0),
            (solver.joint_damping, 0.0),
            (solver.body_parent, -1),
            (solver.body_start, 0.0),
            (solver.body_end, 0.0),
            (solver.body_drag, 0.0),
            (solver.body_load, 0.0),
            (solver.body_mass, model.body_mass[spare]),
            (solver.body_com, 0.0),
            (solver.body_inertia, model.body_inertia[spare]),
            (self._compliance, 1.0),
        ):
            row[spare] = rest
        solver.ties.join(spare, beyond)
        self._set_spans(segment)
        for joint, of in self._joints_on(segment) if beyond == segment else []:
            if not state.body_cut[joint]:
                self._adjust_joint(joint, of, turns=True)

    def _restore(self, segment: int) -> None:
        """Set the parts of a segment from the state, which has their poses already."""
        solver = self._solver
        parts = self.parts_of(segment)
        for body, start, end in parts:
            self._shape(body, self.part(segment, start, end), 1.0)
        for body, _, end in parts[:-1]:
            self._attach(body, segment)
            self._take_joint(body, segment)
            solver.ties.split(segment, body, end)
        self._set_spans(segment)
        for joint, of in [(parts[0][0], segment), *self._joints_on(segment)]:
            self._adjust_joint(joint, of, turns=False)

    def part(self, segment: int, start: float, end: float) -> Part:
        """Returns the part of a segment's wood from ``start`` to ``end`` [m], with the leaves that are still on it."""
        solver = self._solver
        model = solver.model
        whole = part_of(model, segment, start, end)
        off = np.flatnonzero((model.leaf_body == segment) & solver.state.leaf_off)
        here = off[grows_between(model, segment, off, start, end)]
        return without_leaves(model, whole, here) if len(here) else whole

    def shed(self, segment: int) -> None:
        """Give the parts of a segment their masses after leaves were taken off (``State.leaf_off``)."""
        solver = self._solver
        for body, start, end in self.parts_of(segment):
            self._shape(body, self.part(segment, start, end), 1.0)
        solver.launches.changed = True

    def _take_joint(self, spare: int, segment: int) -> None:
        """Give a stump the joint of a segment of the model."""
        solver = self._solver
        solver.joint_stiffness[spare] = solver.model.joint_stiffness[segment]
        solver.joint_damping[spare] = solver.model.joint_damping[segment]
        solver._grown_rest[spare] = solver.model.body_rest[segment]
        solver._set_rest(spare)
        self._compliance[spare] = 1.0

    def _shape(self, body: int, part: Part, share: float) -> None:
        """Give a body the mass, inertia and drag of a part of a segment; the mass times ``share``."""
        solver = self._solver
        solver.body_mass[body] = share * part.mass
        solver.body_com[body] = part.com
        solver.body_inertia[body] = share * part.inertia
        solver.body_product[body] = 0.0
        solver.body_drag[body] = part.drag

    def _attach(self, spare: int, segment: int) -> None:
        """Give a stump the place of a segment's joint, and make its tree move it."""
        solver = self._solver
        model = solver.model
        solver.body_parent[spare] = model.body_parent[segment]
        solver._offset[spare] = model.body_offset[segment]
        tree = int(model.body_tree[spare])
        used = spare + 1 - int(model.tree_first[tree])
        solver.core_moving[tree] = max(int(solver.core_moving[tree]), used)
        if not solver.state.tree_fine[tree]:
            solver.tree_moving[tree] = solver.core_moving[tree]
        solver.launches.set_branching(solver.body_parent)

    def _set_spans(self, segment: int) -> None:
        for body, start, end in self.parts_of(segment):
            self._solver.body_start[body] = start
            self._solver.body_end[body] = end
        self._solver.buffers.upload(["body_length"] if "body_length" in self._solver.buffers.host else [])
        state = self._solver.state
        used = self._spares[state.stump_of[self._spares] >= 0]
        self.table = np.column_stack([used, state.stump_of[used], state.stump_end[used].astype(float)])

    def _joints_on(self, segment: int) -> list[tuple[int, int]]:
        """Returns the bodies whose joints are at the tip of a segment, each with the segment of which it is a part."""
        model = self._solver.model
        here = model.bodies_of(int(model.body_tree[segment]))
        grown = here.start + np.flatnonzero(model.body_parent[here] == segment)
        return [(self.parts_of(child)[0][0], child) for child in grown.tolist()]

    def _adjust_joint(self, body: int, segment: int, *, turns: bool) -> None:
        """Give the joint of ``body``, the first part of a segment, the spring of the wood that meets there. ``turns``:
        the state has the joint's rotation from the former rest pose."""
        solver = self._solver
        model = solver.model
        state = solver.state
        own = float(solver.body_end[body]) / float(model.body_length[segment])
        parent = int(model.body_parent[segment])
        above = 1.0 - float(solver.body_start[parent]) / float(model.body_length[parent]) if parent >= 0 else 1.0
        compliance = joint_compliance(model, segment, own, above)
        ratio = self._compliance[body] / compliance
        self._compliance[body] = compliance
        solver.joint_stiffness[body] *= ratio
        solver.joint_damping[body] *= ratio
        solver._grown_rest[body], solver.joint_settled[body] = relaxed_joint(model, segment, compliance)
        before = solver._rest[body].astype(float)
        solver._set_rest(body)
        if turns:
            turn = frames.multiply(frames.conjugate(solver._rest[body].astype(float)), before)
            state.joint_q[body] = frames.normalize(frames.multiply(turn, state.joint_q[body].astype(float)))
            state.joint_qd[body] = frames.rotate(turn, state.joint_qd[body].astype(float))


# Poses of trees that another client simulates.


def blend_towards(
    plants: ArticulationSolver, tree: int, joint_q: np.ndarray, joint_qd: np.ndarray, blend: float
) -> None:
    """Change the joint state of one tree towards the state that another client has sent; see
    :meth:`vinesim.plants.articulation_solver.ArticulationSolver.blend_towards`.
    """
    state = plants.state
    bodies = plants.model.bodies_of(tree)
    there = np.asarray(joint_q, np.float32)
    rates = np.asarray(joint_qd, np.float32)
    here = state.joint_q[bodies]
    if there.shape != here.shape or rates.shape != (len(here), 3):
        raise ValueError(f"tree {tree}: pulled by joints {there.shape}, {rates.shape}; it has {len(here)} bodies")
    there = frames.normalize(there)
    if not np.isfinite(there).all() or not np.isfinite(rates).all() or not (there != 0.0).any(-1).all():
        raise ValueError(f"tree {tree}: pulled to a pose that is not finite or has zero quaternions; drop the update")
    turn = frames.log(frames.multiply(frames.conjugate(here), there))
    state.joint_q[bodies] = frames.normalize(frames.multiply(here, frames.exp(blend * turn)))
    state.joint_qd[bodies] = rates
    state.joint_qd[bodies.start + plants.tree_moving[tree] : bodies.stop] = 0.0  # joints of locked clusters do not turn
    core = bodies.start + int(plants.model.tree_core[tree])
    unused = slice(bodies.start + int(plants.core_moving[tree]), core)  # the owner's stumps that are not yet known here
    state.joint_q[unused] = frames.IDENTITY
    state.joint_qd[unused] = 0.0


# Kernels of the articulation solver, each bound once to its arrays, and the transfers of rows around them.


STEP_INPUTS = ("body_load", "body_wrench", "joint_x", "joint_xd", "joint_q", "joint_qd")
"""Per-body arrays that are copied to the device before every prediction."""
DEVICE_RESULTS = (
    "body_q",
    "body_qd",
    "joint_xd_free",
    "joint_qd_free",
    "body_acceleration",
    "body_qd_free",
    "body_impulse",
)
"""Per-body arrays that kernels write, or that are copied to the device only when needed."""
TREE_INPUTS = (
    "stepping",
    "divided",
    "floating",
    "divided_floating",
    "counts",
    "levels",
    "tree_moving",
    "tree_phi",
    "tree_euler_steps",
    "tree_steps",
    "tree_rate",
    "tree_awake",
    "tree_moved",
    "tree_fast_steps",
    "tree_budget",
    "tree_air",
    "root_turn",
    "root_turn_rate",
    "tie_stiffness",
    "tie_damping",
    "tie_anchor",
    "tie_anchor_velocity",
)
"""Arrays that the kernels of a step read and that do not have a row for each body: lists, arrays of trees and of
ties."""
TREE_RESULTS = ("tree_euler_steps", "tree_fast_steps", "phi_used", "tree_rate")
"""Arrays with one element for each tree that the kernels of a step write."""
SCRATCH = {
    wp.vec3: ("lever", "tension", "Du", "start_joint_qd", "coarse_joint_qd", "part_joint_damping"),
    wp.quat: ("axes", "start_joint_q", "coarse_joint_q"),
    wp.mat33: ("J", "H", "M", "D", "DJ", "DH", "root_inverse_mass"),
    wp.transform: ("after_q",),
    wp.spatial_vector: (
        "bias",
        "subtree_wrench",
        "added_acceleration",
        "before",
        "after_qd",
        "impact_acceleration",
        "impact_velocity",
    ),
}
"""Per-body arrays that only kernels read and write: element type -> names."""


def kernel_parameters(
    p: PhysicsParameters, dt: float, fast_rate: float, max_rate: float, fault_rate: float, geometric_stiffness: bool
) -> dict[str, Any]:
    """Returns the values of the fields of :class:`vinesim.kernels.plants.structs.SolverParameters`, by name."""
    return {
        "dt": dt,
        "fast_rate": fast_rate,
        "max_rate": max_rate,
        "fault_rate": fault_rate,
        "contact_steps": max(1, round(p.contact_onset_duration / dt)) + 1,
        "geometric_stiffness": float(geometric_stiffness),
        "euler_levers": 0.0,
        "gravity": wp.vec3(0.0, 0.0, -p.gravity),
    }


BUDGET_PERIOD = 8
"""Period [steps] of the energy check while no tree is watched closely."""

BLOW_DURATION = 1.25e-3
"""[s] Time over which the force of a blow is averaged. TUNED: the peak is then the mean of the peaks at dt = 1 ms over
the moments within a step at which the blow may begin; these peaks differ by up to 20 % from their mean."""

MIN_CAPACITY = 16
"""Smallest capacity of a list of bodies."""


@dataclasses.dataclass(frozen=True)
class JointWrenches:
    """Wrenches that the parents of some bodies exerted on the bodies through their joints in the last step."""

    places: np.ndarray
    """[joint] int32: index in the kernels' arrays of the body beyond each joint. The caller writes it."""
    count: np.ndarray
    """[1] int32: number of joints. The caller writes it."""
    carried: np.ndarray
    """[joint, 6] Force [N] of the parent on the body, and moment [N m] about the body's origin, world axes."""
    launch: KernelLaunch
    """Kernel launch that computes :attr:`carried`."""


@dataclasses.dataclass(frozen=True)
class Step:
    """The kernels of a step, all on the same arrays."""

    predict: KernelGraph
    """Predicts the trees, group by group; on a GPU each tree is a group."""
    integrate: dict[tuple[bool, bool], KernelGraph]
    """Integrates the trees that take whole steps. Key: whether energy budgets are kept, whether there are floating
    roots."""
    take_substep: dict[tuple[bool, bool], KernelGraph]
    """Predicts and integrates the trees that take the next substep. Keys as for ``integrate``."""


class KernelLaunches:
    """Launches of the articulation kernels on the arrays of one solver.

    A GPU has a copy of every array with a row for each body (see :mod:`vinesim.plants.device_buffers`).
    :data:`STEP_INPUTS` are copied to the GPU before each prediction, :data:`DEVICE_RESULTS` to the host where it needs
    them. The model's rows are copied by :meth:`upload_changed` when :attr:`changed` is set. A GPU reads all other
    arrays in the host's memory. In a sequence of many steps (:meth:`ArticulationSolver.advance`) these reads would take
    longer than the steps. So for such a sequence the GPU also has copies of :data:`TREE_INPUTS`, and separate launches
    that use them (:attr:`resident`). The sequence begins with :meth:`upload_trees` if the host may have changed an
    array, and ends with :meth:`download_trees`.
    """

    def __init__(self, solver: ArticulationSolver, parameters: dict[str, float], max_substeps: int) -> None:
        """``parameters``: numbers of :class:`vinesim.kernels.plants.structs.SolverParameters`, without gravity."""
        self.buffers = solver.buffers
        self._max_substeps = max_substeps
        self._body_tree = solver.model.body_tree
        self.changed = False
        """Whether model rows (parents, masses, springs) differ from the device's copies."""
        self.substeps_due = False
        """Whether model rows have changed since the substeps of trees were counted."""
        self._budgeted = np.zeros(0, np.int32)
        self._keeps_budgets = False
        self._watches_closely = False
        self._budget_phase = -1
        self._seldom: list[str] = []
        self._register_arrays(solver)
        self._arrays = self.buffers.arrays
        self._record_transfers()
        self._numbers = parameters
        self._blow_bodies = np.zeros(0, np.int32)
        self.parameters = self.fill(structs.SolverParameters, **parameters)
        self._record_step(self.parameters)
        self.shared = self._record_step_kernels(self.parameters)
        """The kernels of a step, bound to the arrays that NumPy also uses."""
        self.of_kernels: tuple[str, ...] = ()
        """Arrays of trees that only kernels change from now on, see :meth:`ArticulationSolver.let_kernels_cut`."""
        self.resident = self.shared
        """The kernels for a sequence of steps without transfers to the host. On a GPU they are bound to separate
        arrays."""
        self.resident_arrays = self.buffers.arrays
        """The arrays that the kernels of :attr:`resident` read and write."""
        if self.buffers.has_copies:
            self._record_resident(self.parameters)
        self._record_impact(
            self.fill(structs.SolverParameters, **(parameters | {"fast_rate": math.inf, "geometric_stiffness": 0.0}))
        )
        self.response_capacity = 0
        self._make_room_for_joints(1)  # otherwise the first picked bunch would wait for the allocation

    # ------------------------------------------------------------------ arrays

    def _register_arrays(self, solver: ArticulationSolver) -> None:
        buffers = self.buffers
        model = solver.model
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
        for name, field in struct_fields(structs.EnergyBudget).items():
            count = buffers.slot_count if name == "start_q" else trees
            setattr(self.budget, name, wp.zeros(count, dtype=field.dtype, device=buffers.device))
        self.budget.limit.fill_(NO_LIMIT)
        rows = (self.budget.limit, self.budget.watch)
        self._budget_rows = [array.numpy() for array in rows] if buffers.device.is_cpu else []
        buffers.arrays["impact_phi"] = wp.empty(trees, dtype=float, device=buffers.device)
        buffers.arrays["blow_steps"] = wp.ones(trees, dtype=wp.int32, device=buffers.device)

    def _branching(self, parent: np.ndarray) -> np.ndarray:
        """Returns for each place [place] in the kernels' arrays whether the body there has a child other than the next
        body."""
        places = np.zeros(self.buffers.slot_count, np.bool_)
        apart = (parent >= 0) & (parent != np.arange(len(parent)) - 1)
        places[self.buffers.slots[parent[apart]]] = True
        return places

    def set_branching(self, parent: np.ndarray) -> None:
        """Change the parents [body] of bodies in the kernels that must know where a tree branches: those of a GPU."""
        if self.buffers.has_copies:
            self._arrays["body_branches"].assign(self._branching(parent))

    def upload_changed(self) -> None:
        """Copy the model's rows (parents, masses, springs) to the device, if :attr:`changed`."""
        if self.changed:
            self.buffers.upload(self._seldom)
            self.budget.limit.fill_(NO_LIMIT)
            self._budget_phase = -1
            self.changed = False
            self.substeps_due = True

    def fill(self, struct: Any, **values: Any) -> Any:
        """Returns a filled kernel argument of the Warp struct type ``struct``. A field named in ``values`` gets that
        value, or the array that the value names if it is a string. Any other field gets the array with the field's
        name."""
        return self._filled(struct, self._arrays, values)

    def fill_resident(self, struct: Any, **values: Any) -> Any:
        """Returns a filled kernel argument like :meth:`fill`, with the arrays of the :attr:`resident` kernels."""
        return self._filled(struct, self.resident_arrays, values)

    def _filled(self, struct: Any, arrays: dict[str, wp.array], values: dict[str, Any]) -> Any:
        filled = struct()
        values = {"pitch": self.buffers.pitch} | values
        for field in struct_fields(struct):
            value = values.get(field, field)
            setattr(filled, field, arrays[value] if isinstance(value, str) else value)
        return filled

    def launch(self, kernel: Any, *arguments: object, **options: Any) -> KernelLaunch:
        """Returns the launch of a kernel with its arguments. A string among the arguments is replaced by the array of
        that name."""
        return KernelLaunch(kernel, self._named(arguments), **options)

    def graph(self, *launches: KernelLaunch) -> KernelGraph:
        """Returns a graph of launches that follow each other on the device."""
        return KernelGraph(*launches, device=str(self.buffers.device))

    def _named(self, arguments: Sequence[object]) -> list[Any]:
        return [self._arrays[value] if isinstance(value, str) else value for value in arguments]

    def count(self, place: int) -> wp.array:
        """Returns one entry of the array of counts as a Warp array [1]. ``place``: index of the entry."""
        return self._arrays["counts"][place : place + 1]

    @property
    def subset(self) -> tuple[wp.array, wp.array]:
        """Number [1] and list [tree] of the trees that :meth:`ArticulationSolver.list_subset` set."""
        return self.count(_SUBSET), self._arrays["subset"]

    # ------------------------------------------------------------------ transfers of the listed trees' rows

    def _record_transfers(self) -> None:
        def copier(trees: str, *names: str, to_host: bool = False) -> Callable[[int], None]:
            count = self.count(_STEPPING if trees == "stepping" else _SUBSET)
            return self.buffers.row_copier(names, trees, count, to_host=to_host)

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
        fill = self.fill
        s = structs
        self._model = fill(s.ArticulationModel)
        self._forces = fill(s.AppliedForces)
        joints = fill(s.JointState)
        self._bodies = fill(s.BodyState)
        self._factors = fill(s.Factors)
        scratch = fill(s.Scratch)
        self.predict_subset = self.graph(self._predict(parameters, _SUBSET, "subset"))
        self.forward_kinematics = self.graph(
            self.launch(forward_kinematics, self._model, *self.subset, joints, self._bodies)
        )
        self.wrenches = self.launch(
            apply_wrenches,
            parameters.dt,
            self._model,
            *self.subset,
            "body_wrench",
            self._factors,
            fill(s.WrenchScratch),
            scratch,
            fill(s.Prediction),
        )
        self.apply_wrenches = self.graph(self.wrenches)
        stepping = (self.count(_STEPPING), "stepping")
        self.count_substeps = self.graph(
            self.launch(
                first_mode.count_substeps,
                parameters.dt,
                first_mode.MAX_ANGLE,
                self._max_substeps,
                self._model,
                *stepping,
                scratch,
                fill(s.WrenchScratch),
                "tree_substeps",
            ),
            self.launch(choose_budget, parameters, self._model, *stepping, scratch, "tree_budget"),
        )
        """Counts the substeps of the listed trees, and chooses how closely the energy of each is watched."""

    def _record_step_kernels(self, parameters: Any) -> Step:
        """Returns the kernels of a step, bound to the arrays in ``self._arrays``."""
        in_groups = not self.buffers.has_copies
        predict = self._predict_groups(parameters) if in_groups else self._predict(parameters, _GROUPS, "stepping")
        begin = self.launch(
            begin_substep,
            self.count(_LEVELS),
            "levels",
            *(self.count(place) for place in (_NEXT_LEVEL, _DIVIDED, _DIVIDED_FLOATING)),
            threads=1,
        )
        predict_divided = self._predict(parameters, _DIVIDED, "divided")
        fast = [self._move_fast_trees(parameters)] if self._max_substeps > 1 else []
        whole = self._integrate(parameters, _WHOLE, "stepping", _FLOATING, "floating", fast)
        divided = self._integrate(parameters, _DIVIDED, "divided", _DIVIDED_FLOATING, "divided_floating", [])
        return Step(
            self.graph(predict),
            {which: self.graph(*launches) for which, launches in whole.items()},
            {which: self.graph(begin, predict_divided, *launches) for which, launches in divided.items()},
        )

    def _predict(self, parameters: Any, count: int, trees: str) -> KernelLaunch:
        fill = self.fill
        s = structs
        kernel = (predict_lean, ("body_branches",)) if self.buffers.has_copies else (predict, ())
        return self.launch(
            kernel[0],
            parameters,
            fill(s.ArticulationModel),
            *kernel[1],
            self.count(count),
            trees,
            "tree_phi",
            "tree_euler_steps",
            "tree_steps",
            fill(s.AppliedForces),
            fill(s.JointState),
            "phi_used",
            fill(s.BodyState),
            fill(s.Factors),
            fill(s.Scratch),
            fill(s.Prediction),
        )

    def _predict_groups(self, parameters: Any) -> KernelLaunch:
        """Returns the launch that predicts trees in groups of up to eight."""
        size = LANES * RECORD * (self.buffers.max_tree_size + 2)
        return self.launch(
            predict_groups,
            parameters,
            self._model,
            self.count(_GROUPS),
            "groups",
            "stepping",
            "tree_phi",
            "tree_euler_steps",
            "tree_steps",
            self._forces,
            self.fill(structs.JointState),
            wp.zeros(size, dtype=float, device=self.buffers.device),
            "phi_used",
            self._bodies,
            self._factors,
            self.fill(structs.Scratch),
            self.fill(structs.Prediction),
        )

    def _move_fast_trees(self, parameters: Any) -> KernelLaunch:
        """Returns the launch that moves fast trees, before the integration of whole steps."""
        fill = self.fill
        s = structs
        device = self.buffers.device
        scratch = {
            name: wp.empty_like(self._arrays[name], device=device)
            for name in ("tie_damping", "tie_anchor", "root_turn")
        }
        own = {"joint_damping": "part_joint_damping"}
        model, forces = fill(s.ArticulationModel, **own), fill(s.AppliedForces)
        for name, array in scratch.items():
            setattr(model if name == "tie_damping" else forces, name, array)
        return self.launch(
            move_fast_trees,
            parameters,
            fill(s.ArticulationModel),
            self.count(_WHOLE),
            "stepping",
            "tree_awake",
            "tree_phi",
            "tree_rate",
            "tree_euler_steps",
            fill(s.AppliedForces),
            fill(s.FastScratch),
            model,
            forces,
            "tree_fast_steps",
            "tree_moved",
            "phi_used",
            fill(s.JointState),
            fill(s.BodyState),
            fill(s.Factors),
            fill(s.Scratch),
            fill(s.Prediction),
        )

    def _integrate(
        self, parameters: Any, count: int, trees: str, root_count: int, roots: str, first: list[KernelLaunch]
    ) -> dict[tuple[bool, bool], list[KernelLaunch]]:
        """Returns the launches of an integration for each combination of two conditions, which are the key: whether
        energy budgets are kept, and whether there are floating roots. ``first``: launches that come before the joints
        are moved.
        """
        fill = self.fill
        s = structs
        model, forces, joints, prediction = (
            fill(struct) for struct in (s.ArticulationModel, s.AppliedForces, s.JointState, s.Prediction)
        )
        apart = fill(s.BodyState, body_q="after_q", body_qd="after_qd")
        begin = self.launch(
            begin_budget,
            parameters,
            model,
            self.count(count),
            trees,
            "tree_budget",
            "tree_phi",
            forces,
            joints,
            self.budget,
            apart,
        )
        move = self.launch(
            integrate,
            parameters,
            model,
            self.count(count),
            trees,
            "tree_awake",
            "phi_used",
            "tree_steps",
            "tree_moved",
            joints,
            prediction,
            "tree_rate",
            "tree_euler_steps",
            joints,
        )
        keep = self.launch(
            keep_budget,
            parameters,
            model,
            self.count(count),
            trees,
            "tree_budget",
            "tree_phi",
            "tree_steps",
            "tree_rate",
            forces,
            self.budget,
            "tree_euler_steps",
            joints,
            apart,
            fill(s.Factors),
            fill(s.Scratch),
            fill(s.Prediction, body_acceleration="impact_acceleration", body_qd_free="impact_velocity"),
        )
        correct = self._correct_momentum(parameters, root_count, roots)
        stepping = (self.count(_STEPPING), "stepping")
        last = [] if self.buffers.has_copies else [self.launch(find_fastest, *stepping, "tree_rate", "fastest")]
        return {
            (False, False): [*first, move, *last],
            (False, True): [*first, move, correct, *last],
            (True, False): [begin, *first, move, keep, *last],
            (True, True): [begin, *first, move, keep, correct, *last],
        }

    def _correct_momentum(self, parameters: Any, count: int, roots: str) -> KernelLaunch:
        fill = self.fill
        s = structs
        return self.launch(
            correct_floating_momentum,
            parameters,
            fill(s.ArticulationModel),
            self.count(count),
            roots,
            "phi_used",
            "tree_rate",
            "tree_steps",
            fill(s.AppliedForces),
            fill(s.BodyState),
            "body_acceleration",
            "lever",
            fill(s.FloatingScratch),
            fill(s.JointState),
        )

    def _record_resident(self, parameters: Any) -> None:
        """Record the kernels of a step a second time, on copies of the arrays of trees and ties."""
        device = self.buffers.device
        shared = self.buffers.arrays
        names = dict.fromkeys(TREE_INPUTS + TREE_RESULTS)
        copies = {name: wp.zeros_like(shared[name], device=device) for name in names}  # until the first upload
        self.resident_arrays = self._arrays = shared | copies
        self.resident = self._record_step_kernels(parameters)
        self._arrays = shared

    def upload_trees(self) -> None:
        """Copy the arrays that NumPy uses, and that kernels do not change, to the arrays of the :attr:`resident`
        kernels."""
        for name in [name for name in TREE_INPUTS if name not in self.of_kernels] if self.buffers.has_copies else ():
            wp.copy(self.resident_arrays[name], self.buffers.host_array(name))

    def download_trees(self) -> None:
        """Copy the results of the :attr:`resident` kernels to the arrays that NumPy uses."""
        for name in TREE_RESULTS + self.of_kernels if self.buffers.has_copies else ():
            wp.copy(self.buffers.host_array(name), self.resident_arrays[name])

    def list_budgets(self, trees: np.ndarray) -> None:
        """Keep energy budgets (:mod:`vinesim.kernels.plants.energy_budget`) of only these trees [k]."""
        self._budgeted = trees
        self._budget_phase = -1
        kind, phi = (self.buffers.host[name][trees] for name in ("tree_budget", "tree_phi"))
        self._watches_closely = bool(((kind == CLOSELY) | (phi < MIN_PHI)).any())

    def keeps_budgets(self, *, every: bool = False) -> bool:
        """Returns whether the next steps keep energy budgets. Call it once before their integrations.

        On a GPU, and if ``every`` step shall, all steps keep budgets, so that no tree depends on others. Otherwise one
        step in :data:`BUDGET_PERIOD` keeps budgets. If a tree is watched closely after that step, all steps up to the
        next such step keep budgets, too.
        """
        self._budget_phase = 0 if every else (self._budget_phase + 1) % BUDGET_PERIOD
        if self._budget_phase == 0 or self.buffers.device.is_cuda:
            self._keeps_budgets = len(self._budgeted) > 0
        elif self._budget_phase == 1 and self._keeps_budgets:
            limit, watch = (row[self._budgeted].max() for row in self._budget_rows)
            self._keeps_budgets = self._watches_closely or bool(watch > 0 or limit >= NO_LIMIT)
        return self._keeps_budgets

    def _record_impact(self, parameters: Any) -> None:
        """Record the kernels of an instantaneous plastic impact. They use the factors of inertia and springs alone, and
        take impulses as wrenches."""
        fill = self.fill
        s = structs
        joints = fill(s.JointState)
        scratch = fill(s.Scratch)
        prediction = fill(s.Prediction, body_acceleration="impact_acceleration", body_qd_free="impact_velocity")
        self.factor_impact = self.graph(
            self.launch(
                predict,
                parameters,
                self._model,
                *self.subset,
                "tree_phi",
                "tree_euler_steps",
                "tree_steps",
                self._forces,
                joints,
                "impact_phi",
                self._bodies,
                self._factors,
                scratch,
                prediction,
            )
        )
        self.apply_impulses = self.graph(
            self.launch(
                apply_wrenches,
                1.0,
                self._model,
                *self.subset,
                "body_impulse",
                self._factors,
                fill(s.WrenchScratch),
                scratch,
                prediction,
            )
        )

    def _record_blows(self, capacity: int) -> None:
        """Record the kernels of :meth:`blow_response` for up to ``capacity`` blows."""
        buffers = self.buffers
        fill = self.fill
        s = structs
        self._blow_count = buffers.pinned(np.zeros(1, np.int32))
        self._blow_bodies = buffers.pinned(np.zeros(capacity, np.int32))
        self._blow_points, self._blow_axes = (buffers.pinned(np.zeros((capacity, 3), np.float32)) for _ in range(2))
        self._blow_response = buffers.pinned(np.zeros((capacity, capacity), np.float32))
        bodies = fill(s.BodyState, body_q="after_q", body_qd="after_qd")
        scratch = fill(s.Scratch)
        parameters = self.fill(s.SolverParameters, **(self._numbers | {"dt": BLOW_DURATION}))
        self._respond_to_blows = self.graph(
            self.launch(
                predict,
                parameters,
                self._model,
                *self.subset,
                "tree_phi",
                "tree_euler_steps",
                "blow_steps",
                self._forces,
                fill(s.JointState),
                "impact_phi",
                bodies,
                self._factors,
                scratch,
                fill(
                    s.Prediction,
                    body_acceleration="impact_acceleration",
                    body_qd_free="impact_velocity",
                    joint_qd_free="start_joint_qd",
                    joint_xd_free="coarse_joint_qd",
                ),
            ),
            self.launch(
                respond_to_blows,
                self._model,
                buffers.reach(self._blow_count, wp.int32, "blow_count"),
                buffers.reach(self._blow_bodies, wp.int32, "blow_bodies"),
                buffers.reach(self._blow_points, wp.vec3, "blow_points"),
                buffers.reach(self._blow_axes, wp.vec3, "blow_axes"),
                bodies,
                self._factors,
                fill(s.WrenchScratch),
                scratch,
                buffers.reach(self._blow_response, float, "blow_response"),
                threads=1,
            ),
        )

    def blow_response(self, bodies: np.ndarray, points: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """Returns what :meth:`ArticulationSolver.blow_response` returns. The trees of the ``bodies`` [n] must be listed
        in the subset."""
        n = len(bodies)
        if n > len(self._blow_bodies):
            self._record_blows(max(2 * len(self._blow_bodies), n, MIN_CAPACITY))
        self._blow_count[0] = n
        self._blow_bodies[:n] = self.buffers.slots[bodies]
        self._blow_points[:n] = points
        self._blow_axes[:n] = axes
        self._respond_to_blows(max(n, int(self.buffers.host["counts"][_SUBSET])))
        self.buffers.synchronize()
        return self._blow_response[:n, :n].astype(float)

    def impulse_response(self, bodies: np.ndarray) -> np.ndarray:
        """Returns the velocity changes [n, 6, m, 6] of ``bodies`` [n] by unit impulse wrenches on the bodies of the
        same tree in this list, which must be adjacent and at most m. The result is a view that the next call
        overwrites."""
        n = len(bodies)
        buffers = self.buffers
        if n > self.response_capacity or self.response_capacity == 0:
            self._record_response(max(2 * self.response_capacity, n, MIN_CAPACITY))
        self._response_bodies[:n] = buffers.slots[bodies]
        self._response_count[0] = n
        self._respond(n)
        buffers.synchronize()
        return self._response[:n]

    def dense_impulse_response(self, bodies: np.ndarray) -> np.ndarray:
        """Returns the velocity changes [n, 6, n, 6] of ``bodies``, in any order, by unit impulse wrenches on them.
        Entries between different trees are zero."""
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
        self.response_capacity = capacity
        buffers = self.buffers
        self._response_count = buffers.pinned(np.zeros(1, np.int32))
        self._response_bodies = buffers.pinned(np.zeros(capacity, np.int32))
        self._response = buffers.pinned(np.zeros((capacity, 6, buffers.max_tree_size, 6), np.float32))
        buffers.add_shared("response_bodies", self._response_bodies, wp.int32)
        buffers.add_shared("response", self._response, float)
        stride = buffers.max_tree_extent
        matrix: Any = wp.mat33
        columns = {
            name: wp.empty(capacity * stride, dtype=matrix, device=buffers.device)
            for name in struct_fields(structs.ResponseColumns)
        }
        self._respond = self.graph(
            self.launch(
                impulse_response,
                self._model,
                stride,
                buffers.reach(self._response_count, wp.int32, "response_count"),
                "response_bodies",
                self._factors,
                self.fill(structs.ResponseColumns, **columns),
                "response",
            )
        )

    def joint_wrench(self, bodies: np.ndarray) -> np.ndarray:
        """Returns the wrench [n, 6] that the parent of each of the ``bodies`` [n] exerted on the body through its joint
        in the last step: force [N], and moment [N m] about the body's origin, world axes.
        """
        if len(bodies) > len(self._joint_wrenches.places):
            self._make_room_for_joints(2 * len(bodies))
        wrenches = self._joint_wrenches
        wrenches.places[: len(bodies)] = self.buffers.slots[bodies]
        wrenches.count[0] = len(bodies)
        self._carry(len(bodies))
        self.buffers.synchronize()
        return wrenches.carried[: len(bodies)].copy()

    def _make_room_for_joints(self, capacity: int) -> None:
        self._joint_wrenches = self.joint_wrenches(capacity)
        self._carry = self.graph(self._joint_wrenches.launch)

    def joint_wrenches(self, capacity: int) -> JointWrenches:
        """Returns the arrays and the launch that compute the joint wrenches of up to ``capacity`` bodies in the last
        step.
        """
        buffers = self.buffers
        places = buffers.pinned(np.zeros(capacity, np.int32))
        count = buffers.pinned(np.zeros(1, np.int32))
        carried = buffers.pinned(np.zeros((capacity, 6), np.float32))
        launch = self.launch(
            joint_wrench,
            self.parameters,
            self._model,
            buffers.reach(count, wp.int32, "joint_count"),
            buffers.reach(places, wp.int32, "joint_bodies"),
            "phi_used",
            "tree_steps",
            self._forces,
            self._bodies,
            "body_acceleration",
            buffers.reach(carried, wp.spatial_vector, "joint_wrench"),
        )
        return JointWrenches(places, count, carried, launch)

    def wood_stress(
        self,
        wood: WoodStrength,
        capacity: wp.array,
        is_held: wp.array,
        patience: int,
        watch: wp.array,
        stress: wp.array,
        largest: wp.array,
    ) -> KernelGraph:
        """Returns the launch that finds the stress in the wood of the trees of the last step. Arguments: see
        :func:`vinesim.kernels.plants.wood_stress.find_stress`."""
        return self.graph(
            self.launch(
                find_stress,
                self.parameters,
                self._model,
                wood,
                capacity,
                self.count(_STEPPING),
                "stepping",
                "phi_used",
                "tree_steps",
                self._forces,
                self._bodies,
                "body_acceleration",
                self.fill(structs.JointState),
                "tree_rate",
                is_held,
                patience,
                watch,
                "subtree_wrench",
                stress,
                largest,
            )
        )


# Launches over the awake trees: in groups of one topology on a CPU, captured into a graph on a GPU.
# A tree whose first mode is too fast for the step takes substeps instead; all other parts use only their sum.
# :mod:`vinesim.kernels.plants.first_mode` computes the number of substeps. While contacts act on such a tree, it takes
# the whole step for which they were solved. A tree that is tied to wires always takes whole steps: wires move once a
# step.


Levels = tuple[int, ...]
"""Entry i is the number of trees (or floating roots) in a list that take at least i + 1 substeps."""


class StepRunner:
    """Runs predictions and integrations of the listed trees.

    The list that the kernels read begins with the trees that take one whole step. The trees with substeps follow,
    sorted by falling number of substeps. On a CPU, trees of one topology with equal numbers of substeps are adjacent
    and are predicted in groups of up to eight. On a GPU each tree is a group.

    Args:
        buffers: the solver's memory.
        launches: the solver's kernels.
        tree_substeps: [tree] number of substeps into which each tree's step is to be divided.
        tree_steps: [tree] number of substeps of the present step, which is 1 for trees in contact; the kernels read it.
        tree_budget: [tree] how closely each tree's energy is watched.
        whole: [tree] bool, trees on wires, whose steps are never divided.
        tree_rate: [tree] each tree's fastest rate, which the kernels write.
        lists: int32 lists that the kernels read. ``stepping`` [tree] has all trees, ``divided`` [tree] has once more
            those with more than one substep, and ``groups`` [tree, 2] has first place in the list and number of trees
            of each group. ``floating`` and ``divided_floating`` [body] have the floating roots of trees with one step,
            and with more. ``levels`` [substep, 2] has the number of trees and of roots that take each substep.
        counts: [:data:`_COUNTS`] int32, the number of entries of each list that the kernels take.
        topologies: topologies of the trees.
    """

    def __init__(
        self,
        buffers: DeviceBuffers,
        launches: KernelLaunches,
        *,
        tree_substeps: np.ndarray,
        tree_steps: np.ndarray,
        tree_budget: np.ndarray,
        whole: np.ndarray,
        tree_rate: np.ndarray,
        lists: dict[str, np.ndarray],
        counts: np.ndarray,
        topologies: Topologies,
    ) -> None:
        self._buffers = buffers
        self._launches = launches
        self._lists = lists
        self._counts = counts
        self._substeps = tree_substeps
        self._steps_of = tree_steps
        self._rate = tree_rate
        self._is_whole = whole
        self._budget_kind = tree_budget
        self.stepped = np.zeros(0, np.int32)
        """The trees of this step [k], sorted."""
        self.is_stepped = np.zeros(len(tree_rate), np.bool_)
        """[tree] Whether a tree is one of :attr:`stepped`."""
        self.fast = np.zeros(0, np.int32)
        """The trees of :attr:`stepped` whose step is to be divided into substeps [k], sorted."""
        self._whole = 0
        self._kind = (False, False)
        """Key of the launches of this step in :attr:`Step.integrate`: whether energy budgets are kept, and whether
        there are floating roots.
        """
        self._room = 0
        """Length of the longest list of an integration."""
        self._levels: Levels = ()
        self._roots = 0
        self._places = 0
        """Number of places for floating roots that kernels write."""
        self._root_levels: Levels = ()
        self._divided = np.zeros(0, np.int32)
        """[k] Number of substeps of each tree of :attr:`fast` when the list was last sorted."""
        self._graph: wp.Graph | None = None
        self._graph_of: tuple = ()
        self.uploaded: bytes | None = None
        """The counts with which :meth:`advance` last uploaded arrays of trees. None: the host may have changed an array
        since."""
        self._topologies = topologies
        self._starts = np.zeros(1, np.int32)
        """Index in the list at which each group begins; the last entry is the length of the list."""
        self._whole_groups = 0
        """Number of groups of trees that take whole steps. These groups come first in the list."""

    # ------------------------------------------------------------------ which trees, in which order

    def list_trees(self, trees: np.ndarray) -> None:
        """Set the trees [k] that the following steps integrate. Counts their substeps if the trees or the model have
        changed."""
        self._launches.upload_changed()
        if self.stepped is trees and not self._launches.substeps_due:
            return
        self._launches.substeps_due = False
        self.is_stepped[self.stepped] = False
        self.is_stepped[trees] = True
        self.stepped = trees
        self._lists["stepping"][: len(trees)] = trees
        self._counts[_STEPPING] = len(trees)
        self._launches.count_substeps(len(trees))
        self._buffers.synchronize()
        self._budget_kind[trees[self._is_whole[trees]]] = NO_BUDGET  # a moving wire does work on these trees
        self._launches.list_budgets(trees[self._budget_kind[trees] != NO_BUDGET])
        self.fast = trees[(self._substeps[trees] > 1) & ~self._is_whole[trees]]
        self._steps_of[trees] = 1
        self._divided = np.ones(len(self.fast), np.int32)
        self._order()

    def _order(self) -> None:
        """Sort the list of trees by the number of substeps of each tree in ``_steps_of``."""
        self.uploaded = None
        trees = self.stepped
        on_cpu = self._buffers.device.is_cpu
        topologies = self._topologies.of(trees)
        if on_cpu:
            order = np.argsort(topologies, kind="stable")
            trees = trees[order]
            topologies = topologies[order]
        listed, self._whole, self._levels = _by_substeps(np.arange(len(trees)), self._steps_of[trees])
        trees = trees[listed]
        topologies = topologies[listed]
        self._lists["stepping"][: len(trees)] = trees
        self._lists["divided"][: len(trees) - self._whole] = trees[self._whole :]
        in_groups = not self._buffers.has_copies
        self._starts = group_starts(topologies, self._whole) if in_groups else np.arange(len(trees) + 1)
        groups = self._lists["groups"][: len(self._starts) - 1]
        groups[:, 0] = self._starts[:-1]
        groups[:, 1] = np.diff(self._starts)
        self._whole_groups = int(np.searchsorted(self._starts, self._whole))

    def let_kernels_cut(self, places: int) -> None:
        """Let kernels write the first ``places`` entries of the list of floating roots, and change the topology of each
        tree."""
        self._places = places
        launches = self._launches
        self._lists["floating"][:places] = -1
        launches.upload_trees()
        launches.of_kernels = ("floating", "tree_moving", "tree_budget")
        self._topologies.alone = True
        self._order()

    def _divide(self, touched: np.ndarray) -> None:
        """Divide the next step of all fast trees into substeps, except for trees that are ``touched`` [k]."""
        if len(self.fast) == 0:
            return
        steps = self._substeps[self.fast]
        if len(touched):
            steps[np.isin(self.fast, touched)] = 1
        self._steps_of[self.fast] = steps
        self._rate[self.fast] = 0.0
        if not np.array_equal(steps, self._divided):
            self._divided = steps
            self._order()

    def _list_roots(self, roots: np.ndarray, trees: np.ndarray) -> None:
        """Write the list of floating roots, sorted by the substeps of their trees. ``roots`` [k]: places of the roots
        in the kernels' arrays; ``trees`` [k]: their trees."""
        if len(roots) == 0:
            self._roots = self._places
            self._root_levels = ()
            return
        order, self._roots, self._root_levels = _by_substeps(np.arange(len(roots)), self._steps_of[trees])
        roots = roots[order]
        self._lists["floating"][: self._roots] = roots[: self._roots]
        self._lists["divided_floating"][: len(roots) - self._roots] = roots[self._roots :]

    def _count(self, *, every: bool = False) -> None:
        """Write the number of entries of each list that the kernels of the integrations process. ``every``: see
        :meth:`KernelLaunches.keeps_budgets`."""
        counts = self._counts
        self._kind = (self._launches.keeps_budgets(every=every), self._roots + len(self._root_levels) > 0)
        self._room = max(len(self.stepped), self._roots + sum(self._root_levels[:1]))
        counts[_WHOLE] = self._whole
        counts[_FLOATING] = self._roots
        if self._levels:
            levels = self._lists["levels"][: len(self._levels)]
            levels[:, 0] = self._levels
            levels[:, 1] = 0
            levels[: len(self._root_levels), 1] = self._root_levels
            counts[_NEXT_LEVEL] = 0
            counts[_LEVELS] = len(self._levels)

    # ------------------------------------------------------------------ a step

    def predict(self) -> None:
        """Predict the listed trees over the whole step."""
        self.uploaded = None
        if len(self.fast):
            self._steps_of[self.fast] = 1
        groups = len(self._starts) - 1
        self._counts[_GROUPS] = groups
        if groups:
            self._launches.shared.predict(groups)

    def integrate(self, touched: np.ndarray, roots: np.ndarray, root_trees: np.ndarray) -> None:
        """Integrate the listed trees. Trees that are fast and not ``touched`` [k] take substeps.

        ``roots`` [j]: places of the floating roots of the trees ``root_trees`` [j].
        """
        self._divide(touched)
        self._list_roots(roots, root_trees)
        self._count()
        self._integrate(self._launches.shared)

    def _integrate(self, step: Step) -> None:
        if self._room == 0:
            return
        step.integrate[self._kind](self._room)
        for _ in self._levels:
            step.take_substep[self._kind](self._room)

    # ------------------------------------------------------------------ many steps

    def advance(
        self,
        steps: int,
        roots: np.ndarray,
        root_trees: np.ndarray,
        between: Callable[[], None],
        beside: Beside,
    ) -> None:
        """Predict and integrate ``steps`` times without transfers to the host, as the solver's method of this name."""
        self._divide(np.zeros(0, np.int32))
        self._list_roots(roots, root_trees)
        if len(self.stepped) == 0:
            return
        self._count(every=True)
        self._counts[_GROUPS] = self._whole_groups
        counts = self._counts.tobytes()
        if self.uploaded != counts or len(self.fast) or len(roots):
            self._launches.upload_trees()
            self.uploaded = counts
        if self._buffers.device.is_cpu:
            self._steps(steps, between, beside)
        elif beside is _NOTHING_BESIDE:
            what = (self._whole_groups, self._room, len(self._levels), self._kind, between)
            if self._graph is None or self._graph_of != what:
                with wp.ScopedCapture(self._buffers.device) as capture:
                    self._steps(1, between, beside)
                self._graph, self._graph_of = capture.graph, what
            for _ in range(steps):
                wp.capture_launch(self._graph)  # pyright: ignore[reportArgumentType]  (captured above)
        else:
            self._steps_on_two_streams(steps, between, beside)
        self._launches.download_trees()
        self._buffers.synchronize()

    def _steps(self, steps: int, between: Callable[[], None], beside: Beside) -> None:
        step = self._launches.resident
        for _ in range(steps):
            step.predict(self._whole_groups)
            beside.predict()
            between()
            self._integrate(step)
            beside.integrate()
            beside.end()

    def _steps_on_two_streams(self, steps: int, between: Callable[[], None], beside: Beside) -> None:
        """Take steps on a GPU with the trees on a second stream, beside what ``beside`` launches.

        The launches are one graph each, not one for the whole step: Warp refuses a conditional node, which mujoco_warp
        has, in a graph that is captured from two streams.
        """
        step = self._launches.resident
        stream = self._buffers.device.stream
        for _ in range(steps):
            with wp.ScopedStream(self._second_stream):  # waits for the stream
                step.predict(self._whole_groups)
            beside.predict()
            stream.wait_stream(self._second_stream)
            between()
            with wp.ScopedStream(self._second_stream):
                self._integrate(step)
            beside.integrate()
            stream.wait_stream(self._second_stream)
            beside.end()

    @functools.cached_property
    def _second_stream(self) -> wp.Stream:
        return wp.Stream(self._buffers.device)


def _levels(steps: np.ndarray) -> Levels:
    """Returns how many of the numbers ``steps`` [k] are above 0, how many are above 1, and so on."""
    return tuple(int(np.count_nonzero(steps > level)) for level in range(int(steps.max(initial=0))))


def _by_substeps(items: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, int, Levels]:
    """Sort items [k] by their numbers of substeps ``steps`` [k]: first the items with 1, then the other items by
    falling number. Returns the sorted items, the number of items with 1, and the :data:`Levels` of the other items."""
    whole = steps == 1
    rest = items[~whole][np.argsort(-steps[~whole], kind="stable")]
    return np.concatenate([items[whole], rest]), int(np.count_nonzero(whole)), _levels(steps[~whole])


# Topology: which trees have the same bodies on the same parents, so that one vector can hold them side by side.


class Topologies:
    """Numbers the topologies of trees. Two trees have the same number if their bodies have the same parents.

    Args:
        model: the model whose trees are numbered.
        body_cut: [body] bool, whether a body has been cut off; a tree with a cut-off body has a topology of its own.
        tree_moving: [tree] number of bodies that move: all bodies of a tree, or all except its berry clusters.
    """

    def __init__(self, model: Model, body_cut: np.ndarray, tree_moving: np.ndarray) -> None:
        self._model = model
        self._body_cut = body_cut
        self._moving = tree_moving
        self.alone = False
        """Whether each tree counts as a topology of its own."""
        known: dict[bytes, int] = {}
        parent = np.maximum(model.body_parent - model.tree_first[model.body_tree], -1).astype(np.int32)

        def number(first: int, size: int) -> int:
            return known.setdefault(parent[first : first + size].tobytes(), len(known))

        sizes = ((model.tree_core - model.tree_spares).tolist(), model.tree_size.tolist())
        first = model.tree_first.tolist()
        self._coarse, self._fine = (np.array([*map(number, first, size)], np.int64) for size in sizes)

    def of(self, trees: np.ndarray) -> np.ndarray:
        """Returns the number of the present topology of each of the ``trees`` [k]."""
        is_fine = self._moving[trees] == self._model.tree_size[trees]
        cut = self._model.body_tree[np.flatnonzero(self._body_cut)]
        alone = -1 - trees.astype(np.int64)
        if self.alone:
            return alone
        return np.where(np.isin(trees, cut), alone, np.where(is_fine, self._fine[trees], self._coarse[trees]))


def group_starts(topologies: np.ndarray, whole: int) -> np.ndarray:
    """Returns the indices in a list at which groups of up to eight trees begin, followed by the length of the list.

    ``topologies`` [k]: topology of each tree in the list. Adjacent trees of one topology form a group. The first
    ``whole`` trees are never in a group with later trees.
    """
    place = np.arange(len(topologies))
    differs = np.ones(len(topologies), bool)
    differs[1:] = (topologies[1:] != topologies[:-1]) | (place[1:] == whole)
    run = np.maximum.accumulate(np.where(differs, place, 0))
    return np.append(np.flatnonzero((place - run) % LANES == 0), len(topologies)).astype(np.int32)
