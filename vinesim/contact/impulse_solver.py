"""Solves all contacts of a step at once: islands, Jacobians, Delassus matrix, projected Gauss-Seidel, warm start.

The stages of :meth:`ImpulseSolver.solve` follow the kernels: ``islands``, ``jacobians``, ``row_response``,
``delassus``, ``projected_gauss_seidel`` (with the steps of ``newton``), ``forces``.
"""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from vinesim.contact.collision_arrays import RigidArrays, material_pairs
from vinesim.contact.detection import ContactDetection
from vinesim.contact.row_response import RowResponse
from vinesim.core import frames
from vinesim.core.warp_arrays import SharedArrays, share, zeros
from vinesim.kernels.contact import delassus, forces, islands, jacobians, projected_gauss_seidel, structs
from vinesim.kernels.contact.friction_law import Steps, Surface
from vinesim.kernels.contact.island_system import IslandSystem
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.plants.articulation_solver import BLOW_DURATION, ArticulationSolver
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.wires.deflected_wires import DeflectedWires, WireContacts

MATRIX_CONTACTS = 16
"""Initial capacity [contacts in a block] of the matrices. They grow if blocks are larger."""
MIN_BLOW_SPEED = 0.02
"""[m/s] A contact that closes more slowly is no blow: its force is that of the step. TUNED"""
BLOW_SWEEPS = 100
"""Largest number of sweeps of :func:`pressing_impulses`. TUNED: ten are usual."""
BLOW_TOLERANCE = 1e-3
"""[1] The sweeps end when no impulse changes by more than this share of the largest one."""
MAX_HALVINGS = 8
"""Number of times that impulses which add energy are halved before they are left out. GUESSED"""
REMOVED_GEOM = np.iinfo(np.int32).max
"""Index that the stored impulses of the last step (warm start) have for a geom that no longer exists."""


