"""Ground truth of pictures: visible bunches, their occlusion, boxes and cut points, and optical flow.

The ground truth is computed from the primitives, not from the picture, so noise and range limits of a camera do not
affect it. Ids are equal on all clients: bunches have their indices in the model, and berries their indices in the
result of :func:`vinesim.scene.berries.lay_out_berries`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np

from vinesim.core import frames
from vinesim.kernels.raster.primitives import FAR
from vinesim.scene.camera_geometry import pixel_rays, project_points
from vinesim.scene.ids import LABEL_STRIDE, Organ, label
from vinesim.scene.model import Model
from vinesim.scene.values import MIN_BERRY_PIXELS, Box, BunchTruth, CameraFrame, CameraInfo, Snapshot
from vinesim.sensors.primitives.ray_caster import RayCaster
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.camera_rasterizer import CameraRasterizer, pinhole
from vinesim.sensors.raster.lens_map import lens_map
from vinesim.sensors.raster.primitive_arrays import CONE, SPHEROID


@dataclasses.dataclass(frozen=True, slots=True)
class Detection:
    """One visible bunch in one picture."""

    bunch: int
    """Index of the bunch in the model."""
    pixels: int
    """Number of pixels that show the bunch."""
    box: Box
    """Bounding box of the pixels that show the bunch."""
    distance: float
    """Median measured depth [m] of these pixels; NaN if none of them has a measurement."""


def detect_bunches(frame: CameraFrame) -> tuple[Detection, ...]:
    """Returns a detection for every bunch that is visible in at least one pixel, sorted by index."""
    rows, columns = np.nonzero(frame.labels // LABEL_STRIDE == int(Organ.BUNCH))
    index = frame.labels[rows, columns] % LABEL_STRIDE
    order = np.argsort(index, kind="stable")
    index = index[order]
    rows = rows[order]
    columns = columns[order]
    edges = np.flatnonzero(np.diff(index, prepend=-1, append=-1))
    sightings = []
    for first, last in itertools.pairwise(edges):
        r = rows[first:last]
        c = columns[first:last]
        depth = frame.depth[r, c]
        depth = depth[np.isfinite(depth)]
        sightings.append(
            Detection(
                int(index[first]),
                int(last - first),
                (int(c.min()), int(r.min()), int(c.max()), int(r.max())),
                float(np.median(depth)) if len(depth) else float("nan"),
            )
        )
    return tuple(sightings)


@dataclasses.dataclass(frozen=True, slots=True)
class PixelBuffers:
    """Exact buffers of an ideal camera at one instant: primitive, depth, label and berry in each pixel."""

    info: CameraInfo
    pose: np.ndarray
    """[7] Pose of the optical frame in the world."""
    primitive: np.ndarray
    """[height, width] int32, index of the primitive; -1 for the sky, -2 for the ground."""
    depth: np.ndarray
    """[height, width] float32 m, depth along the optical axis, exact to 2 um; +Inf for the sky."""
    labels: np.ndarray
    """[height, width] int32, labels as defined by :func:`vinesim.scene.ids.label`."""
    berries: np.ndarray
    """[height, width] int32, index of the berry in its bunch; -1 where no berry is visible."""
    carrier_poses: np.ndarray
    """[primitive, 7] Pose of the body that carries each primitive, for :func:`optical_flow`."""
    layout_version: int
    """Value of :attr:`Primitives.layout_version`; indices of primitives are comparable only between buffers with equal
    values."""


def render_buffers(primitives: Primitives, info: CameraInfo, pose: np.ndarray) -> PixelBuffers:
    """Render exact buffers, without noise, of a camera with intrinsics ``info`` (and lens distortion) at ``pose`` [7],
    the pose of its optical frame."""
    view = lens_map(info)
    shape = view.pinhole.height, view.pinhole.width
    seen = CameraRasterizer(shape[1], shape[0], primitives.device)
    seen.draw(primitives, pinhole(view.pinhole, pose))
    primitive, depth, labels = (
        view.nearest(a.numpy().reshape(shape).copy()) for a in (seen.primitive, seen.depth, seen.labels)
    )
    depth[primitive == -1] = np.inf
    numbers = np.append(_berry_numbers(primitives), [-1, -1])  # the last two entries are for sky (-1) and ground (-2)
    everything = primitives.carrier_poses(np.arange(primitives.count))
    return PixelBuffers(
        info, np.array(pose, float), primitive, depth, labels, numbers[primitive], everything, primitives.layout_version
    )


def _primitives_shown(primitives: Primitives) -> np.ndarray:
    """Returns [primitive] whether each primitive is drawn."""
    return np.repeat(primitives.clusters_shown(), primitives.cluster_size)


def _berry_numbers(primitives: Primitives) -> np.ndarray:
    """Returns [primitive] the index of each berry in its bunch, -1 for primitives that are not berries."""
    kind = np.repeat(primitives.cluster_kind, primitives.cluster_size)
    fruit = np.flatnonzero((kind == SPHEROID) & (primitives.organ == int(Organ.BUNCH)) & _primitives_shown(primitives))
    bunch = primitives.label[fruit]
    starts = np.flatnonzero(np.diff(bunch, prepend=-1))
    numbers = np.full(primitives.count, -1, np.int32)
    numbers[fruit] = np.arange(len(fruit)) - np.repeat(starts, np.diff(np.append(starts, len(fruit))))
    return numbers


def bunch_truths(
    primitives: Primitives, snapshot: Snapshot, seen: PixelBuffers, caster: RayCaster | None = None
) -> tuple[BunchTruth, ...]:
    """Returns the ground truth of every bunch that is in the view, even if fully occluded, sorted by index.

    ``seen``: buffers of the view; ``primitives`` must be posed to the ``snapshot`` at which ``seen`` was rendered;
    ``caster``: ray caster of ``primitives``, which is built if not given.
    """
    info = seen.info
    drawn = lens_map(seen.info).pinhole
    alone = CameraRasterizer(drawn.width, drawn.height, primitives.device)
    lens = pinhole(drawn, seen.pose)
    near = primitives.label[primitives.cluster_first][alone.cluster_distances(primitives, lens) < float(FAR)]
    bunches = np.unique(near[near // LABEL_STRIDE == int(Organ.BUNCH)]) % LABEL_STRIDE
    cuts = _cut_points(primitives.model, snapshot, bunches)
    clear = _visible_cut_points(caster or RayCaster(primitives), seen.pose[:3], cuts)
    look = _Look(primitives, snapshot, info, seen.pose, alone, seen.primitive, seen.labels)
    return tuple(look.bunches(bunches, cuts, clear))


def visible_bunches(
    primitives: Primitives, snapshot: Snapshot, info: CameraInfo, pose: np.ndarray, drawn: CameraRasterizer
) -> tuple[BunchTruth, ...]:
    """Returns the ground truth of every bunch that is visible in at least one pixel, sorted by index, fast enough for
    live pictures.

    ``drawn``: rasteriser that has drawn the ``primitives``, posed to ``snapshot``, as seen from ``pose`` [7]. Its keys
    (depth and primitive of each pixel) are overwritten. A cut point counts as visible if its pixel shows the bunch's
    own peduncle; this test needs no rays.
    """
    view = lens_map(info)
    shape = view.pinhole.height, view.pinhole.width
    primitive, labels = (view.nearest(a.numpy().reshape(shape)) for a in (drawn.primitive, drawn.labels))
    shown = np.unique(labels)
    bunches = shown[shown // LABEL_STRIDE == int(Organ.BUNCH)] % LABEL_STRIDE
    cuts = _cut_points(primitives.model, snapshot, bunches)
    look = _Look(primitives, snapshot, info, np.asarray(pose, float), drawn, primitive, labels)
    clear = {bunch for bunch, cut in cuts.items() if look.shows_peduncle(bunch, cut)}
    return tuple(look.bunches(bunches, cuts, clear))


@dataclasses.dataclass(frozen=True)
class _Look:
    """One view of a camera, for the computation of its ground truth. ``rasterizer`` draws single bunches without their
    surroundings."""

    primitives: Primitives
    snapshot: Snapshot
    info: CameraInfo
    pose: np.ndarray
    rasterizer: CameraRasterizer
    primitive: np.ndarray
    labels: np.ndarray

    def pixel(self, point: np.ndarray) -> np.ndarray | None:
        """Returns column and row [2] px of the image of ``point`` [3] m in the world; None for a point behind the
        camera."""
        local = frames.rotate(frames.conjugate(self.pose[3:]), point - self.pose[:3])
        return project_points(local, self.info) if local[2] > 0.0 else None

    def shows_peduncle(self, bunch: int, point: np.ndarray) -> bool:
        """Returns whether the pixel onto which ``point`` [3] m projects shows the peduncle of ``bunch``."""
        pixel = self.pixel(point)
        if pixel is None or not _inside(pixel, self.info):
            return False
        column, row = np.clip(np.rint(pixel).astype(int), 0, (self.info.width - 1, self.info.height - 1))
        return bool(self.labels[row, column] == label(Organ.PEDUNCLE, bunch))

    def bunches(self, bunches: np.ndarray, cuts: dict[int, np.ndarray], clear: set[int]) -> Iterator[BunchTruth]:
        """Yield the ground truth of those ``bunches`` [k] that are in the view, even if fully occluded.

        ``cuts``: cut points [3] m by bunch; ``clear``: bunches with a visible cut point.
        """
        p = self.primitives
        snapshot = self.snapshot
        model = self.primitives.model
        view = lens_map(self.info)
        lens = pinhole(view.pinhole, self.pose)
        named = p.label[p.cluster_first]
        fruit = np.flatnonzero((named // LABEL_STRIDE == int(Organ.BUNCH)) & p.clusters_shown())
        fruit = fruit[np.isin(named[fruit] % LABEL_STRIDE, bunches)]
        count = np.bincount(self.primitive[self.primitive >= 0], minlength=p.count)
        a = p.shapes.a.numpy()
        b = p.shapes.b.numpy()
        loose = {one.index: k for k, one in enumerate(snapshot.visuals) if one.organ == Organ.BUNCH}
        for bunch in np.unique(named[fruit] % LABEL_STRIDE).tolist():
            mine = fruit[named[fruit] % LABEL_STRIDE == bunch]
            whole = view.nearest(self.rasterizer.coverage(p, lens, mine))
            box = _box_of(whole, (0, 0, 0, 0))
            if box is None:
                continue
            window = np.s_[box[1] : box[3] + 1, box[0] : box[2] + 1]
            visible = self.labels[window] == label(Organ.BUNCH, bunch)
            clusters = zip(p.cluster_first[mine], p.cluster_size[mine], strict=True)
            parts = np.concatenate([first + np.arange(size) for first, size in clusters])
            kind = np.repeat(p.cluster_kind[mine], p.cluster_size[mine])
            attached = bool(snapshot.bunch_attached[bunch])
            turn = (snapshot.body_q[model.bunch_body[bunch]] if attached else snapshot.visual_q[loose[bunch]])[3:]
            frame, size = _box_around(a[parts], b[parts], kind, turn)
            pixel = self.pixel(cuts[bunch]) if attached else None
            yield BunchTruth(
                bunch=bunch,
                variety=int(model.bunch_variety[bunch]),
                tree=int(model.body_tree[model.bunch_body[bunch]]),
                attached=attached,
                amodal_box=box,
                amodal=whole[window].copy(),
                visible=visible,
                visible_box=_box_of(visible, box),
                berries_seen=int((count[parts[kind == SPHEROID]] >= MIN_BERRY_PIXELS).sum()),
                berries=int(model.bunch_berries[bunch]),
                frame=frame,
                size=size,
                cut=cuts.get(bunch),
                cut_pixel=pixel,
                cut_seen=pixel is not None and _inside(pixel, self.info) and bunch in clear,
            )


def _cut_points(model: Model, snapshot: Snapshot, bunches: np.ndarray) -> dict[int, np.ndarray]:
    """Returns the cut points [3] m, by bunch, of those ``bunches`` [k] that still hang on their vines."""
    hanging = bunches[snapshot.bunch_attached[bunches]].tolist()
    return {bunch: cut_point(model, snapshot.body_q, bunch) for bunch in hanging}


def cut_point(model: Model, body_q: np.ndarray, bunch: int) -> np.ndarray:
    """Returns the cut point [3] m of a hanging bunch, the middle of its peduncle's axis; ``body_q``: [body, 7] world
    poses."""
    stalk = []
    body = int(model.body_parent[model.bunch_body[bunch]])
    while body >= 0 and model.body_organ[body] == int(Organ.PEDUNCLE):
        stalk.insert(0, body)
        body = int(model.body_parent[body])
    if not stalk:  # the bunch sits on the cane itself
        return np.asarray(body_q[model.bunch_body[bunch], :3], float)
    ends = np.cumsum(model.body_length[stalk], dtype=float)
    half = 0.5 * ends[-1]
    piece = int(np.searchsorted(ends, half))
    along = half - (ends[piece - 1] if piece else 0.0)
    pose = np.asarray(body_q[stalk[piece]], float)
    return pose[:3] + frames.rotate(pose[3:], np.array([along, 0.0, 0.0]))


def optical_flow(first: PixelBuffers, second: PixelBuffers) -> tuple[np.ndarray, np.ndarray]:
    """Returns the optical flow from the first to the second picture, by motion of camera and objects, and visibility.

    The flow [height, width, 2] is the displacement [px] of each pixel's surface point, in columns and rows. It is exact
    for the point that the pixel's ray hits, which moves with its body, and NaN for the sky and for points that are
    behind the camera in the second picture. The visibility [height, width] tells whether the second picture shows the
    same primitive at the displaced position.
    """
    if first.layout_version != second.layout_version:
        raise ValueError(
            "bodies were added or removed between the two pictures; optical flow needs equal bodies in both"
        )
    info = first.info
    other = second.info
    v, u = np.nonzero(np.isfinite(first.depth))
    primitive = first.primitive[v, u]
    z = first.depth[v, u].astype(float)
    across, down = (
        ((u - info.cx) / info.fx, (v - info.cy) / info.fy)
        if not info.distortion
        else (rays[v, u].astype(float) for rays in pixel_rays(info))
    )
    local = np.stack([across * z, down * z, z], 1)
    point = first.pose[:3] + frames.rotate(first.pose[3:], local)
    solid = primitive >= 0  # the ground does not move
    before, after = (one.carrier_poses[primitive[solid]] for one in (first, second))
    attached = frames.rotate(frames.conjugate(before[:, 3:]), point[solid] - before[:, :3])
    moved = point.copy()
    # computed as a difference, so that rounding does not displace points that did not move
    still = frames.rotate(before[:, 3:], attached) + before[:, :3]
    moved[solid] += frames.rotate(after[:, 3:], attached) + after[:, :3] - still
    there = project_points(frames.rotate(frames.conjugate(second.pose[3:]), moved - second.pose[:3]), other)
    shift = np.full((info.height, info.width, 2), np.nan)
    shift[v, u] = there - np.stack([u, v], 1)
    shown = np.zeros((info.height, info.width), bool)
    near = np.nan_to_num(np.round(there), nan=-1.0, posinf=-1.0, neginf=-1.0)
    inside = (near >= 0).all(1) & (near[:, 0] < other.width) & (near[:, 1] < other.height)
    column, row = near[inside].astype(int).T
    shown[v[inside], u[inside]] = second.primitive[row, column] == primitive[inside]
    return shift, shown


def _visible_cut_points(caster: RayCaster, eye: np.ndarray, points: dict[int, np.ndarray]) -> set[int]:
    """Returns the bunches whose cut point is visible from ``eye`` [3] m, or hidden only by the bunch's own peduncle.

    ``points``: cut points [3] m by bunch.
    """
    if not points:
        return set()
    bunch = np.array(list(points))
    distance, primitive = caster.cast(eye, np.stack(list(points.values())) - eye)
    p = caster.primitives
    own = (primitive >= 0) & (p.label[np.maximum(primitive, 0)] == label(Organ.PEDUNCLE, 0) + bunch)
    return set(bunch[(own & (distance < 1.0)) | ~(distance < 1.0)].tolist())


def _box_around(a: np.ndarray, b: np.ndarray, kind: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pose [7] and edge lengths [3] m of the smallest box with orientation ``turn`` (quaternion) that
    contains spheroids and cones [k].

    ``a``, ``b``: vectors of the primitives [k, 4]; ``kind``: [k].
    """
    back = frames.conjugate(np.asarray(turn, float))
    start, end = (frames.rotate(back, v[:, :3].astype(float)) for v in (a, b))  # for a spheroid, end is its axis
    radius = a[:, 3:].astype(float)
    other = b[:, 3:].astype(float)
    round_one = (kind == SPHEROID)[:, None]
    half = radius * np.sqrt(1.0 + np.where(round_one, (other**2 - 1.0) * end**2, 0.0))
    cone = (kind == CONE)[:, None]
    low = np.where(cone, np.minimum(start - radius, end - other), start - half).min(0)
    high = np.where(cone, np.maximum(start + radius, end + other), start + half).max(0)
    return frames.pose(frames.rotate(np.asarray(turn, float), 0.5 * (low + high)), turn), high - low


def _box_of(mask: np.ndarray, window: Box) -> Box | None:
    """Returns the bounding box, in pixels of the picture, of a ``mask`` [rows, columns] of the picture's rectangle
    ``window``; None for an empty mask."""
    rows = np.flatnonzero(mask.any(1))
    columns = np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    left, top = window[:2]
    return left + int(columns[0]), top + int(rows[0]), left + int(columns[-1]), top + int(rows[-1])


def _inside(pixel: np.ndarray, info: CameraInfo) -> bool:
    return bool(-0.5 <= pixel[0] < info.width - 0.5 and -0.5 <= pixel[1] < info.height - 0.5)
