"""Pictures of all worlds of a batch: primitives are posed and bounded, then each pixel looks for its nearest primitive.

A world has some hundred primitives and small pictures, so a pixel tests the bounds of all clusters of its world (runs of
primitives), and of the primitives of those clusters that may cover it. No list can overflow, and no thread waits for
another one: a picture does not depend on the other worlds. Intersections and colours are those of one world's camera.
"""

import warp as wp

from vinesim.kernels.raster.camera_raster import ground_depth, uneven_ground_depth
from vinesim.kernels.raster.cuda_raster import outline_of
from vinesim.kernels.raster.ground import Ground, is_uneven
from vinesim.kernels.raster.pinhole import EMPTY_KEY, PRIMITIVE_MASK, SMOOTH_SIZE, Pinhole, depth_key, pixel_ray
from vinesim.kernels.raster.primitives import (
    FAR,
    HIDDEN_HEIGHT,
    LEAF,
    Clusters,
    Shapes,
    hit_primitive,
    with_w,
    xyz,
)
from vinesim.kernels.raster.transform_primitives import PosedPrimitive, pose_leaf, pose_solid
from vinesim.kernels.shading.deferred import Light, sky_radiance, surface_light
from vinesim.kernels.shading.materials import Materials
from vinesim.kernels.shading.shadow_maps import ShadowMap
from vinesim.kernels.shading.tone_rows import tone_entry
from vinesim.kernels.worlds.cutting import Canes
from vinesim.kernels.worlds.reset import MOTION

wp.set_module_options({"enable_backward": False, "fast_math": True})

PLANT = wp.constant(0)
"""Carrier of a primitive: a plant's body."""
RIGID = wp.constant(1)
"""A body of mujoco_warp."""
STATIC = wp.constant(2)
"""Nothing moves the primitive."""
BUNCH = wp.constant(3)
"""A plant's body; a body of the pool once the bunch has come off."""
STALK = wp.constant(4)
"""A segment of a peduncle: a plant's body carries what a cut leaves of it."""
PIECE = wp.constant(5)
"""The part of a segment of a peduncle that a bunch has taken along; not seen before."""
WOOD = wp.constant(6)
"""A segment of a cane: a plant's body carries the part that cuts leave to it."""
STUMP = wp.constant(7)
"""A spare body: the part of a segment of a cane that a cut has made of it; not seen before."""
GROWN = wp.constant(8)
"""A node or a bud of a cane: the part of the segment on which it grows carries it."""

TILE_WIDTH = wp.constant(8)
"""Width of a tile [px]: the 32 threads of a warp draw a tile of 8 x 4 pixels, which the same primitives cover."""
TILE_HEIGHT = wp.constant(4)
TILE_PIXELS = wp.constant(32)
NO_PIXELS = wp.constant(wp.vec3i(0, 0, 0))
"""Packed bounds of no pixels, see :func:`packed_bounds`."""


@wp.struct
class Views:
    """Cameras of a world, the same in all worlds; each array is [camera]."""

    width: int
    """[px] Of all pictures."""
    height: int
    max_depth: float
    """[m] Depth beyond which nothing is drawn."""
    body: wp.array(dtype=wp.int32)
    """MuJoCo body that carries the camera; 0 is the world."""
    pose: wp.array(dtype=wp.transform)
    """Pose of the optical frame in the body's frame [m]."""
    focal: wp.array(dtype=float)
    """[px] Focal length."""
    near_radius: wp.array(dtype=float)
    """[m] See :class:`~vinesim.kernels.raster.pinhole.Pinhole`."""


