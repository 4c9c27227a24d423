"""Bunches that leave their vines in a batch of worlds, and the blades that cut them off, and canes.

Each world has a pool of rigid bodies. When a bunch is cut off, one of them gets its pose, velocity, mass and shapes, as
:class:`vinesim.interaction.detachment.DetachmentMonitor` does it in a client. Everything happens on the device.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from vinesim.contact.plant_capsules import plant_capsules
from vinesim.core import frames
from vinesim.core.warp_arrays import struct_fields
from vinesim.interaction.blades import GAP_STEP, Blade
from vinesim.interaction.cutting_force import BLADE_FACTORS, energy_exponent
from vinesim.interaction.detachment import SAME_CUT, STUB_MASS
from vinesim.interaction.stalk import GHOST_SHARE
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.plants import structs
from vinesim.kernels.plants.kinematics import forward_kinematics
from vinesim.kernels.worlds import cutting
from vinesim.kernels.worlds import free_bunches as kernels
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.segment_parts import SHORTEST
from vinesim.rigid.free_bunch import FreeBunch, slot_name
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.rigid.static_world import FREE_BUNCH
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spare_bodies import PLACE_STEP
from vinesim.worlds.batch_contacts import BatchContacts
from vinesim.worlds.cane_cuts import CaneCuts
from vinesim.worlds.overload import Overload
from vinesim.worlds.rigid_batch import RigidBatch

OWN = tuple(struct_fields(kernels.WarpModel))
"""Arrays of mujoco_warp's model of which each world of a batch with a pool has rows of its own."""
PARKING_HEIGHT = 100.0
"""[m] Height at which unused bodies are held, away from everything that they could touch."""
CAPSULE_ARRAYS = ("body", "local_start", "local_end", "rest_start", "rest_end", "radius", "material", "extent")
"""Arrays of capsules that cuts change."""
SPARE = 1e-3
"""[m] Size of unused shapes of a pool body. They lie inside its first sphere, so nothing touches them."""


