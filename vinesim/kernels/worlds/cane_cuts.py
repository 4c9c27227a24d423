"""Cuts of canes in a batch of worlds: what is beyond a cut becomes a floating component of its tree.

The laws are those of :class:`vinesim.plants.articulation_solver.Stumps` and :mod:`vinesim.plants.segment_parts`, for
canes without leaves and ties. The changes of a tree's arrays are made on the device.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import to_double, to_single
from vinesim.kernels.contact.structs import Capsules, Contacts, Geoms
from vinesim.kernels.plants import energy_budget
from vinesim.kernels.plants.structs import ArticulationModel, BodyState, JointState
from vinesim.kernels.worlds.cutting import NONE, Canes, Cuts
from vinesim.kernels.worlds.free_bunches import PlantMasses
from vinesim.kernels.worlds.narrowphase import WorldContacts
from vinesim.kernels.worlds.reset import STUMPS

wp.set_module_options({"enable_backward": False})

NO_BUDGET = wp.constant(energy_budget.NO_BUDGET)


@wp.struct
class CaneNumbers:
    """Numbers of the cuts of canes."""

    worlds: int
    trees: int
    cuts: int
    """Largest number of cuts and breaks of a tree."""
    spares: int
    """Number of spare bodies of a tree."""
    shortest: wp.float64
    """[m] Least distance of a cut from the ends of a part."""
    place_step: wp.float64
    """[m] Places of cuts are multiples of this."""
    clamped: wp.float64
    """[1] Compliance of the joint of a stump at a clamp, relative to that of half of it."""


@wp.struct
class WholeWood:
    """Segments of canes as the model has them [body]."""

    rod: wp.array(dtype=wp.float64)
    """kg, mass of the uniform rod in it."""
    end_mass: wp.array(dtype=wp.float64)
    """kg, weight at one end."""
    end: wp.array(dtype=wp.float64)
    """m, place of this weight."""
    rest: wp.array(dtype=wp.float64)
    """kg m^2, second moment along the segment that both do not explain."""
    second: wp.array(dtype=wp.vec2d)
    """kg m^2, second moments across the segment, along y and z."""
    com: wp.array(dtype=wp.vec3)
    """m, centre of mass."""
    drag: wp.array(dtype=float)
    """m^2, drag area."""
    growth: wp.array(dtype=float)
    """m, place of the first body that grows on it."""
    share: wp.array(dtype=wp.float64)
    """Share of the segment in the compliance of its joint; -1: the joint is at a clamp."""
    settled: wp.array(dtype=wp.vec3d)
    """rad, settled rotation of its joint."""
    offset: wp.array(dtype=wp.vec3)
    """m, place of its joint in the parent's frame."""
    rest_turn: wp.array(dtype=wp.quat)
    """Rest rotation of its joint."""
    stiffness: wp.array(dtype=wp.vec3)
    """N m/rad, of its joint."""
    damping: wp.array(dtype=wp.vec3)
    """N m s/rad, of its joint."""
    capsule: wp.array(dtype=wp.int32)
    """Collision capsule of the body; -1: none."""
    spare: wp.array(dtype=wp.int32)
    """[tree] First spare body."""


@wp.struct
class Topology:
    """What a cut changes in the arrays of trees that other cuts do not know."""

    moving: wp.array(dtype=wp.int32)
    """[tree] Number of bodies that move."""
    budget: wp.array(dtype=wp.int32)
    """[tree] How its energy is watched; a tree with a floating root has no energy budget."""
    roots: wp.array(dtype=wp.int32)
    """[tree * cuts + i] Floating roots; -1: none."""
    branches: wp.array(dtype=wp.bool)
    """[body] Whether a body has a child other than the next body."""
    is_cut: wp.array(dtype=wp.bool)
    """[body] Whether a body was cut off."""
    grown: wp.array(dtype=wp.quat)
    """[body] Rest rotation of each joint without its set."""
    kept: wp.array(dtype=wp.quat)
    """[body] Set of each joint, see :attr:`vinesim.scene.state.State.joint_set`."""


@wp.func
def shape_part(
    body: int, segment: int, start: wp.float64, end: wp.float64, canes: Canes, wood: WholeWood, masses_out: PlantMasses
):
    """Make a body the part of a segment from ``start`` to ``end`` [m]; see
    :func:`vinesim.plants.segment_parts.part_of`."""
    length = wp.float64(canes.length[segment])
    share = (end - start) / length
    half = wp.float64(0.5)
    middle = half * (start + end)
    rod = share * wood.rod[segment]
    tip = wood.end[segment]
    point = wp.float64(0.0)
    if (start <= tip and tip < end) or (end >= length and tip == length):
        point = wood.end_mass[segment]
    total = rod + point
    center = (rod * middle + point * tip) / total
    own = end - start
    along = rod * (own * own / wp.float64(12.0) + (middle - center) * (middle - center))
    along = along + point * (tip - center) * (tip - center) + share * wood.rest[segment]
    beside = share * wood.second[segment]
    com = wood.com[segment]
    masses_out.body_mass[body] = wp.float32(total)
    masses_out.body_com[body] = wp.vec3(wp.float32(center), com[1], com[2])
    masses_out.body_inertia[body] = to_single(wp.vec3d(beside[0] + beside[1], along + beside[1], along + beside[0]))
    masses_out.body_product[body] = wp.vec3()
    masses_out.body_drag[body] = wp.float32(share) * wood.drag[segment]