class ImpulseSolver:
    """Finds the contact impulses between plants and rigid bodies, and their effect on both."""

    def __init__(
        self,
        plants: ArticulationSolver,
        rigid: RigidWorld,
        detection: ContactDetection,
        parameters: PhysicsParameters,
        kernel_parameters: structs.Parameters,
        wires: DeflectedWires | None = None,
    ) -> None:
        """``detection`` finds the candidates. ``wires``: the trellis wires that deflect under contact forces; if None,
        all wires are rigid.
        """
        self._detection = detection
        self._counters = counters = detection.counters
        self._wires = None if wires is None else WireContacts(wires)
        self._at_wires = np.zeros(0, int)
        self.plants = plants
        self.rigid = rigid
        self.parameters = parameters
        self._kernel_parameters = kernel_parameters
        self._pairs = material_pairs(parameters)
        n = self.capacity = parameters.contact_capacity
        self.response = response = RowResponse(plants, n, counters)
        slots = {"body_slot": response.body_slot, "other_slot": response.other_slot}
        self.contacts = SharedArrays.zeros(structs.Contacts, n, **slots)
        self.warm_start = SharedArrays.zeros(structs.WarmStart, n, count=np.zeros(1, np.int32))
        listed = {"body": response.body, "tree_end": response.tree_end}
        self.touched = SharedArrays.zeros(structs.TouchedBodies, 2 * n + 1, **listed)
        self._island_arrays = {
            name: np.zeros(n + 1, np.int32)
            for name in (
                "start",
                "first_block",
                "block_start",
                "row_start",
                "matrix_start",
                "rigid_start",
                "system_start",
                "contact",
                "label",
                "block_label",
                "first_dof",
                "sweeps",
            )
        }
        self._matrix = np.zeros(9 * MATRIX_CONTACTS * n)
        self._row_arrays = {
            "plant_jacobian": response.jacobian,
            "velocity_free": np.zeros(3 * n),
            "bias": np.zeros(3 * n),
            "impulse": np.zeros(3 * n),
        }
        self._place_arrays = {
            "surface": zeros(Surface, (n,)),
            "steps": zeros(Steps, (n,)),
            "pressed": np.zeros(n, np.int32),
        }
        for name in ("free", "impulse", "impulse_first", "impulse_before", "direction"):
            self._place_arrays[name] = np.zeros(10 * n)  # a block of one contact has eight rows
        self._rigid_spans = np.zeros((n, 2), np.int32)
        self._most_contacts = 0
        self._columns = 0
        # _rigid_spans [contact, 2]: first degree of freedom at which the contact's rigid rows may differ from 0, and
        # the end of that range. _most_contacts: the largest number of contacts in one solve. _columns: length of their
        # rows.
        self._memory: dict[str, np.ndarray] = {}
        """Arrays that :meth:`_kept` reuses, by name."""
        self._wrench = np.zeros((2 * n, 6))
        self.bodies = np.zeros(0, np.int32)
        """[n] Indices of the plant bodies in contact, sorted.

        ``bodies``, ``wrenches`` and ``rigid_force`` are views that the next solve overwrites.
        """
        self.wrenches = np.zeros((0, 6))
        """[n, 6] Force (N) and torque (N m) of the contacts on each of ``bodies``, at the body's origin, world axes."""
        self.rigid_force: np.ndarray | None = None
        """[dof] Generalised force (N or N m) of the contacts with plants on the rigid world. None without contact."""
        self._padded_rows = 0
        """Number of rows of all blocks in the last solve, including the rows that pad the blocks."""
        self.unfinished = 0
        """Number of times that the solve of an island ended at the largest number of sweeps, perhaps outside its
        tolerance."""

    def set_rigid_world(self, rigid_arrays: RigidArrays, previous: RigidArrays | None) -> None:
        """Use a rigid world that was recompiled. The warm start is kept; its geoms are matched by name."""
        self.rigid_arrays = rigid_arrays
        if previous is not None:
            at = {name: i for i, name in enumerate(rigid_arrays.names)}
            other = self.warm_start.other
            for k, geom in enumerate(other[: self.warm_start.count[0]].tolist()):
                if 0 <= geom < len(previous.names):
                    other[k] = at.get(previous.names[geom], REMOVED_GEOM)
        self._allocate()
        self.make_graphs()

    def renumber_geoms(self, number: np.ndarray) -> None:
        """Renumber the geoms of the warm start. ``number`` [geom]: new index of each former geom; -1 for a removed
        geom."""
        other = self.warm_start.other[: self.warm_start.count[0]]
        of_geoms = (other >= 0) & (other != REMOVED_GEOM)
        now = number[other[of_geoms]]
        other[of_geoms] = np.where(now >= 0, now, REMOVED_GEOM)

    def _allocate(self) -> None:
        """Allocate the arrays whose size depends on the rigid world or on the matrices of the blocks.

        The large arrays reuse memory from earlier allocations: new pages took 4 ms when an actor joined. Every solve
        overwrites the entries that it reads. Rows of rigid bodies are 0 outside of their spans.
        """
        world = self.rigid.mj_model
        for name in ("rigid_jacobian", "rigid_response"):
            if name in self._memory:
                self._memory[name][: 3 * self._most_contacts * self._columns] = 0.0
        self._rigid_spans[:] = self._most_contacts = 0
        self._columns = world.nv
        self.rows = SharedArrays(
            structs.Rows,
            rigid_jacobian=self._kept("rigid_jacobian", (self.capacity, world.nv, 3)),
            rigid_response=self._kept("rigid_response", (self.capacity, world.nv, 3)),
            delassus=self._matrix,
            **self._row_arrays,
        )
        self.system = SharedArrays(
            IslandSystem,
            **self._place_arrays,
            jacobian=self._kept("jacobian", (self.capacity * world.nv, 3)),
            response=self._kept("response", (self.capacity * world.nv, 3)),
            velocity=np.zeros(world.nv),
            rigid_force=np.zeros(world.nv),
            matrix=self._kept("matrix", self._matrix.shape),
            solution=self._kept("solution", (self.capacity * (1 + world.nv), 3)),
            rigid_matrix=np.zeros((world.nv, 1 + world.nv)),
        )
        labels = np.zeros(2 * world.ntree, np.int32)  # see EffectiveMass.island_labels
        dofs = np.zeros(world.nv, np.int32)
        self.islands = SharedArrays(structs.Islands, rigid_last_contact=labels, dof=dofs, **self._island_arrays)

    def _kept(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Returns an array of shape ``shape`` in the memory kept under ``name``.

        The memory is twice as large as the request for which it was allocated: pages that nothing has touched take no
        physical memory.
        """
        size = math.prod(shape)
        memory = self._memory.get(name)
        if memory is None or len(memory) < size:
            memory = self._memory[name] = np.zeros(2 * size)
        return memory[:size].reshape(shape)

    @property
    def island_count(self) -> int:
        """Number of islands in the last solve."""
        return int(self._counters[structs.ISLANDS])

    @property
    def sweeps(self) -> int:
        """Number of sweeps of the island that took the most sweeps in the last solve."""
        return int(self.islands.sweeps[: self.island_count].max(initial=0))

    def clear(self) -> None:
        """Set the results to those of a step without contacts."""
        self.bodies = self.touched.body[:0]
        self.wrenches = self._wrench[:0]
        self.rigid_force = None
        self._counters[structs.ISLANDS] = self.warm_start.count[0] = 0

    def find_contacts(self, trees: int) -> None:
        """List the contacts of the ``trees`` listed awake trees, the plant bodies in contact, and the islands.

        If there are too many contacts, no islands are built; see :meth:`build_islands`.
        """
        self.rigid_arrays.bodies.tree_island[:] = self.rigid.islands
        self._find_contacts(trees)

    def build_islands(self) -> None:
        """Build the islands of the contacts that are listed now."""
        self._counters[structs.HAVE_ROOM] = 1
        self._build_islands()

    def solve(self, count: int) -> None:
        """Find the impulses of the first ``count`` contacts, and their effect on plants and on rigid bodies."""
        n = count
        if self._make_room():
            self.build_islands()
        counters = self._counters
        self._padded_rows = int(self.islands.row_start[counters[structs.BLOCKS]])
        self._most_contacts = max(self._most_contacts, n)
        if self._wires is not None:
            self._end_at_wires(n, self._wires)
        self.rigid_force = self.system.rigid_force
        self.rigid_force.fill(0.0)
        if self.rigid.mj_data.nefc and self.rigid.is_constrained(self._touched_rigid_bodies(n)):
            self._solve_constrained(n)
        else:
            self._solve(n)
        self.unfinished += int(counters[structs.UNFINISHED])
        self.warm_start.count[0] = n
        self.bodies = self.touched.body[: counters[structs.BODIES]]
        self.wrenches = self._wrench[: counters[structs.BODIES]]

    def _solve_constrained(self, count: int) -> None:
        """Solve the contacts if MuJoCo's constraints act on rigid bodies in contact. MuJoCo then computes the response
        of these bodies."""
        self._write_rows(count)
        self._rigid_spans[:count] = 0, self.rigid.mj_model.nv
        self._respond_constrained(by_rows(self.rows.rigid_jacobian[:count]))
        self._assemble_and_solve(count)
        self._follow_constraints(count)
        self._store(count)

    def _make_room(self) -> bool:
        """Make room for the matrices and responses of the contacts.

        Returns whether the contacts must be listed again.
        """
        counters = self._counters
        entries = int(counters[structs.MATRIX_ENTRIES])
        larger = entries > len(self._matrix)
        if larger:
            self._matrix = np.zeros(2 * entries)
            self._allocate()
        if self.response.make_room(int(counters[structs.RESPONSE_NUMBERS])) or larger:
            self.make_graphs()
        return larger

    def _end_at_wires(self, count: int, wires: WireContacts) -> None:
        """Add the stiffness of the deflecting wires to the contacts with them."""
        contacts = self.contacts
        candidates = self._detection.candidates
        piece = self.rigid_arrays.wire_of_geom[np.maximum(contacts.other[:count], -1)]
        self._at_wires = self._at_wires[:0]
        contacts.wire_stiffness[:count] = contacts.wire_shift[:count] = 0.0
        if piece.max() < 0:
            return
        at = self._at_wires = np.flatnonzero(piece >= 0)
        row, slot = np.divmod(contacts.source[at], candidates.feature.shape[1])
        body = contacts.body[at]
        point = candidates.point[row, slot]
        normal = candidates.normal[row, slot]
        free = self.plants.velocity_free[body]
        arm = point - self.plants.state.body_q[body, :3]
        closing = -((free[:, :3] + frames.cross(free[:, 3:], arm)) * normal).sum(1)
        key = contacts.feature[at].astype(np.int64) * len(self.rigid_arrays.geom_of_wire) + piece[at]
        wires.find_springs(
            piece[at], point, normal, candidates.gap[row, slot], closing, key, self.plants.model.body_tree[body]
        )
        contacts.wire_stiffness[at] = wires.stiffness
        contacts.wire_shift[at] = wires.shift

    def pressed_keys(self, count: int) -> np.ndarray:
        """Returns a number [k] for each of the first ``count`` contacts that carries a force; it is that of the same
        contact in another step."""
        contacts = self.contacts
        keys = (contacts.feature[:count].astype(np.int64) << 32) + contacts.other[:count]
        return keys[self.rows.impulse[0 : 3 * count : 3] > 0.0]

    def peaks(self, count: int, pressed_before: np.ndarray) -> np.ndarray:
        """Returns the largest force [count] N within the step of each of the first ``count`` contacts, as a mean over
        :data:`BLOW_DURATION`. ``pressed_before``: :meth:`pressed_keys` of the last step.

        A contact that began in this step ends the closing speed v along its normal. In the first moment it moves only
        the mass m next to it: the force is v / (1 / m + c) / h over the duration h, with c the compliance of the
        contact over h. Contacts that began together are solved together. The step spreads the impulse over its
        duration, and moves more mass. Call it between steps.
        """
        contacts = self.contacts
        force = np.linalg.norm(contacts.force[:count], axis=1)
        closing = -self.rows.velocity_free[0 : 3 * count : 3]
        new = np.flatnonzero((closing > MIN_BLOW_SPEED) & (self.rows.impulse[0 : 3 * count : 3] > 0.0))
        if len(new):
            keys = (contacts.feature[new].astype(np.int64) << 32) + contacts.other[new]
            new = new[~np.isin(keys, pressed_before)]
        h = BLOW_DURATION
        if len(new) == 0 or self.parameters.dt <= h:
            return force
        between = contacts.other_body[new] >= 0
        side = np.concatenate([np.arange(len(new)), np.flatnonzero(between)])
        body = np.concatenate([contacts.body[new], contacts.other_body[new[between]]])
        sign = np.where(np.arange(len(side)) < len(new), 1.0, -1.0)[:, None] * np.eye(len(new))[side]
        at = new[side]
        mobility = sign.T @ self.plants.blow_response(body, contacts.point[at], contacts.axes[at, 0]) @ sign
        rows = self.rows
        mobility += rows.rigid_jacobian[new, :, 0] @ rows.rigid_response[new, :, 0].T
        surface = contacts.surface[new]
        mobility += np.diag(1.0 / (h * (surface["stiffness"] * h + surface["damping"])))
        blow = pressing_impulses(mobility, closing[new])
        force[new] = np.maximum(force[new], blow / h)
        return force

    def report_wires(self) -> None:
        """Pass the contact forces of the last solve on wires to :class:`DeflectedWires`."""
        wires = self._wires
        at = self._at_wires
        contacts = self.contacts
        dt = self.parameters.dt
        if wires is not None and len(at):
            force = self.rows.impulse[3 * at] / dt
            surface = contacts.surface[at]
            damping = surface["stiffness"] * dt + surface["damping"]
            wires.add_presses(force, -(force / damping + self.rows.bias[3 * at]))

    def _respond_constrained(self, jacobian: np.ndarray) -> np.ndarray:
        """Compute the velocity changes [row, dof] that MuJoCo's constraints allow rigid bodies under unit impulses
        along the contact rows, store them, and return them."""
        response = self.rigid.impulse_response(jacobian).T
        self.rows.rigid_response[: len(response) // 3] = response.reshape(-1, 3, response.shape[1]).transpose(0, 2, 1)
        return response

    def _follow_constraints(self, count: int) -> None:
        """Repeat the solve until MuJoCo, with its constraints, moves the rigid bodies under the contact impulses as the
        solve assumed.

        The solve assumes a linear response to impulses, but contacts of a body with its support may open or begin to
        slide. A light body gains energy if the solve assumes that its support holds it while it slides or lifts off.
        Each round is a Newton step from the last impulses, with the tangent stiffness of the constraints under them.
        If no round reaches the tolerance, the impulses of the round with the least error are kept, as far as they add
        no energy; see :meth:`_end_growth`.
        """
        rows = self.rows
        system = self.system
        row_count = 3 * count
        p = self.parameters
        jacobian = by_rows(rows.rigid_jacobian[:count])
        response = by_rows(rows.rigid_response[:count])
        impulse = rows.impulse[:row_count]
        velocity_free = rows.velocity_free[:row_count]
        of_islands = system.impulse[: self._padded_rows]
        kept = (impulse, velocity_free, of_islands, system.velocity, system.rigid_force)
        free = self.rigid.velocity_free
        free_first = free
        free_rows = velocity_free.copy()
        best = ()
        best_error = np.inf
        error = np.inf
        for round_number in range(p.solver_constraint_steps + 1):
            assert self.rigid_force is not None
            self.rigid.predict_with(self.rigid_force)
            velocity = self.rigid.velocity_free
            error = float(np.abs(jacobian @ (velocity - free + impulse @ response)).max())
            if error < p.solver_constraint_tolerance:
                return
            if error < best_error:
                best = tuple(values.copy() for values in kept)
                best_error = error
            if round_number == p.solver_constraint_steps:
                break
            response = self._respond_constrained(jacobian)
            free_before = free
            free = velocity + impulse @ response
            velocity_free -= jacobian @ (free - free_before)
            self._solve_islands(self.island_count)
        if error > best_error:
            for values, those in zip(kept, best, strict=True):
                values[:] = those
        self._end_growth(count, free_rows, free_first)

    def _end_growth(self, count: int, velocity_free: np.ndarray, rigid_free: np.ndarray) -> None:
        """Halve the impulses of each island until they add no energy with the velocities that MuJoCo computes for them.

        This is the law x . r <= 0 of :func:`vinesim.kernels.contact.projected_gauss_seidel.end_growth`, for a response
        that is not linear. MuJoCo minimises a convex function, so halving ends: x . r falls with the impulses.

        Args:
            count: number of contacts.
            velocity_free: [row] m/s, velocities along the rows of the contacts without impulses.
            rigid_free: [dof] m/s or rad/s, velocities of the rigid world without impulses.
        """
        rows = self.rows
        system = self.system
        lists = self.islands
        islands = self.island_count
        assert self.rigid_force is not None
        of_contact = self.contacts.island[:count]
        jacobian = by_rows(rows.rigid_jacobian[:count])
        impulse = rows.impulse[: 3 * count]
        whole = impulse.copy()

        def by_island(work: np.ndarray) -> np.ndarray:
            return np.bincount(of_contact, work.reshape(-1, 3).sum(1), islands)

        free = by_island(whole * (velocity_free + rows.bias[: 3 * count]))
        own = by_island(whole**2 * np.repeat(self.contacts.surface["compliance"][:count], 3))
        for island in range(islands):
            for block in range(lists.first_block[island], lists.first_block[island + 1]):
                first, end = lists.row_start[block : block + 2]
                used = 3 * int(lists.block_start[block + 1] - lists.block_start[block])
                at = lists.matrix_start[block]
                matrix = rows.delassus[at : at + used * (end - first)].reshape(used, -1)
                own[island] += system.impulse[first : first + used] @ matrix @ system.impulse[first:end]
        rounding = self.parameters.solver_constraint_tolerance * np.bincount(of_contact, whole[::3], islands)
        share = np.ones(islands)
        for halvings in range(MAX_HALVINGS + 1):
            self.rigid.predict_with(self.rigid_force)
            moved = whole * (jacobian @ (self.rigid.velocity_free - rigid_free))
            work = free + share * own - by_island(moved)
            growing = np.flatnonzero((work > rounding) & (share > 0.0))
            if len(growing) == 0:
                return
            factor = 0.5 if halvings < MAX_HALVINGS else 0.0
            for island in growing.tolist():
                share[island] *= factor
                dofs = slice(lists.first_dof[island], lists.first_dof[island + 1])
                blocks = lists.row_start[lists.first_block[island : island + 2]]
                system.impulse[slice(*blocks)] *= factor
                system.velocity[dofs] *= factor
                self.rigid_force[lists.dof[dofs]] *= factor
            impulse[:] = whole * np.repeat(share[of_contact], 3)

    def _touched_rigid_bodies(self, count: int) -> np.ndarray:
        """Returns the MuJoCo bodies [k] that the first ``count`` contacts touch, each body once."""
        other = self.contacts.other[:count]
        return self.rigid_arrays.geoms.body[other[other >= 0]]

    def make_graphs(self) -> None:
        """Make the graphs of all stages, bound to the present arrays.

        Call this again when the detection has allocated its arrays again.
        """
        p = self.parameters
        parameters = self._kernel_parameters
        rigid = self.rigid_arrays
        plants = self._detection.arrays
        capsules = plants.capsules.struct
        bodies = plants.bodies.struct
        geoms = rigid.geoms.struct
        rigid_bodies = rigid.bodies.struct
        factors = rigid.factors.struct
        candidates = self._detection.candidates.struct
        contacts = self.contacts.struct
        island_lists = self.islands.struct
        rows = self.rows.struct
        warm_start = self.warm_start.struct
        system = self.system.struct
        side_groups = self.response.groups.struct
        response = share(self.response.numbers, wp.float32)
        counters = share(self._counters, wp.int32)
        touched = self.touched.struct

        compact_candidates = KernelLaunch(islands.compact_candidates, [candidates], [contacts, counters], threads=1)
        build_islands = KernelLaunch(
            islands.build_islands,
            [capsules, geoms, bodies, rigid_bodies, candidates],
            [counters, touched, contacts, island_lists, side_groups],
            threads=1,
        )
        write_contact_rows = KernelLaunch(
            jacobians.write_contact_rows,
            [
                1,
                parameters,
                share(self._pairs, Surface),
                capsules,
                geoms,
                counters,
                bodies,
                rigid_bodies,
                factors,
                candidates,
                warm_start,
            ],
            [share(self._rigid_spans, wp.vec2i), contacts, rows],
            threads=1,
        )
        respond_rigidly = KernelLaunch(
            delassus.respond_rigidly, [geoms, counters, rigid_bodies, factors, contacts], [rows]
        )
        assemble_delassus = KernelLaunch(
            delassus.assemble_delassus, [counters, contacts, touched, island_lists, side_groups, response], [rows]
        )
        solve_islands = KernelLaunch(
            projected_gauss_seidel.solve_islands,
            [
                parameters,
                p.solver_sweeps,
                p.solver_newton_steps,
                p.solver_newton_contacts,
                p.solver_tolerance,
                geoms,
                counters,
                contacts,
            ],
            [island_lists, system, rows],
        )
        stored = (
            KernelLaunch(
                forces.store_warm_start, [parameters, counters, island_lists, system, rows], [contacts, warm_start]
            ),
            KernelLaunch(forces.count_unfinished, [p.solver_sweeps, island_lists], [counters], threads=1),
            KernelLaunch(
                forces.accumulate_wrenches,
                [parameters, counters, contacts, rows],
                [share(self._wrench, wp.float64)],
                threads=1,
            ),
        )
        self._find_contacts = KernelGraph(*self._detection.narrowphase, compact_candidates, build_islands)
        self._build_islands = KernelGraph(build_islands)
        self._solve_islands = KernelGraph(solve_islands)
        self._assemble_and_solve = KernelGraph(assemble_delassus, solve_islands)
        self._store = KernelGraph(*stored)
        after_response = (respond_rigidly, assemble_delassus, solve_islands, *stored)
        if self.plants.buffers.device.is_cpu:
            self._write_rows = KernelGraph(write_contact_rows, self.response.launch)
            self._solve = KernelGraph(write_contact_rows, self.response.launch, *after_response)
            return
        write_rows = KernelGraph(write_contact_rows)
        respond = KernelGraph(self.response.launch, device=str(self.plants.buffers.device))
        solve = KernelGraph(*after_response)

        def write_and_respond(count: int) -> None:
            write_rows(count)
            respond()
            self.plants.buffers.synchronize()

        def solve_with_response(count: int) -> None:
            write_and_respond(count)
            solve(count)

        self._write_rows = write_and_respond
        self._solve = solve_with_response


def by_rows(jacobian: np.ndarray) -> np.ndarray:
    """Returns a rigid Jacobian [contact, dof, 3] as rows [row, dof]."""
    return jacobian.transpose(0, 2, 1).reshape(-1, jacobian.shape[1])


def pressing_impulses(mobility: np.ndarray, closing: np.ndarray) -> np.ndarray:
    """Returns the impulses x [n] N s, at least 0, that end the closing speeds [n] m/s: mobility x >= closing, with
    equality where x > 0. ``mobility``: [n, n] 1/kg, positive definite. By projected Gauss-Seidel."""
    impulse = np.zeros(len(closing))
    for _ in range(BLOW_SWEEPS):
        before = impulse.copy()
        for i in range(len(closing)):
            missing = closing[i] - mobility[i] @ impulse
            impulse[i] = max(impulse[i] + missing / mobility[i, i], 0.0)
        if np.abs(impulse - before).max() <= BLOW_TOLERANCE * impulse.max():
            break
    return impulse