class BunchPool:
    """The free bunches of all worlds, and the blade with which each world's robot cuts them off, and cuts canes.

    Args:
        plants: trees of all worlds.
        bodies: rigid bodies of all worlds; :func:`add_pool` has added the pool.
        contacts: contacts of the plants.
        blade: the blade, a ``bypass`` or ``anvil`` blade that closes within a step. None: nothing is cut.
        faults: [world] faults, see :attr:`vinesim.worlds.worlds.Worlds.faults`.
        fault_count: [world] number of times that a world without faults got one.
        breaks: whether wood breaks under its load.

    Raises :class:`ValueError` for another blade.
    """

    def __init__(
        self,
        plants: ArticulationSolver,
        bodies: RigidBatch,
        contacts: BatchContacts,
        blade: Blade | None,
        faults: wp.array,
        fault_count: wp.array,
        *,
        breaks: bool = False,
    ) -> None:
        if blade is not None:
            _check(blade, bodies)
        self._plants = plants
        self._bodies = bodies
        self._contacts = contacts
        self._device = bodies.device
        model = plants.model
        bunches = len(model.bunch_body)
        self.closing = self._zeros(wp.bool, bodies.count)
        """[world] Whether the blade closes at the end of the next call of ``Worlds.step``, which clears it."""
        self.needed = self._zeros(float, bodies.count)
        """[world] N: force that the last closing takes, 0 for an empty mouth. Infinite if a cane that cannot be cut, or
        wood thicker than the mouth, was between the blades: then nothing was cut."""
        self.is_free = self._zeros(wp.int32, bunches)
        """[bunch] 1 if the bunch has left its vine, else 0."""
        self.bunch = contacts.free.bunch
        """[world, slot] Bunch that a body of the pool is; -1: it is not used."""
        slots = self.bunch.shape[1]
        self.body = np.array([bodies.rigid.mj_model.body(slot_name(slot)).id for slot in range(slots)])
        """[slot] MuJoCo's indices of the bodies of the pool."""
        self._model = bodies.fill(kernels.WarpModel, bodies.model)
        self._masses = plants.launches.fill_resident(kernels.PlantMasses)
        self._wood = self._take_wood(model)
        self.table, hold = self._take_pool()
        """Where the bodies of the pool are in mujoco_warp's arrays, for kernels."""
        self.hold = KernelGraph(hold, device=str(self._device))
        """Launches the kernel that holds unused bodies at their places. Call it before each step's first half."""
        stumps = 0 if blade is None else int(model.tree_spares.min())
        self.canes = CaneCuts(plants, bodies.count, contacts, stumps, breaks=breaks)
        """The parts of canes that have been cut."""
        cuts = self._cuts(bunches)
        move = self._move_plants()
        detach = self._detach(cuts, faults, fault_count)
        closing = []
        if blade is not None:
            closing = [self._close(blade, cuts), detach, *self.canes.cut(cuts, self._masses, faults, fault_count)]
        self.update = KernelGraph(move, *closing, device=str(self._device))
        """Launches the kernels that close blades and detach bunches, and that compute the poses of all plants, at the
        end of a step. mujoco_warp's poses must be those of the end of the step."""
        self.overload = None
        """Wood that gives under its load; None if none does."""
        breaking = []
        if breaks:
            self.overload = Overload(plants, bodies.count, contacts.parameters, self._wood, self.canes.topology)
            part = self.canes.part(self.overload.breaks, faults, fault_count)
            breaking = [*self.overload.find(cuts, self.is_free), move, detach, *part]
        ending = [*self.canes.slow_lying_parts(), *breaking]
        self.end_step = KernelGraph(*ending, device=str(self._device)) if ending else None
        """Launches the kernels that damp lying pieces and break overloaded wood, after the integration of each step.
        None: there are none."""

    def _zeros(self, dtype: Any, *shape: int) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self._device)

    def _array(self, values: Any, dtype: Any) -> wp.array:
        return wp.array(np.asarray(values), dtype=dtype, device=self._device)

    def _by_place(self, values: np.ndarray, dtype: Any) -> wp.array:
        """Returns an array with a row for each body in the order of the kernels' arrays."""
        buffers = self._plants.buffers
        there = np.zeros((buffers.slot_count, *values.shape[1:]), values.dtype)
        there[buffers.slots] = values
        return self._array(there, dtype)

    def _take_wood(self, model: Model) -> cutting.Wood:
        kind = np.zeros(len(model.body_organ), np.int32)
        kind[model.body_organ == int(Organ.CANE)] = cutting.CANE
        kind[model.body_organ == int(Organ.PEDUNCLE)] = cutting.PEDUNCLE
        tree = model.body_tree[model.bunch_body]
        order = np.argsort(tree, kind="stable")
        wood = cutting.Wood()
        wood.kind = self._by_place(kind, wp.int32)
        wood.length = self._by_place(model.body_length, float)
        wood.radius = self._by_place(model.body_radius, wp.vec2)
        wood.bunch_body = self._array(self._plants.buffers.slots[model.bunch_body], wp.int32)
        wood.of_tree = self._array(order, wp.int32)
        starts = np.searchsorted(tree[order], np.arange(len(model.tree_first) + 1))
        wood.tree_start = self._array(starts, wp.int32)
        return wood

    def _take_pool(self) -> tuple[kernels.Pool, KernelLaunch]:
        m = self._bodies.rigid.mj_model
        body = self.body
        joint = m.body_jntadr[body]
        geom = m.body_geomadr[body]
        pool = kernels.Pool()
        pool.body = self._array(body, wp.int32)
        pool.q = self._array(m.jnt_qposadr[joint], wp.int32)
        pool.v = self._array(m.jnt_dofadr[joint], wp.int32)
        pool.geom = self._array(geom, wp.int32)
        pool.moving_geom = self._array(np.searchsorted(self._bodies.rigid.geoms.id, geom), wp.int32)
        pool.parking = self._array([parking_pose(slot) for slot in range(len(body))], wp.transform)
        data = self._bodies.data
        given = [pool, self._contacts.free]
        shape = {"threads": self._bodies.count, "width": len(body)}
        return pool, KernelLaunch(kernels.hold_parked, given, [data.qpos, data.qvel], **shape)

    def _cuts(self, bunches: int) -> cutting.Cuts:
        cuts = cutting.Cuts()
        trees = len(self._plants.model.tree_first)
        cuts.cane = wp.full(trees, -1, dtype=wp.int32, device=self._device)
        for name in ("cane_at", "cane_force", "cane_diameter"):
            setattr(cuts, name, self._zeros(wp.float64, trees))
        cuts.segment = wp.full(bunches, -1, dtype=wp.int32, device=self._device)
        for name in ("at", "force", "diameter"):
            setattr(cuts, name, self._zeros(wp.float64, bunches))
        return cuts

    def _move_plants(self) -> KernelLaunch:
        """Returns the launch that computes the poses of all plants from their joints."""
        fill = self._plants.launches.fill_resident
        trees = len(self._plants.model.tree_first)
        every = [self._array([trees], wp.int32), self._array(np.arange(trees), wp.int32)]
        given = [fill(structs.ArticulationModel), *every, fill(structs.JointState)]
        return KernelLaunch(forward_kinematics, given, [fill(structs.BodyState)], threads=trees)

    def _close(self, blade: Blade, cuts: cutting.Cuts) -> KernelLaunch:
        parameters = self._contacts.parameters
        numbers = cutting.BladeNumbers()
        numbers.body = self._bodies.rigid.robot(blade.actor).bodies[blade.link]
        numbers.pose = wp.transformd(*map(wp.float64, blade.pose))
        numbers.half = wp.vec3d(*blade.half)
        numbers.force = blade.limit
        numbers.factor = BLADE_FACTORS[blade.kind]
        numbers.strength = parameters.peduncle_cutting_strength
        numbers.cane_strength = parameters.cutting_strength
        numbers.same_cut = SAME_CUT
        numbers.least = 2.0 * SHORTEST + PLACE_STEP
        numbers.power = energy_exponent(parameters.cutting_energy_share)
        numbers.gap_step = GAP_STEP
        arrays = self._plants.launches.resident_arrays
        data = self._bodies.data
        trees = len(self._plants.model.tree_first)
        shape = [numbers, self._bodies.count, trees, self._plants.buffers.pitch]
        tables = [arrays[name] for name in ("tree_first", "tree_size", "body_parent")]
        given = [*shape, *tables, self._wood, self.is_free, *self.canes.parts, arrays["body_q"], data.xpos, data.xquat]
        written = [self.closing, self.needed, cuts]
        return KernelLaunch(cutting.close_blades, given, written, threads=self._bodies.count)

    def _detach(self, cuts: cutting.Cuts, faults: wp.array, fault_count: wp.array) -> KernelLaunch:
        model = self._plants.model
        parameters = self._contacts.parameters
        numbers = kernels.PoolNumbers()
        numbers.worlds = self._bodies.count
        numbers.trees = len(model.tree_first)
        numbers.spheres, numbers.pieces = shapes_of_bunches(model)
        numbers.dofs = self._bodies.rigid.mj_model.nv
        numbers.stub_mass = STUB_MASS
        numbers.ghost_share = GHOST_SHARE
        numbers.shortest = SHORTEST
        numbers.place_step = PLACE_STEP
        numbers.rolling_arm = parameters.bunch_rolling_arm
        numbers.spare = SPARE
        arrays = self._plants.launches.resident_arrays
        data = self._bodies.data
        contacts = self._contacts
        given = [numbers, self.table, self._wood, arrays["body_parent"], cuts, arrays["body_q"], arrays["body_qd"]]
        written = [
            self.is_free,
            contacts.free,
            faults,
            fault_count,
            self._masses,
            contacts.capsules,
            self._plants.launches.budget.limit,
            self._model,
            data.qpos,
            data.qvel,
            contacts.geoms,
            contacts.rigid_bodies,
        ]
        return KernelLaunch(kernels.detach_bunches, given, written, threads=self._bodies.count)

    # ------------------------------------------------------------------ state, for resets

    def of_worlds(self) -> list[wp.array]:
        """Returns the arrays with a row for each world that change."""
        model = [getattr(self._model, name) for name in OWN]
        return [*model, self.bunch, self.needed]

    def of_trees(self) -> list[tuple[wp.array, wp.array]]:
        """Returns the arrays that change with a row for each tree, body, capsule, bunch or geom, and for each row the
        number of a tree of the world that it belongs to."""
        model = self._plants.model
        trees = len(model.tree_first)
        contacts = self._contacts
        capsules = contacts.capsules
        geoms = contacts.geoms
        of_body = self._plants.launches.resident_arrays["body_tree"]
        of_capsule = self._array(np.arange(len(capsules.body)) % trees, wp.int32)
        of_geom = self._array(np.arange(len(geoms.id)) % self._bodies.count, wp.int32)
        rows = [(getattr(self._masses, name), of_body) for name in struct_fields(kernels.PlantMasses)]
        rows += [(getattr(capsules, name), of_capsule) for name in CAPSULE_ARRAYS]
        moving = int(geoms.count.numpy()[0])
        rows += [(getattr(geoms, name)[:moving], of_geom[:moving]) for name in ("size", "half", "radius")]
        return [
            *rows,
            *self.canes.of_trees(),
            *([] if self.overload is None else self.overload.of_trees()),
            (contacts.free.passing, self._array(np.arange(trees), wp.int32)),
            (self.is_free, self._array(model.body_tree[model.bunch_body], wp.int32)),
        ]


