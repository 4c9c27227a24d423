"""Cameras of a batch of worlds: pictures of all worlds by one call, in arrays on the batch's device.

Depth and labels are exact: those of :class:`~vinesim.sensors.camera.camera.Camera` without noise. Colours are its exact
colours in daylight, except that nothing casts a shadow, the ground sees the whole sky, exposure is fixed, and lamps
have no glare. There is no noise, no distortion and no motion blur.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.plants import structs
from vinesim.kernels.plants.kinematics import forward_kinematics
from vinesim.kernels.raster.pinhole import NEAR_DEPTH
from vinesim.kernels.raster.primitives import Clusters, Shapes
from vinesim.kernels.shading.deferred import Light
from vinesim.kernels.shading.materials import Materials
from vinesim.kernels.shading.shadow_maps import ShadowMap
from vinesim.kernels.worlds import pictures as kernels
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.scene.values import RigidVisual
from vinesim.sensors.camera.exposure import usual_exposure
from vinesim.sensors.camera.sunlight import DEFAULT_SUN, OutdoorLight, set_daylight, set_samples
from vinesim.sensors.primitives import textures
from vinesim.sensors.primitives.scene_primitives import Primitives, ground_struct, rest_snapshot
from vinesim.sensors.raster.camera_rasterizer import MAX_DEPTH
from vinesim.sensors.raster.primitive_arrays import CONE
from vinesim.worlds.bunch_pool import shapes_of_bunches
from vinesim.worlds.plants import gathered, items_of_trees
from vinesim.worlds.worlds import Worlds, write_mask

LARGEST = 1024
"""[px] Largest width and height of a picture."""
_COPIED = ("leaf_texture", "noise_texture", "soil_texture", "rows", "colours")
"""Fields of ``Materials`` that all worlds share."""
_LOOKS = {"material": wp.int32, "label": wp.int32, "tint": wp.vec3, "sky": float}
"""Fields of :class:`~vinesim.kernels.worlds.pictures.Looks`, with their types."""
_OPEN = 40.0
"""[m] Width of the square around the origin that is the floor of a vineyard; beyond it are fields. GUESSED. One
world must look the same in any batch, so the square does not follow the plants."""
_BLOCKS = (64, 128)
"""Numbers of threads in a CUDA block: of those that pose clusters, and of those that draw pixels."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class WorldCamera:
    """A camera that each world has: fixed in the world, or on a link of a robot."""

    pose: np.ndarray
    """[7] Pose of the optical frame (z forward, x right, y down) in the world, or in the frame of the link [m]."""
    field_of_view: float = 1.0
    """Horizontal angle of view [rad]."""
    actor: str | None = None
    """Robot that carries the camera; None: it is fixed in the world."""
    link: str = ""
    """Link of the robot."""


