"""The same plants, or the whole scene, in MuJoCo: the reference of tests and benchmarks.

MuJoCo's ball joint has one stiffness for all axes, so each joint takes its first bending stiffness; for an exact
comparison build trees whose springs are isotropic.
"""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim.contact.plant_capsules import plant_capsules
from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.rigid.robot_body import RobotBody
from vinesim.rigid.static_world import FIXED, ROBOT_CODES, build_static_world, contact_friction
from vinesim.scene.builder import GRAVITY
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State
from vinesim.scene.values import RobotSpec


def compile_plants(model: Model, *, dt: float = 0.01, damping: np.ndarray | None = None) -> mujoco.MjModel:
    """Returns all trees of ``model`` as chains of ball joints under ``integrator="discrete"``, without contacts.

    ``damping`` [body] N m s/rad replaces the model's: vinesim's solver subtracts the damping that its scheme adds,
    MuJoCo does not.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = dt
    spec.option.gravity = GRAVITY
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT
    spec.memory = 1 << 28
    _add_plants(spec, model, model.joint_damping[:, 1] if damping is None else damping)
    return spec.compile()


def _add_plants(spec: mujoco.MjSpec, model: Model, damping: np.ndarray) -> list[mujoco.MjsBody]:
    """Add all trees to a world; ``damping`` [body] N m s/rad. Returns MuJoCo's bodies, without geoms.

    Berry clusters are bodies of their own; the body of their bunch is the upper part of the bunch.
    """
    made: list[mujoco.MjsBody] = []
    mass = model.body_mass.copy()
    com = model.body_com.copy()
    inertia = model.body_inertia.copy()
    clustered = model.bunch_clusters > 0
    heads = model.bunch_body[clustered]
    mass[heads] = model.bunch_head_mass[clustered]
    com[heads] = model.bunch_head_com[clustered]
    inertia[heads] = model.bunch_head_inertia[clustered]
    for body in range(len(model.body_mass)):
        parent = int(model.body_parent[body])
        pose = frames.pose(model.body_offset[body], model.body_rest[body])
        if parent < 0:
            pose = frames.compose(model.tree_pose[model.body_tree[body]].astype(float), pose)
        child = (spec.worldbody if parent < 0 else made[parent]).add_body(
            name=f"plant/{body}",
            pos=pose[:3],
            quat=frames.to_wxyz(pose[3:]),
            mass=float(mass[body]),
            ipos=com[body],
            inertia=inertia[body],
            explicitinertial=True,
        )
        child.add_joint(
            name=f"plant/{body}",
            type=mujoco.mjtJoint.mjJNT_BALL,
            stiffness=float(model.joint_stiffness[body, 1]),
            damping=float(damping[body]),
        )
        made.append(child)
    return made


PLANT_IMPEDANCE = (0.925, 0.97, 0.001, 0.5, 2)
"""Impedance of the contacts of plants (MuJoCo's solimp), whatever they touch: about as soft as vinesim's 2e4 N/m."""


class MujocoScene:
    """A scene of plants and robots entirely in MuJoCo: one world, ball joints, a capsule or spheres for every body.

    Bunches that have berry clusters are always fine: each cluster is a body with its own capsule.

    Robots touch plants; plants do not touch each other (in vinesim they may, so MuJoCo has less to compute). Commands
    go to ``rigid``, as in :class:`vinesim.world.Physics`. The scheme of ``discrete`` adds damping of dt K, which is
    subtracted from the model's damping, down to zero.

    ``contact_time_constant`` [s] of every contact (solref); the default of MuJoCo, 0.02, is soft: at 3 m/s bodies
    overlap by centimetres.
    """

    def __init__(
        self, model: Model, robots: list[RobotSpec], *, dt: float = 0.01, contact_time_constant: float | None = None
    ) -> None:
        self.rigid = mine = RigidWorld(model, parameters=PhysicsParameters(dt=dt))
        for robot in robots:
            mine.add_robot(robot)
        spec = build_static_world(model, mine.parameters)
        spec.memory = 1 << 29
        spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        for code, robot in zip(ROBOT_CODES, robots, strict=False):
            RobotBody(robot, code, mine.parameters).add_to(spec)
        made = _add_plants(spec, model, np.maximum(model.joint_damping - dt * model.joint_stiffness, 0.0)[:, 1])
        shapes = plant_capsules(model)
        fine = np.flatnonzero(np.isin(shapes.level, (0, 2)))
        columns = shapes.body[fine], shapes.start[fine], shapes.end[fine], shapes.radius[fine]
        for body, start, end, radius in zip(*columns, strict=True):
            kind = mujoco.mjtGeom.mjGEOM_SPHERE
            place = {"pos": start}
            if (start != end).any():
                kind = mujoco.mjtGeom.mjGEOM_CAPSULE
                place = {"fromto": np.concatenate([start, end])}
            made[body].add_geom(
                type=kind,
                size=[float(radius), 0, 0],
                contype=FIXED,
                conaffinity=0,
                mass=0.0,
                friction=contact_friction(mine.parameters.friction),
                solref=[0.02, 1],
                solimp=PLANT_IMPEDANCE,
                solmix=1e6,
                **place,
            )
        world = spec.compile()
        if contact_time_constant is not None:
            world.geom_solref[:] = contact_time_constant, 1.0
            world.geom_solimp[:] = 0.99, 0.999, 0.001, 0.5, 2.0
        data = mujoco.MjData(world)
        for j in range(mine.mj_model.njnt):
            joint = mine.mj_model.joint(j)
            if joint.name.split("/")[0].split(":")[0] in mine.robots:
                data.joint(joint.name).qpos[:] = mine.mj_data.joint(j).qpos
        for body, q in enumerate(model.joint_settled):
            data.joint(f"plant/{body}").qpos[:] = frames.to_wxyz(q)
        mine.rebind(world, data)
        self.world = world
        self.data = data

    def step(self) -> None:
        """Advance the whole scene by one step."""
        self.rigid.apply_controls()
        mujoco.mj_step(self.world, self.data)
        self.rigid.invalidate_kinematics()

    def body_pose(self, body: int) -> np.ndarray:
        """Returns the pose [7] of a plant's body after the last step."""
        self.rigid.update_kinematics()
        there = self.data.body(f"plant/{body}")
        return np.concatenate([there.xpos, frames.from_wxyz(there.xquat)])

    def contact_force_on(self, link: str) -> np.ndarray:
        """Returns the force [3] N of all contacts on the robot link of this name in the last step."""
        total = np.zeros(3)
        wrench = np.zeros(6)
        for number in range(self.data.ncon):
            contact = self.data.contact[number]
            mujoco.mj_contactForce(self.world, self.data, number, wrench)
            force = contact.frame.reshape(3, 3).T @ wrench[:3]
            one, other = (
                self.world.body(self.world.geom_bodyid[geom]).name.endswith("/" + link) for geom in contact.geom
            )
            total += (float(other) - float(one)) * force
        return total

    def plant_contact_count(self) -> int:
        """Returns the number of contacts between plants and robots in the last step."""
        bodies = self.world.geom_bodyid[self.data.contact.geom]
        is_plant = np.array([self.world.body(i).name.startswith("plant/") for i in range(self.world.nbody)])
        return int((is_plant[bodies].sum(1) == 1).sum())


def copy_state_to_mujoco(state: State, data: mujoco.MjData) -> None:
    """Copy joint rotations and rates into MuJoCo, whose ball joint rates are in the axes of the child body."""
    data.qpos[:] = frames.to_wxyz(state.joint_q).ravel()
    data.qvel[:] = frames.rotate(frames.conjugate(state.joint_q), state.joint_qd).ravel()
