"""The same plants as a MuJoCo model: the peer that tests and benchmarks hold our solver against.

MuJoCo's ball joint has one stiffness for all axes, so each joint takes its first bending stiffness; for an exact
comparison build trees whose springs are isotropic.
"""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim import frames
from vinesim.world.grow import GRAVITY
from vinesim.world.model import Model
from vinesim.world.state import State


def compile_plants(model: Model, *, dt: float = 0.01, damping: np.ndarray | None = None) -> mujoco.MjModel:
    """All trees of ``model`` as ball-joint chains under ``integrator="discrete"``, contacts off.

    ``damping`` [body] N m s/rad replaces the model's: our solver takes off what its scheme adds, MuJoCo does not.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = dt
    spec.option.gravity = GRAVITY
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT
    spec.memory = 1 << 28
    damping = model.joint_damping[:, 1] if damping is None else damping
    made: list[mujoco.MjsBody] = []
    for body in range(len(model.body_mass)):
        parent = int(model.body_parent[body])
        pose = frames.pose(model.body_offset[body], model.body_rest[body])
        if parent < 0:
            pose = frames.compose(model.tree_pose[model.body_tree[body]].astype(float), pose)
        child = (spec.worldbody if parent < 0 else made[parent]).add_body(
            name=str(body), pos=pose[:3], quat=frames.to_wxyz(pose[3:]), mass=float(model.body_mass[body]),
            ipos=model.body_com[body], inertia=model.body_inertia[body], explicitinertial=True,
        )  # fmt: skip
        child.add_joint(
            type=mujoco.mjtJoint.mjJNT_BALL,
            stiffness=float(model.joint_stiffness[body, 1]),
            damping=float(damping[body]),
        )
        made.append(child)
    return spec.compile()


def copy_state(state: State, data: mujoco.MjData) -> None:
    """Our joints into MuJoCo, whose ball rates are in the moved body's axes."""
    data.qpos[:] = frames.to_wxyz(state.joint_q).ravel()
    data.qvel[:] = frames.rotate(frames.conjugate(state.joint_q), state.joint_qd).ravel()