@wp.struct
class Variants:
    """Primitives of the different worlds, in the frames of their carriers. The rows of a variant lie side by side."""

    room: int
    """Number of primitives for which each world has rows: that of the largest variant."""
    of_world: wp.array(dtype=wp.int32)
    """[world] Variant of each world."""
    first_primitive: wp.array(dtype=wp.int32)
    """[variant + 1] First primitive of each variant."""
    first_cluster: wp.array(dtype=wp.int32)
    """[variant + 1] First cluster of each variant."""
    role: wp.array(dtype=wp.int32)
    """[primitive] How the primitive moves: :data:`PLANT` to :data:`GROWN`."""
    tree: wp.array(dtype=wp.int32)
    """[primitive] Tree of the world; of rigid primitives not used."""
    body: wp.array(dtype=wp.int32)
    """[primitive] Number of the body in its tree, or MuJoCo's index of a rigid body."""
    bunch: wp.array(dtype=wp.int32)
    """[primitive] Number of the bunch in its world, -1 for none."""
    above: wp.array(dtype=wp.int32)
    """[primitive] Number of segments of the peduncle between this one and the bunch; only of stalks."""
    place: wp.array(dtype=float)
    """[primitive] m, from the origin of the body to where the primitive grows; only of :data:`GROWN`."""
    first_wood: wp.array(dtype=wp.int32)
    """[primitive] First row of its tree in :attr:`wood`; only of :data:`STUMP`."""
    wood: wp.array(dtype=wp.int32)
    """[body] Number of the body's :data:`WOOD` in its variant, -1 for none. The bodies of a tree lie side by side."""
    offset: wp.array(dtype=wp.transform)
    """[primitive] Pose in the body of the pool, for bunches, or in the world, if nothing moves the primitive."""


@wp.struct
class Motion:
    """Where bodies are, and which bunches have come off."""

    worlds: int
    pitch: int
    """Distance between consecutive bodies of a tree in ``body_q``."""
    tree_first: wp.array(dtype=wp.int32)
    """[tree] First body of each tree in ``body_q``."""
    body_q: wp.array(dtype=wp.transform)
    """[body] Poses of plant bodies [m]."""
    xpos: wp.array2d(dtype=wp.vec3)
    """[world, body] Of mujoco_warp [m]."""
    xquat: wp.array2d(dtype=wp.quat)
    """[world, body] Of mujoco_warp: w first."""
    world_bunch: wp.array2d(dtype=wp.int32)
    """[world, i] Bunch of the batch that is bunch i of a world."""
    free_bunch: wp.array2d(dtype=wp.int32)
    """[world, slot] Bunch of the batch that a body of the pool is, -1 for none."""
    pool_body: wp.array(dtype=wp.int32)
    """[slot] MuJoCo body of each body of the pool."""
    first_piece: wp.array(dtype=wp.int32)
    """[slot] First MuJoCo geom of each body of the pool that is a piece of a stalk."""
    geom_pos: wp.array2d(dtype=wp.vec3)
    """[world, geom] Of mujoco_warp, as the three below."""
    geom_quat: wp.array2d(dtype=wp.quat)
    geom_size: wp.array2d(dtype=wp.vec3)
    geom_margin: wp.array2d(dtype=float)
    canes: Canes
    """Parts of canes."""
    spares: int
    """Number of spare bodies of a tree that cuts can take."""
    first_spare: wp.array(dtype=wp.int32)
    """[tree] First spare body."""


@wp.struct
class Looks:
    """How primitives look: [world * room + i] primitive i of a world."""

    material: wp.array(dtype=wp.int32)
    tint: wp.array(dtype=wp.vec3)
    sky: wp.array(dtype=float)
    """Share of the sky that is visible."""
    label: wp.array(dtype=wp.int32)


@wp.func
def is_drawn(world: int, due: wp.array(dtype=wp.bool), faults: wp.array(dtype=wp.int32)) -> bool:
    """Returns whether the pictures of a world are wanted, and its numbers are finite."""
    return due[world] and (faults[world] & MOTION) == 0


@wp.func
def rigid_pose(motion: Motion, world: int, body: int) -> wp.transform:
    """Returns the pose of a body of mujoco_warp in its world [m]."""
    q = motion.xquat[world, body]
    return wp.transform(motion.xpos[world, body], wp.quat(q[1], q[2], q[3], q[0]))


@wp.func
def lens_of(views: Views, motion: Motion, world: int, camera: int) -> Pinhole:
    """Returns pose and projection of a camera of a world."""
    pose = wp.transform_multiply(rigid_pose(motion, world, views.body[camera]), views.pose[camera])
    lens = Pinhole()
    lens.eye = wp.transform_get_translation(pose)
    lens.rotation = wp.transpose(wp.quat_to_matrix(wp.normalize(wp.transform_get_rotation(pose))))
    lens.fx = views.focal[camera]
    lens.fy = lens.fx
    lens.width = views.width
    lens.height = views.height
    lens.cx = 0.5 * float(views.width - 1)
    lens.cy = 0.5 * float(views.height - 1)
    lens.first_row = 0
    lens.end_row = views.height
    lens.max_depth = views.max_depth
    lens.near_radius = views.near_radius[camera]
    return lens


