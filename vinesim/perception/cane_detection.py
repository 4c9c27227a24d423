"""Finds the canes of dormant vines in one RGB-D picture of a row, without labels: axis, thickness, base and nodes.

    for seen in find_canes(picture, row).canes:
        print(seen.base, seen.diameter, seen.nodes)

The picture is drawn onto the upright plane of the row, in metres. There a cane is a line of known width that differs in
colour from both of its sides, at the depth of the row. Lines are followed by the continuity of their direction, also
where canes cross. Two canes that meet above old wood stand on one spur. Nodes are darker and redder than the wood
between them and nearly evenly spaced: a comb finds them.

This is what a user's program would have to do, with less than a user's trained detector. It knows the trellis: the
fruiting wire and the posts. Its numbers are fitted to pictures of scene ``winter_spur``, seeds 100 to 102.
"""

from __future__ import annotations

import dataclasses
import itertools

import cv2
import numpy as np

from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.perception.clouds import picture_points
from vinesim.robot.tasks.sight import CaneSight, RowMap, SeenCane
from vinesim.scene.values import CameraFrame

CELL = 0.0015
"""[m] Edge of a cell of the picture on the plane of the row: a cane is six cells wide."""
BELOW = 0.06
ABOVE = 0.50
"""[m] Heights below and above the fruiting wire between which the row is searched."""
OFF_ROW = 0.15
"""[m] Distance from the plane of the row within which pixels belong to it."""
FARTHEST = 1.25
"""[m] Distance from the camera up to which the row is searched."""
SIDE = 0.0085
"""[m] Distance from the axis of a cane at which its sides are compared with it: a cane's thickness of 9 mm."""
LINE = 0.033
"""[m] Length over which colours are averaged along a cane."""
ANGLES = np.deg2rad(np.linspace(-63.0, 63.0, 22))
"""[rad] Directions of lines, from upright to the right."""
CONTRAST = 4.0
"""Least difference of colour (CIE Lab) between a cane and both of its sides. TUNED"""
SURE_CONTRAST = 7.0
"""Difference of colour from which on a line begins. TUNED"""
STEP = 0.005
"""[m] Step in which lines are followed."""
MEMORY = 0.06
"""[m] Length from which the direction of a line is taken."""
GAP = 0.03
"""[m] Longest part of a line that may lack contrast, as at wires and crossings."""
THICK = 0.050
"""[m] Width from which wood is old wood: a cordon or a head. Depth makes it 10 mm wider than it is."""
THICK_AREA = 0.0035
"""[m2] Least area of old wood."""
SHORTEST = 0.10
"""[m] Shortest line that is a cane."""
POST_ANGLE = 0.2
"""[rad] Angle from upright within which lines on a post are taken for its edges."""
FITTED = 0.22
"""[m] Length of the lower part of a cane that is taken for a curve of second order."""
EDGE = 0.03
"""[m] Distance from the edge of the picture within which a base may be cut off."""
MEETING = 0.008
"""[m] Distance between the axes of two canes at which the lower one leaves the spur."""
UPPER_BASE = 0.028
"""[m] Way from there to the base of the upper cane: an internode of a spur. TUNED, seeds 100 to 102"""
FIRST_NODE = 0.042
"""[m] Usual way from the base of a cane to its first node. TUNED, seeds 100 to 102"""
NODE_SPREAD = 0.014
"""[m] Standard deviation of that way, as seen. TUNED, seeds 100 to 102"""
INTERNODES = np.arange(0.040, 0.0735, 0.001)
"""[m] Lengths of internodes that are tried. Nodes are on average 60 mm apart (data/plants/vine.toml)."""
INTERNODE = 0.057
INTERNODE_SPREAD = 0.008
"""[m] Mean and standard deviation of their lengths. GUESSED"""
LEAN = 6.0
"""How much a radian of lean counts: the upper cane follows the spur, the lower one stands off it. TUNED"""
ABOVE_RING = 0.0055
"""[m] Distance of a node above the darkest place of its ring. TUNED, seeds 100 to 102"""
FEWEST_TEETH = 2
"""Number of nodes that must be in view for the comb."""


