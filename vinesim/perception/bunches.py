"""Berries and volume of a bunch from depth pictures in which the pixels of the bunch are known.

A berry is found at a point of the bunch that is nearer to the camera than its surroundings. A sphere is grown from
there and refined to a spheroid, with the size of a table grape as prior. The volume of a bunch is that of the hull
around its points, cut into slices, times a measured share of the hull that berries fill.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.perception.clouds import picture_points
from vinesim.scene.ids import Organ, label
from vinesim.scene.values import CameraFrame

EXACT_NOISE = 0.0001
"""Standard deviation [m] that is assumed for exact depth."""
MILLIMETRE_NOISE = 0.0003
"""Standard deviation [m] of depth that is rounded to whole millimetres, as in the PNG files of a tour."""
MEASURED_NOISE = 0.001
"""Standard deviation [m] that is assumed for measured depth. GUESSED for a D435 at half a metre."""
PRIOR_RADIUS = (0.011, 0.002)
"""Mean and standard deviation [m] of the radius of a table grape before it is measured. GUESSED from the varieties."""
PRIOR_ELONGATION = 0.24, 0.12
"""Mean and standard deviation of 1 - 1 / e^2 before a berry is measured, e: length over thickness. GUESSED: e of 1.15,
from 1.06 to 1.25."""
MAX_SHAPE_NOISE = 0.0002
"""Noise of depth [m] from which only the size of a berry is measured, and its elongation is that of the prior."""
MIN_PIXELS = 60
"""Smallest number of pixels of a berry that is measured."""
MIN_DISC = 0.25
"""Smallest share of a berry's disc that must be visible."""
FILLED_ALL_ROUND = 0.597
"""Share of the hull that berries fill, for a bunch seen from several sides. TUNED on 60 bunches of scene demo, seed 11,
seen from three sides."""
FILLED_ONE_SIDE = 0.534
"""As :data:`FILLED_ALL_ROUND`, for a bunch seen from one side: the hull is taken to be round."""
SIDES = np.radians(80.0)
"""Angle [rad] between two horizontal viewing directions from which a bunch counts as seen from several sides."""
MAX_DEPTH = 0.12
"""Largest difference [m] of a point's depth from the median depth of its bunch. Stereo measures the background in some
pixels of a bunch."""
SLICE = 0.006
"""Height of a slice of the hull [m]."""
_SECTORS = 18
_SMOOTHING = 2.0
"""Standard deviation of the filter that smooths depth before berries are searched [px]."""
_REACHES = (0.006, 0.008, 0.010, 0.012, 0.012)
"""Distances [m] from the nearest point of a berry within which points may belong to it, as the sphere grows."""
_MAX_POINTS = 150


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BerryFit:
    """A spheroid that was fitted to the visible part of a berry."""

    centre: np.ndarray
    """[3] m in the world."""
    diameter: float
    """Thickness across the axis [m]."""
    length: float
    """Length along the axis [m]."""
    visible: float
    """Number of the berry's pixels divided by the number that its whole disc would have."""

    @property
    def mean_diameter(self) -> float:
        """Diameter of the ball of the same volume [m]."""
        return (self.diameter**2 * self.length) ** (1.0 / 3.0)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BunchMeasurement:
    """A bunch, measured in one or several pictures."""

    bunch: int
    """Index of the bunch in the model."""
    volume: float
    """Volume of all berries, hidden ones included [m^3]."""
    berries: tuple[BerryFit, ...]
    """Visible berries, each once."""
    pictures: int
    """Number of pictures that show the bunch."""
    has_sides: bool
    """Whether the pictures show the bunch from directions at least :data:`SIDES` apart."""