@wp.func
def slot_of_bunch(motion: Motion, world: int, bunch: int) -> int:
    """Returns the body of the pool that is bunch number ``bunch`` of a world, -1 if it hangs on its vine."""
    found = int(-1)
    if bunch >= 0:
        for slot in range(motion.free_bunch.shape[1]):
            if motion.free_bunch[world, slot] == motion.world_bunch[world, bunch]:
                found = slot
    return found


@wp.func
def tree_of(variants: Variants, motion: Motion, world: int, k: int) -> int:
    """Returns the tree of the batch that carries primitive ``k`` of the variants in a world."""
    return variants.tree[k] * motion.worlds + world


@wp.func
def body_of(variants: Variants, motion: Motion, world: int, k: int) -> int:
    """Returns the plant's body in whose frame primitive ``k`` of the variants is, in a world."""
    return motion.tree_first[tree_of(variants, motion, world, k)] + variants.body[k] * motion.pitch


@wp.func
def part_at(motion: Motion, tree: int, segment: int, place: float) -> int:
    """Returns the part of a segment of a cane on which something grows, ``place`` [m] from the segment's origin."""
    body = int(segment)
    if place < motion.canes.start[segment]:  # it stays on a stump
        for i in range(motion.spares):
            spare = motion.first_spare[tree] + i * motion.pitch
            is_here = motion.canes.start[spare] <= place and place < motion.canes.end[spare]
            if motion.canes.segment[spare] == segment and is_here:
                body = spare
    return body


@wp.func
def wood_of_stump(variants: Variants, motion: Motion, world: int, k: int) -> int:
    """Returns the primitive of the variants that is the whole segment of the stump ``k`` in a world, -1 for no stump."""
    segment = motion.canes.segment[body_of(variants, motion, world, k)]
    found = int(-1)
    if segment >= 0:
        number = (segment - motion.tree_first[tree_of(variants, motion, world, k)]) // motion.pitch
        wood = variants.wood[variants.first_wood[k] + number]
        found = variants.first_primitive[variants.of_world[world]] + wood
    return found


@wp.func
def carrier_pose(variants: Variants, motion: Motion, world: int, k: int, slot: int) -> wp.transform:
    """Returns the pose [m] that moves primitive ``k`` of the variants in a world.

    ``slot``: body of the pool that its bunch is, -1 for none.
    """
    role = variants.role[k]
    pose = variants.offset[k]
    if role == RIGID:
        pose = rigid_pose(motion, world, variants.body[k])
    elif (role == BUNCH or role == PIECE) and slot >= 0:
        pose = wp.transform_multiply(rigid_pose(motion, world, motion.pool_body[slot]), pose)
    elif role != STATIC:
        body = body_of(variants, motion, world, k)
        if role == GROWN:
            body = part_at(motion, tree_of(variants, motion, world, k), body, variants.place[k])
        pose = motion.body_q[body]
    return pose


@wp.func
def hidden(s: PosedPrimitive) -> PosedPrimitive:
    """Returns a cone where no camera sees it."""
    s.a = wp.vec4(0.0, 0.0, HIDDEN_HEIGHT, 1.0e-6)
    s.b = wp.vec4(1.0e-3, 0.0, HIDDEN_HEIGHT, 1.0e-6)
    return s


@wp.func
def cut_cane(s: PosedPrimitive, canes: Canes, body: int) -> PosedPrimitive:
    """Returns the part of a segment of a cane that is ``body``. ``s``: the whole segment."""
    length = canes.length[canes.segment[body]]
    start = canes.start[body] / length
    end = canes.end[body] / length
    way = s.b - s.a
    s.b = wp.where(end < 1.0, s.a + way * end, s.b)
    s.a = s.a + way * start
    return s


