"""What the kernels of the tasks with an arm read and write, of a batch of worlds or of the physics of a client."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from vinesim.kernels.contact.structs import Contacts
from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.learn.reach import ArmState, move_targets
from vinesim.kernels.worlds.narrowphase import WorldContacts
from vinesim.learn.arm import AXES, JOINT_LIMIT, TOOL, TOOL_LINK
from vinesim.learn.task_env import STEPS
from vinesim.world import Physics
from vinesim.worlds.worlds import Worlds

SPEED = 1.0
"""[rad/s] Speed of a joint's target at action 1."""
LEAD = 0.3
"""[rad] Largest distance of a joint's target from the joint."""


@dataclasses.dataclass(frozen=True)
class ArmArrays:
    """Arrays of one world or several on one device. Tree t of world w has the number ``t * worlds + w``."""

    worlds: int
    """Number of worlds."""
    arm: ArmState
    bunch: wp.array
    """[tree] Index of the tree's bunch in :attr:`body_q`."""
    bunch_com: wp.array
    """[tree] vec3 m, centre of mass of the bunch in its body's axes."""
    body_q: wp.array
    """[body] Poses of plant bodies."""
    contacts: Contacts
    world_contacts: WorldContacts
    targets: wp.array
    """[world, joint] rad, targets of the servos."""

    @property
    def bunches(self) -> list[wp.array]:
        """The arguments of kernels for the bunches."""
        return [self.bunch, self.bunch_com, self.body_q]

    @property
    def device(self) -> wp.Device:
        """Where the arrays are."""
        return self.targets.device

    def move(self, action: wp.array, dt: float) -> KernelLaunch:
        """Returns the launch that moves the targets by an action [world, joint]. ``dt`` [s]: duration of a step."""
        joints = len(AXES)
        limit = np.full(joints, JOINT_LIMIT)
        limits = [wp.array(side, dtype=float, device=self.device) for side in (-limit, limit)]
        given = [SPEED * STEPS * dt, *limits, LEAD, self.arm.q, action, self.arm.qpos]
        return KernelLaunch(move_targets, given, [self.targets], threads=self.worlds, width=joints)


def arrays_of_worlds(worlds: Worlds) -> ArmArrays:
    """Returns the arrays of a batch, on its device. They are the batch's own."""
    data = worlds.bodies.data
    robot = worlds.bodies.rigid.robot("arm")
    body = worlds.model.bunch_body
    device = worlds.bodies.device
    contacts, world_contacts = worlds.contacts.lists()
    return ArmArrays(
        worlds=worlds.count,
        arm=_arm_state(robot, device, data.xpos, data.xmat, data.qpos, data.qvel),
        bunch=wp.array(worlds.plants.buffers.slots[body], dtype=wp.int32, device=device),
        bunch_com=wp.array(worlds.model.body_com[body], dtype=wp.vec3, device=device),
        body_q=worlds.plants.launches.resident_arrays["body_q"],
        contacts=contacts,
        world_contacts=world_contacts,
        targets=worlds.bodies.targets,
    )


class ClientArm:
    """The arrays of one world that a client's physics steps, on the CPU. :meth:`read` copies its state into them.

    Contacts of a tree appear as one, with the sum of their sizes.

    Args:
        physics: the world.
        robot: name of its arm (:mod:`vinesim.learn.arm`).
    """

    def __init__(self, physics: Physics, robot: str) -> None:
        self._physics = physics
        self._robot = physics.rigid.robot(robot)
        m = physics.rigid.mj_model
        trees = len(physics.model.tree_first)
        poses = (wp.zeros((1, m.nbody), dtype=dtype, device="cpu") for dtype in (wp.vec3, wp.mat33))
        motion = (wp.zeros((1, size), dtype=float, device="cpu") for size in (m.nq, m.nv))
        contacts = Contacts()
        contacts.force = wp.zeros(trees, dtype=wp.vec3d, device="cpu")
        world_contacts = WorldContacts()
        world_contacts.count = wp.full(1, trees, dtype=wp.int32, device="cpu")
        world_contacts.tree = wp.array(np.arange(trees), dtype=wp.int32, device="cpu")
        body = physics.model.bunch_body
        self.arrays = ArmArrays(
            worlds=1,
            arm=_arm_state(self._robot, wp.get_device("cpu"), *poses, *motion),
            bunch=wp.array(body, dtype=wp.int32, device="cpu"),
            bunch_com=wp.array(physics.model.body_com[body], dtype=wp.vec3, device="cpu"),
            body_q=wp.zeros(len(physics.state.body_q), dtype=wp.transform, device="cpu"),
            contacts=contacts,
            world_contacts=world_contacts,
            targets=wp.array(self._robot.target[None], dtype=float, device="cpu"),
        )

    def read(self) -> None:
        """Copy the state after the last step. Poses of plants are those at its start, as in a batch."""
        physics = self._physics
        physics.rigid.update_kinematics()
        d = physics.rigid.mj_data
        arrays = self.arrays
        arm = arrays.arm
        for target, source in ((arm.xpos, d.xpos), (arm.xmat, d.xmat), (arm.qpos, d.qpos), (arm.qvel, d.qvel)):
            view = target.numpy()
            view[:] = np.reshape(source, view.shape)
        arrays.body_q.numpy()[:] = physics.state.body_q
        force = arrays.contacts.force.numpy()
        force[:] = 0.0
        for contact in physics.contacts:
            force[physics.model.body_tree[contact.body], 0] += np.linalg.norm(contact.force)


def _arm_state(robot: Any, device: Any, xpos: wp.array, xmat: wp.array, qpos: wp.array, qvel: wp.array) -> ArmState:
    state = ArmState()
    state.tool_body = robot.bodies[TOOL_LINK]
    state.tool = wp.vec3(*TOOL)
    state.q, state.v = (
        wp.array(index[: len(AXES)], dtype=wp.int32, device=device) for index in (robot.q, robot.v)
    )  # fmt: skip
    state.xpos = xpos
    state.xmat = xmat
    state.qpos = qpos
    state.qvel = qvel
    return state
