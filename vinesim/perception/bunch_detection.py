"""Finds hanging bunches in one RGB-D picture, without labels: colour and texture of every pixel, then the shape of each
connected part.

    for seen in find_bunches(picture).bunches:
        print(seen.top, seen.radius, seen.length)

A pixel is rated by two quadratic forms of its colour and of the contrast around it, one for fruit and one for wood.
Areas of fruit are separated where the depth jumps, and by their width where two bunches touch. An area is a bunch if it
has the size of a bunch. This is less than a user's trained detector: it knows the varieties, leaves and light of the
scenes demo and harvest only.
"""

from __future__ import annotations

import cv2
import numpy as np

from vinesim.core import frames
from vinesim.perception.clouds import picture_points
from vinesim.robot.tasks.sight import SeenBunch, Sight
from vinesim.scene.values import CameraFrame

MAX_DISTANCE = 1.8
"""[m] Distance up to which pixels are rated; noise of stereo depth and small areas spoil those beyond."""
MIN_DISTANCE = 0.25
"""[m] Distance from which pixels are rated; nearer is the robot's own hand."""
FRUIT = -1.0
"""Rating from which a pixel may be fruit. TUNED: 85 % of the pixels of bunches and 3 % of those of leaves reach it."""
WOOD = 0.0
"""Rating from which a pixel is wood, a post or a wire. TUNED: 80 % of theirs reach it."""
JUMP = 0.04
"""[m] Difference of depth between neighbouring pixels that separates two areas."""
MIN_AREA = 0.004
"""[m2] Smallest area of a bunch, seen from the side. Leaves that look like fruit are smaller."""
MIN_WIDTH = 0.055
"""[m] Smallest width of a bunch."""
MIN_LENGTH = 0.075
"""[m] Smallest visible length of a bunch."""
MAX_LENGTH = 0.35
"""[m] Largest length of a bunch."""
USUAL_WIDTH = 0.15
"""[m] Width from which an area may be two bunches that touch."""
CORE = 0.030
"""[m] Distance from the edge of an area at which two touching bunches are apart."""
SMALLEST_RADIUS = 0.040
LARGEST_RADIUS = 0.072
"""[m] Bounds of the estimated radius of a bunch. GUESSED from the table grapes of the scenes."""
HIDDEN_TOP = 0.014
"""[m] Mean distance of the upper end of a bunch above the top of its area. TUNED, seeds 112 to 117 of scene demo"""
HIDDEN_END = 0.008
"""[m] Mean distance of the lower end of a bunch below its area. TUNED as :data:`HIDDEN_TOP`"""
HIDDEN_SIDE = 0.010
"""[m] Mean difference between the radius of a bunch and half the width of its area. TUNED as :data:`HIDDEN_TOP`"""
_BLURS = ((0.65, 11, 33), (1.1, 7, 21), (np.inf, 5, 13))
"""Depth up to which a row holds [m], and the widths [px] of the two filters: a third of a berry's picture, and a
berry's."""
_FRUIT_WEIGHTS = np.array(
    (
        -10.2,
        3.47,
        7.64,
        -6.71,
        2.86,
        6.48,
        0.824,
        3.15,
        -6.19,
        -1.75,
        -0.381,
        12.5,
        -1.62,
        0.726,
        2.62,
        -2.88,
        2.14,
        -3.09,
        -2.8,
        -0.571,
        1.58,
        -1.04,
        -0.567,
        1.94,
        -0.931,
        1.39,
        -9.11,
        4.11,
        -5.48,
        -0.0523,
        2.02,
        -3.78,
        -1.6,
        0.22,
        2.71,
        -1.36,
    ),
    np.float32,
)
"""[36] Weights of 1, the 7 features and their 28 products, by logistic regression on 110 pictures of scene demo, seeds
100 to 113. :data:`_WOOD_WEIGHTS` has those for wood, posts and wires."""
_WOOD_WEIGHTS = np.array(
    (
        3.87,
        7.14,
        -0.853,
        -0.221,
        -0.269,
        -1.15,
        1.01,
        -1.34,
        -9.27,
        -4.25,
        -0.535,
        1.31,
        1.48,
        -2.85,
        -0.376,
        -1.95,
        -0.8,
        -1.33,
        1.41,
        -0.374,
        1.18,
        0.411,
        4.15,
        2.15,
        -0.911,
        -0.511,
        0.288,
        -3.35,
        1.98,
        0.32,
        -1.8,
        0.949,
        0.632,
        -0.944,
        0.66,
        -0.179,
    ),
    np.float32,
)


def find_bunches(frame: CameraFrame) -> Sight:
    """Find the bunches in a picture with colours and measured depth. Labels are not used."""
    points = picture_points(frame)
    depth = np.nan_to_num(points[..., 2], nan=0.0).astype(np.float32)
    is_near = (depth > MIN_DISTANCE) & (depth < MAX_DISTANCE)
    features = _features(frame.rgb, depth, is_near)
    fruit = np.full(depth.shape, -10.0, np.float32)
    fruit[is_near] = features @ _FRUIT_WEIGHTS
    wood = np.zeros(depth.shape, bool)
    wood[is_near] = features @ _WOOD_WEIGHTS > WOOD
    wood &= fruit < 0.0
    pose = np.asarray(frame.pose, float)
    found = []
    areas = _areas(fruit > FRUIT, depth, float(frame.info.fx))
    for area in range(1, int(areas.max()) + 1):
        seen = _bunch_of(areas == area, points, fruit, pose, float(frame.info.fx))
        if seen is not None:
            found.append(seen)
    found.sort(key=lambda seen: -seen.rating)
    coarse = (slice(None, None, 6), slice(None, None, 6))
    clouds = [
        pose[:3] + frames.rotate(pose[3:], points[coarse][mask[coarse]]) for mask in (wood, (fruit > FRUIT) & is_near)
    ]
    return Sight(tuple(found), *clouds)