@wp.func
def double_quat(q: wp.quat):
    """Returns a rotation in double precision, with length 1."""
    return wp.normalize(wp.quatd(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3])))


@wp.func
def single_quat(q: wp.quatd):
    """Returns a rotation in single precision."""
    return wp.quat(wp.float32(q[0]), wp.float32(q[1]), wp.float32(q[2]), wp.float32(q[3]))


@wp.func
def turn_by(rotation: wp.vec3d):
    """Returns the rotation by a rotation vector [rad]."""
    angle = wp.length(rotation)
    turn = wp.quat_identity(dtype=wp.float64)
    if angle > wp.float64(0.0):
        turn = wp.quat_from_axis_angle(rotation / angle, angle)
    return turn


@wp.func
def turn_rest(
    body: int,
    grown: wp.quatd,
    kept: wp.quatd,
    topology_out: Topology,
    model_out: ArticulationModel,
    joints_out: JointState,
):
    """Give a joint a rest rotation without its set, and a set; its pose and motion do not change."""
    before = double_quat(model_out.body_rest[body])
    rest = wp.normalize(grown * kept)
    turn = wp.quat_inverse(rest) * before
    topology_out.grown[body] = single_quat(grown)
    topology_out.kept[body] = single_quat(kept)
    model_out.body_rest[body] = single_quat(rest)
    joints_out.joint_q[body] = single_quat(wp.normalize(turn * double_quat(joints_out.joint_q[body])))
    joints_out.joint_qd[body] = to_single(wp.quat_rotate(turn, to_double(joints_out.joint_qd[body])))


@wp.func
def adjust_joint(
    body: int,
    clamped: wp.float64,
    canes: Canes,
    wood: WholeWood,
    topology_out: Topology,
    model_out: ArticulationModel,
    joints_out: JointState,
):
    """Give the joint of the first part of a segment the spring of the wood that meets there; its pose does not change.
    See :func:`vinesim.plants.segment_parts.joint_compliance` and :func:`~vinesim.plants.segment_parts.relaxed_joint`.
    """
    one = wp.float64(1.0)
    segment = canes.segment[body]
    own = wp.float64(canes.end[body]) / wp.float64(canes.length[segment])
    share = wood.share[segment]
    compliance = one
    if share >= wp.float64(0.0):
        parent = model_out.body_parent[body]
        above = one - wp.float64(canes.start[parent]) / wp.float64(canes.length[parent])
        compliance = share * own + (one - share) * above
    elif own < one:
        compliance = clamped * own
    model_out.joint_stiffness[body] = wood.stiffness[segment] / wp.float32(compliance)
    model_out.joint_damping[body] = wood.damping[segment] / wp.float32(compliance)
    relaxed = turn_by((one - compliance) * wood.settled[segment])
    grown = wp.normalize(double_quat(wood.rest_turn[segment]) * relaxed)
    turn_rest(body, grown, double_quat(topology_out.kept[body]), topology_out, model_out, joints_out)


@wp.func
def cut_off(body: int, bodies: BodyState, topology_out: Topology, model_out: ArticulationModel, joints_out: JointState):
    """Make a body a floating root in its present pose."""
    if not topology_out.is_cut[body]:
        pose = bodies.body_q[body]
        motion = bodies.body_qd[body]
        joints_out.joint_x[body] = wp.transform_get_translation(pose)
        joints_out.joint_q[body] = wp.transform_get_rotation(pose)
        joints_out.joint_xd[body] = wp.spatial_top(motion)
        joints_out.joint_qd[body] = wp.spatial_bottom(motion)
        topology_out.is_cut[body] = True
        topology_out.kept[body] = wp.quat_identity()
        model_out.body_parent[body] = -1
        model_out.body_offset[body] = wp.vec3()
        model_out.body_rest[body] = wp.quat_identity()
        model_out.joint_stiffness[body] = wp.vec3()
        model_out.joint_damping[body] = wp.vec3()


