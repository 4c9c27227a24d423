"""``python -m benchmarks picture_statistics``: statistics of synthetic pictures beside those of photographs.

    python -m benchmarks picture_statistics --photos FOLDER --synthetic FOLDER --synthetic FOLDER --out table.md

Each statistic is computed for each picture. The table has the mean and the standard deviation over all pictures of a
folder, and marks a mean that is further than one standard deviation of the photographs from theirs. Only pictures with
masks count, see :func:`benchmarks.support.bunch_pictures.read_photographs`.
"""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from scipy import ndimage

from benchmarks.support import bunch_pictures
from benchmarks.support.bunch_pictures import BunchPicture, mask_boxes
from vinesim.core.errors import UsageError, require_place, writing
from vinesim.scene.values import Measurement

HUES = ((10.0, 40.0), (40.0, 70.0), (70.0, 110.0), (110.0, 160.0))
"""[deg] Ranges of hues: soil, dry grass and bark; yellow leaves; green; blue-green."""
LEAST_SATURATION = 0.1
LEAST_VALUE = 0.1
"""Saturation and value (of HSV, 0 to 1) below which a pixel counts as without hue."""
NEAR_WHITE = 250
"""Level of 0 to 255 that red, green and blue of a nearly white pixel reach."""
SKY_VALUE = 0.75
"""Value from which on a pixel may be sky."""
SKY_SATURATION = 0.12
SKY_HUES = (190.0, 250.0)
"""[deg] A bright pixel counts as sky if its saturation is lower, or its hue in this range: white paint counts, too."""
DETAIL_SIGMA = 1.5
"""[px] Width of the Gaussian filter that separates fine detail from the rest of a picture that is 768 px wide."""
DETAIL_WIDTH = 768
DETAIL_QUANTILES = (0.1, 0.5)
"""Quantiles over the blocks of a picture: of smooth or blurred parts, and of the middle."""
NOISE_BLOCK = 16
"""[px] Width and height of the blocks in which noise is measured."""
NOISE_QUANTILE = 0.1
"""Quantile over the blocks that stands for the picture: that of smooth blocks, since the others show texture."""
UNCLIPPED = (10.0, 245.0)
"""Least and largest mean level of a block in which noise is measured."""
LEAST_PIXELS = 16
"""Number of pixels below which a bunch does not count, as in data sets."""
FRAGMENT_SHARE = 0.05
"""Share of a bunch's pixels below which a part does not count."""
MARK = "**"
_NOISE_FILTER = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
"""Keeps the standard deviation of white noise, and is 0 on planes and edges along rows or columns."""


def picture_statistics(
    *, photos: str, synthetic: Sequence[str], limit: int | None = None, out: str | None = None
) -> Iterator[Measurement]:
    """Yield the mean of each statistic of each folder of synthetic pictures, beside that of the photographs, and
    write the table into the file ``out``."""
    if limit is not None and limit < 1:
        raise UsageError(f"--limit is {limit}: give 1 or more")
    if out is not None:
        require_place("--out", out)
    places = [pathlib.Path(folder) for folder in synthetic]
    folders = bunch_pictures.read_folders(
        [pathlib.Path(photos)], places, limit, announce=lambda line: print(line, file=sys.stderr, flush=True)
    )
    ((name, photographs),) = folders.photographs.items()
    masked = [p for p in photographs if p.bunches is not None]
    if not masked:
        raise UsageError(
            f"--photos {photos}: none of its {len(photographs)} photographs has masks; put STEM.png or STEM.npz beside "
            "STEM.jpg"
        )
    values = {folder: of_pictures(pictures) for folder, pictures in [(name, masked), *folders.synthetic.items()]}
    if out is not None:
        with writing(out):
            pathlib.Path(out).write_text(table(values))
    reference = values.pop(name)
    for folder, found in values.items():
        for statistic, several in found.items():
            mean, peer = mean_and_spread(several)[0], mean_and_spread(reference[statistic])[0]
            yield Measurement("picture_statistics", f"{folder}: {statistic}", mean, "-", name, peer)


