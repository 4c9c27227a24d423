"""What the kernels of the tasks with an arm read and write, of a batch of worlds or of the physics of a client."""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp

from vinesim.contact.plant_capsules import PlantCapsules
from vinesim.core import frames
from vinesim.interaction.blades import Blade
from vinesim.kernels.contact.structs import Capsules, Contacts
from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.learn.pick import BunchPlaces
from vinesim.kernels.learn.prune import CanePlaces
from vinesim.kernels.learn.reach import ArmState, move_targets
from vinesim.kernels.worlds.narrowphase import WorldContacts
from vinesim.learn.arm import AXES, JOINT_LIMIT, TOOL, TOOL_LINK
from vinesim.learn.task_env import STEPS
from vinesim.scene.model import Model
from vinesim.world import Physics
from vinesim.worlds.worlds import Worlds

SPEED = 1.0
"""[rad/s] Speed of a joint's target at action 1."""
CONTACTS = 256
"""Largest number of contacts of a client's world that are observed. GUESSED: an arm in canes has some 20."""
LEAD = 0.3
"""[rad] Largest distance of a joint's target from the joint."""


@dataclasses.dataclass(frozen=True)
class ArmArrays:
    """Arrays of one world or several on one device. Tree t of world w has the number ``t * worlds + w``."""

    worlds: int
    """Number of worlds."""
    arm: ArmState
    fingers: wp.array
    """[2] Indices of the left and the right finger in ``arm.qpos``."""
    places: BunchPlaces
    """The bunches, on their vines and off them."""
    body_qd: wp.array
    """[body] Velocities of plant bodies."""
    bunch_size: wp.array
    """[tree] vec2 m, length and radius of the tree's bunch."""
    capsules: Capsules
    """Collision capsules of the plants. Capsule i of a tree is at ``i * trees + tree``; an entry without a body is no
    capsule."""
    contacts: Contacts
    world_contacts: WorldContacts
    targets: wp.array
    """[world, joint] rad or m, targets of the servos."""
    closing: wp.array
    """[world] Whether the blade closes at the end of the action."""
    canes: CanePlaces
    """The trees as canes that the blade cuts; empty without a blade."""

    @property
    def bunches(self) -> list[wp.array]:
        """The arguments of kernels for the bunches on their vines."""
        return [self.places.body, self.places.com, self.places.body_q]

    @property
    def device(self) -> wp.Device:
        """Where the arrays are."""
        return self.targets.device

    def move(self, action: wp.array, dt: float) -> KernelLaunch:
        """Returns the launch that moves the targets by an action [world, k]. ``dt`` [s]: duration of a step."""
        joints = len(AXES)
        limit = np.full(joints, JOINT_LIMIT)
        limits = [wp.array(side, dtype=float, device=self.device) for side in (-limit, limit)]
        given = [SPEED * STEPS * dt, *limits, LEAD, self.arm.q, action, self.arm.qpos]
        return KernelLaunch(move_targets, given, [self.targets], threads=self.worlds, width=joints)


def arrays_of_worlds(worlds: Worlds) -> ArmArrays:
    """Returns the arrays of a batch, on its device. They are the batch's own."""
    data = worlds.bodies.data
    robot = worlds.bodies.rigid.robot("arm")
    device = worlds.bodies.device
    slots = worlds.plants.buffers.slots
    resident = worlds.plants.launches.resident_arrays
    pool = worlds.pool
    arm = _arm_state(robot.bodies[TOOL_LINK], robot.q, robot.v, device)
    arm.xpos, arm.xmat, arm.qpos, arm.qvel = data.xpos, data.xmat, data.qpos, data.qvel
    places = _places(worlds.model, slots, arm, device)
    places.body_q = resident["body_q"]
    if pool is None:
        places.slots = wp.zeros((worlds.count, 0), dtype=wp.int32, device=device)
        places.free_body, places.free_v = (wp.zeros(0, dtype=wp.int32, device=device) for _ in range(2))
        closing = wp.zeros(worlds.count, dtype=wp.bool, device=device)
        canes = CanePlaces()
    else:
        places.slots, places.free_body, places.free_v = pool.bunch, pool.table.body, pool.table.v
        closing = pool.closing
        canes = _cane_places(worlds.model, slots, worlds.plants.buffers.slot_count, device)
        canes.first, canes.size = resident["tree_first"], resident["tree_size"]
        canes.pitch = worlds.plants.buffers.pitch
        canes.body_q = resident["body_q"]
        parts, canes.is_cut = pool.canes.parts
        canes.segment, canes.start = parts.segment, parts.start
    contacts, world_contacts = worlds.contacts.lists()
    return ArmArrays(
        worlds=worlds.count,
        arm=arm,
        fingers=wp.array(robot.q[len(AXES) :], dtype=wp.int32, device=device),
        places=places,
        body_qd=resident["body_qd"],
        bunch_size=_bunch_size(worlds.model, device),
        capsules=worlds.contacts.capsules,
        contacts=contacts,
        world_contacts=world_contacts,
        targets=worlds.bodies.targets,
        closing=closing,
        canes=canes,
    )