@wp.func
def leave_stump(
    spare: int,
    old: int,
    at: wp.float64,
    numbers: CaneNumbers,
    wood: WholeWood,
    canes_out: Canes,
    bodies_out: BodyState,
    masses_out: PlantMasses,
    capsules_out: Capsules,
    topology_out: Topology,
    model_out: ArticulationModel,
    joints_out: JointState,
):
    """Make a spare body the wood of the body ``old`` before a cut ``at`` [m], and leave the wood beyond it to ``old``."""
    segment = canes_out.segment[old]
    start = canes_out.start[old]
    end = canes_out.end[old]
    place = wp.float32(at)
    bodies_out.body_q[spare] = bodies_out.body_q[old]
    bodies_out.body_qd[spare] = bodies_out.body_qd[old]
    if topology_out.is_cut[old]:
        cut_off(spare, bodies_out, topology_out, model_out, joints_out)
    else:
        parent = model_out.body_parent[old]
        joints_out.joint_q[spare] = joints_out.joint_q[old]
        joints_out.joint_qd[spare] = joints_out.joint_qd[old]
        model_out.body_parent[spare] = parent
        model_out.body_offset[spare] = wood.offset[segment]
        model_out.body_rest[spare] = model_out.body_rest[old]
        topology_out.grown[spare] = topology_out.grown[old]
        topology_out.kept[spare] = topology_out.kept[old]
        if parent >= 0:
            topology_out.branches[parent] = True
    canes_out.segment[spare] = segment
    canes_out.start[spare] = start
    canes_out.end[spare] = place
    canes_out.start[old] = place
    shape_part(spare, segment, wp.float64(start), at, canes_out, wood, masses_out)
    shape_part(old, segment, at, wp.float64(end), canes_out, wood, masses_out)
    capsule = wood.capsule[old]
    own = wood.capsule[spare]
    radius = capsules_out.radius[capsule]
    capsules_out.body[own] = spare
    capsules_out.radius[own] = radius
    capsules_out.material[own] = capsules_out.material[capsule]
    share = (place - start) / (end - start)
    middle = wp.lerp(capsules_out.rest_start[capsule], capsules_out.rest_end[capsule], share)
    capsules_out.rest_start[own] = capsules_out.rest_start[capsule]
    capsules_out.rest_end[own] = middle
    capsules_out.rest_start[capsule] = middle
    capsules_out.local_start[own] = wp.vec3(start, 0.0, 0.0)
    capsules_out.local_end[own] = wp.vec3(place, 0.0, 0.0)
    capsules_out.extent[own] = place + radius
    capsules_out.local_start[capsule] = wp.vec3(place, 0.0, 0.0)
    tree = model_out.body_tree[spare]
    used = (spare - model_out.tree_first[tree]) / model_out.pitch + 1
    topology_out.moving[tree] = wp.max(topology_out.moving[tree], used)
    if not topology_out.is_cut[spare]:
        adjust_joint(spare, numbers.clamped, canes_out, wood, topology_out, model_out, joints_out)
    if old == segment:
        first = model_out.tree_first[tree]
        for k in range(first, first + topology_out.moving[tree] * model_out.pitch, model_out.pitch):
            if model_out.body_parent[k] == old:
                adjust_joint(k, numbers.clamped, canes_out, wood, topology_out, model_out, joints_out)


@wp.func
def find_roots(tree: int, topology: Topology, model_out: ArticulationModel):
    """Write to which floating component each body of a tree belongs. No tie holds it."""
    first = model_out.tree_first[tree]
    for k in range(first, first + topology.moving[tree] * model_out.pitch, model_out.pitch):
        parent = model_out.body_parent[k]
        root = int(-1)
        if parent >= 0:
            root = model_out.body_root[parent]
        elif topology.is_cut[k]:
            root = k
        model_out.body_root[k] = root
        model_out.body_falls[k] = root >= 0


@wp.func
def free_spare(tree: int, wood: WholeWood, canes: Canes, numbers: CaneNumbers, pitch: int):
    """Returns the first spare body of a tree that is no stump; -1: none."""
    found = int(NONE)
    for i in range(numbers.spares):
        spare = wood.spare[tree] + i * pitch
        if found < 0 and canes.segment[spare] < 0:
            found = spare
    return found


@wp.func
def free_place(tree: int, cuts: int, topology: Topology):
    """Returns the first free place of a tree in the list of floating roots; -1: none."""
    found = int(NONE)
    for i in range(cuts):
        if found < 0 and topology.roots[tree * cuts + i] < 0:
            found = tree * cuts + i
    return found


@wp.func
def report_fault(world: int, faults_out: wp.array(dtype=wp.int32), fault_count_out: wp.array(dtype=wp.int32)):
    """Give a world the fault :data:`~vinesim.kernels.worlds.reset.STUMPS`."""
    before = faults_out[world]
    faults_out[world] = before | STUMPS
    if before == 0:
        fault_count_out[world] = fault_count_out[world] + 1


