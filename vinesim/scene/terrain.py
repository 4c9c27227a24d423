"""The uneven ground of a scene: heights on a regular grid, and the one law by which every consumer interpolates them.

The height at (x, y) is that of an inclined plane plus an interpolated *residual*. The residual is given at the nodes of
a grid; each cell is two triangles, divided by the diagonal from its lowest x and y to its highest, as MuJoCo divides
the cells of its height fields. Beyond the grid the residual of the nearest edge continues, and so does the plane.
Kernels use the same law (:mod:`vinesim.kernels.raster.ground`, :mod:`vinesim.kernels.contact.ground_distance`), so
cameras, lidars, plants, wheels and boxes meet the same triangles.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from vinesim.core import frames

FOOTPRINT_SAMPLES = 7
"""Number of samples along each side of a footprint, from which :meth:`Terrain.fit_plane` fits a plane."""


@dataclasses.dataclass(frozen=True, eq=False)
class Terrain:
    """Heights of the ground. All methods are vectorised: coordinates broadcast against each other [...]."""

    origin: tuple[float, float]
    """[m] x and y of the first node, which has the lowest x and y."""
    cell: float
    """[m] Distance between neighbouring nodes."""
    slope: tuple[float, float]
    """[1] Gradient of the inclined plane, which passes through the world's origin: rise along x and along y."""
    residual: np.ndarray
    """[row, column] float32 m, height of each node above the inclined plane; rows along y, columns along x."""

    def __post_init__(self) -> None:
        if self.residual.dtype != np.float32 or self.residual.ndim != 2 or min(self.residual.shape) < 2:
            raise ValueError(
                f"residual is {self.residual.dtype} {list(self.residual.shape)}; give float32 heights of 2 x 2 nodes "
                "or more"
            )

    @property
    def end(self) -> tuple[float, float]:
        """[m] x and y of the last node, which has the highest x and y."""
        rows, columns = self.residual.shape
        return self.origin[0] + self.cell * (columns - 1), self.origin[1] + self.cell * (rows - 1)

    def height(self, x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        """Returns the height [...] m of the ground at ``x``, ``y`` [...] m."""
        x = np.asarray(x, float)
        y = np.asarray(y, float)
        (low, along_x, along_y), fx, fy = self._triangle_at(x, y)
        return self.slope[0] * x + self.slope[1] * y + (low + fx * along_x + fy * along_y)

    def gradient(self, x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        """Returns the gradient [..., 2] of the height along x and y in the triangle at ``x``, ``y`` [...] m."""
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        (_, along_x, along_y), _, _ = self._triangle_at(x, y)
        inside = [(low <= at) & (at <= high) for at, low, high in zip((x, y), self.origin, self.end, strict=True)]
        across = self.slope[0] + np.where(inside[0], along_x / self.cell, 0.0)
        return np.stack([across, self.slope[1] + np.where(inside[1], along_y / self.cell, 0.0)], -1)

    def normal(self, x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        """Returns the upward unit normal [..., 3] of the triangle at ``x``, ``y`` [...] m."""
        gradient = self.gradient(x, y)
        return frames.normalize(np.concatenate([-gradient, np.ones((*gradient.shape[:-1], 1))], -1))

    def nodes(self) -> np.ndarray:
        """Returns the heights of the nodes [row, column] m."""
        rows, columns = self.residual.shape
        x = self.origin[0] + self.cell * np.arange(columns)
        y = self.origin[1] + self.cell * np.arange(rows)[:, None]
        return self.slope[0] * x + self.slope[1] * y + self.residual

    def fit_plane(
        self, x: np.ndarray | float, y: np.ndarray | float, yaw: np.ndarray | float, half: tuple[float, float]
    ) -> np.ndarray:
        """Fit a plane to the ground under a rectangle, by least squares of samples on a grid.

        Args:
            x: [...] m, centre of the rectangle.
            y: [...] m.
            yaw: [...] rad, direction of the rectangle's length.
            half: [m] half of its length and of its width.

        Returns:
            [..., 3]: height [m] of the plane at the centre, and its rise [1] along the length and along the width.
        """
        x, y, yaw = (np.asarray(value, float)[..., None] for value in (x, y, yaw))
        along, across, fit = _samples(*half)
        c = np.cos(yaw)
        s = np.sin(yaw)
        return self.height(x + c * along - s * across, y + s * along + c * across) @ fit

    def resting_pose(self, x: float, y: float, yaw: float, half: tuple[float, float]) -> np.ndarray:
        """Returns the pose [7] of a stiff rectangle that lies on the ground: in the plane of :meth:`fit_plane`, raised
        until it penetrates no sample. ``half``: see there."""
        height, along, across = self.fit_plane(x, y, yaw, half).tolist()
        share = np.linspace(-1.0, 1.0, 1 + 2 * FOOTPRINT_SAMPLES)
        u, v = (half[k] * grid for k, grid in enumerate(np.meshgrid(share, share)))
        c = np.cos(yaw)
        s = np.sin(yaw)
        above = self.height(x + c * u - s * v, y + s * u + c * v) - (height + along * u + across * v)
        return frames.pose([x, y, height + float(above.max())], tilt(yaw, along, across))

    def _triangle_at(
        self, x: np.ndarray, y: np.ndarray
    ) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
        """Returns the linear function of the residual in the triangle at ``x``, ``y`` [...] m (value at the cell's
        first node, change along x and along y over a cell), and the position in the cell along x and y, 0 to 1."""
        rows, columns = self.residual.shape
        u = np.minimum(np.maximum((x - self.origin[0]) / self.cell, 0.0), columns - 1)
        v = np.minimum(np.maximum((y - self.origin[1]) / self.cell, 0.0), rows - 1)
        i = np.minimum(u.astype(int), columns - 2)
        j = np.minimum(v.astype(int), rows - 2)
        fx = u - i
        fy = v - j
        node = self.residual.ravel()
        first = j * columns + i
        low = node[first].astype(float)
        high = node[first + (columns + 1)].astype(float)
        # the third corner is the one to the right of the first below the diagonal, and the one behind it above
        below = fx >= fy
        third = node[first + np.where(below, 1, columns)].astype(float)
        along = np.where(below, third - low, high - third)
        return (low, along, high - low - along), fx, fy


@functools.lru_cache(64)
def _samples(half_length: float, half_width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the samples of a rectangle along its length and its width [n] m, and the matrix [n, 3] that turns heights
    into the plane of :meth:`Terrain.fit_plane`. The grid is symmetric, so the unknowns of the fit are independent."""
    share = np.linspace(-1.0, 1.0, FOOTPRINT_SAMPLES)
    along, across = (
        half * grid.ravel() for half, grid in zip((half_length, half_width), np.meshgrid(share, share), strict=True)
    )
    fit = [np.full(len(along), 1.0 / len(along)), *(offset / (offset * offset).sum() for offset in (along, across))]
    return along, across, np.stack(fit, -1)


def tilt(yaw: float, along: float, across: float) -> np.ndarray:
    """Returns the quaternion [4] of a body on an inclined plane: its x axis points to ``yaw`` [rad] seen from above,
    its z axis along the plane's normal. ``along``, ``across``: rise [1] of the plane along x and y of a level body."""
    normal = np.array([-along, -across, 1.0])
    ahead = np.array([1.0, 0.0, along])
    left = frames.cross(normal, ahead)
    axes = frames.normalize(np.stack([ahead, left, normal]))
    return frames.multiply(frames.from_yaw(yaw), frames.from_matrix(axes.T))


def on_ground(terrain: Terrain | None, pose: np.ndarray) -> np.ndarray:
    """Returns an upright pose [7] higher by the height of the ground at its x and y."""
    if terrain is None:
        return pose
    raised = np.array(pose, float)
    raised[2] += terrain.height(raised[0], raised[1])
    return raised


def above_ground(terrain: Terrain | None, points: np.ndarray) -> np.ndarray:
    """Returns the heights [...] m of ``points`` [..., 3] m above the ground."""
    return points[..., 2] if terrain is None else points[..., 2] - terrain.height(points[..., 0], points[..., 1])


def ground_height(terrain: Terrain | None, x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
    """Returns the height [...] m of the ground at ``x``, ``y`` [...] m; 0 without terrain."""
    if terrain is None:
        return np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
    return terrain.height(x, y)