def _features(rgb: np.ndarray, depth: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Returns 1, the 7 features and their 28 products [n, 36] for the n pixels ``where`` [height, width]: colour (a, b,
    L of CIE Lab) with a narrow and a wide filter, and the spread of L in the wide one. Filters are as wide as the depth
    requires."""
    lab = cv2.cvtColor(rgb.astype(np.float32) / np.float32(255.0), cv2.COLOR_RGB2LAB)
    light = lab[..., 0]
    distance = depth[where]
    features = np.zeros((len(distance), 7), np.float32)
    nearest = 0.0
    for farthest, small, large in _BLURS:
        here = (distance >= nearest) & (distance < farthest)
        nearest = farthest
        if not here.any():
            continue
        near = cv2.blur(lab, (small, small))[where][here]
        wide = cv2.blur(lab, (large, large))[where][here]
        spread = cv2.blur(light * light, (large, large))[where][here] - wide[:, 0] ** 2
        features[here, :3] = near[:, [1, 2, 0]]
        features[here, 3:6] = wide[:, [1, 2, 0]]
        features[here, 6] = np.sqrt(np.maximum(spread, 0.0))
    features /= np.array([10.0, 10.0, 30.0, 10.0, 10.0, 30.0, 10.0], np.float32)
    features[:, [2, 5]] -= 1.5
    first, second = np.triu_indices(7)
    return np.concatenate(
        [np.ones((len(features), 1), np.float32), features, features[:, first] * features[:, second]], 1
    )


def _areas(mask: np.ndarray, depth: np.ndarray, focal: float) -> np.ndarray:
    """Returns the number of the area of fruit [height, width] that each pixel belongs to, 0 for none."""
    mask = mask.astype(np.uint8)
    smooth = cv2.medianBlur(depth, 5)
    mask[cv2.morphologyEx(smooth, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > JUMP] = 0
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (13, 13)))
    count, areas = cv2.connectedComponents(mask)
    total = count - 1
    for area in range(1, count):
        here = areas == area
        columns = np.flatnonzero(here.any(0))
        pixel = float(np.median(depth[here])) / focal
        if (columns[-1] - columns[0]) * pixel < USUAL_WIDTH:
            continue
        inside = cv2.distanceTransform(here.astype(np.uint8), cv2.DIST_L2, 3)
        cores, core = cv2.connectedComponents((inside * pixel > CORE).astype(np.uint8))
        if cores <= 2:
            continue
        # each pixel goes to the nearest core
        away = [cv2.distanceTransform((core != k).astype(np.uint8), cv2.DIST_L2, 3) for k in range(1, cores)]
        nearest = np.argmin(away, axis=0)
        areas[here] = np.where(nearest == 0, area, total + nearest)[here]
        total += cores - 2
    return areas


def _bunch_of(
    mask: np.ndarray, points: np.ndarray, rating: np.ndarray, pose: np.ndarray, focal: float
) -> SeenBunch | None:
    """Returns the bunch of an area, None if it has not the size of one."""
    inside = mask & np.isfinite(points[..., 2])
    if np.count_nonzero(inside) < 200:
        return None
    cloud = points[inside]
    typical = float(np.median(cloud[:, 2]))
    cloud = cloud[np.abs(cloud[:, 2] - typical) < 2.0 * LARGEST_RADIUS]
    if np.count_nonzero(inside) * (typical / focal) ** 2 < MIN_AREA or len(cloud) < 200:
        return None
    world = pose[:3] + frames.rotate(pose[3:], cloud)
    ahead = frames.rotate(pose[3:], np.array([0.0, 0.0, 1.0]))[:2]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    right = np.array([ahead[1], -ahead[0]])
    bottom, top = np.quantile(world[:, 2], (0.01, 0.99))
    left, end = np.quantile(world[:, :2] @ right, (0.02, 0.98))
    width = float(end - left)
    length = float(top - bottom)
    if width < MIN_WIDTH or not MIN_LENGTH < length < MAX_LENGTH:
        return None
    radius = float(np.clip(0.5 * width + HIDDEN_SIDE, SMALLEST_RADIUS, LARGEST_RADIUS))
    front = float(np.quantile(world[:, :2] @ ahead, 0.1))
    middle = 0.5 * (left + end) * right + (front + 0.85 * radius) * ahead
    rows, columns = np.nonzero(mask)
    is_cut_off = bool(
        rows.min() == 0 or columns.min() == 0 or rows.max() == len(mask) - 1 or columns.max() == mask.shape[1] - 1
    )
    return SeenBunch(
        np.append(middle, top + HIDDEN_TOP),
        length + HIDDEN_TOP + HIDDEN_END,
        radius,
        float(rating[inside].mean()),
        typical + radius,
        is_cut_off,
    )
