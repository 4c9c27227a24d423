"""The robots and boxes of a batch of worlds, in mujoco_warp.

All worlds have the same bodies. Their states differ. A step has two halves, as in
:class:`vinesim.rigid.rigid_world.RigidWorld`: :attr:`RigidBatch.predict` computes the velocity at the end of the step
without contacts with plants, :attr:`RigidBatch.integrate` integrates with the generalised forces of these contacts.

Unlike in a client, contacts between rigid bodies have no speculative margins, all wires are rigid, and nothing sleeps.
"""

from __future__ import annotations

import copy
from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np
import warp as wp

from vinesim.core.warp_arrays import struct_fields
from vinesim.kernels.graph import ForeignLaunches, KernelGraph, KernelLaunch
from vinesim.kernels.worlds.drives import apply_controls
from vinesim.kernels.worlds.rigid_state import EffectiveMass
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.worlds.errors import MissingExtra

DEFAULT_CONTACTS = 16
"""Default for the number of contacts between rigid bodies for which there is room, per world."""
BUNCH_CONTACTS = 12
"""Further contacts for each body of a pool for free bunches: one for each of its shapes."""
ROWS_PER_CONTACT = 6
"""Room for rows of constraints per contact; MuJoCo's contacts have 1, 3, 4 or 6 rows."""


def _mujoco_warp() -> Any:
    """Returns the module mujoco_warp. Raises :class:`MissingExtra` without it."""
    try:
        import mujoco_warp
    except ImportError as error:
        raise MissingExtra(f"vinesim.worlds needs mujoco_warp: pip install 'vinesim[learn]' ({error})") from error
    return mujoco_warp


def _turn_free_bodies(model: Any, data: Any) -> None:
    """Launch the gyroscopic terms of free bodies, as the steps of mujoco_warp do. It has no public function for it."""
    from mujoco_warp._src.forward import _launch_discrete_free_gyro

    _launch_discrete_free_gyro(model, data, data.qacc, data.qacc, False)


