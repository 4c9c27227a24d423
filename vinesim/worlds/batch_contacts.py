"""Contacts of the trees of a batch of worlds with robots, boxes and static geoms, solved on the CPU or GPU that holds
the trees' arrays.

The trees of a world do not touch each other. The contacts of a world form one island, no data has to return to the host
between steps, and a GPU uses one thread for each tree or world. Detection, rows, contact law and shapes use the
functions that :class:`vinesim.contact.contact_solver.ContactSolver` launches.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from vinesim.contact.collision_arrays import PlantArrays, RigidArrays, kernel_parameters, material_pairs
from vinesim.contact.plant_capsules import plant_capsules
from vinesim.core.warp_arrays import SharedArrays, struct_fields
from vinesim.kernels.contact import broadphase, structs
from vinesim.kernels.contact.distance import CAPSULE, PLANE, SPHERE
from vinesim.kernels.contact.friction_law import Surface
from vinesim.kernels.graph import THREADS_PER_BLOCK, KernelGraph, KernelLaunch
from vinesim.kernels.plants import structs as plant_structs
from vinesim.kernels.worlds import contact_step, delassus, free_bunches, narrowphase, reset, rigid_state
from vinesim.kernels.worlds.dense_solver import WorldSearch, WorldSystem
from vinesim.kernels.worlds.views import GROUP
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.device_buffers import WARP_SIZE
from vinesim.rigid.collision_geoms import PLANE_HALF_SIZE
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.worlds.rigid_batch import RigidBatch

FULL_BLOCK = 128
"""CUDA threads in a block, for kernels with several threads for each tree."""
AABB_BLOCK = int(structs.AABB_BLOCK)
DEFAULT_SLOTS = 8
"""Default for the largest number of contacts of one world. This many contacts take 10 kB for each world."""
PAIRS_PER_SLOT = 4
"""Capacity for pairs of capsules and geoms with overlapping bounding boxes of one tree, per contact slot of a world."""
FIRST_LANES = 16
"""Number of GPU threads that share a world with few contacts; each thread solves one row."""
WARPS = 132 * 32
"""Number of GPU warps that solve at the same time: as many as a GPU with 132 multiprocessors holds."""


class BatchContacts:
    """Contacts of all trees of a solver, from step to step on the solver's device.

    ``plants.advance(steps, contacts.solve)`` takes steps with these contacts. Each tree touches ground, poles, wires
    and fixed wood as it would in :class:`vinesim.world.Physics`, and the rigid bodies of its world, but no other tree.
    All trees must be awake, without cut-off parts at the start, and with first modes slow enough for whole steps.

    Args:
        plants: trees, on any device. Tree t of world w has the number ``t * worlds + w``.
        parameters: numbers of the contacts; ``dt`` must be that of ``plants``.
        slots: contacts that a world can have at once; more are left out and counted in :attr:`dropped`.
        bodies: rigid bodies of all worlds that can move. None: each tree is a world of its own, without such bodies.

    Raises :class:`ValueError` for trees that sleep, float or need substeps, and for numbers of trees that do not fit.
    """

    def __init__(
        self,
        plants: ArticulationSolver,
        parameters: PhysicsParameters = PhysicsParameters(),
        *,
        slots: int = DEFAULT_SLOTS,
        bodies: RigidBatch | None = None,
    ) -> None:
        self.plants = plants
        self.parameters = parameters
        self.slots = slots
        self.bodies = bodies
        self._device = plants.buffers.device
        model = plants.model
        self._trees = len(plants.model.tree_first)
        self.worlds = self._trees if bodies is None else bodies.count
        rigid = RigidWorld(model, parameters=parameters) if bodies is None else bodies.rigid
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
        if self.bodies is None and len(rigid.geoms.id):
            raise ValueError("the scene has crates, which move: give the rigid bodies of all worlds")
        if self._trees % self.worlds:
            raise ValueError(f"{self._trees} trees in {self.worlds} worlds: all worlds need as many trees")

    # ------------------------------------------------------------------ arrays

    def _on_device(self, kind: Any, source: Any, /, **values: Any) -> Any:
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
        """Copy the geoms to the device: first the geoms that can move, of all worlds, then the static geoms. Each
        static geom and each block of static geoms has a bounding box.

        The ground's box has no lower end.
        """
        device = self._device
        moving = rigid.movable
        static = slice(moving, rigid.count)
        copies = moving * self.worlds
        of_pose = rigid.world.ngeom
        given: dict[str, Any] = {"count": np.array([copies, copies + rigid.count - moving], np.int32)}
        for name in struct_fields(structs.Geoms):
            if name != "count":
                values = getattr(rigid.geoms, name)
                given[name] = np.concatenate([np.repeat(values[:moving], self.worlds, 0), values[static]])
        given["id"][:copies] = of_pose + np.arange(copies)
        self._moving = moving
        self._moving_geoms = wp.array(rigid.geoms.id[:moving], dtype=wp.int32, device=device)
        self._first_pose = of_pose
        self._geoms = self._on_device(structs.Geoms, rigid.geoms.struct, **given)
        self._hulls = self._on_device(structs.Hulls, rigid.hulls.struct)
        self._take_over_bodies(rigid, copies)
        self._geom_states = self._allocated(
            structs.GeomStates, dict.fromkeys(struct_fields(structs.GeomStates), len(given["id"])), {}
        )
        arguments = [self._numbers, self._geoms, self._geoms.count[1:], self._rigid_bodies]
        KernelGraph(
            KernelLaunch(broadphase.geom_aabbs, arguments, [self._geom_states], threads=len(given["id"])),
            device=str(device),
        )()
        self.free = narrowphase.FreeBunches()
        """Bunches that have left their vines."""
        slots = max(int(rigid.bunch_of_geom.max(initial=-1)) + 1, 1)
        self.free.bunch = wp.full((self.worlds, slots), -1, dtype=wp.int32, device=device)
        self.free.passing = self._zeros(wp.int32, self._trees, slots)
        self.free.slot = wp.array(rigid.bunch_of_geom[:moving], dtype=wp.int32, device=device)
        low, high = (getattr(self._geom_states, name).numpy() for name in ("low", "high"))
        low[given["kind"] == PLANE, 2] = -PLANE_HALF_SIZE
        self._geom_states.low.assign(low)
        starts = range(copies, len(low), AABB_BLOCK)
        boxes = [(low[i : i + AABB_BLOCK].min(0), high[i : i + AABB_BLOCK].max(0)) for i in starts]
        self._static_blocks = structs.Aabbs()
        self._static_blocks.low, self._static_blocks.high = (
            wp.array(np.array(corner, np.float32).reshape(-1, 3), dtype=wp.vec3, device=device)
            for corner in (zip(*boxes, strict=True) if boxes else ((), ()))
        )
        self._world_boxes = self._allocated(structs.Aabbs, {"low": self.worlds, "high": self.worlds}, {})
        self._pairs = wp.array(material_pairs(self.parameters), dtype=Surface, device=device)

    def _take_over_bodies(self, rigid: RigidArrays, copies: int) -> None:
        """Allocate the arrays of the rigid bodies of all worlds. Poses of static geoms come first, then the poses of
        ``copies`` geoms that can move."""
        source = rigid.bodies
        self._rigid_count = rigid.world.nbody if self.bodies is not None else 0
        self._dofs = rigid.world.nv if self.bodies is not None else 0
        if self.bodies is None:
            self._rigid_bodies = self._on_device(structs.RigidBodies, source.struct)
            return
        bodies, dofs = self.worlds * self._rigid_count, self.worlds * self._dofs
        tiled = {
            "xpos": np.concatenate([source.xpos, np.zeros((copies, 3))]),
            "xmat": np.concatenate([source.xmat, np.tile(np.eye(3), (copies, 1, 1))]),
            "cvel": np.zeros((bodies, 6)),
            "cdof": np.zeros((dofs, 6)),
            "subtree_com": np.tile(source.subtree_com, (self.worlds, 1)),
        }
        tiled |= {name: np.zeros(dofs) for name in ("velocity_free", "correction", "correction_before")}
        self._rigid_bodies = self._on_device(structs.RigidBodies, source.struct, **tiled)

    def _by_slot(self, dtype: Any, columns: int) -> wp.array:
        """Returns a table [tree, column] of zeros that is stored column by column, so that the entries of consecutive
        trees are adjacent in memory.
        """
        return self._zeros(dtype, columns, self._trees).transpose()

    def _allocate(self) -> None:
        trees = self._trees
        worlds = self.worlds
        slots = self.slots
        dofs = max(self._dofs, 1)
        self._groups = 1 if self._device.is_cpu else min(worlds, WARPS)
        rows = 3 * slots
        pairs = PAIRS_PER_SLOT * slots
        self.candidates = self._allocated(structs.Candidates, {}, {})
        for name in ("feature", "other", "gap", "end_gap", "normal", "point"):
            setattr(self.candidates, name, self._by_slot(struct_fields(structs.Candidates)[name].dtype, 2 * pairs))
        of_all: dict[str, int] = dict.fromkeys(struct_fields(structs.Contacts), worlds * slots)
        self.contacts = self._allocated(structs.Contacts, of_all | dict.fromkeys(("island", "block", "place"), 1), {})
        of_rows: dict[str, int] = dict.fromkeys(("plant_jacobian", "velocity_free", "bias", "impulse"), worlds * rows)
        of_rows |= dict.fromkeys(("rigid_jacobian", "rigid_response"), worlds * slots if self._dofs else 1)
        width = {"plant_jacobian": 12, "rigid_jacobian": dofs, "rigid_response": dofs}
        self.rows = self._allocated(structs.Rows, of_rows, width)
        self._system = self._allocated(WorldSystem, {"free": worlds * rows, "velocity": worlds * rows}, {})
        self._system.matrix = self._zeros(float, worlds * rows, rows)
        self._system.surface = self.contacts.surface
        self._system.impulse = self.rows.impulse
        searched = worlds * rows if self._device.is_cpu else 1  # a GPU searches in registers
        self._search = self._allocated(
            WorldSearch, dict.fromkeys(struct_fields(WorldSearch), searched), {"factor": rows + 1}
        )
        busy_rows = self._groups * rows
        self._dense = self._allocated(
            WorldSystem, dict.fromkeys(struct_fields(WorldSystem), busy_rows), {"matrix": rows}
        )
        self._dense_search = self._allocated(
            WorldSearch, dict.fromkeys(struct_fields(WorldSearch), busy_rows), {"factor": rows + 1}
        )
        of_all = dict.fromkeys(struct_fields(structs.WarmStart), worlds * slots) | {"count": worlds}
        self._warm_start = self._allocated(structs.WarmStart, of_all, {})
        sizes = dict.fromkeys(struct_fields(narrowphase.WorldContacts), trees)
        sizes |= dict.fromkeys(("count", "busy", "dropped", "sweeps"), worlds)
        sizes |= dict.fromkeys(("near_total", "busy_count"), 1)
        sizes |= dict.fromkeys(("tree", "loaded"), worlds * slots)
        sizes |= dict.fromkeys(("near", "near_place", "found"), trees * pairs)
        self._world_contacts = self._allocated(narrowphase.WorldContacts, sizes, {})
        self._response = self._allocated(delassus.ResponseRows, dict.fromkeys(("a", "alpha"), worlds * slots), {})
        self._rigid_inverse = self._zeros(wp.float64, worlds * self._dofs or 1, dofs)
        self._was_in_contact = self._zeros(wp.bool, trees)
        self.friction_scale = wp.ones(worlds, dtype=wp.float64, device=self._device)
        """[world] Factor of the coefficients of friction of all contacts of the world's plants."""

    # ------------------------------------------------------------------ kernels

    def _make_graphs(self) -> tuple[KernelGraph, KernelGraph, KernelGraph, KernelGraph]:
        """Returns the graphs of a step's kernels: before the solves, the solve of most worlds, the solve of worlds with
        many contacts, and after the solves.
        """
        device = str(self._device)
        before = [*self._detection(), *self._systems()]
        most, busy = self._solves()
        return (
            KernelGraph(*before, device=device),
            KernelGraph(most, device=device),
            KernelGraph(busy, device=device),
            KernelGraph(*self._endings(), device=device),
        )

    def _launch(self, kernel: Any, threads: int, *given: Any) -> KernelLaunch:
        """Returns a launch; kernels with a thread for each tree or world have small blocks."""
        block = THREADS_PER_BLOCK if threads in (self._trees, self.worlds) else FULL_BLOCK
        return KernelLaunch(kernel, given, threads=threads, block=block)

    def _detection(self) -> list[KernelLaunch]:
        """Returns the launches that find the contacts."""
        trees = self._trees
        worlds = self.worlds
        parameters = self._numbers
        contacts = self._world_contacts
        is_round = np.isin(self._geoms.kind.numpy(), (PLANE, SPHERE, CAPSULE)).all()
        find = narrowphase.find_round_contacts if is_round else narrowphase.find_contacts
        few = self.slots if self._device.is_cpu else FIRST_LANES // 3
        launches = []
        if self.bodies is not None:
            source = self.bodies.fill(rigid_state.WarpState)
            items = self._moving + self._rigid_count + self._dofs
            shape = (worlds, self._moving, self._rigid_count, self._dofs)
            launches = [
                self._launch(
                    rigid_state.take_rigid_state,
                    worlds * items,
                    self.parameters.dt,
                    worlds,
                    self._moving_geoms,
                    self._first_pose,
                    source,
                    self._rigid_bodies,
                ),
                self._launch(
                    narrowphase.move_geoms,
                    worlds,
                    parameters,
                    self._geoms,
                    *shape,
                    self.free,
                    self._rigid_bodies,
                    self._geom_states,
                    self._world_boxes,
                ),
            ]
        if (self.free.slot.numpy() >= 0).any():
            launches.append(
                self._launch(
                    free_bunches.end_passing,
                    trees,
                    worlds,
                    trees,
                    self._capsules,
                    self._geoms,
                    self._hulls,
                    self._bodies,
                    self._rigid_bodies,
                    self._geom_states,
                    self.free,
                )
            )
        return [
            *launches,
            self._launch(
                narrowphase.list_near_pairs,
                trees,
                parameters,
                self._capsules,
                self._geoms,
                trees,
                worlds,
                self._bodies,
                self._geom_states,
                self._world_boxes,
                self._static_blocks,
                self.free,
                self._capsule_states,
                contacts,
            ),
            self._launch(
                find,
                trees * self.slots,
                parameters,
                self._capsules,
                self._geoms,
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
            self._launch(
                narrowphase.number_contacts, worlds, trees, worlds, self.slots, few, contacts, self.contacts.source
            ),
        ]

    def _systems(self) -> list[KernelLaunch]:
        """Returns the launches that write the contact system of each world."""
        worlds = self.worlds
        dofs = self._dofs
        plants = self.plants.launches
        fill = plants.fill_resident
        s = plant_structs
        arrays = plants.resident_arrays
        contacts = self._world_contacts
        model = fill(s.ArticulationModel)
        factors = fill(s.Factors)
        entries = -(-worlds // GROUP) * GROUP * self.slots
        launches = [
            self._launch(
                contact_step.predict_impacted_trees,
                self._trees,
                plants.parameters,
                model,
                self.plants.onset_steps,
                contacts.is_impact,
                fill(s.AppliedForces),
                fill(s.JointState),
                arrays["phi_used"],
                arrays["tree_euler_steps"],
                fill(s.BodyState),
                factors,
                fill(s.Scratch),
                fill(s.Prediction),
            ),
            self._launch(
                contact_step.write_world_rows,
                entries,
                self._numbers,
                self._pairs,
                self._capsules,
                self._geoms,
                worlds,
                self.slots,
                self._rigid_count,
                dofs,
                self.friction_scale,
                self._bodies,
                self._rigid_bodies,
                self.candidates,
                self._warm_start,
                contacts,
                self.contacts,
                self.rows,
            ),
            self._launch(
                delassus.respond_at_contacts,
                self._trees,
                model,
                arrays["body_branches"],
                worlds,
                dofs,
                factors,
                self.contacts,
                self.rows,
                contacts,
                self._compliances,
                self._response,
            ),
        ]
        if self.bodies is not None:
            mass = self.bodies.effective_mass()
            launches.append(
                self._launch(
                    rigid_state.invert_effective_mass, worlds, mass, worlds, dofs, contacts, self._rigid_inverse
                )
            )
        return [
            *launches,
            self._launch(
                delassus.write_delassus,
                entries,
                model,
                self._geoms,
                worlds,
                3 * self.slots,
                dofs,
                factors,
                contacts,
                self.contacts,
                self._compliances,
                self._response,
                self._rigid_inverse,
                self.rows,
                self._system,
            ),
        ]

    @property
    def _compliances(self) -> delassus.BodyCompliances:
        """Memory that the prediction of a step does not use any more when its contacts are solved."""
        return self.plants.launches.fill_resident(delassus.BodyCompliances, P="M", Q="H", R="J")

    def _solves(self) -> tuple[KernelLaunch, KernelLaunch]:
        """Returns the launch that solves most worlds, and the one that solves worlds with many contacts."""
        p = self.parameters
        worlds = self.worlds
        numbers = (p.solver_sweeps, p.solver_newton_steps, p.solver_newton_contacts, p.solver_tolerance)
        width = 3 * self.slots
        contacts = self._world_contacts
        if self._device.is_cpu:
            most = self._launch(
                contact_step.begin_worlds, worlds, *numbers, worlds, width, contacts, self._system, self._search
            )
        else:
            threads = -(-worlds * FIRST_LANES // FULL_BLOCK) * FULL_BLOCK
            most = self._launch(
                contact_step.solve_small_worlds, threads, *numbers, worlds, width, FIRST_LANES, contacts, self._system
            )
        lanes = 1 if self._device.is_cpu else WARP_SIZE
        busy = self._launch(
            contact_step.solve_busy_worlds,
            self._groups * lanes,
            *numbers,
            worlds,
            width,
            lanes,
            self._groups,
            contacts,
            self._system,
            self._dense,
            self._dense_search,
        )
        return most, busy

    def _endings(self) -> list[KernelLaunch]:
        """Returns the launches that apply the impulses."""
        worlds = self.worlds
        plants = self.plants.launches
        fill = plants.fill_resident
        s = plant_structs
        arrays = plants.resident_arrays
        contacts = self._world_contacts
        launches = [
            self._launch(
                contact_step.apply_impulses_to_trees,
                self._trees,
                self._numbers,
                fill(s.ArticulationModel),
                arrays["body_branches"],
                self.plants.onset_steps,
                worlds,
                3 * self.slots,
                self._dofs,
                self._bodies.q,
                self.rows,
                self._system,
                fill(s.Factors),
                self._was_in_contact,
                arrays["tree_euler_steps"],
                contacts,
                self.contacts,
                self._warm_start,
                arrays["body_wrench"],
                fill(s.WrenchScratch),
                fill(s.Scratch),
                fill(s.Prediction),
            ),
            self._launch(
                contact_step.end_worlds, worlds, worlds, self._trees, self.contacts, contacts, self._warm_start
            ),
        ]
        if self.bodies is not None:
            launches.append(
                self._launch(
                    contact_step.add_contact_efforts,
                    worlds * self._dofs,
                    self._numbers,
                    worlds,
                    self._dofs,
                    self.rows,
                    self.contacts,
                    self._geoms.count,
                    contacts,
                    self.bodies.data.qacc,
                    self.bodies.applied,
                    self.bodies.likely_acceleration,
                )
            )
        return launches

    def forget(self, resets: wp.array) -> KernelLaunch:
        """Returns the launch after which the next step of some worlds begins without contacts. ``resets``: bool
        [world], which worlds."""
        before = (self._world_contacts, self._warm_start, self._was_in_contact, self._rigid_bodies)
        return self._launch(reset.forget_contacts, self.worlds, self.worlds, self._dofs, resets, *before)

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

    def lists(self) -> tuple[structs.Contacts, narrowphase.WorldContacts]:
        """Returns the contacts of the last step, for kernels: entry i of a world is at ``i * worlds + world``."""
        return self.contacts, self._world_contacts

    @property
    def geoms(self) -> structs.Geoms:
        """Geoms that plants touch, for kernels: geom m of a world that can move is at ``m * worlds + world``; static
        geoms follow."""
        return self._geoms

    @property
    def rigid_bodies(self) -> structs.RigidBodies:
        """MuJoCo's arrays of all worlds as the contacts read them, for kernels."""
        return self._rigid_bodies

    @property
    def capsules(self) -> structs.Capsules:
        """Collision capsules of the plants, for kernels. Capsule i of a tree is at ``i * trees + tree``; an entry with
        the body -1 is no capsule."""
        return self._capsules

    @property
    def is_cut(self) -> wp.array:
        """[body] bool, whether a body has been cut off since the start, for kernels."""
        return self._bodies.is_cut

    @property
    def count(self) -> np.ndarray:
        """[world] Number of contacts in the last step, including contacts without force."""
        return self._world_contacts.count.numpy()

    @property
    def dropped(self) -> np.ndarray:
        """[world] Number of contacts and near pairs left out since the start because there was no room for them."""
        return self._world_contacts.dropped.numpy()

    @property
    def sweeps(self) -> np.ndarray:
        """[world] Number of sweeps in the last solve; 0 for worlds without contact."""
        return np.where(self.count > 0, self._world_contacts.sweeps.numpy(), 0)

    @property
    def force(self) -> np.ndarray:
        """[world, 3] Sum of the forces of all contacts on the plants of each world in the last step, N."""
        force = self.contacts.force.numpy().reshape(self.slots, self.worlds, 3)
        return (force * (np.arange(self.slots)[:, None] < self.count)[..., None]).sum(0)
