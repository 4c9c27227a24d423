"""Everything a camera or lidar can see, as analytic primitives carried by plant bodies and rigid bodies.

:class:`Primitives` is built once from a :class:`~vinesim.scene.model.Model` and follows the world through
:meth:`Primitives.update`: one Warp launch moves the clusters of the trees and rigid bodies that moved, and nothing
else.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import warp as wp

from vinesim import frames
from vinesim.kernels.raster import primitives, transform_primitives
from vinesim.kernels.shading import materials
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.values import RigidVisual, Snapshot
from vinesim.sensors.raster import renderer_selection
from vinesim.sensors.raster.primitive_arrays import CONE, KINDS, LEAF
from vinesim.sensors.scene import textures
from vinesim.sensors.scene.bunch_primitives import Ripeness, bunch_batches, bunch_bodies
from vinesim.sensors.scene.leaf_area_density import LeafDensity
from vinesim.sensors.scene.plant_primitives import cane_batch, leaf_batches
from vinesim.sensors.scene.primitive_batches import placeholder_batch
from vinesim.sensors.scene.primitive_clusters import ClusterLayout, lay_out
from vinesim.sensors.scene.rigid_primitives import rigid_batches
from vinesim.sensors.scene.static_primitives import grass_batch, litter_batch, row_layout, trellis_batch

log = logging.getLogger(__name__)

_SKY_OF_RIGID = 0.7
"""Share of the sky that robots, people and boxes see: GUESSED, nothing is baked for them."""


class Primitives:
    """All primitives of a vineyard and its actors, posed in the world (see
    :mod:`vinesim.kernels.raster.primitives`)."""

    def __init__(
        self,
        model: Model,
        *,
        grass: float = 90.0,
        device: str = "cpu",
        ripeness: Ripeness | None = None,
        renderer: str = "warp",
    ) -> None:
        """``grass``: tufts per square metre around the vines, 0 for bare ground without fallen leaves; ``ripeness`` of
        the fruit: all of it is ripe unless given; ``renderer``: see :mod:`~vinesim.sensors.raster.renderer_selection`.
        """
        self.model, self.device, self._ripeness = model, device, ripeness
        self.rasterizer = renderer_selection.create_rasterizer(renderer, device)
        """Fills the pixels of cameras; None where :class:`~vinesim.sensors.raster.camera_rasterizer.CameraRasterizer`
        does so itself."""
        bodies = len(model.body_mass)
        self._static_carrier = bodies
        """Carrier of the static scene; those of rigid bodies follow it."""
        spots = np.concatenate([model.tree_pose[:, :2], model.fixed_start[:, :2], model.fixed_end[:, :2]])
        low, high = (spots.min(0), spots.max(0)) if len(spots) else (np.zeros(2), np.zeros(2))
        trees = len(model.tree_first)
        batches = [cane_batch(model, bodies), *leaf_batches(model)]
        every = np.arange(len(model.bunch_body))
        pieces = [bunch_bodies(model, int(bunch)) for bunch in every]
        batches += bunch_batches(model, every, None, pieces, model.body_tree[model.bunch_body], ripeness)
        around = [trellis_batch(model, bodies)]
        if grass > 0.0:
            age = float(model.leaf_age.mean()) if len(model.leaf_age) else 0.0
            around += [grass_batch(row_layout(model), low, high, grass, bodies), litter_batch(low, high, age, bodies)]
        batches += [b for b in around if b is not None]
        self._fixed_batches = [b for b in batches if len(b)] or [placeholder_batch(bodies)]
        self._tree_count = trees
        self._visuals: tuple[RigidVisual, ...] = ()
        self._attached = np.ones(len(model.bunch_body), bool)
        self._picked_shapes: dict[int, np.ndarray] = {}
        self._moved = np.zeros(0, np.int64)
        outline, hull = textures.leaf_outlines()
        self._outline, self._hull = wp.array(outline, device=device), wp.array(hull, dtype=wp.vec2, device=device)
        self._rest = self._body_q = State.at_rest(model).body_q
        self.pose_version = 0
        """Counts changes of any pose."""
        self.layout_version = 0
        """Counts changes of the set of primitives."""
        self._poses = np.zeros((0, 7), np.float32)
        self._build(())
        self._bake_sky(low, high)
        self._pose(np.arange(len(self.cluster_first)))

    # -- reading

    @property
    def count(self) -> int:
        """How many primitives there are."""
        return len(self.label)

    def counts_by_kind(self) -> dict[str, int]:
        """How many there are of each kind."""
        kinds = self.shapes.kind.numpy()
        return {name: int((kinds == kind).sum()) for name, kind in KINDS.items()}

    def clusters_shown(self) -> np.ndarray:
        """Whether each cluster is drawn [cluster]; those of picked bunches are not."""
        return self.ball.numpy()[:, 3] > 0.0

    def carrier_poses(self, primitive: np.ndarray) -> np.ndarray:
        """Poses [..., 7] m, 1 of the carriers of some primitives [...]: a plant's body, a rigid body, or the world."""
        return self._poses[self._carrier.numpy()[primitive]].astype(float)

    # -- building

    def _build(self, visuals: tuple[RigidVisual, ...]) -> None:
        """Lay all primitives out in clusters: plants, the static scene, then rigid bodies."""
        moving = rigid_batches(
            self.model, visuals, self._static_carrier + 1, 0, self._picked_bunch_shapes(visuals), self._ripeness
        )
        layout = lay_out(self._fixed_batches, moving, self._static_carrier)
        if self.layout_version:
            layout.c[: len(self._baked_c)] = self._baked_c
        self.label, self.organ = layout.label, layout.organ
        self.cluster_first, self.cluster_size, self.cluster_kind = layout.first, layout.size, layout.kind
        self._owner, self._cluster_bunch = layout.owner, layout.bunch
        self.rigid_clusters = np.flatnonzero(layout.is_rigid)
        self.cluster_version = np.zeros(len(self.cluster_first), np.int64)
        """:attr:`pose_version` at which each cluster moved last."""
        self._by_owner = np.argsort(self._owner, kind="stable")
        self._owner_start = np.searchsorted(self._owner[self._by_owner], np.arange(self._tree_count + 1))
        self._upload(layout)
        self._upload_materials(layout)
        poses = np.zeros((self._static_carrier + 1 + len(visuals), 7), np.float32)
        poses[:, 6] = 1.0
        poses[: self._static_carrier] = self._poses[: self._static_carrier] if len(self._poses) else self._rest
        self._poses = poses
        self._pose_array = wp.array(poses, dtype=wp.transform, device=self.device)
        self._visuals = visuals
        self.plant_count = len(layout.label) - sum(len(b) for b in moving)
        self.layout_version += 1

    def _array(self, values: np.ndarray, kind: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=kind, device=self.device)

    def _upload(self, layout: ClusterLayout) -> None:
        """Device arrays of the primitives and clusters; poses are not yet applied."""
        total = len(layout.label)
        self._local, self.shapes, self.clusters = primitives.Shapes(), primitives.Shapes(), primitives.Clusters()
        for name in "abcd":
            setattr(self._local, name, self._array(getattr(layout, name), wp.vec4))
            setattr(self.shapes, name, wp.empty(total, dtype=wp.vec4, device=self.device))
        primitive_kind = np.repeat(layout.kind, layout.size)
        for table in (self._local, self.shapes):
            table.kind = self._array(primitive_kind, wp.int32)
            table.outline, table.hull = self._outline, self._hull
        self.clusters.first, self.clusters.size, self.clusters.kind, self.clusters.shown = (
            self._array(v.astype(np.int32), wp.int32)
            for v in (layout.first, layout.size, layout.kind, self._cluster_shown())
        )
        self._carrier, self.labels, self.organs = (
            self._array(v, wp.int32) for v in (layout.carrier, layout.label, layout.organ)
        )
        self.lower, self.upper = (wp.empty(total, dtype=wp.vec3, device=self.device) for _ in range(2))
        self.ball = wp.empty(len(layout.first), dtype=wp.vec4, device=self.device)

    def _cluster_shown(self) -> np.ndarray:
        """Whether each cluster is to be drawn [cluster]: not those of bunches that no longer hang."""
        if not len(self._attached):
            return np.ones(len(self._cluster_bunch), bool)
        return (self._cluster_bunch < 0) | self._attached[self._cluster_bunch]

    def _upload_materials(self, layout: ClusterLayout) -> None:
        """Material, colour and visible sky of each primitive; baked values are kept."""
        self.materials = materials.Materials()
        self.materials.material = self._array(layout.material, wp.int32)
        self.materials.tint = self._array(layout.tint, wp.vec3)
        self.lamp_primitives = np.flatnonzero(layout.material == int(materials.LAMP))
        """Primitives that emit light."""
        sky = np.full(len(layout.label), _SKY_OF_RIGID, np.float32)
        if self.layout_version:
            known = self._sky[: min(len(self._sky), len(sky))]
            sky[: len(known)] = known
            baked = self._baked_materials
            for name in (
                "leaf_texture",
                "noise_texture",
                "soil_texture",
                "rows",
                "ground_sky",
                "ground_x",
                "ground_y",
                "ground_cell",
            ):
                setattr(self.materials, name, getattr(baked, name))
        self.materials.sky = self._array(sky, float)

    def _picked_bunch_shapes(self, visuals: tuple[RigidVisual, ...]) -> dict[int, np.ndarray]:
        """Poses [piece, 7] of the pieces of picked bunches in their frames: as they were when first seen loose."""
        picked = {}
        for bunch in (visual.index for visual in visuals if visual.organ == Organ.BUNCH):
            q = np.asarray(self._body_q[bunch_bodies(self.model, bunch)], float)
            picked[bunch] = self._picked_shapes.get(bunch, frames.compose(frames.inverse(q[0]), q))
        self._picked_shapes = picked
        return picked

    def _bake_sky(self, low: np.ndarray, high: np.ndarray) -> None:
        """Share of the sky that every primitive and the ground see through the leaves, in the shape at rest."""
        self._pose(np.arange(len(self.cluster_first)))
        low, high = low - 3.0, high + 3.0
        posed = self.shapes.a.numpy()
        is_blade = (self.organ == int(Organ.LEAF)) & (self.shapes.kind.numpy() == LEAF)
        canopy = LeafDensity(posed[is_blade], low, high, self.device)
        # light runs on from one piece of wood to the next: cones know the sky at their far end too
        wood = np.flatnonzero(self.shapes.kind.numpy() == CONE)
        wood_c = self._local.c.numpy()
        wood_c[wood, 2:] = np.stack([canopy.visible_sky(self.shapes.b.numpy()[wood, :3]), np.ones(len(wood))], 1)
        self._local.c.assign(wood_c)
        self._baked_c = wood_c.copy()
        self._sky = canopy.visible_sky(posed[:, :3]) if len(posed) else np.zeros(0, np.float32)
        baked = self.materials
        baked.sky = wp.array(self._sky, dtype=float, device=self.device)
        step = max(0.2, float((high - low).max()) / 500.0)
        x, y = np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step))
        ground = canopy.visible_sky(np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.05)], 1)).reshape(x.shape)
        baked.rows = wp.vec2(*row_layout(self.model))
        baked.ground_sky = wp.array(ground, dtype=float, device=self.device)
        baked.ground_x, baked.ground_y, baked.ground_cell = float(low[0]), float(low[1]), float(step)
        baked.leaf_texture, baked.noise_texture, baked.soil_texture = (
            wp.array(table, dtype=wp.vec4, device=self.device)
            for table in (textures.leaf_texture(), textures.noise_texture(), textures.soil_texture())
        )
        self._baked_materials = baked

    # -- following the world

    def update(self, snapshot: Snapshot, moved: np.ndarray | None = None) -> np.ndarray:
        """Take over the poses of ``snapshot``; returns the clusters [k] that moved.

        ``moved`` are the trees that may have moved since the last call (default: those of this snapshot and
        the one before). A caller that skips snapshots must gather them from all of these.
        """
        if snapshot.visuals is not self._visuals:
            self._body_q = snapshot.body_q
            self._build(snapshot.visuals)
            everything = True
        else:
            everything = False
        attached = np.asarray(snapshot.bunch_attached, bool)
        changed = np.flatnonzero(attached != self._attached)
        if len(changed):
            self._attached = attached.copy()
            shown = self.clusters.shown.numpy()
            shown[:] = self._cluster_shown()
            if self.device != "cpu":
                self.clusters.shown.assign(shown)
        trees = np.union1d(snapshot.moved_trees if moved is None else moved, self._moved).astype(np.int64)
        self._moved = np.asarray(snapshot.moved_trees, np.int64)
        if everything:
            dirty = np.arange(len(self.cluster_first))
        else:
            dirty = self._tree_clusters(trees)
            if len(changed):
                dirty = np.union1d(dirty, np.flatnonzero(np.isin(self._cluster_bunch, changed)))
            visual_q = np.asarray(snapshot.visual_q, np.float32).reshape(-1, 7)
            if len(self.rigid_clusters) and not np.array_equal(self._poses[self._static_carrier + 1 :], visual_q):
                dirty = np.concatenate([dirty, self.rigid_clusters])
        if len(dirty):
            self._poses[: self._static_carrier] = snapshot.body_q
            self._poses[self._static_carrier + 1 :] = np.asarray(snapshot.visual_q, np.float32).reshape(-1, 7)
            self._pose(dirty)
        return dirty

    def _tree_clusters(self, trees: np.ndarray) -> np.ndarray:
        """Clusters that the given trees [k] move."""
        start, size = self._owner_start[trees], self._owner_start[trees + 1] - self._owner_start[trees]
        inner = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
        return self._by_owner[np.repeat(start, size) + inner]

    def _pose(self, dirty: np.ndarray) -> None:
        self._pose_array.assign(self._poses)
        wp.launch(
            transform_primitives.pose_clusters,
            len(dirty),
            inputs=[
                self._local,
                self.clusters,
                self._carrier,
                wp.array(dirty.astype(np.int32), device=self.device),
                self._pose_array,
            ],
            outputs=[self.shapes.a, self.shapes.b, self.shapes.c, self.shapes.d, self.lower, self.upper, self.ball],
            device=self.device,
        )
        self.pose_version += 1
        self.cluster_version[dirty] = self.pose_version


def rest_snapshot(model: Model, visuals: tuple[RigidVisual, ...] = (), visual_q: np.ndarray | None = None) -> Snapshot:
    """Snapshot of the vineyard at rest, for pictures and tests without physics."""
    return Snapshot(
        time=0.0,
        tick=0,
        body_q=State.at_rest(model).body_q,
        bunch_attached=np.ones(len(model.bunch_body), bool),
        visuals=visuals,
        visual_q=np.zeros((0, 7)) if visual_q is None else np.asarray(visual_q, float),
        moved_trees=np.zeros(0, np.int64),
    )
