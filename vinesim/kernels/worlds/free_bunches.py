"""Bunches that leave their vines in a batch of worlds: bodies of a pool in mujoco_warp take them over.

A bunch is a rigid body with its stalk, as in :mod:`vinesim.interaction.stalk` and :mod:`vinesim.rigid.free_bunch`. Mass,
centre, inertia, momentum and shapes are computed on the device, in double precision.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import to_double, to_single
from vinesim.kernels.contact.narrowphase_rigid import FAR, segment_geom_distance
from vinesim.kernels.contact.structs import Capsules, Geoms, GeomStates, Hulls, PlantBodies, RigidBodies
from vinesim.kernels.plants.energy_budget import NO_LIMIT
from vinesim.kernels.worlds.cutting import NONE, WHOLE, Cuts, Wood
from vinesim.kernels.worlds.narrowphase import FreeBunches
from vinesim.kernels.worlds.reset import BUNCHES

wp.set_module_options({"enable_backward": False})

NEVER = wp.constant(-1.0)
"""[m] Margin of shapes that touch nothing."""


@wp.struct
class PoolNumbers:
    """The bodies of the pool, and the numbers of free bunches."""

    worlds: int
    trees: int
    spheres: int
    """Number of spheres of a body of the pool: its first geoms."""
    pieces: int
    """Number of capsules for pieces of a stalk: its last geoms."""
    dofs: int
    """Degrees of freedom of a world."""
    stub_mass: float
    """[kg] Mass of the stub of the peduncle that stays on the vine in place of a bunch."""
    ghost_share: float
    """Share of its mass that a segment of stalk keeps on the vine."""
    shortest: wp.float64
    """[m] Least distance of a cut from the ends of a segment."""
    place_step: wp.float64
    """[m] Places of cuts are multiples of this."""
    rolling_arm: wp.float64
    """[m] Lever arm of the rolling resistance of the thickest shape."""
    spare: wp.float64
    """[m] Size of shapes that a bunch has not; they are inside its first sphere."""


@wp.struct
class Pool:
    """Where the bodies of the pool are [slot]."""

    body: wp.array(dtype=wp.int32)
    """MuJoCo body."""
    q: wp.array(dtype=wp.int32)
    """First index in MuJoCo's qpos."""
    v: wp.array(dtype=wp.int32)
    """First degree of freedom."""
    geom: wp.array(dtype=wp.int32)
    """First MuJoCo geom."""
    moving_geom: wp.array(dtype=wp.int32)
    """The same geom's number among the geoms of a world that can move."""
    parking: wp.array(dtype=wp.transform)
    """[m] Pose of the unused body."""


@wp.struct
class WarpModel:
    """Arrays of mujoco_warp's model under their names there, with a row for each world."""

    body_mass: wp.array2d(dtype=float)
    body_subtreemass: wp.array2d(dtype=float)
    body_ipos: wp.array2d(dtype=wp.vec3)
    body_iquat: wp.array2d(dtype=wp.quat)
    body_inertia: wp.array2d(dtype=wp.vec3)
    body_invweight0: wp.array2d(dtype=wp.vec2)
    geom_size: wp.array2d(dtype=wp.vec3)
    geom_pos: wp.array2d(dtype=wp.vec3)
    geom_quat: wp.array2d(dtype=wp.quat)
    geom_rbound: wp.array2d(dtype=float)
    geom_aabb: wp.array3d(dtype=wp.vec3)
    geom_friction: wp.array2d(dtype=wp.vec3)
    geom_margin: wp.array2d(dtype=float)


@wp.struct
class PlantMasses:
    """Masses of the plants' bodies [body]."""

    body_mass: wp.array(dtype=float)
    body_com: wp.array(dtype=wp.vec3)
    body_inertia: wp.array(dtype=wp.vec3)
    body_product: wp.array(dtype=wp.vec3)
    body_drag: wp.array(dtype=float)


@wp.struct
class Sums:
    """Mass [kg], first moment [kg m], momentum [kg m/s], angular momentum [kg m^2/s] and inertia [kg m^2] of some bodies
    about one point, world axes."""

    mass: wp.float64
    moment: wp.vec3d
    linear: wp.vec3d
    angular: wp.vec3d
    inertia: wp.mat33d