@dataclasses.dataclass(frozen=True, eq=False)
class _View:
    """A picture on the plane of a row: column by column along the row, row by row downwards."""

    lab: np.ndarray
    """[height, width, 3] float32, colours of CIE Lab."""
    off: np.ndarray
    """[height, width] m, distance of what is shown behind the plane; large where there is no depth."""
    is_row: np.ndarray
    """[height, width] whether it belongs to the row."""
    shown: np.ndarray
    """[height, width] whether the picture reaches there."""
    is_post: np.ndarray
    """[height, width] whether a post stands there."""
    origin: np.ndarray
    """[3] m in the world, the first cell."""
    right: np.ndarray
    """[3] m, from a cell to the next along the row."""
    across: np.ndarray
    """[3] Level direction across the row."""

    def places(self, cells: np.ndarray) -> np.ndarray:
        """Returns places [n, 3] m on the plane at ``cells`` [n, 2] (column, row)."""
        return self.origin + cells[:, :1] * self.right + cells[:, 1:] * np.array([0.0, 0.0, -CELL])


@dataclasses.dataclass(frozen=True, eq=False)
class _Axis:
    """The lower part of a line, smoothed and continued downwards."""

    way: np.ndarray
    """[n] m from the lowest place that was followed; negative where it is continued."""
    cells: np.ndarray
    """[n, 2] (column, row)."""
    normal: np.ndarray
    """[n, 2] Unit vector to the right."""
    end: float
    """Way up to which the line was followed [m]."""


def find_canes(frame: CameraFrame, row: RowMap) -> CaneSight:
    """Find the canes of ``row`` in a picture with colours and measured depth. Labels are not used.

    Raises :class:`UsageError` if the picture has no colours, or does not show the row.
    """
    if not frame.rgb.size:
        raise UsageError(f"the picture of {frame.name!r} has no colours; render it with colours")
    view = _drawn_on_row(frame, row)
    if view is None:
        raise UsageError(
            f"the picture of {frame.name!r} does not show the row within {FARTHEST:g} m; turn the camera to the row"
        )
    ridges = _ridges(view)
    axes = _axes(_lines(ridges), view)
    strips = [_strip(view, axis) for axis in axes]
    spurs, base = _spurs(axes)
    nodes = [np.zeros(0)] * len(axes)
    for spur in spurs:
        # each cane of a spur as the lower one, and as the upper one, whose base is an internode of the spur further up
        combs = [[_comb(axes[one], strips[one], base[one] + more) for more in (0.0, UPPER_BASE)] for one in spur]
        upper = [0] * len(spur)
        if len(spur) == 2:
            leans = [abs(_lean(axes[one])) for one in spur]
            ratings = [
                combs[1 - one][0].rating + combs[one][1].rating + LEAN * (leans[1 - one] - leans[one]) for one in (0, 1)
            ]
            upper[int(np.argmax(ratings))] = 1
        for one, mine, number in zip(spur, combs, upper, strict=True):
            nodes[one] = _nodes(axes[one], mine[number])
            base[one] += number * UPPER_BASE
    found = []
    for number, (axis, strip) in enumerate(zip(axes, strips, strict=True)):
        seen = _seen(frame, view, axis, strip, base[number], nodes[number])
        if seen is not None:
            found.append(seen)
    found.sort(key=lambda seen: seen.distance)
    return CaneSight(tuple(found))


def _drawn_on_row(frame: CameraFrame, row: RowMap) -> _View | None:
    """Returns the picture on the plane of the row; None if it does not show it."""
    pose = np.asarray(frame.pose, float)
    ahead = row.wire[1] - row.wire[0]
    level = float(np.linalg.norm(ahead[:2]))
    across = np.array([-ahead[1], ahead[0], 0.0]) / level
    eye = float((pose[:3] - row.wire[0])[:2] @ ahead[:2]) / level
    along = np.arange(eye - FARTHEST, eye + FARTHEST, CELL)
    up = np.arange(ABOVE, -BELOW, -CELL)
    turn = frames.conjugate(pose[3:])
    start, forward, upward, sideways = frames.rotate(
        turn, np.stack([row.wire[0] - pose[:3], ahead / level, np.array([0.0, 0.0, 1.0]), across])
    )
    local = start + along[None, :, None] * forward + up[:, None, None] * upward
    depth = np.maximum(local[..., 2], 1e-6)
    x = (local[..., 0] / depth * frame.info.fx + frame.info.cx).astype(np.float32)
    y = (local[..., 1] / depth * frame.info.fy + frame.info.cy).astype(np.float32)
    shown = (local[..., 2] > 0.1) & (np.linalg.norm(local, axis=-1) < FARTHEST)
    shown &= (x > 1.0) & (y > 1.0) & (x < frame.info.width - 2.0) & (y < frame.info.height - 2.0)
    columns = np.flatnonzero(shown.any(0))
    rows = np.flatnonzero(shown.any(1))
    if len(columns) < round(SHORTEST / CELL) or len(rows) < round(SHORTEST / CELL):
        return None
    window = np.ix_(rows, columns)
    x = np.ascontiguousarray(x[window])
    y = np.ascontiguousarray(y[window])
    shown = shown[window]
    rgb = cv2.remap(frame.rgb, x, y, cv2.INTER_LINEAR)
    rgb[~shown] = 0
    off = np.nan_to_num(picture_points(frame) @ sideways - start @ sideways, nan=9.0).astype(np.float32)
    off = cv2.remap(off, x, y, cv2.INTER_NEAREST)
    off[~shown] = 9.0
    is_post = np.zeros(shown.shape, bool)
    for post in row.posts:
        is_post[:, np.abs(along[columns] - float((post - row.wire[0, :2]) @ ahead[:2]) / level) < row.post_radius] = (
            True
        )
    return _View(
        cv2.cvtColor(rgb.astype(np.float32) / np.float32(255.0), cv2.COLOR_RGB2LAB),
        off,
        np.abs(off) < OFF_ROW,
        shown,
        is_post,
        row.wire[0] + along[columns[0]] / level * ahead + np.array([0.0, 0.0, up[rows[0]]]),
        CELL / level * ahead,
        across,
    )


