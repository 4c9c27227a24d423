"""Broadphase: bounding boxes of geoms, actors, capsules and trees, swept over the step, and the search for trees near
actors.

All boxes are axis-aligned. They are enlarged by the distance that their contents can move in the step, so that a
sleeping tree wakes before a body reaches it.
"""

import warp as wp

from vinesim.kernels.contact.structs import (
    AABB_BLOCK,
    AWAKE_TREES,
    CHANGED_BLOCKS,
    NEAR_ASLEEP,
    Aabbs,
    Actors,
    Capsules,
    CapsuleStates,
    Geoms,
    GeomStates,
    Parameters,
    PlantBodies,
    RigidBodies,
    Trees,
)

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e30)
"""[m] Coordinates of the corners of an empty box."""


DISJOINT = """
    const auto disjoint = [](const wp::vec3& a_low, const wp::vec3& a_high, const wp::vec3& b_low, const wp::vec3& b_high) {
#if defined(__CUDACC__)
        return a_low[0] > b_high[0] || a_low[1] > b_high[1] || a_low[2] > b_high[2]
            || b_low[0] > a_high[0] || b_low[1] > a_high[1] || b_low[2] > a_high[2];
#else
        typedef float Four __attribute__((vector_size(16)));
        const auto four = [](const wp::vec3& v) { return Four{v[0], v[1], v[2], 0.0f}; };
        return __builtin_reduce_or((four(a_low) > four(b_high)) | (four(b_low) > four(a_high))) != 0;
#endif
    };
"""
"""Native code that tests whether two boxes are disjoint. It has no branches: with a branch for each axis, a CPU would
spend most of the time on mispredicted branches."""


@wp.func_native(DISJOINT + "return disjoint(a_low, a_high, b_low, b_high);")
def aabbs_disjoint(a_low: wp.vec3, a_high: wp.vec3, b_low: wp.vec3, b_high: wp.vec3) -> bool:
    """Returns whether two boxes are disjoint."""
    ...


@wp.func_native(
    DISJOINT
    + """
    while (first < end && disjoint(low, high, lows.data[first], highs.data[first])) ++first;
    return first;
"""
)
def next_overlap(
    first: int, end: int, low: wp.vec3, high: wp.vec3, lows: wp.array(dtype=wp.vec3), highs: wp.array(dtype=wp.vec3)
) -> int:
    """Returns the index of the first box, from ``first`` to before ``end``, that overlaps the box ``low``, ``high``;
    ``end`` if no box does."""
    ...


@wp.func
def exists_at_level(level: int, is_fine: bool):
    """Returns whether a capsule exists at its tree's level of detail. ``level``: 0 always, 1 while the tree is coarse,
    2 while the tree is fine, 3 never."""
    return level == 0 or level == wp.where(is_fine, 2, 1)


@wp.func
def is_collidable(level: int, is_fine: bool, bunch: int, bunch_attached: wp.array(dtype=wp.bool)):
    """Returns whether a capsule collides: it exists at the present level of detail, and its bunch, if any, is not
    picked.
    """
    collides = exists_at_level(level, is_fine)
    if collides and bunch >= 0:
        collides = bunch_attached[bunch]
    return collides