def of_pictures(pictures: Sequence[BunchPicture]) -> dict[str, np.ndarray]:
    """Returns the values [n] of each statistic by name, for all pictures."""
    each = [of_picture(p) for p in pictures]
    return {name: np.array([one[name] for one in each]) for name in each[0]}


def of_picture(picture: BunchPicture) -> dict[str, float]:
    """Returns the statistics of a picture with masks by name; nan where a picture has none, such as the saturation of
    bunches in a picture without bunches."""
    bunches = picture.bunches
    assert bunches is not None
    rgb = picture.rgb
    hue, saturation, value = np.moveaxis(cv2.cvtColor(rgb.astype(np.float32) / 255.0, cv2.COLOR_RGB2HSV), -1, 0)
    luma = rgb @ np.array([0.299, 0.587, 0.114]) / 255.0
    has_hue = (saturation >= LEAST_SATURATION) & (value >= LEAST_VALUE)
    found: dict[str, float] = {}
    for place, is_there in (("bunches", bunches > 0), ("background", bunches == 0)):
        shares = [_mean((has_hue & (hue >= low) & (hue < high))[is_there]) for low, high in HUES]
        for (low, high), share in zip(HUES, shares, strict=True):
            found[f"{place}: hue {low:.0f} to {high:.0f} degrees, share"] = share
        found[f"{place}: other hue or none, share"] = 1.0 - sum(shares)
        found[f"{place}: saturation"] = _mean(saturation[is_there])
        found[f"{place}: brightness"] = _mean(luma[is_there])
        found[f"{place}: spread of brightness"] = float(luma[is_there].std()) if is_there.any() else np.nan
    found["nearly white, share"] = _mean(rgb.min(-1) >= NEAR_WHITE)
    found["noise, levels of 255"] = noise_level(rgb @ np.array([0.299, 0.587, 0.114]))
    is_blue = (saturation < SKY_SATURATION) | ((hue >= SKY_HUES[0]) & (hue < SKY_HUES[1]))
    found["bright and pale or blue, share"] = _mean((value >= SKY_VALUE) & is_blue)
    for quantile, level in zip(DETAIL_QUANTILES, detail_levels(255.0 * luma), strict=True):
        found[f"fine detail, quantile {quantile:g}, levels of 255"] = level
    found["bunches, share of the picture"] = _mean(bunches > 0)
    return found | bunch_shapes(bunches)


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")


