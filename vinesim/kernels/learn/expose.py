"""The task *expose* (:mod:`vinesim.learn.expose`): visible share of a bunch, observation, reward and success of each
world, on the batch's device."""

import warp as wp

from vinesim.kernels.contact.body_motion import to_double
from vinesim.kernels.contact.distance import segment_segment_distance
from vinesim.kernels.contact.structs import Capsules, Contacts
from vinesim.kernels.learn.reach import ArmState, bunch_middle, observe_arm, squared_action
from vinesim.kernels.worlds.narrowphase import WorldContacts

wp.set_module_options({"enable_backward": False})

ACROSS = wp.constant(3)
ALONG = wp.constant(3)
"""Numbers of points of the wanted bunch that are looked at, across and along its axis."""


@wp.struct
class ExposeNumbers:
    """Numbers of the task."""

    eye: wp.vec3
    """[m] Point from which the bunch is looked at."""
    share: float
    """Visible share from which the bunch is exposed."""
    speed: float
    """[m/s] Speed of the shoot in front below which it is held aside."""
    success_reward: float
    force_cost: float
    """[1/N] Cost of an action per force on the wanted bunch's shoot."""
    action_cost: float


@wp.func
def is_hidden(
    eye: wp.vec3,
    point: wp.vec3,
    world: int,
    worlds: int,
    capsules: Capsules,
    body_q: wp.array(dtype=wp.transform),
    trees: int,
):
    """Returns whether a capsule of another tree of the world than tree 0 is between ``eye`` and ``point`` [m].

    Capsule i of a tree is at ``i * trees + tree``; an entry without a body is no capsule.
    """
    hidden = bool(False)
    for s in range(world, capsules.body.shape[0], worlds):
        body = capsules.body[s]
        if body >= 0 and s % trees >= worlds:
            pose = body_q[body]
            start = to_double(wp.transform_point(pose, capsules.local_start[s]))
            end = to_double(wp.transform_point(pose, capsules.local_end[s]))
            found = segment_segment_distance(start, end, to_double(eye), to_double(point))
            hidden = hidden or wp.float32(found[3]) < capsules.radius[s]
    return hidden


@wp.kernel
def observe(
    # model
    numbers: ExposeNumbers,
    # in
    arm: ArmState,
    bunch: wp.array(dtype=wp.int32),
    bunch_com: wp.array(dtype=wp.vec3),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
    size: wp.array(dtype=wp.vec2),
    worlds: int,
    capsules: Capsules,
    action: wp.array2d(dtype=float),
    contacts: Contacts,
    world_contacts: WorldContacts,
    # out
    observation_out: wp.array2d(dtype=float),
    reward_out: wp.array(dtype=float),
    success_out: wp.array(dtype=wp.bool),
):
    """One thread per world.

    The wanted bunch is that of tree 0 of the world; tree 1 hangs in front of it. bunch, bunch_com: [tree] body of the
    tree's bunch, and its centre of mass. size: [tree] m, length and radius of the bunch. observation: [world, k], as
    :class:`vinesim.learn.expose.ExposeEnv` describes it.
    """
    world = wp.tid()
    joints = arm.q.shape[0]
    trees = bunch.shape[0]
    point = observe_arm(world, arm, observation_out)
    place = int(2 * joints)
    for tree in range(world, trees, worlds):
        away = bunch_middle(body_q, bunch[tree], bunch_com[tree]) - point
        for k in range(3):
            observation_out[world, place + k] = away[k]
        place = place + 3
    body = bunch[world]
    pose = body_q[body]
    middle = bunch_middle(body_q, body, bunch_com[world])
    extent = size[world]
    axis = wp.transform_vector(pose, wp.vec3(1.0, 0.0, 0.0))
    across = wp.normalize(wp.cross(axis, middle - numbers.eye))
    visible = float(0.0)
    for i in range(ALONG):
        for j in range(ACROSS):
            along = (float(i + 1) / float(ALONG + 1) - 0.5) * extent[0]
            aside = (2.0 * float(j + 1) / float(ACROSS + 1) - 1.0) * extent[1]
            seen = middle + along * axis + aside * across
            if not is_hidden(numbers.eye, seen, world, worlds, capsules, body_q, trees):
                visible = visible + 1.0
    share = visible / float(ALONG * ACROSS)
    force = float(0.0)
    for c in range(world_contacts.count[world]):
        at = c * worlds + world
        if world_contacts.tree[at] < worlds:
            force = force + float(wp.length(contacts.force[at]))
    observation_out[world, place] = share
    observation_out[world, place + 1] = force
    effort = squared_action(world, action)
    front = bunch[worlds + world]
    motion = body_qd[front]
    success = share >= numbers.share and wp.length(wp.spatial_top(motion)) < numbers.speed
    reward = share - 1.0 - numbers.force_cost * force - numbers.action_cost * effort
    if success:
        reward = reward + numbers.success_reward
    reward_out[world] = reward
    success_out[world] = success
