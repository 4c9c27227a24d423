"""Sun, sky and the cached shadow maps of one camera.

Two shadow maps follow the camera: a fine one around the point that the camera looks at, and a coarse one of the plants
farther away. A map is redrawn only when the camera has left the map's middle, or when an object inside the map has
moved, and then at a bounded rate.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from vinesim.core.thread_pool import ThreadPool
from vinesim.kernels.shading import deferred, shadow_maps
from vinesim.scene.palette import DEFAULT, Palette
from vinesim.sensors.primitives import textures
from vinesim.sensors.primitives.scene_primitives import Primitives

DEFAULT_SUN = (-0.41, -0.52, 0.75)
"""Vector towards the sun: in the south-west, about 50 degrees high."""


Window = tuple[int, int, int, int]
"""A rectangle of texels in a shadow map: first column, last column + 1, first row, last row + 1."""
_TILES = 8
"""Number of tiles across (and down) into which a shadow map is divided to redraw only parts of it."""
_NOTHING = 1.0e9
"""Depth [m] of texels on which no primitive is drawn."""
_GPU_THREADS = (8, 16)
"""Numbers of GPU threads that share the primitives of a cluster, and that share the rows of a primitive."""


def _vector(v: np.ndarray) -> wp.vec3:
    return wp.vec3(float(v[0]), float(v[1]), float(v[2]))


def _pairs(x: np.ndarray, y: np.ndarray, device: str) -> wp.array:
    return wp.array(np.stack([x, y], 1).astype(np.float32), dtype=wp.vec2, device=device)


class ShadowSquare:
    """One cached square shadow map around a point in front of the camera; the map moves in steps and is redrawn
    then."""

    def __init__(
        self,
        texel: float,
        side: int,
        ahead: float,
        slack: float,
        rigid: bool,
        depth: wp.array,
        device: str,
        workers: ThreadPool,
    ) -> None:
        """``texel``: width of a texel [m]; ``side``: number of texels along a side; ``ahead``: distance of the map's
        centre in front of the camera [m]; ``slack``: distance [m] that the centre may move before the map is redrawn;
        ``rigid``: draw rigid bodies, too, and redraw the map when objects move; ``depth``: [side * side] memory of the
        map."""
        self.ahead = ahead
        self.slack = slack
        self.rigid = rigid
        self.device = device
        self._workers = workers
        self._every = wp.empty(0, dtype=wp.int32, device=device)
        self._known = -1
        self.struct = shadow_maps.ShadowMap()
        self.struct.depth = depth
        self.struct.texel = float(texel)
        self.struct.side = side
        self.half = 0.5 * texel * side
        self._drawn_balls = np.zeros((0, 4), np.float32)
        """[cluster, 4] Bounding spheres of all clusters when the map was last drawn; empty on a GPU, which always
        redraws the whole map."""

    def set_sun(self, sun: np.ndarray) -> None:
        """Set the unit vector towards the sun, ``sun`` [3]; the whole map becomes invalid."""
        self.right = np.cross(sun, [0.0, 0.0, 1.0]) if abs(sun[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
        self.right /= np.linalg.norm(self.right)
        self.up = np.cross(self.right, sun)
        self.focus = np.full(3, np.inf)
        self.time = -np.inf
        self.version = -1
        self.built = -1
        self.struct.right, self.struct.up, self.struct.sun = _vector(self.right), _vector(self.up), _vector(sun)

    def follow(self, primitives: Primitives, eye: np.ndarray, forward: np.ndarray, time: float, period: float) -> None:
        """Redraw the map, or its changed part, if it is no longer valid for a camera at ``eye`` [3] m that looks along
        ``forward`` [3] at ``time`` [s].

        ``period``: least time [s] between redraws because of moving objects.
        """
        wanted = eye + self.ahead * forward
        strayed = not np.linalg.norm(wanted - self.focus) <= self.slack
        other = self.built != primitives.layout_version
        if strayed or other:
            if strayed:
                self.focus = wanted
            windows = self._whole()
        else:
            due = self.rigid and not 0.0 <= time - self.time < period
            windows = self._changed_windows(primitives) if due else []
            if not windows:
                return
            if self.device != "cpu":
                windows = self._whole()
        self.time = time
        self.version = primitives.pose_version
        self.built = primitives.layout_version
        self._draw(primitives, windows)

    def _whole(self) -> list[Window]:
        """Returns rectangles that cover the whole map, one for each thread."""
        side = self.struct.side
        count = self._workers.size
        return [(0, side, side * i // count, side * (i + 1) // count) for i in range(count)]

    def _texels(self, ball: np.ndarray) -> np.ndarray:
        """Returns bounds [ball, 4] of the shadows of spheres ``ball`` [ball, 4] in texels: least and largest column,
        least and largest row."""
        apart = ball[:, :3] - self.focus
        middle = np.stack([apart @ self.right, apart @ self.up], 1) / self.struct.texel + 0.5 * self.struct.side
        reach = ball[:, 3:] / self.struct.texel + float(shadow_maps.SHADOW_MARGIN) + 1.0
        return np.stack([middle - reach, middle + reach], 2).reshape(-1, 4)

    def _changed_windows(self, primitives: Primitives) -> list[Window]:
        """Returns rectangles that contain all shadows that moved since the map was drawn, at their old and new
        places."""
        moved = primitives.cluster_version > self.version
        balls = primitives.ball.numpy()[moved]
        if self.device == "cpu":
            balls = np.concatenate([balls, self._drawn_balls[moved]])
        side = self.struct.side
        texels = self._texels(balls[balls[:, 3] > 0.0])
        texels = texels[(texels[:, ::2] < side).all(1) & (texels[:, 1::2] > 0.0).all(1)]
        tile = np.clip(texels, 0.0, side - 1.0).astype(int) * _TILES // side
        # +1 and -1 at the corners of each rectangle; cumulative sums follow
        dirty = np.zeros((_TILES + 1, _TILES + 1), int)
        for row, column, value in ((2, 0, 1), (2, 1, -1), (3, 0, -1), (3, 1, 1)):
            np.add.at(dirty, (tile[:, row] + (row == 3), tile[:, column] + (column == 1)), value)
        dirty = dirty.cumsum(0).cumsum(1)[:-1] > 0
        windows = []
        for row in range(_TILES):
            steps = np.flatnonzero(np.diff(dirty[row].astype(int), prepend=0))
            for first, end in steps.reshape(-1, 2):
                windows.append(tuple(side * n // _TILES for n in (first, end, row, row + 1)))
        return windows

    def _casters_inside(self, primitives: Primitives, window: Window) -> np.ndarray:
        """Returns the clusters [k] (runs of primitives) whose shadows may touch the rectangle ``window`` of the map."""
        ball = primitives.ball.numpy()
        texels = self._texels(ball)
        inside = (ball[:, 3] > 0.0) & (texels[:, 0] < window[1]) & (texels[:, 1] > window[0])
        inside &= (texels[:, 2] < window[3]) & (texels[:, 3] > window[2])
        if not self.rigid:
            inside[primitives.rigid_clusters] = False
        return np.flatnonzero(inside)

    def _casters(self, primitives: Primitives) -> wp.array:
        """Returns all clusters (runs of primitives) that this map draws, wherever they are: plants, and rigid bodies if
        the map draws them."""
        if self._known != primitives.layout_version:
            every = np.arange(len(primitives.cluster_first), dtype=np.int32)
            mine = every if self.rigid else np.delete(every, primitives.rigid_clusters)
            self._every = wp.array(mine, device=self.device)
            self._known = primitives.layout_version
        return self._every

    def _draw(self, primitives: Primitives, windows: list[Window]) -> None:
        self.struct.corner = _vector(self.focus - self.half * (self.right + self.up))
        if self.device == "cpu":
            self._drawn_balls = primitives.ball.numpy().copy()
        self._workers.share([functools.partial(self._draw_window, primitives, window) for window in windows])

    def _draw_window(self, primitives: Primitives, window: Window) -> None:
        """Clear and redraw the rectangle ``window`` of the map."""
        if self.device == "cpu":
            which = wp.array(self._casters_inside(primitives, window).astype(np.int32), device="cpu")
            lanes = 1
            slices = 1
            square = self.struct.depth.numpy().reshape(self.struct.side, self.struct.side)
            square[window[2] : window[3], window[0] : window[1]] = _NOTHING
        else:  # culling on the GPU takes less time than a transfer of a list; one thread for each row
            which = self._casters(primitives)
            (lanes, slices) = _GPU_THREADS
            self.struct.depth.fill_(_NOTHING)
        if len(which):
            scene = [primitives.shapes, primitives.clusters, primitives.ball, which, self.struct]
            wp.launch(
                shadow_maps.raster_shadow_map,
                (len(which), lanes, slices),
                inputs=[*scene, 0.25, wp.vec4i(*map(int, window)), lanes, slices],
                outputs=[self.struct.depth],
                device=self.device,
            )


SunPath = Callable[[float], tuple[float, float, float]]
"""Function from simulated time [s] to the unit vector towards the sun."""
_MIN_COS_CHANGE = np.cos(np.radians(0.25))
"""Cosine of the motion of the sun (a quarter of a degree, or one minute) after which the light is computed again."""
_NOON_SUN = np.array([3.3, 2.95, 2.35])
"""Linear RGB of sunlight when the sine of the sun's elevation is :data:`_NOON_SINE`, in units in which a white sheet in
full light has radiance 1."""
_NOON_SINE = 0.75
_OPTICAL_DEPTH = np.array([0.10, 0.15, 0.27])
"""Optical depth of clear country air at 610, 550 and 465 nm (red, green, blue): Rayleigh scattering and some haze."""
_CLEAR_SKY = np.array(DEFAULT.sky.light)
_WHITE_BALANCE_SHARE = 0.6
"""Share of the daylight's colour cast that a camera's white balance removes, 0 to 1."""


def air_mass(height: float) -> float:
    """Returns the relative air mass on the path of sunlight, 1 for a sun in the zenith (Kasten and Young 1989).

    ``height``: sine of the sun's elevation.
    """
    degrees = np.degrees(np.arcsin(np.clip(height, 0.0, 1.0)))
    return float(1.0 / (max(height, 0.0) + 0.50572 * (degrees + 6.07995) ** -1.6364))


def daylight(height: float) -> tuple[np.ndarray, float]:
    """Returns the linear RGB [3] of direct sunlight, and the brightness of the sky relative to noon.

    ``height``: sine of the sun's elevation.
    """
    sun = (
        _NOON_SUN
        * np.exp(-_OPTICAL_DEPTH * (air_mass(height) - air_mass(_NOON_SINE)))
        * np.clip(height / 0.02 + 0.5, 0.0, 1.0)
    )
    return sun, 0.04 + 0.96 * float(np.clip((height + 0.1) / (_NOON_SINE + 0.1), 0.0, 1.0) ** 0.8)


_TWILIGHT = 0.052
"""Sine of the sun's depression, 3 degrees, over which the light of twilight falls to a tenth (civil twilight: 400 lx at
sunset, 3.4 lx at its end, 6 degrees)."""


@dataclasses.dataclass(frozen=True)
class OutdoorLight:
    """Daylight for one elevation of the sun. Colours are linear RGB [3]."""

    sun: np.ndarray
    sky: np.ndarray
    haze: np.ndarray
    ground: np.ndarray
    """Light that the ground reflects."""
    canopy: np.ndarray
    """Light that the canopy transmits."""
    dim: float
    """Brightness of the sky, relative to noon."""
    brightness: float
    """Illuminance of the ground, relative to noon."""
    balance: np.ndarray
    """White balance of a camera in this light: factors [3] on linear RGB."""

    @classmethod
    def of(cls, height: float, palette: Palette = DEFAULT) -> OutdoorLight:
        """Returns the daylight for ``height``, the sine of the sun's elevation, in a vineyard with the colours of
        ``palette``."""
        sun, dim = daylight(height)
        sun = sun * palette.sky.sun
        sky = np.array(palette.sky.light) * dim
        falls = sun * max(height, 0.05) + sky
        usual = _NOON_SUN * _NOON_SINE + _CLEAR_SKY
        brightness = float(falls.mean() / usual.mean())
        return cls(
            sun,
            sky,
            np.array(palette.sky.haze) * dim,
            np.array(palette.ground.bounce) * brightness,
            np.array(palette.leaf.shade) * brightness,
            dim,
            brightness,
            (usual / usual.mean() / (falls / falls.mean())) ** _WHITE_BALANCE_SHARE,
        )

    def dimmed(self, share: float) -> OutdoorLight:
        """Returns this light without sun, with the ``share`` of all other light, for a camera with a flash: without one
        a night is as bright as the end of the day, so that robots see something. The balance is that of white light,
        as of the flash."""
        other = (self.sky * share, self.haze * share, self.ground * share, self.canopy * share)
        return OutdoorLight(np.zeros(3), *other, self.dim * share, self.brightness * share, np.ones(3))


def set_daylight(light: deferred.Light, sun: np.ndarray, now: OutdoorLight, palette: Palette, device: str) -> None:
    """Set the colours of ``light``, and its table of the sky. ``sun``: unit vector [3] towards it; ``now``: the
    daylight."""
    light.sun = _vector(sun)
    light.sun_colour = _vector(now.sun)
    light.sky_colour = _vector(now.sky)
    light.haze_colour = _vector(now.haze)
    light.haze_rate = palette.sky.haze_rate
    light.ground_colour = _vector(now.ground)
    light.canopy_colour = _vector(now.canopy)
    table = textures.sky_texture(tuple(sun), tuple(now.sun), palette.sky) * np.float32(now.dim)
    light.sky_table = wp.array(table, dtype=wp.vec3, device=device)


def set_samples(light: deferred.Light, taps: int, device: str) -> None:
    """Set the samples of shadows of ``light``, see its ``shadow_taps``."""
    light.shadow_taps = taps
    k = np.arange(max(taps, 1))
    angle = 2.399963 * k
    radius = np.sqrt((k + 0.5) / len(k))
    light.sample_spiral = _pairs(radius * np.cos(angle), radius * np.sin(angle), device)
    turn = np.arange(64) * (2.0 * np.pi / 64)
    light.sample_rotations = _pairs(np.cos(turn), np.sin(turn), device)


class Sunlight:
    """Light of sun and sky, and the two shadow maps, for one camera."""

    def __init__(
        self,
        sun: tuple[float, float, float] | SunPath = DEFAULT_SUN,
        *,
        taps: int = 4,
        period: float = 0.2,
        fine: int = 1,
        flash: float = 0.0,
        device: str = "cpu",
        workers: ThreadPool | None = None,
    ) -> None:
        """``sun``: vector towards the sun, or a function from simulated time [s] to that vector.

        ``taps``: ``shadow_taps`` of :class:`vinesim.kernels.shading.deferred.Light`; ``period``: least time [s] between
        redraws of shadows; ``fine``: divisor of the texel size of the near shadow map; ``flash``: ``flash`` of
        :class:`vinesim.kernels.shading.deferred.Light` while the sun is below the horizon.
        """
        self._path: SunPath = sun if callable(sun) else lambda time: sun
        self.period = period
        self._flash = flash
        self._device = device
        self._direction = np.zeros(3)
        self._palette = DEFAULT
        self.balance = np.ones(3)
        """White balance: factors [3] on linear light."""
        self.brightness = 1.0
        """Illuminance of the ground, relative to noon."""
        light = deferred.Light()
        set_samples(light, taps, device)
        self.light = light
        workers = workers or ThreadPool(1)
        side = 1024 * fine
        self.depth = wp.empty(side * side + 1024 * 1024, dtype=float, device=device)
        """[texel] Depths [m] of the near shadow map, followed by those of the far one."""
        near = self.depth[: side * side]
        far = self.depth[side * side :]
        self._near = ShadowSquare(0.007 / fine, side, 2.5, 0.8, True, near, device, workers)
        self._far = ShadowSquare(0.035, 1024, 12.0, 4.0, False, far, device, workers)

    def _update_light(self, time: float, palette: Palette) -> None:
        """Compute the daylight again if the sun has moved by a quarter of a degree since the last time, or if the
        palette is another one."""
        direction = np.asarray(self._path(time), float)
        direction = direction / np.linalg.norm(direction)
        if direction @ self._direction > _MIN_COS_CHANGE and palette is self._palette:
            return
        self._direction = direction
        self._palette = palette
        light = self.light
        light.flash = self._flash if direction[2] < 0.0 else 0.0
        now = OutdoorLight.of(direction[2], palette)
        if light.flash > 0.0:
            now = now.dimmed(10.0 ** (direction[2] / _TWILIGHT))
        set_daylight(light, direction, now, palette, self._device)
        self.brightness = now.brightness
        self.balance = now.balance
        raised = np.array([direction[0], direction[1], max(direction[2], 0.1)])
        raised /= np.linalg.norm(raised)
        self._near.set_sun(raised)
        self._far.set_sun(raised)

    def update(
        self, primitives: Primitives, eye: np.ndarray, forward: np.ndarray, time: float
    ) -> tuple[shadow_maps.ShadowMap, shadow_maps.ShadowMap]:
        """Compute light and shadows again where they are no longer valid at ``time`` [s], for a camera at ``eye`` [3] m
        that looks along ``forward`` [3]. Returns the fine and the coarse shadow map."""
        self._update_light(time, primitives.model.look.palette)
        for one in (self._near, self._far):
            one.follow(primitives, eye, forward, time, self.period)
        return self._near.struct, self._far.struct