def noise_level(levels: np.ndarray) -> float:
    """Returns the standard deviation of the noise of a picture ``levels`` [height, width], 0 to 255, in its smoothest
    blocks."""
    high = ndimage.convolve(levels.astype(float), _NOISE_FILTER, mode="reflect")
    rows, columns = (size // NOISE_BLOCK for size in levels.shape)
    cut = np.s_[: rows * NOISE_BLOCK, : columns * NOISE_BLOCK]

    def block_means(values: np.ndarray) -> np.ndarray:
        return values[cut].reshape(rows, NOISE_BLOCK, columns, NOISE_BLOCK).mean((1, 3))

    middle = block_means(levels.astype(float))
    spreads = np.sqrt(block_means(high**2))[(middle >= UNCLIPPED[0]) & (middle <= UNCLIPPED[1])]
    return float(np.quantile(spreads, NOISE_QUANTILE)) if spreads.size else float("nan")


def detail_levels(levels: np.ndarray) -> list[float]:
    """Returns quantiles, over the blocks of a picture ``levels`` [height, width], 0 to 255, of the standard deviation
    of its fine detail."""
    height, width = levels.shape
    if width != DETAIL_WIDTH:
        size = (DETAIL_WIDTH, max(round(height * DETAIL_WIDTH / width), NOISE_BLOCK))
        levels = cv2.resize(levels, size, interpolation=cv2.INTER_AREA if width > DETAIL_WIDTH else cv2.INTER_LINEAR)
    fine = levels - cv2.GaussianBlur(levels, (0, 0), DETAIL_SIGMA, borderType=cv2.BORDER_REFLECT)
    rows, columns = (size // NOISE_BLOCK for size in fine.shape)
    blocks = fine[: rows * NOISE_BLOCK, : columns * NOISE_BLOCK].reshape(rows, NOISE_BLOCK, columns, NOISE_BLOCK)
    return np.quantile(np.sqrt((blocks**2).mean((1, 3))), DETAIL_QUANTILES).tolist()


def bunch_shapes(bunches: np.ndarray) -> dict[str, float]:
    """Returns the means over all bunches of a picture ``bunches`` [height, width], see :class:`BunchPicture`.

    *Parts* are the connected parts of a bunch's visible pixels. *Roughness* is perimeter^2 / (4 pi area), 1 for a disc
    and more for an outline that others hide partly. *Filled* is the share of the convex hull that is visible. Outlines
    that were drawn by hand are smoother than those of data sets, which follow every pixel.
    """
    shapes: list[tuple[float, float, float, float]] = []
    for bunch, (left, top, right, bottom) in zip(
        np.unique(bunches[bunches > 0]), mask_boxes(bunches).astype(int), strict=True
    ):
        mask = np.pad(bunches[top:bottom, left:right] == bunch, 1)
        area = int(mask.sum())
        if area < LEAST_PIXELS:
            continue
        _, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
        sizes = np.bincount(parts.ravel())[1:]
        outlines = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        perimeter = sum(cv2.arcLength(outline, True) for outline in outlines)
        hull = cv2.contourArea(cv2.convexHull(np.concatenate(_corners(mask))))
        shapes.append(
            (
                (bottom - top) / bunches.shape[0],
                float((sizes >= FRAGMENT_SHARE * area).sum()),
                perimeter**2 / (4.0 * np.pi * area),
                area / hull,
            )
        )
    means = np.mean(shapes, 0) if shapes else np.full(4, np.nan)
    names = (
        "height of a box / height of the picture",
        "parts of a bunch",
        "roughness of a bunch",
        "filled, of a bunch",
    )
    return {"bunches in a picture": float(len(shapes))} | dict(zip(names, means.tolist(), strict=True))


def _corners(mask: np.ndarray) -> list[np.ndarray]:
    """Returns the four corners [n, 2] of all pixels in ``mask``, as float32."""
    points = np.argwhere(mask)[:, ::-1].astype(np.float32)
    return [points + np.array(corner, np.float32) for corner in ((0, 0), (1, 0), (0, 1), (1, 1))]


def mean_and_spread(values: np.ndarray) -> tuple[float, float]:
    """Returns mean and standard deviation of the numbers among ``values``; nan if there is none."""
    known = values[np.isfinite(values)]
    return (float(known.mean()), float(known.std())) if known.size else (float("nan"), float("nan"))


def table(values: dict[str, dict[str, np.ndarray]]) -> str:
    """Returns a table in Markdown of the statistics by folder. The first folder is that of the photographs; means of
    others that are further than its standard deviation from its mean are in bold type."""
    names = list(values)
    reference = values[names[0]]
    counts = [f"{name} ({len(next(iter(values[name].values())))})" for name in names]
    lines = [f"| mean ± standard deviation | {' | '.join(counts)} |", "|---" * (len(names) + 1) + "|"]
    outside = dict.fromkeys(names[1:], 0)
    for statistic, theirs in reference.items():
        mean, spread = mean_and_spread(theirs)
        cells = [f"{mean:.3f} ± {spread:.3f}"]
        for name in names[1:]:
            ours, our_spread = mean_and_spread(values[name][statistic])
            is_outside = not abs(ours - mean) <= spread
            outside[name] += is_outside
            mark = MARK if is_outside else ""
            cells.append(f"{mark}{ours:.3f}{mark} ± {our_spread:.3f}")
        lines.append(f"| {statistic} | {' | '.join(cells)} |")
    ends = [f"{outside[name]} of {len(reference)} outside" for name in names[1:]]
    return "\n".join([*lines, f"| bold: outside of one standard deviation | | {' | '.join(ends)} |"]) + "\n"
