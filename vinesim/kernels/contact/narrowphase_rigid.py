"""Narrowphase of plants and rigid geoms: finds contacts of a tree's capsules with geoms that exist now or may begin
before the step ends.

Two shapes that overlap, or almost touch, in the generated rest pose of all plants are in contact only if they come
closer than in that pose. For a piece that was cut off, this allowed overlap shrinks by the distance that the piece has
moved since, so that a shoot that grew around a wire does not fall through the wire. A deflected wire is in contact with
shapes that it would overlap in its undeflected position. A bunch that overlaps a tree when it is picked passes through
that tree until the two no longer overlap.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import (
    extrapolate_point,
    rotate_by_small_angle,
    to_double,
    velocity_at,
    velocity_product_acceleration,
    was_cut_off,
)
from vinesim.kernels.contact.broadphase import aabbs_disjoint, is_collidable, list_near_geoms
from vinesim.kernels.contact.candidates import Candidate, curvature_gap, is_smooth, store_candidate
from vinesim.kernels.contact.distance import (
    HEIGHT_FIELD,
    MESH,
    PLANE,
    has_flat_or_straight_side,
    interval_along_face,
    is_outside_box,
    segment_primitive_distance,
    vec5d,
)
from vinesim.kernels.contact.ground_distance import segment_ground_distance
from vinesim.kernels.contact.hull_distance import interval_along_hull, segment_hull_distance
from vinesim.kernels.contact.structs import (
    AWAKE_TREES,
    Aabbs,
    Candidates,
    Capsules,
    CapsuleStates,
    Geoms,
    GeomStates,
    Hulls,
    Parameters,
    PassingBunches,
    PlantBodies,
    RigidBodies,
    Trees,
)

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(wp.float64(1.0e30))
"""[m] Value of ``reach`` for an unlimited search."""


@wp.struct
class Pair:
    """A capsule and a geom whose distance is smaller than the distance by which they can approach in the step."""

    capsule: int
    body: int
    """Plant body of the capsule."""
    geom: int
    ends: int
    """Number of contacts of the pair: 2 if a part of the capsule lies along a face of the geom (one contact at each end
    of this part), else 1.
    """
    rotation: wp.mat33d
    """Rotation of the geom."""


@wp.func
def segment_geom_distance(
    is_round: bool,
    geoms: Geoms,
    hulls: Hulls,
    g: int,
    rotation: wp.mat33d,
    center: wp.vec3d,
    a: wp.vec3d,
    b: wp.vec3d,
    reach: wp.float64,
):
    """Returns the world normal (entries 0 to 2) and distance (3) [m] from a geom to the segment a b, and the parameter
    (4) of its closest point, 0 to 1.

    Beyond ``reach`` [m] the distance from a hull is a lower bound. ``is_round``: all geoms are known to be planes,
    spheres and capsules, so that much less code is compiled.
    """
    found = vec5d()
    if not is_round and geoms.kind[g] == MESH:
        to_local = wp.transpose(rotation)
        found = segment_hull_distance(hulls, geoms.hull[g], to_local * (a - center), to_local * (b - center), reach)
        normal = rotation * wp.vec3d(found[0], found[1], found[2])
        found[0] = normal[0]
        found[1] = normal[1]
        found[2] = normal[2]
    elif not is_round and geoms.kind[g] == HEIGHT_FIELD:
        found = segment_ground_distance(hulls, a, b)
    else:
        found = segment_primitive_distance(is_round, geoms.kind[g], geoms.size[g], rotation, center, a, b)
    return found


@wp.func
def is_in_tile(is_round: bool, geoms: Geoms, g: int, center: wp.vec3d, p: wp.vec3d):
    """Returns whether point ``p`` [m] is above or below the geom, if the geom is a tile of uneven ground; True for other
    geoms. So a capsule across the border of two tiles touches one of them."""
    inside = bool(True)
    if not is_round and geoms.kind[g] == HEIGHT_FIELD:
        half = geoms.half[g]
        inside = wp.abs(p[0] - center[0]) <= half[0] and wp.abs(p[1] - center[1]) <= half[1]
    return inside


@wp.func
def follow_contact(
    is_round: bool,
    parameters: Parameters,
    candidate: Candidate,
    pair: Pair,
    nearest: vec5d,
    t: wp.float64,
    approach: wp.float64,
    relative: wp.vec3d,
    velocity: wp.vec3d,
    acceleration: wp.spatial_vector,
    bodies: PlantBodies,
    capsule_states: CapsuleStates,
    geoms: Geoms,
    hulls: Hulls,
    geom_states: GeomStates,
):
    """Returns the candidate with normal, point and gap that take into account the motion of both sides over the step at
    their present velocities.

    The two ends of a part along a face are followed separately. For a single contact, the closest points are found
    again at the end of the step. ``approach`` [m]: change of distance at constant velocity. ``relative`` [m/s]:
    ``velocity`` of the capsule at the contact minus that of the geom. ``acceleration``: of the body, see
    :func:`velocity_product_acceleration`.
    """
    s = pair.capsule
    body = pair.body
    g = pair.geom
    dt = parameters.dt
    half = wp.float64(0.5)
    end_a = to_double(
        extrapolate_point(wp.float32(dt), bodies.q[body], bodies.qd[body], acceleration, capsule_states.start[s])
    )
    end_b = to_double(
        extrapolate_point(wp.float32(dt), bodies.q[body], bodies.qd[body], acceleration, capsule_states.end[s])
    )
    if pair.ends == 2:
        end_a = end_a + t * (end_b - end_a)
        end_b = end_a
    later = segment_geom_distance(
        is_round,
        geoms,
        hulls,
        g,
        rotate_by_small_angle(dt * geom_states.angular_velocity[g], pair.rotation),
        geom_states.center[g] + dt * geom_states.velocity[g],
        end_a,
        end_b,
        FAR,
    )
    end_normal = wp.vec3d(later[0], later[1], later[2])
    curvature = wp.float64(0.0)
    if is_smooth(candidate.normal, end_normal):
        curvature = curvature_gap(nearest[3], later[3], approach, dt * wp.length(relative))
        moved = end_a + later[4] * (end_b - end_a)
        moved = moved - (later[3] - half * candidate.gap) * end_normal - dt * velocity
        candidate.normal = wp.normalize(candidate.normal + end_normal)
        candidate.point = half * (candidate.point + moved)
    candidate.end_gap = candidate.gap + curvature
    if candidate.gap + approach + curvature < wp.float64(0.0) and approach < -parameters.impact_speed * dt:
        candidate.is_impact = True
    return candidate


@wp.func
def rigid_candidate(
    is_round: bool,
    parameters: Parameters,
    pair: Pair,
    nearest: vec5d,
    t: wp.float64,
    is_static: bool,
    acceleration: wp.spatial_vector,
    bodies: PlantBodies,
    capsules: Capsules,
    capsule_states: CapsuleStates,
    geoms: Geoms,
    hulls: Hulls,
    geom_states: GeomStates,
):
    """Returns the contact of a pair at the parameter ``t`` (0 to 1) on the capsule's axis.

    ``nearest``: see :func:`segment_primitive_distance`.
    """
    s = pair.capsule
    body = pair.body
    g = pair.geom
    zero = wp.float64(0.0)
    dt = parameters.dt
    radius = wp.float64(capsules.radius[s])
    a = to_double(capsule_states.start[s])
    b = to_double(capsule_states.end[s])
    candidate = Candidate()
    candidate.exists = True
    candidate.gap = nearest[3] - radius
    candidate.normal = wp.vec3d(nearest[0], nearest[1], nearest[2])
    candidate.point = a + t * (b - a) - (radius + wp.float64(0.5) * candidate.gap) * candidate.normal
    velocity = velocity_at(bodies.q[body], bodies.qd[body], candidate.point)
    geom_velocity = geom_states.velocity[g] + wp.cross(
        geom_states.angular_velocity[g], candidate.point - geom_states.center[g]
    )
    relative = velocity - geom_velocity
    approach = dt * wp.dot(candidate.normal, relative)
    if is_static:
        rest_a = to_double(capsules.rest_start[s])
        rest_b = to_double(capsules.rest_end[s])
        at_rest = vec5d()
        if not is_round and geoms.kind[g] == HEIGHT_FIELD:
            at_rest = segment_ground_distance(hulls, rest_a, rest_b)
        else:
            at_rest = segment_primitive_distance(
                is_round,
                geoms.kind[g],
                geoms.size[g],
                pair.rotation,
                geom_states.center[g] - geom_states.offset[g],
                rest_a,
                rest_b,
            )
        overlap = -wp.min(at_rest[3] - radius - parameters.margin, zero)
        if overlap > zero and was_cut_off(body, bodies.parent, bodies.is_cut):
            moved = wp.max(wp.length(a - rest_a), wp.length(b - rest_b))
            overlap = wp.max(radius - at_rest[3] - moved, zero)
        candidate.gap = candidate.gap + overlap
        free = velocity_at(bodies.q[body], bodies.qd_free[body], candidate.point)
        soonest = wp.min(wp.min(approach, dt * wp.dot(candidate.normal, free)), zero)
        deflected = wp.min(wp.dot(candidate.normal, geom_states.offset[g]), zero)
        candidate.exists = candidate.gap + deflected + soonest < parameters.static_margin
    if candidate.exists:
        candidate = follow_contact(
            is_round,
            parameters,
            candidate,
            pair,
            nearest,
            t,
            approach,
            relative,
            velocity,
            acceleration,
            bodies,
            capsule_states,
            geoms,
            hulls,
            geom_states,
        )
    return candidate


@wp.func
def contact_ends(
    is_round: bool,
    parameters: Parameters,
    geoms: Geoms,
    hulls: Hulls,
    g: int,
    rotation: wp.mat33d,
    center: wp.vec3d,
    a: wp.vec3d,
    b: wp.vec3d,
    nearest: vec5d,
):
    """Returns the parameters (0 to 1) of both ends of the part of the segment a b along a face of a geom. The two
    parameters are equal if no part of the segment is along a face.

    ``nearest``: result of :func:`segment_geom_distance`.
    """
    ends = wp.vec2d(nearest[4], nearest[4])
    to_local = wp.transpose(rotation)
    local_a = to_local * (a - center)
    local_b = to_local * (b - center)
    if geoms.kind[g] == PLANE:
        ends = wp.vec2d(wp.float64(0.0), wp.float64(1.0))
    elif not is_round and geoms.kind[g] == MESH:
        normal = to_local * wp.vec3d(nearest[0], nearest[1], nearest[2])
        local = vec5d(normal[0], normal[1], normal[2], nearest[3], nearest[4])
        ends = interval_along_hull(hulls, geoms.hull[g], local_a, local_b, local, parameters.margin)
    elif has_flat_or_straight_side(geoms.kind[g]):
        ends = interval_along_face(
            is_round, geoms.kind[g], geoms.size[g], local_a, local_b, nearest[4], parameters.margin
        )
    return ends


@wp.func
def is_tied(capsule: int, geom: int, capsules: Capsules, is_cut: wp.array(dtype=wp.bool)):
    """Returns whether a tie prevents collisions of a capsule with a geom, given by its MuJoCo index.

    The tie holds the capsule's body, or its parent or child if the joint between them was not cut.
    """
    tied = bool(False)
    for k in range(capsules.tied_geom.shape[1]):
        if capsules.tied_geom[capsule, k] == geom:
            joint = capsules.tied_joint[capsule, k]
            if joint < 0:
                tied = True
            elif not is_cut[joint]:
                tied = True
    return tied


@wp.func
def clear_slots(row: int, count: int, candidates_out: Candidates):
    """Mark the slots from ``count`` on as empty in a row of the table of candidates [awake tree, slot]."""
    slots = candidates_out.feature.shape[1]
    for k in range(wp.min(count, slots), slots):
        candidates_out.feature[row, k] = -1


@wp.func
def add_pairs(
    is_round: bool,
    row: int,
    count: int,
    pairs: wp.array(dtype=wp.vec2i),
    first: int,
    pitch: int,
    pair_count: int,
    parameters: Parameters,
    capsules: Capsules,
    geoms: Geoms,
    bodies: PlantBodies,
    capsule_states: CapsuleStates,
    rigid: RigidBodies,
    hulls: Hulls,
    geom_states: GeomStates,
    candidates_out: Candidates,
):
    """Find the contacts of a tree's pairs of a capsule and a geom with overlapping boxes. Write them to the tree's row
    in the table of candidates, after the ``count`` contacts that the row already has.

    The pairs are listed ``pitch`` apart, from ``first`` on, sorted by capsule. Returns the number of contacts, and
    whether one contact is an impact. One call handles all pairs of a tree, because every call copies all structs.
    """
    is_impact = bool(False)
    total = int(count)
    known = int(-1)
    acceleration = wp.spatial_vector()
    for i in range(pair_count):
        s = pairs[first + i * pitch][0]
        g = pairs[first + i * pitch][1]
        radius = wp.float64(capsules.radius[s])
        a = to_double(capsule_states.start[s])
        b = to_double(capsule_states.end[s])
        bound = wp.float64(0.5) * wp.length(b - a) + radius
        center = geom_states.center[g]
        margin = parameters.margin + (wp.float64(capsule_states.speed[s]) + geom_states.speed[g]) * parameters.dt
        between = wp.float64(0.5) * (a + b) - center
        limit = bound + geoms.radius[g] + margin
        rotation = rigid.xmat[geoms.id[g]]
        near = wp.dot(between, between) < limit * limit
        if near and not is_round and geoms.kind[g] > HEIGHT_FIELD:
            to_local = wp.transpose(rotation)  # the box test is fast, and excludes half of all pairs
            near = not is_outside_box(geoms.half[g], to_local * (a - center), to_local * (b - center), radius + margin)
        if near:
            nearest = segment_geom_distance(is_round, geoms, hulls, g, rotation, center, a, b, radius + margin)
            if (
                nearest[3] - radius < margin
                and is_in_tile(is_round, geoms, g, center, a + nearest[4] * (b - a))
                and not is_tied(s, geoms.id[g], capsules, bodies.is_cut)
            ):
                ends = contact_ends(is_round, parameters, geoms, hulls, g, rotation, center, a, b, nearest)
                pair = Pair()
                pair.capsule = s
                pair.body = capsules.body[s]
                pair.geom = g
                pair.ends = wp.where(ends[0] < ends[1], 2, 1)
                pair.rotation = rotation
                acceleration = velocity_product_acceleration(
                    pair.body, known, acceleration, bodies.parent, bodies.is_cut, bodies.q, bodies.qd
                )
                known = pair.body
                for end in range(pair.ends):
                    if pair.ends == 2:
                        p = a + ends[end] * (b - a)
                        nearest = segment_geom_distance(is_round, geoms, hulls, g, rotation, center, p, p, FAR)
                    candidate = rigid_candidate(
                        is_round,
                        parameters,
                        pair,
                        nearest,
                        ends[end],
                        g >= geoms.count[0],
                        acceleration,
                        bodies,
                        capsules,
                        capsule_states,
                        geoms,
                        hulls,
                        geom_states,
                    )
                    if candidate.exists:
                        is_impact = is_impact or candidate.is_impact
                        store_candidate(row, total, 2 * s + end, g, candidate, candidates_out)
                        total = total + 1
    return total, is_impact


@wp.func
def overlaps_bunch(
    row: int,
    tree: int,
    bunch: int,
    near_count: int,
    capsules: Capsules,
    geoms: Geoms,
    trees: Trees,
    capsule_states: CapsuleStates,
    rigid: RigidBodies,
    hulls: Hulls,
    geom_states: GeomStates,
    near_geoms: wp.array2d(dtype=wp.int32),
    bunch_of_geom: wp.array(dtype=wp.int32),
):
    """Returns whether a capsule of a tree overlaps a free bunch.

    ``near_geoms`` [row, near_count]: the geoms to test.
    """
    overlaps = bool(False)
    for k in range(near_count):
        g = near_geoms[row, k]
        if bunch_of_geom[g] == bunch:
            for s in range(capsules.tree_start[tree], capsules.tree_start[tree + 1]):
                if not overlaps and is_collidable(
                    capsules.level[s], trees.is_fine[tree], capsules.bunch[s], trees.bunch_attached
                ):
                    nearest = segment_geom_distance(
                        False,
                        geoms,
                        hulls,
                        g,
                        rigid.xmat[geoms.id[g]],
                        geom_states.center[g],
                        to_double(capsule_states.start[s]),
                        to_double(capsule_states.end[s]),
                        FAR,
                    )
                    overlaps = nearest[3] < wp.float64(capsules.radius[s])
    return overlaps


@wp.func
def is_passing(tree: int, bunch: int, by_tree: wp.array2d(dtype=wp.int32)):
    """Returns whether a free bunch (-1: no bunch) passes through a tree."""
    passing = bool(False)
    if bunch >= 0:
        for k in range(by_tree.shape[1]):
            passing = passing or by_tree[tree, k] == bunch
    return passing


@wp.func
def find_contacts_of_tree(
    row: int,
    parameters: Parameters,
    max_static_geoms: int,
    capsules: Capsules,
    geoms: Geoms,
    trees: Trees,
    tree_boxes: Aabbs,
    bodies: PlantBodies,
    capsule_states: CapsuleStates,
    rigid: RigidBodies,
    hulls: Hulls,
    geom_states: GeomStates,
    static_blocks: Aabbs,
    passing_out: PassingBunches,
    candidates_out: Candidates,
):
    """Find the contacts of the tree ``trees.awake[row]`` with rigid geoms, and write them to row ``row`` of the
    candidates.

    A picked bunch that was passing through the tree collides with the tree again once the two no longer overlap.
    """
    tree = trees.awake[row]
    near_count = list_near_geoms(
        row,
        tree_boxes.low[tree],
        tree_boxes.high[tree],
        trees.is_remote[tree],
        max_static_geoms,
        geoms,
        geom_states,
        static_blocks,
        candidates_out.near_geoms,
    )
    most = wp.min(geoms.count[0] + max_static_geoms, candidates_out.near_geoms.shape[1])
    candidates_out.skipped_geoms[row] = wp.max(near_count - most, 0)
    near_count = wp.min(near_count, most)
    for k in range(passing_out.by_tree.shape[1]):
        bunch = passing_out.by_tree[tree, k]
        if bunch >= 0 and not overlaps_bunch(
            row,
            tree,
            bunch,
            near_count,
            capsules,
            geoms,
            trees,
            capsule_states,
            rigid,
            hulls,
            geom_states,
            candidates_out.near_geoms,
            passing_out.of_geom,
        ):
            passing_out.by_tree[tree, k] = -1
    is_impact = bool(False)
    count = int(0)
    room = candidates_out.near_pairs.shape[0] / candidates_out.count.shape[0]
    pair_count = int(0)
    last = capsules.tree_start[tree + wp.where(near_count > 0, 1, 0)]
    for s in range(capsules.tree_start[tree], last):
        if is_collidable(capsules.level[s], trees.is_fine[tree], capsules.bunch[s], trees.bunch_attached):
            low = capsule_states.low[s]
            high = capsule_states.high[s]
            for k in range(near_count):
                g = candidates_out.near_geoms[row, k]
                if not aabbs_disjoint(low, high, geom_states.low[g], geom_states.high[g]) and not is_passing(
                    tree, passing_out.of_geom[g], passing_out.by_tree
                ):
                    candidates_out.near_pairs[row * room + pair_count] = wp.vec2i(s, g)
                    pair_count = pair_count + 1
                    if pair_count == room:
                        count, hits = add_pairs(
                            False,
                            row,
                            count,
                            candidates_out.near_pairs,
                            row * room,
                            1,
                            pair_count,
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
                        is_impact = is_impact or hits
                        pair_count = int(0)
    if pair_count > 0:
        count, hits = add_pairs(
            False,
            row,
            count,
            candidates_out.near_pairs,
            row * room,
            1,
            pair_count,
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
        is_impact = is_impact or hits
    candidates_out.is_impact[row] = is_impact
    candidates_out.count[row] = count
    clear_slots(row, count, candidates_out)


@wp.kernel
def find_rigid_contacts(
    # model
    threads: int,
    parameters: Parameters,
    max_static_geoms: int,
    capsules: Capsules,
    geoms: Geoms,
    # in
    counters: wp.array(dtype=wp.int32),
    trees: Trees,
    tree_boxes: Aabbs,
    bodies: PlantBodies,
    capsule_states: CapsuleStates,
    rigid: RigidBodies,
    hulls: Hulls,
    geom_states: GeomStates,
    static_blocks: Aabbs,
    # out
    passing_out: PassingBunches,
    candidates_out: Candidates,
):
    """Find the contacts of each awake tree with rigid geoms, in the order of (capsule, geom, end).

    Thread i takes the rows i, i + threads, i + 2 threads ...
    """
    for row in range(wp.tid(), counters[AWAKE_TREES], threads):
        find_contacts_of_tree(
            row,
            parameters,
            max_static_geoms,
            capsules,
            geoms,
            trees,
            tree_boxes,
            bodies,
            capsule_states,
            rigid,
            hulls,
            geom_states,
            static_blocks,
            passing_out,
            candidates_out,
        )
