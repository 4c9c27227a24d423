"""The visible scene as analytic primitives that plant bodies and rigid bodies carry, for cameras and lidars.

:class:`Primitives` is built once from a :class:`~vinesim.scene.model.Model`. :meth:`Primitives.update` then moves it
with the world, in one Warp launch for the clusters of trees and rigid bodies that moved. Plants are read from
:mod:`vinesim.core.disk_cache` if their primitives were computed before. When rigid bodies are added or removed, only
the primitives of rigid bodies are computed again.
"""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np
import warp as wp

from vinesim.core import disk_cache, frames
from vinesim.kernels.graph import outside_captures
from vinesim.kernels.raster import ground, primitives, transform_primitives
from vinesim.kernels.shading import materials
from vinesim.scene import berries
from vinesim.scene.ids import LABEL_STRIDE, NO_OBJECT, Organ
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.terrain import Terrain
from vinesim.scene.values import RigidVisual, Shape, Snapshot, Stalk
from vinesim.sensors.primitives import textures
from vinesim.sensors.primitives.bunch_primitives import Ripeness, bunch_batches, bunch_bodies
from vinesim.sensors.primitives.clutter import clutter_batches
from vinesim.sensors.primitives.distant_rows import distant_batches, shaded_extent
from vinesim.sensors.primitives.dormant_primitives import dormant_batches
from vinesim.sensors.primitives.leaf_area_density import LeafDensity
from vinesim.sensors.primitives.palette_colours import colour_struct
from vinesim.sensors.primitives.plant_primitives import NODE_BEFORE, NODE_BEYOND, cane_batches, leaf_batches
from vinesim.sensors.primitives.primitive_batches import Batch, placeholder_batch
from vinesim.sensors.primitives.primitive_clusters import ClusterLayout, join_rigid, lay_out
from vinesim.sensors.primitives.rigid_primitives import rigid_batches
from vinesim.sensors.primitives.static_primitives import (
    grass_batch,
    litter_batch,
    row_layout,
    trellis_batches,
    wire_batch,
)
from vinesim.sensors.raster.primitive_arrays import CONE, KINDS, LEAF, PrimitiveRasterizer
from vinesim.wires.wire_segments import wire_segments

_SKY_OF_RIGID = 0.7
"""Share of the sky light that reaches robots, people and crates: GUESSED, because it is computed only for plants."""
_RIGID_ROOM = 2048
"""Initial capacity for primitives of rigid bodies."""
_PRIMITIVE_COLUMNS = {
    **{f"local_{name}": wp.vec4 for name in "abcd"},
    **dict.fromkeys("abcd", wp.vec4),
    "tint": wp.vec3,
    "lower": wp.vec3,
    "upper": wp.vec3,
    "sky": wp.float32,
    **dict.fromkeys(("kind", "carrier", "label", "organ", "material"), wp.int32),
}
"""Columns of the table of primitives: name -> type. Columns ``local_*`` are in the frame of the carrier, ``a`` to ``d``
in the world."""
_NOTHING = 1e-6
"""Radius [m], and share of its length, with which a segment that has left the vine is drawn there: too small to be
seen."""
_ONLY_IN_COLUMNS = ("a", "b", "c", "d", "material", "tint", "organ", "label", "carrier")
"""Fields of :class:`ClusterLayout` with a value for each primitive; after loading they are only in the device's
columns."""
_CUT_COLUMNS = ("local_a", "local_b", "local_c", "tint", "material", "sky", "organ", "label", "carrier")
"""Columns of primitives that a cut of a cane changes."""
_CLUSTER_COLUMNS = {**dict.fromkeys(("first", "size", "cluster_kind", "shown"), wp.int32), "ball": wp.vec4}
"""Columns of the table of clusters: name -> type."""
_TEXTURES = (
    "leaf_texture",
    "noise_texture",
    "soil_texture",
    "rows",
    "ground_sky",
    "ground_x",
    "ground_y",
    "ground_cell",
    "ground",
    "colours",
)
"""Fields of ``Materials`` that do not depend on the primitives: textures, rows of vines, visible sky above the ground,
colours."""


