"""The base of a legged robot: it moves freely in six degrees of freedom, and its legs carry it.

MuJoCo's robots are weightless (``gravcomp``): the drives carry the weight of the links beyond their joints. Of a free
base nothing carries the weight, so MuJoCo's compensation of it is removed in each step, and the whole weight of the
robot ends in the contacts of its feet.

The copy of a robot that another client simulates has no weight: a spring and a damper on its base, which act on the
state at the end of the step, pull it to the received pose.
"""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid import recompile


def joint_name(robot: str) -> str:
    """Returns the name of the joint of a robot's free base."""
    return f"{robot}:base"


class FreeBase:
    """The free base of one robot, and its indices in MuJoCo's arrays."""

    def __init__(self, stiffness: np.ndarray, damping: np.ndarray, effort: np.ndarray) -> None:
        """``stiffness``, ``damping``, ``effort``: [6] gains and largest effort of the spring that pulls a copy, in
        N/m, N m/rad etc.: linear along the axes of the world, then angular about those of the base."""
        self._stiffness = stiffness
        self._damping = damping
        self._effort = effort
        self._goal: np.ndarray | None = None
        """[7] Pose to which the copy of a remote robot is pulled; None: nothing pulls."""
        self._goal_velocity = np.zeros(6)
        """[6] Velocity at the goal: linear in world axes, angular in those of the base."""
        self.q = self.v = np.zeros(0, int)
        """[7] and [6] indices of the base in MuJoCo's qpos and qvel."""

    def add_to(self, spec: mujoco.MjSpec, robot: str) -> mujoco.MjsBody:
        """Add the body of the base to a world and return it."""
        base = spec.worldbody.add_body(name=robot, sleep=mujoco.mjtSleepPolicy.mjSLEEP_NEVER)
        base.add_joint(name=joint_name(robot), type=mujoco.mjtJoint.mjJNT_FREE)
        return base

    def find_indices(self, m: mujoco.MjModel, names: recompile.WorldNames, robot: str) -> None:
        """Look up the MuJoCo indices of the base in a recompiled world."""
        joint = names.joint[joint_name(robot)]
        self.q = int(m.jnt_qposadr[joint]) + np.arange(7)
        self.v = int(m.jnt_dofadr[joint]) + np.arange(6)
        self._set_damping(m)

    def take_over(self, other: FreeBase) -> None:
        """Copy the goal of ``other``, the base of the same robot with other shapes."""
        self._goal = other._goal
        self._goal_velocity = other._goal_velocity

    def place(self, d: mujoco.MjData, pose: np.ndarray) -> None:
        """Put the base at ``pose`` [7], at rest."""
        d.qpos[self.q] = np.concatenate([pose[:3], frames.to_wxyz(frames.normalize(pose[3:]))])
        d.qvel[self.v] = 0.0

    def state(self, d: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pose [7] and the velocity [6] (world axes) of the base."""
        at = d.qpos[self.q]
        rate = d.qvel[self.v]
        turn = frames.from_wxyz(at[3:])
        return np.concatenate([at[:3], turn]), np.concatenate([rate[:3], frames.rotate(turn, rate[3:])])

    def follow(self, m: mujoco.MjModel, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Pull the base to ``pose`` [7], which moves with ``velocity`` [6] (world axes)."""
        was_free = self._goal is None
        self._goal = pose
        self._goal_velocity = np.concatenate([velocity[:3], frames.rotate(frames.conjugate(pose[3:]), velocity[3:])])
        if was_free:
            self._set_damping(m)

    def load(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """After ``mj_step1``: let the base carry the robot's weight, or pull that of a copy."""
        if self._goal is None:
            d.qfrc_passive[self.v] -= d.qfrc_gravcomp[self.v]
            d.qfrc_gravcomp[self.v] = 0.0
            return
        dt = m.opt.timestep
        here, _ = self.state(d)
        away = np.empty(6)
        away[:3] = self._goal[:3] - here[:3]
        away[3:] = frames.log(frames.multiply(frames.conjugate(here[3:]), self._goal[3:]))
        pull = self._stiffness * (away + dt * self._goal_velocity)
        pull = np.minimum(np.maximum(pull, -self._effort), self._effort)
        d.qfrc_passive[self.v] += pull + self._damping * self._goal_velocity

    def _set_damping(self, m: mujoco.MjModel) -> None:
        """Write the damping of a copy's base into MuJoCo's model, which applies it to the velocity at the end of the
        step. A spring that acts at the end of the step damps by ``dt`` times its stiffness, too."""
        m.dof_damping[self.v] = 0.0 if self._goal is None else self._damping + m.opt.timestep * self._stiffness
