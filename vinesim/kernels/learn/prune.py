"""The task *prune* (:mod:`vinesim.learn.prune`): the blade, observation, reward and success of each world, on the batch's
device."""

import warp as wp

from vinesim.kernels.contact.structs import Contacts
from vinesim.kernels.learn.reach import ArmState, force_on_others, observe_arm, squared_action
from vinesim.kernels.worlds.narrowphase import WorldContacts

wp.set_module_options({"enable_backward": False})


@wp.struct
class PruneNumbers:
    """Numbers of the task."""

    kept: int
    """Number of buds that shall stay: bud i is at the tip of internode i, from 1 on."""
    tolerance: float
    """[m] Largest distance of a cut from the wanted place, along the cane."""
    bud: float
    """[m] Distance from a bud within which a contact presses it."""
    success_reward: float
    distance_cost: float
    """[1/m] Cost of an action per distance."""
    force_cost: float
    """[1/N] Cost of an action per force on buds and other canes."""
    action_cost: float


@wp.struct
class CanePlaces:
    """The canes of all worlds. [tree]: each tree is one cane."""

    first: wp.array(dtype=wp.int32)
    """[tree] First body: the first internode."""
    size: wp.array(dtype=wp.int32)
    """[tree] Number of bodies."""
    pitch: int
    """Distance in memory from one body of a tree to the next."""
    length: wp.array(dtype=float)
    """[body] m, length of the internode."""
    base: wp.array(dtype=float)
    """[body] m, distance along the cane from its base to the internode."""
    body_q: wp.array(dtype=wp.transform)
    segment: wp.array(dtype=wp.int32)
    """[body] Internode of which the body is a part; -1: a spare body."""
    start: wp.array(dtype=float)
    """[body] m, from the origin of the internode to the beginning of the body's wood."""
    is_cut: wp.array(dtype=wp.bool)
    """[body] Whether a body was cut off."""


@wp.func
def wanted_place(tree: int, kept: int, canes: CanePlaces):
    """Returns the point [m] at which a cane shall be cut, the middle of the internode above the last bud that stays,
    and the direction of the cane there."""
    body = canes.first[tree] + kept * canes.pitch
    pose = canes.body_q[body]
    point = wp.transform_point(pose, wp.vec3(0.5 * canes.length[body], 0.0, 0.0))
    return point, wp.transform_vector(pose, wp.vec3(1.0, 0.0, 0.0))


@wp.func
def lowest_cut(tree: int, canes: CanePlaces):
    """Returns the distance [m] along a cane from its base to its lowest cut; infinite without a cut."""
    lowest = float(wp.inf)
    first = canes.first[tree]
    for k in range(first, first + canes.size[tree] * canes.pitch, canes.pitch):
        if canes.is_cut[k]:
            segment = canes.segment[k]
            lowest = wp.min(lowest, canes.base[segment] + canes.start[k])
    return lowest


@wp.func
def force_on_buds(
    world: int,
    worlds: int,
    wanted: int,
    numbers: PruneNumbers,
    canes: CanePlaces,
    contacts: Contacts,
    world_contacts: WorldContacts,
):
    """Returns the sum of the contact forces [N] near the buds of the wanted cane that shall stay."""
    force = float(0.0)
    tree = wanted * worlds + world
    for c in range(world_contacts.count[world]):
        at = c * worlds + world
        if world_contacts.tree[at] / worlds == wanted:
            point = wp.vec3(contacts.point[at])
            near = bool(False)
            for i in range(1, numbers.kept + 1):
                bud = wp.transform_get_translation(canes.body_q[canes.first[tree] + i * canes.pitch])
                near = near or wp.length(point - bud) < numbers.bud
            if near:
                force = force + float(wp.length(contacts.force[at]))
    return force


@wp.kernel
def close_blade(
    # model
    component: int,
    # in
    action: wp.array2d(dtype=float),
    # out
    closing_out: wp.array(dtype=wp.bool),
):
    """One thread per world. The blade closes at the end of the action if this component is above 0."""
    world = wp.tid()
    closing_out[world] = action[world, component] > 0.0


@wp.kernel
def judge_cuts(
    # model
    numbers: PruneNumbers,
    worlds: int,
    # in
    canes: CanePlaces,
    target: wp.array(dtype=wp.int32),
    # out
    is_done_out: wp.array(dtype=wp.bool),
    failed_out: wp.array(dtype=wp.bool),
):
    """One thread per world, once after each action. Find whether the wanted cane is cut at the wanted place (``is_done``
    [world]), or a cane is cut elsewhere (``failed`` [world])."""
    world = wp.tid()
    done = bool(False)
    failed = bool(False)
    for number in range(canes.first.shape[0] / worlds):
        tree = number * worlds + world
        place = lowest_cut(tree, canes)
        if wp.isfinite(place):
            body = canes.first[tree] + numbers.kept * canes.pitch
            apart = wp.abs(place - canes.base[body] - 0.5 * canes.length[body])
            if number == target[world] and apart <= numbers.tolerance:
                done = True
            else:
                failed = True
    is_done_out[world] = done and not failed
    failed_out[world] = failed


@wp.kernel
def observe(
    # model
    numbers: PruneNumbers,
    worlds: int,
    # in
    arm: ArmState,
    canes: CanePlaces,
    target: wp.array(dtype=wp.int32),
    is_done: wp.array(dtype=wp.bool),
    action: wp.array2d(dtype=float),
    contacts: Contacts,
    world_contacts: WorldContacts,
    # out
    observation_out: wp.array2d(dtype=float),
    reward_out: wp.array(dtype=float),
    success_out: wp.array(dtype=wp.bool),
):
    """One thread per world.

    target: [world] number of the cane that is wanted, in its world. is_done: see :func:`judge_cuts`. observation: [world,
    k], as :class:`vinesim.learn.prune.PruneEnv` describes it.
    """
    world = wp.tid()
    trees = canes.first.shape[0] / worlds
    mouth = observe_arm(world, arm, observation_out)
    place = int(2 * arm.q.shape[0])
    wanted = target[world]
    point, along = wanted_place(wanted * worlds + world, numbers.kept, canes)
    away = point - mouth
    for k in range(3):
        observation_out[world, place + k] = away[k]
        observation_out[world, place + 3 + k] = along[k]
    place = place + 6
    for other in range(trees):
        if other != wanted:
            apart, _along = wanted_place(other * worlds + world, numbers.kept, canes)
            for k in range(3):
                observation_out[world, place + k] = apart[k] - mouth[k]
            place = place + 3
    on_others = force_on_others(world, worlds, wanted, contacts, world_contacts)
    on_buds = force_on_buds(world, worlds, wanted, numbers, canes, contacts, world_contacts)
    observation_out[world, place] = on_others
    observation_out[world, place + 1] = on_buds
    for k in range(trees):
        observation_out[world, place + 2 + k] = wp.where(k == wanted, 1.0, 0.0)
    effort = squared_action(world, action)
    reward = -numbers.distance_cost * wp.length(away) - numbers.force_cost * (on_others + on_buds)
    reward = reward - numbers.action_cost * effort
    success = is_done[world]
    if success:
        reward = reward + numbers.success_reward
    reward_out[world] = reward
    success_out[world] = success
