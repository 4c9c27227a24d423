"""RGB-D cameras: a picture, labels, exact depth, and depth as the sensor measures it.

Depth follows REP-118: metres along the optical axis; -Inf nearer than the sensor can measure, +Inf farther than it can,
which includes the open sky; NaN for a pixel that should have measured and did not
(:mod:`vinesim.sensors.camera.stereo`).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Annotated

import msgspec
import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.thread_pool import MAX_THREADS, ThreadPool, usable_cores
from vinesim.kernels.raster import camera_raster, camera_raster_plants
from vinesim.kernels.raster.pinhole import Pinhole
from vinesim.kernels.shading import deferred, light_plants, light_points, shadow_maps, tone_rows
from vinesim.kernels.shading.shadow_maps import ShadowMap
from vinesim.kernels.stereo import stereo_rows
from vinesim.scene.plant_parameters import Number
from vinesim.scene.values import CameraFrame, CameraInfo, CameraMount, CameraOutput, Snapshot
from vinesim.sensors import spec_file
from vinesim.sensors.camera.exposure import Exposure
from vinesim.sensors.camera.live_light import LiveLight
from vinesim.sensors.camera.live_light import shadow_maps as shadow_maps_of
from vinesim.sensors.camera.stereo import Stereo, StereoSpec
from vinesim.sensors.camera.sunlight import DEFAULT_SUN, Sunlight, SunPath
from vinesim.sensors.ground_truth import visible_bunches
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.camera_rasterizer import CameraRasterizer, pinhole, supersampled
from vinesim.sensors.raster.lens_map import LensError, LensMap, lens_map
from vinesim.sensors.sensor import SensorMaker, SensorSetting


class CameraSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One kind of camera (``data/cameras``)."""

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
    """How the camera measures depth. Unless given, it measures exactly."""
    distortion: Annotated[spec_file.Numbers | None, "1", (-1000.0, 1000.0)] = None
    """Coefficients of the lens distortion, in the order of sensor_msgs/CameraInfo: 5 (plumb_bob) or 8
    (rational_polynomial). A pinhole unless given. Colour, depth and labels are distorted alike."""

    @classmethod
    def load(cls, name: str) -> CameraSpec:
        """The spec in the file ``name``, or the one of that name in ``data/cameras``."""
        spec = spec_file.load("cameras", name, cls)
        if not 0.0 <= spec.nearest.value < spec.farthest.value:
            raise spec_file.SensorError(
                f"camera {name!r} measures from {spec.nearest.value} to {spec.farthest.value} m, which is no range; "
                "give 0 <= nearest < farthest"
            )
        try:
            lens_map(spec.info(""))
        except LensError as error:
            raise spec_file.SensorError(f"camera {name!r}: {error}") from error
        return spec

    def ideal(self) -> CameraSpec:
        """The same camera with exact depth at any distance."""
        number = msgspec.structs.replace
        near = number(self.nearest, value=0.0)
        far = number(self.farthest, value=1000.0)
        return msgspec.structs.replace(self, nearest=near, farthest=far, stereo=None)

    def info(self, frame_id: str, scale: float = 1.0, size: tuple[int, int] | None = None) -> CameraInfo:
        """Intrinsics with the principal point in the middle.

        ``scale`` enlarges the picture; ``size`` gives it this width and height [px], with the same horizontal angle.
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
    """Settings that trade the cost of a picture against its looks. Exact depth and labels are the same in all
    qualities."""

    taps: int
    """Number of shadow samples for each pixel. 0 stands for a smooth filter of two widths, -1 for a filter of one
    width."""
    block: int
    """Side of a block of pixels in which each primitive is lit once."""
    samples: int
    """Number of colour samples along each side of a pixel."""
    shadow_texel_divisor: int
    """Divisor of the texel size of the near shadow map."""
    is_live: bool
    """Whether a CPU lights eight points at once (:mod:`vinesim.sensors.camera.live_light`), and computes the second
    view of a stereo camera from the first one instead of rendering it."""


QUALITIES = {
    "fast": Quality(taps=-1, block=2, samples=1, shadow_texel_divisor=1, is_live=True),
    "full": Quality(taps=0, block=1, samples=1, shadow_texel_divisor=1, is_live=False),
    "still": Quality(taps=12, block=2, samples=2, shadow_texel_divisor=2, is_live=False),
}
"""Qualities by name: ``fast`` for live robots, ``full`` for spectators, ``still`` for pictures that are not live."""


@functools.cache
def load_camera_kernels() -> None:
    """Compile the CPU kernels of cameras, or read them from the cache. Threads must not call it at the same time."""
    for module in (
        camera_raster,
        camera_raster_plants,
        deferred,
        shadow_maps,
        light_points,
        light_plants,
        tone_rows,
        stereo_rows,
    ):
        wp.load_module(module, device="cpu")


@dataclasses.dataclass
class Camera:
    """One RGB-D camera."""

    spec: CameraSpec
    info: CameraInfo
    name: str = "camera"
    sun: tuple[float, float, float] | SunPath = DEFAULT_SUN
    """Unit vector towards the sun, or a function that gives it for a time [s]."""
    quality: str = "full"
    """Name of one of :data:`QUALITIES`."""
    shadow_period: float | None = None
    """Period at which shadows of moving things are redrawn [s]; 0 for every frame. Unless given, 0.2, and 0 for
    stills."""
    exposure: float | None = None
    """Fixed exposure; automatic unless given. 0.75 suits a sunny noon."""
    device: str = "cpu"
    threads: int | None = None
    """Number of CPU threads that draw. Unless given, the number of cores that this process may use, up to four. The
    result is the same to the bit for every number."""
    seed: int = 0
    image_index: int = 0
    """Number of the next image. The noise of the measurement follows from (seed, name, this number)."""

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
        self._sunlight = Sunlight(
            self.sun,
            taps=quality.taps,
            period=period,
            fine=quality.shadow_texel_divisor,
            device=self.device,
            workers=workers,
        )
        self._exposure = Exposure(width, height, samples, self.exposure, self.device, workers)
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
        """See :class:`vinesim.sensors.sensor.Sensor`. The frame has the ground truth of the bunches if ``outputs`` ask
        for it."""
        frame = self.render(primitives, pose, snapshot.time, outputs=outputs)
        if CameraOutput.BUNCHES in outputs:
            bunches = visible_bunches(primitives, snapshot, self.info, frame.pose, self.rasterizer)
            frame = dataclasses.replace(frame, bunches=bunches)
        return frame

    def render(
        self, primitives: Primitives, pose: np.ndarray, time: float = 0.0, *, outputs: CameraOutput = CameraOutput.ALL
    ) -> CameraFrame:
        """The frame seen from ``pose`` [7], the optical frame in the world.

        Only ``outputs`` are rendered; the other arrays of the frame have the size 0.
        """
        pose = np.array(pose, float)
        shape = (self._drawn.height, self._drawn.width)
        # a stereo camera matches by the texture of the picture
        is_lit = CameraOutput.RGB in outputs or (CameraOutput.DEPTH in outputs and self._stereo is not None)
        measures = self._stereo is not None and CameraOutput.DEPTH in outputs
        picture = self.render_on_device(primitives, pose, time, is_lit=is_lit, measures=measures)
        lens = pinhole(self._drawn, pose)
        measured = None
        if measures and self._stereo and self.device != "cpu":
            assert picture is not None
            measured = self._stereo.measure_on_device(primitives, lens, self.rasterizer.depth, picture)
        needs_exact = CameraOutput.EXACT_DEPTH in outputs or (CameraOutput.DEPTH in outputs and measured is None)
        rgb, exact, labels, depth = self._download(
            picture if is_lit else None,
            self.rasterizer.depth if needs_exact else None,
            self.rasterizer.labels if CameraOutput.LABELS in outputs else None,
            measured,
        )
        rgb = rgb.reshape(-1, shape[1], 3)
        exact = exact.reshape(-1, shape[1])
        if CameraOutput.DEPTH not in outputs:
            depth = np.zeros((0, 0), np.float32)
        elif measured is not None:
            depth = depth.reshape(shape)
        elif self._stereo:
            depth = self._stereo.measure(primitives, lens, exact, rgb, None)
        else:
            too_near = exact < self.spec.nearest.value
            too_far = exact > self.spec.farthest.value
            depth = np.where(too_near, np.float32(-np.inf), np.where(too_far, np.float32(np.inf), exact))
        self.image_index += 1
        return CameraFrame(
            time=float(time),
            name=self.name,
            info=self.info,
            pose=pose,
            rgb=self._lens.smooth(rgb) if CameraOutput.RGB in outputs else np.zeros((0, 0, 3), np.uint8),
            depth=self._lens.nearest(depth) if depth.size else depth,
            labels=self._lens.nearest(labels.reshape(shape)) if labels.size else labels.reshape(0, 0),
            exact_depth=(
                self._lens.nearest(exact) if CameraOutput.EXACT_DEPTH in outputs else np.zeros((0, 0), np.float32)
            ),
        )

    def _download(self, *arrays: wp.array | None) -> list[np.ndarray]:
        """Copies of arrays for the host; an empty array for None. From a GPU all are copied at once, through pinned
        memory."""
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

    def render_on_device(
        self,
        primitives: Primitives,
        pose: np.ndarray,
        time: float = 0.0,
        *,
        is_lit: bool = True,
        measures: bool = False,
    ) -> wp.array | None:
        """The colours [pixel, 3] without distortion, on the device. With a GPU the call does not wait for them.

        Unless ``is_lit``, it renders depth and labels alone and returns None. ``measures``: the noise of a stereo
        measurement is drawn at the same time.
        """
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
            return None
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
        return self._exposure.tone_map(self._sunlight.balance, time, self._sunlight.brightness)

    def update_shadows(
        self, primitives: Primitives, pose: np.ndarray, time: float = 0.0
    ) -> tuple[ShadowMap, ShadowMap]:
        """The near and the far shadow map. A map that is no longer valid at ``time`` [s] for ``pose`` [7] is drawn
        again."""
        forward = frames.rotate(frames.normalize(pose[3:]), np.array([0.0, 0.0, 1.0]))
        return self._sunlight.update(primitives, pose[:3], forward, time)

    def _shade(self, primitives: Primitives, near: ShadowMap, far: ShadowMap, lens: Pinhole) -> None:
        """Light the rows that ``lens`` draws."""
        seen = self._supersampled
        block = self._quality.block
        across, down = (-(-n // block) for n in (seen.width, lens.end_row - lens.first_row))
        run = across if self.device == "cpu" else 1  # a thread takes a row: structs are passed once a thread
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
    spec = CameraSpec.load(mount.type)
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
    )


MAKER = SensorMaker(lambda name: CameraSpec.load(name).rate.value, _make, load_camera_kernels)