@wp.func
def rotation_of(pose: wp.transform):
    """Returns the rotation of a pose in double precision, with length 1."""
    q = wp.transform_get_rotation(pose)
    return wp.normalize(wp.quatd(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3])))


@wp.func
def wxyz(q: wp.quatd):
    """Returns a rotation in MuJoCo's order, in single precision."""
    return wp.quat(wp.float32(q[3]), wp.float32(q[0]), wp.float32(q[1]), wp.float32(q[2]))


@wp.func
def turn_from_z(axis: wp.vec3d):
    """Returns a rotation from the z axis to a unit vector."""
    zero = wp.float64(0.0)
    turn = wp.quatd(wp.float64(1.0), zero, zero, zero)  # half a turn about x
    if axis[2] > wp.float64(-0.999999):
        turn = wp.normalize(wp.quatd(-axis[1], axis[0], zero, wp.float64(1.0) + axis[2]))
    return turn


@wp.func
def add_part(
    sums: Sums,
    pose: wp.transform,
    motion: wp.spatial_vector,
    origin: wp.vec3d,
    mass: wp.float64,
    com: wp.vec3d,
    inertia: wp.vec3d,
    product: wp.vec3d,
):
    """Returns the sums with a part of a body with this pose and motion: mass, centre [m] in the body's frame, inertia xx,
    yy, zz and yz, zx, xy about the centre. The sums are about ``origin`` [m]."""
    axes = wp.quat_to_matrix(rotation_of(pose))
    arm = axes * com
    spin = to_double(wp.spatial_bottom(motion))
    velocity = to_double(wp.spatial_top(motion)) + wp.cross(spin, arm)
    own = wp.mat33d(
        inertia[0], product[2], product[1], product[2], inertia[1], product[0], product[1], product[0], inertia[2]
    )
    tensor = axes * own * wp.transpose(axes)
    r = to_double(wp.transform_get_translation(pose)) - origin + arm
    steiner = mass * (wp.dot(r, r) * wp.identity(n=3, dtype=wp.float64) - wp.outer(r, r))
    return Sums(
        sums.mass + mass,
        sums.moment + mass * r,
        sums.linear + mass * velocity,
        sums.angular + tensor * spin + mass * wp.cross(r, velocity),
        sums.inertia + tensor + steiner,
    )


@wp.func
def rod_part(
    start: wp.float64, end: wp.float64, length: wp.float64, mass: wp.float64, com: wp.vec3d, inertia: wp.vec3d
):
    """Returns mass, centre and moments of inertia of the part of a uniform rod between ``start`` and ``end`` [m]; see
    :func:`vinesim.interaction.stalk.split`."""
    twelfth = wp.float64(1.0) / wp.float64(12.0)
    across = wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(1.0))
    along = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    own = end - start
    share = own / length
    moments = share * (inertia - mass * length * length * twelfth * across)
    moments = moments + share * mass * own * own * twelfth * across
    place = com + wp.float64(0.5) * (start + end - length) * along
    return share * mass, place, moments


@wp.func
def write_geom(
    world: int,
    g: int,
    row: int,
    start: wp.vec3d,
    end: wp.vec3d,
    radius: wp.float64,
    widest: wp.float64,
    numbers: PoolNumbers,
    model_out: WarpModel,
    geoms_out: Geoms,
):
    """Give MuJoCo geom ``g`` of a world the shape of a sphere or capsule with these ends of its axis [m] in the bunch's
    frame. ``row``: the geom's row in ``geoms``. ``widest`` [m]: radius of the bunch's thickest shape."""
    axis = end - start
    half = wp.float64(0.5) * wp.length(axis)
    turn = wp.quat_identity(dtype=wp.float64)
    if half > wp.float64(0.0):
        turn = turn_from_z(wp.normalize(axis))
    reach = wp.float32(radius + half)
    thin = wp.float32(radius)
    friction = model_out.geom_friction[world, g]
    friction[2] = wp.float32(numbers.rolling_arm * radius / widest)
    model_out.geom_friction[world, g] = friction
    model_out.geom_margin[world, g] = 0.0
    model_out.geom_size[world, g] = wp.vec3(thin, wp.float32(half), 0.0)
    model_out.geom_pos[world, g] = to_single(wp.float64(0.5) * (start + end))
    model_out.geom_quat[world, g] = wxyz(turn)
    model_out.geom_rbound[world, g] = reach
    model_out.geom_aabb[world, g, 0] = wp.vec3()
    model_out.geom_aabb[world, g, 1] = wp.vec3(thin, thin, reach)
    geoms_out.size[row] = wp.vec3d(radius, half, wp.float64(0.0))
    geoms_out.half[row] = wp.vec3d(radius, radius, radius + half)
    geoms_out.radius[row] = radius + half


