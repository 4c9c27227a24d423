"""The base of a robot on uneven ground: height, pitch and roll follow the plane under its footprint.

On level ground the base has three joints (x, y, yaw). On uneven ground it has three more (z, pitch, roll), with servos
as stiff as a chassis on its tracks. Their targets are the least-squares plane of the ground under the footprint at the
end of the step, and its rate. So MuJoCo knows the velocities and accelerations of the tilting base: inertial units,
wrenches and the loads of joints contain them (docs/decisions/terrain.md).
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from vinesim.rigid import recompile
from vinesim.scene.terrain import Terrain

AXES = ("z", "pitch", "roll")
FREQUENCY = 10.0
"""[Hz] Natural frequency of the base on its tracks, with critical damping. GUESSED: rubber tracks on soil, without
springs; 200 kg sink by 0.25 mm under 20 kg more."""
GYRATION_RADIUS = 0.6
"""[m] Radius of gyration of a robot about its pitch and roll axes, from which their stiffness follows. GUESSED."""
MAX_EFFORT = 1e7
"""[N, N m] Effort limit of the servos, which is never reached."""
STANDING_HEIGHT = 0.1
"""[m] Shapes with a part below this height above the ground belong to the footprint."""
DEFAULT_FOOTPRINT = (0.3, 0.25)
"""[m] Half length and half width of the footprint of a robot without shapes near the ground. GUESSED."""


def footprint(parsed: mujoco.MjSpec) -> tuple[float, float]:
    """Returns half the length and half the width [m] of the rectangle around the origin that contains all shapes of a
    ``parsed`` robot near the ground."""
    alone = parsed.copy()
    m = recompile.compile_without_contacts(alone)
    d = mujoco.MjData(m)
    mujoco.mj_kinematics(m, d)
    signs = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), -1).reshape(8, 3)
    corner = m.geom_aabb[:, None, :3] + signs * m.geom_aabb[:, None, 3:]
    corner = np.einsum("gij,gkj->gki", d.geom_xmat.reshape(-1, 3, 3), corner) + d.geom_xpos[:, None]
    near = corner[..., 2].min(1, initial=np.inf) < STANDING_HEIGHT
    if not near.any():
        return DEFAULT_FOOTPRINT
    length, width = np.abs(corner[near][..., :2]).max((0, 1)).tolist()
    return max(length, 0.05), max(width, 0.05)


class GroundFollower:
    """Lets one base follow the ground: targets of its joints z, pitch and roll."""

    def __init__(self, terrain: Terrain, footprint: tuple[float, float]) -> None:
        """``footprint``: half length and half width [m] of the rectangle on the ground."""
        self.terrain = terrain
        self.footprint = footprint
        self._q = self._v = self._actuator = np.zeros(0, int)
        """[3] Indices of z, pitch and roll in MuJoCo's qpos, qvel and ctrl."""
        self._stiffness = np.zeros(3)
        """[3] N/m, N m/rad, N m/rad."""
        self._damping = np.zeros(3)
        self._weight = 0.0
        """[N] Weight of the robot."""
        self._drive = np.zeros((0, 2))
        """MuJoCo's force range [2, 2] N of the base's servos along x and y."""
        self._traction = 0.0
        """[N] Largest force of the tracks."""

    def find_indices(
        self, m: mujoco.MjModel, names: recompile.WorldNames, robot: str, drives: np.ndarray, traction: float
    ) -> None:
        """Look up the MuJoCo indices of the joints in a recompiled world, and set the gains of their servos.

        ``drives`` [2]: actuators of the base along x and y; ``traction``: largest force of the tracks [N].
        """
        joints = [names.joint[f"{robot}:{axis}"] for axis in AXES]
        self._q = m.jnt_qposadr[joints].astype(int)
        self._v = m.jnt_dofadr[joints].astype(int)
        self._actuator = np.array([names.actuator[f"{robot}:{axis}"] for axis in AXES], int)
        rate = 2.0 * np.pi * FREQUENCY
        mass = float(m.body_subtreemass[names.body[robot]])
        self._weight = -mass * float(m.opt.gravity[2])
        self._drive = m.actuator_forcerange[drives[0] : drives[1] + 1]
        self._traction = traction
        inertia = mass * np.array([1.0, GYRATION_RADIUS**2, GYRATION_RADIUS**2])
        self._stiffness = inertia * rate * rate
        self._damping = 2.0 * inertia * rate
        m.actuator_biasprm[self._actuator, 1] = -self._stiffness
        m.actuator_biasprm[self._actuator, 2] = -self._damping

    def standing(self, base: np.ndarray) -> np.ndarray:
        """Returns height [m], pitch and roll [rad] [..., 3] of a base that stands at ``base`` [..., 3]: x, y [m] and
        yaw [rad]."""
        return _attitude(self.terrain.fit_plane(base[..., 0], base[..., 1], base[..., 2], self.footprint))

    def place(self, d: mujoco.MjData, base: np.ndarray) -> None:
        """Put the base on the ground at ``base`` [3]: x, y [m] and yaw [rad]; at rest."""
        d.qpos[self._q] = self.standing(base)
        d.qvel[self._v] = 0.0

    def apply_controls(self, d: mujoco.MjData, base: np.ndarray, velocity: np.ndarray, dt: float) -> None:
        """Before a step of ``dt`` [s]: write MuJoCo's controls. ``base`` [3]: x, y [m] and yaw [rad]; ``velocity`` [3]:
        their rates."""
        x, y, yaw = np.stack([base, base + dt * velocity], 1)
        planes = self.terrain.fit_plane(x, y, yaw, self.footprint)
        now, then = _attitude(planes)
        d.ctrl[self._actuator] = self._stiffness * then + self._damping * (then - now) / dt
        # MuJoCo's robots are weightless (gravcomp); the tracks have to carry what pulls the robot downhill
        _, along, across = planes[0].tolist()
        c = math.cos(base[2])
        s = math.sin(base[2])
        level = 1.0 / math.sqrt(1.0 + along * along + across * across)  # cosine of the incline
        pull = -self._weight * level * level
        downhill = np.array([[pull * (c * along - s * across)], [pull * (s * along + c * across)]])
        self._drive[:] = downhill + level * np.array([-self._traction, self._traction])

    def level_velocity(self, d: mujoco.MjData, velocity: np.ndarray) -> tuple[float, float, float]:
        """Returns the rates of the horizontal position [m/s], in axes with the base's yaw, and of the yaw [rad/s].
        ``velocity`` [3]: vx, vy [m/s] and wz [rad/s] of the base in its own axes."""
        _, pitch, roll = d.qpos[self._q].tolist()
        vx, vy, wz = velocity.tolist()
        level = math.cos(pitch)
        upright = math.cos(roll)
        return level * vx + math.sin(pitch) * math.sin(roll) * vy, upright * vy, wz * upright / level

    def base_state(
        self, d: mujoco.MjData, base: tuple[float, float, float], rate: tuple[float, float, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns pose [7] and velocity [6] (world axes) of the base. ``base``: x, y [m] and yaw [rad]; ``rate``: their
        rates."""
        z, pitch, roll = d.qpos[self._q].tolist()
        vz, pitch_rate, roll_rate = d.qvel[self._v].tolist()
        x, y, yaw = base
        # the product of the quaternions of yaw, pitch and roll, in Python floats: ten times as fast as frames.multiply
        sy, cy, sp, cp, sr, cr = (part(0.5 * angle) for angle in (yaw, pitch, roll) for part in (math.sin, math.cos))
        turn = (
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
            cy * cp * cr + sy * sp * sr,
        )
        c = math.cos(yaw)
        s = math.sin(yaw)
        level = math.cos(pitch)
        spin = (
            -s * pitch_rate + c * level * roll_rate,
            c * pitch_rate + s * level * roll_rate,
            rate[2] - math.sin(pitch) * roll_rate,
        )
        return np.array([x, y, z, *turn]), np.array([rate[0], rate[1], vz, *spin])


def _attitude(plane: np.ndarray) -> np.ndarray:
    """Returns height [m], pitch and roll [rad] [..., 3] of a body on a ``plane`` [..., 3] of
    :meth:`Terrain.fit_plane`."""
    along = plane[..., 1]
    result = plane.copy()
    result[..., 1] = -np.arctan(along)
    result[..., 2] = np.arctan2(plane[..., 2], np.sqrt(1.0 + along * along))
    return result