def measure_bunch(
    pictures: Sequence[CameraFrame],
    bunch: int,
    *,
    exact: bool = False,
    berries: bool = True,
    noise: float | None = None,
) -> BunchMeasurement:
    """Measure volume and berries of a bunch.

    Args:
        pictures: pictures with labels and poses; pictures that do not show the bunch are ignored.
        bunch: index of the bunch in the model. Its pixels are those with its label.
        exact: use the exact depth instead of the measured depth.
        berries: also fit the berries.
        noise: standard deviation of the depth [m]; by default :data:`MEASURED_NOISE`, or for exact depth
            :data:`EXACT_NOISE` or :data:`MILLIMETRE_NOISE`.

    Raises :class:`UsageError` if no picture shows depth of the bunch in at least :data:`MIN_PIXELS` pixels.
    """
    views = [view for picture in pictures if (view := _bunch_points(picture, bunch, exact)) is not None]
    if not views:
        raise UsageError(
            f"no picture shows {MIN_PIXELS} pixels of bunch {bunch} with depth; go nearer, or take another"
        )
    volume, has_sides = hull_volume([view.world for view in views], [view.eye for view in views])
    volume *= FILLED_ALL_ROUND if has_sides else FILLED_ONE_SIDE
    fits = [fit for view in views for fit in fit_berries(view, noise or _noise(view, exact))] if berries else []
    return BunchMeasurement(bunch, volume, tuple(_once(fits)), len(views), has_sides)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BunchPoints:
    """Depth of one bunch in one picture."""

    points: np.ndarray
    """[height, width, 3] m in the optical frame; NaN for pixels that do not show the bunch, or have no depth."""
    pose: np.ndarray
    """[7] pose of the optical frame in the world."""
    focal: float
    """Focal length [px]."""

    @property
    def world(self) -> np.ndarray:
        """[n, 3] m, the points in the world."""
        local = self.points[np.isfinite(self.points[..., 2])]
        return self.pose[:3] + frames.rotate(self.pose[3:], local)

    @property
    def eye(self) -> np.ndarray:
        """[3] m, position of the camera."""
        return self.pose[:3]


def _bunch_points(frame: CameraFrame, bunch: int, exact: bool) -> BunchPoints | None:
    """Returns the points of a bunch in a picture, None if there are fewer than :data:`MIN_PIXELS`."""
    if not frame.labels.size:
        raise UsageError(f"the picture of {frame.name!r} has no labels; render it with labels")
    rows, columns = np.nonzero(frame.labels == label(Organ.BUNCH, bunch))
    if len(rows) < MIN_PIXELS:
        return None
    window = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    points = picture_points(frame, exact)[window]
    points = np.where((frame.labels[window] == label(Organ.BUNCH, bunch))[..., None], points, np.nan)
    if not np.isfinite(points[..., 2]).any():
        return None
    off = np.abs(points[..., 2] - np.nanmedian(points[..., 2]))
    points = np.where((off < MAX_DEPTH)[..., None], points, np.nan)
    if np.isfinite(points[..., 2]).sum() < MIN_PIXELS:
        return None
    return BunchPoints(points, np.asarray(frame.pose, float), float(frame.info.fx))


def _noise(view: BunchPoints, exact: bool) -> float:
    """Returns the standard deviation [m] that is assumed for the depth of a view."""
    if not exact:
        return MEASURED_NOISE
    millimetres = 1000.0 * view.points[..., 2][np.isfinite(view.points[..., 2])]
    is_rounded = np.abs(millimetres - np.round(millimetres)).max() < 1e-3
    return MILLIMETRE_NOISE if is_rounded else EXACT_NOISE


# ---- volume ----------------------------------------------------------------------------------------------------------


def hull_volume(clouds: Sequence[np.ndarray], eyes: Sequence[np.ndarray]) -> tuple[float, bool]:
    """Returns the volume [m^3] of the hull around points of a hanging bunch, and whether they show several sides.

    The hull consists of horizontal slices, each star-shaped about a point of the bunch's axis. From one side, the axis
    is half a slice's width behind its nearest points, and directions without points have the radius of the opposite
    ones, or the mean radius.

    Args:
        clouds: points [n, 3] m in the world, one array for each picture.
        eyes: position [3] m of the camera of each picture.
    """
    points = np.concatenate(clouds)
    sights = np.array([eye[:2] - cloud[:, :2].mean(0) for cloud, eye in zip(clouds, eyes, strict=True)])
    bearing = np.arctan2(sights[:, 1], sights[:, 0])
    apart = np.angle(np.exp(1j * (bearing[:, None] - bearing[None])))
    has_sides = bool((np.abs(apart) >= SIDES).any())
    low, high = np.quantile(points[:, 2], (0.002, 0.998))
    count = max(int(np.ceil((high - low) / SLICE)), 1)
    height = max(high - low, 1e-6) / count
    slices = np.clip(((points[:, 2] - low) / height).astype(int), 0, count - 1)
    filled = np.flatnonzero(np.bincount(slices, minlength=count) >= 12)
    if not len(filled):
        return 0.0, has_sides
    toward = np.array([np.cos(bearing), np.sin(bearing)]).mean(1)
    toward /= max(float(np.linalg.norm(toward)), 1e-9)
    axis = np.array([_slice_middle(points[slices == k, :2], None if has_sides else toward) for k in filled])
    axis = np.stack([_smoothed(np.interp(np.arange(count), filled, axis[:, k])) for k in range(2)], 1)
    areas = [_slice_area(points[slices == k, :2] - axis[k]) for k in filled]
    return float(np.interp(np.arange(count), filled, areas).sum() * height), has_sides