@wp.func
def write_spare_geom(
    world: int, g: int, row: int, place: wp.vec3d, numbers: PoolNumbers, model_out: WarpModel, geoms_out: Geoms
):
    """Let MuJoCo geom ``g`` of a world touch nothing: a small shape inside a bunch, with a margin below which no two
    geoms overlap."""
    end = place + wp.vec3d(numbers.spare, wp.float64(0.0), wp.float64(0.0))
    write_geom(world, g, row, place, end, numbers.spare, numbers.spare, numbers, model_out, geoms_out)
    model_out.geom_margin[world, g] = NEVER


@wp.func
def write_inertia(world: int, body: int, mass: wp.float64, com: wp.vec3d, tensor: wp.mat33d, model_out: WarpModel):
    """Give a MuJoCo body of a world its mass, centre of mass and inertia about it, in the body's frame, and what MuJoCo
    derives from them."""
    axes, moments = wp.eig3(wp.float64(0.5) * (tensor + wp.transpose(tensor)))
    if wp.determinant(axes) < wp.float64(0.0):
        axes = -axes
    one = wp.float64(1.0)
    turning = (one / moments[0] + one / moments[1] + one / moments[2]) / wp.float64(3.0)
    model_out.body_mass[world, body] = wp.float32(mass)
    model_out.body_subtreemass[world, body] = wp.float32(mass)
    model_out.body_ipos[world, body] = to_single(com)
    model_out.body_iquat[world, body] = wxyz(wp.quat_from_matrix(axes))
    model_out.body_inertia[world, body] = to_single(moments)
    model_out.body_invweight0[world, body] = wp.vec2(wp.float32(one / mass), wp.float32(turning))


@wp.func
def leave_stub(k: int, share: float, masses_out: PlantMasses):
    """Leave a share of the mass of a plant's body on the vine."""
    masses_out.body_mass[k] = share * masses_out.body_mass[k]
    masses_out.body_inertia[k] = share * masses_out.body_inertia[k]
    masses_out.body_product[k] = share * masses_out.body_product[k]


@wp.func
def is_below(k: int, segment: int, body: int, body_parent: wp.array(dtype=wp.int32)):
    """Returns whether body ``k`` is beyond ``segment`` on the way to the bunch's ``body``, or is that body."""
    found = bool(False)
    at = int(body)
    while at != segment:
        found = found or at == k
        at = body_parent[at]
    return found


@wp.func
def write_spheres(
    world: int,
    slot: int,
    tree: int,
    body: int,
    numbers: PoolNumbers,
    pool: Pool,
    capsules: Capsules,
    model_out: WarpModel,
    geoms_out: Geoms,
):
    """Give a body of the pool the spheres of a bunch. Returns the centre [m] of the first one, and the radius [m] of the
    thickest one."""
    first = pool.geom[slot]
    row = pool.moving_geom[slot]
    widest = wp.float64(0.0)
    for s in range(tree, capsules.body.shape[0], numbers.trees):
        if capsules.body[s] == body:
            widest = wp.max(widest, wp.float64(capsules.radius[s]))
    count = int(0)
    middle = wp.vec3d()
    for s in range(tree, capsules.body.shape[0], numbers.trees):
        if capsules.body[s] == body:
            start = to_double(capsules.local_start[s])
            end = to_double(capsules.local_end[s])
            if count == 0:
                middle = start
            g = first + count
            geom_row = (row + count) * numbers.worlds + world
            radius = wp.float64(capsules.radius[s])
            write_geom(world, g, geom_row, start, end, radius, widest, numbers, model_out, geoms_out)
            count = count + 1
    while count < numbers.spheres:
        g = first + count
        geom_row = (row + count) * numbers.worlds + world
        write_spare_geom(world, g, geom_row, middle, numbers, model_out, geoms_out)
        count = count + 1
    return middle, widest


