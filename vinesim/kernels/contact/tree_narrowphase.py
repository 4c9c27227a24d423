"""Narrowphase for batches of independent trees with static geoms: near pairs and contacts of each tree.

Contacts are found by a kernel for geoms of any kind, or by a far shorter kernel for planes, spheres and capsules only.
If the threads of a GPU execute different parts of a long kernel, the GPU mostly waits for instructions. The index of a
contact in its tree is computed from the numbers of contacts of earlier pairs, so that it is the same in every run.
"""

import warp as wp

from vinesim.kernels.contact.broadphase import aabbs_disjoint, sweep_capsule
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

wp.set_module_options({"enable_backward": False})


@wp.struct
class TreeContacts:
    """Data about each tree's contacts that is kept from step to step [tree]."""

    count: wp.array(dtype=wp.int32)
    """[tree] Number of contacts in this step."""
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
    """[1] Number of trees that need more threads or sweeps than most trees."""
    busy: wp.array(dtype=wp.int32)
    """[i] Trees that need more threads or sweeps than most trees, in any order."""
    is_impact: wp.array(dtype=wp.bool)
    """[tree] Whether one of the tree's contacts is an impact."""
    dropped: wp.array(dtype=wp.int32)
    """[tree] Number of contacts left out since the start because the tree had no room for them."""
    sweeps: wp.array(dtype=wp.int32)
    """[tree] Number of sweeps in the last solve."""
    loaded_count: wp.array(dtype=wp.int32)
    """[tree] Number of bodies on which the wrenches of the last contacts act."""
    loaded: wp.array(dtype=wp.int32)
    """[i * trees + tree] Bodies on which the wrenches of the last contacts act."""


@wp.func
def list_near_geoms(
    s: int,
    near_count: int,
    room: int,
    low: wp.vec3,
    high: wp.vec3,
    geoms: Geoms,
    geom_states: GeomStates,
    static_blocks: Aabbs,
    tree_contacts_out: TreeContacts,
):
    """List the geoms whose boxes overlap the box of capsule ``s``. Returns the new number of near pairs of the tree.

    Pairs for which there is no ``room`` are counted but not listed.
    """
    for block in range(static_blocks.low.shape[0]):
        if not aabbs_disjoint(low, high, static_blocks.low[block], static_blocks.high[block]):
            for g in range(block * AABB_BLOCK, wp.min((block + 1) * AABB_BLOCK, geoms.count[1])):
                if not aabbs_disjoint(low, high, geom_states.low[g], geom_states.high[g]):
                    if near_count < room:
                        k = wp.atomic_add(tree_contacts_out.near_total, 0, 1)
                        tree_contacts_out.near[k] = wp.vec2i(s, g)
                        tree_contacts_out.near_place[k] = near_count
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
    bodies: PlantBodies,
    geom_states: GeomStates,
    static_blocks: Aabbs,
    # out
    capsule_states_out: CapsuleStates,
    tree_contacts_out: TreeContacts,
):
    """One thread per tree. List the pairs of a capsule and a geom whose boxes overlap, and compute the capsules'
    states.

    Capsule i of a tree is at ``i * trees + tree``; an entry without a body is no capsule. Pairs for which there is no
    room count as dropped.
    """
    tree = wp.tid()
    if tree == 0:
        tree_contacts_out.busy_count[0] = 0
    room = tree_contacts_out.near.shape[0] / trees
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
                s, before, room, low, high, geoms, geom_states, static_blocks, tree_contacts_out
            )
            if near_count > before:
                capsule_states_out.start[s] = start
                capsule_states_out.end[s] = end
                capsule_states_out.speed[s] = speed
    tree_contacts_out.near_count[tree] = wp.min(near_count, room)
    tree_contacts_out.is_impact[tree] = False
    if near_count > room:
        tree_contacts_out.dropped[tree] += near_count - room


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
    tree_contacts_out: TreeContacts,
    candidates_out: Candidates,
):
    """Find the contacts of the near pairs ``thread``, ``thread + threads``, ``thread + 2 threads`` ...

    Contacts of pair i of a tree are the tree's candidates 2 i and 2 i + 1.
    """
    for k in range(thread, tree_contacts_out.near_total[0], threads):
        tree = tree_contacts_out.near[k][0] % trees
        i = tree_contacts_out.near_place[k]
        end, is_impact = add_pairs(
            is_round,
            tree,
            2 * i,
            tree_contacts_out.near,
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
        tree_contacts_out.found[i * trees + tree] = end - 2 * i
        if is_impact:
            tree_contacts_out.is_impact[tree] = True


@wp.kernel(module="unique", enable_backward=False)
def find_tree_contacts(
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
    tree_contacts_out: TreeContacts,
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
        tree_contacts_out,
        candidates_out,
    )


@wp.kernel(module="unique", enable_backward=False)
def find_round_tree_contacts(
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
    tree_contacts_out: TreeContacts,
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
        tree_contacts_out,
        candidates_out,
    )


@wp.kernel
def number_tree_contacts(
    # in
    trees: int,
    slots: int,
    few: int,
    # out
    tree_contacts_out: TreeContacts,
    source_out: wp.array(dtype=wp.int32),
):
    """One thread per tree. List the tree's contacts in the order of (capsule, geom, end). Contacts beyond the slots are
    counted as dropped.

    few: trees with more contacts than this are listed as busy. source_out: [slot * trees + tree] candidate of each
    contact.
    """
    tree = wp.tid()
    if tree == 0:
        tree_contacts_out.near_total[0] = 0
    count = int(0)
    for i in range(tree_contacts_out.near_count[tree]):
        for end in range(tree_contacts_out.found[i * trees + tree]):
            if count < slots:
                source_out[count * trees + tree] = 2 * i + end
            count = count + 1
    tree_contacts_out.count[tree] = wp.min(count, slots)
    tree_contacts_out.sweeps[tree] = 0
    if count > few:
        tree_contacts_out.busy[wp.atomic_add(tree_contacts_out.busy_count, 0, 1)] = tree
    if count > slots:
        tree_contacts_out.dropped[tree] += count - slots