@wp.func
def cut_stalk(s: PosedPrimitive, motion: Motion, world: int, role: int, above: int, slot: int) -> PosedPrimitive:
    """Returns a segment of a peduncle as a cut leaves it on the vine (:data:`STALK`), or the part of it that its bunch
    has taken along (:data:`PIECE`).

    ``s``: the whole segment; ``above``: number of segments between this one and the bunch; ``slot``: body of the pool
    that the bunch is, -1 while it hangs.
    """
    share = float(0.0)
    if role == STALK:
        share = 1.0
    if slot >= 0:
        g = motion.first_piece[slot] + above
        if motion.geom_margin[world, g] >= 0.0:  # else the cut is below this segment
            size = motion.geom_size[world, g]
            if role == STALK:
                share = 1.0 - 2.0 * size[1] / wp.max(wp.length(xyz(s.b) - xyz(s.a)), 1.0e-6)
                share = wp.where(share < 1.0e-3, 0.0, share)
            else:
                q = motion.geom_quat[world, g]
                at = wp.transform(motion.geom_pos[world, g], wp.quat(q[1], q[2], q[3], q[0]))
                at = wp.transform_multiply(rigid_pose(motion, world, motion.pool_body[slot]), at)
                share = 1.0
                s.a = with_w(wp.transform_point(at, wp.vec3(0.0, 0.0, -size[1])), size[0])
                s.b = with_w(wp.transform_point(at, wp.vec3(0.0, 0.0, size[1])), size[0])
    if share == 0.0:
        s = hidden(s)
    elif share < 1.0:
        s.b = s.a + (s.b - s.a) * share
    return s


@wp.func
def packed_bounds(first_x: int, end_x: int, first_y: int, end_y: int, depth: float) -> wp.vec3i:
    """Returns bounds of a shape in a picture: first and last + 1 column and row [px] in 16 bits each, and the least depth
    [um]."""
    return wp.vec3i(first_x | (end_x << 16), first_y | (end_y << 16), int(depth * 1.0e6))


@wp.func
def may_cover(bounds: wp.vec3i, x: int, y: int, best: wp.int64) -> bool:
    """Returns whether a shape with packed ``bounds`` may be nearer in pixel (x, y) than the hit with the key ``best``."""
    return (
        x >= (bounds[0] & 0xFFFF)
        and x < (bounds[0] >> 16)
        and y >= (bounds[1] & 0xFFFF)
        and y < (bounds[1] >> 16)
        and (wp.int64(bounds[2]) << wp.int64(32)) < best
    )