@wp.func
def leave_capsules(
    tree: int,
    bunch: int,
    segment: int,
    at: float,
    body: int,
    trees: int,
    body_parent: wp.array(dtype=wp.int32),
    capsules_out: Capsules,
):
    """Remove the capsules of a bunch and its stalk from a tree, and shorten that of the stump to ``at`` [m].
    ``segment``: :data:`WHOLE` for a bunch without stalk."""
    for s in range(tree, capsules_out.body.shape[0], trees):
        owner = capsules_out.body[s]
        if owner >= 0 and capsules_out.bunch[s] == bunch:
            if segment == WHOLE:
                capsules_out.body[s] = NONE
            elif owner == segment:
                share = at / capsules_out.local_end[s][0]
                capsules_out.local_end[s] = share * capsules_out.local_end[s]
                capsules_out.extent[s] = at + capsules_out.radius[s]
            elif is_below(owner, segment, body, body_parent):
                capsules_out.body[s] = NONE


@wp.func
def place_body(
    world: int,
    slot: int,
    frame: wp.transform,
    sums: Sums,
    dofs: int,
    pool: Pool,
    model_out: WarpModel,
    qpos_out: wp.array2d(dtype=float),
    qvel_out: wp.array2d(dtype=float),
    rigid_out: RigidBodies,
):
    """Give a body of the pool the pose ``frame``, and the mass, inertia and momentum of all parts of the bunch; the sums
    are about the frame's origin."""
    zero = wp.float64(0.0)
    turn = rotation_of(frame)
    back = wp.quat_inverse(turn)
    com = sums.moment / sums.mass
    steiner = sums.mass * (wp.dot(com, com) * wp.identity(n=3, dtype=wp.float64) - wp.outer(com, com))
    tensor = sums.inertia - steiner
    spin = wp.inverse(tensor) * (sums.angular - wp.cross(com, sums.linear))
    velocity = sums.linear / sums.mass - wp.cross(spin, com)
    axes = wp.quat_to_matrix(turn)
    own = wp.transpose(axes) * tensor * axes
    write_inertia(world, pool.body[slot], sums.mass, wp.quat_rotate(back, com), own, model_out)
    q = pool.q[slot]
    v = pool.v[slot]
    place = wp.transform_get_translation(frame)
    rotation = wxyz(turn)
    turning = wp.quat_rotate(back, spin)
    first = world * dofs + v
    for i in range(3):
        qpos_out[world, q + i] = place[i]
        qvel_out[world, v + i] = wp.float32(velocity[i])
        qvel_out[world, v + 3 + i] = wp.float32(turning[i])
        rigid_out.velocity_free[first + i] = velocity[i]
        rigid_out.velocity_free[first + 3 + i] = turning[i]
    for i in range(4):
        qpos_out[world, q + 3 + i] = rotation[i]
    for i in range(6):
        rigid_out.correction[first + i] = zero
        rigid_out.correction_before[first + i] = zero


