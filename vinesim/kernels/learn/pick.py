"""The task *pick* (:mod:`vinesim.learn.pick`): actions of the hand, observation, reward and success of each world, on the
batch's device."""

import warp as wp

from vinesim.kernels.contact.structs import Contacts
from vinesim.kernels.learn.reach import ArmState, bunch_middle, force_on_others, observe_arm, squared_action
from vinesim.kernels.worlds.narrowphase import WorldContacts

wp.set_module_options({"enable_backward": False})

STALK_RADIUS = wp.constant(0.003)
"""[m] Distance beyond a finger's inner face up to which a stalk counts as between the fingers, which give way."""


@wp.struct
class PickNumbers:
    """Numbers of the task."""

    reach: float
    """[m] Distance of the stalk from the point between the fingers up to which the bunch is in the hand."""
    lost: float
    """[m] Distance of the stalk from which on a bunch that came off is lost."""
    speed: float
    """[m/s] Speed of the bunch's middle below which it is held."""
    actions: int
    """Number of actions for which it must be held."""
    trigger: int
    """Number of actions in a row that must command the blade before it closes."""
    success_reward: float
    time_cost: float
    """Cost of an action."""
    force_cost: float
    """[1/N] Cost of an action per force on other plants."""
    action_cost: float
    place: wp.vec3
    """[m] Where the stalk shall be in the hand, from the point between the tips of the fingers."""
    distance_worth: float
    """[1/m] Potential lost per distance of the stalk from this place."""
    tilt_worth: float
    """Potential lost per 1 - the cosine of the angle between the stalk and the hand's vertical axis."""
    grasp_worth: float
    """Potential of closed fingers with the stalk between them."""
    cut_worth: float
    """Further potential of this grasp, times how far the bunch is cut off."""
    finger: wp.vec3
    """[m] Edges of a finger, in the hand's axes. Its tip is at the point between the tips."""
    gap: float
    """[m] Clear width between the fingers in the middle of their ways."""
    open_gap: float
    """[m] Clear width between open fingers."""


@wp.struct
class BunchPlaces:
    """The bunches of all worlds, on their vines and off them. [tree]: each tree has one bunch."""

    body: wp.array(dtype=wp.int32)
    """[tree] Body of the bunch on its vine."""
    com: wp.array(dtype=wp.vec3)
    """[tree] m, its centre of mass in its frame."""
    segment: wp.array(dtype=wp.int32)
    """[tree] Last segment of its peduncle."""
    length: wp.array(dtype=float)
    """[tree] m, length of this segment."""
    body_q: wp.array(dtype=wp.transform)
    slots: wp.array2d(dtype=wp.int32)
    """[world, slot] Bunch that a body of the pool is."""
    free_body: wp.array(dtype=wp.int32)
    """[slot] MuJoCo body."""
    free_v: wp.array(dtype=wp.int32)
    """[slot] First degree of freedom in MuJoCo's qvel."""
    xpos: wp.array2d(dtype=wp.vec3)
    xmat: wp.array2d(dtype=wp.mat33)
    qvel: wp.array2d(dtype=float)


@wp.func
def slot_of(world: int, tree: int, bunches: BunchPlaces):
    """Returns the body of the pool that the bunch of a tree is; -1 while it hangs."""
    found = int(-1)
    for slot in range(bunches.slots.shape[1]):
        if bunches.slots[world, slot] == tree:
            found = slot
    return found


@wp.func
def stalk_point(world: int, tree: int, slot: int, bunches: BunchPlaces):
    """Returns the point [m] at which the hand shall grasp the stalk: the upper end of the last segment of the
    peduncle."""
    point = wp.transform_get_translation(bunches.body_q[bunches.segment[tree]])
    if slot >= 0:
        body = bunches.free_body[wp.max(slot, 0)]
        point = bunches.xpos[world, body] + bunches.xmat[world, body] * wp.vec3(-bunches.length[tree], 0.0, 0.0)
    return point


@wp.func
def stalk_axis(world: int, tree: int, slot: int, bunches: BunchPlaces):
    """Returns the direction of the stalk at this point, towards the bunch."""
    axis = wp.transform_vector(bunches.body_q[bunches.segment[tree]], wp.vec3(1.0, 0.0, 0.0))
    if slot >= 0:
        body = bunches.free_body[wp.max(slot, 0)]
        axis = bunches.xmat[world, body] * wp.vec3(1.0, 0.0, 0.0)
    return axis


