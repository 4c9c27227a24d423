"""Leaves that robots and people touch: the trees whose leaves are near, and the contacts of leaves.

A leaf is treated only while a robot or a person is so near to its tree that the leaf can be within reach. It gives way
by its petiole: its capsule may overlap a geom, and the contact has the petiole's stiffness. Of all geoms that a leaf
overlaps, the one that it overlaps most pushes it aside, so that a hand of many geoms bends a petiole once. The force of
a leaf is therefore the gradient of a potential, and adds no energy.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import to_double, velocity_product_acceleration
from vinesim.kernels.contact.broadphase import aabbs_disjoint, next_overlap, sweep_capsule
from vinesim.kernels.contact.candidates import store_candidate
from vinesim.kernels.contact.distance import vec5d
from vinesim.kernels.contact.narrowphase_rigid import FAR, Pair, rigid_candidate, segment_geom_distance
from vinesim.kernels.contact.structs import (
    AABB_BLOCK,
    AWAKE_TREES,
    NEAR_ASLEEP,
    Aabbs,
    Actors,
    Candidates,
    Capsules,
    CapsuleStates,
    Geoms,
    GeomStates,
    Hulls,
    Leaves,
    Parameters,
    PlantBodies,
    RigidBodies,
    Trees,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def has_leaf_near(
    tree: int,
    first: int,
    end: int,
    actor_low: wp.vec3,
    actor_high: wp.vec3,
    dt: float,
    capsules: Capsules,
    leaves: Leaves,
    bodies: PlantBodies,
    geom_states: GeomStates,
):
    """Returns whether the box of one of a tree's leaves overlaps that of a geom from ``first`` to before ``end``, which
    all lie in the box ``actor_low``, ``actor_high``."""
    is_near = bool(False)
    s = leaves.tree_start[tree]
    last = leaves.tree_start[tree + 1]
    while s < last:
        _start, _end, _speed, low, high = sweep_capsule(s, dt, capsules, bodies)
        s = s + 1
        if not aabbs_disjoint(low, high, actor_low, actor_high):
            if next_overlap(first, end, low, high, geom_states.low, geom_states.high) < end:
                is_near = True
                s = last
    return is_near


@wp.kernel
def mark_trees_with_near_leaves(
    # model
    parameters: Parameters,
    actors: Actors,
    capsules: Capsules,
    leaves: Leaves,
    # in
    trees: Trees,
    bodies: PlantBodies,
    block_boxes: Aabbs,
    tree_boxes: Aabbs,
    actor_boxes: Aabbs,
    geom_states: GeomStates,
    # out
    is_near_out: wp.array(dtype=wp.bool),
    counters_out: wp.array(dtype=wp.int32),
):
    """One thread per block. Mark also those trees of the block of which a leaf's box overlaps a geom of a robot or a
    person. Call it after ``mark_near_trees``, whose marks stay.
    """
    block = wp.tid()
    most = wp.vec3(leaves.most_reach)
    block_low = block_boxes.low[block] - most
    block_high = block_boxes.high[block] + most
    for actor in range(actors.count[0]):
        actor_low = actor_boxes.low[actor]
        actor_high = actor_boxes.high[actor]
        if not actors.may_sleep[actor] and not aabbs_disjoint(block_low, block_high, actor_low, actor_high):
            for tree in range(block * AABB_BLOCK, wp.min((block + 1) * AABB_BLOCK, tree_boxes.low.shape[0])):
                grown = wp.vec3(leaves.reach[tree])
                low = tree_boxes.low[tree] - grown
                high = tree_boxes.high[tree] + grown
                counts = trees.is_remote[tree] or not actors.is_remote[actor]
                if counts and not is_near_out[tree] and not aabbs_disjoint(low, high, actor_low, actor_high):
                    end = actors.start[actor + 1]
                    first = next_overlap(actors.start[actor], end, low, high, geom_states.low, geom_states.high)
                    if first < end and has_leaf_near(
                        tree,
                        first,
                        end,
                        actor_low,
                        actor_high,
                        wp.float32(parameters.dt),
                        capsules,
                        leaves,
                        bodies,
                        geom_states,
                    ):
                        if not trees.is_awake[tree]:
                            wp.atomic_add(counters_out, NEAR_ASLEEP, 1)
                        is_near_out[tree] = True


@wp.func
def add_leaf_contacts(
    row: int,
    tree: int,
    parameters: Parameters,
    capsules: Capsules,
    leaves: Leaves,
    geoms: Geoms,
    trees: Trees,
    bodies: PlantBodies,
    rigid: RigidBodies,
    hulls: Hulls,
    geom_states: GeomStates,
    capsule_states_out: CapsuleStates,
    candidates_out: Candidates,
):
    """Write the contacts of a tree's leaves after the other contacts of its row, at most one for each leaf."""
    count = candidates_out.count[row]
    movable = geoms.count[0]
    for s in range(leaves.tree_start[tree], leaves.tree_start[tree + 1]):
        start, end, speed, low, high = sweep_capsule(s, wp.float32(parameters.dt), capsules, bodies)
        g = next_overlap(0, movable, low, high, geom_states.low, geom_states.high)
        pair = Pair()
        pair.geom = -1
        least = FAR
        nearest = vec5d()
        radius = wp.float64(capsules.radius[s])
        while g < movable:
            if geoms.touches_leaves[g] and (trees.is_remote[tree] or not geoms.is_remote[g]):
                margin = parameters.margin + (wp.float64(speed) + geom_states.speed[g]) * parameters.dt
                found = segment_geom_distance(
                    False,
                    geoms,
                    hulls,
                    g,
                    rigid.xmat[geoms.id[g]],
                    geom_states.center[g],
                    to_double(start),
                    to_double(end),
                    radius + margin,
                )
                if found[3] < radius + margin and found[3] < least:
                    pair.geom = g
                    least = found[3]
                    nearest = found
            g = next_overlap(g + 1, movable, low, high, geom_states.low, geom_states.high)
        if pair.geom >= 0:
            capsule_states_out.start[s] = start
            capsule_states_out.end[s] = end
            capsule_states_out.speed[s] = speed
            pair.capsule = s
            pair.body = capsules.body[s]
            pair.ends = 1
            pair.rotation = rigid.xmat[geoms.id[pair.geom]]
            acceleration = velocity_product_acceleration(
                pair.body, -1, wp.spatial_vector(), bodies.parent, bodies.is_cut, bodies.q, bodies.qd
            )
            candidate = rigid_candidate(
                False,
                parameters,
                pair,
                nearest,
                nearest[4],
                False,
                acceleration,
                bodies,
                capsules,
                capsule_states_out,
                geoms,
                hulls,
                geom_states,
            )
            store_candidate(row, count, 2 * s, pair.geom, candidate, candidates_out)
            count = count + 1
    candidates_out.count[row] = count


