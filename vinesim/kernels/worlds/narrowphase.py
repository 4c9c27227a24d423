"""Narrowphase of a batch of worlds: near pairs and contacts of the trees of each world with the world's geoms.

Contacts are found by a kernel for geoms of any kind, or by a far shorter kernel for planes, spheres and capsules only.
If the threads of a GPU execute different parts of a long kernel, the GPU mostly waits for instructions. The index of a
contact in its world is computed from the numbers of contacts of earlier pairs, so that it is the same in every run.

Tree t of a world has the index ``t * worlds + world`` among all trees. Geom m that can move has the index ``m * worlds +
world`` among all geoms. The static geoms follow, which all worlds share.
"""

import warp as wp

from vinesim.kernels.contact.broadphase import aabbs_disjoint, geom_motion, sweep_capsule
from vinesim.kernels.contact.narrowphase_rigid import add_pairs
from vinesim.kernels.contact.structs import (
    AABB_BLOCK,
    Aabbs,
    Candidates,
    Capsules,
    CapsuleStates,
    Geoms,
    GeomStates,
    Hulls,
    Parameters,
    PlantBodies,
    RigidBodies,
)
from vinesim.kernels.worlds.views import part_of_rigid

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e30)
"""[m] Coordinates of the corners of an empty box."""


@wp.struct
class WorldContacts:
    """Data about the contacts of each world and each tree that is kept from step to step."""

    count: wp.array(dtype=wp.int32)
    """[world] Number of contacts in this step."""
    tree: wp.array(dtype=wp.int32)
    """[i * worlds + world] Tree of contact i. The contacts of a tree are adjacent, and sorted by body."""
    first: wp.array(dtype=wp.int32)
    """[tree] Index in its world of the tree's first contact."""
    of_tree: wp.array(dtype=wp.int32)
    """[tree] Number of the tree's contacts in this step."""
    near: wp.array(dtype=wp.vec2i)
    """[k] Scratch: pairs of a capsule and a geom whose boxes overlap, of all trees in any order."""
    near_place: wp.array(dtype=wp.int32)
    """[k] Index of the pair in its tree."""
    near_total: wp.array(dtype=wp.int32)
    """[1] Number of pairs in ``near``."""
    near_count: wp.array(dtype=wp.int32)
    """[tree] Number of the tree's pairs in ``near``."""
    found: wp.array(dtype=wp.int32)
    """[i * trees + tree] Scratch: number of contacts of pair i of the tree, 0 to 2."""
    busy_count: wp.array(dtype=wp.int32)
    """[1] Number of worlds that need more threads or sweeps than most worlds."""
    busy: wp.array(dtype=wp.int32)
    """[i] Worlds that need more threads or sweeps than most worlds, in any order."""
    is_impact: wp.array(dtype=wp.bool)
    """[tree] Whether one of the tree's contacts is an impact."""
    dropped: wp.array(dtype=wp.int32)
    """[world] Number of contacts and near pairs left out since the start because the world had no room for them."""
    sweeps: wp.array(dtype=wp.int32)
    """[world] Number of sweeps in the last solve."""
    loaded_first: wp.array(dtype=wp.int32)
    """[tree] Index in ``loaded`` of its world of the first body on which wrenches of the last contacts act."""
    loaded_count: wp.array(dtype=wp.int32)
    """[tree] Number of bodies on which the wrenches of the last contacts act."""
    loaded: wp.array(dtype=wp.int32)
    """[i * worlds + world] Bodies on which the wrenches of the last contacts act."""


@wp.struct
class FreeBunches:
    """Bunches that have left their vines. Each is a body of its world's pool."""

    bunch: wp.array2d(dtype=wp.int32)
    """[world, slot] Bunch that this body of the pool is; -1: the body is not used."""
    passing: wp.array2d(dtype=wp.int32)
    """[tree, slot] 1 if the bunch passes through the tree, because it has overlapped it since it left its vine; else 0."""
    slot: wp.array(dtype=wp.int32)
    """[m] Body of the pool that the moving geom m belongs to; -1 for none."""


