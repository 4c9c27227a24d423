"""One hand of a person: a free body that a spring pulls to its controller, and a weld to what it holds."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid.human_shapes import HAND_HALF_THICKNESS
from vinesim.rigid.mujoco_sleep import wake_body
from vinesim.rigid.recompile import WorldNames
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import HandSample


class HandBody:
    """State of one hand and its indices in MuJoCo's arrays.

    A hand follows its controller until it touches something. From then on it is pulled to its controller by a
    spring, until it has touched nothing for ``hand_contact_duration``. A hand that holds something touches nothing.
    """

    def __init__(self, side: str, stiffness: float, max_force: float, parameters: PhysicsParameters) -> None:
        """``side``: left or right; ``stiffness`` [N/m] and ``max_force`` [N] of its spring."""
        p = self.parameters = parameters
        self.side = side
        self.stiffness = stiffness
        self.max_force = max_force
        self.damping = 2.0 * math.sqrt(stiffness * p.hand_mass)
        """[N s/m] of the spring: critical, so that an empty hand returns without overshoot."""
        self.torsional_damping = 2.0 * math.sqrt(p.hand_torsional_stiffness * p.hand_inertia)
        """[N m s/rad] likewise."""
        self.contact_steps = p.steps(p.hand_contact_duration)
        self.closed = False
        """Whether the hand is to hold what it is near to."""
        self.has_shears = self.is_squeezed = False
        """Whether the hand has shears, and whether it closes, on them or on what it holds: to be seen."""
        self.busy = False
        """Of a remote person's hand: it touches nothing here, since its own client computes what it pushes or holds."""
        self.steps_since_contact = self.contact_steps
        self.force = np.zeros(3)
        """[3] N on the world in the last step, world axes."""
        self.held: tuple[str, str] | None = None
        """Actor and link that the hand holds."""
        self.grasp_pose = np.zeros(7)
        """[7] of the hand in the frame of what it holds."""
        self.on_plant = False
        """It holds a plant and is placed on it: see :mod:`vinesim.interaction.hand_grasp`."""
        self.collision_bits: tuple[int, int] = (0, 0)
        """MuJoCo's contype and conaffinity while the hand can touch something."""
        self.body = self.weld = -1
        self.qpos = self.dofs = slice(0)

    @property
    def link(self) -> str:
        """Name of the hand's link."""
        return f"{self.side}_hand"

    @property
    def is_on_spring(self) -> bool:
        """Whether the spring pulls the hand: it touched something a short time ago."""
        return self.steps_since_contact < self.contact_steps

    def find_indices(self, m: mujoco.MjModel, names: WorldNames, actor: str) -> None:
        """Find the hand of ``actor`` in a world that was compiled anew."""
        name = f"{actor}/{self.link}"
        joint = names.joint[name]
        self.body = names.body[name]
        self.weld = names.equality[name]
        qpos = int(m.jnt_qposadr[joint])
        dof = int(m.jnt_dofadr[joint])
        self.qpos = slice(qpos, qpos + 7)
        self.dofs = slice(dof, dof + 6)

    # ------------------------------------------------------------------ the step

    def apply_control(
        self,
        m: mujoco.MjModel,
        d: mujoco.MjData,
        pose: np.ndarray,
        error: tuple[np.ndarray, np.ndarray],
        motion: tuple[np.ndarray, np.ndarray],
    ) -> None:
        """Before a step: set the spring's force, or the velocity of a free hand.

        Args:
            m: MuJoCo's model.
            d: MuJoCo's data.
            pose: [7] of the hand.
            error: translation [m] and rotation vector [rad] from the hand to its goal.
            motion: translation [m] and rotation vector [rad] of the controller in this step.
        """
        velocity = d.qvel[self.dofs]
        if self.on_plant:
            velocity[:] = d.xfrc_applied[self.body] = 0.0
        elif self.is_on_spring:
            self._pull(d, pose, velocity, error, motion)
        else:
            self._return(m, d, pose, velocity, error, motion)

    def _pull(
        self,
        d: mujoco.MjData,
        pose: np.ndarray,
        velocity: np.ndarray,
        error: tuple[np.ndarray, np.ndarray],
        motion: tuple[np.ndarray, np.ndarray],
    ) -> None:
        """Set the wrench of the spring, limited to what the hand can do."""
        p = self.parameters
        dt = self.parameters.dt
        offset, angle = error
        step, spin = motion
        turning = frames.rotate(pose[3:], velocity[3:])
        force = self.stiffness * offset + self.damping * (step / dt - velocity[:3])
        moment = p.hand_torsional_stiffness * angle + self.torsional_damping * (spin / dt - turning)
        d.xfrc_applied[self.body, :3] = _limited(self.max_force, force)
        d.xfrc_applied[self.body, 3:] = _limited(p.hand_moment, moment)

    def _return(
        self,
        m: mujoco.MjModel,
        d: mujoco.MjData,
        pose: np.ndarray,
        velocity: np.ndarray,
        error: tuple[np.ndarray, np.ndarray],
        motion: tuple[np.ndarray, np.ndarray],
    ) -> None:
        """Set the velocity of a free hand: with its controller, and towards it."""
        p = self.parameters
        dt = self.parameters.dt
        offset, angle = error
        step, spin = motion
        step = step + offset * dt / max(p.hand_return_time, math.sqrt(offset @ offset) / p.hand_return_speed)
        velocity[:3] = self._clip_to_obstacle(m, d, pose[:3], step) / dt
        velocity[3:] = frames.rotate(frames.conjugate(pose[3:]), spin / dt + angle / p.hand_return_time)
        d.xfrc_applied[self.body] = 0.0

    def _clip_to_obstacle(self, m: mujoco.MjModel, d: mujoco.MjData, at: np.ndarray, step: np.ndarray) -> np.ndarray:
        """A translation [3] m of a fast free hand, shortened if an obstacle is in its way."""
        length = float(np.linalg.norm(step))
        if length < HAND_HALF_THICKNESS or self.busy:
            return step
        way = step / length
        gone = 0.0
        geom = np.zeros(1, np.int32)
        while gone < length + HAND_HALF_THICKNESS:
            ahead = mujoco.mj_ray(m, d, at + gone * way, way, None, 1, self.body, geom)
            if ahead < 0.0 or gone + ahead > length + HAND_HALF_THICKNESS:
                return step
            if m.geom_contype[geom[0]] & self.collision_bits[1]:  # not the person's own body, nor what is only drawn
                return way * max(gone + ahead - 0.8 * HAND_HALF_THICKNESS, 0.0)
            gone += ahead + 1e-3
        return step

    def place(self, d: mujoco.MjData, pose: np.ndarray) -> None:
        """Put the hand at ``pose`` [7], at rest."""
        d.qpos[self.qpos] = np.concatenate([pose[:3], frames.to_wxyz(pose[3:])])
        d.qvel[self.dofs] = 0.0

    def measure(self, d: mujoco.MjData) -> None:
        """After a step: read the force of the hand on what it touches or holds."""
        if not self.on_plant:
            reaction = d.qfrc_constraint[self.dofs] + d.qfrc_applied[self.dofs]
            self.force = -reaction[:3]
            self.steps_since_contact = 0 if self.held is not None or reaction.any() else self.steps_since_contact + 1

    def sample(self, d: mujoco.MjData, controller: np.ndarray) -> HandSample:
        """The hand after the last step; ``controller`` [7] is the pose of its controller."""
        pose = np.concatenate([d.qpos[self.qpos][:3], frames.from_wxyz(d.qpos[self.qpos][3:])])
        return HandSample(pose, controller.copy(), self.force.copy(), self.steps_since_contact == 0, self.held)

    # ------------------------------------------------------------------ holding

    def weld_to(self, m: mujoco.MjModel, d: mujoco.MjData, body: int | None) -> None:
        """Weld the hand to a MuJoCo body at ``grasp_pose``; None: the hand holds a plant and is placed on it."""
        self.on_plant = body is None
        self.steps_since_contact = 0
        d.eq_active[self.weld] = body is not None
        if body is not None:
            m.eq_obj2id[self.weld] = body
            m.eq_data[self.weld, :3], m.eq_data[self.weld, 3:6] = self.grasp_pose[:3], 0.0
            m.eq_data[self.weld, 6:10] = frames.to_wxyz(frames.conjugate(self.grasp_pose[3:]))
            m.eq_data[self.weld, 10] = 1.0
            wake_body(m, d, body)
        self.set_collision(m, enabled=False)

    def release(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """Open the hand; it stays on its spring for ``hand_contact_duration`` and then returns to its controller."""
        self.held = None
        self.on_plant = False
        self.steps_since_contact = 0
        if d.eq_active[self.weld]:
            wake_body(m, d, m.eq_obj2id[self.weld])
        d.eq_active[self.weld] = 0
        self.set_collision(m, enabled=True)

    def set_collision(self, m: mujoco.MjModel, *, enabled: bool) -> None:
        """Let the hand touch what it can touch, or nothing."""
        geoms = slice(m.body_geomadr[self.body], m.body_geomadr[self.body] + m.body_geomnum[self.body])
        bit, meets = self.collision_bits if enabled else (0, 0)
        m.geom_contype[geoms] = m.body_contype[self.body] = bit
        m.geom_conaffinity[geoms] = m.body_conaffinity[self.body] = meets


def _limited(limit: float, vector: np.ndarray) -> np.ndarray:
    """A vector [3], shortened to the length ``limit`` if it is longer."""
    length = float(np.linalg.norm(vector))
    return vector * (limit / length) if length > limit else vector
