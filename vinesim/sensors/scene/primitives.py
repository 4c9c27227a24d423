"""Everything a camera or lidar can see, as one structure of analytic primitives that ride on bodies and links.

:class:`Primitives` is built once from a :class:`~vinesim.scene.model.Model` and follows the world through
:meth:`Primitives.update`: one Warp launch moves the clusters of the trees and links that moved, and nothing else.
"""

from __future__ import annotations

import logging

import numpy as np
import warp as wp

from vinesim import frames
from vinesim.kernels.raster import primitives
from vinesim.kernels.shading import materials, shadow_maps
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.values import RigidVisual, Snapshot
from vinesim.sensors.camera import renderers
from vinesim.sensors.scene import textures
from vinesim.sensors.scene.plant_primitives import Ripeness, bunch_batches, bunch_bodies, cane_batch, leaf_batches
from vinesim.sensors.scene.primitive_batches import CONE, KINDS, LEAF, placeholder_batch
from vinesim.sensors.scene.rigid_primitives import rigid_batches
from vinesim.sensors.scene.static_primitives import grass_batch, litter_batch, row_layout, trellis_batch

log = logging.getLogger(__name__)

_MAX_CLUSTER = 24
"""Most primitives of one cluster."""


class Primitives:
    """All primitives of a vineyard and its actors, posed in the world (see :mod:`vinesim.kernels.raster.primitives`)."""

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
        the fruit: all of it is ripe unless given; ``renderer``: who draws (:mod:`~vinesim.sensors.camera.renderers`).
        """
        self.model, self.device, self._ripeness = model, device, ripeness
        self.rasterizer = renderers.create_rasterizer(renderer, device)
        """Fills the pixels of cameras; None where :class:`~vinesim.sensors.camera.camera.CameraRasterizer` does so itself."""
        bodies = len(model.body_mass)
        self._static_carrier = bodies
        """Carrier of what stands still; links follow it."""
        spots = np.concatenate([model.tree_pose[:, :2], model.fixed_start[:, :2], model.fixed_end[:, :2]])
        low, high = (spots.min(0), spots.max(0)) if len(spots) else (np.zeros(2), np.zeros(2))
        trees = len(model.tree_first)
        batches = [cane_batch(model, bodies), *leaf_batches(model)]
        every = np.arange(len(model.bunch_body))
        pieces = [bunch_bodies(model, bunch) for bunch in every]
        batches += bunch_batches(model, every, None, pieces, model.body_tree[model.bunch_body], ripeness)
        around = [trellis_batch(model, bodies)]
        if grass > 0.0:
            age = float(model.leaf_age.mean()) if len(model.leaf_age) else 0.0
            around += [grass_batch(row_layout(model), low, high, grass, bodies), litter_batch(low, high, age, bodies)]
        batches += [b for b in around if b is not None]
        self._fixed_batches = [b for b in batches if len(b)] or [placeholder_batch(bodies)]
        self._tree_count = trees
        self._links: tuple[RigidVisual, ...] = ()
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
        """Whether each cluster is there at all [cluster]: what has been picked is not."""
        return self.ball.numpy()[:, 3] > 0.0

    def carrier_poses(self, primitive: np.ndarray) -> np.ndarray:
        """Poses [..., 7] m, 1 of what carries some primitives [...]: a plant's body, a link, or the world."""
        return self._poses[self._carrier.numpy()[primitive]].astype(float)

    # -- building

    def _build(self, links: tuple[RigidVisual, ...]) -> None:
        """Lay all primitives out in clusters: plants, what stands still, then links."""
        moving = rigid_batches(
            self.model, links, self._static_carrier + 1, 0, self._picked_bunch_shapes(links), self._ripeness
        )
        batches = self._fixed_batches + moving
        first_rigid = len(self._fixed_batches)
        pieces: dict[str, list[np.ndarray]] = {
            name: [] for name in ("a", "b", "c", "d", "material", "tint", "organ", "label", "carrier")
        }
        kinds, firsts, sizes, owners, of_bunch, rigids = [], [], [], [], [], []
        total = 0
        for number, batch in enumerate(batches):
            order = np.lexsort((batch.bunch, batch.group))
            group, bunch = batch.group[order], batch.bunch[order]
            starts = np.flatnonzero(np.r_[True, (group[1:] != group[:-1]) | (bunch[1:] != bunch[:-1])])
            runs = np.diff(np.r_[starts, len(group)])
            parts = (runs + _MAX_CLUSTER - 1) // _MAX_CLUSTER
            inner = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
            first = np.repeat(starts, parts) + inner * _MAX_CLUSTER
            size = np.minimum(_MAX_CLUSTER, np.repeat(runs, parts) - inner * _MAX_CLUSTER)
            still = number < first_rigid and bool((batch.carrier == self._static_carrier).all())
            firsts.append(total + first)
            sizes.append(size)
            kinds.append(np.full(len(first), batch.kind))
            owners.append(np.full(len(first), -1) if still or number >= first_rigid else group[first])
            of_bunch.append(bunch[first])
            rigids.append(np.full(len(first), number >= first_rigid))
            for name, pile in pieces.items():
                pile.append(getattr(batch, name)[order])
            total += len(batch)
        whole = {name: np.concatenate(pile) for name, pile in pieces.items()}
        if self.layout_version:
            whole["c"][: len(self._baked_c)] = self._baked_c
        self.label, self.organ = whole["label"].astype(np.int32), whole["organ"].astype(np.int32)
        self.cluster_first, self.cluster_size, self.cluster_kind, self._owner, self._cluster_bunch = (
            np.concatenate(x).astype(np.int32) for x in (firsts, sizes, kinds, owners, of_bunch)
        )
        self.rigid_clusters = np.flatnonzero(np.concatenate(rigids))
        self.cluster_version = np.zeros(len(self.cluster_first), np.int64)
        """:attr:`version` at which each cluster moved last."""
        order = np.argsort(self._owner, kind="stable")
        self._by_owner = order
        self._owner_start = np.searchsorted(self._owner[order], np.arange(self._tree_count + 1))
        shown = (
            (self._cluster_bunch < 0) | self._attached[self._cluster_bunch]
            if len(self._attached)
            else np.ones(len(order), bool)
        )

        def array(values: np.ndarray, kind: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=kind, device=self.device)

        self._local, self.shapes, self.clusters, self.materials = (
            primitives.Shapes(),
            primitives.Shapes(),
            primitives.Clusters(),
            materials.Materials(),
        )
        primitive_kind = np.repeat(self.cluster_kind, self.cluster_size)
        for name in "abcd":
            setattr(self._local, name, array(whole[name], wp.vec4))
            setattr(self.shapes, name, wp.empty(total, dtype=wp.vec4, device=self.device))
        for table in (self._local, self.shapes):
            table.kind = array(primitive_kind, wp.int32)
            table.outline, table.hull = self._outline, self._hull
        self.clusters.first, self.clusters.size, self.clusters.kind, self.clusters.shown = (
            array(v.astype(np.int32), wp.int32)
            for v in (self.cluster_first, self.cluster_size, self.cluster_kind, shown)
        )
        self._carrier, self.labels = array(whole["carrier"].astype(np.int32), wp.int32), array(self.label, wp.int32)
        self.organs = array(self.organ, wp.int32)
        self.lower, self.upper = (wp.empty(total, dtype=wp.vec3, device=self.device) for _ in range(2))
        self.ball = wp.empty(len(self.cluster_first), dtype=wp.vec4, device=self.device)
        self.materials.material, self.materials.tint = (
            array(whole["material"].astype(np.int32), wp.int32),
            array(whole["tint"], wp.vec3),
        )
        self.lamp_primitives = np.flatnonzero(whole["material"] == int(materials.LAMP))
        """Primitives that shine."""
        sky = np.full(total, 0.7, np.float32)
        if self.layout_version:
            known = self._sky[: min(len(self._sky), total)]
            sky[: len(known)] = known
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
                setattr(self.materials, name, getattr(self._baked_materials, name))
        self.materials.sky = array(sky, float)
        poses = np.zeros((self._static_carrier + 1 + len(links), 7), np.float32)
        poses[:, 6] = 1.0
        poses[: self._static_carrier] = self._poses[: self._static_carrier] if len(self._poses) else self._rest
        self._poses = poses
        self._pose_array = wp.array(poses, dtype=wp.transform, device=self.device)
        self._links = links
        self.plant_count = total - sum(len(b) for b in moving)
        self.layout_version += 1

    def _picked_bunch_shapes(self, links: tuple[RigidVisual, ...]) -> dict[int, np.ndarray]:
        """Poses [piece, 7] of the pieces of picked bunches in their frames: as they were when first seen loose."""
        picked = {}
        for bunch in (link.index for link in links if link.organ == Organ.BUNCH):
            q = np.asarray(self._body_q[bunch_bodies(self.model, bunch)], float)
            picked[bunch] = self._picked_shapes.get(bunch, frames.compose(frames.inverse(q[0]), q))
        self._picked_shapes = picked
        return picked

    def _bake_sky(self, low: np.ndarray, high: np.ndarray) -> None:
        """Share of the sky that every primitive and the ground see through the leaves, in the shape at rest."""
        self._pose(np.arange(len(self.cluster_first)))
        low, high = low - 3.0, high + 3.0
        cell = max(0.15, float((high - low).max()) / 600.0)
        size = np.maximum(((high - low) / cell).astype(int) + 1, 1)
        corner = np.array([low[0], low[1], 0.0])
        density = np.zeros((*size, int(3.0 / cell) + 1), np.float32)
        foliage = (self.organ == int(Organ.LEAF)) & (self.shapes.kind.numpy() == LEAF)
        posed = self.shapes.a.numpy()
        at = ((posed[foliage, :3] - corner) / cell).astype(int)
        inside = ((at >= 0) & (at < density.shape)).all(1)
        np.add.at(density, tuple(at[inside].T), 1.1 * posed[foliage, 3][inside] ** 2 / cell**3)
        grid = wp.array(density, dtype=float, device=self.device)

        def seen(points: np.ndarray) -> np.ndarray:
            out = wp.zeros(len(points), dtype=float, device=self.device)
            at = wp.array(np.ascontiguousarray(points, np.float32), dtype=wp.vec3, device=self.device)
            wp.launch(
                shadow_maps.sky_visibility,
                len(points),
                inputs=[grid, wp.vec3(*map(float, corner)), float(cell), at],
                outputs=[out],
                device=self.device,
            )
            return out.numpy()

        # light runs on from one piece of wood to the next: cones know the sky at their far end too
        wood = np.flatnonzero(self.shapes.kind.numpy() == CONE)
        wood_c = self._local.c.numpy()
        wood_c[wood, 2:] = np.stack([seen(self.shapes.b.numpy()[wood, :3]), np.ones(len(wood))], 1)
        self._local.c.assign(wood_c)
        self._baked_c = wood_c.copy()
        self._sky = seen(posed[:, :3]) if len(posed) else np.zeros(0, np.float32)
        self.materials.sky = wp.array(self._sky, dtype=float, device=self.device)
        step = max(0.2, float((high - low).max()) / 500.0)
        x, y = np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step))
        ground = seen(np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.05)], 1)).reshape(x.shape)
        baked = self.materials
        baked.rows = wp.vec2(*row_layout(self.model))
        baked.ground_sky = wp.array(ground, dtype=float, device=self.device)
        baked.ground_x, baked.ground_y, baked.ground_cell = float(low[0]), float(low[1]), float(step)
        baked.leaf_texture, baked.noise_texture, baked.soil_texture = (
            wp.array(t, dtype=wp.vec4, device=self.device)
            for t in (textures.leaf_texture(), textures.noise_texture(), textures.soil_texture())
        )
        self._baked_materials = baked

    # -- following the world

    def update(self, view: Snapshot, moved: np.ndarray | None = None) -> np.ndarray:
        """Take over the poses of ``view``; returns the clusters that moved.

        ``moved`` are the trees that may have moved since the last call (default: those of the view and of the view
        before). Whoever skips views must gather it from all of them.
        """
        if view.visuals is not self._links:
            self._body_q = view.body_q
            self._build(view.visuals)
            everything = True
        else:
            everything = False
        attached = np.asarray(view.bunch_attached, bool)
        changed = np.flatnonzero(attached != self._attached)
        if len(changed):
            self._attached = attached.copy()
            shown = self.clusters.shown.numpy()
            shown[:] = (self._cluster_bunch < 0) | self._attached[self._cluster_bunch]
            if self.device != "cpu":
                self.clusters.shown.assign(shown)
        trees = np.union1d(view.moved_trees if moved is None else moved, self._moved).astype(np.int64)
        self._moved = np.asarray(view.moved_trees, np.int64)
        if everything:
            dirty = np.arange(len(self.cluster_first))
        else:
            dirty = self._tree_clusters(trees)
            if len(changed):
                dirty = np.union1d(dirty, np.flatnonzero(np.isin(self._cluster_bunch, changed)))
            link_q = np.asarray(view.visual_q, np.float32).reshape(-1, 7)
            if len(self.rigid_clusters) and not np.array_equal(self._poses[self._static_carrier + 1 :], link_q):
                dirty = np.concatenate([dirty, self.rigid_clusters])
        if len(dirty):
            self._poses[: self._static_carrier] = view.body_q
            self._poses[self._static_carrier + 1 :] = np.asarray(view.visual_q, np.float32).reshape(-1, 7)
            self._pose(dirty)
        return dirty

    def _tree_clusters(self, trees: np.ndarray) -> np.ndarray:
        """Clusters that ride on the given trees, without a loop over trees."""
        start, size = self._owner_start[trees], self._owner_start[trees + 1] - self._owner_start[trees]
        inner = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
        return self._by_owner[np.repeat(start, size) + inner]

    def _pose(self, dirty: np.ndarray) -> None:
        self._pose_array.assign(self._poses)
        wp.launch(
            primitives.pose_clusters,
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


def rest_snapshot(model: Model, links: tuple[RigidVisual, ...] = (), link_q: np.ndarray | None = None) -> Snapshot:
    """A view of the vineyard at rest, for pictures and tests without physics."""
    return Snapshot(
        time=0.0,
        tick=0,
        body_q=State.at_rest(model).body_q,
        bunch_attached=np.ones(len(model.bunch_body), bool),
        visuals=links,
        visual_q=np.zeros((0, 7)) if link_q is None else np.asarray(link_q, float),
        moved_trees=np.zeros(0, np.int64),
    )