def _ridges(view: _View) -> np.ndarray:
    """Returns for each of :data:`ANGLES` how much the lines through each cell differ from both of their sides [angle,
    height, width]; 0 outside the row, and in old wood."""
    wood = (view.is_row & ~_old_wood(view.is_row & ~view.is_post)).astype(np.float32)
    near_post = cv2.dilate(view.is_post.astype(np.uint8), np.ones((1, 2 * round(0.012 / CELL) + 1), np.uint8)) > 0
    half = round(0.5 * LINE / CELL)
    side = SIDE / CELL
    size = (wood.shape[1], wood.shape[0])
    found = np.zeros((len(ANGLES), *wood.shape), np.float32)
    for number, angle in enumerate(ANGLES.tolist()):
        right = np.sin(angle)
        down = -np.cos(angle)
        line = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
        start, end = ((round(half + sign * half * right), round(half + sign * half * down)) for sign in (-1.0, 1.0))
        cv2.line(line, start, end, (1.0,))
        line /= line.sum()
        mean = cv2.filter2D(view.lab, -1, line, borderType=cv2.BORDER_REPLICATE)
        off = []
        for way in (side, -side):
            shift = np.array([[1.0, 0.0, way * down], [0.0, 1.0, -way * right]], np.float32)
            beside = cv2.warpAffine(mean, shift, size, borderMode=cv2.BORDER_REPLICATE)
            off.append(np.sqrt(((mean - beside) ** 2).sum(-1)))
        where = cv2.filter2D(wood, -1, line) > 0.6
        if abs(angle) < POST_ANGLE:
            where &= ~near_post
        found[number] = np.where(where, np.minimum(*off), 0.0)
    return found


def _old_wood(is_row: np.ndarray) -> np.ndarray:
    """Returns where the row is too thick for canes [height, width]."""
    mask = cv2.morphologyEx(is_row.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    width = 2 * int(0.5 * THICK / CELL) + 1
    core = cv2.morphologyEx(mask, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width)))
    _, areas, statistics, _ = cv2.connectedComponentsWithStats(core)
    is_large = statistics[:, cv2.CC_STAT_AREA] * CELL**2 > THICK_AREA
    is_large[0] = False
    return is_large[areas.astype(int)]


def _lines(ridges: np.ndarray) -> list[np.ndarray]:
    """Returns the lines that were followed, surest first: [n, 2] cells (column, row), from the lower end upwards."""
    best = ridges.max(0)
    direction = ridges.argmax(0)
    starts: list[tuple[float, int, int]] = []
    for row in range(0, len(best), round(0.02 / CELL)):
        values = best[row]
        is_peak = (values[1:-1] >= values[:-2]) & (values[1:-1] > values[2:]) & (values[1:-1] > SURE_CONTRAST)
        starts += [(float(values[column]), int(column), row) for column in np.flatnonzero(is_peak) + 1]
    starts.sort(reverse=True)
    found: list[np.ndarray] = []
    tried = np.zeros((0, 3))  # column, row and direction of all cells that were followed
    for _, column, row in starts:
        angle = float(ANGLES[direction[row, column]])
        near = np.abs(tried - [column, row, angle]) < [0.009 / CELL, 0.009 / CELL, 0.25]
        if near.all(1).any():
            continue
        below = _followed(ridges, column, row, angle, -1.0)
        line = np.array(below[::-1] + _followed(ridges, column, row, angle, 1.0)[1:], float)
        way = cv2.blur(np.gradient(line, axis=0), (1, 9), borderType=cv2.BORDER_REPLICATE) if len(line) > 1 else line
        tried = np.concatenate([tried, np.column_stack([line, np.arctan2(way[:, 0], -way[:, 1])])])
        if (len(line) - 1) * STEP < SHORTEST:
            continue
        apart = [np.hypot(*(line[::3, None] - other[None, ::2]).transpose(2, 0, 1)).min(1) for other in found]
        if not any((one < 0.0075 / CELL).mean() > 0.5 for one in apart):
            found.append(line)
    return found