@wp.kernel
def move_geoms(
    # model
    parameters: Parameters,
    geoms: Geoms,
    # in
    worlds: int,
    moving: int,
    rigid_bodies: int,
    dofs: int,
    free: FreeBunches,
    rigid: RigidBodies,
    # out
    geom_states_out: GeomStates,
    world_boxes_out: Aabbs,
):
    """One thread per world. Compute the motion and the bounding box of each of the world's ``moving`` geoms that can
    move, and a common box of all of them [world]. Geoms of unused bodies of the pool have empty boxes."""
    world = wp.tid()
    own = part_of_rigid(rigid, world, rigid_bodies, dofs)
    low = wp.vec3(FAR)
    high = wp.vec3(-FAR)
    for m in range(moving):
        g = m * worlds + world
        geom_motion(g, parameters, geoms, own, geom_states_out)
        slot = free.slot[m]
        if slot >= 0 and free.bunch[world, wp.max(slot, 0)] < 0:
            geom_states_out.low[g] = wp.vec3(FAR)
            geom_states_out.high[g] = wp.vec3(-FAR)
        low = wp.min(low, geom_states_out.low[g])
        high = wp.max(high, geom_states_out.high[g])
    world_boxes_out.low[world] = low
    world_boxes_out.high[world] = high


@wp.func
def list_pair(s: int, g: int, near_count: int, room: int, world_contacts_out: WorldContacts):
    """List a pair of a capsule and a geom, if the tree, which has ``near_count`` pairs, has room for another one."""
    if near_count < room:
        k = wp.atomic_add(world_contacts_out.near_total, 0, 1)
        world_contacts_out.near[k] = wp.vec2i(s, g)
        world_contacts_out.near_place[k] = near_count


@wp.func
def is_passing(g: int, tree: int, worlds: int, free: FreeBunches):
    """Returns whether a moving geom passes through a tree."""
    slot = free.slot[g / worlds]
    return slot >= 0 and free.passing[tree, wp.max(slot, 0)] != 0


@wp.func
def list_near_geoms(
    s: int,
    tree: int,
    world: int,
    worlds: int,
    near_count: int,
    room: int,
    low: wp.vec3,
    high: wp.vec3,
    geoms: Geoms,
    geom_states: GeomStates,
    world_boxes: Aabbs,
    static_blocks: Aabbs,
    free: FreeBunches,
    world_contacts_out: WorldContacts,
):
    """List the geoms whose boxes overlap the box of capsule ``s``. Returns the new number of near pairs of the tree.

    Pairs for which there is no ``room`` are counted but not listed.
    """
    movable = geoms.count[0]
    if movable > 0 and not aabbs_disjoint(low, high, world_boxes.low[world], world_boxes.high[world]):
        for g in range(world, movable, worlds):
            is_near = not aabbs_disjoint(low, high, geom_states.low[g], geom_states.high[g])
            if is_near and not is_passing(g, tree, worlds, free):
                list_pair(s, g, near_count, room, world_contacts_out)
                near_count = near_count + 1
    for block in range(static_blocks.low.shape[0]):
        if not aabbs_disjoint(low, high, static_blocks.low[block], static_blocks.high[block]):
            first = movable + block * AABB_BLOCK
            for g in range(first, wp.min(first + AABB_BLOCK, geoms.count[1])):
                if not aabbs_disjoint(low, high, geom_states.low[g], geom_states.high[g]):
                    list_pair(s, g, near_count, room, world_contacts_out)
                    near_count = near_count + 1
    return near_count


@wp.kernel
def list_near_pairs(
    # model
    parameters: Parameters,
    capsules: Capsules,
    geoms: Geoms,
    # in
    trees: int,
    worlds: int,
    bodies: PlantBodies,
    geom_states: GeomStates,
    world_boxes: Aabbs,
    static_blocks: Aabbs,
    free: FreeBunches,
    # out
    capsule_states_out: CapsuleStates,
    world_contacts_out: WorldContacts,
):
    """One thread per tree. List the pairs of a capsule and a geom whose boxes overlap, and compute the capsules'
    states.

    Capsule i of a tree is at ``i * trees + tree``; an entry without a body is no capsule. Pairs for which there is no
    room count as dropped.
    """
    tree = wp.tid()
    world = tree % worlds
    if tree == 0:
        world_contacts_out.busy_count[0] = 0
    room = world_contacts_out.near.shape[0] / trees
    near_count = int(0)
    size = capsules.body.shape[0]
    following = capsules.body[tree]
    for s in range(tree, size, trees):
        body = following
        if s + trees < size:
            following = capsules.body[s + trees]
        if body >= 0:
            start, end, speed, low, high = sweep_capsule(s, wp.float32(parameters.dt), capsules, bodies)
            before = near_count
            near_count = list_near_geoms(
                s,
                tree,
                world,
                worlds,
                before,
                room,
                low,
                high,
                geoms,
                geom_states,
                world_boxes,
                static_blocks,
                free,
                world_contacts_out,
            )
            if near_count > before:
                capsule_states_out.start[s] = start
                capsule_states_out.end[s] = end
                capsule_states_out.speed[s] = speed
    world_contacts_out.near_count[tree] = wp.min(near_count, room)
    world_contacts_out.is_impact[tree] = False
    if near_count > room:
        wp.atomic_add(world_contacts_out.dropped, world, near_count - room)