@wp.kernel
def pose_primitives(
    # model
    local: Shapes,
    clusters: Clusters,
    variants: Variants,
    views: Views,
    # in
    motion: Motion,
    due: wp.array(dtype=wp.bool),
    faults: wp.array(dtype=wp.int32),
    # out
    shapes_out: Shapes,
    bounds_out: wp.array3d(dtype=wp.vec3i),
    cluster_bounds_out: wp.array3d(dtype=wp.vec3i),
    looks_out: Looks,
):
    """One thread transforms the primitives of one cluster of a world into the world, and bounds them in its pictures.

    local: [primitive] of the variants, in the frames of their carriers; clusters: of the variants; due: [world] whether
    the world's pictures are wanted; faults: [world], a world whose motion has one is not drawn. shapes: [world * room + i] primitive i of a world; bounds: [world, camera, i] of
    primitives and cluster_bounds: [world, camera, i] of clusters, see :func:`packed_bounds`. looks: a stump gets that
    of its segment.
    """
    world, number = wp.tid()
    variant = variants.of_world[world]
    cluster = variants.first_cluster[variant] + number
    if is_drawn(world, due, faults) and cluster < variants.first_cluster[variant + 1]:
        kind = clusters.kind[cluster]
        first = clusters.first[cluster]
        end = first + clusters.size[cluster]
        base = variants.first_primitive[variant]
        for k in range(first, end):
            slot = slot_of_bunch(motion, world, variants.bunch[k])
            pose = carrier_pose(variants, motion, world, k, slot)
            i = world * variants.room + k - base
            role = variants.role[k]
            whole = int(k)
            if role == STUMP:
                whole = wood_of_stump(variants, motion, world, k)
            s = PosedPrimitive()
            if whole < 0:
                s = hidden(s)
            elif kind == LEAF:
                s = pose_leaf(local, k, pose)
            else:
                s = pose_solid(local, whole, kind, pose)
            if role == STALK or role == PIECE:
                s = cut_stalk(s, motion, world, role, variants.above[k], slot)
            elif (role == WOOD or role == STUMP) and whole >= 0:
                s = cut_cane(s, motion.canes, body_of(variants, motion, world, k))
            if whole >= 0 and whole != k:
                like = i + whole - k
                looks_out.material[i] = looks_out.material[like]
                looks_out.tint[i] = looks_out.tint[like]
                looks_out.sky[i] = looks_out.sky[like]
                looks_out.label[i] = looks_out.label[like]
            shapes_out.a[i] = s.a
            shapes_out.b[i] = s.b
            shapes_out.c[i] = s.c
            shapes_out.d[i] = s.d
        for camera in range(views.body.shape[0]):
            lens = lens_of(views, motion, world, camera)
            low_x = int(lens.width)
            high_x = int(0)
            low_y = int(lens.height)
            high_y = int(0)
            nearest = float(lens.max_depth)
            for k in range(first, end):
                o = outline_of(shapes_out, world * variants.room + k - base, lens)
                bounds = NO_PIXELS
                if o.box[0] < o.box[1] and o.box[2] < o.box[3] and o.depth < lens.max_depth:
                    bounds = packed_bounds(o.box[0], o.box[1], o.box[2], o.box[3], o.depth)
                    low_x = wp.min(low_x, o.box[0])
                    high_x = wp.max(high_x, o.box[1])
                    low_y = wp.min(low_y, o.box[2])
                    high_y = wp.max(high_y, o.box[3])
                    nearest = wp.min(nearest, o.depth)
                row = k - base
                bounds_out[world, camera, row] = bounds
            together = NO_PIXELS
            if low_x < high_x:
                together = packed_bounds(low_x, high_x, low_y, high_y, nearest)
            cluster_bounds_out[world, camera, number] = together


