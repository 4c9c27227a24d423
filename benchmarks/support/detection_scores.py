"""Scores of a detector of bunches that gives a probability for each pixel: by pixels and by blobs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from benchmarks.support.bunch_pictures import BunchPicture

THRESHOLD = 0.5
"""Probability from which on a pixel counts as one of a bunch."""
LEVELS = 1024
"""Number of different probabilities."""
HIT_SHARE = 0.25
"""Share of a box from which on it counts as found."""
MIN_BLOB_SHARE = 1e-4
"""Share of the picture below which a blob does not count: 39 pixels of 768x512. Boxes are found by blobs of any
size."""


@dataclasses.dataclass(frozen=True, slots=True)
class PictureScores:
    """Counts of one photograph."""

    bunch_pixels: np.ndarray | None
    """[LEVELS] pixels of bunches by probability; None if the photograph has no masks."""
    other_pixels: np.ndarray | None
    boxes: int
    hits: int
    """Number of boxes of which at least ``HIT_SHARE`` is covered by pixels that count as bunch."""
    false_blobs: int
    """Number of blobs outside of all boxes that count by their size."""
    false_specks: int
    """Number of blobs outside of all boxes that are too small to count."""


def score_picture(picture: BunchPicture, probability: np.ndarray) -> PictureScores:
    """Returns the counts of a photograph, ``probability`` [height, width] 0 to 1.

    A blob is a set of pixels with a probability of at least ``THRESHOLD`` that touch each other, also at corners. It
    is false if none of its pixels is in a box.
    """
    is_found = probability >= THRESHOLD
    in_boxes = np.zeros(is_found.shape, bool)
    hits = 0
    for left, top, right, bottom in np.rint(picture.boxes).astype(int):
        part = np.s_[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
        in_boxes[part] = True
        hits += bool(is_found[part].size) and is_found[part].mean() >= HIT_SHARE
    count, blobs = cv2.connectedComponents(is_found.astype(np.uint8), connectivity=8)
    sizes = np.bincount(blobs.ravel(), minlength=count)
    is_outside = np.ones(count, bool)
    is_outside[np.unique(blobs[in_boxes]).astype(int)] = False
    is_outside[0] = False  # the pixels of no blob
    counts = sizes >= MIN_BLOB_SHARE * is_found.size
    bunch_pixels = other_pixels = None
    if picture.bunches is not None:
        level = np.clip((probability * LEVELS).astype(int), 0, LEVELS - 1)
        is_bunch = picture.bunches > 0
        bunch_pixels = np.bincount(level[is_bunch], minlength=LEVELS)
        other_pixels = np.bincount(level[~is_bunch], minlength=LEVELS)
    return PictureScores(
        bunch_pixels,
        other_pixels,
        len(picture.boxes),
        int(hits),
        int((is_outside & counts).sum()),
        int((is_outside & ~counts).sum()),
    )


@dataclasses.dataclass(frozen=True, slots=True)
class Scores:
    """Scores of all photographs of a test."""

    photographs: int
    masks: int
    """Number of the photographs that have masks. Pixels are counted on these, and all of them count alike."""
    f1: float
    """F1 of pixels at ``THRESHOLD``; nan without masks, as are all scores of pixels."""
    f1_low: float
    """The 5 % quantile of F1, if the photographs are drawn again at random."""
    f1_high: float
    iou: float
    average_precision: float
    best_f1: float
    """The largest F1 at any threshold. The threshold is chosen with the test's own masks."""
    best_threshold: float
    boxes: int
    hits: int
    false_blobs: int
    false_specks: int


def total_scores(pictures: Sequence[PictureScores], seed: int = 0) -> Scores:
    """Returns the scores of all ``pictures`` together; ``seed``: of the photographs that are drawn again."""
    bunch = np.array([p.bunch_pixels for p in pictures if p.bunch_pixels is not None], float).reshape(-1, LEVELS)
    other = np.array([p.other_pixels for p in pictures if p.other_pixels is not None], float).reshape(-1, LEVELS)
    nan = float("nan")
    f1 = low = high = precision = best = threshold = nan
    if len(bunch):
        curve = f1_curve(bunch.sum(0), other.sum(0))
        at = round(THRESHOLD * LEVELS)
        f1, best, threshold = float(curve[at]), float(curve.max()), float(curve.argmax() / LEVELS)
        rng = np.random.default_rng(seed)
        drawn = rng.integers(len(bunch), size=(1000, len(bunch)))
        low, high = np.quantile([f1_curve(bunch[d].sum(0), other[d].sum(0))[at] for d in drawn], (0.05, 0.95)).tolist()
        precision = average_precision(bunch.sum(0), other.sum(0))
    return Scores(
        photographs=len(pictures),
        masks=len(bunch),
        f1=f1,
        f1_low=low,
        f1_high=high,
        iou=f1 / (2.0 - f1),
        average_precision=precision,
        best_f1=best,
        best_threshold=threshold,
        boxes=sum(p.boxes for p in pictures),
        hits=sum(p.hits for p in pictures),
        false_blobs=sum(p.false_blobs for p in pictures),
        false_specks=sum(p.false_specks for p in pictures),
    )


def f1_curve(bunch: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Returns F1 [LEVELS] if all pixels of a level and above are taken for bunches, from the numbers of pixels
    [LEVELS] of bunches and of others."""
    found = np.cumsum(bunch[::-1])[::-1]
    false = np.cumsum(other[::-1])[::-1]
    return 2.0 * found / np.maximum(found + false + bunch.sum(), 1.0)


def average_precision(bunch: np.ndarray, other: np.ndarray) -> float:
    """Returns the average precision: precision at each level, weighted by the recall that the level adds; nan without
    a pixel of a bunch."""
    if not bunch.sum():
        return float("nan")
    found, false = np.cumsum(bunch[::-1]), np.cumsum(other[::-1])
    return float((bunch[::-1] / bunch.sum() * found / np.maximum(found + false, 1.0)).sum())