class Primitives:
    """All primitives of a vineyard and its actors, posed in the world (see
    :mod:`vinesim.kernels.raster.primitives`)."""

    @outside_captures()
    def __init__(
        self,
        model: Model,
        *,
        grass: float = 90.0,
        device: str = "cpu",
        ripeness: Ripeness | None = None,
    ) -> None:
        """``grass``: tufts per square metre around the vines, 0 for bare ground without fallen leaves; ``ripeness``:
        ripeness of the fruit, None for that of the model's scene."""
        self.model = model
        self.device = device
        self._ripeness = Ripeness.of(model) if ripeness is None else ripeness
        self.rasterizer: PrimitiveRasterizer | None = None
        """Rasteriser that finds the primitive in each pixel of a camera; None: the CPU kernels of
        :class:`~vinesim.sensors.raster.camera_rasterizer.CameraRasterizer`."""
        if device != "cpu":  # programs on a CPU do not load the kernels for GPUs
            from vinesim.sensors.raster.cuda_rasterizer import CudaRasterizer

            self.rasterizer = CudaRasterizer(device)
        self._bodies = len(model.body_mass)
        self._wires = wire_segments(model)
        self.static_carrier = self._bodies + len(self._wires)
        """Index of the carrier (row of poses) of the static scene. Lower indices are bodies of plants, then segments of
        wires; higher indices are rigid bodies."""
        self._wires_away = np.zeros(0, int)
        """Segments of wires [k] that were deflected at the last update."""
        self._visuals: tuple[RigidVisual, ...] = ()
        self._attached = np.ones(len(model.bunch_body), bool)
        self._picked_shapes: dict[int, np.ndarray] = {}
        self._stumps: dict[Stalk, dict[int, np.ndarray]] = {}
        """For each cut stalk, the drawn ends [2, 4] of its peduncle's segments before the cut, by primitive."""
        self.stump_rows = np.zeros(0, np.int64)
        """Primitives [k] of plants that a cut has ever shortened, ascending."""
        self._stump_trees = np.zeros(0, np.int64)
        """Trees [k] whose stumps the last change of rigid bodies has changed."""
        self.stump_keys: list[tuple[int, int, float, float, float]] = []
        """Each carrier and place that the primitives in :attr:`stump_rows` have had: primitive, carrier, and first
        point in the carrier's frame [m]. Pages know primitives by them."""
        self._cuts = np.zeros((0, 3))
        """``Snapshot.stumps`` as drawn."""
        self._whole: dict[int, dict[str, np.ndarray]] = {}
        """Columns of the primitives that cuts of canes have changed, before the cuts, by primitive."""
        self._leaf_off = np.zeros(0, bool)
        """``Snapshot.leaf_off`` as drawn."""
        self._leaves_before: dict[int, np.ndarray] = {}
        """Sizes [2] m of both ends of each primitive of leaves that are off, as they were drawn, by primitive."""
        self._rigid: dict[tuple[Organ, int, int], tuple[tuple[Shape, ...], ClusterLayout | None]] = {}
        """Shapes and clusters of each rigid body, by organ, index and identity of the tuple of shapes."""
        self._moved = np.zeros(0, np.int64)
        outline, hull = textures.leaf_outlines()
        self._outline = wp.array(outline, device=device)
        self._hull = wp.array(hull, dtype=wp.vec2, device=device)
        self._body_q = State.at_rest(model).body_q
        self.pose_version = 0
        """Counter that increases when any primitive moves."""
        self.layout_version = 0
        """Counter that increases when primitives are added or removed."""
        self._columns: dict[str, wp.array] = {}
        """Columns of the tables of primitives and clusters, by name, with spare capacity for rigid bodies."""
        self._poses = np.zeros((0, 7), np.float32)
        self._textures = materials.Materials()
        self.ground = ground_struct(model.terrain, device)
        """The uneven ground; without nodes the ground is the plane z = 0."""
        self._textures.rows = wp.vec2(*row_layout(model))
        self._textures.ground = self.ground
        self._textures.colours = colour_struct(model.look.palette)
        self._textures.leaf_texture, self._textures.noise_texture, self._textures.soil_texture = (
            wp.array(table, dtype=wp.vec4, device=device)
            for table in (textures.leaf_texture(), textures.noise_texture(), textures.soil_texture())
        )
        if ripeness is None:
            baked = disk_cache.load_or_make("primitives", _digest(model, grass, device), lambda: self._bake(grass))
        else:
            baked = self._bake(grass)
        self._open(baked)
        self._pose(np.arange(len(self.cluster_first)))

    # -- reading

    @property
    def count(self) -> int:
        """Number of primitives."""
        return len(self.label)

    def counts_by_kind(self) -> dict[str, int]:
        """Returns the number of primitives of each kind."""
        kinds = self.shapes.kind.numpy()
        return {name: int((kinds == kind).sum()) for name, kind in KINDS.items()}

    def clusters_shown(self) -> np.ndarray:
        """Returns whether each cluster (run of primitives) is drawn [cluster]: all but those of picked bunches at their
        former place on the vine."""
        return self.ball.numpy()[:, 3] > 0.0

    def local_columns(self, rows: slice | np.ndarray) -> dict[str, np.ndarray]:
        """Returns the primitives ``rows`` [n] in the frames of their carriers: ``a`` to ``d`` [n, 4] (see
        :mod:`vinesim.kernels.raster.primitives`), ``tint`` [n, 3], ``sky``, ``material``, ``label``, ``carrier`` [n].
        """
        names = {name: f"local_{name}" for name in "abcd"}
        names |= {name: name for name in ("tint", "sky", "material", "label", "carrier")}
        return {name: self._columns[column].numpy()[rows] for name, column in names.items()}

    def carrier_poses(self, primitive: np.ndarray) -> np.ndarray:
        """Returns the world poses [..., 7] of the carriers of primitives ``primitive`` [...].

        A carrier is the body that moves the primitive: a body of a plant, a segment of wire, a rigid body, or the
        static scene.
        """
        return self._poses[self._carrier.numpy()[primitive]].astype(float)

    # -- building

    def _bake(self, grass: float) -> disk_cache.Arrays:
        """Compute clusters of primitives of plants and the static scene, and the share of the sky that is visible
        through the leaves, both for plants at rest.

        The visible share is computed for each primitive, for the far end of each segment of wood, and for the ground.
        ``grass``: tufts per square metre.
        """
        low, high = _ground_extent(self.model)
        layout = lay_out(self._plant_batches(grass, low, high), [], self.static_carrier)
        baked = {field.name: getattr(layout, field.name) for field in dataclasses.fields(layout)}
        baked["sky"] = np.zeros(len(layout.label), np.float32)
        baked["ground_sky"] = np.zeros((1, 1), np.float32)
        self._open(baked)
        self._pose(np.arange(len(self.cluster_first)))

        posed = self.shapes.a.numpy()
        kind = self.shapes.kind.numpy()
        blades = posed[(layout.organ == int(Organ.LEAF)) & (kind == LEAF)]
        canopy = LeafDensity(blades, low - 3.0, high + 3.0, self.device, self.model.terrain)
        # cones also store the visible sky at their far end, so that light is continuous from segment to segment
        wood = np.flatnonzero(kind == CONE)
        far = canopy.visible_sky(self.shapes.b.numpy()[wood, :3])
        baked["c"][wood, 2:] = np.stack([far, np.ones(len(wood))], 1)
        baked["sky"] = canopy.visible_sky(posed[:, :3])
        low, high = shaded_extent(self.model, low, high)
        step = _ground_step(low, high)
        x, y = np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step))
        height = 0.05 if self.model.terrain is None else self.model.terrain.height(x.ravel(), y.ravel()) + 0.05
        soil = np.stack([x.ravel(), y.ravel(), np.zeros(x.size) + height], 1)
        sky = canopy.visible_sky(soil)
        distant = np.flatnonzero(layout.label % LABEL_STRIDE == NO_OBJECT)
        if len(distant):
            around = LeafDensity(blades, low, high, self.device, self.model.terrain)
            baked["sky"][distant] = around.visible_sky(posed[distant, :3])
            sky = np.minimum(sky, around.visible_sky(soil))
        baked["ground_sky"] = sky.reshape(x.shape)
        return baked

    def _plant_batches(self, grass: float, low: np.ndarray, high: np.ndarray) -> list[Batch]:
        """Returns the primitives of plants and trellis, and of grass and fallen leaves on the ground between the
        corners ``low`` and ``high`` [2] m."""
        model = self.model
        static = self.static_carrier
        batches = [*cane_batches(model), *leaf_batches(model), *dormant_batches(model)]
        every = np.arange(len(model.bunch_body))
        pieces = [bunch_bodies(model, int(bunch)) for bunch in every]
        batches += bunch_batches(model, every, None, pieces, model.body_tree[model.bunch_body], self._ripeness)
        batches += clutter_batches(model, self._wires, static, low, high) + distant_batches(model, static)
        around = [*trellis_batches(model, static), wire_batch(model, self._wires, self._bodies, len(model.tree_first))]
        if grass > 0.0:
            age = float(model.leaf_age.mean()) if len(model.leaf_age) else 0.0
            colours = model.look.palette.ground
            tufts = grass_batch(row_layout(model), low, high, grass, static, model.terrain, colours)
            around += [tufts, litter_batch(low, high, age, static, model.terrain, colours)]
        batches += [b for b in around if b is not None]
        return [b for b in batches if len(b)] or [placeholder_batch(static)]

    def _open(self, baked: disk_cache.Arrays) -> None:
        """Store the result of :meth:`_bake` in this object. Poses are not applied yet.

        ``baked``: arrays that were just computed or read from the disk cache.
        """
        low, high = shaded_extent(self.model, *_ground_extent(self.model))
        self._textures.ground_sky = wp.array(baked["ground_sky"], dtype=float, device=self.device)
        self._textures.ground_x = float(low[0])
        self._textures.ground_y = float(low[1])
        self._textures.ground_cell = float(_ground_step(low, high))
        self.plant_count = len(baked["label"])
        """Number of primitives of plants and the static scene; primitives of rigid bodies have higher indices."""
        names = [field.name for field in dataclasses.fields(ClusterLayout)]
        plants = ClusterLayout(**{name: baked[name] for name in names})
        self._columns = {}
        self._reserve(plants, 0)
        self._write(plants, baked["sky"], 0, 0)
        self._plant_lamps = np.flatnonzero(plants.material == int(materials.LAMP))
        nothing = np.zeros(0, np.float32)  # the device's columns hold these hundreds of megabytes of a large vineyard
        self._plants = dataclasses.replace(plants, **dict.fromkeys(_ONLY_IN_COLUMNS, nothing))
        owners = len(self.model.tree_first) + len(self.model.fixed_start)  # trees, then pieces of wire
        self._by_owner = np.argsort(self._plants.owner, kind="stable")
        self._owner_start = np.searchsorted(self._plants.owner[self._by_owner], np.arange(owners + 1))
        self._poses = np.zeros((0, 7), np.float32)
        self._build(())

    def _build(self, visuals: tuple[RigidVisual, ...]) -> None:
        """Compute the primitives of the rigid bodies ``visuals``, which follow the unchanged primitives of the
        plants."""
        plants = self._plants
        rows = self.plant_count
        clusters = len(plants.first)
        bodies = self._lay_out_rigid(visuals)
        empty = not bodies
        rigid = plants if empty else join_rigid([one for _, one in bodies], [carrier for carrier, _ in bodies], rows)
        if not empty:
            if rows + len(rigid.label) > len(self._columns["label"]) or clusters + len(rigid.first) > len(
                self._columns["first"]
            ):
                self._reserve(plants, len(rigid.label))
            self._write(rigid, np.full(len(rigid.label), _SKY_OF_RIGID, np.float32), rows, clusters)
        parts = [plants] if empty else [plants, rigid]
        joined = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("first", "size", "kind", "owner", "bunch")
        }
        end = rows if empty else rows + len(rigid.label)
        self.label, self.organ = (self._columns[name][:end].numpy() for name in ("label", "organ"))
        self.cluster_first = joined["first"]
        self.cluster_size = joined["size"]
        self.cluster_kind = joined["kind"]
        self._owner = joined["owner"]
        self.cluster_bunch = joined["bunch"]
        self.rigid_clusters = np.arange(clusters, len(self.cluster_first))
        version = np.zeros(len(self.cluster_first), np.int64)
        if self.layout_version:
            version[:clusters] = self.cluster_version[:clusters]
        self.cluster_version = version
        """[cluster] Value of :attr:`pose_version` at the last motion of each cluster."""
        lamps = self._plant_lamps
        if not empty:
            lamps = np.concatenate([lamps, np.flatnonzero(rigid.material == int(materials.LAMP)) + rows])
        self.lamp_primitives = lamps
        """Indices of the primitives that emit light."""
        self._bind()
        poses = np.zeros((self.static_carrier + 1 + len(visuals), 7), np.float32)
        poses[:, 6] = 1.0
        if len(self._poses):
            poses[: self.static_carrier] = self._poses[: self.static_carrier]
        else:
            poses[: self._bodies], poses[self._bodies : self.static_carrier] = self._body_q, self._wires.rest_q
        self._pose_array = wp.array(poses, dtype=wp.transform, device=self.device)
        self._poses = self._pose_array.numpy() if self._pose_array.device.is_cpu else poses
        """[carrier, 7] World pose of each carrier. On a CPU this is the memory that kernels read."""
        self._visuals = visuals
        self._draw_stumps({visual.stalk for visual in visuals if visual.stalk is not None})
        self.layout_version += 1

    def _draw_stumps(self, stalks: set[Stalk]) -> None:
        """Draw of each peduncle that was cut only the stump; the bunch carries the rest. Peduncles that are whole again
        in a world that was set back are drawn whole."""
        changed = stalks ^ self._stumps.keys()
        below = {stalk: self._segments_below(stalk) for stalk in changed}
        cut = np.array([segments[0] for segments in below.values()], int)
        self._stump_trees = np.unique(self.model.body_tree[cut])
        if not changed:
            return
        carrier, kind = (self._columns[name][: self.plant_count].numpy() for name in ("carrier", "kind"))
        ends = [self._columns[f"local_{name}"] for name in "ab"]
        for stalk, segments in below.items():
            if stalk in self._stumps:
                for row, whole in self._stumps.pop(stalk).items():
                    for column, end in zip(ends, whole, strict=True):
                        column[row : row + 1].assign(end[None])
                continue
            kept = self._stumps[stalk] = {}
            for body in segments:
                for row in np.flatnonzero((carrier == body) & (kind == CONE)).tolist():
                    start, end = (column[row : row + 1].numpy()[0].copy() for column in ends)
                    kept[row] = np.stack([start, end])
                    share = stalk.at / float(self.model.body_length[body]) if body == stalk.segment else _NOTHING
                    shown = start + share * (end - start)
                    if body != stalk.segment:
                        start[3] = shown[3] = _NOTHING
                    for column, value in zip(ends, (start, shown), strict=True):
                        column[row : row + 1].assign(value[None])
            self._know([*kept])

    def _draw_cut_canes(self, cuts: np.ndarray) -> np.ndarray:
        """Draw canes as cut by ``cuts`` [k, 3] (``Snapshot.stumps``): the wood of each stump and of the part beyond,
        and the leaves on the stump. Returns the trees [k] that have changed."""
        trees = self.model.body_tree[np.concatenate([self._cuts, cuts])[:, 0].astype(int)]
        self._cuts = cuts.copy()
        for row, columns in self._whole.items():
            for name, value in columns.items():
                self._columns[name][row : row + 1].assign(value)
        self._whole = {}
        carrier = self._columns["carrier"][: self.plant_count].numpy()
        rows = np.flatnonzero(np.isin(carrier, cuts[:, :2].astype(int)))
        whole = {name: self._columns[name].numpy()[rows] for name in _CUT_COLUMNS}
        drawn = {name: values.copy() for name, values in whole.items()}
        base = self.growth_places(rows, whole)
        for segment in np.unique(cuts[:, 1]).astype(int).tolist():
            stumps = cuts[cuts[:, 1] == segment]
            stumps = stumps[np.argsort(stumps[:, 2])]
            here = np.flatnonzero(whole["carrier"] == segment)
            wood = here[np.isnan(base[here])]
            edges = [0.0, *stumps[:, 2].tolist(), float(self.model.body_length[segment])]
            for body, start, end in zip([*stumps[:, 0].astype(int).tolist(), segment], edges, edges[1:], strict=False):
                own = np.flatnonzero(whole["carrier"] == body) if body != segment else wood
                for name in _CUT_COLUMNS if len(wood) else ():
                    if name != "carrier":
                        drawn[name][own] = whole[name][wood[:1]]
                if len(wood):
                    first, last = (whole[f"local_{name}"][wood[0]] for name in "ab")
                    for name, at in (("local_a", start), ("local_b", end)):
                        drawn[name][own] = first + (at / edges[-1]) * (last - first)
                drawn["carrier"][here[(start <= base[here]) & (base[here] < end)]] = body
        columns = [(drawn[name] != whole[name]).T.reshape(-1, len(rows)) for name in drawn if len(rows)]
        changed = np.flatnonzero(np.concatenate(columns).any(0)) if columns else rows
        for k in changed.tolist():
            row = int(rows[k])
            self._whole[row] = {name: values[k : k + 1].copy() for name, values in whole.items()}
            for name in drawn:
                self._columns[name][row : row + 1].assign(drawn[name][k : k + 1])
        self.label, self.organ = (self._columns[name][: self.count].numpy() for name in ("label", "organ"))
        self._know([*self._whole])
        return trees

    def _draw_leaves(self, off: np.ndarray) -> np.ndarray:
        """Draw leaves that are ``off`` [leaf] bool no longer, with their petioles and the small leaves in their axils;
        empty: all are on. Returns the trees [k] that have changed."""
        model = self.model
        none = np.zeros(len(model.leaf_body), bool)
        changed = (off if len(off) else none) != (self._leaf_off if len(self._leaf_off) else none)
        self._leaf_off = off
        leaves = np.flatnonzero(off)
        if len(leaves) == 0 and not self._leaves_before:
            return np.zeros(0, np.int64)
        names = ("carrier", "organ", "kind", "local_a", "local_b")
        carrier, organ, kind, first, last = (self._columns[name].numpy()[: self.plant_count] for name in names)
        for row, sizes in self._leaves_before.items():
            first[row, 3], last[row, 3] = sizes
        segment = np.arange(self.static_carrier + 1)
        segment[self._cuts[:, 0].astype(int)] = self._cuts[:, 1].astype(int)
        gone = {(int(model.leaf_body[k]), model.leaf_base[k].tobytes()) for k in leaves.tolist()}
        rows = np.flatnonzero((organ == int(Organ.LEAF)) & np.isin(segment[carrier], model.leaf_body[leaves]))
        here = segment[carrier[rows]].tolist()
        begins = [first[row, :3].tobytes() for row in rows.tolist()]
        is_petiole = (kind[rows] == CONE).tolist()
        petioles = [k for k, key in enumerate(zip(here, begins, strict=True)) if is_petiole[k] and key in gone]
        blades = {(here[k], last[rows[k], :3].tobytes()) for k in petioles}
        hidden = petioles + [k for k, key in enumerate(zip(here, begins, strict=True)) if key in blades]
        self._leaves_before = {}
        for row in rows[sorted(set(hidden))].tolist():
            self._leaves_before[row] = np.array([first[row, 3], last[row, 3]])
            first[row, 3] = _NOTHING
            if kind[row] == CONE:
                last[row, 3] = _NOTHING
        for name, values in (("local_a", first), ("local_b", last)):
            self._columns[name][: self.plant_count].assign(values)
        self._know([*self._leaves_before])
        return np.unique(model.body_tree[model.leaf_body[changed]])

    def growth_places(self, rows: np.ndarray, columns: dict[str, np.ndarray] | None = None) -> np.ndarray:
        """Returns where the primitives ``rows`` [k] of plants grow along the bodies that carry them [k] m; NaN for the
        wood of the bodies themselves. ``columns``: columns of these primitives; None: the present ones."""
        model = self.model
        if columns is None:
            columns = {name: self._columns[name].numpy()[rows] for name in ("local_a", "local_b", "carrier")}
        start, end = columns["local_a"], columns["local_b"]
        carrier = columns["carrier"]
        place = start[:, 0].astype(float)
        organ, material = (self._columns[name].numpy()[rows] for name in ("organ", "material"))
        is_wood = np.isin(organ, (Organ.CANE, Organ.SPUR)) & (start[:, :3] == 0.0).all(1) & (end[:, 1:3] == 0.0).all(1)
        place[is_wood] = np.nan
        is_node = (organ == int(Organ.CANE)) & (material == int(materials.CANE)) & ~is_wood
        is_swelling = is_node & (start[:, 1:3] == 0.0).all(1)
        before = NODE_BEFORE / (NODE_BEFORE + NODE_BEYOND)
        place[is_swelling] += before * (end[is_swelling, 0] - start[is_swelling, 0])
        place[is_node] = np.maximum(place[is_node], 0.0)
        nodes = model.nodes
        index = self._columns["label"].numpy()[rows] % LABEL_STRIDE
        of_bud = np.flatnonzero(nodes.bud >= 0)  # buds are numbered in the order of their nodes
        for kind, along in ((Organ.NODE, nodes.along), (Organ.BUD, nodes.along[of_bud])):
            here = organ == int(kind)
            place[here] = along[index[here]]
        for body in np.unique(carrier).tolist():
            leaves = np.flatnonzero(model.leaf_body == body)
            here = np.flatnonzero((carrier == body) & (material == int(materials.FOLIAGE)))
            if len(leaves) and len(here):
                away = np.linalg.norm(start[here, None, :3] - model.leaf_pose[leaves, :3], axis=-1)
                # a small leaf stands in the axil of the leaf next to it
                place[here] = model.leaf_base[leaves[away.argmin(1)], 0]
        return place

    def _know(self, rows: list[int]) -> None:
        """Add the present places of primitives of plants to :attr:`stump_keys`, and those before cuts."""
        known = set(self.stump_keys)
        carrier, first = (self._columns[name].numpy() for name in ("carrier", "local_a"))
        for row in rows:
            keys = [(row, int(carrier[row]), *first[row, :3].tolist())]
            if row in self._whole:
                keys.append((row, int(self._whole[row]["carrier"][0]), *self._whole[row]["local_a"][0, :3].tolist()))
            for key in keys:
                if key not in known:
                    known.add(key)
                    self.stump_keys.append(key)
        self.stump_rows = np.union1d(self.stump_rows, rows).astype(np.int64)

    def _segments_below(self, stalk: Stalk) -> list[int]:
        """Returns the segments of a peduncle from the one that was cut to the bunch."""
        model = self.model
        found = [stalk.segment]
        while len(child := np.flatnonzero(model.body_parent == found[-1])) and (
            model.body_organ[child[0]] == int(Organ.PEDUNCLE)
        ):
            found.append(int(child[0]))
        return found

    def _lay_out_rigid(self, visuals: tuple[RigidVisual, ...]) -> list[tuple[int, ClusterLayout]]:
        """Returns carrier (index of the pose that moves a body) and clusters of each rigid body in ``visuals`` that has
        shapes. Clusters of known bodies are taken from the cache."""
        picked = self._picked_bunch_shapes(visuals)
        known = {}
        found = []
        for number, visual in enumerate(visuals):
            key = visual.organ, visual.index, id(visual.shapes)
            if key not in self._rigid:
                batches = rigid_batches(self.model, (visual,), 0, 0, picked, self._ripeness)
                layout = lay_out([], batches, -1) if batches else None
                self._rigid[key] = visual.shapes, layout
            known[key] = self._rigid[key]
            if (layout := known[key][1]) is not None:
                found.append((self.static_carrier + 1 + number, layout))
        self._rigid = known
        return found

    def _reserve(self, plants: ClusterLayout, rigid: int) -> None:
        """Allocate device memory for the plants and for twice ``rigid`` primitives of rigid bodies; values of plants
        are copied."""
        kept = self._columns
        room = max(2 * rigid, _RIGID_ROOM)
        for names, count in ((_PRIMITIVE_COLUMNS, self.plant_count), (_CLUSTER_COLUMNS, len(plants.first))):
            for name, kind in names.items():
                column = wp.zeros(count + room, dtype=kind, device=self.device)
                if name in kept:
                    wp.copy(column, kept[name], count=count)
                self._columns = self._columns | {name: column}

    def _write(self, layout: ClusterLayout, sky: np.ndarray, row: int, cluster: int) -> None:
        """Copy a layout of primitives to the device: primitives from index ``row`` on, clusters from index ``cluster``
        on.

        ``sky``: [primitive] share of the sky that is visible.
        """
        values = {name: getattr(layout, name) for name in ("material", "tint", "organ", "label", "carrier")}
        values |= {f"local_{name}": getattr(layout, name) for name in "abcd"}
        values |= {"kind": np.repeat(layout.kind, layout.size), "sky": sky}
        for name, column in values.items():
            self._columns[name][row : row + len(sky)].assign(np.ascontiguousarray(column))
        values = {"first": layout.first, "size": layout.size, "cluster_kind": layout.kind}
        values["shown"] = _clusters_shown(layout.bunch, self._attached)
        for name, column in values.items():
            end = cluster + len(layout.first)
            self._columns[name][cluster:end].assign(np.ascontiguousarray(column.astype(np.int32)))

    def _bind(self) -> None:
        """Make the kernel structs of the present primitives and clusters, as views of the device's columns."""
        column = {name: self._columns[name][: len(self.label)] for name in _PRIMITIVE_COLUMNS}
        column |= {name: self._columns[name][: len(self.cluster_first)] for name in _CLUSTER_COLUMNS}
        self._local = primitives.Shapes()
        self.shapes = primitives.Shapes()
        self.clusters = primitives.Clusters()
        for name in "abcd":
            setattr(self._local, name, column[f"local_{name}"])
            setattr(self.shapes, name, column[name])
        for table in (self._local, self.shapes):
            table.kind = column["kind"]
            table.outline = self._outline
            table.hull = self._hull
        self.clusters.first = column["first"]
        self.clusters.size = column["size"]
        self.clusters.kind = column["cluster_kind"]
        self.clusters.shown = column["shown"]
        self._carrier = column["carrier"]
        self.labels = column["label"]
        self.organs = column["organ"]
        self.lower = column["lower"]
        self.upper = column["upper"]
        self.ball = column["ball"]
        self.materials = materials.Materials()
        self.materials.material = column["material"]
        self.materials.tint = column["tint"]
        self.materials.sky = column["sky"]
        for name in _TEXTURES:
            setattr(self.materials, name, getattr(self._textures, name))

    def _picked_bunch_shapes(self, visuals: tuple[RigidVisual, ...]) -> dict[int, np.ndarray]:
        """Returns by picked bunch the poses [piece, 7] of its pieces in the bunch's frame, as they were when the bunch
        first appeared as a rigid body."""
        picked = {}
        for bunch in (visual.index for visual in visuals if visual.organ == Organ.BUNCH):
            q = np.asarray(self._body_q[bunch_bodies(self.model, bunch)], float)
            picked[bunch] = self._picked_shapes.get(bunch, frames.compose(frames.inverse(q[0]), q))
        self._picked_shapes = picked
        return picked

    # -- following the world

    @outside_captures()
    def update(self, snapshot: Snapshot, moved: np.ndarray | None = None) -> np.ndarray:
        """Move the primitives to the poses of ``snapshot``, and return the clusters [k] (runs of primitives) that
        moved.

        ``moved``: trees that may have moved since the last call (default: the moved trees of this snapshot and of the
        one before). A caller that skips snapshots must collect the moved trees of all skipped snapshots.
        """
        body_q = snapshot.body_q
        visual_q = np.asarray(snapshot.visual_q, np.float32).reshape(-1, 7)
        trees = np.union1d(snapshot.moved_trees if moved is None else moved, self._moved).astype(np.int64)
        self._moved = np.asarray(snapshot.moved_trees, np.int64)
        new_visuals = snapshot.visuals is not self._visuals
        if new_visuals:
            self._body_q = body_q
            self._build(snapshot.visuals)
            # the snapshot of a new world, or of a world that was set back, may not list all trees that moved
            differs = (np.asarray(body_q, np.float32) != self._poses[: self._bodies]).any(1)
            trees = np.union1d(trees, self.model.body_tree[differs])
            trees = np.union1d(trees, self._stump_trees)
        if not np.array_equal(snapshot.stumps, self._cuts):
            trees = np.union1d(trees, self._draw_cut_canes(np.asarray(snapshot.stumps, float)))
            self._draw_leaves(self._leaf_off)
        if snapshot.leaf_off is not self._leaf_off and not np.array_equal(snapshot.leaf_off, self._leaf_off):
            trees = np.union1d(trees, self._draw_leaves(snapshot.leaf_off))
        attached = np.asarray(snapshot.bunch_attached, bool)
        changed = np.flatnonzero(attached != self._attached)
        if len(changed):
            self._attached = attached.copy()
            self.clusters.shown.assign(_clusters_shown(self.cluster_bunch, attached))
        wires = np.union1d(self._wires_away, snapshot.wires.segment).astype(int)
        pieces = np.unique(self._wires.piece[wires])
        dirty = self._clusters_of(np.concatenate([trees, len(self.model.tree_first) + pieces]))
        if len(changed):
            dirty = np.union1d(dirty, np.flatnonzero(np.isin(self.cluster_bunch, changed)))
        first_visual = self.static_carrier + 1
        if new_visuals or not np.array_equal(self._poses[first_visual:], visual_q):
            dirty = np.concatenate([dirty, self.rigid_clusters])
        if len(dirty):
            self._poses[: self._bodies] = body_q
            self._poses[self._bodies + wires] = self._wires.poses(wires, snapshot.wires)
            self._wires_away = snapshot.wires.segment
            self._poses[first_visual:] = visual_q
            self._pose(dirty)
        return dirty

    def _clusters_of(self, owners: np.ndarray) -> np.ndarray:
        """Returns the clusters [k] that ``owners`` move: indices of trees, or number of trees plus index of a fixed
        piece (wire)."""
        start = self._owner_start[owners]
        size = self._owner_start[owners + 1] - self._owner_start[owners]
        inner = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
        return self._by_owner[np.repeat(start, size) + inner]

    def _pose(self, dirty: np.ndarray) -> None:
        if not self._pose_array.device.is_cpu:
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