class WorldCameras:
    """Cameras that each world of a batch has, and their pictures of all worlds.

    Args:
        worlds: the batch. Its robots and plants are drawn, and what stands still.
        cameras: at least one.
        size: width and height of all pictures [px].
        sun: vector towards the sun.
        grass: tufts per square metre around the vines, as of :class:`Primitives`.
        colours: whether :attr:`rgb` is wanted.

    Raises :class:`ValueError` for no cameras, and for a size, pose or angle that no camera can have.
    """

    def __init__(
        self,
        worlds: Worlds,
        cameras: Sequence[WorldCamera],
        size: tuple[int, int] = (128, 128),
        *,
        sun: tuple[float, float, float] = DEFAULT_SUN,
        grass: float = 0.0,
        colours: bool = True,
    ) -> None:
        width, height = size
        if not cameras:
            raise ValueError("no cameras: give at least one")
        if not (1 <= width <= LARGEST and 1 <= height <= LARGEST):
            raise ValueError(f"pictures of {width} x {height} px: give 1 to {LARGEST} px")
        if not np.isfinite(sun).all() or not np.linalg.norm(sun) > 0.0:
            raise ValueError(f"sun {sun}: give a vector towards the sun")
        if not (np.isfinite(grass) and grass >= 0.0):
            raise ValueError(f"grass {grass}: give 0 or more tufts per square metre")
        self.worlds = worlds
        self._device = worlds.bodies.device
        self._views = self._views_of(cameras, width, height)
        variants, of_world = _variants(worlds, grass)
        self._tables = _Tables(worlds, variants, of_world, self._device)
        shape = (worlds.count, len(cameras), height, width)
        self._primitive = self._zeros(wp.int32, *shape)
        self.depth = self._zeros(float, *shape)
        """[world, camera, row, column] m along the optical axis, infinite for the sky."""
        self.labels = self._zeros(wp.int32, *shape)
        """[world, camera, row, column] Class and number of the visible object, see :func:`vinesim.scene.ids.label`.
        Trees and bunches are numbered within their world, in the order of its trees."""
        self.rgb: wp.array | None = self._zeros(wp.vec3ub, *shape) if colours else None
        """[world, camera, row, column] Three numbers of eight bits, sRGB; None without ``colours``."""
        self._ground = ground_struct(worlds.model.terrain, str(self._device))
        self._due = wp.full(worlds.count, True, dtype=wp.bool, device=self._device)
        self.launches = self._all_launches(variants[0], np.asarray(sun, float))
        """The launches that draw all pictures, by name, in their order."""
        self._graph = KernelGraph(*self.launches.values(), device=str(self._device))

    def render(self, worlds: np.ndarray | wp.array | None = None) -> None:
        """Write the pictures of the present states. Call it between two steps; the states do not change.

        ``worlds``: bool [world], which worlds to draw. The other worlds keep their pictures. None draws all. A world
        with a fault of its motion (:attr:`Worlds.faults`) keeps its pictures, because its numbers may not be finite.
        Raises :class:`ValueError` for an array of another type or length.
        """
        write_mask(worlds, self._due)
        self.worlds.bodies.update_kinematics()
        self._graph()

    @property
    def primitives(self) -> int:
        """Number of primitives of a world; of the largest one, if worlds differ."""
        return self._tables.variants.room

    def memory(self) -> int:
        """Returns the device memory of a world [byte], without what all worlds share."""
        pictures = [self._primitive, self.depth, self.labels, *([] if self.rgb is None else [self.rgb])]
        arrays = [*pictures, *self._tables.of_worlds()]
        return sum(array.capacity for array in arrays) // self.worlds.count

    def _zeros(self, dtype: Any, *shape: int) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self._device)

    def _array(self, values: Any, dtype: Any) -> wp.array:
        return wp.array(np.asarray(values), dtype=dtype, device=self._device)

    def _views_of(self, cameras: Sequence[WorldCamera], width: int, height: int) -> kernels.Views:
        rigid = self.worlds.bodies.rigid
        bodies, poses, focal = [], [], []
        for number, camera in enumerate(cameras):
            name = f"pose of camera {number}"
            if camera.actor is None and camera.link:
                raise ValueError(f"camera {number} is on link {camera.link!r} of no actor: give the actor too")
            if not 0.01 <= camera.field_of_view <= 3.1:
                raise ValueError(f"camera {number} has the field_of_view {camera.field_of_view}: give 0.01 to 3.1 rad")
            if camera.actor is not None:
                rigid.link_pose(camera.actor, camera.link)  # raises an error if there is no such link
            bodies.append(0 if camera.actor is None else rigid.robot(camera.actor).bodies[camera.link])
            poses.append(frames.checked_pose(name, camera.pose))
            focal.append(0.5 * width / np.tan(0.5 * camera.field_of_view))
        views = kernels.Views()
        views.width = width
        views.height = height
        views.max_depth = MAX_DEPTH
        views.body = self._array(bodies, wp.int32)
        views.pose = self._array(np.array(poses), wp.transform)
        views.focal = self._array(focal, float)
        corner = 0.5 * np.hypot(width + 1, height + 1) / np.array(focal)
        views.near_radius = self._array(float(NEAR_DEPTH) * np.sqrt(1.0 + corner**2), float)
        return views

    def _motion(self, body_q: wp.array) -> kernels.Motion:
        worlds = self.worlds
        data = worlds.bodies.data
        motion = kernels.Motion()
        motion.worlds = worlds.count
        motion.pitch = worlds.plants.buffers.pitch
        motion.tree_first = worlds.plants.buffers.arrays["tree_first"]
        motion.body_q = body_q
        motion.xpos = data.xpos
        motion.xquat = data.xquat
        motion.world_bunch = self._array(bunches_of_worlds(worlds.model, worlds.count), wp.int32)
        motion.spares = _spares_for_cuts(worlds)
        first_spare = np.zeros(0, np.int32)
        if motion.spares:
            plants = worlds.model
            first_spare = worlds.plants.buffers.slots[plants.tree_first + plants.tree_core - plants.tree_spares]
        motion.first_spare = self._array(first_spare, wp.int32)
        pool = worlds.pool
        if pool is None:
            motion.free_bunch = self._zeros(wp.int32, worlds.count, 0)
            motion.pool_body = motion.first_piece = self._zeros(wp.int32, 0)
            return motion
        model = worlds.bodies.model
        motion.canes = pool.canes.parts[0]
        motion.free_bunch = pool.bunch
        motion.pool_body = pool.table.body
        motion.first_piece = self._array(pool.table.geom.numpy() + shapes_of_bunches(worlds.model)[0], wp.int32)
        for name in ("geom_pos", "geom_quat", "geom_size", "geom_margin"):
            setattr(motion, name, getattr(model, name))
        return motion

    def _all_launches(self, first: _Variant, sun: np.ndarray) -> dict[str, KernelLaunch]:
        worlds = self.worlds
        tables = self._tables
        views = self._views
        device = str(self._device)
        fill = worlds.plants.launches.fill_resident
        bodies = structs.BodyState()  # copies, because a step reads those of its plants
        state = fill(structs.BodyState)
        bodies.body_q, bodies.body_qd = wp.clone(state.body_q), wp.clone(state.body_qd)
        trees = len(worlds.model.tree_first)
        every = [self._array([trees], wp.int32), self._array(np.arange(trees), wp.int32)]
        given = [fill(structs.ArticulationModel), *every, fill(structs.JointState)]
        move = KernelLaunch(forward_kinematics, given, [bodies], threads=trees)

        motion = self._motion(bodies.body_q)
        cameras = len(views.body)
        bounds = self._zeros(wp.vec3i, worlds.count, cameras, tables.variants.room)
        cluster_bounds = self._zeros(wp.vec3i, worlds.count, cameras, tables.clusters_room)
        tables.bounds = [bounds, cluster_bounds]
        given = [tables.local, tables.clusters, tables.variants, views, motion, self._due, worlds.faults]
        shape = {"threads": worlds.count, "width": tables.clusters_room, "block": _BLOCKS[0]}
        pose = KernelLaunch(
            kernels.pose_primitives, given, [tables.shapes, bounds, cluster_bounds, tables.looks], **shape
        )

        tiles = -(-views.width // int(kernels.TILE_WIDTH)) * -(-views.height // int(kernels.TILE_HEIGHT))
        pixels = int(kernels.TILE_PIXELS)
        run = 1 if self._device.is_cuda else pixels  # on a CPU a thread takes a tile, to pass the structs less often
        # at least two: a launch with a width of 1 has one dimension
        shape = {"threads": worlds.count * cameras, "width": max(tiles * pixels // run, 2), "block": _BLOCKS[1]}
        given = [tables.shapes, tables.clusters, tables.variants, views, self._ground, tables.looks.label]
        given += [label(Organ.GROUND, 0), motion, self._due, worlds.faults, bounds, cluster_bounds, float("inf"), run]
        draw = KernelLaunch(kernels.draw_pictures, given, [self._primitive, self.depth, self.labels], **shape)
        launches = {"kinematics": move, "pose": pose, "draw": draw}
        if self.rgb is None:
            return launches

        light = Light()
        set_samples(light, 0, device)
        sun = sun / np.linalg.norm(sun)
        now = OutdoorLight.of(float(sun[2]), worlds.model.look.palette)
        set_daylight(light, sun, now, worlds.model.look.palette, device)
        gain = wp.vec3(*(now.balance * usual_exposure(now.brightness)).tolist())
        unshaded = ShadowMap()
        unshaded.texel = 1.0
        unshaded.depth = self._zeros(float, 0)
        tone = self._array(textures.tone_curve(), wp.uint8)
        given = [tables.shapes, self._materials(first), views, light, unshaded, gain, tone]
        given += [motion, self._due, worlds.faults, self._primitive, self.depth, run]
        return launches | {"shade": KernelLaunch(kernels.shade_pictures, given, [self.rgb], **shape)}

    def _materials(self, first: _Variant) -> Materials:
        made = Materials()
        given = first.primitives.materials
        for name in _COPIED:
            value = getattr(given, name)
            setattr(made, name, value.to(self._device) if isinstance(value, wp.array) else value)
        for name in ("material", "tint", "sky"):
            setattr(made, name, getattr(self._tables.looks, name))
        made.ground = self._ground
        made.ground_sky = self._array(np.ones((2, 2), np.float32), float)
        made.ground_x = made.ground_y = -0.5 * _OPEN
        made.ground_cell = _OPEN
        return made


class _Variant:
    """Primitives of a world, with how each one moves."""

    def __init__(
        self, model: Model, visuals: tuple[RigidVisual, ...], bodies: np.ndarray, grass: float, *, canes: bool
    ) -> None:
        """``visuals``, ``bodies``: visible rigid bodies and the MuJoCo body of each; ``canes``: whether canes may be
        cut."""
        self.primitives = scene = Primitives(model, grass=grass)
        scene.update(rest_snapshot(model, visuals, np.tile(frames.pose(np.zeros(3)), (len(visuals), 1))))
        columns = scene.local_columns(np.arange(scene.count))
        carrier = columns.pop("carrier")
        self.columns = columns
        self.columns["kind"] = np.repeat(scene.cluster_kind, scene.cluster_size)
        self.first = scene.cluster_first
        self.size = scene.cluster_size
        self.kind = scene.cluster_kind
        moves = carrier < len(model.body_mass)
        is_rigid = carrier > scene.static_carrier
        body = np.where(moves, carrier, 0)
        bunch = np.where(moves, np.repeat(scene.cluster_bunch, scene.cluster_size), -1)
        of_body = model.bunch_of_body()
        is_stalk = moves & (model.body_organ[body] == int(Organ.PEDUNCLE)) & (self.columns["kind"] == CONE)
        is_stalk &= of_body[body] >= 0
        role = np.select(
            [is_rigid, ~moves, is_stalk, bunch >= 0], [kernels.RIGID, kernels.STATIC, kernels.STALK, kernels.BUNCH], 0
        )
        tree = model.body_tree[body]
        self.columns |= {
            "role": role.astype(np.int32),
            "tree": np.where(moves, tree, 0),
            "body": np.where(moves, body - model.tree_first[tree], 0),
            "bunch": np.where(is_stalk, of_body[body], bunch),
            "above": np.where(is_stalk, _segments_above(model)[body], 0),
            "offset": np.tile(frames.pose(np.zeros(3)), (scene.count, 1)),
        }
        self.columns["body"][is_rigid] = bodies[carrier[is_rigid] - scene.static_carrier - 1]
        still = ~moves & ~is_rigid
        self.columns["offset"][still] = scene.carrier_poses(np.flatnonzero(still))
        self.columns |= {"place": np.zeros(scene.count), "first_wood": np.zeros(scene.count, np.int32)}
        self.wood = np.full(len(model.body_mass), -1)
        """[body] Number of the segment that is drawn for each body of a cane, -1 for none."""
        if canes:
            self._let_canes_be_cut(model, np.flatnonzero(moves), body)
        of_bunch = np.flatnonzero(role == kernels.BUNCH)
        rest = model_rest(model)
        own = rest[model.bunch_body[bunch[of_bunch]]]
        self.columns["offset"][of_bunch] = frames.compose(frames.inverse(own), rest[body[of_bunch]])
        self._add_pieces(np.flatnonzero(is_stalk))

    def _let_canes_be_cut(self, model: Model, rows: np.ndarray, body: np.ndarray) -> None:
        """Give the primitives of canes and of spare bodies their roles. ``rows`` [k]: what plants carry; ``body``: body
        of each primitive."""
        is_cane = model.body_organ == int(Organ.CANE)
        is_cane[model.leaf_body] = False
        is_spare = model.is_spare()
        rows = rows[(is_cane | is_spare)[body[rows]]]
        place = self.primitives.growth_places(rows)
        is_wood = np.isnan(place)
        self.columns["role"][rows] = np.where(is_wood, int(kernels.WOOD), int(kernels.GROWN))
        self.columns["place"][rows] = np.where(is_wood, 0.0, place)
        stumps = rows[is_spare[body[rows]]]
        self.columns["role"][stumps] = int(kernels.STUMP)
        self.columns["first_wood"][stumps] = model.tree_first[model.body_tree[body[stumps]]]
        wood = rows[is_wood]
        self.wood[body[wood]] = wood

    def _add_pieces(self, stalks: np.ndarray) -> None:
        """Append the parts of stalks that bunches take along, one cluster for each bunch."""
        order = stalks[np.argsort(self.columns["bunch"][stalks], kind="stable")]
        _, first, size = np.unique(self.columns["bunch"][order], return_index=True, return_counts=True)
        self.first = np.append(self.first, len(self.columns["kind"]) + first)
        self.size = np.append(self.size, size)
        self.kind = np.append(self.kind, np.full(len(first), CONE))
        for name, values in self.columns.items():
            added = np.full(len(order), int(kernels.PIECE)) if name == "role" else values[order]
            self.columns[name] = np.concatenate([values, added])

    def __len__(self) -> int:
        return len(self.columns["kind"])


def model_rest(model: Model) -> np.ndarray:
    """Returns the poses [body, 7] of a model at rest."""
    return rest_snapshot(model).body_q.astype(float)


def _segments_above(model: Model) -> np.ndarray:
    """Returns for each segment of a peduncle the number of segments between it and its bunch [body], 0 for other
    bodies."""
    above = np.zeros(len(model.body_mass), int)
    body = model.body_parent[model.bunch_body]
    steps = 0
    while (is_stalk := (body >= 0) & (model.body_organ[body] == int(Organ.PEDUNCLE))).any():
        above[body[is_stalk]] = steps
        body = np.where(is_stalk, model.body_parent[body], -1)
        steps += 1
    return above


def bunches_of_worlds(model: Model, count: int) -> np.ndarray:
    """Returns the bunches [world, i] of each of ``count`` worlds in the order of its trees, -1 after the last one."""
    tree = model.body_tree[model.bunch_body]
    order = np.lexsort((tree // count, tree % count))
    world = tree[order] % count
    rank = np.arange(len(order)) - np.searchsorted(world, world)
    found = np.full((count, int(rank.max(initial=0)) + 1), -1)
    found[world, rank] = order
    return found


def _spares_for_cuts(worlds: Worlds) -> int:
    """Returns the number of spare bodies of each tree that cuts can take; 0 if nothing is cut."""
    spares = worlds.model.tree_spares
    return 0 if worlds.pool is None or not len(spares) else int(spares.min())


def _variants(worlds: Worlds, grass: float) -> tuple[list[_Variant], np.ndarray]:
    """Returns the different worlds, and the number of each world's variant [world]."""
    rigid = worlds.bodies.rigid
    shown = [k for k, one in enumerate(rigid.visuals()) if one.organ != Organ.BUNCH]  # those of the pool are none yet
    visuals = tuple(rigid.visuals()[k] for k in shown)
    bodies = rigid.visual_bodies()[shown]
    trees = np.arange(len(worlds.model.tree_first) // worlds.count) * worlds.count
    items = items_of_trees(worlds.model)
    canes = _spares_for_cuts(worlds) > 0
    known: dict[str, int] = {}
    variants = []
    of_world = np.zeros(worlds.count, np.int32)
    for world in range(worlds.count):
        model = gathered(worlds.model, trees + world, items)
        digest = model.digest()
        if digest not in known:
            known[digest] = len(variants)
            variants.append(_Variant(model, visuals, bodies, grass, canes=canes))
        of_world[world] = known[digest]
    return variants, of_world


class _Tables:
    """Arrays of primitives on the device: those of the variants, and those of the worlds."""

    def __init__(self, worlds: Worlds, variants: list[_Variant], of_world: np.ndarray, device: Any) -> None:
        def on_device(values: np.ndarray, dtype: Any) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        def joined(name: str) -> np.ndarray:
            return np.concatenate([variant.columns[name] for variant in variants])

        ends = np.cumsum([0, *(len(variant) for variant in variants)])
        cluster_ends = np.cumsum([0, *(len(variant.first) for variant in variants)])
        table = self.variants = kernels.Variants()
        table.room = max(len(variant) for variant in variants)
        table.of_world = on_device(of_world, wp.int32)
        table.first_primitive = on_device(ends, wp.int32)
        table.first_cluster = on_device(cluster_ends, wp.int32)
        for name in ("role", "tree", "body", "bunch", "above"):
            setattr(table, name, on_device(joined(name), wp.int32))
        table.offset = on_device(joined("offset"), wp.transform)
        table.place = on_device(joined("place"), float)
        bodies = np.cumsum([0, *(len(variant.wood) for variant in variants[:-1])])
        first_wood = [variant.columns["first_wood"] + start for variant, start in zip(variants, bodies, strict=True)]
        table.first_wood = on_device(np.concatenate(first_wood), wp.int32)
        table.wood = on_device(np.concatenate([variant.wood for variant in variants]), wp.int32)
        self.clusters_room = max(2, *(len(variant.first) for variant in variants))
        """Number of clusters of the largest variant, at least two: a launch with a width of 1 has one dimension."""
        self.clusters = Clusters()
        starts = np.concatenate([variant.first + end for variant, end in zip(variants, ends, strict=False)])
        self.clusters.first = on_device(starts, wp.int32)
        self.clusters.size = on_device(np.concatenate([variant.size for variant in variants]), wp.int32)
        self.clusters.kind = on_device(np.concatenate([variant.kind for variant in variants]), wp.int32)
        self.clusters.shown = wp.zeros(0, dtype=wp.int32, device=device)
        self.local = Shapes()
        self.shapes = Shapes()
        rows = worlds.count * table.room
        outline, hull = textures.leaf_outlines()
        for shapes in (self.local, self.shapes):
            shapes.outline = on_device(outline, wp.int8)
            shapes.hull = on_device(hull, wp.vec2)
        for name in "abcd":
            setattr(self.local, name, on_device(joined(name), wp.vec4))
            setattr(self.shapes, name, wp.zeros(rows, dtype=wp.vec4, device=device))
        self.local.kind = on_device(joined("kind"), wp.int32)
        # of each world, because the kernels of cameras know one number of a primitive
        row = np.minimum(ends[of_world][:, None] + np.arange(table.room), ends[of_world + 1][:, None] - 1).ravel()
        self.shapes.kind = on_device(joined("kind")[row], wp.int32)
        self.looks = kernels.Looks()
        for name, dtype in _LOOKS.items():
            setattr(self.looks, name, on_device(joined(name)[row], dtype))
        self.bounds: list[wp.array] = []
        """Bounds of primitives and clusters in the pictures."""

    def of_worlds(self) -> list[wp.array]:
        """Returns the arrays that grow with the number of worlds."""
        shapes = [getattr(self.shapes, name) for name in ("a", "b", "c", "d", "kind")]
        return [*shapes, *(getattr(self.looks, name) for name in _LOOKS), *self.bounds]