@wp.func
def detach_bunch(
    world: int,
    slot: int,
    bunch: int,
    tree: int,
    segment: int,
    at: wp.float64,
    numbers: PoolNumbers,
    pool: Pool,
    wood: Wood,
    body_parent: wp.array(dtype=wp.int32),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
    masses_out: PlantMasses,
    capsules_out: Capsules,
    model_out: WarpModel,
    qpos_out: wp.array2d(dtype=float),
    qvel_out: wp.array2d(dtype=float),
    geoms_out: Geoms,
    rigid_out: RigidBodies,
):
    """Move a bunch from its vine to a body of the pool, with the stalk beyond a cut ``at`` [m] along ``segment``; without
    stalk if this is :data:`WHOLE`."""
    zero = wp.float64(0.0)
    body = wood.bunch_body[bunch]
    frame = body_q[body]
    origin = to_double(wp.transform_get_translation(frame))
    back = wp.quat_inverse(rotation_of(frame))
    sums = add_part(
        Sums(),
        frame,
        body_qd[body],
        origin,
        wp.float64(masses_out.body_mass[body]),
        to_double(masses_out.body_com[body]),
        to_double(masses_out.body_inertia[body]),
        to_double(masses_out.body_product[body]),
    )
    middle, widest = write_spheres(world, slot, tree, body, numbers, pool, capsules_out, model_out, geoms_out)
    # the pieces of its stalk, and what stays on the vine
    first = pool.geom[slot] + numbers.spheres
    row = pool.moving_geom[slot] + numbers.spheres
    pieces = int(0)
    k = body_parent[body]
    if segment == WHOLE:
        k = NONE
    while pieces < numbers.pieces:
        g = first + pieces
        geom_row = (row + pieces) * numbers.worlds + world
        if k < 0:
            write_spare_geom(world, g, geom_row, middle, numbers, model_out, geoms_out)
        else:
            length = wp.float64(wood.length[k])
            mass = wp.float64(masses_out.body_mass[k])
            com = to_double(masses_out.body_com[k])
            inertia = to_double(masses_out.body_inertia[k])
            begin = wp.where(k == segment, at, zero)
            part_mass, part_com, part_inertia = rod_part(begin, length, length, mass, com, inertia)
            pose = body_q[k]
            sums = add_part(sums, pose, body_qd[k], origin, part_mass, part_com, part_inertia, wp.vec3d())
            place = to_double(wp.transform_get_translation(pose)) - origin
            along = wp.quat_rotate(rotation_of(pose), wp.vec3d(wp.float64(1.0), zero, zero))
            start = wp.quat_rotate(back, place + begin * along)
            end = wp.quat_rotate(back, place + length * along)
            thick = wood.radius[k]
            radius = wp.float64(0.5 * (thick[0] + thick[1]))
            write_geom(world, g, geom_row, start, end, radius, widest, numbers, model_out, geoms_out)
            if k == segment:
                stump_mass, stump_com, stump_inertia = rod_part(zero, at, length, mass, com, inertia)
                masses_out.body_mass[k] = wp.float32(stump_mass)
                masses_out.body_com[k] = to_single(stump_com)
                masses_out.body_inertia[k] = to_single(stump_inertia)
                k = NONE
            else:
                leave_stub(k, numbers.ghost_share, masses_out)
                k = body_parent[k]
        pieces = pieces + 1
    leave_stub(body, numbers.stub_mass / masses_out.body_mass[body], masses_out)
    masses_out.body_drag[body] = 0.0
    leave_capsules(tree, bunch, segment, wp.float32(at), body, numbers.trees, body_parent, capsules_out)
    place_body(world, slot, frame, sums, numbers.dofs, pool, model_out, qpos_out, qvel_out, rigid_out)


