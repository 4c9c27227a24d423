"""Articulation solver: all plants of a vineyard as trees of bodies on ball joints, stepped with implicit springs.

One step of the plants alone is ``predict()`` then ``integrate()``. A contact solver works in between: it reads
``state.body_q`` and ``velocity_free``, asks for the ``impulse_response()`` of the bodies in contact, and integrates
with the wrenches that it found. Trees that sleep cost nothing.

A tree with berry clusters is *coarse* (each bunch one compound, its clusters riding on it) until ``refine()`` lets them
move and ``coarsen()`` locks them again. ``cut()`` makes a body the floating root of what grows on it. All three are
called between steps, after ``integrate()`` and before the next ``predict()``.

The scheme (:mod:`vinesim.kernels.articulation`) damps as if every joint's beta (damping / stiffness) were larger by
``(2 phi - 1) dt``, so the solver takes that off what the model asks, down to nothing: what is asked is what is seen.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from vinesim import frames
from vinesim.errors import checked_index
from vinesim.kernels.articulation.first_mode import MAX_SUBSTEPS, substeps_for
from vinesim.kernels.launch import bound
from vinesim.kernels.shared_launch import LaunchPool
from vinesim.physics.parameters import PhysicsParameters
from vinesim.physics.plants.berry_clusters import BerryClusters, spans
from vinesim.physics.plants.contact_loads import ContactLoads
from vinesim.physics.plants.device_buffers import DeviceBuffers
from vinesim.physics.plants.kernel_launches import KernelLaunches, kernel_parameters
from vinesim.physics.plants.remote_pose import blend_towards
from vinesim.physics.plants.step_runner import StepRunner
from vinesim.physics.plants.ties import RootRests, TieTable, turning_damping
from vinesim.physics.plants.topology import Topologies
from vinesim.physics.plants.validation import checked_trees, validate
from vinesim.scene.model import Model
from vinesim.scene.state import State

_NO_TREES, _NO_WRENCHES = np.zeros(0, np.int32), np.zeros((0, 6), np.float32)


class ArticulationSolver:
    """The trees of one model and their state, in memory shared by NumPy and Warp.

    ``predict()`` chooses each tree's phi: 1 while a joint turns faster than ``fast_rate``, and if that was faster than
    a tenth of ``max_rate`` until all have been slower than 0.06 ``max_rate`` for a second; 1 for a while after contact
    began (``contact_onset_duration``); ``phi`` otherwise. ``impulse_response()`` and ``integrate()`` belong to the
    ``predict()`` before them.

    Args:
        model: constants; :class:`ValueError` in words if a tree cannot be simulated.
        state: its arrays are read and written in place.
        parameters: numbers of the scheme; those that follow replace single ones and may be infinite.
        dt, phi: step [s]; 1/2 (trapezoidal, adds no damping) to 1 (backward Euler).
        device: ``"cpu"`` or ``"cuda"``. With a GPU the arrays of ``state`` are replaced by ones that it can reach: take
            them from ``state`` after this. Results agree with the CPU's to rounding, not to the bit.
        threads: on a CPU, so many threads share the awake trees (the result is the same to the bit).
        fast_rate, max_rate, fault_rate: [rad/s] see ``fast_joint_rate``, ``max_joint_rate`` and ``fault_joint_rate`` of
            ``PhysicsParameters``, and :mod:`vinesim.physics.plants.fault_guard`.
        geometric_stiffness: take the stiffness that weight and pull lend to what hangs into the implicit solve. Without
            it a heavy bunch on a soft peduncle gains energy every step; off only to compare with solvers without it.
        substeps: divide the step of trees whose first mode is too fast for it; off only to compare with other solvers.
        buffers: where arrays live, instead of what ``device`` says."""

    def __init__(
        self,
        model: Model,
        state: State,
        parameters: PhysicsParameters = PhysicsParameters(),
        *,
        dt: float | None = None,
        phi: float | None = None,
        device: str = "cpu",
        threads: int = 1,
        fast_rate: float | None = None,
        max_rate: float | None = None,
        fault_rate: float | None = None,
        geometric_stiffness: bool = True,
        substeps: bool = True,
        buffers: DeviceBuffers | None = None,
    ) -> None:
        p = parameters
        dt, phi = p.dt if dt is None else dt, p.phi if phi is None else phi
        buffers = DeviceBuffers(device) if buffers is None else buffers
        if not isinstance(threads, int) or threads < 1 or (threads > 1 and not buffers.device.is_cpu):
            raise ValueError(f"{threads} threads on {device}: 1 or more on cpu; a GPU needs none, leave threads at 1")
        if not 0.0 < dt < math.inf or not 0.5 <= phi <= 1.0:
            raise ValueError(f"dt {dt} s, phi {phi}: need a finite dt above 0 and phi from 0.5 to 1")
        validate(model, state)
        self.model, self.state, self._dt, self._gravity = model, state, dt, p.gravity
        self.fast_rate = p.fast_joint_rate if fast_rate is None else fast_rate
        self.max_rate = p.max_joint_rate if max_rate is None else max_rate
        self.fault_rate = p.fault_joint_rate if fault_rate is None else fault_rate
        self.buffers, self.threads = buffers, threads
        """Where arrays live, for NumPy and for kernels."""
        self.tick = 0
        """Integrations so far."""
        self.ties, self.root_rests = TieTable(model, p.max_held_bodies, p.max_hands_per_body), RootRests(model)
        self._allocate(phi)
        self.phi[model.body_tree[model.tie_body[model.tie_stiffness * dt**2 > p.stiff_tie_mass]]] = 1.0
        self._pin_arrays()
        self.launch_pool = LaunchPool(threads)
        """Threads that share launches over trees."""
        weakref.finalize(self, self.launch_pool.close)
        numbers = kernel_parameters(p, dt, self.fast_rate, self.max_rate, self.fault_rate, geometric_stiffness)
        self.onset_steps = numbers["contact_steps"] - 1  # with phi = 1 after contact began
        self.launches = KernelLaunches(self, numbers, self.launch_pool, MAX_SUBSTEPS if substeps else 1)
        """Kernels on these arrays."""
        self._runner = StepRunner(
            buffers, self.launches, tree_substeps=self.tree_substeps, tree_steps=self._steps,
            tree_rate=self.tree_rate, tree_budget=self.tree_budget, stepping=self._stepping, groups=self._groups,
            floating=self._floating, topologies=Topologies(model, state.body_cut, self.tree_moving),
            whole=np.isin(np.arange(len(model.tree_first)), model.body_tree[model.tie_body[self.ties.on_wire]])
            | model.is_on_arm(),
        )  # fmt: skip

        def apply_on_device(touched: int, first: int = 0, partition: int = 0) -> None:
            self.launches.upload_wrenches(len(self._runner.stepped))
            self.launches.apply_wrenches(touched)

        self._loads = ContactLoads(
            body_tree=model.body_tree, place_in_tree=self._place_in_tree, is_stepped=self._runner.is_stepped,
            tree_moving=self.tree_moving, body_wrench=self._wrench, touched=self._subset,
            euler_steps=self._euler_steps, onset=self.onset_steps + 1,  # the first step counts
            apply=bound(apply_on_device) if buffers.has_copies else self.launches.apply_wrenches,
            pool=self.launch_pool,
        )  # fmt: skip
        self._list_awake()
        self._detach_joints(self.bodies_of(np.unique(model.body_tree[state.body_cut])))
        self.berry_clusters = BerryClusters(self)
        """Locks and unlocks berry clusters; for what leaves the tree, see :class:`DetachmentMonitor`."""

    @property
    def dt(self) -> float:
        """[s] Duration of a step. Fixed: kernels, damping and counts of steps follow from it at the start."""
        return self._dt

    def _allocate(self, phi: float) -> None:
        """Arrays of the solver beside model and state."""
        model, state, trees, bodies = self.model, self.state, len(self.model.tree_first), len(self.model.body_mass)
        self.phi = np.full(trees, phi, np.float32)
        """phi asked for each tree [tree]; set it as you like. 1 where a tie is stiff (``stiff_tie_mass``)."""
        self.phi_used = np.zeros(trees, np.float32)
        """phi of each tree's last ``predict()`` [tree]."""
        self.awake_list = np.zeros(trees, np.int32)
        """Its first entries are :attr:`awake`: for kernels, which stay bound to it [tree]."""
        self.tree_rate = np.zeros(trees, np.float32)
        """Fastest joint of the last step [tree] rad/s, m/s of what falls; NaN or above ``fault_rate``: stopped."""
        self.tree_substeps = np.ones(trees, np.int32)
        """Into how many substeps the step of each awake tree is divided while nothing holds it [tree]."""
        self.tree_budget = np.zeros(trees, np.int32)
        """How the energy of each awake tree is watched [tree]: :mod:`vinesim.kernels.articulation.energy_budget`."""
        self.tree_air = np.zeros((trees, 3), np.float32)
        """Velocity of the air around each tree [tree, 3] m/s; see :mod:`vinesim.physics.plants.wind`."""
        self.body_load = np.zeros((bodies, 6), np.float32)
        """Wrenches that last until changed (wind, a rope): force [N], moment about the body's origin [N m], world."""
        self.velocity_free = np.zeros((bodies, 6), np.float32)
        """Velocity of each body of an awake tree at the end of the step if nothing touches it [body, 6]."""
        self.acceleration = np.zeros((bodies, 6), np.float32)
        """Acceleration over the last step [body, 6] m/s^2, rad/s^2, world axes."""
        self.body_mass, self.body_com = model.body_mass.copy(), model.body_com.copy()
        self.body_inertia, self.body_drag = model.body_inertia.copy(), model.body_drag.copy()
        """What moves now, in the model's units: the body of a bunch is its compound while the tree is coarse, its head
        while it is fine; a picked bunch is a stub."""
        self.body_product = np.zeros((bodies, 3), np.float32)
        """Entries yz, zx, xy of the inertia in the body's axes [body, 3] kg m^2: a compound is not symmetric."""
        self.joint_stiffness, self.joint_damping = model.joint_stiffness.copy(), model.joint_damping.copy()
        """The model's, but none where a body has been cut off; if ties hold that, the damping is how they resist that
        it turns."""
        self.tree_moving = np.where(state.tree_fine, model.tree_size, model.tree_core).astype(np.int32)
        """Bodies of each tree that move [tree]: all, or all but the clusters."""
        self.body_impulse = np.zeros((bodies, 6), np.float32)
        """Impulses of a plastic impact while it is solved [body, 6] N s, N m s."""
        self.joint_xd_free, self.joint_qd_free = np.zeros((bodies, 3), np.float32), np.zeros((bodies, 3), np.float32)
        """Predicted rates of roots and joints [body, 3] m/s, rad/s."""
        self._place_in_tree = (np.arange(bodies) - model.tree_first[model.body_tree]).astype(np.int32)
        # as the kernels see the trees: a cut body has no parent and no lever
        self._parent, self._root = model.body_parent.copy(), np.full(bodies, -1, np.int32)
        self._offset, self._rest = model.body_offset.copy(), model.body_rest.copy()
        self._falls = np.zeros(bodies, np.bool_)  # of a floating component that no tie holds
        self._floating, self._falling_roots = np.zeros(bodies, np.int32), np.zeros(0, np.int32)
        self._wrench = np.zeros((bodies, 6), np.float32)
        self._euler_steps, self._steps = np.zeros(trees, np.int32), np.ones(trees, np.int32)
        self._stepping, self._subset, self._groups = (np.zeros(n, np.int32) for n in (trees, trees, (trees, 2)))

    def _pin_arrays(self) -> None:
        """Move the arrays of solver, ties and state to where the device can reach them."""
        for owner in (self, self.ties, self.root_rests, self.state):
            for name, value in vars(owner).items():
                if isinstance(value, np.ndarray):
                    setattr(owner, name, self.buffers.pinned(value))

    def kernel_arrays(self) -> dict[Any, dict[str, np.ndarray]]:
        """All arrays that kernels read or write, by element type and name."""
        model, state, ties, rests = self.model, self.state, self.ties, self.root_rests
        return {
            wp.int32: {"tree_moving": self.tree_moving, "body_tree": model.body_tree, "body_parent": self._parent,
                       "body_root": self._root, "stepping": self._stepping, "subset": self._subset,
                       "tree_euler_steps": self._euler_steps, "tree_steps": self._steps, "floating": self._floating,
                       "tree_substeps": self.tree_substeps, "tree_budget": self.tree_budget},
            float: {"body_mass": self.body_mass, "body_drag": self.body_drag, "tie_stiffness": ties.stiffness,
                    "tie_damping": ties.damping, "tie_softening": ties.softening, "tree_phi": self.phi,
                    "phi_used": self.phi_used, "tree_rate": self.tree_rate},
            wp.vec2i: {"tie_span": ties.span, "groups": self._groups},
            wp.bool: {"tree_awake": state.tree_awake, "body_falls": self._falls},
            wp.vec3: {"body_offset": self._offset, "body_com": self.body_com, "body_inertia": self.body_inertia,
                      "body_product": self.body_product, "joint_stiffness": self.joint_stiffness,
                      "joint_damping": self.joint_damping, "tie_point": ties.point, "tie_anchor": ties.anchor,
                      "tie_anchor_velocity": ties.anchor_velocity, "tie_axis": ties.axis, "tree_air": self.tree_air,
                      "root_turn": rests.turn, "root_turn_rate": rests.rate, "root_softening": rests.softening,
                      "joint_x": state.joint_x, "joint_xd": state.joint_xd, "joint_qd": state.joint_qd,
                      "joint_xd_free": self.joint_xd_free, "joint_qd_free": self.joint_qd_free},
            wp.quat: {"body_rest": self._rest, "joint_q": state.joint_q},
            wp.transform: {"body_q": state.body_q},
            wp.spatial_vector: {"body_qd": state.body_qd, "body_load": self.body_load, "body_wrench": self._wrench,
                                "body_impulse": self.body_impulse, "body_acceleration": self.acceleration,
                                "body_qd_free": self.velocity_free},
        }  # fmt: skip

    # ------------------------------------------------------------------ awake and asleep

    @property
    def awake(self) -> np.ndarray:
        """Ids of the awake trees, sorted [k] int32."""
        return self._awake

    def wake(self, trees: np.ndarray | int) -> None:
        """Let trees move from the next ``predict()`` on; :class:`ValueError` if there is no such tree."""
        trees = checked_trees(trees, len(self.state.tree_awake))
        if not self.state.tree_awake[trees].all():
            self.state.tree_awake[trees] = True
            self._list_awake()

    def put_to_sleep(self, trees: np.ndarray | int) -> None:
        """Put trees to sleep where they are, with zero rates; their poses are brought up to date.

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
        self.forward_kinematics(trees)
        self.state.tree_awake[trees] = False
        self._list_awake()

    def _list_awake(self) -> None:
        self._awake = np.flatnonzero(self.state.tree_awake).astype(np.int32)
        self.awake_list[: len(self._awake)] = self._awake

    def bodies_of(self, trees: np.ndarray) -> np.ndarray:
        """All bodies of some trees, tree by tree [k]."""
        return spans(self.model.tree_first[trees], self.model.tree_size[trees])

    # ------------------------------------------------------------------ topology and mass

    def refine(self, trees: np.ndarray | int) -> None:
        """Let the clusters of these trees' bunches move, from where they ride and as fast as what they ride on.

        Pose, velocity and momentum go on. Nothing happens to trees that are fine or have no clusters; none wakes.
        :class:`ValueError` if there is no such tree.
        """
        self.berry_clusters.refine(trees)

    def coarsen(self, trees: np.ndarray | int) -> None:
        """Lock the clusters of these trees' bunches where they are: each bunch becomes one compound.

        Nothing changes its pose. The clusters' motion against their bunch ends in a plastic impact that lasts a step.
        A bunch keeps its angular momentum about its origin; what its joint must take sets the rest of the tree moving,
        against springs as in any step (free of them, a light peduncle would be flung about). A floating tree keeps all
        momentum. Kinetic energy does not grow, as the scheme counts it: with the rates squared times the metric.
        """
        self.berry_clusters.coarsen(trees)

    def cut(self, body: int) -> None:
        """Cut a body off its parent: it and what grows on it fall, from where they are and as fast as they are.

        Its tree wakes; the rest of it goes on as before. Numbers never change. :class:`ValueError` if it cannot be cut.
        """
        model, state = self.model, self.state
        body = checked_index("body", body, len(model.body_mass))
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
        self._find_falling(bodies)

    def _find_falling(self, bodies: np.ndarray) -> None:
        """Note which floating components of some whole trees no tie holds; ties resist that the others turn."""
        root, is_cut = self._root[bodies], self.state.body_cut[bodies]
        tied = np.isin(bodies, self.ties.tied_bodies)
        self._falls[bodies] = (root >= 0) & ~np.isin(root, root[tied])
        if is_cut.any():
            damping = turning_damping(self.model, bodies, root, tied, self._gravity)
            self.joint_damping[bodies[is_cut]] = damping[is_cut, None]
        self._falling_roots = np.flatnonzero(self.state.body_cut & self._falls).astype(np.int32)
        self.launches.changed = True

    def set_mass(self, body: int, mass: float) -> None:
        """Give one body another mass [kg] (a picked bunch, a pruned leaf); its inertia scales along.

        A bunch with clusters is meant as a whole, fine or coarse: head and clusters keep their shares.
        """
        if not 0.0 < mass < math.inf:
            raise ValueError(f"body {body}: mass {mass} kg; leave a stub of a gram")
        self.berry_clusters.set_mass(body, mass)

    # ------------------------------------------------------------------ one step

    def predict(self, trees: np.ndarray | None = None) -> None:
        """Bring ``body_q`` and ``body_qd`` to the start of the step and solve the motion without contacts.

        ``trees`` [k]: only these, woken or given another phi after the prediction of all.
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
        """How a unit impulse wrench on one body moves another: [n, 6, n, 6] in 1/kg, 1/(kg m), 1/(kg m^2).

        ``impulse_response[u, :, t, :] @ impulse`` is the velocity that an impulse wrench (N s, N m s, at the origin of
        body ``t``) adds to body ``u`` of ``bodies`` [n]. Symmetric; zero between different trees.
        """
        self.require_stepped(bodies)
        return self.launches.dense_impulse_response(bodies)

    def integrate(self, bodies: np.ndarray | None = None, wrenches: np.ndarray | None = None) -> None:
        """End the step: wrenches (N, N m, world, at the bodies' origins) act over it, joints move.

        ``bodies`` [n] may name one body several times; ``wrenches`` is [n, 6].
        """
        launches, touched, loads = self.launches, _NO_TREES, self._loads
        count = len(self._runner.stepped)
        if bodies is not None and len(bodies):
            touched = loads.replace(bodies, np.asarray(wrenches), self.tick)
        elif len(loads):
            self._unload(count)
        self._runner.integrate(touched, *self._floating_roots())
        launches.download_joints(count)
        self.buffers.synchronize()
        self.tick += 1

    def _unload(self, count: int) -> None:
        """Take the wrenches of the last contacts off the first ``count`` trees of the list."""
        self._loads.replace(_NO_TREES, _NO_WRENCHES, self.tick)
        self.launches.upload_wrenches(count)

    def _floating_roots(self) -> tuple[np.ndarray, np.ndarray]:
        """The floating roots that this step moves: where kernels find them, and their trees."""
        if len(self._falling_roots) == 0:
            return _NO_TREES, _NO_TREES
        tree = self.model.body_tree[self._falling_roots]
        roots = self._falling_roots[self.state.tree_awake[tree] & np.isin(tree, self._runner.stepped)]
        return self.buffers.slots[roots], self.model.body_tree[roots]

    def advance(self, steps: int, between: Callable[[], None] | None = None) -> None:
        """Many steps of the awake trees: no sleep, no fault guard, no contacts but what ``between`` launches.

        Threads part once for all of them. A GPU works on its own copies meanwhile: :meth:`upload` before and
        :meth:`download` after, and between two of those nothing crosses the bus. ``velocity_free``, ``acceleration``
        are of the last step; a tree that went wrong stays where it was (``tree_rate`` NaN or above ``fault_rate``).
        """
        self._runner.list_trees(self._awake)
        floating = self._floating_roots()
        if len(self._loads) and steps > 0:  # the next prediction still knows the last contacts
            self._runner.predict()
            self._unload(len(self._runner.stepped))
            self._runner.integrate(_NO_TREES, *floating)
            self._runner.advance(steps - 1, *floating, between)
        else:
            self._runner.advance(steps, *floating, between)
        self.tick += steps

    def upload(self) -> None:
        """Bring the device's copies of the awake trees up to the host's arrays; on a CPU there is nothing to bring."""
        self._runner.list_trees(self._awake)
        self.launches.upload_step(len(self._runner.stepped))
        self.buffers.synchronize()

    def download(self) -> None:
        """Bring the host's arrays of the awake trees up to the device's, as ``predict()`` and ``integrate()`` do."""
        self.launches.download_prediction(len(self._runner.stepped))
        self.launches.download_joints(len(self._runner.stepped))
        self.buffers.synchronize()

    def use_backward_euler(self, trees: np.ndarray) -> None:
        """Use phi = 1 for ``contact_onset_duration``: trees about to be touched (``integrate()`` sees to touched)."""
        self._euler_steps[trees] = np.maximum(self._euler_steps[trees], self.onset_steps)

    def forward_kinematics(self, trees: np.ndarray | int | None = None) -> None:
        """Bring ``body_q`` and ``body_qd`` of trees (the awake ones unless given) up to their joints; no step."""
        trees = self._awake if trees is None else np.atleast_1d(trees)
        self.list_subset(trees)
        self.launches.upload_changed()
        self.launches.upload_subset_joints(len(trees))
        self.launches.forward_kinematics(len(trees))
        self.launches.download_subset_bodies(len(trees))
        self.buffers.synchronize()

    def list_subset(self, trees: np.ndarray) -> None:
        """List trees [k] for the kernels that do not work on all awake ones."""
        self._subset[: len(trees)] = trees

    def require_stepped(self, bodies: np.ndarray) -> None:
        """:class:`ValueError` unless ``bodies`` [k] move, and their trees were in the last prediction."""
        self._loads.require_stepped(np.asarray(bodies))

    def blend_towards(self, tree: int, joint_q: np.ndarray, joint_qd: np.ndarray, blend: float) -> None:
        """Move one tree towards a state elsewhere: rotations [k, 4] by ``blend`` of the way, rates [k, 3] fully."""
        blend_towards(self, tree, joint_q, joint_qd, blend)

    # ------------------------------------------------------------------ ties, wrenches, damping

    @property
    def tie_anchor(self) -> np.ndarray:
        """Where ties are held [tie, 3] m, in the world; move them as you like. See :meth:`add_tie`."""
        return self.ties.anchor

    @property
    def tie_stiffness(self) -> np.ndarray:
        """N/m [tie]; a tie of zero does nothing."""
        return self.ties.stiffness

    @property
    def tie_damping(self) -> np.ndarray:
        """N s/m [tie]."""
        return self.ties.damping

    @property
    def held_bodies(self) -> list[int]:
        """Bodies that ties of :meth:`add_tie` hold."""
        return self.ties.held_bodies

    def add_tie(self, body: int, point: np.ndarray, stiffness: float, damping: float) -> int:
        """Hold a body at ``point`` [3] m, in its own frame, by a spring [N/m] and damper [N s/m]; returns the tie.

        It pulls to ``tie_anchor`` of that tie, which starts where the point is; move it as you like.
        :class:`TieLimitError` if too many bodies are held, or this one in too many places; :class:`ValueError` for a
        berry cluster and for numbers that are not finite.
        """
        body = checked_index("body", body, len(self.model.body_mass))
        if body - self.model.tree_first[tree := self.model.body_tree[body]] >= self.model.tree_core[tree]:
            raise ValueError(f"body {body} is a berry cluster, which cannot be held; hold its bunch")
        self.forward_kinematics(np.array([tree]))
        tie = self.ties.add(body, point, self.state.body_q[body].astype(float), stiffness, damping)
        self._find_falling(self.bodies_of(np.array([tree])))
        return tie

    def remove_tie(self, body: int, tie: int) -> None:
        """Undo a tie of :meth:`add_tie`."""
        self.ties.remove(body, tie)
        self._find_falling(self.bodies_of(self.model.body_tree[[body]]))

    def joint_wrench(self, bodies: np.ndarray) -> np.ndarray:
        """Force [N] and moment [N m, about the body's origin, world axes] on bodies from their parents [n, 6].

        Of the last step, and only for bodies of trees that were awake in it. At rest it carries what hangs below.
        """
        return self.launches.joint_wrench(bodies)

    def damping_floor(self, frequency: float, phi: float | None = None) -> float:
        """Least damping ratio that a first mode of this frequency [Hz] can show: pi f (2 phi - 1) dt / substeps."""
        phi = float(self.phi.max(initial=0.5)) if phi is None else phi
        return math.pi * frequency * (2.0 * phi - 1.0) * self.dt / substeps_for(frequency, self.dt)