class ClientArm:
    """The arrays of one world that a client's physics steps, on the CPU. :meth:`read` copies its state into them.

    Forces of contacts are sizes, along the first axis. The arm's tool is body 0, and the bunch of tree t is body 1 + t
    while it is off its vine.

    Args:
        physics: the world.
        robot: name of its arm (:mod:`vinesim.learn.arm`).
    """

    def __init__(self, physics: Physics, robot: str) -> None:
        self._physics = physics
        self._robot = physics.rigid.robot(robot)
        blades = [blade for blade in physics.detachment_monitor.blades if blade.actor == robot]
        self.blade: Blade | None = blades[0] if blades else None
        """The blade of the arm; None: it has none."""
        model = physics.model
        trees = len(model.tree_first)
        bodies = len(model.body_tree)
        joints = len(self._robot.q)
        device = wp.get_device("cpu")
        arm = _arm_state(0, np.arange(joints), np.arange(joints), device)
        arm.xpos, arm.xmat = (wp.zeros((1, 1 + trees), dtype=dtype, device=device) for dtype in (wp.vec3, wp.mat33))
        arm.qpos = wp.zeros((1, joints), dtype=float, device=device)
        arm.qvel = wp.zeros((1, joints + 6 * trees), dtype=float, device=device)
        places = _places(model, np.arange(bodies), arm, device)
        places.body_q = wp.zeros(bodies, dtype=wp.transform, device=device)
        places.slots = wp.full((1, trees), -1, dtype=wp.int32, device=device)
        places.free_body = wp.array(1 + np.arange(trees), dtype=wp.int32, device=device)
        places.free_v = wp.array(joints + 6 * np.arange(trees), dtype=wp.int32, device=device)
        contacts = Contacts()
        contacts.force, contacts.point = (wp.zeros(CONTACTS, dtype=wp.vec3d, device=device) for _ in range(2))
        world_contacts = WorldContacts()
        world_contacts.count = wp.zeros(1, dtype=wp.int32, device=device)
        world_contacts.tree = wp.zeros(CONTACTS, dtype=wp.int32, device=device)
        canes = _cane_places(model, np.arange(bodies), bodies, device)
        canes.first = wp.array(model.tree_first, dtype=wp.int32, device=device)
        canes.size = wp.array(np.diff(np.append(model.tree_first, bodies)), dtype=wp.int32, device=device)
        canes.pitch = 1
        canes.body_q = places.body_q
        canes.segment = wp.zeros(bodies, dtype=wp.int32, device=device)
        canes.start = wp.zeros(bodies, dtype=float, device=device)
        canes.is_cut = wp.zeros(bodies, dtype=wp.bool, device=device)
        self.arrays = ArmArrays(
            worlds=1,
            arm=arm,
            fingers=wp.array(np.arange(joints)[len(AXES) :], dtype=wp.int32, device=device),
            places=places,
            body_qd=wp.zeros(bodies, dtype=wp.spatial_vector, device=device),
            bunch_size=_bunch_size(model, device),
            capsules=_capsules(physics.contact_solver.capsules, trees),
            contacts=contacts,
            world_contacts=world_contacts,
            targets=wp.array(self._robot.target[None], dtype=float, device=device),
            closing=wp.zeros(1, dtype=wp.bool, device=device),
            canes=canes,
        )

    def read(self) -> None:
        """Copy the state after the last step. As in a batch, poses of plants are those at its start, and with a blade
        those at its end."""
        physics = self._physics
        rigid = physics.rigid
        physics.rigid.update_kinematics()
        if self.blade is not None:
            physics.update_kinematics()
        d = rigid.mj_data
        arm = self.arrays.arm
        places = self.arrays.places
        joints = len(self._robot.q)
        tool = self._robot.bodies[TOOL_LINK]
        xpos, xmat, qvel, slots = (array.numpy()[0] for array in (arm.xpos, arm.xmat, arm.qvel, places.slots))
        xpos[0] = d.xpos[tool]
        xmat[0] = d.xmat[tool].reshape(3, 3)
        arm.qpos.numpy()[0] = d.qpos[self._robot.q]
        qvel[:joints] = d.qvel[self._robot.v]
        slots[:] = -1
        for bunch in rigid.free_bunches:
            pose = rigid.bunch_pose(bunch)
            slots[bunch] = bunch
            xpos[1 + bunch] = pose[:3]
            xmat[1 + bunch] = frames.to_matrix(pose[3:])
            qvel[joints + 6 * bunch : joints + 6 * bunch + 6] = rigid.bunch_rates(bunch)
        places.body_q.numpy()[:] = physics.state.body_q
        self.arrays.body_qd.numpy()[:] = physics.state.body_qd
        self._read_contacts()
        state = physics.state
        canes = self.arrays.canes
        canes.segment.numpy()[:] = np.where(state.stump_of >= 0, state.stump_of, np.arange(len(state.stump_of)))
        canes.start.numpy()[:] = physics.plants.body_start
        canes.is_cut.numpy()[:] = state.body_cut

    def _read_contacts(self) -> None:
        arrays = self.arrays
        found = self._physics.contacts[:CONTACTS]
        count = len(found)
        arrays.world_contacts.count.numpy()[0] = count
        if count:
            body = np.array([contact.body for contact in found])
            arrays.world_contacts.tree.numpy()[:count] = self._physics.model.body_tree[body]
            arrays.contacts.force.numpy()[:count, 0] = [np.linalg.norm(contact.force) for contact in found]
            arrays.contacts.point.numpy()[:count] = [contact.position for contact in found]


