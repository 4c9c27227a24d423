"""RGB-D cameras: a picture, labels, exact depth, and depth as the sensor would measure it.

Depth follows REP-118: metres along the optical axis; -Inf for surfaces nearer than the sensor's range, +Inf for
surfaces beyond its range and for the sky; NaN for a pixel within the range whose measurement failed
(:mod:`vinesim.sensors.camera.stereo`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Annotated

import msgspec
import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.thread_pool import MAX_THREADS, ThreadPool, usable_cores
from vinesim.kernels.graph import outside_captures
from vinesim.kernels.raster import camera_raster, camera_raster_plants
from vinesim.kernels.raster.pinhole import Pinhole
from vinesim.kernels.shading import colour_response, deferred, light_plants, light_points, shadow_maps, tone_rows
from vinesim.kernels.shading.shadow_maps import ShadowMap
from vinesim.kernels.stereo import stereo_rows
from vinesim.scene.plant_parameters import Number
from vinesim.scene.values import CameraFrame, CameraInfo, CameraMount, CameraOutput, Snapshot
from vinesim.sensors import spec_file
from vinesim.sensors.camera.defocus import LensSpec, automatic_focus, defocused
from vinesim.sensors.camera.exposure import Exposure
from vinesim.sensors.camera.live_light import LiveLight
from vinesim.sensors.camera.live_light import shadow_maps as shadow_maps_of
from vinesim.sensors.camera.motion import Moments, Motion
from vinesim.sensors.camera.response import ColourSpec, Response
from vinesim.sensors.camera.stereo import Stereo, StereoSpec
from vinesim.sensors.camera.sunlight import DEFAULT_SUN, Sunlight, SunPath
from vinesim.sensors.ground_truth import visible_bunches
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.camera_rasterizer import CameraRasterizer, pinhole, supersampled
from vinesim.sensors.raster.lens_map import LensError, LensMap, lens_map
from vinesim.sensors.sensor import SensorMaker, SensorSetting

COLOURS = ("camera", "exact")
"""Colours of a picture: ``camera``, those of the camera's data sheet; ``exact``, before the camera's response, as of a
data sheet without ``[colour]``."""


class CameraSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The data sheet of one model of camera, from a file in ``data/cameras``."""

    model: str
    width: Annotated[Number, "px", (1.0, 8192.0)]
    height: Annotated[Number, "px", (1.0, 8192.0)]
    fx: Annotated[Number, "px", (1.0, 1e6)]
    fy: Annotated[Number, "px", (1.0, 1e6)]
    nearest: Annotated[Number, "m", (0.0, 1000.0)]
    """Smallest depth that is measured."""
    farthest: Annotated[Number, "m", (0.0, 1000.0)]
    """Largest depth that is measured."""
    rate: Annotated[Number, "Hz", (0.01, 1000.0)]
    stereo: StereoSpec | None = None
    """Parameters of the stereo matching that measures depth; None: depth is measured exactly."""
    distortion: Annotated[spec_file.Numbers | None, "1", (-1000.0, 1000.0)] = None
    """Coefficients of the lens distortion, in the order of sensor_msgs/CameraInfo: 5 (plumb_bob) or 8
    (rational_polynomial); None: a pinhole. Colour, depth and labels have equal distortion."""
    colour: ColourSpec | None = None
    """How light becomes 8-bit colours; None: exact colours, with neither noise nor clipping."""
    lens: LensSpec | None = None
    """Aperture and focus, which blur what is out of focus; None: everything is in focus. Only for cameras with
    ``colour``."""

    @classmethod
    def load(cls, name: str) -> CameraSpec:
        """Read a camera's data sheet: ``name`` is the path of a file, or the name of a file in ``data/cameras``."""
        spec = spec_file.load("cameras", name, cls)
        if not 0.0 <= spec.nearest.value < spec.farthest.value:
            raise spec_file.SensorError(
                f"camera {name!r} measures from {spec.nearest.value} to {spec.farthest.value} m, an empty range; "
                "give 0 <= nearest < farthest"
            )
        try:
            lens_map(spec.info(""))
        except LensError as error:
            raise spec_file.SensorError(f"camera {name!r}: {error}") from error
        if spec.colour is not None:
            spec.colour.check(name)
        elif spec.lens is not None:
            raise spec_file.SensorError(f"camera {name!r} has a table lens but none with its colours; give colour, too")
        return spec

    def mounted(self, mount: CameraMount) -> CameraSpec:
        """Returns the data sheet with the values that a robot's ``mount`` gives instead."""
        number = msgspec.structs.replace
        spec = self.coloured(mount.colour)
        if mount.field_of_view is not None:
            focal = 0.5 * self.width.value / math.tan(0.5 * mount.field_of_view)
            spec = msgspec.structs.replace(spec, fx=number(self.fx, value=focal), fy=number(self.fy, value=focal))
        if mount.range is not None:
            near, far = (
                number(one, value=value) for one, value in zip((self.nearest, self.farthest), mount.range, strict=True)
            )
            spec = msgspec.structs.replace(spec, nearest=near, farthest=far)
        return spec

    def coloured(self, colour: str) -> CameraSpec:
        """Returns the data sheet for pictures with the ``colour`` of :data:`COLOURS`. Raises :class:`SensorError` for
        another word."""
        if colour not in COLOURS:
            raise spec_file.SensorError(f"colour is {colour!r}; give {' or '.join(COLOURS)}")
        return self if colour == "camera" else msgspec.structs.replace(self, colour=None, lens=None)

    def ideal(self) -> CameraSpec:
        """Returns the data sheet of a camera like this one that measures depth exactly at any distance, has exact
        colours, and is in focus everywhere."""
        number = msgspec.structs.replace
        near = number(self.nearest, value=0.0)
        far = number(self.farthest, value=1000.0)
        return msgspec.structs.replace(self, nearest=near, farthest=far, stereo=None, colour=None, lens=None)

    def info(self, frame_id: str, scale: float = 1.0, size: tuple[int, int] | None = None) -> CameraInfo:
        """Returns the intrinsics, with the principal point in the middle of the picture.

        ``scale``: factor on width, height and focal lengths. ``size``: width and height [px] instead of the camera's
        own, with an equal horizontal field of view; ``scale`` is then not used.
        """
        width = round(self.width.value * scale)
        height = round(self.height.value * scale)
        if size is not None:
            width, height = size
            scale = width / self.width.value
        return CameraInfo(
            width,
            height,
            self.fx.value * scale,
            self.fy.value * scale,
            0.5 * (width - 1),
            0.5 * (height - 1),
            frame_id,
            self.distortion.value if self.distortion is not None and any(self.distortion.value) else (),
        )