@wp.kernel
def detach_bunches(
    # model
    numbers: PoolNumbers,
    pool: Pool,
    wood: Wood,
    body_parent: wp.array(dtype=wp.int32),
    # in
    cuts: Cuts,
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
    # out
    is_free_out: wp.array(dtype=wp.int32),
    free_out: FreeBunches,
    faults_out: wp.array(dtype=wp.int32),
    fault_count_out: wp.array(dtype=wp.int32),
    masses_out: PlantMasses,
    capsules_out: Capsules,
    budget_limit_out: wp.array(dtype=float),
    model_out: WarpModel,
    qpos_out: wp.array2d(dtype=float),
    qvel_out: wp.array2d(dtype=float),
    geoms_out: Geoms,
    rigid_out: RigidBodies,
):
    """One thread per world. Move the bunches that are cut off to bodies of the pool. A bunch for which no body is left
    hangs on; the world then has the fault :data:`~vinesim.kernels.worlds.reset.BUNCHES`.

    is_free: [bunch] 1 if the bunch has left its vine. faults, fault_count: [world], see :func:`vinesim.kernels.worlds.reset.find_faults`. budget_limit:
    [tree] J, limit of the tree's energy budget, which begins again. qpos, qvel: of mujoco_warp. rigid: the contacts'
    velocities of MuJoCo's degrees of freedom.
    """
    world = wp.tid()
    slot = int(0)
    slots = free_out.bunch.shape[1]
    while slot < slots and free_out.bunch[world, wp.min(slot, slots - 1)] >= 0:
        slot = slot + 1
    for tree in range(world, numbers.trees, numbers.worlds):
        for i in range(wood.tree_start[tree], wood.tree_start[tree + 1]):
            bunch = wood.of_tree[i]
            segment = cuts.segment[bunch]
            if segment != NONE and slot >= slots:
                before = faults_out[world]
                faults_out[world] = before | BUNCHES
                if before == 0:
                    fault_count_out[world] = fault_count_out[world] + 1
            elif segment != NONE:
                longest = wp.float64(wood.length[wp.max(segment, 0)]) - numbers.shortest
                at = wp.min(wp.max(cuts.at[bunch], numbers.shortest), longest)
                at = wp.rint(at / numbers.place_step) * numbers.place_step
                detach_bunch(
                    world,
                    slot,
                    bunch,
                    tree,
                    segment,
                    at,
                    numbers,
                    pool,
                    wood,
                    body_parent,
                    body_q,
                    body_qd,
                    masses_out,
                    capsules_out,
                    model_out,
                    qpos_out,
                    qvel_out,
                    geoms_out,
                    rigid_out,
                )
                budget_limit_out[tree] = NO_LIMIT
                is_free_out[bunch] = 1
                free_out.bunch[world, slot] = bunch
                for other in range(world, numbers.trees, numbers.worlds):
                    free_out.passing[other, slot] = 1
                slot = slot + 1


@wp.kernel
def hold_parked(
    # model
    pool: Pool,
    # in
    free: FreeBunches,
    # out
    qpos_out: wp.array2d(dtype=float),
    qvel_out: wp.array2d(dtype=float),
):
    """One thread per body of a world's pool. Hold a body that is not used at its parking place."""
    world, slot = wp.tid()
    if free.bunch[world, slot] < 0:
        pose = pool.parking[slot]
        place = wp.transform_get_translation(pose)
        turn = wp.transform_get_rotation(pose)
        q = pool.q[slot]
        v = pool.v[slot]
        for i in range(3):
            qpos_out[world, q + i] = place[i]
            qpos_out[world, q + 4 + i] = turn[i]
            qvel_out[world, v + i] = 0.0
            qvel_out[world, v + 3 + i] = 0.0
        qpos_out[world, q + 3] = turn[3]


@wp.kernel
def end_passing(
    # model
    worlds: int,
    trees: int,
    capsules: Capsules,
    geoms: Geoms,
    hulls: Hulls,
    # in
    bodies: PlantBodies,
    rigid: RigidBodies,
    geom_states: GeomStates,
    # out
    free_out: FreeBunches,
):
    """One thread per tree. Let free bunches that have passed through the tree since they left their vines collide with
    it, once they no longer overlap it."""
    tree = wp.tid()
    world = tree % worlds
    for slot in range(free_out.bunch.shape[1]):
        if free_out.passing[tree, slot] != 0:
            overlaps = bool(False)
            for m in range(free_out.slot.shape[0]):
                g = m * worlds + world
                if free_out.slot[m] == slot:
                    for s in range(tree, capsules.body.shape[0], trees):
                        body = capsules.body[s]
                        if body >= 0 and not overlaps:
                            pose = bodies.q[body]
                            nearest = segment_geom_distance(
                                True,
                                geoms,
                                hulls,
                                g,
                                rigid.xmat[geoms.id[g]],
                                geom_states.center[g],
                                to_double(wp.transform_point(pose, capsules.local_start[s])),
                                to_double(wp.transform_point(pose, capsules.local_end[s])),
                                FAR,
                            )
                            overlaps = nearest[3] < wp.float64(capsules.radius[s])
            free_out.passing[tree, slot] = wp.where(overlaps, 1, 0)