def _check(blade: Blade, bodies: RigidBatch) -> None:
    if np.isfinite(blade.speed) or blade.kind == "saw":
        raise ValueError(f"a {blade.kind} blade with {blade.speed:g} m/s: a batch has blades that close at once")
    bodies.rigid.link_pose(blade.actor, blade.link)  # raises an error if there is no such link
    frames.checked_pose("pose of the blade", blade.pose)
    half = np.asarray(blade.half, float)
    if not (np.isfinite(half) & (half > 0.0)).all():
        raise ValueError(f"half {half.tolist()} of the blade: give finite numbers above 0 [m]")
    if not blade.limit > 0.0:
        raise ValueError(f"force {blade.limit} of the blade: give a number above 0 [N]")


def parking_pose(slot: int) -> np.ndarray:
    """Returns the pose [7] of an unused body of the pool."""
    return frames.pose(np.array([float(slot), 0.0, PARKING_HEIGHT]))


def shapes_of_bunches(model: Model) -> tuple[int, int]:
    """Returns the largest numbers of spheres of a bunch, at least 1, and of segments of a peduncle."""
    capsules = plant_capsules(model)
    of_body = np.bincount(capsules.body[capsules.level < 2], minlength=len(model.body_mass))
    spheres = int(of_body[model.bunch_body].max(initial=1))
    pieces = 0
    body = model.body_parent[model.bunch_body]
    while (is_stalk := (body >= 0) & (model.body_organ[body] == int(Organ.PEDUNCLE))).any():
        pieces += 1
        body = np.where(is_stalk, model.body_parent[body], -1)
    return spheres, pieces


def add_pool(rigid: RigidWorld, slots: int) -> None:
    """Add ``slots`` bodies for free bunches to a world before it is copied. Each has room for the shapes of every bunch
    of the world's plants. Raises :class:`ValueError` if a bunch has more shapes than a body can have, and
    for less than one body."""
    if slots < 1:
        raise ValueError(f"bunches {slots}: a blade needs at least one body for what it cuts off")
    spheres, pieces = shapes_of_bunches(rigid.model)
    start = np.tile([0.05, 0.0, 0.0], (spheres + pieces, 1))
    end = start.copy()
    end[spheres:, 0] -= 0.01
    template = FreeBunch(
        mass=0.5,
        com=start[0],
        inertia=np.full(3, 1e-3),
        product=np.zeros(3),
        start=start,
        end=end,
        radius=np.full(len(start), 0.01),
    )
    rigid.add_bunches({slot: (template, parking_pose(slot), np.zeros(6)) for slot in range(slots)})
    # bunches may hang in each other, because plants of a world do not touch. If they touched as free bodies, the solver
    # of mujoco_warp would fail in single precision
    m = rigid.mj_model
    m.geom_conaffinity[(m.geom_contype & FREE_BUNCH) != 0] &= ~FREE_BUNCH