def _slice_middle(points: np.ndarray, toward: np.ndarray | None) -> np.ndarray:
    """Returns the middle [2] m of a slice's points [n, 2] m; ``toward``: unit vector [2] to the camera if the points
    show one side only."""
    if toward is None:
        return 0.5 * (points.min(0) + points.max(0))
    across = np.array([-toward[1], toward[0]])
    side = points @ across
    half = 0.5 * float(side.max() - side.min())
    return across * (side.min() + half) + toward * (float((points @ toward).max()) - half)


def _smoothed(values: np.ndarray) -> np.ndarray:
    return np.convolve(np.pad(values, 2, mode="edge"), np.full(5, 0.2), mode="valid")


def _slice_area(points: np.ndarray) -> float:
    """Returns the area [m^2] of a star-shaped slice from its points [n, 2] m about its axis."""
    radius = np.hypot(points[:, 0], points[:, 1])
    sector = ((np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
    reach = np.full(_SECTORS, np.nan)
    for k in np.flatnonzero(np.bincount(sector, minlength=_SECTORS) >= 2):
        reach[k] = np.quantile(radius[sector == k], 0.98)
    reach = np.where(np.isnan(reach), np.roll(reach, _SECTORS // 2), reach)
    reach = np.where(np.isnan(reach), np.nanmean(reach) if np.isfinite(reach).any() else 0.0, reach)
    return float(0.5 * (reach**2).sum() * 2.0 * np.pi / _SECTORS)


# ---- berries ---------------------------------------------------------------------------------------------------------


def fit_berries(view: BunchPoints, noise: float) -> list[BerryFit]:
    """Returns the berries in one picture of a bunch; ``noise``: standard deviation of depth [m]."""
    points = view.points
    depth = _smooth(points[..., 2], max(4.0 * noise, 0.002))
    typical = float(np.nanmedian(depth))
    pixel = typical / view.focal
    size = round(0.004 / pixel)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * size + 1, 2 * size + 1))
    filled = np.where(np.isfinite(depth), depth, 9.0).astype(np.float32)
    seeds = np.argwhere((filled <= cv2.erode(filled, around)) & np.isfinite(depth) & np.isfinite(points[..., 2]))
    seeds = seeds[np.argsort(depth[tuple(seeds.T)], kind="stable")]
    is_free = np.isfinite(points[..., 2])
    reach = int(0.014 / pixel) + 1
    found = []
    for row, column in seeds:
        if not is_free[row, column]:
            continue
        window = (
            slice(max(row - reach, 0), row + reach + 1),
            slice(max(column - reach, 0), column + reach + 1),
        )
        cloud = points[window][is_free[window]]
        ball = _grow(cloud, points[row, column], noise)
        if ball is None:
            continue
        fit = _refined(cloud, ball, noise) if noise < MAX_SHAPE_NOISE else _stretched(ball)
        if fit is None:
            continue
        centre, radius, bend = fit[:3], fit[3], fit[4:]
        if noise < MAX_SHAPE_NOISE:
            inside = _spheroid_distance(cloud, fit) < 3.0 * noise + 0.0002
        else:
            inside = np.abs(np.linalg.norm(cloud - centre, axis=1) - ball[3]) < _tolerance(noise, 1.0)
        taken = is_free[window].copy()
        taken[taken] = inside
        is_free[window] &= ~taken
        stretch = 1.0 / np.sqrt(1.0 - bend @ bend)
        disc = np.pi * (radius / (centre[2] / view.focal)) ** 2 * np.sqrt(stretch)
        visible = int(np.count_nonzero(taken)) / disc
        if visible < MIN_DISC:
            continue
        world = view.pose[:3] + frames.rotate(view.pose[3:], centre)
        found.append(BerryFit(world, 2.0 * radius, 2.0 * radius * stretch, float(min(visible, 1.0))))
    return found


def _refined(cloud: np.ndarray, ball: np.ndarray, noise: float) -> np.ndarray | None:
    """Returns the spheroid [7] of :func:`_fit_spheroid` through the points of ``cloud`` [n, 3] that belong to the berry
    of ``ball``; None if there is none."""
    mine = np.abs(np.linalg.norm(cloud - ball[:3], axis=1) - ball[3]) < _tolerance(noise, 0.5)
    fit = _fit_spheroid(cloud[mine], ball, noise)
    for narrow in (2.5, 2.0):  # points of neighbouring berries drop out
        if fit is None:
            return None
        mine = _spheroid_distance(cloud, fit) < narrow * noise + 0.0001
        fit = _fit_spheroid(cloud[mine], ball, noise) if mine.sum() >= MIN_PIXELS else None
    return fit


def _stretched(ball: np.ndarray) -> np.ndarray:
    """Returns an upright spheroid [7] (:func:`_fit_spheroid`) with the volume of a ball [4] and the elongation of the
    prior."""
    stretch = (1.0 - PRIOR_ELONGATION[0]) ** -0.5
    return np.array([*ball[:3], ball[3] * stretch ** (-1.0 / 3.0), 0.0, -np.sqrt(PRIOR_ELONGATION[0]), 0.0])


def _tolerance(noise: float, share: float) -> float:
    """Returns the largest distance [m] of a berry's points from a ball; ``share``: 0 to 1, from wide to narrow."""
    return (4.0 - share) * noise + 0.0006 - 0.0004 * share * (noise >= MAX_SHAPE_NOISE)


def _smooth(depth: np.ndarray, gap: float) -> np.ndarray:
    """Returns depth [height, width] m, averaged over neighbouring pixels whose depth differs by less than ``gap``
    [m]."""
    reach = int(np.ceil(2.0 * _SMOOTHING))
    total = np.zeros_like(depth)
    weight = np.zeros_like(depth)
    padded = np.pad(depth, reach, constant_values=np.nan)
    rows, columns = depth.shape
    for down in range(2 * reach + 1):
        for right in range(2 * reach + 1):
            share = np.exp(-((down - reach) ** 2 + (right - reach) ** 2) / (2.0 * _SMOOTHING**2))
            other = padded[down : down + rows, right : right + columns]
            near = np.abs(other - depth) < gap
            total += np.where(near, share * other, 0.0)
            weight += np.where(near, share, 0.0)
    return np.divide(total, weight, out=np.full_like(depth, np.nan), where=weight > 0.0)


def _grow(cloud: np.ndarray, nearest: np.ndarray, noise: float) -> np.ndarray | None:
    """Returns centre and radius [4] m of the ball that grows from the ``nearest`` point [3] m of a berry through points
    ``cloud`` [n, 3]; None if there is none."""
    ball = np.array([*(nearest * (1.0 + PRIOR_RADIUS[0] / np.linalg.norm(nearest))), PRIOR_RADIUS[0]])
    away = np.linalg.norm(cloud - nearest, axis=1)
    for reach in _REACHES:
        off = np.abs(np.linalg.norm(cloud - ball[:3], axis=1) - ball[3])
        mine = (away < 1.3 * reach) & (off < _tolerance(noise, float(reach >= 0.010)))
        if mine.sum() < MIN_PIXELS // 2:
            return None
        ball = _fit_ball(_thinned(cloud[mine]), ball, max(noise, 0.0003))
    off = np.abs(np.linalg.norm(cloud - ball[:3], axis=1) - ball[3])
    is_berry = 0.5 < ball[3] / PRIOR_RADIUS[0] < 1.6
    return ball if is_berry and (off < _tolerance(noise, 1.0)).sum() >= MIN_PIXELS else None


def _thinned(points: np.ndarray) -> np.ndarray:
    return points[:: len(points) // _MAX_POINTS + 1]


def _fit_ball(points: np.ndarray, ball: np.ndarray, noise: float) -> np.ndarray:
    """Returns centre and radius [4] m of the ball through points [n, 3], by robust Gauss-Newton steps from ``ball``."""
    for _ in range(4):
        away = points - ball[:3]
        distance = np.linalg.norm(away, axis=1)
        off = distance - ball[3]
        weight = _robust_weight(off, noise)
        slopes = np.concatenate([-away / distance[:, None], np.full((len(points), 1), -1.0)], 1)
        slopes = np.concatenate([slopes * (weight / noise)[:, None], [[0.0, 0.0, 0.0, 1.0 / PRIOR_RADIUS[1]]]])
        rest = np.append(off * weight / noise, (ball[3] - PRIOR_RADIUS[0]) / PRIOR_RADIUS[1])
        step = np.linalg.lstsq(slopes, -rest, rcond=None)[0]
        ball = ball + step * min(1.0, 0.003 / max(float(np.abs(step).max()), 1e-12))
    return ball


def _fit_spheroid(points: np.ndarray, ball: np.ndarray, noise: float) -> np.ndarray | None:
    """Returns centre [3], radius and bend [3] of the spheroid through points [n, 3]; None if there is none.

    Points x of the surface have |x - c|^2 - (w (x - c))^2 = r^2. The bend w points along the axis; its length is
    sqrt(1 - 1 / e^2), where e is length over thickness.
    """
    points = _thinned(points)
    best = None
    least = np.inf
    for axis in np.eye(3):
        fit = np.array([*ball[:3], 0.97 * ball[3], *(0.45 * axis)])
        for _ in range(10):
            away = points - fit[:3]
            along = away @ fit[4:]
            distance = np.sqrt(np.maximum((away**2).sum(1) - along**2, 1e-12))
            off = distance - fit[3]
            weight = _robust_weight(off, noise) / noise
            slopes = np.empty((len(points) + 2, 7))
            slopes[:-2, :3] = -(away - along[:, None] * fit[4:]) / distance[:, None]
            slopes[:-2, 3] = -1.0
            slopes[:-2, 4:] = -along[:, None] * away / distance[:, None]
            slopes[:-2] *= weight[:, None]
            slopes[-2:] = 0.0
            slopes[-2, 3] = 1.0 / PRIOR_RADIUS[1]
            slopes[-1, 4:] = 2.0 * fit[4:] / PRIOR_ELONGATION[1]
            prior = (fit[3] - PRIOR_RADIUS[0]) / PRIOR_RADIUS[1], (fit[4:] @ fit[4:] - PRIOR_ELONGATION[0])
            rest = np.append(off * weight, [prior[0], prior[1] / PRIOR_ELONGATION[1]])
            step = np.linalg.lstsq(slopes, -rest, rcond=None)[0]
            fit = fit + step / max(float(np.abs(step[:4]).max()) / 0.003, float(np.abs(step[4:]).max()) / 0.3, 1.0)
            if np.abs(step).max() < 1e-6:
                break
        cost = float((rest**2).sum())
        if cost < least and fit[4:] @ fit[4:] < 0.7 and 0.5 < fit[3] / PRIOR_RADIUS[0] < 1.6:
            best = fit
            least = cost
    return best


def _robust_weight(off: np.ndarray, noise: float) -> np.ndarray:
    """Returns the square root of Huber's weight of residuals [n] m."""
    return np.sqrt(np.minimum(1.0, 2.0 * noise / np.maximum(np.abs(off), 1e-12)))


def _spheroid_distance(points: np.ndarray, fit: np.ndarray) -> np.ndarray:
    """Returns the distance [n] m, about, of points [n, 3] from a spheroid (:func:`_fit_spheroid`)."""
    away = points - fit[:3]
    along = away @ fit[4:]
    return np.abs(np.sqrt(np.maximum((away**2).sum(1) - along**2, 0.0)) - fit[3])


def _once(fits: list[BerryFit]) -> list[BerryFit]:
    """Returns berries that were seen in several pictures once: the fit that shows most of each."""
    kept: list[BerryFit] = []
    for fit in sorted(fits, key=lambda one: -one.visible):
        if all(np.linalg.norm(fit.centre - other.centre) > 0.6 * other.diameter for other in kept):
            kept.append(fit)
    return kept