_LATERAL = np.arange(-3.0, 3.01, 0.75)
"""[cells] Places beside the expected one that are tried when a line is followed."""


def _followed(ridges: np.ndarray, column: float, row: float, angle: float, sign: float) -> list[tuple[float, float]]:
    """Returns the cells of a line from its start: upwards if ``sign`` is 1, downwards if it is -1. It ends where the
    contrast is missing for longer than :data:`GAP`."""
    height, width = ridges.shape[1:]
    step = sign * STEP / CELL
    spacing = float(ANGLES[1] - ANGLES[0])
    line = [(float(column), float(row))]
    missing = 0
    last = 1
    while True:
        ahead = (line[-1][0] + step * np.sin(angle), line[-1][1] - step * np.cos(angle))
        x = ahead[0] + _LATERAL * np.cos(angle)
        y = ahead[1] + _LATERAL * np.sin(angle)
        columns = np.round(x).astype(int)
        rows = np.round(y).astype(int)
        if min(columns.min(), rows.min()) < 0 or columns.max() >= width or rows.max() >= height:
            break
        middle = round((angle - float(ANGLES[0])) / spacing)
        contrast = ridges[max(middle - 1, 0) : middle + 2, rows, columns].max(0)
        best = int(np.argmax(contrast - 0.6 * np.abs(_LATERAL)))
        if contrast[best] < CONTRAST:
            missing += 1
            if missing * STEP > GAP:
                break
            line.append(ahead)
        else:
            missing = 0
            line.append((float(x[best]), float(y[best])))
            last = len(line)
        recent = np.array(line[-round(MEMORY / STEP) :])
        if len(recent) >= 5:
            right, down = sign * (np.arange(len(recent)) - 0.5 * (len(recent) - 1)) @ recent
            turned = np.clip(np.arctan2(right, -down), angle - 0.12, angle + 0.12)
            angle = float(np.clip(turned, ANGLES[0], ANGLES[-1]))
    return line[:last]


