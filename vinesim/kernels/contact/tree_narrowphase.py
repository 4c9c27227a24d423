"""Narrowphase of trees that are worlds of their own with geoms that do not move: pairs, contacts of each, their numbers.

Contacts are found in a kernel for geoms of any kind, and in a far shorter one for planes, spheres and capsules alone: a GPU
whose threads are at many places of a long kernel waits for instructions more than for anything else. The number of a
contact in its tree follows from the pairs before its own, so that it is the same in every run.
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
    """What is kept of each tree's contacts [tree] from step to step."""

    count: wp.array(dtype=wp.int32)
    """of this step."""
    near: wp.array(dtype=wp.vec2i)
    """[k] scratch: capsules and geoms whose boxes overlap, those of all trees in any order."""
    near_place: wp.array(dtype=wp.int32)
    """[k] which pair of its tree each is."""
    near_total: wp.array(dtype=wp.int32)
    """[1] number of these pairs."""
    near_count: wp.array(dtype=wp.int32)
    """of them."""
    found: wp.array(dtype=wp.int32)
    """[i * trees + tree] scratch: contacts of such a pair, 0 to 2."""
    busy_count: wp.array(dtype=wp.int32)
    """[1] number of trees that need more threads or sweeps than most."""
    busy: wp.array(dtype=wp.int32)
    """[i] these trees, in any order."""
    is_impact: wp.array(dtype=wp.bool)
    """[tree]"""
    dropped: wp.array(dtype=wp.int32)
    """left out since the start, for want of room."""
    sweeps: wp.array(dtype=wp.int32)
    """of the last solve."""
    loaded_count: wp.array(dtype=wp.int32)
    """bodies that the wrenches of the last contacts act on."""
    loaded: wp.array(dtype=wp.int32)
    """[i * trees + tree] these bodies."""


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
    """List the geoms whose boxes overlap that of capsule ``s``; returns how many pairs its tree has then. More than there
    is ``room`` for are only counted."""
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
    """One thread per tree: pairs of a capsule and a geom whose boxes overlap, and where these capsules are.

    Capsule i of a tree is ``i * trees + tree``; one without a body is none. Pairs beyond their room count as dropped.
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
    """Contacts of every so-manieth near pair: those of pair i of a tree are its candidates 2 i and 2 i + 1."""
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
    """``threads`` threads: :func:`find_contacts_of_pairs` with geoms of any kind."""
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
    """``threads`` threads: :func:`find_contacts_of_pairs` where all geoms are planes, spheres and capsules."""
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
    """One thread per tree: its contacts in the order of (capsule, geom, end). What exceeds the slots is only counted.

    few: trees with more contacts are listed as busy. source_out: [slot * trees + tree] which candidate each contact is.
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
