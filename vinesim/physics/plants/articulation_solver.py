"""All plants of a vineyard, stepped at 100 Hz: free motion, response, commitment. Asleep trees cost nothing.

One tick of the plants alone is ``predict()`` then ``integrate()``. Whoever solves contacts stands in between: it reads
``state.body_q`` and ``velocity_free``, asks ``impulse_response()`` of the bodies it touches, and integrates with the wrenches it found.

A tree with berry clusters is *coarse* (each bunch one compound, its clusters riding on it) until ``refine()`` lets them
move and ``coarsen()`` fuses them again. ``cut()`` makes a body the floating root of what grows on it. All three are
called between ticks, after ``integrate()`` and before the next ``predict()``.

The scheme (:mod:`vinesim.kernels.articulation.dynamics`) damps as if every joint's beta (damping / stiffness) were larger by
``(2 phi - 1) dt``, so the solver takes that off what the model asks, down to nothing: what is asked is what is seen.
"""

from __future__ import annotations

import functools
import math
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from vinesim import frames
from vinesim.kernels.articulation import dynamics
from vinesim.kernels.launch import ThreadPool, bind_launch
from vinesim.physics.plants.device_buffers import DeviceBuffers
from vinesim.scene.builder import GRAVITY
from vinesim.scene.model import Model
from vinesim.scene.state import State

FAST_JOINT_RATE = 5.0
"""[rad/s] A tree with a joint faster than this is stepped with phi = 1; a body turning faster feels drag."""

ONSET = 3
"""[tick] How long a tree is stepped with phi = 1 after something began to touch it."""

MAX_JOINT_RATE = 50.0
"""[rad/s] No joint is integrated faster than this: half a radian in a tick of 10 ms."""

FAULT_JOINT_RATE = 5000.0
"""[rad/s] A tree of which a joint would turn faster than this is not integrated: see :mod:`vinesim.physics.plants.fault_guard`."""

AIR_DENSITY = float(dynamics.AIR_DENSITY)
"""[kg/m^3] density of air"""

STIFF_TIE_MASS = 10.0
"""[kg] A tie of which stiffness dt^2 is more than this (1e5 N/m at 10 ms) moves any cane to and fro within a tick. Of
that nothing is seen, but with phi below 1 it rings on and pumps the cane."""


MIN_TREES_PER_THREAD = 16
"""[tree] For fewer awake trees a thread, handing ``predict()`` to other threads costs more than it saves."""

MIN_INTEGRATED_TREES_PER_THREAD = 100
"""[tree] The same for the move at the end of ``integrate()``, which is twelve times as short."""


MAX_TIED_BODIES, MAX_TIES_PER_BODY = 16, 4
"""So many bodies can be held at once, each in so many places; see :meth:`ArticulationSolver.add_tie`."""