@wp.func
def grasp_share(place: wp.vec3, left: float, right: float, numbers: PickNumbers):
    """Returns how far the fingers have closed on a stalk, from 0 (open, or the stalk is not between them) to 1.

    place: [m] the stalk, in the hand's axes from the point between the tips. left, right: [m] positions of the fingers.
    """
    upper = 0.5 * numbers.gap + left
    lower = right - 0.5 * numbers.gap
    share = float(0.0)
    is_along = place[0] < 0.0 and place[0] > -numbers.finger[0] and wp.abs(place[2]) < numbers.finger[2]
    if is_along and place[1] < upper + STALK_RADIUS and place[1] > lower - STALK_RADIUS:
        share = wp.clamp(1.0 - (upper - lower) / numbers.open_gap, 0.0, 1.0)
    return share


@wp.func
def middle_point(world: int, tree: int, slot: int, bunches: BunchPlaces):
    """Returns the middle of a bunch [m]."""
    point = bunch_middle(bunches.body_q, bunches.body[tree], bunches.com[tree])
    if slot >= 0:
        body = bunches.free_body[wp.max(slot, 0)]
        point = bunches.xpos[world, body] + bunches.xmat[world, body] * bunches.com[tree]
    return point


@wp.kernel
def move_hand(
    # model
    closed: float,
    open: float,
    step: float,
    dead: float,
    first: int,
    trigger: int,
    # in
    action: wp.array2d(dtype=float),
    # out
    targets_out: wp.array2d(dtype=float),
    commanded_out: wp.array(dtype=wp.int32),
    closing_out: wp.array(dtype=wp.bool),
):
    """One thread per world. Set the targets of both fingers and the command of the blade by the components ``first`` and
    ``first + 1`` of the action.

    closed, open: [m] ends of the ways of the targets of the fingers, as distances from the middle of their ways. They
    move by ``step`` [m] if the component is above ``dead`` or below -``dead``. targets: [world, joint]; the fingers are
    the joints ``first`` (left) and ``first + 1`` (right). commanded: [world] for how many actions in a row the blade has
    been commanded; it closes after ``trigger`` of them.
    """
    world = wp.tid()
    command = action[world, first]
    way = targets_out[world, first + 1]
    if command > dead:
        way = wp.min(way + step, closed)
    if command < -dead:
        way = wp.max(way - step, open)
    targets_out[world, first] = -way
    targets_out[world, first + 1] = way
    commanded = int(0)
    if action[world, first + 1] > 0.0:
        commanded = commanded_out[world] + 1
    closes = commanded >= trigger
    if closes:
        commanded = 0
    commanded_out[world] = commanded
    closing_out[world] = closes


@wp.kernel
def count_held(
    # model
    numbers: PickNumbers,
    worlds: int,
    # in
    arm: ArmState,
    bunches: BunchPlaces,
    target: wp.array(dtype=wp.int32),
    # out
    held_out: wp.array(dtype=wp.int32),
    failed_out: wp.array(dtype=wp.bool),
):
    """One thread per world, once after each action. Count for how many of the last actions the wanted bunch has been
    held off its vine (``held`` [world]). The task has failed (``failed`` [world]) if this bunch is lost, or another one
    is off its vine."""
    world = wp.tid()
    tree = target[world] * worlds + world
    slot = slot_of(world, tree, bunches)
    held = int(0)
    failed = bool(False)
    for other in range(bunches.body.shape[0] / worlds):
        if other != target[world] and slot_of(world, other * worlds + world, bunches) >= 0:
            failed = True
    if slot >= 0:
        body = bunches.free_body[wp.max(slot, 0)]
        v = bunches.free_v[wp.max(slot, 0)]
        velocity = wp.vec3(bunches.qvel[world, v], bunches.qvel[world, v + 1], bunches.qvel[world, v + 2])
        spin = wp.vec3(bunches.qvel[world, v + 3], bunches.qvel[world, v + 4], bunches.qvel[world, v + 5])
        velocity = velocity + bunches.xmat[world, body] * wp.cross(spin, bunches.com[tree])
        point = arm.xpos[world, arm.tool_body] + arm.xmat[world, arm.tool_body] * arm.tool
        away = stalk_point(world, tree, slot, bunches) - point
        if wp.length(away) < numbers.reach and wp.length(velocity) < numbers.speed:
            held = held_out[world] + 1
        if wp.length(away) > numbers.lost:
            failed = True
    held_out[world] = held
    failed_out[world] = failed


