"""Worlds with robots, boxes and plants, stepped together on one device.

A step has the stages of :class:`vinesim.world.Physics`: both sides predict their velocities, the contacts of each world
are found and solved together, both sides integrate. Nothing is copied between host and GPU during a step.

What a client's world has and a batch does not: contacts between plants, wires and arms that deform, hands of people,
sleep, and bunches with moving berry clusters.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
import warp as wp

from vinesim.core.warp_arrays import struct_fields
from vinesim.interaction.blades import Blade
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.worlds.free_bunches import PlantMasses
from vinesim.kernels.worlds.reset import find_faults, forget_faults, restore_rows, restore_worlds
from vinesim.plants.articulation_solver import TREE_RESULTS, ArticulationSolver, Beside
from vinesim.rigid.rigid_world import MAX_RATE, RigidWorld
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State
from vinesim.scene.values import RobotSpec
from vinesim.worlds.batch_contacts import FULL_BLOCK, BatchContacts
from vinesim.worlds.bunch_pool import OWN, BunchPool, add_pool
from vinesim.worlds.cane_cuts import CHANGED_ROWS
from vinesim.worlds.rigid_batch import RigidBatch

DEFAULT_SLOTS = 16
"""Default for the number of contacts that the plants of one world can have at once."""
_BODY_STATE = ("joint_q", "joint_qd", "body_q", "body_qd", "body_qd_free", "body_wrench", "body_acceleration")
"""Arrays with a row for each body that change in a step and that the next step reads."""


_BUDGET_STATE = ("limit", "last", "scale", "held", "watch", "mark")
"""Arrays of energy budgets with an element for each tree that change in a step and that the next step reads."""


def _as_table(rows: wp.array) -> wp.array:
    """Returns an array of numbers of four bytes, vectors, quaternions or poses as a table that shares its memory.

    Integers appear as floating-point numbers with the same bits, which is enough for copies.
    """
    width = rows.strides[0] // 4
    if width == 0:
        raise TypeError(f"an array of {rows.dtype}: give numbers of four bytes")
    return wp.array(ptr=rows.ptr, shape=(len(rows), width), dtype=float, device=rows.device)


def write_mask(worlds: np.ndarray | wp.array | None, mask: wp.array) -> None:
    """Write into ``mask`` bool [world] which worlds are meant; None: all. Raises :class:`ValueError` for an array of
    another type or length, such as the numbers of worlds."""
    if worlds is None:
        mask.fill_(True)
        return
    if not isinstance(worlds, wp.array):
        worlds = np.asarray(worlds)
    if tuple(worlds.shape) != mask.shape or worlds.dtype not in (np.bool_, wp.bool):
        given = getattr(worlds.dtype, "__name__", worlds.dtype)
        raise ValueError(f"worlds: {given} {list(worlds.shape)}; give bool [{len(mask)}], one for each world")
    mask.assign(worlds)


class Worlds:
    """``count`` worlds with the same robots and boxes, and with plants of their own.

    Args:
        model: plants of all worlds, and what stands still. Tree t of world w has the number ``t * count + w``. All
            worlds use the same coordinates. They overlap, but do not touch each other.
        count: number of worlds.
        robots: robots that each world has, at the poses of their descriptions.
        parameters: numbers of the physics. Nothing sleeps in a batch.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        slots: number of contacts that the plants of one world can have at once. Further contacts are left out, and
            counted in :attr:`dropped`.
        blade: the blade of one of the robots. It cuts peduncles, and canes of trees with spare bodies for the stumps
            (:func:`vinesim.scene.spare_bodies.with_spares`), see :mod:`vinesim.worlds.cane_cuts`. None: nothing is cut.
        bunches: number of bunches that can come off in each world.
        breaks: whether peduncles and canes break under their load, and canes keep a set, as in a client.
        deterministic: whether equal worlds stay equal to the bit on a GPU, at the cost of speed (docs/worlds.md). On a
            CPU they always do.

    Raises :class:`ValueError` if the number of trees does not fit or a tree needs substeps, or for a blade that a batch
    cannot have (see :class:`~vinesim.worlds.bunch_pool.BunchPool`),
    :class:`~vinesim.worlds.errors.MissingExtra` without mujoco_warp.
    """

    def __init__(
        self,
        model: Model,
        count: int,
        *,
        robots: Sequence[RobotSpec] = (),
        parameters: PhysicsParameters = PhysicsParameters(),
        device: str = "cpu",
        slots: int = DEFAULT_SLOTS,
        blade: Blade | None = None,
        bunches: int = 1,
        breaks: bool = False,
        deterministic: bool = False,
    ) -> None:
        parameters = msgspec.structs.replace(parameters, sleep=False, bunch_pool_size=0)
        self.model = model
        self.count = count
        self.parameters = parameters
        rigid = RigidWorld(model, parameters=parameters)
        for robot in robots:
            rigid.add_robot(robot)
        has_pool = blade is not None or breaks
        if has_pool:
            add_pool(rigid, bunches)
        self.bodies = RigidBatch(rigid, count, device, own=OWN if has_pool else (), deterministic=deterministic)
        """Robots and boxes."""
        self.plants = ArticulationSolver(model, State.at_rest(model), parameters, device=device)
        """Trees."""
        self.plants.wake(np.arange(len(model.tree_first)))
        self.plants.forward_kinematics()
        self.contacts = BatchContacts(self.plants, parameters, slots=slots, bodies=self.bodies)
        """Contacts of the plants."""
        self.plants.upload()
        self._resets = wp.zeros(count, dtype=wp.bool, device=device)
        self.faults = wp.zeros(count, dtype=wp.int32, device=device)
        """[world] What has gone wrong since the world's last reset: a sum of
        :data:`~vinesim.kernels.worlds.reset.MOTION` (a number is not finite, or a rate too high),
        :data:`~vinesim.kernels.worlds.reset.ROOM` (contacts were left out),
        :data:`~vinesim.kernels.worlds.reset.BUNCHES` (a bunch was cut off for which the pool has no body) and
        :data:`~vinesim.kernels.worlds.reset.STUMPS` (a cane was cut whose tree has no spare body left). 0: nothing.
        A world with a fault goes on as it can, until it is reset."""
        self.fault_count = wp.zeros(count, dtype=wp.int32, device=device)
        """[world] Number of times since the start that a world without faults got one."""
        self.pool: BunchPool | None = None
        """Bunches that come off; None if nothing is cut or breaks."""
        if has_pool:
            state = (self.faults, self.fault_count)
            self.pool = BunchPool(self.plants, self.bodies, self.contacts, blade, *state, breaks=breaks)
        self.plants.launches.upload_trees()  # a reset returns to what the device has now
        self._check = self._check_graph(device)
        self._reset = self._reset_graph(device)

    def _reset_graph(self, device: str) -> KernelGraph:
        """Returns the launches that return worlds to the states that they have now."""
        plants = self.plants.launches
        arrays = plants.resident_arrays
        trees = wp.array(np.arange(len(self.model.tree_first)), dtype=wp.int32, device=device)
        of_trees = [arrays[name] for name in TREE_RESULTS] + [getattr(plants.budget, name) for name in _BUDGET_STATE]
        state = [(array, trees) for array in of_trees]
        state += [(arrays[name], arrays["body_tree"]) for name in _BODY_STATE]
        launches = []
        of_worlds = []
        if self.pool is not None:
            state += self.pool.of_trees()
            launches += self.pool.canes.restore_flags(self._resets)
            of_worlds += [_as_table(array) for array in self.pool.of_worlds()]
        for array, tree in state:
            rows = _as_table(array)
            given = [self.count, self._resets, tree, wp.clone(rows)]
            launches.append(KernelLaunch(restore_rows, given, [rows], threads=rows.shape[0], width=rows.shape[1]))
        bodies = self.bodies
        of_worlds += [*bodies.state_arrays(), bodies.targets, bodies.base_velocity, bodies.base_targets]
        for rows in of_worlds:
            if rows.size:
                given = [self._resets, wp.clone(rows)]
                launches.append(KernelLaunch(restore_worlds, given, [rows], threads=self.count, width=rows.shape[1]))
        clear = KernelLaunch(
            forget_faults, [self._resets], [bodies.data.overflow, self.faults], threads=self.count, block=FULL_BLOCK
        )
        return KernelGraph(*launches, self.contacts.forget(self._resets), clear, device=device)

    def _check_graph(self, device: str) -> KernelGraph:
        """Returns the launch that looks for faults after a step."""
        data = self.bodies.data
        rate = self.plants.launches.resident_arrays["tree_rate"]
        limits = [MAX_RATE, self.plants.fault_rate]
        state = [self.count, rate, data.qpos, data.qvel, data.overflow, self.contacts.lists()[1]]
        found = [wp.zeros_like(self.faults), self.faults, self.fault_count]
        return KernelGraph(
            KernelLaunch(find_faults, limits + state, found, threads=self.count, block=FULL_BLOCK), device=device
        )

    def reset(self, worlds: np.ndarray | wp.array | None = None) -> None:
        """Return worlds to their first states, with the targets that their robots had then.

        ``worlds``: bool [world], whether each world is reset; None: all are. Between two calls of :meth:`step`. Raises
        :class:`ValueError` for an array of another type or length.
        """
        write_mask(worlds, self._resets)
        self._reset()

    @property
    def dt(self) -> float:
        """[s] Duration of a step."""
        return self.parameters.dt

    @property
    def tick(self) -> int:
        """Number of steps so far."""
        return self.plants.tick

    @property
    def dropped(self) -> np.ndarray:
        """[world] Number of contacts left out since the start because the world had no room for them."""
        return self.contacts.dropped

    def step(self, steps: int = 1) -> None:
        """Advance all worlds by ``steps`` steps. Raises :class:`ValueError` for less than 0."""
        if steps < 0:
            raise ValueError(f"steps {steps}: give 0 or more")
        beside = Beside(self._predict_bodies, self.bodies.integrate)
        if self.pool is not None and self.pool.end_step is not None:
            beside = beside._replace(end=self.pool.end_step)
        self.plants.advance(steps, self.contacts.solve, beside)
        self._check()
        if self.pool is not None:
            self.bodies.update_kinematics()
            self.pool.update()

    def _predict_bodies(self) -> None:
        self._check()  # of the step before
        if self.pool is not None:
            self.pool.hold()
        self.bodies.predict()

    def download(self) -> None:
        """Copy the states of all plants to the host: afterwards ``plants.state`` holds their poses, and ``plants`` what
        cuts and breaks have changed."""
        self.plants.download()
        if self.pool is not None:
            self.plants.buffers.download([*struct_fields(PlantMasses), *CHANGED_ROWS])
        self.plants.forward_kinematics()
