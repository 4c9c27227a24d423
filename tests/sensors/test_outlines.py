"""Polygons of masks: what pycocotools and shoelaces make of them is the mask, with its holes and parts."""

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco_mask

from vinesim.sensors.export.outlines import join_polygons, mask_polygons


def _masks(count: int) -> list[np.ndarray]:
    """Random blobs, from dust to lace, with parts, holes, islands in holes, and pixels at the picture's edges."""
    rng = np.random.default_rng(3)
    masks = []
    for number in range(count):
        noise = rng.normal(size=rng.integers(1, 60, 2))
        noise = cv2.GaussianBlur(noise, (0, 0), 2.0) if number % 2 else noise
        mask = noise > np.quantile(noise, rng.uniform(0.05, 0.95))
        masks.append(mask if mask.any() else ~mask)
    return masks


def _filled(polygons: list[list[float]], shape: tuple[int, int]) -> np.ndarray:
    """As torchvision's references and DETR make a mask of a segmentation."""
    return coco_mask.decode(coco_mask.frPyObjects(polygons, *shape)).any(axis=2)


def _area(polygon: list[float]) -> float:
    x, y = np.array(polygon, float).reshape(-1, 2).T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def test_polygons_are_the_mask() -> None:
    for mask in _masks(100):
        polygons = mask_polygons(mask)
        assert np.array_equal(_filled(polygons, mask.shape), mask)
        assert abs(sum(map(_area, polygons))) == mask.sum()  # so no two of them overlap, and holes count as negative
        assert np.array_equal(_filled(mask_polygons(mask, inset=True), mask.shape), mask)
        parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)[0] - 1
        assert len(polygons) == parts


def test_one_polygon_of_all_parts_is_the_mask() -> None:
    for mask in _masks(40):
        joined = join_polygons(mask_polygons(mask))
        assert np.array_equal(_filled([joined], mask.shape), mask)
        assert abs(_area(joined)) == mask.sum()
        assert np.array_equal(_filled([join_polygons(mask_polygons(mask, inset=True))], mask.shape), mask)


def _drawn(polygons: list[list[float]], shape: tuple[int, int]) -> np.ndarray:
    """As Ultralytics makes a mask: corners are truncated, and the boundary is drawn."""
    drawn = np.zeros(shape, np.uint8)
    for polygon in polygons:
        cv2.fillPoly(drawn, [np.array(polygon).astype(np.int32).reshape(-1, 1, 2)], 1)
    return drawn.astype(bool)


def test_inset_polygons_are_the_mask_also_where_corners_are_truncated_and_the_boundary_is_drawn() -> None:
    for mask in _masks(80):
        assert np.array_equal(_drawn(mask_polygons(mask, inset=True), mask.shape), mask)


def test_fills_that_draw_the_boundary_are_larger_by_at_most_a_pixel() -> None:
    """Polygons that are not inset, by cv2.fillPoly, as supervision makes a mask."""
    for mask in _masks(80):
        drawn = _drawn(mask_polygons(mask), mask.shape)
        padded = np.pad(mask, 1)
        grown = padded[1:-1, 1:-1] | padded[:-2, 1:-1] | padded[1:-1, :-2] | padded[:-2, :-2]
        assert not (mask & ~drawn).any()
        assert not (drawn & ~grown).any()


@pytest.mark.parametrize(
    ("mask", "polygons"),
    [
        ([[0, 0], [0, 1]], [{(1, 1), (2, 1), (2, 2), (1, 2)}]),
        ([[1, 0], [0, 1]], [{(0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (1, 2), (0, 1)}]),
        ([[0, 0]], []),
    ],
)
def test_corners_are_corners_of_pixels(mask: list, polygons: list) -> None:
    found = mask_polygons(np.array(mask, bool))
    assert [set(zip(one[::2], one[1::2], strict=True)) for one in found] == polygons