@dataclasses.dataclass(frozen=True)
class Quality:
    """Rendering settings that trade computing time against the look of a picture; exact depth and labels do not depend
    on them."""

    taps: int
    """Number of samples of the shadow map for each pixel. 0: the shadow map is filtered with two widths instead; -1:
    with one width."""
    block: int
    """Width and height [px] of the blocks of pixels within which each primitive is shaded once."""
    samples: int
    """Number of colour samples along each side of a pixel."""
    shadow_texel_divisor: int
    """Divisor of the texel size of the near shadow map; 2 doubles the map's resolution."""
    is_live: bool
    """Whether two faster methods are used on a CPU: eight points are shaded at once
    (:mod:`vinesim.sensors.camera.live_light`), and the depth in view of a stereo camera's second imager is computed
    from the depth of the first imager instead of rendered."""


QUALITIES = {
    "fast": Quality(taps=-1, block=2, samples=1, shadow_texel_divisor=1, is_live=True),
    "full": Quality(taps=0, block=1, samples=1, shadow_texel_divisor=1, is_live=False),
    "still": Quality(taps=12, block=2, samples=2, shadow_texel_divisor=2, is_live=False),
}
"""Qualities by name: ``fast`` for robots' cameras, ``full`` for spectators, ``still`` for pictures and data sets."""