class ArticulationSolver:
    """The trees of one model and their state, in memory shared by NumPy and Warp.

    ``predict()`` chooses each tree's phi: 1 while a joint turns faster than ``fast_rate``, and if that was faster than a tenth
    of ``max_rate`` until all have been slower than 0.06 ``max_rate`` for a second; 1 for ``ONSET`` ticks after a touch began;
    ``phi`` otherwise. ``impulse_response()`` and ``integrate()`` belong to the ``predict()`` before them.

    Args:
        model: constants; :class:`ValueError` in words if a tree cannot be simulated.
        state: its arrays are read and written in place.
        dt: tick [s].
        phi: 1/2 (trapezoidal, adds no damping) to 1 (backward Euler).
        device: ``"cpu"`` or ``"cuda"``. With a GPU the arrays of ``state`` are replaced by ones that it can reach: take
            them from ``state`` after this. Results agree with the CPU's to rounding, not to the bit.
        threads: on a CPU, so many threads share the awake trees (the result is the same to the bit).
        fast_rate: [rad/s] see :data:`FAST_JOINT_RATE`.
        max_rate: [rad/s] see :data:`MAX_JOINT_RATE`.
        fault_rate: [rad/s] see :data:`FAULT_JOINT_RATE`.
        geometric_stiffness: take the stiffness that weight and pull lend to what hangs into the implicit solve. Without it a heavy
            bunch on a soft peduncle gains energy every tick; off only to compare with solvers that do without.
        buffers: where arrays live, instead of what ``device`` says.
    """

    def __init__(
        self,
        model: Model,
        state: State,
        *,
        dt: float = 0.01,
        phi: float = 0.55,
        device: str = "cpu",
        threads: int = 1,
        fast_rate: float = FAST_JOINT_RATE,
        max_rate: float = MAX_JOINT_RATE,
        fault_rate: float = FAULT_JOINT_RATE,
        geometric_stiffness: bool = True,
        buffers: DeviceBuffers | None = None,
    ) -> None:
        buffers = DeviceBuffers(device) if buffers is None else buffers
        if threads < 1 or (threads > 1 and not buffers.device.is_cpu):
            raise ValueError(f"{threads} threads on {device}: 1 or more on cpu; a GPU needs none, leave threads at 1")
        if not dt > 0.0 or not 0.5 <= phi <= 1.0:
            raise ValueError(f"dt {dt} s, phi {phi}: need dt above 0 and phi from 0.5 to 1")
        validate(model, state)
        self.model, self.state = model, state
        self.dt, self.fast_rate, self.max_rate, self.fault_rate = dt, fast_rate, max_rate, fault_rate
        trees, bodies = len(model.tree_first), len(model.body_mass)
        self.phi = np.full(trees, phi, np.float32)
        """phi asked for each tree [tree]; set it as you like. 1 from the start where a tie is ``STIFF_TIE_MASS``."""
        self.tree_rate = np.zeros(trees, np.float32)
        """Fastest joint that the last commit found [tree] rad/s, and m/s of what falls; NaN or above ``fault_rate`` for a
        tree that it stopped."""
        self.phi[model.body_tree[model.tie_body[model.tie_stiffness * dt**2 > STIFF_TIE_MASS]]] = 1.0
        self.body_load = np.zeros((bodies, 6), np.float32)
        """Wrenches that last until changed (wind, a rope): force [N], moment about the body's origin [N m], world."""
        self.velocity_free = np.zeros((bodies, 6), np.float32)
        """Velocity of each body of an awake tree at the end of the tick if nothing touches it [body, 6]."""
        self.acceleration = np.zeros((bodies, 6), np.float32)
        """Acceleration over the last tick [body, 6] m/s^2, rad/s^2, world axes."""
        self.tree_air = np.zeros((trees, 3), np.float32)
        """Velocity of the air around each tree [tree, 3] m/s; see :mod:`vinesim.physics.plants.wind`."""
        of_body = np.bincount(model.tie_body, minlength=bodies)
        self._max_model_ties = int(of_body.max(initial=0))
        room = MAX_TIED_BODIES * (self._max_model_ties + MAX_TIES_PER_BODY)
        self.tie_anchor = np.append(model.tie_anchor, np.zeros((room, 3), np.float32), 0)
        """Where ties are held [tie, 3] m, in the world; move them as you like. Behind the model's ties there is room
        for those of :meth:`add_tie`."""
        self.tie_stiffness = np.append(model.tie_stiffness, np.zeros(room, np.float32))
        self.tie_damping = np.append(model.tie_damping, np.zeros(room, np.float32))
        """N/m, N s/m [tie]; a tie of zero is undone."""
        self._tie_point = np.append(model.tie_point, np.zeros((room, 3), np.float32), 0)
        self._tied_bodies: dict[int, int] = {}
        self.body_mass, self.body_com = model.body_mass.copy(), model.body_com.copy()
        self.body_inertia, self.body_drag = model.body_inertia.copy(), model.body_drag.copy()
        """What moves now, in the model's units: the body of a bunch is its compound while the tree is coarse, its head
        while it is fine; a picked bunch is a stub."""
        self.body_product = np.zeros((bodies, 3), np.float32)
        """Entries yz, zx, xy of the inertia in the body's axes [body, 3] kg m^2: a compound is not symmetric."""
        self.joint_stiffness, self.joint_damping = model.joint_stiffness.copy(), model.joint_damping.copy()
        """The model's, but none where a body has been cut off."""
        self.phi_used = np.zeros(trees, np.float32)
        """phi of each tree's last ``predict()`` [tree]."""
        self._onset = np.zeros(trees, np.int32)
        self._last_contact = np.full(trees, -2, np.int64)  # tick of the last touch
        self.tick = 0
        """Commits so far."""
        self._wrench = np.zeros((bodies, 6), np.float32)
        self._impulse = np.zeros((bodies, 6), np.float32)
        self._joint_xd_free, self._joint_qd_free = np.zeros((bodies, 3), np.float32), np.zeros((bodies, 3), np.float32)
        self._loaded_bodies = np.zeros(0, np.int32)
        self._stepping = np.zeros(trees, np.int32)
        self._subset = np.zeros(trees, np.int32)
        self._stepped = np.zeros(0, np.int32)
        self._capacity, self._joints = 0, 0
        self._checked: np.ndarray | None = None
        """Bodies that are known to be stepping."""
        # as the kernels see the trees: a cut body has no parent and no lever, a coarse tree no clusters
        self._parent, self._root = model.body_parent.copy(), np.full(bodies, -1, np.int32)
        self._offset, self._rest = model.body_offset.copy(), model.body_rest.copy()
        self._moving = np.where(state.tree_fine, model.tree_size, model.tree_core).astype(np.int32)
        ends = np.searchsorted(model.tie_body, np.arange(bodies + 1)).astype(np.int32)
        self._ties = np.stack([ends[:-1], ends[1:]], -1)
        self._model_ties = self._ties.copy()
        self._floating, self._roots = np.zeros(bodies, np.int32), np.zeros(0, np.int32)
        self.buffers, self.threads = buffers, threads
        """Where arrays live, for NumPy and for kernels."""
        for owner in (self, state):
            for name, value in vars(owner).items():
                if isinstance(value, np.ndarray):
                    setattr(owner, name, buffers.pinned(value))
        self.thread_pool = ThreadPool(threads) if threads > 1 else None
        """Who shares the work, if there is more than one thread."""
        if self.thread_pool is not None:
            weakref.finalize(self, self.thread_pool.close)
        self._share_ends = [0] * (threads + 1)
        self._graph: wp.Graph | None = None
        self._graph_of = (-1, -1)
        self._record(geometric_stiffness)
        self._list_awake()
        self._detach_joints(self.bodies_of(np.unique(model.body_tree[state.body_cut])))
        clustered = np.flatnonzero(model.bunch_clusters > 0)
        tree = model.body_tree[model.bunch_body[clustered]]
        order = np.argsort(tree, kind="stable")
        self._clustered_bunches, self._clustered_bunch_tree = clustered[order], tree[order]
        """Bunches that have clusters, by tree."""
        self._head_mass, self._head_inertia = model.bunch_head_mass.copy(), model.bunch_head_inertia.copy()
        self._lock_clusters(self._clustered_bunches[~state.tree_fine[self._clustered_bunch_tree]])
        self._unlock_clusters(self._clustered_bunches[state.tree_fine[self._clustered_bunch_tree]])

    # who is awake

    @property
    def awake(self) -> np.ndarray:
        """Ids of the awake trees, sorted [k] int32."""
        return self._awake

    def wake(self, trees: np.ndarray | int) -> None:
        """Let trees move from the next ``predict()`` on."""
        trees = np.atleast_1d(trees)
        if not self.state.tree_awake[trees].all():
            self.state.tree_awake[trees] = True
            self._list_awake()

    def put_to_sleep(self, trees: np.ndarray | int) -> None:
        """Put trees to sleep where they are, with zero rates; their poses are brought up to date."""
        trees = np.atleast_1d(trees)
        if len(trees) == 0:
            return
        bodies = self.bodies_of(trees)
        self.state.joint_qd[bodies] = 0.0
        self.state.joint_xd[bodies] = 0.0
        self.velocity_free[bodies] = 0.0
        self.acceleration[bodies] = 0.0
        self._wrench[bodies] = 0.0
        self.tree_rate[trees] = 0.0
        self._onset[trees] = 0
        self.forward_kinematics(trees)
        self.state.tree_awake[trees] = False
        self._list_awake()

    def bodies_of(self, trees: np.ndarray) -> np.ndarray:
        """All bodies of some trees, tree by tree [k]."""
        return _spans(self.model.tree_first[trees], self.model.tree_size[trees])

    # coarse and fine

    def refine(self, trees: np.ndarray | int) -> None:
        """Let the clusters of these trees' bunches move, from where they ride and as fast as what they ride on.

        Pose, velocity and momentum go on. Nothing happens to trees that are fine or have no clusters; none wakes.
        """
        trees = self._clustered_trees(trees, fine=False)
        if len(trees) == 0:
            return
        self._unlock_clusters(self._clustered_bunches_of(trees))
        self.state.tree_fine[trees] = True
        self._moving[trees] = self.model.tree_size[trees]
        self.state.joint_qd[self._clusters_of(trees)] = 0.0
        self.forward_kinematics(trees)

    def coarsen(self, trees: np.ndarray | int) -> None:
        """Freeze the clusters of these trees' bunches where they are: each bunch becomes one compound.

        Nothing changes its pose. The clusters' motion against their bunch ends in a plastic impact that lasts a tick.
        A bunch keeps its angular momentum about its origin; what its joint must take sets the rest of the tree moving,
        against springs as in any tick (free of them, a light peduncle would be flung about). A floating tree keeps all
        momentum. Kinetic energy does not grow, as the scheme counts it: with the rates squared times the metric.
        """
        trees = self._clustered_trees(trees, fine=True)
        if len(trees) == 0:
            return
        bunches, riding, state = self._clustered_bunches_of(trees), self._clusters_of(trees), self.state
        impulse = self._lock_clusters(bunches)
        state.tree_fine[trees] = False
        self._moving[trees] = self.model.tree_core[trees]
        state.joint_qd[riding] = 0.0
        self.velocity_free[riding] = 0.0
        self.acceleration[riding] = 0.0
        if impulse.any():
            self.forward_kinematics(trees)
            bodies = self.model.bunch_body[bunches]
            axes = state.body_q[bodies, 3:].astype(float)
            self._impulse[bodies, :3] = frames.rotate(axes, impulse[:, :3])
            self._impulse[bodies, 3:] = frames.rotate(axes, impulse[:, 3:])
            springs = self.joint_stiffness[bodies], self.joint_damping[bodies]
            self.joint_stiffness[bodies], self.joint_damping[bodies] = 0.0, 0.0
            self._subset[: len(trees)] = trees
            self._renewed = True
            self._upload_changed()
            self._carry_in_kick(len(trees))
            self._solve(len(trees))
            self.buffers.synchronize()
            self.joint_stiffness[bodies], self.joint_damping[bodies] = springs
            self._renewed = True
            moving = _spans(self.model.tree_first[trees], self.model.tree_core[trees])
            self._joint_qd_free[moving], self._joint_xd_free[moving] = state.joint_qd[moving], state.joint_xd[moving]
            self._carry_in_rates(len(trees))
            self._kick(len(trees))
            self._carry_out_kick(len(trees))
            self.buffers.synchronize()
            self._impulse[bodies] = 0.0
            state.joint_qd[moving] = self._joint_qd_free[moving]
            roots = moving[state.body_cut[moving]]
            state.joint_xd[roots] = self._joint_xd_free[roots]
        self.forward_kinematics(trees)

    def _clustered_trees(self, trees: np.ndarray | int, *, fine: bool) -> np.ndarray:
        """Those of some trees that have clusters and are fine or not [k], sorted."""
        trees = np.unique(np.atleast_1d(trees))
        return trees[
            (self.state.tree_fine[trees] == fine) & (self.model.tree_core[trees] < self.model.tree_size[trees])
        ]

    def _clusters_of(self, trees: np.ndarray) -> np.ndarray:
        """The clusters of some trees [k]."""
        core = self.model.tree_core[trees]
        return _spans(self.model.tree_first[trees] + core, self.model.tree_size[trees] - core)

    def _clustered_bunches_of(self, trees: np.ndarray) -> np.ndarray:
        """The bunches of some trees that have clusters [k]."""
        start, end = (np.searchsorted(self._clustered_bunch_tree, trees, side=side) for side in ("left", "right"))
        return self._clustered_bunches[_spans(start, end - start)]

    def _unlock_clusters(self, bunches: np.ndarray) -> None:
        """Leave to each bunch's body its head only."""
        bodies = self.model.bunch_body[bunches]
        self.body_mass[bodies] = self._head_mass[bunches]
        self.body_com[bodies] = self.model.bunch_head_com[bunches]
        self.body_inertia[bodies] = self._head_inertia[bunches]
        self.body_product[bodies] = 0.0
        self._renewed = True

    def _lock_clusters(self, bunches: np.ndarray) -> np.ndarray:
        """Make each bunch's body a compound of head and clusters as they are.

        Returns the momentum of the clusters' motion against it [bunch, 6]: N s, and N m s about its origin, its axes.
        """
        model, state = self.model, self.state
        n, bodies = len(bunches), model.bunch_body[bunches]
        most = int(model.bunch_clusters[bunches].max(initial=0))
        here, speed = np.zeros((n, most + 1, 7)), np.zeros((n, most + 1, 6))  # in the bunch's frame; the head first
        here[..., 6] = 1.0
        mass = np.zeros((n, most + 1))
        com, inertia = np.zeros((n, most + 1, 3)), np.zeros((n, most + 1, 3))
        mass[:, 0], com[:, 0], inertia[:, 0] = (
            self._head_mass[bunches], model.bunch_head_com[bunches], self._head_inertia[bunches]
        )  # fmt: skip
        for number in range(most):  # over the clusters of one bunch, a handful
            has = np.flatnonzero(model.bunch_clusters[bunches] > number)
            body = model.bunch_cluster[bunches[has]] + number
            parent = model.body_parent[body]
            above = np.where(parent == bodies[has], 0, parent - model.bunch_cluster[bunches[has]] + 1)
            base, motion = here[has, above], speed[has, above]
            frame = frames.compose(base, frames.pose(model.body_offset[body].astype(float), model.body_rest[body]))
            turn = frames.rotate(frame[:, 3:], state.joint_qd[body].astype(float))
            here[has, number + 1, :3] = frame[:, :3]
            here[has, number + 1, 3:] = frames.multiply(frame[:, 3:], state.joint_q[body].astype(float))
            speed[has, number + 1, :3] = motion[:, :3] + np.cross(motion[:, 3:], frame[:, :3] - base[:, :3])
            speed[has, number + 1, 3:] = motion[:, 3:] + turn
            mass[has, number + 1] = self.body_mass[body]
            com[has, number + 1], inertia[has, number + 1] = self.body_com[body], self.body_inertia[body]
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
        self.body_mass[bodies], self.body_com[bodies] = whole, center
        self.body_inertia[bodies] = np.diagonal(tensor, axis1=1, axis2=2)
        self.body_product[bodies] = tensor[:, [1, 2, 0], [2, 0, 1]]
        self._renewed = True
        return np.concatenate([linear.sum(1), angular.sum(1)], -1)

    # cutting

    def cut(self, body: int) -> None:
        """Cut a body off its parent: it and what grows on it fall, from where they are and as fast as they are.

        Its tree wakes; the rest of it goes on as before. Numbers never change.
        """
        model, state, body = self.model, self.state, int(body)
        if not 0 <= body < len(model.body_mass):
            raise ValueError(f"body {body} cannot be cut off: there are {len(model.body_mass)}, counted from 0")
        tree = int(model.body_tree[body])
        if state.body_cut[body]:
            raise ValueError(f"body {body} of tree {tree} has been cut off already")
        if body - model.tree_first[tree] >= model.tree_core[tree]:
            raise ValueError(f"body {body} of tree {tree} is a berry cluster; cut off its bunch")
        self.forward_kinematics(tree)
        state.joint_x[body], state.joint_q[body] = state.body_q[body, :3], state.body_q[body, 3:]
        state.joint_xd[body], state.joint_qd[body] = state.body_qd[body, :3], state.body_qd[body, 3:]
        state.body_cut[body] = True
        self._detach_joints(self.bodies_of(np.array([tree])))
        self.wake(tree)

    def _detach_joints(self, bodies: np.ndarray) -> None:
        """Take over which of the bodies of some whole trees have been cut off."""
        cut = bodies[self.state.body_cut[bodies]]
        self._parent[cut] = -1
        self._offset[cut], self._rest[cut] = 0.0, frames.IDENTITY
        self.joint_stiffness[cut], self.joint_damping[cut] = 0.0, 0.0
        up = bodies
        while ((above := self._parent[up]) >= 0).any():
            up = np.where(above >= 0, above, up)
        self._root[bodies] = np.where(self.state.body_cut[up], up, -1)
        self._roots = np.flatnonzero(self.state.body_cut).astype(np.int32)
        self._renewed = True

    # one tick

    def predict(self) -> None:
        """Bring ``body_q`` and ``body_qd`` to the start of the tick and solve the motion without contacts."""
        self._checked = None
        self._partition_awake()
        self._upload_changed()
        self._carry_in(len(self._stepped))
        self._launch_partitioned(self._free, MIN_TREES_PER_THREAD)
        self._carry_out_free(len(self._stepped))
        self.buffers.synchronize()

    def impulse_response(self, bodies: np.ndarray) -> np.ndarray:
        """How a unit impulse wrench on one body moves another: [n, 6, n, 6] in 1/kg, 1/(kg m), 1/(kg m^2).

        ``impulse_response[u, :, t, :] @ impulse`` is the velocity that an impulse wrench (N s, N m s, at the origin of body
        ``t``) adds to body ``u`` of ``bodies`` [n]. Symmetric; zero between different trees. A view, good until the
        next call.
        """
        n = len(bodies)
        self._require_stepped(bodies)
        if n > self._capacity or self._capacity == 0:
            self._record_response(max(2 * self._capacity, n, 16))
        self._asked[:n] = self.buffers.slots[bodies]
        self._respond(n)
        self.buffers.synchronize()
        return self._response[:n, :, :n]

    def integrate(self, bodies: np.ndarray | None = None, wrenches: np.ndarray | None = None) -> None:
        """End the tick: wrenches (N, N m, world, at the bodies' origins) act over it, joints move.

        ``bodies`` [n] may name one body several times; ``wrenches`` is [n, 6].
        """
        changed = len(self._loaded_bodies) > 0
        self._wrench[self._loaded_bodies] = 0.0
        self._loaded_bodies = np.zeros(0, np.int32)
        if bodies is not None and len(bodies):
            self._require_stepped(bodies)
            np.add.at(self._wrench, bodies, np.asarray(wrenches, np.float32))
            self._loaded_bodies = np.array(bodies, np.int32)
            touched = np.unique(self.model.body_tree[bodies])
            self._subset[: len(touched)] = touched
            self._carry_wrench(len(self._stepped))
            self._push(len(touched))
            begun = touched[self._last_contact[touched] < self.tick - 1]
            self._onset[begun] = np.maximum(self._onset[begun], ONSET + 1)  # integrating counts this tick
            self._last_contact[touched] = self.tick
        elif changed:
            self._carry_wrench(len(self._stepped))
        self._launch_partitioned(self._integrate, MIN_INTEGRATED_TREES_PER_THREAD)
        self._conserve(self._list_floating_roots())
        self._carry_out_commit(len(self._stepped))
        self.buffers.synchronize()
        self.tick += 1

    def _list_floating_roots(self) -> int:
        """List the floating roots that this tick moves; how many there are."""
        if len(self._roots) == 0:
            return 0
        tree = self.model.body_tree[self._roots]
        roots = self._roots[self.state.tree_awake[tree] & np.isin(tree, self._stepped)]
        self._floating[: len(roots)] = self.buffers.slots[roots]
        return len(roots)

    def advance(self, ticks: int) -> None:
        """Many ticks of the awake trees with nothing in between: no contacts, no sleep, no guard.

        Threads part once for all of them. A GPU works on its own copies meanwhile: :meth:`upload` before and
        :meth:`download` after, and between two of those nothing crosses the bus. ``velocity_free`` and
        ``acceleration`` are of the last tick; a tree that went wrong stays where it was (``tree_rate`` is NaN or above
        ``fault_rate``).
        """
        self._partition_awake()
        floating = self._list_floating_roots()
        if len(self._loaded_bodies) and ticks > 0:  # the next prediction still knows the last contacts
            self._run_steps(1, floating)
            self._wrench[self._loaded_bodies] = 0.0
            self._loaded_bodies = np.zeros(0, np.int32)
            self._carry_wrench(len(self._stepped))
            self._run_steps(ticks - 1, floating)
        else:
            self._run_steps(ticks, floating)
        self.tick += ticks

    def upload(self) -> None:
        """Bring the device's copies of the awake trees up to the host's arrays; on a CPU there is nothing to bring."""
        self._partition_awake()
        self._upload_changed()
        self._carry_in(len(self._stepped))
        self.buffers.synchronize()

    def download(self) -> None:
        """Bring the host's arrays of the awake trees up to the device's copies, as ``predict()`` and ``integrate()`` do."""
        self._carry_out_free(len(self._stepped))
        self._carry_out_commit(len(self._stepped))
        self.buffers.synchronize()

    def use_backward_euler(self, trees: np.ndarray) -> None:
        """Use phi = 1 in the next ``ONSET`` ticks of trees about to be touched (``integrate()`` sees to new touches)."""
        self._onset[trees] = np.maximum(self._onset[trees], ONSET)

    def forward_kinematics(self, trees: np.ndarray | None = None) -> None:
        """Bring ``body_q`` and ``body_qd`` of trees (the awake ones unless given) up to their joints; no step."""
        trees = self._awake if trees is None else np.atleast_1d(trees)
        self._subset[: len(trees)] = trees
        self._upload_changed()
        self._carry_in_place(len(trees))
        self._place(len(trees))
        self._carry_out_place(len(trees))
        self.buffers.synchronize()

    def blend_towards(self, tree: int, joint_q: np.ndarray, joint_qd: np.ndarray, blend: float) -> None:
        """Move one tree towards a state elsewhere: rotations [k, 4] by ``blend`` of the way, rates [k, 3] fully."""
        bodies = self.model.bodies_of(tree)
        there, rates = np.asarray(joint_q, np.float32), np.asarray(joint_qd, np.float32)
        here = self.state.joint_q[bodies]
        if there.shape != here.shape or rates.shape != (len(here), 3):
            raise ValueError(f"tree {tree}: pulled by joints {there.shape}, {rates.shape}; it has {len(here)} bodies")
        there = frames.normalize(there)
        if not np.isfinite(there).all() or not np.isfinite(rates).all() or not (there != 0.0).any(-1).all():
            raise ValueError(
                f"tree {tree}: pulled to a pose that is not finite or has zero quaternions; drop the update"
            )
        turn = frames.log(frames.multiply(frames.conjugate(here), there))
        self.state.joint_q[bodies] = frames.normalize(frames.multiply(here, frames.exp(blend * turn)))
        self.state.joint_qd[bodies] = rates
        self.state.joint_qd[bodies.start + self._moving[tree] : bodies.stop] = 0.0  # what rides does not turn

    # what one may ask

    def add_tie(self, body: int, point: np.ndarray, stiffness: float, damping: float) -> int:
        """Hold a body at ``point`` [3], in its own frame, by a spring [N/m] and damper [N s/m]; returns the tie.

        It pulls to ``tie_anchor`` of that tie, which starts where the point is; move it as you like.
        """
        if body - self.model.tree_first[tree := self.model.body_tree[body]] >= self.model.tree_core[tree]:
            raise ValueError(f"body {body} is a berry cluster, which cannot be held; hold its bunch")
        room, first = self._max_model_ties + MAX_TIES_PER_BODY, len(self.model.tie_body)
        if body not in self._tied_bodies:
            free = [i for i in range(MAX_TIED_BODIES) if i not in self._tied_bodies.values()]
            if not free:
                raise ValueError(f"body {body} is one too many: {MAX_TIED_BODIES} are held already, let go of one")
            self._tied_bodies[body] = free[0]
            # its own ties come along: the ties of a body lie side by side
            own = slice(*self._model_ties[body].tolist())
            start = first + room * free[0]
            here = slice(start, start + own.stop - own.start)
            for ties in (self.tie_anchor, self.tie_stiffness, self.tie_damping, self._tie_point):
                ties[start : start + room] = 0.0
                ties[here] = ties[own]
            self._ties[body] = start, start + room
            self._renewed = True
        start = first + room * self._tied_bodies[body] + self._max_model_ties
        spare = np.flatnonzero(self.tie_stiffness[start : start + MAX_TIES_PER_BODY] == 0.0)
        if len(spare) == 0:
            raise ValueError(f"body {body} is held in {MAX_TIES_PER_BODY} places already; let go of one")
        tie = start + int(spare[0])
        self.forward_kinematics(np.array([tree]))
        pose = self.state.body_q[body].astype(float)
        self.tie_anchor[tie] = pose[:3] + frames.rotate(pose[3:], np.asarray(point, float))
        self._tie_point[tie], self.tie_stiffness[tie], self.tie_damping[tie] = point, stiffness, damping
        return tie

    def remove_tie(self, body: int, tie: int) -> None:
        """Undo a tie of :meth:`add_tie`."""
        self.tie_stiffness[tie] = self.tie_damping[tie] = 0.0
        start = (
            len(self.model.tie_body)
            + (self._max_model_ties + MAX_TIES_PER_BODY) * self._tied_bodies[body]
            + self._max_model_ties
        )
        if not self.tie_stiffness[start : start + MAX_TIES_PER_BODY].any():
            del self._tied_bodies[body]
            self._ties[body] = self._model_ties[body]
            self._renewed = True

    def joint_wrench(self, bodies: np.ndarray) -> np.ndarray:
        """Force [N] and moment [N m, about the body's origin, world axes] on bodies from their parents [n, 6].

        Of the last tick, and only for bodies of trees that were awake in it. At rest it carries what hangs below.
        """
        n = len(bodies)
        if n > self._joints:
            self._record_joints(max(2 * self._joints, n, 16))
        self._loaded[:n] = self.buffers.slots[bodies]
        self._carry(n)
        self.buffers.synchronize()
        return self._carried[:n].copy()

    def damping_floor(self, frequency: float, phi: float | None = None) -> float:
        """Least damping ratio that a spring mode of this frequency [Hz] can show: pi f (2 phi - 1) dt."""
        phi = float(self.phi.max(initial=0.5)) if phi is None else phi
        return math.pi * frequency * (2.0 * phi - 1.0) * self.dt

    def set_mass(self, body: int, mass: float) -> None:
        """Give one body another mass [kg] (a picked bunch, a pruned leaf); its inertia scales along.

        A bunch with clusters is meant as a whole, fine or coarse: head and clusters keep their shares.
        """
        if not mass > 0.0:
            raise ValueError(f"body {body}: mass {mass} kg; leave a stub of a gram")
        fruit = self._clustered_bunches[self.model.bunch_body[self._clustered_bunches] == body]
        parts = _spans(self.model.bunch_cluster[fruit], self.model.bunch_clusters[fruit])
        whole = self.body_mass[body] if len(fruit) == 0 else self._head_mass[fruit].sum() + self.body_mass[parts].sum()
        share = mass / float(whole)
        self._head_mass[fruit] *= share
        self._head_inertia[fruit] *= share
        parts = np.append(parts, body)
        self.body_mass[parts] *= share
        self.body_inertia[parts] *= share
        self.body_product[parts] *= share
        self._renewed = True

    # memory and launches

    def _list_awake(self) -> None:
        self._awake = np.flatnonzero(self.state.tree_awake).astype(np.int32)

    def _require_stepped(self, bodies: np.ndarray) -> None:
        if bodies is self._checked or len(bodies) == 0:
            return
        bodies = self._checked = np.asarray(bodies)
        trees = self.model.body_tree[bodies]
        at = np.searchsorted(self._stepped, trees)
        if len(self._stepped) == 0 or (self._stepped[np.minimum(at, len(self._stepped) - 1)] != trees).any():
            late = next(i for i, tree in enumerate(trees) if tree not in self._stepped)
            raise ValueError(f"body {bodies[late]} is touched, but tree {trees[late]} slept: wake it before predict()")
        riding = bodies - self.model.tree_first[trees] >= self._moving[trees]
        if riding.any():
            late = int(np.argmax(riding))
            raise ValueError(
                f"body {bodies[late]} is touched, but tree {trees[late]} is coarse and the body rides on its bunch: "
                "touch the bunch, or refine the tree before predict()"
            )

    def _partition_awake(self) -> None:
        """The awake trees are the ones that this tick steps; deal them out to the threads."""
        if self._stepped is self._awake:
            return
        self._stepped = trees = self._awake
        self._stepping[: len(trees)] = trees
        bodies = np.cumsum(self.model.tree_size[trees])
        parts = np.arange(self.threads + 1) * (int(bodies[-1]) if len(trees) else 0) // self.threads
        self._share_ends[:] = np.searchsorted(bodies, parts, side="right").tolist()

    def _launch_partitioned(self, launch: Callable[..., None], few: int) -> None:
        """Launch over the trees that this tick steps, on all threads if there are ``few`` for each."""
        if self.thread_pool is None or len(self._stepped) < few * self.threads:
            launch(len(self._stepped))
        else:
            self.thread_pool.run(self._shares[launch])

    def _run_steps(self, ticks: int, floating: int) -> None:
        """Predict and move, so many times, without coming back in between."""
        count, ends = len(self._stepped), self._share_ends
        if count == 0:
            return
        if not self.buffers.device.is_cpu:
            if self._graph_of != (count, floating):
                with wp.ScopedCapture(self.buffers.device) as capture:
                    self._launch_steps(1, count, floating)
                self._graph, self._graph_of = capture.graph, (count, floating)
            for _ in range(ticks):
                wp.capture_launch(self._graph)
            self.buffers.synchronize()
        elif self.thread_pool is None or count < self.threads or floating:
            self._launch_steps(ticks, count, floating)
        else:
            share = [(ends[i + 1] - ends[i], ends[i], i) for i in range(self.threads)]
            self.thread_pool.run([functools.partial(_run, self._free, self._integrate, ticks, *part) for part in share])

    def _launch_steps(self, ticks: int, count: int, floating: int) -> None:
        for _ in range(ticks):
            self._free(count)
            self._integrate(count)
            self._conserve(floating)

    def _upload_changed(self) -> None:
        """Tell a device's copies of what seldom changes: who grows on whom, masses, springs."""
        if self._renewed:
            self.buffers.upload(self._seldom)
            self._renewed = False

    def _record(self, tension: bool) -> None:
        """Bind every kernel to the arrays once.

        Arrays of the model are constants. What has a row for each body (``body_``, ``joint_`` and those named below)
        a GPU keeps a copy of, see :mod:`vinesim.physics.plants.device_buffers`: carried to it before every ``predict()``, or ``seldom``
        (set ``_renewed`` after a change), or ``made`` there. All else it reads where it is.
        """
        model, state, memory = self.model, self.state, self.buffers
        kinds = {
            wp.int32: {"tree_moving": self._moving,
                       "body_tree": model.body_tree, "body_parent": self._parent, "body_root": self._root,
                       "stepping": self._stepping, "subset": self._subset,
                       "onset": self._onset, "floating": self._floating},
            float: {"body_mass": self.body_mass, "body_drag": self.body_drag, "tie_stiffness": self.tie_stiffness,
                    "tie_damping": self.tie_damping, "tree_phi": self.phi, "phi_used": self.phi_used,
                    "tree_rate": self.tree_rate},
            wp.vec2i: {"tie_span": self._ties},
            wp.bool: {"tree_awake": state.tree_awake},
            wp.vec3: {"body_offset": self._offset, "body_com": self.body_com, "body_inertia": self.body_inertia,
                      "body_product": self.body_product, "joint_stiffness": self.joint_stiffness,
                      "joint_damping": self.joint_damping, "tie_point": self._tie_point,
                      "tie_anchor": self.tie_anchor, "tree_air": self.tree_air, "joint_x": state.joint_x,
                      "joint_xd": state.joint_xd, "joint_qd": state.joint_qd, "joint_xd_free": self._joint_xd_free,
                      "joint_qd_free": self._joint_qd_free},
            wp.quat: {"body_rest": self._rest, "joint_q": state.joint_q},
            wp.transform: {"tree_pose": model.tree_pose, "body_q": state.body_q},
            wp.spatial_vector: {"body_qd": state.body_qd, "body_load": self.body_load, "wrench": self._wrench,
                                "impulse": self._impulse, "acceleration": self.acceleration,
                                "velocity_free": self.velocity_free},
        }  # fmt: skip
        made = ("body_q", "body_qd", "joint_xd_free", "joint_qd_free", "acceleration", "velocity_free",
                "impulse")  # fmt: skip
        often = ("body_load", "wrench", "joint_x", "joint_xd", "joint_q", "joint_qd")
        self._seldom: list[str] = []
        self._renewed = False
        constants = {id(model.tree_pose)}
        memory.set_layout(model.tree_first, model.tree_size)
        for dtype, arrays in kinds.items():
            for name, data in arrays.items():
                if id(data) in constants:
                    memory.add_constant(name, data, dtype)
                elif name.startswith(("body_", "joint_", "tie_span")) or name in made + often:
                    memory.add_body_rows(name, data, dtype, points=name in ("body_parent", "body_root"))
                    self._seldom += [name] if name not in made + often else []
                else:
                    memory.add_shared(name, data, dtype)
        scratch = {
            wp.vec3: ("lever", "drawn", "Du"),
            wp.quat: ("axes",),
            wp.mat33: ("J", "H", "M", "D", "DJ", "DH", "lift"),
            wp.transform: ("later_q",),
            wp.spatial_vector: ("bias", "spread", "added", "earlier", "later_qd", "idle_acceleration", "idle_velocity"),
        }
        for dtype, names in scratch.items():
            for name in names:
                memory.add_scratch(name, dtype)
        a = memory.arrays
        a["idle_phi"] = wp.empty(len(model.tree_first), dtype=float, device=memory.device)

        def record(kernel: wp.Kernel, *inputs: object, **options: Any) -> Callable[..., None]:
            given = [a[value] if isinstance(value, str) else value for value in inputs]
            return bind_launch(kernel, given, [], device=str(memory.device), **options)

        def carrier(trees: str, *names: str, back: bool = False) -> Callable[[int], None]:
            return memory.row_copier(names, trees, back=back)

        self._carry_in = carrier("stepping", *often)
        self._carry_out_free = carrier("stepping", "body_q", "body_qd", "velocity_free", back=True)
        self._carry_wrench = carrier("stepping", "wrench")
        self._carry_out_commit = carrier(
            "stepping", "joint_x", "joint_xd", "joint_q", "joint_qd", "acceleration", back=True
        )
        self._carry_in_place = carrier("subset", "joint_x", "joint_xd", "joint_q", "joint_qd")
        self._carry_out_place = carrier("subset", "body_q", "body_qd", back=True)
        self._carry_in_kick = carrier("subset", *often, "impulse")
        self._carry_in_rates = carrier("subset", "joint_xd_free", "joint_qd_free")
        self._carry_out_kick = carrier("subset", "joint_xd_free", "joint_qd_free", back=True)

        gravity, dt = wp.vec3(GRAVITY), self.dt
        tree, joint = (
            (memory.pitch, "tree_first", "tree_moving"),
            ("body_parent", "body_root", "body_offset", "body_rest"),
        )
        body = ("body_mass", "body_com", "body_inertia", "body_product", "body_drag")
        tie = ("tie_span", "tie_point", "tie_stiffness", "tie_damping")
        where = ("joint_x", "joint_xd", "joint_q", "joint_qd")
        factors = ("axes", "lever", "D", "DJ", "DH", "lift")
        freed = ("joint_xd_free", "joint_qd_free")
        dealt = {"index_list": "trees", "partitions": self.threads}

        def free(brisk: float, tension: float, trees: str, phi: str, acceleration: str, velocity: str) -> Callable:
            return record(
                dynamics.predict, dt, brisk, tension, gravity, *tree, "tree_pose", *joint, *body, "joint_stiffness",
                "joint_damping", *tie, trees, "tree_phi", "onset", "tree_air", "tie_anchor", "body_load", "wrench",
                *where, "body_q", "body_qd", phi, "axes", "lever", "J", "H", "M", "bias", "drawn", "D", "DJ", "DH",
                "Du", "lift", acceleration, *freed, velocity, **dealt,
            )  # fmt: skip

        def push(dt: float, wrench: str, acceleration: str) -> Callable:
            return record(
                dynamics.apply_wrenches, dt, *tree, "body_parent", "body_root", "subset", wrench, *factors, "spread", "added", "Du",
                acceleration, *freed,
            )  # fmt: skip

        self._place = record(
            dynamics.forward_kinematics,
            memory.pitch,
            "tree_first",
            "tree_size",
            "tree_pose",
            *joint,
            "subset",
            *where,
            "body_q",
            "body_qd",
        )
        self._free = free(self.fast_rate, float(tension), "stepping", "phi_used", "acceleration", "velocity_free")
        self._push = push(dt, "wrench", "acceleration")
        # an impact: factors of inertia and springs alone, and wrenches that are impulses
        self._solve = free(math.inf, 0.0, "subset", "idle_phi", "idle_acceleration", "idle_velocity")
        self._kick = push(1.0, "impulse", "idle_acceleration")
        self._integrate = record(
            dynamics.integrate, dt, self.max_rate, self.fault_rate, *tree, "body_parent", "body_root", "stepping", "tree_awake",
            "phi_used", *where, *freed, "tree_rate", "onset", *where, **dealt,
        )  # fmt: skip
        self._conserve = record(
            dynamics.correct_floating_momentum, dt, self.max_rate, self.fault_rate, gravity, *tree, "body_tree", *joint, *body, *tie, "floating",
            "phi_used", "tree_rate", "tree_air", "tie_anchor", "body_load", "wrench", "body_q", "body_qd",
            "acceleration", "lever", "earlier", "later_q", "later_qd", *where,
        )  # fmt: skip
        self._bind = record
        ends = self._share_ends

        def part(launch: Callable[..., None], i: int) -> Callable[[], None]:
            return lambda: launch(ends[i + 1] - ends[i], ends[i], i)

        self._shares = {
            launch: [part(launch, i) for i in range(self.threads)] for launch in (self._free, self._integrate)
        }

    def _record_joints(self, capacity: int) -> None:
        """Room for what ``capacity`` joints carry."""
        self._joints, memory = capacity, self.buffers
        self._loaded = memory.pinned(np.zeros(capacity, np.int32))
        self._carried = memory.pinned(np.zeros((capacity, 6), np.float32))
        memory.add_shared("loaded", self._loaded, wp.int32)
        memory.add_shared("carried", self._carried, wp.spatial_vector)
        self._carry = self._bind(
            dynamics.joint_wrench, self.dt, wp.vec3(GRAVITY), memory.pitch, "tree_first", "tree_moving", "body_tree",
            "body_parent", "body_root", "body_mass", "body_com", "body_inertia", "body_product", "body_drag",
            "tie_span", "tie_point", "tie_stiffness", "tie_damping", "loaded", "phi_used", "tree_air", "tie_anchor",
            "body_q", "body_qd", "acceleration", "body_load", "wrench", "carried",
        )  # fmt: skip

    def _record_response(self, capacity: int) -> None:
        """Room for the responses of ``capacity`` bodies at once."""
        self._capacity, memory = capacity, self.buffers
        self._asked = memory.pinned(np.zeros(capacity, np.int32))
        self._response = memory.pinned(np.zeros((capacity, 6, capacity, 6), np.float32))
        stride = memory.max_tree_extent
        columns = [wp.empty(capacity * stride, dtype=wp.mat33, device=memory.device) for _ in range(4)]
        memory.add_shared("asked", self._asked, wp.int32)
        memory.add_shared("response", self._response, float)
        self._respond = self._bind(
            dynamics.impulse_response, memory.pitch, "tree_first", "body_tree", "body_parent", stride, "asked", "lever", "D", "DJ",
            "DH", "lift", *columns, "response",
        )  # fmt: skip


