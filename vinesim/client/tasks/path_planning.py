"""Paths of a base on the ground, around posts, trunks, wires and boxes: A* on a grid, then straightened."""

from __future__ import annotations

import heapq

import numpy as np

from vinesim.client.tasks.start_poses import ground_clearance
from vinesim.scene.model import Model

GRID_SIZE = 0.1
"""[m] Cell size of the grid on which paths are searched."""
MARGIN = 3.0
"""[m] By which the grid extends beyond start and goal."""

Cell = tuple[int, int]


def find_path(model: Model, start: np.ndarray, goal: np.ndarray, clearance: float) -> np.ndarray | None:
    """Waypoints [n, 2] m of a short path with ``clearance`` [m] on either side, ends included; None if there is none.

    Every waypoint of the grid is dropped that a straight line can replace.
    """
    low = np.minimum(start, goal) - MARGIN
    shape = tuple((np.ceil((np.maximum(start, goal) + MARGIN - low) / GRID_SIZE)).astype(int))
    at = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 2)
    free = (ground_clearance(model, low + GRID_SIZE * at) > clearance).reshape(shape)
    first, last = (_cell(np.round((p - low) / GRID_SIZE)) for p in (start, goal))
    if not free[last] or float(ground_clearance(model, np.array([start]))[0]) < clearance:
        return None
    cells = search_grid(free, first, last)
    if cells is None:
        return None
    points = [start, *(low + GRID_SIZE * np.array(cell) for cell in cells[1:-1]), goal]
    kept = [points[0]]
    i = 0
    while i < len(points) - 1:
        i = next(
            j
            for j in range(len(points) - 1, i, -1)
            if j == i + 1 or _is_line_free(model, points[i], points[j], clearance)
        )
        kept.append(points[i])
    return np.array(kept)


def search_grid(free: np.ndarray, first: Cell, last: Cell) -> list[Cell] | None:
    """Shortest path over the cells that are ``free`` [n, m] bool, both ends included; None if there is none.

    A* with eight neighbours and Euclidean costs (Hart, Nilsson and Raphael 1968).
    """
    moves = [(i, j, float(np.hypot(i, j))) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    previous: dict[Cell, Cell] = {first: first}
    cost = {first: 0.0}
    queue = [(0.0, first)]
    while queue:
        _, here = heapq.heappop(queue)
        if here == last:
            break
        for i, j, length in moves:
            there = (here[0] + i, here[1] + j)
            if not (0 <= there[0] < free.shape[0] and 0 <= there[1] < free.shape[1] and free[there]):
                continue
            price = cost[here] + length
            if price < cost.get(there, np.inf):
                cost[there] = price
                previous[there] = here
                ahead = float(np.hypot(there[0] - last[0], there[1] - last[1]))
                heapq.heappush(queue, (price + ahead, there))
    if last not in previous:
        return None
    cells = [last]
    while cells[-1] != first:
        cells.append(previous[cells[-1]])
    return cells[::-1]


def _cell(index: np.ndarray) -> Cell:
    """Whole indices of a cell from ``index`` [2]."""
    return int(index[0]), int(index[1])


def _is_line_free(model: Model, start: np.ndarray, end: np.ndarray, clearance: float) -> bool:
    """Whether the straight line from ``start`` to ``end`` [2] m has ``clearance`` [m] on either side."""
    count = max(int(np.linalg.norm(end - start) / (0.5 * GRID_SIZE)), 2)
    line = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
    return bool((ground_clearance(model, line) > clearance - 0.5 * GRID_SIZE).all())