def _axis(line: np.ndarray) -> _Axis | None:
    """Returns the lower part of a line as a curve of second order, continued straight by 7 cm downwards; None if too
    little of it is such a curve. Cells off the curve, as on old wood below a cane, are left out."""
    way = CELL * np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    fitted = way < FITTED
    for _ in range(4):
        curves = [np.polyfit(way[fitted], line[fitted, k], 2) for k in (0, 1)]
        off = np.hypot(*(line - np.stack([np.polyval(one, way) for one in curves], -1)).T)
        start = float(way[fitted][0])
        fitted = (off < 0.004 / CELL) & (way < start + FITTED)
        if np.count_nonzero(fitted) * STEP < 0.8 * SHORTEST:
            return None
    curves = [np.polyfit(way[fitted], line[fitted, k], 2) for k in (0, 1)]
    start = float(way[fitted][0])
    end = float(way[fitted][-1])
    at = np.arange(start - 0.07, end, CELL)
    inside = np.maximum(at, start)
    cells = np.stack(
        [np.polyval(one, inside) + (at - inside) * np.polyval(np.polyder(one), start) for one in curves], -1
    )
    tangent = np.gradient(cells, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return _Axis(at - start, cells, np.stack([-tangent[:, 1], tangent[:, 0]], -1), end - start)


def _axes(lines: list[np.ndarray], view: _View) -> list[_Axis]:
    """Returns the axes of lines, each cane once, without those on posts."""
    found: list[_Axis] = []
    for line in lines:
        columns, rows = np.round(line).astype(int).T
        if view.is_post[rows, columns].mean() > 0.5:
            continue
        axis = _axis(line)
        if axis is None:
            continue
        mine = axis.cells[(axis.way > 0.0) & (axis.way < 0.12)]
        apart = [np.hypot(*(mine[:, None] - other.cells[None]).transpose(2, 0, 1)).min(1) for other in found]
        if not any(np.mean(one < 0.006 / CELL) > 0.7 for one in apart):
            found.append(axis)
    return found


_BESIDE = np.arange(-0.015, 0.01501, 0.00075)
"""[m] Places across a cane at which its strip has colours."""


def _strip(view: _View, axis: _Axis) -> np.ndarray:
    """Returns the colours along a cane and across it [n, beside, 3]."""
    x, y = (axis.cells[:, None] + (_BESIDE / CELL)[None, :, None] * axis.normal[:, None]).transpose(2, 0, 1)
    return cv2.remap(view.lab, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)


def _spurs(axes: list[_Axis]) -> tuple[list[tuple[int, ...]], np.ndarray]:
    """Returns the numbers of the canes on each spur, one or two, and the way [cane] m at which each leaves it: where
    two meet, otherwise where a line ends."""
    base = np.zeros(len(axes))
    pairs = []
    for first, second in itertools.combinations(range(len(axes)), 2):
        one = axes[first]
        other = axes[second]
        if np.hypot(*(one.cells[0] - other.cells[0])) * CELL > 0.16:
            continue
        apart = CELL * np.hypot(*(one.cells[:, None] - other.cells[None]).transpose(2, 0, 1))
        fork = []
        for way, distance in ((one.way, apart.min(1)), (other.way, apart.min(0))):
            close = way[(distance < MEETING) & (way < 0.07)]
            beyond = distance[(way > 0.06) & (way < 0.16)]
            fork.append(close.max() if len(close) and len(beyond) and beyond.min() > MEETING else np.nan)
        # both lines end where they meet, not where others cross them
        if not np.isnan(fork).any() and np.abs(fork).max() < 0.06:
            pairs.append((float(np.abs(fork).sum()), first, second, *fork))
    taken: set[int] = set()
    spurs: list[tuple[int, ...]] = []
    for _, first, second, below, aside in sorted(pairs):
        if first in taken or second in taken:
            continue
        taken |= {first, second}
        spurs.append((first, second))
        base[first] = below
        base[second] = aside
    return spurs + [(one,) for one in range(len(axes)) if one not in taken], base


def _lean(axis: _Axis) -> float:
    """Returns the angle from upright [rad] of the first 12 cm of a cane."""
    mine = axis.cells[(axis.way > 0.0) & (axis.way < 0.12)]
    right, down = mine[-1] - mine[0]
    return float(np.arctan2(right, -down))


@dataclasses.dataclass(frozen=True, eq=False)
class _Comb:
    """The nodes of a cane as an evenly spaced comb."""

    first: float
    """Way to the ring of the lowest node [m]."""
    spacing: float
    """[m]"""
    rating: float
    """How much darker and redder the rings are than the wood between them; less if the comb is unusual."""
    signal: np.ndarray
    """[n] How dark and red the wood is, along the axis."""


def _comb(axis: _Axis, strip: np.ndarray, base: float) -> _Comb:
    """Returns the comb that fits best to the nodes of a cane whose base is at ``base`` [m]."""
    inside = strip[:, np.abs(_BESIDE) < 0.0025].mean(1)
    signal = inside[:, 1] / 1.2 - inside[:, 0] / 5.0  # how much rings differ, on average
    radius = round(0.03 / CELL)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(signal, radius, mode="edge"), 2 * radius + 1)
    signal = np.clip(signal - np.median(around, axis=1), -1.5, 1.5)
    kernel = np.ones(round(0.008 / CELL))
    signal = np.convolve(signal, kernel / len(kernel), mode="same")
    usual = base + FIRST_NODE - ABOVE_RING
    first = usual + np.arange(-0.026, 0.0261, 0.002)
    teeth = first[None, :, None] + INTERNODES[:, None, None] * np.arange(5)
    counted = teeth < axis.end
    count = np.maximum(counted.sum(-1), 1)
    at = np.interp(teeth, axis.way, signal)
    between = np.mean(
        [np.interp(teeth + part * INTERNODES[:, None, None], axis.way, signal) for part in (0.35, 0.5, 0.65)], axis=0
    )
    contrast = (np.where(counted, at - between, 0.0).sum(-1) / count) * np.sqrt(count)
    unusual = 0.1 * ((first - usual) / NODE_SPREAD) ** 2
    rating = contrast - unusual - 0.1 * ((INTERNODES[:, None] - INTERNODE) / INTERNODE_SPREAD) ** 2
    rating = np.where(counted.sum(-1) >= FEWEST_TEETH, rating, -10.0)
    best = np.unravel_index(np.argmax(rating), rating.shape)
    if rating[best] <= -10.0:
        return _Comb(usual, INTERNODE, -10.0, signal)
    return _Comb(float(first[best[1]]), float(INTERNODES[best[0]]), float(rating[best]), signal)


