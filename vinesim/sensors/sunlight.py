"""Sun, sky and the cached shadow maps of one camera.

Two maps follow the camera: a fine one around what it looks at, a coarse one of the plants far around. A map is drawn
anew only when the camera has left its middle, or when something inside it has moved, and then at a bounded rate.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.kernels import shade, shadows
from vinesim.sensors import textures
from vinesim.sensors.primitives import Primitives

DEFAULT_SUN = (-0.41, -0.52, 0.75)
"""Towards the sun: south-west, half-way up."""


_SPREAD = (8, 16)
"""Threads that share the primitives of a cluster, and the rows of each of them, on a GPU."""


def _vector(v: np.ndarray) -> wp.vec3:
    return wp.vec3(float(v[0]), float(v[1]), float(v[2]))


def _pairs(x: np.ndarray, y: np.ndarray, device: str) -> wp.array:
    return wp.array(np.stack([x, y], 1).astype(np.float32), dtype=wp.vec2, device=device)


class _Map:
    """One square of depths seen from the sun, around a focus that moves in steps."""

    def __init__(
        self, sun: np.ndarray, texel: float, side: int, ahead: float, slack: float, rigid: bool, device: str
    ) -> None:
        self.sun, self.ahead, self.slack, self.rigid, self.device = sun, ahead, slack, rigid, device
        self.right = np.cross(sun, [0.0, 0.0, 1.0]) if abs(sun[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
        self.right /= np.linalg.norm(self.right)
        self.up = np.cross(self.right, sun)
        self.focus = np.full(3, np.inf)
        self.time, self.version, self.built = -np.inf, -1, -1
        self._every, self._known = wp.empty(0, dtype=wp.int32, device=device), -1
        self.struct = shadows.ShadowMap()
        self.struct.depth = wp.empty(side * side, dtype=float, device=device)
        self.struct.right, self.struct.up, self.struct.sun = _vector(self.right), _vector(self.up), _vector(sun)
        self.struct.texel, self.struct.side = float(texel), side
        self.half = 0.5 * texel * side

    def follow(self, primitives: Primitives, eye: np.ndarray, forward: np.ndarray, time: float, period: float) -> None:
        """Draw the map anew if it no longer holds for this camera at ``time``."""
        wanted = eye + self.ahead * forward
        strayed = not np.linalg.norm(wanted - self.focus) <= self.slack
        other = self.built != primitives.built
        if not (strayed or other):
            due = self.rigid and not 0.0 <= time - self.time < period
            if not due or not (primitives.cluster_version[self._inside(primitives)] > self.version).any():
                return
        if strayed:
            self.focus = wanted
        self.time, self.version, self.built = time, primitives.version, primitives.built
        self._draw(primitives)

    def _inside(self, primitives: Primitives) -> np.ndarray:
        """Clusters whose shadows may fall into the square."""
        ball = primitives.ball.numpy()
        apart = ball[:, :3] - self.focus
        reach = self.half + ball[:, 3]
        inside = (ball[:, 3] > 0.0) & (np.abs(apart @ self.right) < reach) & (np.abs(apart @ self.up) < reach)
        if not self.rigid:
            inside[primitives.rigid_clusters] = False
        return np.flatnonzero(inside)

    def _casting(self, primitives: Primitives) -> wp.array:
        """Clusters that this map shows, wherever they are."""
        if self._known != primitives.built:
            every = np.arange(len(primitives.cluster_first), dtype=np.int32)
            mine = every if self.rigid else np.delete(every, primitives.rigid_clusters)
            self._every, self._known = wp.array(mine, device=self.device), primitives.built
        return self._every

    def _draw(self, primitives: Primitives) -> None:
        self.struct.corner = _vector(self.focus - self.half * (self.right + self.up))
        self.struct.depth.fill_(1.0e9)
        if self.device == "cpu":
            which, lanes, slices = wp.array(self._inside(primitives).astype(np.int32), device="cpu"), 1, 1
        else:  # a GPU culls faster than it can be told what to draw, and wants a thread for every row
            which, (lanes, slices) = self._casting(primitives), _SPREAD
        if len(which):
            wp.launch(
                shadows.cast_shadows,
                (len(which), lanes, slices),
                inputs=[
                    primitives.shapes,
                    primitives.clusters,
                    primitives.ball,
                    which,
                    self.struct,
                    0.25,
                    lanes,
                    slices,
                ],
                outputs=[self.struct.depth],
                device=self.device,
            )


class Sunlight:
    """Light of one camera's surroundings."""

    def __init__(
        self, sun: tuple[float, float, float] = DEFAULT_SUN, *, taps: int = 4, period: float = 0.2, device: str = "cpu"
    ) -> None:
        """``sun`` points towards the sun; ``taps`` are shadow samples a pixel; ``period`` [s] as in :class:`Camera`."""
        direction = np.asarray(sun, float) / np.linalg.norm(sun)
        self.period = period
        day = float(np.clip(direction[2] / 0.15, 0.0, 1.0))
        dim = 0.04 + 0.96 * day
        light = shade.Light()
        light.sun = _vector(direction)
        light.sun_colour = wp.vec3(3.3 * day, 2.95 * day, 2.35 * day)
        light.sky_colour = wp.vec3(0.52 * dim, 0.70 * dim, 1.0 * dim)
        light.bounce = wp.vec3(0.26 * dim, 0.21 * dim, 0.13 * dim)
        light.haze = wp.vec3(0.50 * dim, 0.60 * dim, 0.72 * dim)
        light.exposure, light.taps = 0.75, taps
        light.table = wp.array(textures.sky(tuple(direction)) * np.float32(dim), dtype=wp.vec3, device=device)
        k = np.arange(max(taps, 1))
        angle, radius = 2.399963 * k, np.sqrt((k + 0.5) / len(k))
        light.spiral = _pairs(radius * np.cos(angle), radius * np.sin(angle), device)
        turn = np.arange(64) * (2.0 * np.pi / 64)
        light.turns = _pairs(np.cos(turn), np.sin(turn), device)
        light.tone = wp.array(textures.tone_curve(), dtype=wp.uint8, device=device)
        self.light = light
        raised = np.array([direction[0], direction[1], max(direction[2], 0.1)])
        raised /= np.linalg.norm(raised)
        self._near = _Map(raised, 0.007, 1024, 2.5, 0.8, True, device)
        self._far = _Map(raised, 0.035, 1024, 12.0, 4.0, False, device)

    def follow(
        self, primitives: Primitives, eye: np.ndarray, forward: np.ndarray, time: float
    ) -> tuple[shadows.ShadowMap, shadows.ShadowMap]:
        """The fine and the coarse shadow map for a camera at ``eye`` that looks along ``forward``."""
        for one in (self._near, self._far):
            one.follow(primitives, eye, forward, time, self.period)
        return self._near.struct, self._far.struct