class RigidBatch:
    """Robots and boxes of ``count`` worlds on one device, each in the state that ``rigid`` has now.

    Args:
        rigid: the world that is copied. Robots and boxes can no longer be added to it.
        count: number of worlds.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        contacts: number of contacts between rigid bodies of a world for which there is room, on average.
        own: names of arrays of mujoco_warp's model of which each world has rows of its own.
        deterministic: whether a GPU sums in the same order each time. A CPU always does.
    """

    def __init__(
        self,
        rigid: RigidWorld,
        count: int,
        device: str = "cpu",
        *,
        contacts: int = DEFAULT_CONTACTS,
        own: Collection[str] = (),
        deterministic: bool = False,
    ) -> None:
        self.rigid = rigid
        self.count = count
        self.device = wp.get_device(device)
        self._mjw = _mujoco_warp()
        m = copy.copy(rigid.mj_model)
        m.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        m.tree_sleep_policy[:] = int(
            mujoco.mjtSleepPolicy.mjSLEEP_AUTO_ALLOWED
        )  # mujoco_warp has none that begins asleep
        m.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # mujoco_warp never resets by itself
        rigid.update_kinematics()
        contacts += BUNCH_CONTACTS * len(rigid.free_bunches)
        limits = int(m.jnt_limited.sum() + m.neq * ROWS_PER_CONTACT + (m.dof_frictionloss > 0.0).sum())
        with wp.ScopedDevice(self.device):
            self.model = self._mjw.put_model(m, dict.fromkeys(own, count))
            # Newton's method finds the acceleration without constraints, too; its own solver takes longer than a step
            self.model.opt.run_qacc_smooth = False
            self.model.opt.deterministic = deterministic and self.device.is_cuda
            self.model.opt.warn_overflow = 0  # it would print to raise what users cannot; a world's fault tells it
            self.data = self._mjw.put_data(
                m, rigid.mj_data, nworld=count, nconmax=contacts, njmax=limits + ROWS_PER_CONTACT * contacts
            )
        self._dt = float(m.opt.timestep)
        controls = self._drives()
        clear = ForeignLaunches(self.applied.zero_)
        forward = self._mjw.forward
        # a graph takes a CPU 0.5 ms where the calls take 75 ms, because Warp packs the arguments of each launch
        self.predict = KernelGraph(
            controls, clear, ForeignLaunches(lambda: forward(self.model, self.data)), device=device
        )
        """Launches the first half of a step."""
        self.integrate = KernelGraph(ForeignLaunches(self._solve_again), device=device)
        """Launches the second half of a step, with the generalised forces in :attr:`applied`. The search for the
        acceleration begins at :attr:`likely_acceleration`."""
        kinematics = self._mjw.kinematics
        self.update_kinematics = KernelGraph(ForeignLaunches(lambda: kinematics(self.model, self.data)), device=device)
        """Computes the poses of all bodies after a step or a reset; a step leaves those of its start."""

    def _solve_again(self) -> None:
        """Launch what mujoco_warp's step2 does after its stage of actuation, and without sensors.

        The stage of actuation must not run twice, because it makes all constraints stiffer each time.
        """
        self._mjw.fwd_acceleration(self.model, self.data)
        self._mjw.solve(self.model, self.data)
        _turn_free_bodies(self.model, self.data)
        self._mjw.discrete(self.model, self.data)

    def _drives(self) -> KernelLaunch:
        """Collect the drives of all robots, with a target for each world. Returns the launch that applies them."""
        robots = [self.rigid.robot(name) for name in self.rigid.robots]

        def all_of(name: str) -> np.ndarray:
            return np.concatenate([np.zeros(0), *(getattr(robot, name) for robot in robots)])

        def on_device(values: np.ndarray, dtype: Any) -> wp.array:
            return wp.array(values, dtype=dtype, device=self.device)

        self.targets = on_device(np.tile(all_of("target"), (self.count, 1)), float)
        """[world, joint] rad or m: target positions of the servos, in the order of the robots and their drives."""
        self.base_velocity = wp.zeros((self.count, 3 * len(robots)), dtype=float, device=self.device)
        """[world, 3 * robot] m/s, m/s, rad/s: commanded velocities of the driven bases, in their own axes."""
        self.base_targets = on_device(np.tile(all_of("base_target"), (self.count, 1)), float)
        """[world, 3 * robot] m, m, rad: targets of the servos of the driven bases."""
        joints = [all_of(name) for name in ("stiffness", "damping_at_start", "damping_at_end")]
        bases = [np.concatenate([np.zeros(0), *(robot.base_gains[i] for robot in robots)]) for i in (0, 1)]
        return KernelLaunch(
            apply_controls,
            [
                self._dt,
                *(on_device(values, float) for values in joints),
                on_device(all_of("v"), wp.int32),
                on_device(all_of("actuator"), wp.int32),
                *(on_device(values, float) for values in bases),
                on_device(np.repeat([robot.base_slip for robot in robots], 3), float),
                on_device(all_of("base_q"), wp.int32),
                on_device(all_of("base_actuator"), wp.int32),
                self.targets,
                self.base_velocity,
                self.data.qpos,
                self.data.qvel,
            ],
            [self.base_targets, self.data.ctrl],
            threads=self.count,
        )

    # ------------------------------------------------------------------ arrays for the contacts with plants

    @property
    def applied(self) -> wp.array:
        """[world, dof] N or N m: generalised forces of the contacts with plants."""
        return self.data.qfrc_applied

    @property
    def likely_acceleration(self) -> wp.array:
        """[world, dof] m/s^2 or rad/s^2: where the search of :attr:`integrate` begins. Write it before each call."""
        return self.data.qacc_warmstart

    def state_arrays(self) -> list[wp.array]:
        """Returns the arrays [world, k] of single-precision numbers that are the state of robots and boxes."""
        data = self.data
        return [data.qpos, data.qvel, data.qacc, data.qacc_warmstart, data.act, data.ctrl, data.qfrc_applied]

    def fill(self, struct: Any, source: Any = None) -> Any:
        """Returns a Warp struct whose fields are arrays of mujoco_warp with the same names: of its data, or of
        ``source``."""
        made = struct()
        for name in struct_fields(struct):
            setattr(made, name, getattr(self.data if source is None else source, name))
        return made

    def effective_mass(self) -> EffectiveMass:
        """Returns the arrays from which the effective mass of a step follows."""
        made = EffectiveMass()
        made.qH = self.data.qH
        made.row_start = self.model.M_rowadr
        made.row_count = self.model.M_rownnz
        made.column = self.model.M_colind
        made.nefc = self.data.nefc
        made.J_rownnz = self.data.efc.J_rownnz
        made.J_rowadr = self.data.efc.J_rowadr
        made.J_colind = self.data.efc.J_colind
        made.J = self.data.efc.J
        made.D = self.data.efc.D
        made.state = self.data.efc.state
        return made
