"""Sightings of bunches."""

import numpy as np
import pytest
import seeing

from vinesim.sensors import truth
from vinesim.world.ids import Organ, label
from vinesim.world.values import CameraFrame


def _frame(labels: np.ndarray, depth: np.ndarray) -> CameraFrame:
    return CameraFrame(0.0, "c", seeing.SMALL, seeing.AHEAD, np.zeros((*labels.shape, 3), np.uint8), depth, labels)


def test_pixels_boxes_and_distances() -> None:
    labels = np.zeros((6, 8), np.int32)
    labels[1:3, 2:5] = label(Organ.BUNCH, 7)
    labels[5, 7] = label(Organ.BUNCH, 3)
    labels[0, 0] = label(Organ.LEAF, 7)
    depth = np.full((6, 8), np.inf, np.float32)
    depth[1:3, 2:5] = 1.5
    depth[1, 2] = -np.inf
    three, seven = truth.bunches(_frame(labels, depth))
    assert (three.bunch, three.pixels, three.box) == (3, 1, (7, 5, 7, 5))
    assert np.isnan(three.distance)
    assert (seven.bunch, seven.pixels, seven.box, seven.distance) == (7, 6, (2, 1, 4, 2), pytest.approx(1.5))


def test_no_bunch_no_sighting() -> None:
    assert truth.bunches(_frame(np.zeros((4, 4), np.int32), np.zeros((4, 4), np.float32))) == ()
