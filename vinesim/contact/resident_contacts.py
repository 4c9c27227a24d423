"""Contacts of many independent trees with the static geoms of a scene, solved on the CPU or GPU that holds the trees'
arrays.

This is for batches of simulations, in which every tree is a separate world: trees do not touch each other, and no geom
moves. The contacts of a tree then form one island, no data has to return to the host between steps, and a GPU uses one
thread for each tree. Detection, rows, Delassus matrix and solve use the functions that
:class:`vinesim.contact.contact_solver.ContactSolver` launches.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from vinesim.contact.collision_arrays import PlantArrays, RigidArrays, kernel_parameters, material_pairs
from vinesim.contact.plant_capsules import plant_capsules
from vinesim.core.warp_arrays import SharedArrays, struct_fields
from vinesim.kernels.contact import broadphase, structs, tree_delassus, tree_islands, tree_narrowphase
from vinesim.kernels.contact.distance import CAPSULE, PLANE, SPHERE
from vinesim.kernels.contact.friction_law import Surface
from vinesim.kernels.contact.tree_solver import TreeSearch, TreeSystem
from vinesim.kernels.contact.tree_views import GROUP
from vinesim.kernels.graph import THREADS_PER_BLOCK, KernelGraph, KernelLaunch
from vinesim.kernels.plants import structs as plant_structs
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.device_buffers import WARP_SIZE
from vinesim.rigid.collision_geoms import PLANE_HALF_SIZE
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.physics_parameters import PhysicsParameters

FULL_BLOCK = 128
"""CUDA threads in a block, for kernels with several threads for each tree."""
AABB_BLOCK = int(structs.AABB_BLOCK)
DEFAULT_SLOTS = 8
"""Default for the largest number of contacts of one tree. This many contacts take 10 kB for each tree."""
PAIRS_PER_SLOT = 4
"""Capacity for pairs of capsules and geoms with overlapping bounding boxes, per contact slot of a tree."""
FIRST_LANES = 16
"""Number of GPU threads that share a tree with few contacts; each thread solves one row."""
WARPS = 132 * 32
"""Number of GPU warps that solve at the same time: as many as a GPU with 132 multiprocessors holds."""


class ResidentContacts:
    """Contacts of all trees of a solver with the static geoms of its model, from step to step on the solver's device.

    ``plants.advance(steps, contacts.solve)`` takes steps with these contacts. Each tree touches ground, poles, wires
    and fixed wood as it would in :class:`vinesim.world.Physics`, and no other tree. All trees must be awake, without
    cut-off parts, and with first modes slow enough for whole steps.

    Args:
        plants: trees, on any device.
        parameters: numbers of the contacts; ``dt`` must be that of ``plants``.
        slots: contacts that a tree can have at once; more are left out and counted in :attr:`dropped`.

    Raises :class:`ValueError` for trees that sleep, float or need substeps, and for geoms that move.
    """

    def __init__(
        self,
        plants: ArticulationSolver,
        parameters: PhysicsParameters = PhysicsParameters(),
        *,
        slots: int = DEFAULT_SLOTS,
    ) -> None:
        self.plants = plants
        self.parameters = parameters
        self.slots = slots
        self._device = plants.buffers.device
        model = plants.model
        self._trees = len(plants.model.tree_first)
        rigid = RigidWorld(model, parameters=parameters)
        self._check(rigid)
        self._numbers = kernel_parameters(parameters)
        self._take_over_plants(PlantArrays(model, plants, plant_capsules(model)))
        self._take_over_geoms(RigidArrays(rigid, set(), self._numbers, None))
        self._allocate()
        self._before, self._solve_most, self._solve_busy, self._after = self._make_graphs()
        self._beside = None if self._device.is_cpu else wp.Stream(self._device, priority=-1)

    def _check(self, rigid: RigidWorld) -> None:
        plants = self.plants
        if plants.dt != self.parameters.dt:
            raise ValueError(
                f"dt {self.parameters.dt} s of the contacts, {plants.dt} s of the plants: must be the same"
            )
        if len(plants.awake) < self._trees or plants.state.body_cut.any():
            raise ValueError("trees that sleep or were cut: wake all, and leave them whole")
        plants.upload()
        if (plants.tree_substeps > 1).any():
            tree = int(np.argmax(plants.tree_substeps > 1))
            raise ValueError(f"tree {tree} swings too fast for a whole step of {plants.dt} s: take a shorter dt")
        if len(rigid.geoms.id):
            raise ValueError("the scene has crates, which move: resident trees touch static geoms only")

    # ------------------------------------------------------------------ arrays

    def _on_device(self, kind: Any, source: Any, **values: Any) -> Any:
        """Returns a ``kind`` struct on the device: arrays from ``values`` where given, else copies of those of
        ``source``.
        """
        made = kind()
        for name, field in struct_fields(kind).items():
            given = values.get(name)
            if isinstance(given, np.ndarray):
                given = wp.array(given, dtype=field.dtype, device=self._device)
            setattr(made, name, wp.clone(getattr(source, name), self._device) if given is None else given)
        return made

    def _allocated(self, kind: Any, sizes: dict[str, int], width: dict[str, int]) -> Any:
        """Returns a struct of zeroed arrays, with ``sizes`` by name (default 1) and the ``width`` of 2-D arrays."""
        made = kind()
        for name, field in struct_fields(kind).items():
            size = sizes.get(name, 1)
            shape = size if field.ndim == 1 else (size, width.get(name, 1))
            setattr(made, name, wp.zeros(shape, dtype=field.dtype, device=self._device))
        return made

    def _take_over_plants(self, arrays: PlantArrays) -> None:
        rows = self.plants.buffers.arrays
        zeros = self._zeros
        self._bodies = structs.PlantBodies()
        self._bodies.parent = rows["body_parent"]
        self._bodies.tree = rows["body_tree"]
        self._bodies.is_cut = zeros(wp.bool, self._places)
        self._bodies.q, self._bodies.qd, self._bodies.qd_free = rows["body_q"], rows["body_qd"], rows["body_qd_free"]
        self._capsules = self._interleaved(arrays.capsules)
        self._capsule_states = self._allocated(
            structs.CapsuleStates, dict.fromkeys(struct_fields(structs.CapsuleStates), self._capsule_count), {}
        )

    def _interleaved(self, capsules: SharedArrays) -> Any:
        """Returns the capsules on the device. Capsule i of a tree is at ``i * trees + tree``.

        Capsules that do not collide have -1 as their body.
        """
        start = capsules.tree_start
        number = np.arange(start[-1]) - np.repeat(start[:-1], np.diff(start))
        self._capsule_count = (int(number.max(initial=-1)) + 1) * self._trees
        tree = np.repeat(np.arange(self._trees), np.diff(start))
        at = number * self._trees + tree
        given: dict[str, np.ndarray] = {}
        for name in struct_fields(structs.Capsules):
            source = getattr(capsules, name)
            if len(source) == start[-1]:
                given[name] = np.zeros((self._capsule_count, *source.shape[1:]), source.dtype)
                given[name][at] = source
        given["body"][:] = -1
        state = self.plants.state
        collides = (capsules.level == 0) | (capsules.level == 1 + state.tree_fine[tree])
        if len(state.bunch_attached):
            collides &= (capsules.bunch < 0) | state.bunch_attached[capsules.bunch]
        given["body"][at[collides]] = self.plants.buffers.slots[capsules.body[collides]]
        return self._on_device(structs.Capsules, capsules.struct, **given)

    @property
    def _places(self) -> int:
        """Number of entries of an array that has a row for each body."""
        return len(self.plants.buffers.arrays["body_parent"])

    def _zeros(self, dtype: Any, *shape: int) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self._device)

    def _take_over_geoms(self, rigid: RigidArrays) -> None:
        """Copy the static geoms to the device, with a bounding box of each geom and of each block of geoms.

        The ground's box has no lower end.
        """
        device = self._device
        self._geoms = self._on_device(structs.Geoms, rigid.geoms.struct)
        self._rigid_bodies = self._on_device(structs.RigidBodies, rigid.bodies.struct)
        self._hulls = self._on_device(structs.Hulls, rigid.hulls.struct)
        self._geom_states = self._on_device(structs.GeomStates, rigid.geom_states.struct)
        given = [self._numbers, self._geoms, self._geoms.count[1:], self._rigid_bodies]
        KernelGraph(
            KernelLaunch(broadphase.geom_aabbs, given, [self._geom_states], threads=rigid.count), device=str(device)
        )()
        low, high = (getattr(self._geom_states, name).numpy() for name in ("low", "high"))
        low[rigid.geoms.kind[: len(low)] == 0, 2] = -PLANE_HALF_SIZE
        self._geom_states.low.assign(low)
        starts = range(0, rigid.count, AABB_BLOCK)
        boxes = [(low[i : i + AABB_BLOCK].min(0), high[i : i + AABB_BLOCK].max(0)) for i in starts]
        self._static_blocks = structs.Aabbs()
        self._static_blocks.low, self._static_blocks.high = (
            wp.array(np.array(corner, np.float32), dtype=wp.vec3, device=device) for corner in zip(*boxes, strict=True)
        )
        self._pairs = wp.array(material_pairs(self.parameters), dtype=Surface, device=device)

    def _by_slot(self, dtype: Any, columns: int) -> wp.array:
        """Returns a table [tree, column] of zeros that is stored column by column, so that the entries of consecutive
        trees are adjacent in memory.
        """
        return self._zeros(dtype, columns, self._trees).transpose()

    def _allocate(self) -> None:
        trees = self._trees
        slots = self.slots
        self._groups = 1 if self._device.is_cpu else min(trees, WARPS)
        rows = 3 * slots
        pairs = PAIRS_PER_SLOT * slots
        self.candidates = self._allocated(structs.Candidates, {}, {})
        for name in ("feature", "other", "gap", "end_gap", "normal", "point"):
            setattr(self.candidates, name, self._by_slot(struct_fields(structs.Candidates)[name].dtype, 2 * pairs))
        of_all: dict[str, int] = dict.fromkeys(struct_fields(structs.Contacts), trees * slots)
        self.contacts = self._allocated(structs.Contacts, of_all | dict.fromkeys(("island", "block", "place"), 1), {})
        of_rows: dict[str, int] = dict.fromkeys(("plant_jacobian", "velocity_free", "bias", "impulse"), trees * rows)
        self.rows = self._allocated(structs.Rows, of_rows, {"plant_jacobian": 12})
        self._system = self._allocated(TreeSystem, {"free": trees * rows, "velocity": trees * rows}, {})
        self._system.matrix = self._zeros(float, trees * rows, rows)
        self._system.surface = self.contacts.surface
        self._system.impulse = self.rows.impulse
        searched = trees * rows if self._device.is_cpu else 1  # a GPU searches in registers
        self._search = self._allocated(
            TreeSearch, dict.fromkeys(struct_fields(TreeSearch), searched), {"factor": rows + 1}
        )
        busy_rows = self._groups * rows
        self._dense = self._allocated(TreeSystem, dict.fromkeys(struct_fields(TreeSystem), busy_rows), {"matrix": rows})
        self._dense_search = self._allocated(
            TreeSearch, dict.fromkeys(struct_fields(TreeSearch), busy_rows), {"factor": rows + 1}
        )
        of_all = dict.fromkeys(struct_fields(structs.WarmStart), trees * slots) | {"count": trees}
        self._warm_start = self._allocated(structs.WarmStart, of_all, {})
        of_trees = dict.fromkeys(struct_fields(tree_narrowphase.TreeContacts), trees)
        of_trees |= dict.fromkeys(("near_total", "busy_count"), 1) | {"loaded": trees * slots}
        of_trees |= dict.fromkeys(("near", "near_place", "found"), trees * pairs)
        self._tree_contacts = self._allocated(tree_narrowphase.TreeContacts, of_trees, {})
        self._response = self._allocated(tree_delassus.ResponseRows, dict.fromkeys(("a", "alpha"), trees * slots), {})
        self._was_in_contact = self._zeros(wp.bool, trees)

    # ------------------------------------------------------------------ kernels

    def _make_graphs(self) -> tuple[KernelGraph, KernelGraph, KernelGraph, KernelGraph]:
        """Returns the graphs of a step's kernels: before the solves, the solve of most trees, the solve of trees with
        many contacts, and after the solves.
        """
        p = self.parameters
        plants = self.plants.launches
        trees = self._trees
        fill = plants.fill_resident
        s = plant_structs
        arrays = plants.resident_arrays
        device = str(self._device)
        parameters = self._numbers
        capsules = self._capsules
        geoms = self._geoms
        model = fill(s.ArticulationModel)
        forces = fill(s.AppliedForces)
        joints = fill(s.JointState)
        bodies = fill(s.BodyState)
        factors = fill(s.Factors)
        scratch = fill(s.Scratch)
        prediction = fill(s.Prediction)
        work = fill(s.WrenchScratch)
        onset = self.plants.onset_steps
        contacts = self._tree_contacts
        width = 3 * self.slots
        entries = -(-trees // GROUP) * GROUP
        numbers = (p.solver_sweeps, p.solver_newton_steps, p.solver_newton_contacts, p.solver_tolerance)
        few = self.slots
        lanes = 1
        solve = tree_islands.begin_trees
        of_most = trees
        first_lanes: tuple[int, ...] = ()
        search: tuple[Any, ...] = (self._search,)
        if not self._device.is_cpu:
            few = FIRST_LANES // 3
            lanes = WARP_SIZE
            solve = tree_islands.solve_small_trees
            of_most = -(-trees * FIRST_LANES // FULL_BLOCK) * FULL_BLOCK
            first_lanes = (FIRST_LANES,)
            search = ()

        def launch(kernel: Any, threads: int, *given: Any) -> KernelLaunch:
            block = THREADS_PER_BLOCK if threads == trees else FULL_BLOCK
            return KernelLaunch(kernel, given, threads=threads, block=block)

        is_round = np.isin(self._geoms.kind.numpy(), (PLANE, SPHERE, CAPSULE)).all()
        find = tree_narrowphase.find_round_tree_contacts if is_round else tree_narrowphase.find_tree_contacts
        compliances = fill(tree_delassus.BodyCompliances, P="M", Q="H", R="J")  # unused memory after the prediction
        before = [
            launch(
                tree_narrowphase.list_near_pairs,
                trees,
                parameters,
                capsules,
                geoms,
                trees,
                self._bodies,
                self._geom_states,
                self._static_blocks,
                self._capsule_states,
                contacts,
            ),
            launch(
                find,
                trees * self.slots,
                parameters,
                capsules,
                geoms,
                trees,
                trees * self.slots,
                self._bodies,
                self._capsule_states,
                self._rigid_bodies,
                self._hulls,
                self._geom_states,
                contacts,
                self.candidates,
            ),
            launch(
                tree_narrowphase.number_tree_contacts, trees, trees, self.slots, few, contacts, self.contacts.source
            ),
            launch(
                tree_islands.predict_impacted_trees,
                trees,
                plants.parameters,
                model,
                onset,
                contacts.is_impact,
                forces,
                joints,
                arrays["phi_used"],
                arrays["tree_euler_steps"],
                bodies,
                factors,
                scratch,
                prediction,
            ),
            launch(
                tree_islands.write_tree_rows,
                entries * self.slots,
                parameters,
                self._pairs,
                capsules,
                geoms,
                trees,
                self.slots,
                self._bodies,
                self._rigid_bodies,
                self.candidates,
                self._warm_start,
                contacts,
                self.contacts,
                self.rows,
            ),
            launch(
                tree_delassus.respond_at_contacts,
                trees,
                model,
                arrays["body_branches"],
                trees,
                factors,
                self.contacts,
                self.rows,
                contacts,
                compliances,
                self._response,
            ),
            launch(
                tree_delassus.write_delassus,
                entries * self.slots,
                model,
                trees,
                width,
                factors,
                contacts,
                self.contacts,
                self.rows,
                compliances,
                self._response,
                self._system,
            ),
        ]
        solve_most = launch(solve, of_most, *numbers, trees, width, *first_lanes, contacts, self._system, *search)
        solve_busy = launch(
            tree_islands.solve_busy_trees,
            self._groups * lanes,
            *numbers,
            trees,
            width,
            lanes,
            self._groups,
            contacts,
            self._system,
            self._dense,
            self._dense_search,
        )
        after = launch(
            tree_islands.apply_tree_impulses,
            trees,
            parameters,
            model,
            arrays["body_branches"],
            onset,
            trees,
            width,
            self._bodies.q,
            self.rows,
            self._system,
            factors,
            self._was_in_contact,
            arrays["tree_euler_steps"],
            contacts,
            self.contacts,
            self._warm_start,
            arrays["body_wrench"],
            work,
            scratch,
            prediction,
        )
        return (
            KernelGraph(*before, device=device),
            KernelGraph(solve_most, device=device),
            KernelGraph(solve_busy, device=device),
            KernelGraph(after, device=device),
        )

    def solve(self) -> None:
        """Launch the kernels of the contacts of one step. An argument of :meth:`ArticulationSolver.advance`, which
        calls it between prediction and integration."""
        self._before()
        if self._beside is None:
            self._solve_most()
            self._solve_busy()
        else:  # on two streams: few trees are busy, but each takes long
            with wp.ScopedStream(self._beside):
                self._solve_busy()
            self._solve_most()
            self._device.stream.wait_stream(self._beside)
        self._after()

    # ------------------------------------------------------------------ results

    @property
    def count(self) -> np.ndarray:
        """[tree] Number of contacts in the last step, including contacts without force."""
        return self._tree_contacts.count.numpy()

    @property
    def dropped(self) -> int:
        """Number of contacts left out since the start because a tree had no slot for them."""
        return int(self._tree_contacts.dropped.numpy().sum())

    @property
    def sweeps(self) -> np.ndarray:
        """[tree] Number of sweeps in the last solve; 0 for trees without contact."""
        return np.where(self.count > 0, self._tree_contacts.sweeps.numpy(), 0)

    @property
    def force(self) -> np.ndarray:
        """[tree, 3] Sum of the forces of all contacts on each tree in the last step, N."""
        force = self.contacts.force.numpy().reshape(self.slots, self._trees, 3)
        return (force * (np.arange(self.slots)[:, None] < self.count)[..., None]).sum(0)