@wp.kernel
def forget_counts(
    # in
    begins: wp.array(dtype=wp.bool),
    # out
    held_out: wp.array(dtype=wp.int32),
    commanded_out: wp.array(dtype=wp.int32),
):
    """One thread per world. Begin an episode with a bunch that hangs."""
    world = wp.tid()
    if begins[world]:
        held_out[world] = 0
        commanded_out[world] = 0


@wp.kernel
def observe(
    # model
    numbers: PickNumbers,
    worlds: int,
    fingers: wp.array(dtype=wp.int32),
    # in
    arm: ArmState,
    bunches: BunchPlaces,
    target: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    commanded: wp.array(dtype=wp.int32),
    action: wp.array2d(dtype=float),
    contacts: Contacts,
    world_contacts: WorldContacts,
    # out
    potential_out: wp.array(dtype=float),
    observation_out: wp.array2d(dtype=float),
    reward_out: wp.array(dtype=float),
    success_out: wp.array(dtype=wp.bool),
):
    """One thread per world.

    fingers: [2] indices of the left and the right finger in MuJoCo's qpos. target: [world] number of the tree whose bunch
    is wanted, in its world. held: see :func:`count_held`. commanded: see :func:`move_hand`. potential: [world] of
    the state, by which rewards are shaped. observation: [world, k], as :class:`vinesim.learn.pick.PickEnv` describes it.
    """
    world = wp.tid()
    trees = bunches.body.shape[0] / worlds
    point = observe_arm(world, arm, observation_out)
    place = int(2 * arm.q.shape[0])
    observation_out[world, place] = arm.qpos[world, fingers[0]] - arm.qpos[world, fingers[1]]
    wanted = target[world]
    tree = wanted * worlds + world
    slot = slot_of(world, tree, bunches)
    to_stalk = stalk_point(world, tree, slot, bunches) - point
    to_middle = middle_point(world, tree, slot, bunches) - point
    for k in range(3):
        observation_out[world, place + 1 + k] = to_stalk[k]
        observation_out[world, place + 4 + k] = to_middle[k]
    share = float(commanded[world]) / float(numbers.trigger)
    observation_out[world, place + 7] = share
    to_hand = wp.transpose(arm.xmat[world, arm.tool_body])
    in_hand = to_hand * to_stalk
    axis = to_hand * stalk_axis(world, tree, slot, bunches)
    for k in range(3):
        observation_out[world, place + 8 + k] = in_hand[k]
        observation_out[world, place + 11 + k] = axis[k]
    place = place + 14
    for other in range(trees):
        if other != wanted:
            tree = other * worlds + world
            offset = middle_point(world, tree, slot_of(world, tree, bunches), bunches) - point
            for k in range(3):
                observation_out[world, place + k] = offset[k]
            place = place + 3
    force = force_on_others(world, worlds, wanted, contacts, world_contacts)
    observation_out[world, place] = force
    for k in range(trees):
        observation_out[world, place + 1 + k] = wp.where(k == wanted, 1.0, 0.0)
    left = arm.qpos[world, fingers[0]]
    right = arm.qpos[world, fingers[1]]
    cut = wp.where(slot < 0, share, 1.0)
    potential = (numbers.grasp_worth + numbers.cut_worth * cut) * grasp_share(in_hand, left, right, numbers)
    potential = potential - numbers.distance_worth * wp.length(in_hand - numbers.place)
    potential = potential - numbers.tilt_worth * (1.0 + axis[2])
    success = held[world] >= numbers.actions
    effort = squared_action(world, action)
    reward = -numbers.time_cost - numbers.force_cost * force - numbers.action_cost * effort
    if success:
        reward = reward + numbers.success_reward
    reward_out[world] = reward + potential - potential_out[world]
    potential_out[world] = potential
    success_out[world] = success