def _clusters_shown(bunch: np.ndarray, attached: np.ndarray) -> np.ndarray:
    """Returns 0 for each cluster (run of primitives) whose bunch no longer hangs on its vine, and 1 for all others:
    [cluster] int32.

    ``bunch``: [cluster] bunch of each cluster, -1 for none; ``attached``: [bunch] whether the bunch hangs.
    """
    if not len(attached):
        return np.ones(len(bunch), np.int32)
    return ((bunch < 0) | attached[bunch]).astype(np.int32)


def ground_struct(terrain: Terrain | None, device: str) -> ground.Ground:
    """Returns the kernel struct of the uneven ground; without nodes if ``terrain`` is None."""
    struct = ground.Ground()
    nodes = np.zeros((0, 0), np.float32) if terrain is None else terrain.residual
    struct.residual = wp.array(nodes, dtype=float, device=device)
    if terrain is not None:
        struct.x, struct.y = terrain.origin
        struct.cell = terrain.cell
        struct.slope_x, struct.slope_y = terrain.slope
        struct.low = float(nodes.min())
        struct.high = float(nodes.max())
    return struct


def _ground_extent(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Returns lowest and highest x and y [2] m of the area with vines and posts."""
    spots = np.concatenate([model.tree_pose[:, :2], model.fixed_start[:, :2], model.fixed_end[:, :2]])
    return (spots.min(0), spots.max(0)) if len(spots) else (np.zeros(2), np.zeros(2))


def _ground_step(low: np.ndarray, high: np.ndarray) -> float:
    """Returns the spacing [m] of the table with the share of the sky that is visible from the ground."""
    return max(0.2, float((high - low).max()) / 500.0)


def _digest(model: Model, grass: float, device: str) -> str:
    """Returns a digest, for the disk cache, of all inputs of the plants' primitives.

    It includes the kind of device, because a GPU rounds the visible share of the sky differently.
    """
    package = pathlib.Path(__file__).parents[2]
    folders = ("scene", "sensors/primitives", "sensors/raster", "kernels/raster")
    code = [package / part for part in (*folders, "core/frames.py", "wires/wire_segments.py")]
    shading = package / "kernels" / "shading"
    code += [shading / "materials.py", shading / "shadow_maps.py"]
    where = device.partition(":")[0]
    return disk_cache.source_digest(*code, f"{model.digest()} {grass!r} {berries.VARIETIES!r} {model.look!r}", where)


def rest_snapshot(model: Model, visuals: tuple[RigidVisual, ...] = (), visual_q: np.ndarray | None = None) -> Snapshot:
    """Returns a snapshot of the vineyard at rest, for pictures and tests without physics.

    ``visuals``, ``visual_q``: rigid bodies with visible shapes and their poses [visual, 7].
    """
    return Snapshot(
        time=0.0,
        tick=0,
        body_q=State.at_rest(model).body_q,
        bunch_attached=np.ones(len(model.bunch_body), bool),
        visuals=visuals,
        visual_q=np.zeros((0, 7)) if visual_q is None else np.asarray(visual_q, float),
        moved_trees=np.zeros(0, np.int64),
    )