@wp.func
def find_contacts_of_pairs(
    thread: int,
    is_round: bool,
    parameters: Parameters,
    capsules: Capsules,
    geoms: Geoms,
    trees: int,
    threads: int,
    bodies: PlantBodies,
    capsule_states: CapsuleStates,
    rigid: RigidBodies,
    hulls: Hulls,
    geom_states: GeomStates,
    world_contacts_out: WorldContacts,
    candidates_out: Candidates,
):
    """Find the contacts of the near pairs ``thread``, ``thread + threads``, ``thread + 2 threads`` ...

    Contacts of pair i of a tree are the tree's candidates 2 i and 2 i + 1.
    """
    for k in range(thread, world_contacts_out.near_total[0], threads):
        tree = world_contacts_out.near[k][0] % trees
        i = world_contacts_out.near_place[k]
        end, is_impact = add_pairs(
            is_round,
            tree,
            2 * i,
            world_contacts_out.near,
            k,
            1,
            1,
            parameters,
            capsules,
            geoms,
            bodies,
            capsule_states,
            rigid,
            hulls,
            geom_states,
            candidates_out,
        )
        world_contacts_out.found[i * trees + tree] = end - 2 * i
        if is_impact:
            world_contacts_out.is_impact[tree] = True


@wp.kernel(module="unique", enable_backward=False)
def find_contacts(
    # model
    parameters: Parameters,
    capsules: Capsules,
    geoms: Geoms,
    # in
    trees: int,
    threads: int,
    bodies: PlantBodies,
    capsule_states: CapsuleStates,
    rigid: RigidBodies,
    hulls: Hulls,
    geom_states: GeomStates,
    # out
    world_contacts_out: WorldContacts,
    candidates_out: Candidates,
):
    """``threads`` threads. Find contacts by :func:`find_contacts_of_pairs`, for geoms of any kind."""
    find_contacts_of_pairs(
        wp.tid(),
        False,
        parameters,
        capsules,
        geoms,
        trees,
        threads,
        bodies,
        capsule_states,
        rigid,
        hulls,
        geom_states,
        world_contacts_out,
        candidates_out,
    )


@wp.kernel(module="unique", enable_backward=False)
def find_round_contacts(
    # model
    parameters: Parameters,
    capsules: Capsules,
    geoms: Geoms,
    # in
    trees: int,
    threads: int,
    bodies: PlantBodies,
    capsule_states: CapsuleStates,
    rigid: RigidBodies,
    hulls: Hulls,
    geom_states: GeomStates,
    # out
    world_contacts_out: WorldContacts,
    candidates_out: Candidates,
):
    """``threads`` threads. Find contacts by :func:`find_contacts_of_pairs`, if all geoms are planes, spheres or
    capsules."""
    find_contacts_of_pairs(
        wp.tid(),
        True,
        parameters,
        capsules,
        geoms,
        trees,
        threads,
        bodies,
        capsule_states,
        rigid,
        hulls,
        geom_states,
        world_contacts_out,
        candidates_out,
    )


@wp.kernel
def number_contacts(
    # in
    trees: int,
    worlds: int,
    slots: int,
    few: int,
    # out
    world_contacts_out: WorldContacts,
    source_out: wp.array(dtype=wp.int32),
):
    """One thread per world. List the world's contacts in the order of (tree, capsule, geom, end). Contacts beyond the
    slots are counted as dropped.

    few: worlds with more contacts than this are listed as busy. source_out: [slot * worlds + world] candidate of each
    contact.
    """
    world = wp.tid()
    if world == 0:
        world_contacts_out.near_total[0] = 0
    count = int(0)
    for tree in range(world, trees, worlds):
        first = wp.min(count, slots)
        for i in range(world_contacts_out.near_count[tree]):
            for end in range(world_contacts_out.found[i * trees + tree]):
                if count < slots:
                    source_out[count * worlds + world] = 2 * i + end
                    world_contacts_out.tree[count * worlds + world] = tree
                count = count + 1
        world_contacts_out.first[tree] = first
        world_contacts_out.of_tree[tree] = wp.min(count, slots) - first
    listed = wp.min(count, slots)
    world_contacts_out.count[world] = listed
    world_contacts_out.sweeps[world] = 0
    if listed > few:
        world_contacts_out.busy[wp.atomic_add(world_contacts_out.busy_count, 0, 1)] = world
    if count > slots:
        wp.atomic_add(world_contacts_out.dropped, world, count - slots)
