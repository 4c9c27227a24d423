"""Narrowphase of plants among themselves: bunches and side shoots against other parts of their tree, tree against tree.

Two capsules that overlap, or almost touch, in the generated rest pose of all plants are in contact only if they come
closer than in that pose.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import extrapolate_point, to_double, velocity_at, velocity_product_acceleration
from vinesim.kernels.contact.broadphase import aabbs_disjoint, is_collidable, next_overlap
from vinesim.kernels.contact.candidates import Candidate, curvature_gap, is_smooth, store_candidate
from vinesim.kernels.contact.distance import segment_segment_distance, vec6d
from vinesim.kernels.contact.structs import (
    AWAKE_TREES,
    PAIRED_TREES,
    SORT_AXIS,
    Aabbs,
    Candidates,
    Capsules,
    CapsuleStates,
    Parameters,
    PlantBodies,
    Trees,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def are_adjacent(x: int, y: int, parent: wp.array(dtype=wp.int32)):
    """Returns whether two bodies are the same or at most two joints apart."""
    adjacent = x == y
    if x >= 0 and y >= 0:
        x_parent = parent[x]
        y_parent = parent[y]
        adjacent = adjacent or x_parent == y or y_parent == x or (x_parent >= 0 and x_parent == y_parent)
        if x_parent >= 0:
            adjacent = adjacent or parent[x_parent] == y
        if y_parent >= 0:
            adjacent = adjacent or parent[y_parent] == x
    return adjacent


@wp.func
def distance_after_step(
    dt: wp.float32,
    s: int,
    t: int,
    body: int,
    other_body: int,
    bodies: PlantBodies,
    capsule_states: CapsuleStates,
):
    """Returns :func:`segment_segment_distance` of two capsules' axes at the end of the step, if their velocities stay
    constant.
    """
    none = wp.spatial_vector()
    acceleration = velocity_product_acceleration(body, -1, none, bodies.parent, bodies.is_cut, bodies.q, bodies.qd)
    other_acceleration = velocity_product_acceleration(
        other_body, -1, none, bodies.parent, bodies.is_cut, bodies.q, bodies.qd
    )
    return segment_segment_distance(
        to_double(extrapolate_point(dt, bodies.q[body], bodies.qd[body], acceleration, capsule_states.start[s])),
        to_double(extrapolate_point(dt, bodies.q[body], bodies.qd[body], acceleration, capsule_states.end[s])),
        to_double(
            extrapolate_point(
                dt, bodies.q[other_body], bodies.qd[other_body], other_acceleration, capsule_states.start[t]
            )
        ),
        to_double(
            extrapolate_point(
                dt, bodies.q[other_body], bodies.qd[other_body], other_acceleration, capsule_states.end[t]
            )
        ),
    )


@wp.func
def plant_candidate(
    parameters: Parameters,
    s: int,
    t: int,
    nearest: vec6d,
    bodies: PlantBodies,
    capsules: Capsules,
    capsule_states: CapsuleStates,
):
    """Returns the contact of capsules ``s`` and ``t``. ``nearest``: result of :func:`segment_segment_distance`."""
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    dt = parameters.dt
    radii = wp.float64(capsules.radius[s] + capsules.radius[t])
    body = capsules.body[s]
    other_body = capsules.body[t]
    a = to_double(capsule_states.start[s])
    b = to_double(capsule_states.end[s])
    candidate = Candidate()
    gap = nearest[3] - radii
    candidate.normal = wp.vec3d(nearest[0], nearest[1], nearest[2])
    depth = wp.float64(capsules.radius[s]) + half * gap
    candidate.point = a + nearest[4] * (b - a) - depth * candidate.normal
    velocity = velocity_at(bodies.q[body], bodies.qd[body], candidate.point)
    relative = velocity - velocity_at(bodies.q[other_body], bodies.qd[other_body], candidate.point)
    approach = dt * wp.dot(candidate.normal, relative)
    at_rest = segment_segment_distance(
        to_double(capsules.rest_start[s]),
        to_double(capsules.rest_end[s]),
        to_double(capsules.rest_start[t]),
        to_double(capsules.rest_end[t]),
    )
    gap = gap - wp.min(at_rest[3] - radii - parameters.margin, zero)
    free = velocity_at(bodies.q[body], bodies.qd_free[body], candidate.point)
    free = free - velocity_at(bodies.q[other_body], bodies.qd_free[other_body], candidate.point)
    soonest = wp.min(wp.min(approach, dt * wp.dot(candidate.normal, free)), zero)
    candidate.exists = gap + soonest < parameters.static_margin
    candidate.gap = gap
    if candidate.exists:
        later = distance_after_step(wp.float32(dt), s, t, body, other_body, bodies, capsule_states)
        end_normal = wp.vec3d(later[0], later[1], later[2])
        curvature = zero
        if is_smooth(candidate.normal, end_normal):
            curvature = curvature_gap(nearest[3], later[3], approach, dt * wp.length(relative))
            candidate.normal = wp.normalize(candidate.normal + end_normal)
        candidate.end_gap = gap + curvature
        candidate.is_impact = gap + approach + curvature < zero and approach < -parameters.impact_speed * dt
    return candidate


@wp.func
def may_touch_own_tree(s: int, tree: int, low: wp.vec3, high: wp.vec3, capsules: Capsules, wood_boxes: Aabbs):
    """Returns whether a capsule with this box may touch another capsule of its tree. Bunches can touch wood, and
    bunches with a higher index; side shoots can touch axes with a lower number.
    """
    bunch = capsules.bunch[s]
    may = bool(False)
    if bunch >= 0 or capsules.branch[s] > 0:
        clear = aabbs_disjoint(low, high, wood_boxes.low[tree], wood_boxes.high[tree])
        may = not clear or (bunch >= 0 and bunch < capsules.tree_last_bunch[tree])
    return may


@wp.func
def may_touch(s: int, t: int, capsules: Capsules, bodies: PlantBodies):
    """Returns whether two capsules of one tree collide. Each pair of bunches or axes is considered once."""
    pair = bool(True)
    if capsules.bunch[s] < 0:
        pair = capsules.bunch[t] < 0 and capsules.branch[t] < capsules.branch[s]
    elif capsules.bunch[t] >= 0:
        pair = capsules.bunch[t] > capsules.bunch[s]
    if pair:
        pair = not are_adjacent(capsules.body[s], capsules.body[t], bodies.parent)
    return pair


@wp.func
def touching_candidate(
    s: int, t: int, parameters: Parameters, bodies: PlantBodies, capsules: Capsules, capsule_states: CapsuleStates
):
    """Returns the contact of two capsules whose boxes overlap, if they are near enough."""
    nearest = segment_segment_distance(
        to_double(capsule_states.start[s]),
        to_double(capsule_states.end[s]),
        to_double(capsule_states.start[t]),
        to_double(capsule_states.end[t]),
    )
    radii = capsules.radius[s] + capsules.radius[t]
    motion = (capsule_states.speed[s] + capsule_states.speed[t]) * wp.float32(parameters.dt)
    candidate = Candidate()
    if nearest[3] < wp.float64(radii + wp.float32(parameters.margin) + motion):
        candidate = plant_candidate(parameters, s, t, nearest, bodies, capsules, capsule_states)
    return candidate


@wp.kernel
def find_plant_contacts(
    # model
    parameters: Parameters,
    capsules: Capsules,
    # in
    sorted_rows: wp.array(dtype=wp.int32),
    counters: wp.array(dtype=wp.int32),
    trees: Trees,
    tree_boxes: Aabbs,
    wood_boxes: Aabbs,
    bodies: PlantBodies,
    capsule_states: CapsuleStates,
    # out
    candidates_out: Candidates,
):
    """One thread per awake tree. Find its contacts with itself and with the trees after it in the order of their boxes.

    Thread i takes position i in that order: row ``sorted_rows[i]`` of the candidates.
    """
    place = wp.tid()
    if place >= counters[PAIRED_TREES]:
        return
    row = sorted_rows[place]
    tree = trees.awake[row]
    count = candidates_out.count[row]
    axis = counters[SORT_AXIS]
    skin = wp.vec3(wp.float32(parameters.margin))
    last = capsules.tree_start[tree + 1]
    for other_place in range(place, counters[AWAKE_TREES]):
        other = trees.awake[sorted_rows[other_place]]
        if tree_boxes.low[other][axis] > tree_boxes.high[tree][axis]:
            break
        if not aabbs_disjoint(
            tree_boxes.low[tree], tree_boxes.high[tree], tree_boxes.low[other], tree_boxes.high[other]
        ):
            low = wp.max(tree_boxes.low[tree], tree_boxes.low[other]) - skin
            high = wp.min(tree_boxes.high[tree], tree_boxes.high[other]) + skin
            last_other = capsules.tree_start[other + 1]
            s = next_overlap(capsules.tree_start[tree], last, low, high, capsule_states.low, capsule_states.high)
            while s < last:
                s_low = capsule_states.low[s] - skin
                s_high = capsule_states.high[s] + skin
                t = int(last_other)
                if is_collidable(capsules.level[s], trees.is_fine[tree], capsules.bunch[s], trees.bunch_attached):
                    if other != tree or may_touch_own_tree(s, tree, s_low, s_high, capsules, wood_boxes):
                        t = next_overlap(
                            capsules.tree_start[other],
                            last_other,
                            s_low,
                            s_high,
                            capsule_states.low,
                            capsule_states.high,
                        )
                while t < last_other:
                    pair = is_collidable(
                        capsules.level[t], trees.is_fine[other], capsules.bunch[t], trees.bunch_attached
                    )
                    if pair and other == tree:
                        pair = may_touch(s, t, capsules, bodies)
                    if pair:
                        candidate = touching_candidate(s, t, parameters, bodies, capsules, capsule_states)
                        if candidate.exists:
                            if candidate.is_impact:
                                candidates_out.is_impact[row] = True
                            store_candidate(row, count, 2 * s, -1 - t, candidate, candidates_out)
                            count = count + 1
                    t = next_overlap(t + 1, last_other, s_low, s_high, capsule_states.low, capsule_states.high)
                s = next_overlap(s + 1, last, low, high, capsule_states.low, capsule_states.high)
    candidates_out.count[row] = count