@wp.func
def geom_motion(g: int, parameters: Parameters, geoms: Geoms, rigid: RigidBodies, states_out: GeomStates):
    """Compute the motion of the centre of geom ``g``, and its bounding box, enlarged by its possible motion in the
    step."""
    rotation = rigid.xmat[geoms.id[g]]
    center = rigid.xpos[geoms.id[g]] + rotation * geoms.center[g]
    body = geoms.body[g]
    spin = wp.vec3d(rigid.cvel[body, 0], rigid.cvel[body, 1], rigid.cvel[body, 2])
    velocity = wp.vec3d(rigid.cvel[body, 3], rigid.cvel[body, 4], rigid.cvel[body, 5])
    arm = center - rigid.subtree_com[geoms.root[g]]
    velocity = velocity + wp.cross(spin, arm)
    half = geoms.half[g]
    extent = wp.length(half)
    speed = wp.length(velocity) + wp.length(spin) * extent
    # A drive may start within the step. Its likely speed is the free speed plus the smaller correction of the last two
    # steps, if these agree in sign. Its largest speed is the free speed.
    linear_likely = wp.vec3d()
    spin_likely = wp.vec3d()
    linear_free = wp.vec3d()
    spin_free = wp.vec3d()
    dof = geoms.dof[g]
    while dof >= 0:
        angular = wp.vec3d(rigid.cdof[dof, 0], rigid.cdof[dof, 1], rigid.cdof[dof, 2])
        linear = wp.vec3d(rigid.cdof[dof, 3], rigid.cdof[dof, 4], rigid.cdof[dof, 5]) + wp.cross(angular, arm)
        rate = rigid.velocity_free[dof]
        linear_free += rate * linear
        spin_free += rate * angular
        last = rigid.correction[dof]
        before = rigid.correction_before[dof]
        if last * before > wp.float64(0.0):
            rate += wp.where(wp.abs(last) < wp.abs(before), last, before)
        linear_likely += rate * linear
        spin_likely += rate * angular
        dof = rigid.dof_parent[dof]
    speed = wp.max(speed, wp.length(linear_likely) + wp.length(spin_likely) * extent)
    largest = wp.max(speed, wp.length(linear_free) + wp.length(spin_free) * extent)
    grown = parameters.margin + parameters.dt * largest
    box = wp.vec3()
    for i in range(3):
        reach = wp.abs(rotation[i, 0]) * half[0] + wp.abs(rotation[i, 1]) * half[1] + wp.abs(rotation[i, 2]) * half[2]
        box[i] = wp.float32(reach + grown)
    middle = wp.vec3(wp.float32(center[0]), wp.float32(center[1]), wp.float32(center[2]))
    states_out.center[g] = center
    states_out.velocity[g] = velocity
    states_out.angular_velocity[g] = spin
    states_out.speed[g] = speed
    states_out.low[g] = middle - box
    states_out.high[g] = middle + box


@wp.kernel
def geom_aabbs(
    # model
    parameters: Parameters,
    geoms: Geoms,
    # in
    count: wp.array(dtype=wp.int32),
    rigid: RigidBodies,
    # out
    states_out: GeomStates,
):
    """One thread per geom. Compute its motion and its bounding box by :func:`geom_motion`. count: [1] number of geoms."""
    g = wp.tid()
    if g < count[0]:
        geom_motion(g, parameters, geoms, rigid, states_out)


@wp.func
def sweep_capsule(s: int, dt: float, capsules: Capsules, bodies: PlantBodies):
    """Returns a capsule's ends in the world, an upper bound of its speed [m/s], and the corners of its swept box."""
    body = capsules.body[s]
    pose = bodies.q[body]
    velocity = bodies.qd[body]
    local_start = capsules.local_start[s]
    local_end = capsules.local_end[s]
    extent = capsules.extent[s]
    radius = capsules.radius[s]
    start = wp.transform_point(pose, local_start)
    end = wp.transform_point(pose, local_end)
    speed = wp.length(wp.spatial_top(velocity)) + extent * wp.length(wp.spatial_bottom(velocity))
    grown = wp.vec3(radius + speed * dt)
    return start, end, speed, wp.min(start, end) - grown, wp.max(start, end) + grown


