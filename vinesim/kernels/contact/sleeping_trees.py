"""Search for sleeping trees that awake trees will touch in the step: by boxes of blocks, trees and capsules, then by
the narrowphase.

A capsule that was compared with all sleeping trees around it is compared again only after it has moved as far as its
clearance at that time. So an awake tree that hardly moves takes one comparison for each capsule.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import to_double
from vinesim.kernels.contact.broadphase import FAR, aabbs_disjoint, is_collidable
from vinesim.kernels.contact.distance import segment_segment_distance
from vinesim.kernels.contact.narrowphase_plants import plant_candidate
from vinesim.kernels.contact.structs import (
    AABB_BLOCK,
    SEARCHING_TREES,
    Aabbs,
    Capsules,
    CapsuleStates,
    Clearances,
    Parameters,
    PlantBodies,
    Trees,
)

wp.set_module_options({"enable_backward": False})

SEARCH_DISTANCE = wp.constant(0.005)
"""[m] Distance around a capsule within which sleeping trees are searched. TUNED."""


@wp.func
def list_due_capsules(
    dt: float,
    tree: int,
    capsules: Capsules,
    trees: Trees,
    bodies: PlantBodies,
    capsule_states: CapsuleStates,
    clearances_out: Clearances,
):
    """Find the *due* capsules of a tree: those that may touch a sleeping tree before the step ends.

    Returns the bounding box of these capsules.
    """
    low = wp.vec3(FAR)
    high = wp.vec3(-FAR)
    for s in range(capsules.tree_start[tree], capsules.tree_start[tree + 1]):
        clearances_out.reach[s] = 0.0
        if is_collidable(capsules.level[s], trees.is_fine[tree], capsules.bunch[s], trees.bunch_attached):
            start = capsule_states.start[s]
            end = capsule_states.end[s]
            free = bodies.qd_free[capsules.body[s]]
            speed = wp.length(wp.spatial_top(free)) + capsules.extent[s] * wp.length(wp.spatial_bottom(free))
            motion = dt * wp.max(speed, capsule_states.speed[s])
            moved = wp.max(wp.length(start - clearances_out.start[s]), wp.length(end - clearances_out.end[s]))
            if not moved + motion < clearances_out.distance[s]:
                reach = SEARCH_DISTANCE + motion
                clearances_out.reach[s] = reach
                clearances_out.distance[s] = SEARCH_DISTANCE
                clearances_out.start[s] = start
                clearances_out.end[s] = end
                low = wp.min(low, capsule_states.low[s] - wp.vec3(reach))
                high = wp.max(high, capsule_states.high[s] + wp.vec3(reach))
    return low, high


@wp.func
def compare_with_sleeping_tree(
    parameters: Parameters,
    tree: int,
    other: int,
    capsules: Capsules,
    trees: Trees,
    tree_boxes: Aabbs,
    bodies: PlantBodies,
    capsule_states: CapsuleStates,
    clearances_out: Clearances,
):
    """Returns whether the due capsules of a tree will be in contact with another tree. A capsule is *due* if it may
    touch a sleeping tree before the step ends.

    Also stores how far each due capsule may move before it must be compared with the other tree again (its clearance).
    """
    reached = bool(False)
    for s in range(capsules.tree_start[tree], capsules.tree_start[tree + 1]):
        reach = clearances_out.reach[s]
        low = capsule_states.low[s] - wp.vec3(reach)
        high = capsule_states.high[s] + wp.vec3(reach)
        if reach > 0.0 and not aabbs_disjoint(low, high, tree_boxes.low[other], tree_boxes.high[other]):
            for t in range(capsules.tree_start[other], capsules.tree_start[other + 1]):
                if not aabbs_disjoint(low, high, capsule_states.low[t], capsule_states.high[t]) and is_collidable(
                    capsules.level[t], trees.is_fine[other], capsules.bunch[t], trees.bunch_attached
                ):
                    nearest = segment_segment_distance(
                        to_double(capsule_states.start[s]),
                        to_double(capsule_states.end[s]),
                        to_double(capsule_states.start[t]),
                        to_double(capsule_states.end[t]),
                    )
                    if nearest[3] < wp.float64(capsules.radius[s] + capsules.radius[t] + reach):
                        candidate = plant_candidate(parameters, s, t, nearest, bodies, capsules, capsule_states)
                        clearances_out.distance[s] = wp.min(clearances_out.distance[s], wp.float32(candidate.gap))
                        reached = reached or candidate.exists
    return reached


@wp.kernel
def find_reached_trees(
    # model
    parameters: Parameters,
    capsules: Capsules,
    # in
    counters: wp.array(dtype=wp.int32),
    trees: Trees,
    block_boxes: Aabbs,
    tree_boxes: Aabbs,
    bodies: PlantBodies,
    capsule_states: CapsuleStates,
    # out
    clearances_out: Clearances,
    is_reached_out: wp.array(dtype=wp.bool),
):
    """One thread per awake tree. Mark the sleeping trees that the tree will touch before the step ends.

    Thread i takes the tree ``trees.awake[i]``. Capsules that overlap, or almost touch, in the generated pose are in
    contact only if they come closer than in that pose (:func:`plant_candidate`), so that trees that stand close
    together do not wake each other.
    """
    row = wp.tid()
    if row >= counters[SEARCHING_TREES]:
        return
    tree = trees.awake[row]
    low, high = list_due_capsules(
        wp.float32(parameters.dt), tree, capsules, trees, bodies, capsule_states, clearances_out
    )
    if low[0] > high[0]:
        return
    for block in range(block_boxes.low.shape[0]):
        if not aabbs_disjoint(low, high, block_boxes.low[block], block_boxes.high[block]):
            for other in range(block * AABB_BLOCK, wp.min((block + 1) * AABB_BLOCK, tree_boxes.low.shape[0])):
                asleep = not trees.is_awake[other] and not is_reached_out[other]
                if asleep and not aabbs_disjoint(low, high, tree_boxes.low[other], tree_boxes.high[other]):
                    if compare_with_sleeping_tree(
                        parameters, tree, other, capsules, trees, tree_boxes, bodies, capsule_states, clearances_out
                    ):
                        is_reached_out[other] = True