def _run(
    free: Callable[..., None], integrate: Callable[..., None], ticks: int, count: int, first: int = 0, share: int = 0
) -> None:
    """Many ticks of some of the listed trees, on one thread."""
    for _ in range(ticks):
        free(count, first, share)
        integrate(count, first, share)


def _spans(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """The numbers ``first[i] ... first[i] + count[i] - 1``, one span after the other."""
    end = np.cumsum(count)
    return np.repeat(first - (end - count), count) + np.arange(end[-1] if len(end) else 0)


def validate(model: Model, state: State) -> None:
    """Raise :class:`ValueError` naming the first tree or body that cannot be simulated, and the remedy."""
    model.check()
    state.check()
    if len(state.joint_q) != len(model.body_mass) or len(state.tree_awake) != len(model.tree_first):
        raise ValueError(
            f"state of {len(state.joint_q)} bodies for a model of {len(model.body_mass)}; use State.at_rest"
        )

    def refuse(bad: np.ndarray, what: str, value: np.ndarray, remedy: str) -> None:
        if bad.any():
            body = int(np.argmax(bad.reshape(len(bad), -1).any(-1)))
            tree = int(model.body_tree[body])
            raise ValueError(f"body {body} of tree {tree}: {what} {np.asarray(value[body]).tolist()}; {remedy}")

    count = len(model.body_mass)
    owner = np.repeat(np.arange(len(model.tree_first)), model.tree_size)
    start = np.cumsum(model.tree_size) - model.tree_size
    if len(owner) != count or (model.tree_first != start).any() or (model.tree_size < 1).any():
        raise ValueError("tree_first and tree_size do not tile the bodies; build the model with grow.assemble")
    refuse(model.body_tree != owner, "is listed in tree", model.body_tree, "body_tree must agree with tree_first")
    parent = model.body_parent
    refuse(parent >= np.arange(count), "parent", parent, "a parent stands before its children (no cycles); reorder")
    refuse((parent < -1) | ((parent >= 0) & (parent < start[owner])), "parent", parent, "name a body of the same tree")
    refuse(~(model.body_length > 0.0), "length [m]", model.body_length, "give a positive length or leave the body out")
    refuse(~(model.body_mass > 0.0), "mass [kg]", model.body_mass, "give a positive mass or leave the body out")
    refuse(~(model.body_inertia > 0.0), "inertia [kg m^2]", model.body_inertia, "give positive principal moments")
    refuse(
        model.joint_stiffness < 0.0, "stiffness [N m/rad]", model.joint_stiffness, "a spring pulls back: use 0 or more"
    )
    refuse(
        model.joint_damping < 0.0, "damping [N m s/rad]", model.joint_damping, "a damper takes energy: use 0 or more"
    )
    for what, q in (("rest rotation", model.body_rest), ("joint rotation", state.joint_q)):
        refuse(abs(np.linalg.norm(q, axis=-1) - 1.0) > 1e-3, what, q, "give a unit quaternion xyzw")
    refuse(~(model.body_drag >= 0.0), "drag area [m^2]", model.body_drag, "air holds back: use 0 or more")
    _validate_clusters(model)
    _validate_ties(model)


def _validate_clusters(model: Model) -> None:
    """Clusters are all that stands behind a tree's core, each run on one bunch."""
    core, size = model.tree_core, model.tree_size
    if (bad := (core < 1) | (core > size)).any():
        tree = int(np.argmax(bad))
        raise ValueError(f"tree {tree}: tree_core {core[tree]} of {size[tree]} bodies; give 1 to tree_size (all)")
    riding = np.arange(len(model.body_mass)) - model.tree_first[model.body_tree] >= core[model.body_tree]
    owner = np.full(len(model.body_mass), -1)
    for bunch in np.flatnonzero(model.bunch_clusters > 0).tolist():
        first, count, body = model.bunch_cluster[bunch], model.bunch_clusters[bunch], model.bunch_body[bunch]
        parts = np.arange(first, first + count)
        where = f"bunch {bunch}: clusters {first} to {first + count - 1}"
        if first < 0 or first + count > len(owner) or not riding[parts].all():
            raise ValueError(f"{where} are not behind the core of a tree; put clusters last and set tree_core")
        if (owner[parts] >= 0).any():
            raise ValueError(f"{where} are also bunch {owner[parts].max()}'s; give each bunch its own")
        owner[parts] = bunch
        parent = model.body_parent[parts]
        if (bad := (parent != body) & ((parent < first) | (parent >= first + count))).any():
            part = int(np.argmax(bad))
            raise ValueError(
                f"bunch {bunch}: cluster {parts[part]} hangs on body {parent[part]}; hang it on the bunch, body "
                f"{body}, or on another of its clusters"
            )
        if not model.bunch_head_mass[bunch] > 0.0 or not (model.bunch_head_inertia[bunch] > 0.0).all():
            raise ValueError(
                f"bunch {bunch}: its head has mass {model.bunch_head_mass[bunch]} kg, moments "
                f"{model.bunch_head_inertia[bunch].tolist()}; give positive ones"
            )
        whole = model.bunch_head_mass[bunch] + model.body_mass[parts].sum()
        if abs(whole - model.body_mass[body]) > 1e-3 * whole:
            raise ValueError(
                f"bunch {bunch}: head and clusters weigh {whole:g} kg, its body {model.body_mass[body]:g} kg; "
                "body_mass is the whole bunch's"
            )
    if (bad := riding & (owner < 0)).any():
        body = int(np.argmax(bad))
        raise ValueError(
            f"body {body} of tree {model.body_tree[body]} is behind its core, but no bunch's cluster; list it in "
            "bunch_cluster or raise tree_core"
        )


def _validate_ties(model: Model) -> None:
    """Ties are sorted, on bodies that are there and always move, and pull back."""
    body, count = model.tie_body, len(model.body_mass)

    def refuse(bad: np.ndarray, what: str) -> None:
        if bad.any():
            tie = int(np.argmax(bad))
            raise ValueError(f"tie {tie} on body {body[tie]}: {what}")

    refuse((body < 0) | (body >= count), f"there are {count} bodies, counted from 0")
    refuse(np.append(False, body[1:] < body[:-1]), "it stands behind a tie of a later body; sort ties by body")
    tree = model.body_tree[body]
    refuse(body - model.tree_first[tree] >= model.tree_core[tree], "a berry cluster cannot be tied; tie its bunch")
    refuse(~(model.tie_stiffness >= 0.0), "stiffness below 0 N/m; a spring pulls back: use 0 or more")
    refuse(~(model.tie_damping >= 0.0), "damping below 0 N s/m; a damper takes energy: use 0 or more")