def _arm_state(tool_body: int, q: np.ndarray, v: np.ndarray, device: wp.Device) -> ArmState:
    """Returns the arm with its tool and its seven joints; the caller sets the arrays of its state."""
    state = ArmState()
    state.tool_body = tool_body
    state.tool = wp.vec3(*TOOL)
    state.q, state.v = (wp.array(index[: len(AXES)], dtype=wp.int32, device=device) for index in (q, v))
    return state


def _places(model: Model, slots: np.ndarray, arm: ArmState, device: wp.Device) -> BunchPlaces:
    """Returns where the bunches are; the caller sets the arrays of the free ones, and ``body_q``.

    ``slots``: [body] index in ``body_q``.
    """
    body = model.bunch_body
    segment = model.body_parent[body]
    places = BunchPlaces()
    places.body, places.segment = (wp.array(slots[index], dtype=wp.int32, device=device) for index in (body, segment))
    places.com = wp.array(model.body_com[body], dtype=wp.vec3, device=device)
    places.length = wp.array(model.body_length[segment], dtype=float, device=device)
    places.xpos, places.xmat, places.qvel = arm.xpos, arm.xmat, arm.qvel
    return places


def _cane_places(model: Model, slots: np.ndarray, slot_count: int, device: wp.Device) -> CanePlaces:
    """Returns the lengths of canes; the caller sets the arrays of trees, poses and cuts.

    ``slots``: [body] index of each body in the arrays of ``slot_count`` rows.
    """
    length, base = np.zeros((2, slot_count), np.float32)
    length[slots] = model.body_length
    along = np.zeros(len(model.body_length))
    for body in range(len(along)):
        if (parent := model.body_parent[body]) >= 0:
            along[body] = along[parent] + model.body_length[parent]
    base[slots] = along
    canes = CanePlaces()
    canes.length = wp.array(length, dtype=float, device=device)
    canes.base = wp.array(base, dtype=float, device=device)
    return canes


def _bunch_size(model: Model, device: wp.Device) -> wp.array:
    return wp.array(np.stack([model.bunch_length, model.bunch_radius], -1), dtype=wp.vec2, device=device)


def _capsules(given: PlantCapsules, trees: int) -> Capsules:
    """Returns the places and sizes of the capsules of awake plants in the order of :attr:`ArmArrays.capsules`."""
    start = given.tree_start
    count = np.diff(start)
    at = np.concatenate([np.arange(number) * trees + tree for tree, number in enumerate(count)])
    body = np.full(int(count.max()) * trees, -1)
    body[at] = np.where(given.level <= 1, given.body, -1)[: start[-1]]
    capsules = Capsules()
    capsules.body = wp.array(body, dtype=wp.int32, device="cpu")
    for name, values, dtype in (
        ("local_start", given.start, wp.vec3),
        ("local_end", given.end, wp.vec3),
        ("radius", given.radius, float),
    ):
        rows = np.zeros((len(body), *values.shape[1:]))
        rows[at] = values[: start[-1]]
        setattr(capsules, name, wp.array(rows, dtype=dtype, device="cpu"))
    return capsules