@functools.cache
def load_camera_kernels() -> None:
    """Compile the CPU kernels of cameras, or load them from the cache. Only one thread may do so at a time."""
    for module in (
        camera_raster,
        camera_raster_plants,
        deferred,
        shadow_maps,
        light_points,
        light_plants,
        tone_rows,
        colour_response,
        stereo_rows,
    ):
        wp.load_module(module, device="cpu")


@dataclasses.dataclass
class Camera:
    """One RGB-D camera, which renders frames of the vineyard's primitives (analytic shapes such as cones and leaves)
    from given poses."""

    spec: CameraSpec
    info: CameraInfo
    name: str = "camera"
    sun: tuple[float, float, float] | SunPath = DEFAULT_SUN
    """Unit vector towards the sun, or a function from simulated time [s] to that vector."""
    quality: str = "full"
    """Cost and look of the picture, a key of :data:`QUALITIES`: ``fast``, ``full`` or ``still``."""
    shadow_period: float | None = None
    """Period [s] at which the shadows of moving objects are rendered again; 0: in every frame; None: 0.2, or 0 with the
    quality ``still``."""
    exposure: float | None = None
    """Fixed exposure, a factor on radiance (0.75 suits a sunny noon); None: automatic exposure."""
    device: str = "cpu"
    threads: int | None = None
    """Number of CPU threads that render; None: the number of cores that this process may use, at most four. The picture
    does not depend on this number."""
    seed: int = 0
    image_index: int = 0
    """Index of the next image. The seed, the camera's name and this index determine the noise of the measured depth."""
    noise: float = 0.0
    """Standard deviation of each colour value [1], as a share of the largest value."""

    def __post_init__(self) -> None:
        if self.quality not in QUALITIES:
            raise ValueError(f"camera {self.name!r} has the quality {self.quality!r}; give {', '.join(QUALITIES)}")
        self._quality = quality = QUALITIES[self.quality]
        self._lens: LensMap = lens_map(self.info)
        drawn = self._drawn = self._lens.pinhole
        width = drawn.width
        height = drawn.height
        samples = quality.samples
        period = self.shadow_period
        if period is None:
            period = 0.0 if self.quality == "still" else 0.2
        threads = min(usable_cores(), MAX_THREADS) if self.threads is None else self.threads
        workers = ThreadPool(threads if self.device == "cpu" else 1)
        self.rasterizer = CameraRasterizer(width, height, self.device, workers)
        self._supersampled = self.rasterizer
        if samples > 1:
            self._supersampled = CameraRasterizer(width * samples, height * samples, self.device, workers)
        colour = self.spec.colour
        flash = 0.0  # the kernels of live light have none
        if colour is not None and colour.flash is not None and not quality.is_live:
            flash = colour.flash.value
        self._sunlight = Sunlight(
            self.sun,
            taps=quality.taps,
            period=period,
            fine=quality.shadow_texel_divisor,
            flash=flash,
            device=self.device,
            workers=workers,
        )
        self._exposure = Exposure(width, height, samples, self.exposure, self.device, workers)
        self._response = None
        if colour is not None:
            rng = spec_file.noise_rng(self.seed + 2, self.name, self.image_index)
            self._response = Response(colour, width, height, samples, self.exposure, rng, self.device, workers)
        self._live_light = LiveLight(self.rasterizer) if quality.is_live and self.device == "cpu" else None
        self._host_buffers: dict[int, wp.array] = {}
        reach = self.spec.nearest.value, self.spec.farthest.value
        self._stereo = self.spec.stereo and Stereo(
            self.spec.stereo,
            drawn,
            reach,
            self.device,
            second_from_first=quality.is_live,
            workers=workers,
        )

    @property
    def rate(self) -> float:
        """Frame rate [Hz]."""
        return self.spec.rate.value

    def frame(self, primitives: Primitives, snapshot: Snapshot, pose: np.ndarray, outputs: CameraOutput) -> CameraFrame:
        """Render a frame from ``pose`` [7] of the optical frame in the world, as the interface
        :class:`vinesim.sensors.sensor.Sensor` defines it. The frame contains the ground truth of the bunches if
        ``outputs`` contain :attr:`CameraOutput.BUNCHES`."""
        frame = self.render(primitives, pose, snapshot.time, outputs=outputs)
        if CameraOutput.BUNCHES in outputs:
            bunches = visible_bunches(primitives, snapshot, self.info, frame.pose, self.rasterizer)
            frame = dataclasses.replace(frame, bunches=bunches)
        return frame

    @outside_captures()
    def render(
        self,
        primitives: Primitives,
        pose: np.ndarray,
        time: float = 0.0,
        *,
        outputs: CameraOutput = CameraOutput.ALL,
        motion: Motion | None = None,
    ) -> CameraFrame:
        """Render a frame from ``pose`` [7], the pose of the optical frame in the world, at simulated ``time`` [s].

        Only ``outputs`` are rendered; all other arrays of the frame have the size 0. ``motion``: motion during the
        exposure, which blurs and shears the colours by the exposure time and the line delay of the data sheet. Rows of
        labels and exact depth are those of the middle of the row's exposure. A stereo camera measures depth by global
        shutters, in the middle of the exposure.
        """
        pose = np.array(pose, float)
        shape = (self._drawn.height, self._drawn.width)
        # the model of a stereo camera needs the texture of the picture
        is_lit = CameraOutput.RGB in outputs or (CameraOutput.DEPTH in outputs and self._stereo is not None)
        measures = self._stereo is not None and CameraOutput.DEPTH in outputs
        response = self._response if CameraOutput.RGB in outputs else None
        picture = None
        self._draw(primitives, pose, time, is_lit=is_lit, measures=measures)
        if is_lit and (response is None or measures):
            picture = self._exposure.tone_map(self._sunlight.balance, time, self._sunlight.brightness)
        lens = pinhole(self._drawn, pose)
        measured = None
        if measures and self._stereo and self.device != "cpu":
            assert picture is not None
            measured = self._stereo.measure_on_device(primitives, lens, self.rasterizer.depth, picture)
        needs_exact = CameraOutput.EXACT_DEPTH in outputs or (CameraOutput.DEPTH in outputs and measured is None)
        rgb, exact, labels, depth = self._download(
            picture,
            self.rasterizer.depth if needs_exact else None,
            self.rasterizer.labels if CameraOutput.LABELS in outputs else None,
            measured,
        )
        rgb = rgb.reshape(-1, shape[1], 3)
        exact = exact.reshape(-1, shape[1])
        labels = labels.reshape(-1, shape[1])
        if CameraOutput.DEPTH not in outputs:
            depth = np.zeros((0, 0), np.float32)
        elif measured is not None:
            depth = depth.reshape(shape)
        elif self._stereo:
            depth = self._stereo.measure(primitives, lens, exact, rgb, None)
        else:
            depth = self._ranged(exact)
        if response is not None:
            rgb = self._respond(response, primitives, pose, time, motion, labels, exact)
            if self._stereo is None and depth.size and motion is not None:
                depth = self._ranged(exact)
        if self.noise and CameraOutput.RGB in outputs:
            rng = spec_file.noise_rng(self.seed + 1, self.name, self.image_index)  # another one than that of the depth
            grain = 255.0 * self.noise * rng.standard_normal(rgb.shape, np.float32)
            rgb = np.clip(np.round(rgb + grain), 0.0, 255.0).astype(np.uint8)
        self.image_index += 1
        if CameraOutput.RGB in outputs:
            rgb = self._lens.smooth(rgb)
            if response is not None:
                rgb = response.compress(rgb)
        return CameraFrame(
            time=float(time),
            name=self.name,
            info=self.info,
            pose=pose,
            rgb=rgb if CameraOutput.RGB in outputs else np.zeros((0, 0, 3), np.uint8),
            depth=self._lens.nearest(depth) if depth.size else depth,
            labels=self._lens.nearest(labels) if labels.size else labels.reshape(0, 0),
            exact_depth=(
                self._lens.nearest(exact) if CameraOutput.EXACT_DEPTH in outputs else np.zeros((0, 0), np.float32)
            ),
        )

    def _ranged(self, exact: np.ndarray) -> np.ndarray:
        """Returns ``exact`` depth [height, width] m with the values of REP-118 outside of the range."""
        too_near = exact < self.spec.nearest.value
        too_far = exact > self.spec.farthest.value
        return np.where(too_near, np.float32(-np.inf), np.where(too_far, np.float32(np.inf), exact))

    def _respond(
        self,
        response: Response,
        primitives: Primitives,
        pose: np.ndarray,
        time: float,
        motion: Motion | None,
        labels: np.ndarray,
        exact: np.ndarray,
    ) -> np.ndarray:
        """Returns the camera's 8-bit colours [height, width, 3] of the radiance that was drawn last.

        With ``motion`` other moments are drawn too, and the rows of ``labels`` and ``exact`` depth (empty or [height,
        width]) become those of their own exposures.
        """
        radiance = self._exposure.radiance
        exposure = response.meter(radiance, time, self._sunlight.brightness)
        developed = functools.partial(self._light, response, exposure, self._focus())
        light = developed()
        if motion is not None:
            spec = response.spec
            exposure_time, delay = (0.0 if n is None else n.value for n in (spec.exposure_time, spec.line_delay))
            delay *= self.spec.height.value / len(light)
            moments = Moments.of(motion, len(light), self._drawn.fy, exposure_time, delay)
            share = moments.weights.astype(np.float32)[:, :, None, None]
            middle = len(share) // 2
            light = share[middle] * light
            for k in np.flatnonzero(np.arange(len(share)) != middle):
                offset = float(moments.times[k])
                if motion.pose_scene is not None:
                    motion.pose_scene(offset)
                self._draw(primitives, motion.pose_at(pose, offset), time + offset)
                light += share[k] * developed()
                rows = np.flatnonzero(moments.nearest == k)
                for kept, drawn in ((labels, self.rasterizer.labels), (exact, self.rasterizer.depth)):
                    if kept.size and len(rows):
                        kept[rows] = drawn.numpy().reshape(kept.shape)[rows]
            if motion.pose_scene is not None and middle:
                motion.pose_scene(0.0)
        rng = spec_file.noise_rng(self.seed + 3, self.name, self.image_index)
        return response.develop(light, exposure, self._sunlight.balance, rng)

    def _focus(self) -> float:
        """Returns the distance [m] of the plane of focus for the depths that were drawn last; 0 without a lens."""
        lens = self.spec.lens
        if lens is None:
            return 0.0
        if lens.focus is not None:
            return lens.focus.value
        return automatic_focus(self.rasterizer.depth.numpy().reshape(self._drawn.height, self._drawn.width))

    def _light(self, response: Response, exposure: float, focus: float) -> np.ndarray:
        """Returns linear RGB [height, width, 3] of the radiance that was drawn last, blurred where it is out of
        ``focus`` [m]."""
        radiance = self._exposure.radiance
        lens = self.spec.lens
        if lens is None:
            return response.light(radiance, exposure)
        fine = self._supersampled
        shape = (fine.height, fine.width)
        disc = lens.infinity_disc(self._drawn.fx, self._drawn.width, focus)
        clipped = np.minimum(radiance.numpy().reshape(*shape, 3), response.most_light(exposure))
        return defocused(clipped, fine.depth.numpy().reshape(shape), self._quality.samples, disc, focus)

    def _download(self, *arrays: wp.array | None) -> list[np.ndarray]:
        """Copy device arrays to the host, with an empty array for None. A GPU copies all of them at once, through
        pinned memory."""
        if self.device == "cpu":
            return [np.zeros(0, np.float32) if a is None else a.numpy().copy() for a in arrays]
        copies = []
        for i, array in enumerate(arrays):
            if array is not None:
                if i not in self._host_buffers:
                    shape = array.shape
                    kind = array.dtype
                    self._host_buffers[i] = wp.empty(shape, dtype=kind, device="cpu", pinned=True)
                wp.copy(self._host_buffers[i], array)
        wp.synchronize_stream(self.device)
        for i, array in enumerate(arrays):
            copies.append(np.zeros(0, np.float32) if array is None else self._host_buffers[i].numpy().copy())
        return copies

    @outside_captures()
    def render_on_device(
        self,
        primitives: Primitives,
        pose: np.ndarray,
        time: float = 0.0,
        *,
        is_lit: bool = True,
        measures: bool = False,
    ) -> wp.array | None:
        """Render from ``pose`` [7] without lens distortion and return the colours [pixel, 3] on the device.

        With a GPU the call returns before rendering ends. Without ``is_lit``, only depth and labels are rendered, and
        the result is None. ``measures``: also generate the random numbers for a stereo measurement. The colours are
        exact: they do not have the camera's response.
        """
        self._draw(primitives, pose, time, is_lit=is_lit, measures=measures)
        if not is_lit:
            return None
        return self._exposure.tone_map(self._sunlight.balance, time, self._sunlight.brightness)

    def _draw(
        self, primitives: Primitives, pose: np.ndarray, time: float, *, is_lit: bool = True, measures: bool = False
    ) -> None:
        """Draw depth and labels, and with ``is_lit`` the radiance; see :meth:`render_on_device`."""
        if self.device == "cpu":
            load_camera_kernels()
        pose = np.array(pose, float)
        lens = pinhole(self._drawn, pose)
        beside = []
        if measures and self._stereo:
            rng = spec_file.noise_rng(self.seed, self.name, self.image_index)
            beside = [functools.partial(self._stereo.draw_noise, rng)]
        seen = self.rasterizer
        seen.draw(primitives, lens, beside=beside)
        if not is_lit:
            return
        seen = self._supersampled
        quality = self._quality
        if quality.samples > 1:
            lens = pinhole(supersampled(self._drawn, quality.samples), pose)
            seen.draw(primitives, lens)
        near, far = self.update_shadows(primitives, pose, time)
        if self._live_light is not None:
            maps = shadow_maps_of(near, far, self._sunlight.depth)
            self._live_light.shade(primitives, self._sunlight.light, maps, lens, self._exposure.radiance)
        else:
            shade = functools.partial(self._shade, primitives, near, far)
            seen.workers.share([functools.partial(shade, band) for band in seen.bands(lens)])
        self._exposure.add_glare(primitives, seen.primitive)

    def update_shadows(
        self, primitives: Primitives, pose: np.ndarray, time: float = 0.0
    ) -> tuple[ShadowMap, ShadowMap]:
        """Returns the near and the far shadow map for a camera at ``pose`` [7] at ``time`` [s]. A map that is no longer
        valid for this pose and time is rendered again before."""
        forward = frames.rotate(frames.normalize(pose[3:]), np.array([0.0, 0.0, 1.0]))
        return self._sunlight.update(primitives, pose[:3], forward, time)

    def _shade(self, primitives: Primitives, near: ShadowMap, far: ShadowMap, lens: Pinhole) -> None:
        """Shade the pixels in the rows that ``lens`` draws."""
        seen = self._supersampled
        block = self._quality.block
        across, down = (-(-n // block) for n in (seen.width, lens.end_row - lens.first_row))
        run = across if self.device == "cpu" else 1  # on a CPU one thread takes a row, to pass the structs less often
        wp.launch(
            deferred.shade_pixels,
            across * down // run,
            inputs=[
                primitives.shapes,
                primitives.materials,
                self._sunlight.light,
                near,
                far,
                lens,
                seen.primitive,
                seen.keys,
                block,
                run,
            ],
            outputs=[self._exposure.radiance],
            device=self.device,
        )


def _make(mount: CameraMount, setting: SensorSetting) -> Camera:
    spec = CameraSpec.load(mount.type).mounted(mount)
    return Camera(
        spec,
        spec.info(mount.frame, size=mount.size),
        mount.name,
        setting.sun,
        quality=mount.quality,
        device=setting.device,
        threads=setting.threads,
        seed=setting.seed,
        image_index=setting.number,
        noise=mount.noise,
    )


MAKER = SensorMaker(lambda name: CameraSpec.load(name).rate.value, _make, load_camera_kernels)
