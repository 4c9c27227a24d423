"""The task *reach* (:mod:`vinesim.learn.reach`): observation, reward and success of each world, on the batch's device."""

import warp as wp

from vinesim.kernels.contact.structs import Contacts
from vinesim.kernels.worlds.narrowphase import WorldContacts

wp.set_module_options({"enable_backward": False})


@wp.struct
class ReachNumbers:
    """Numbers of the task."""

    reach: float
    """[m] Distance from the bunch's middle at which it is reached."""
    success_reward: float
    distance_cost: float
    """[1/m] Cost of a step per distance."""
    force_cost: float
    """[1/N] Cost of a step per force on other plants."""
    action_cost: float


@wp.struct
class ArmState:
    """The arm of all worlds."""

    tool_body: int
    """MuJoCo body of the tool."""
    tool: wp.vec3
    """[m] The tool's point in the axes of its body."""
    q: wp.array(dtype=wp.int32)
    """[joint] Index in MuJoCo's qpos."""
    v: wp.array(dtype=wp.int32)
    """[joint] Index in MuJoCo's qvel."""
    xpos: wp.array2d(dtype=wp.vec3)
    """[world, body] m."""
    xmat: wp.array2d(dtype=wp.mat33)
    qpos: wp.array2d(dtype=float)
    qvel: wp.array2d(dtype=float)


@wp.func
def observe_arm(world: int, arm: ArmState, observation_out: wp.array2d(dtype=float)):
    """Write the positions of the joints, then their rates, into the first entries of an observation. Returns the tool's
    point [m]."""
    joints = arm.q.shape[0]
    for i in range(joints):
        observation_out[world, i] = arm.qpos[world, arm.q[i]]
        observation_out[world, joints + i] = arm.qvel[world, arm.v[i]]
    return arm.xpos[world, arm.tool_body] + arm.xmat[world, arm.tool_body] * arm.tool


@wp.func
def bunch_middle(body_q: wp.array(dtype=wp.transform), body: int, com: wp.vec3):
    """Returns the centre of mass [m] of a bunch in the world."""
    return wp.transform_point(body_q[body], com)


@wp.func
def force_on_others(world: int, worlds: int, wanted: int, contacts: Contacts, world_contacts: WorldContacts):
    """Returns the sum of the contact forces [N] on the trees of a world except its tree number ``wanted``."""
    force = float(0.0)
    for c in range(world_contacts.count[world]):
        at = c * worlds + world
        if world_contacts.tree[at] / worlds != wanted:
            force = force + float(wp.length(contacts.force[at]))
    return force


@wp.func
def squared_action(world: int, action: wp.array2d(dtype=float)):
    """Returns the sum of the squared components of a world's action."""
    effort = float(0.0)
    for i in range(action.shape[1]):
        effort = effort + action[world, i] * action[world, i]
    return effort


@wp.kernel
def observe(
    # model
    numbers: ReachNumbers,
    # in
    arm: ArmState,
    bunch: wp.array(dtype=wp.int32),
    bunch_com: wp.array(dtype=wp.vec3),
    body_q: wp.array(dtype=wp.transform),
    worlds: int,
    target: wp.array(dtype=wp.int32),
    action: wp.array2d(dtype=float),
    contacts: Contacts,
    world_contacts: WorldContacts,
    # out
    observation_out: wp.array2d(dtype=float),
    reward_out: wp.array(dtype=float),
    success_out: wp.array(dtype=wp.bool),
):
    """One thread per world.

    bunch, bunch_com: [tree] body of the tree's bunch, and its centre of mass. target: [world] number of the tree whose
    bunch is wanted, in its world. observation: [world, k], as :class:`vinesim.learn.reach.ReachEnv`
    describes it.
    """
    world = wp.tid()
    joints = arm.q.shape[0]
    trees = bunch.shape[0] / worlds
    point = observe_arm(world, arm, observation_out)
    wanted = target[world]
    tree = wanted * worlds + world
    away = bunch_middle(body_q, bunch[tree], bunch_com[tree]) - point
    distance = wp.length(away)
    place = int(2 * joints)
    for k in range(3):
        observation_out[world, place + k] = away[k]
    place = place + 3
    for other in range(trees):
        if other != wanted:
            tree = other * worlds + world
            offset = bunch_middle(body_q, bunch[tree], bunch_com[tree]) - point
            for k in range(3):
                observation_out[world, place + k] = offset[k]
            place = place + 3
    force = force_on_others(world, worlds, wanted, contacts, world_contacts)
    observation_out[world, place] = force
    for k in range(trees):
        observation_out[world, place + 1 + k] = wp.where(k == wanted, 1.0, 0.0)
    effort = squared_action(world, action)
    success = distance < numbers.reach
    reward = -numbers.distance_cost * distance - numbers.force_cost * force - numbers.action_cost * effort
    if success:
        reward = reward + numbers.success_reward
    reward_out[world] = reward
    success_out[world] = success


@wp.kernel
def move_targets(
    # model
    step: float,
    lower: wp.array(dtype=float),
    upper: wp.array(dtype=float),
    lead: float,
    q: wp.array(dtype=wp.int32),
    # in
    action: wp.array2d(dtype=float),
    qpos: wp.array2d(dtype=float),
    # out
    targets_out: wp.array2d(dtype=float),
):
    """One thread per joint of a world. Move its target by ``step`` [rad] times the action, at most ``lead`` [rad] from
    the joint, and within the joint's limits [rad]."""
    world, i = wp.tid()
    position = qpos[world, q[i]]
    target = targets_out[world, i] + step * wp.clamp(action[world, i], -1.0, 1.0)
    target = wp.clamp(target, position - lead, position + lead)
    targets_out[world, i] = wp.clamp(target, lower[i], upper[i])