@wp.kernel
def cut_canes(
    # model
    numbers: CaneNumbers,
    wood: WholeWood,
    # in
    cuts: Cuts,
    # out
    canes_out: Canes,
    faults_out: wp.array(dtype=wp.int32),
    fault_count_out: wp.array(dtype=wp.int32),
    masses_out: PlantMasses,
    capsules_out: Capsules,
    topology_out: Topology,
    model_out: ArticulationModel,
    bodies_out: BodyState,
    joints_out: JointState,
):
    """One thread per world. Cut the canes that its blade cuts. A tree that has been cut as often as it can be stays as
    it is; the world then has the fault :data:`~vinesim.kernels.worlds.reset.STUMPS`.

    faults, fault_count: [world], see :func:`vinesim.kernels.worlds.reset.find_faults`.
    """
    world = wp.tid()
    for tree in range(world, numbers.trees, numbers.worlds):
        old = cuts.cane[tree]
        if old >= 0:
            place = free_place(tree, numbers.cuts, topology_out)
            spare = free_spare(tree, wood, canes_out, numbers, model_out.pitch)
            at = cuts.cane_at[tree]
            splits = wood.growth[canes_out.segment[old]] >= wp.float32(at)
            if place < 0 or spare < 0:
                report_fault(world, faults_out, fault_count_out)
            elif splits or not topology_out.is_cut[old]:
                root = int(old)
                if splits:
                    begin = wp.float64(canes_out.start[old]) + numbers.shortest
                    end = wp.float64(canes_out.end[old]) - numbers.shortest
                    least = wp.ceil(begin / numbers.place_step - wp.float64(1.0e-6))
                    most = wp.floor(end / numbers.place_step + wp.float64(1.0e-6))
                    at = wp.clamp(wp.rint(at / numbers.place_step), least, most) * numbers.place_step
                    if topology_out.is_cut[old]:
                        root = spare
                    leave_stump(
                        spare,
                        old,
                        at,
                        numbers,
                        wood,
                        canes_out,
                        bodies_out,
                        masses_out,
                        capsules_out,
                        topology_out,
                        model_out,
                        joints_out,
                    )
                cut_off(old, bodies_out, topology_out, model_out, joints_out)
                find_roots(tree, topology_out, model_out)
                topology_out.roots[place] = root
                topology_out.budget[tree] = NO_BUDGET


@wp.kernel
def part_canes(
    # model
    numbers: CaneNumbers,
    # in
    breaks: wp.array(dtype=wp.bool),
    # out
    faults_out: wp.array(dtype=wp.int32),
    fault_count_out: wp.array(dtype=wp.int32),
    topology_out: Topology,
    model_out: ArticulationModel,
    bodies_out: BodyState,
    joints_out: JointState,
):
    """One thread per world. Part canes at the joints that ``breaks`` [body] lists. Faults as in :func:`cut_canes`."""
    world = wp.tid()
    for tree in range(world, numbers.trees, numbers.worlds):
        first = model_out.tree_first[tree]
        for k in range(first, first + topology_out.moving[tree] * model_out.pitch, model_out.pitch):
            if breaks[k] and not topology_out.is_cut[k]:
                place = free_place(tree, numbers.cuts, topology_out)
                if place < 0:
                    report_fault(world, faults_out, fault_count_out)
                else:
                    cut_off(k, bodies_out, topology_out, model_out, joints_out)
                    find_roots(tree, topology_out, model_out)
                    topology_out.roots[place] = k
                    topology_out.budget[tree] = NO_BUDGET


@wp.kernel
def slow_lying_parts(
    # model
    share: float,
    cuts: int,
    worlds: int,
    geoms: Geoms,
    # in
    body_root: wp.array(dtype=wp.int32),
    topology: Topology,
    contacts: Contacts,
    world_contacts: WorldContacts,
    # out
    joint_qd_out: wp.array(dtype=wp.vec3),
):
    """One thread per tree, after an integration. Multiply the angular velocity of each cut-off part that pressed on
    something static in the step by ``share``, as :meth:`ArticulationSolver.slow_turning` does."""
    tree = wp.tid()
    world = tree % worlds
    first = world_contacts.first[tree]
    for i in range(cuts):
        root = topology.roots[tree * cuts + i]
        lies = bool(False)
        for c in range(first, first + world_contacts.of_tree[tree]):
            at = c * worlds + world
            presses = contacts.other[at] >= geoms.count[0] and wp.length_sq(contacts.force[at]) > wp.float64(0.0)
            lies = lies or (presses and body_root[contacts.body[at]] == root)
        if root >= 0 and lies:
            joint_qd_out[root] = share * joint_qd_out[root]