def _nodes(axis: _Axis, comb: _Comb) -> np.ndarray:
    """Returns the ways [k] m to the nodes of a cane, each at the darkest place near its tooth."""
    found = []
    for tooth in np.arange(comb.first, max(axis.end, comb.first + 1.5 * comb.spacing), comb.spacing).tolist():
        near = np.abs(axis.way - tooth) < 0.006
        found.append(float(axis.way[near][np.argmax(comb.signal[near])]) if near.any() else tooth)
    return np.array(found) + ABOVE_RING


def _seen(
    frame: CameraFrame, view: _View, axis: _Axis, strip: np.ndarray, base: float, nodes: np.ndarray
) -> SeenCane | None:
    """Returns the cane of an axis in the world; None if its depth is missing."""
    height, width = view.shown.shape
    columns = np.clip(np.round(axis.cells[:, 0]).astype(int), 0, width - 1)
    rows = np.clip(np.round(axis.cells[:, 1]).astype(int), 0, height - 1)
    measured = view.off[rows, columns]
    known = (np.abs(measured) < OFF_ROW) & (axis.way > base) & (axis.way < 0.22)
    if np.count_nonzero(known) < 20:
        return None
    typical = float(np.median(measured[known]))
    known &= np.abs(measured - typical) < 0.05
    if np.count_nonzero(known) < 20:
        return None
    depth = np.polyval(np.polyfit(axis.way[known], measured[known], 1), axis.way)
    eye = np.asarray(frame.pose, float)[:3]
    plane = view.places(axis.cells)
    rays = plane - eye
    # up to the measured surface, and on to the axis of the cane
    share = 1.0 + depth / (rays @ view.across)
    surface = eye + share[:, None] * rays
    scale = float(np.median(share[known]))
    # a round cane that is seen obliquely is wider on the plane than it is
    level = rays * np.array([1.0, 1.0, 0.0])
    turned = np.abs(level @ view.across) / np.linalg.norm(level, axis=1)
    diameter = scale * float(np.median(turned[known])) * _thickness(axis, strip)
    points = surface + 0.5 * diameter * frames.normalize(rays)
    start = int(np.searchsorted(axis.way, base))
    points = points[start:]
    if len(points) < round(SHORTEST / CELL):
        return None
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    reach = round(EDGE / CELL)
    whole = cv2.erode(view.shown.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8), borderValue=0)
    is_cut_off = not whole[rows[start], columns[start]]
    return SeenCane(
        points[::4],
        diameter,
        np.interp(nodes, axis.way[start:], way),
        float(np.linalg.norm(points[0] - eye)),
        is_cut_off,
    )


def _thickness(axis: _Axis, strip: np.ndarray) -> float:
    """Returns the thickness of a cane on the plane of the row [m]: where its colour has changed by half to that of its
    sides."""
    mine = (axis.way > 0.03) & (axis.way < 0.20)
    off = np.linalg.norm(strip - np.median(strip[:, np.abs(_BESIDE) < 0.002], axis=1)[:, None], axis=-1)[mine]
    widths = []
    for side in (1.0, -1.0):
        beside = side * _BESIDE
        order = np.argsort(beside)
        outer = (beside > SIDE - 0.0016) & (beside < SIDE + 0.0016)
        level = 0.5 * off[:, outer].mean(1)
        inner = order[beside[order] >= 0.0]
        crossed = off[:, inner] > level[:, None]
        first = np.argmax(crossed, axis=1)
        rows = np.arange(len(off))
        before = np.maximum(first - 1, 0)
        low = off[rows, inner[before]]
        high = off[rows, inner[first]]
        share = np.clip((level - low) / np.maximum(high - low, 1e-6), 0.0, 1.0)
        width = beside[inner[before]] + share * (beside[inner[first]] - beside[inner[before]])
        widths.append(np.where(crossed.any(1) & (level > 0.5 * CONTRAST), width, np.nan))
    both = widths[0] + widths[1]
    return float(np.nanmedian(both)) if np.isfinite(both).any() else 0.009