@wp.kernel
def tree_aabbs(
    # model
    parameters: Parameters,
    capsules: Capsules,
    # in
    counters: wp.array(dtype=wp.int32),
    trees: Trees,
    bodies: PlantBodies,
    # out
    states_out: CapsuleStates,
    wood_boxes_out: Aabbs,
    tree_boxes_out: Aabbs,
):
    """One thread per tree. Compute the world positions of its capsules, their boxes, and the boxes of the tree and of
    its wood.

    Thread i takes the tree ``trees.awake[i]``.
    """
    row = wp.tid()
    if row >= counters[AWAKE_TREES]:
        return
    tree = trees.awake[row]
    is_fine = trees.is_fine[tree]
    dt = wp.float32(parameters.dt)
    low = wp.vec3(FAR)
    high = wp.vec3(-FAR)
    wood_low = wp.vec3(FAR)
    wood_high = wp.vec3(-FAR)
    for s in range(capsules.tree_start[tree], capsules.tree_start[tree + 1]):
        if exists_at_level(capsules.level[s], is_fine):
            start, end, speed, capsule_low, capsule_high = sweep_capsule(s, dt, capsules, bodies)
            low = wp.min(low, capsule_low)
            high = wp.max(high, capsule_high)
            if capsules.bunch[s] < 0:
                wood_low = wp.min(wood_low, capsule_low)
                wood_high = wp.max(wood_high, capsule_high)
            states_out.start[s] = start
            states_out.end[s] = end
            states_out.speed[s] = speed
            states_out.low[s] = capsule_low
            states_out.high[s] = capsule_high
    wood_boxes_out.low[tree] = wood_low
    wood_boxes_out.high[tree] = wood_high
    tree_boxes_out.low[tree] = low
    tree_boxes_out.high[tree] = high


@wp.kernel
def take_free_velocities(
    # model
    parameters: Parameters,
    # in
    qvel: wp.array(dtype=wp.float64),
    qacc: wp.array(dtype=wp.float64),
    # out
    rigid_out: RigidBodies,
):
    """One thread per degree of freedom of MuJoCo. Write its free velocity: the velocity at the end of the step if no
    plant touches a rigid body.

    Also write the correction, which is the amount by which plants changed the velocity in the last step. qvel, qacc:
    [dof] MuJoCo's arrays. While a body sleeps, its free velocity is 0, because MuJoCo does not update its acceleration.
    """
    dof = wp.tid()
    rigid_out.correction_before[dof] = rigid_out.correction[dof]
    rigid_out.correction[dof] = qvel[dof] - rigid_out.velocity_free[dof]
    velocity = wp.float64(0.0)
    if rigid_out.tree_asleep[rigid_out.dof_tree[dof]] < 0:
        velocity = qvel[dof] + parameters.dt * qacc[dof]
    rigid_out.velocity_free[dof] = velocity


@wp.kernel
def actor_aabbs(
    # model
    actors: Actors,
    geoms: Geoms,
    # in
    rigid: RigidBodies,
    geom_states: GeomStates,
    # out
    actor_boxes_out: Aabbs,
):
    """One thread per actor. Compute its bounding box, which is empty for boxes and free bunches that MuJoCo has put to
    sleep.

    A body that plants press on does not fall asleep in MuJoCo.
    """
    actor = wp.tid()
    if actor >= actors.count[0]:
        return
    first = actors.start[actor]
    low = wp.vec3(FAR)
    high = wp.vec3(-FAR)
    if not actors.may_sleep[actor] or rigid.tree_asleep[rigid.dof_tree[geoms.dof[first]]] < 0:
        for g in range(first, actors.start[actor + 1]):
            low = wp.min(low, geom_states.low[g])
            high = wp.max(high, geom_states.high[g])
    actor_boxes_out.low[actor] = low
    actor_boxes_out.high[actor] = high


@wp.kernel
def block_aabbs(
    # in
    counters: wp.array(dtype=wp.int32),
    blocks: wp.array(dtype=wp.int32),
    boxes: Aabbs,
    # out
    block_boxes_out: Aabbs,
):
    """One thread per block of 32 boxes. Compute their common bounding box. Thread i takes the block ``blocks[i]``."""
    place = wp.tid()
    if place >= counters[CHANGED_BLOCKS]:
        return
    block = blocks[place]
    low = wp.vec3(FAR)
    high = wp.vec3(-FAR)
    for i in range(block * AABB_BLOCK, wp.min((block + 1) * AABB_BLOCK, boxes.low.shape[0])):
        low = wp.min(low, boxes.low[i])
        high = wp.max(high, boxes.high[i])
    block_boxes_out.low[block] = low
    block_boxes_out.high[block] = high