@wp.kernel
def find_leaf_contacts(
    # model
    threads: int,
    parameters: Parameters,
    capsules: Capsules,
    leaves: Leaves,
    geoms: Geoms,
    # in
    counters: wp.array(dtype=wp.int32),
    trees: Trees,
    tree_boxes: Aabbs,
    bodies: PlantBodies,
    rigid: RigidBodies,
    hulls: Hulls,
    geom_states: GeomStates,
    # out
    capsule_states_out: CapsuleStates,
    candidates_out: Candidates,
):
    """Find the contacts of the leaves of each awake tree with robots and people. Call it after all other contacts are
    found.

    Thread i takes the rows i, i + threads, i + 2 threads ...
    """
    movable = geoms.count[0]
    for row in range(wp.tid(), counters[AWAKE_TREES], threads):
        tree = trees.awake[row]
        if leaves.tree_start[tree] < leaves.tree_start[tree + 1]:
            grown = wp.vec3(leaves.reach[tree])
            low = tree_boxes.low[tree] - grown
            high = tree_boxes.high[tree] + grown
            if next_overlap(0, movable, low, high, geom_states.low, geom_states.high) < movable:
                add_leaf_contacts(
                    row,
                    tree,
                    parameters,
                    capsules,
                    leaves,
                    geoms,
                    trees,
                    bodies,
                    rigid,
                    hulls,
                    geom_states,
                    capsule_states_out,
                    candidates_out,
                )