@wp.func
def pixel_of_thread(width: int, n: int) -> wp.vec2i:
    """Returns column and row of the pixel with number ``n`` in the order of tiles, of pictures ``width`` [px] wide. It may
    be outside the picture."""
    across = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tile = n // TILE_PIXELS
    lane = n - tile * TILE_PIXELS
    return wp.vec2i(
        (tile % across) * TILE_WIDTH + lane % TILE_WIDTH, (tile // across) * TILE_HEIGHT + lane // TILE_WIDTH
    )


@wp.func
def nearest_key(
    shapes: Shapes,
    clusters: Clusters,
    variants: Variants,
    lens: Pinhole,
    bounds: wp.array3d(dtype=wp.vec3i),
    cluster_bounds: wp.array3d(dtype=wp.vec3i),
    world: int,
    camera: int,
    x: int,
    y: int,
) -> wp.int64:
    """Returns the key (:mod:`vinesim.kernels.raster.pinhole`) of the nearest primitive in pixel (x, y)."""
    best = wp.int64(EMPTY_KEY)
    ray = wp.transpose(lens.rotation) * pixel_ray(lens, x, y)
    variant = variants.of_world[world]
    base = variants.first_primitive[variant]
    first_cluster = variants.first_cluster[variant]
    for cluster in range(first_cluster, variants.first_cluster[variant + 1]):
        if may_cover(cluster_bounds[world, camera, cluster - first_cluster], x, y, best):
            first = clusters.first[cluster] - base
            for row in range(first, first + clusters.size[cluster]):
                if may_cover(bounds[world, camera, row], x, y, best):
                    i = world * variants.room + row
                    smooth = wp.int32(0)
                    if shapes.kind[i] == LEAF:
                        a4 = shapes.a[i]
                        if a4[3] * lens.fx > wp.dot(lens.rotation[2], xyz(a4) - lens.eye) * SMOOTH_SIZE:
                            smooth = 1
                    t = hit_primitive(shapes, i, lens.eye, ray, smooth)
                    if t < lens.max_depth:
                        best = wp.min(best, depth_key(t, i))
    return best


@wp.kernel
def draw_pictures(
    # model
    shapes: Shapes,
    clusters: Clusters,
    variants: Variants,
    views: Views,
    ground: Ground,
    label: wp.array(dtype=wp.int32),
    ground_label: int,
    # in
    motion: Motion,
    due: wp.array(dtype=wp.bool),
    faults: wp.array(dtype=wp.int32),
    bounds: wp.array3d(dtype=wp.vec3i),
    cluster_bounds: wp.array3d(dtype=wp.vec3i),
    sky_depth: float,
    run: int,
    # out
    primitive_out: wp.array4d(dtype=wp.int32),
    depth_out: wp.array4d(dtype=float),
    labels_out: wp.array4d(dtype=wp.int32),
):
    """One thread finds what ``run`` pixels of a tile of one picture show.

    shapes: [world * room + i] posed primitives; label: of each; due, faults: [world]; bounds, cluster_bounds: see
    :func:`pose_primitives`. All outputs are [world, camera, row, column]. primitive: -1 the sky, -2 the ground; depth: m
    along the optical axis, ``sky_depth`` for the sky; labels: see :func:`vinesim.scene.ids.label`.
    """
    picture, part = wp.tid()
    cameras = views.body.shape[0]
    world = picture // cameras
    camera = picture - world * cameras
    if is_drawn(world, due, faults):
        lens = lens_of(views, motion, world, camera)
        for n in range(part * run, part * run + run):
            place = pixel_of_thread(views.width, n)
            x = place[0]
            y = place[1]
            if x < lens.width and y < lens.height:
                key = nearest_key(shapes, clusters, variants, lens, bounds, cluster_bounds, world, camera, x, y)
                z = float(FAR)
                if key < EMPTY_KEY:
                    z = float(key >> wp.int64(32)) * 1.0e-6
                t = float(FAR)
                if is_uneven(ground):
                    t = uneven_ground_depth(ground, lens, x, y, z)
                else:
                    t = ground_depth(lens, x, y)
                i = wp.where(t < FAR, -2, -1)
                name = wp.where(t < FAR, ground_label, 0)
                if z < t:
                    t = z
                    i = int(key & PRIMITIVE_MASK)
                    name = label[i]
                primitive_out[world, camera, y, x] = i
                depth_out[world, camera, y, x] = wp.where(t < FAR, t, sky_depth)
                labels_out[world, camera, y, x] = name


@wp.kernel
def shade_pictures(
    # model
    shapes: Shapes,
    materials: Materials,
    views: Views,
    light: Light,
    unshaded: ShadowMap,
    gain: wp.vec3,
    tone: wp.array(dtype=wp.uint8),
    # in
    motion: Motion,
    due: wp.array(dtype=wp.bool),
    faults: wp.array(dtype=wp.int32),
    primitive: wp.array4d(dtype=wp.int32),
    depth: wp.array4d(dtype=float),
    run: int,
    # out
    rgb_out: wp.array4d(dtype=wp.vec3ub),
):
    """One thread computes the colours of ``run`` pixels of a tile of one picture.

    unshaded: a shadow map without texels: no primitive casts a shadow; gain: exposure times white balance; tone: [4096]
    8-bit sRGB for sqrt(radiance / 4). primitive, depth, rgb: [world, camera, row, column], see :func:`draw_pictures`.
    """
    picture, part = wp.tid()
    cameras = views.body.shape[0]
    world = picture // cameras
    camera = picture - world * cameras
    if is_drawn(world, due, faults):
        lens = lens_of(views, motion, world, camera)
        back = wp.transpose(lens.rotation)
        for n in range(part * run, part * run + run):
            place = pixel_of_thread(views.width, n)
            x = place[0]
            y = place[1]
            if x < lens.width and y < lens.height:
                i = primitive[world, camera, y, x]
                ray = back * pixel_ray(lens, x, y)
                colour = wp.vec3(0.0, 0.0, 0.0)
                if i == -1:
                    colour = sky_radiance(light, ray / wp.length(ray))
                else:
                    z = depth[world, camera, y, x]
                    colour = surface_light(shapes, materials, light, unshaded, unshaded, lens, i, ray, z, x, y, 1)
                colour = wp.cw_mul(gain, colour)
                rgb_out[world, camera, y, x] = wp.vec3ub(
                    tone[tone_entry(colour[0])], tone[tone_entry(colour[1])], tone[tone_entry(colour[2])]
                )