@wp.func
def overlaps_capsule(
    low: wp.vec3, high: wp.vec3, tree: int, capsules: Capsules, trees: Trees, capsule_states: CapsuleStates
):
    """Returns whether a box overlaps the box of one of a tree's capsules."""
    overlaps = bool(False)
    for s in range(capsules.tree_start[tree], capsules.tree_start[tree + 1]):
        if not aabbs_disjoint(low, high, capsule_states.low[s], capsule_states.high[s]):
            overlaps = overlaps or is_collidable(
                capsules.level[s], trees.is_fine[tree], capsules.bunch[s], trees.bunch_attached
            )
    return overlaps


@wp.kernel
def mark_near_trees(
    # model
    actors: Actors,
    capsules: Capsules,
    # in
    trees: Trees,
    capsule_states: CapsuleStates,
    block_boxes: Aabbs,
    tree_boxes: Aabbs,
    actor_boxes: Aabbs,
    geom_states: GeomStates,
    # out
    is_near_out: wp.array(dtype=wp.bool),
    counters_out: wp.array(dtype=wp.int32),
):
    """One thread per block. Mark the trees of the block whose box a geom of an actor overlaps, and unmark its other
    trees.

    For a box or free bunch the box of one of the tree's capsules must also overlap, so that a box that lies on a canopy
    for hours keeps few trees awake. A remote actor marks remote trees only. capsule_states: from the last step of each
    tree.
    """
    block = wp.tid()
    for tree in range(block * AABB_BLOCK, wp.min((block + 1) * AABB_BLOCK, tree_boxes.low.shape[0])):
        is_near_out[tree] = False
    for actor in range(actors.count[0]):
        actor_low = actor_boxes.low[actor]
        actor_high = actor_boxes.high[actor]
        if not aabbs_disjoint(block_boxes.low[block], block_boxes.high[block], actor_low, actor_high):
            for tree in range(block * AABB_BLOCK, wp.min((block + 1) * AABB_BLOCK, tree_boxes.low.shape[0])):
                low = tree_boxes.low[tree]
                high = tree_boxes.high[tree]
                counts = trees.is_remote[tree] or not actors.is_remote[actor]
                if counts and not is_near_out[tree] and not aabbs_disjoint(low, high, actor_low, actor_high):
                    for g in range(actors.start[actor], actors.start[actor + 1]):
                        if not aabbs_disjoint(low, high, geom_states.low[g], geom_states.high[g]):
                            if not actors.may_sleep[actor] or overlaps_capsule(
                                geom_states.low[g], geom_states.high[g], tree, capsules, trees, capsule_states
                            ):
                                if not is_near_out[tree] and not trees.is_awake[tree]:
                                    wp.atomic_add(counters_out, NEAR_ASLEEP, 1)
                                is_near_out[tree] = True


@wp.func
def list_near_geoms(
    row: int,
    low: wp.vec3,
    high: wp.vec3,
    is_remote: bool,
    most: int,
    geoms: Geoms,
    geom_states: GeomStates,
    static_blocks: Aabbs,
    near_geoms_out: wp.array2d(dtype=wp.int32),
):
    """List the geoms whose boxes overlap a tree's box, among them at most ``most`` static geoms.

    Returns the number of overlapping geoms, including those that were not listed.
    """
    count = int(0)
    movable = geoms.count[0]
    g = next_overlap(0, movable, low, high, geom_states.low, geom_states.high)
    while g < movable:
        if is_remote or not geoms.is_remote[g]:
            near_geoms_out[row, count] = g
            count = count + 1
        g = next_overlap(g + 1, movable, low, high, geom_states.low, geom_states.high)
    room = wp.min(movable + most, near_geoms_out.shape[1])
    blocks = static_blocks.low.shape[0]
    block = next_overlap(0, blocks, low, high, static_blocks.low, static_blocks.high)
    while block < blocks:
        first = movable + block * AABB_BLOCK
        end = wp.min(first + AABB_BLOCK, geoms.count[1])
        g = next_overlap(first, end, low, high, geom_states.low, geom_states.high)
        while g < end:
            if count < room:
                near_geoms_out[row, count] = g
            count = count + 1
            g = next_overlap(g + 1, end, low, high, geom_states.low, geom_states.high)
        block = next_overlap(block + 1, blocks, low, high, static_blocks.low, static_blocks.high)
    return count
