"""Multispectral cameras: surface, illumination and reflectance in each band, for each pixel.

A pixel's value is reflectance times illumination. The illumination is that of the RGB picture (sun, shadow maps, sky
through the canopy, light from the ground, light through leaves), averaged over its three colours. It is equal in all
bands, so a ratio of bands such as the NDVI is equal in sun and shade. Reflectances depend only on the kind of surface.
Not modelled: the bluer light of shadows, light that passes from leaf to leaf, highlights, haze, and the distances
between the lenses.
"""

from __future__ import annotations

import functools
from typing import Annotated, Any

import msgspec
import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.thread_pool import MAX_THREADS, ThreadPool, usable_cores
from vinesim.kernels.graph import outside_captures
from vinesim.kernels.raster.pinhole import Pinhole
from vinesim.kernels.shading import illumination, materials
from vinesim.kernels.shading.shadow_maps import ShadowMap
from vinesim.scene.plant_parameters import Number
from vinesim.scene.values import Band, CameraInfo, CameraOutput, MultispectralFrame, MultispectralMount, Snapshot
from vinesim.sensors import spec_file
from vinesim.sensors.camera.camera import load_camera_kernels
from vinesim.sensors.camera.sunlight import Sunlight
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.camera_rasterizer import CameraRasterizer, pinhole
from vinesim.sensors.raster.primitive_arrays import LEAF
from vinesim.sensors.sensor import Export, SensorMaker, SensorSetting

FULL_SCALE = 32768
"""Value in 16-bit images that stands for a reflectance of 1, as in MicaSense's images."""
SHADOW_PERIOD = 0.2
"""Period [s] at which shadows of moving objects are redrawn."""
DARK_BERRY = 0.55
"""Ratio of green to red colour up to which a berry counts as dark; from ratio 1 on it counts as green. GUESSED."""
GREEN_AGE = 0.42
DRY_AGE = 1.0
"""Age (``Model.leaf_age``) from which a leaf is dry; up to ``GREEN_AGE`` it is green. Both values are those of the RGB
picture."""
SURFACES = (
    "leaf",
    "leaf_dry",
    "grass",
    "berry_green",
    "berry_dark",
    "stem",
    "wood",
    "soil",
    "metal",
    "plastic",
    "paint",
    "cloth",
    "skin",
    "rubber",
    "straw",
    "sky",
)
"""Names of the surfaces for which a data file contains reflectances."""
_OF_MATERIAL = {
    materials.FOLIAGE: "leaf",
    materials.BERRY: "berry_green",
    materials.CANE: "wood",
    materials.BARK: "wood",
    materials.POST: "wood",
    materials.WIRE: "metal",
    materials.STEM: "stem",
    materials.PLASTIC: "plastic",
    materials.CLOTH: "cloth",
    materials.SKIN: "skin",
    materials.PAINT: "paint",
    materials.GRASS: "grass",
    materials.LAMP: "metal",
    materials.RUBBER: "rubber",
    materials.METAL: "metal",
    materials.STRAW: "straw",
    materials.REFLEX: "metal",
    materials.GLASS: "metal",
    materials.OLD_BARK: "wood",
}
_SURFACE_OF_MATERIAL = np.array([SURFACES.index(_OF_MATERIAL[kind]) for kind in sorted(_OF_MATERIAL)])
_SECOND = {"leaf": "leaf_dry", "berry_green": "berry_dark", "soil": "grass"}
"""Pairs of surfaces between which reflectance is interpolated, such as green and dry leaves; each primitive or pixel
has a weight from 0 (first surface) to 1 (second surface)."""
_SECOND_OF_SURFACE = np.array([SURFACES.index(_SECOND.get(name, name)) for name in SURFACES])


class BandSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One spectral band with a Gaussian response."""

    name: str
    centre: Annotated[Number, "nm", (300.0, 1100.0)]
    width: Annotated[Number, "nm", (1.0, 500.0)]
    """Full width of the response at half of its maximum."""
    irradiance: Annotated[Number, "W/(m^2 nm)", (0.0, 3.0)]
    """Irradiance of a level surface in the open by sun and sky."""


class MultispectralSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The data sheet of one model of multispectral camera, from a file in ``data/multispectral``."""

    model: str
    width: Annotated[Number, "px", (1.0, 8192.0)]
    height: Annotated[Number, "px", (1.0, 8192.0)]
    fx: Annotated[Number, "px", (1.0, 1e6)]
    fy: Annotated[Number, "px", (1.0, 1e6)]
    rate: Annotated[Number, "Hz", (0.01, 1000.0)]
    bits: Annotated[Number, "1", (1, 16)]
    """Resolution of the analogue-digital converter in bits."""
    brightest: Annotated[Number, "1", (0.1, 10.0)]
    """Reflectance at full scale, to which brighter surfaces are clipped."""
    full_well: Annotated[Number, "1", (10.0, 1e9)]
    """Number of electrons of a pixel at full scale, for shot noise (standard deviation: square root of the number)."""
    read_noise: Annotated[Number, "1", (0.0, 1e4)]
    """Read noise: standard deviation of a pixel without light [electron]."""
    transmission: Annotated[Number, "1", (0.0, 2.0)]
    """Transmittance of a leaf divided by its reflectance, equal in all bands."""
    bands: tuple[BandSpec, ...]
    """Bands sorted by wavelength; they include bands named ``red`` and ``nir``, for the NDVI."""
    reflectance: dict[str, Annotated[spec_file.Numbers, "1", (0.0, 1.0)]]
    """Diffuse reflectances: for each of :data:`SURFACES` one number for each band."""

    @classmethod
    def load(cls, name: str) -> MultispectralSpec:
        """Read a camera's data sheet: ``name`` is the path of a file, or the name of a file in
        ``data/multispectral``."""
        spec = spec_file.load("multispectral", name, cls)
        names = [band.name for band in spec.bands]
        if not {"red", "nir"} <= set(names) or len(set(names)) < len(names):
            raise spec_file.SensorError(f"{name}: the bands are {names}; give different names, with red and nir")
        centres = [band.centre.value for band in spec.bands]
        if sorted(centres) != centres:
            raise spec_file.SensorError(f"{name}: the bands are at {centres} nm; give them sorted by wavelength")
        if wrong := sorted(set(spec.reflectance) ^ set(SURFACES)):
            raise spec_file.SensorError(
                f"{name}: reflectance.{wrong[0]} is missing or unknown; give one for each of {', '.join(SURFACES)}"
            )
        for surface, numbers in spec.reflectance.items():
            if len(numbers.value) != len(names) or not all(0.0 <= value <= 1.0 for value in numbers.value):
                raise spec_file.SensorError(
                    f"{name}: reflectance.{surface} is {list(numbers.value)}; give {len(names)} numbers from 0 to 1"
                )
        return spec

    def info(self, frame_id: str, size: tuple[int, int] | None = None) -> CameraInfo:
        """Returns the intrinsics, with the principal point in the middle of the picture.

        ``size``: width and height [px] that replace the camera's, with an equal horizontal field of view.
        """
        width, height = size or (round(self.width.value), round(self.height.value))
        scale = width / self.width.value
        middle = 0.5 * (width - 1), 0.5 * (height - 1)
        return CameraInfo(width, height, self.fx.value * scale, self.fy.value * scale, *middle, frame_id)


class MultispectralCamera:
    """One multispectral camera, which renders frames of the vineyard's primitives from given poses."""

    def __init__(
        self,
        spec: MultispectralSpec,
        info: CameraInfo,
        name: str = "multispectral",
        setting: SensorSetting = SensorSetting(),
        *,
        is_exact: bool = False,
        shadow_period: float = SHADOW_PERIOD,
    ) -> None:
        """``is_exact``: measure without noise, quantisation and saturation; ``shadow_period``: period [s] at which
        shadows of moving objects are redrawn."""
        self.spec = spec
        self.info = info
        self.name = name
        self.is_exact = is_exact
        self.image_index = setting.number
        """Index of the next image. The seed, the camera's name and this index determine the noise."""
        self._seed = setting.seed
        self._device = device = setting.device
        threads = min(usable_cores(), MAX_THREADS) if setting.threads is None else setting.threads
        workers = ThreadPool(threads if device == "cpu" else 1)
        self._seen = CameraRasterizer(info.width, info.height, device, workers)
        self._sunlight = Sunlight(setting.sun, taps=0, period=shadow_period, device=device, workers=workers)
        self._light = wp.empty(info.width * info.height, dtype=float, device=device)
        self._sod = wp.empty(info.width * info.height, dtype=float, device=device)
        self._reflectance = np.array([spec.reflectance[name].value for name in SURFACES], np.float32)
        """[surface, band] Reflectances of :data:`SURFACES`."""
        self.bands = tuple(Band(b.name, b.centre.value, b.width.value, b.irradiance.value) for b in spec.bands)
        self._layout: tuple[Primitives, int] | None = None
        self._surface = np.zeros(0, int)
        """[primitive + 2] Index of each primitive's surface. The last two entries are the ground (primitive -2) and the
        sky (-1)."""
        self._turned = np.zeros(0, np.float32)
        """[primitive + 2] Weight (0 to 1) of the second surface of a pair in :data:`_SECOND`, for each primitive."""

    @property
    def rate(self) -> float:
        """Frame rate [Hz]."""
        return self.spec.rate.value

    def frame(
        self, primitives: Primitives, snapshot: Snapshot, pose: np.ndarray, outputs: CameraOutput
    ) -> MultispectralFrame:
        """Render a frame as :class:`vinesim.sensors.sensor.Sensor` defines it; the frame always has all bands."""
        return self.render(primitives, pose, snapshot.time)

    @outside_captures()
    def render(self, primitives: Primitives, pose: np.ndarray, time: float = 0.0) -> MultispectralFrame:
        """Render a frame from ``pose`` [7], the pose of the optical frame in the world, at simulated ``time`` [s]."""
        if self._device == "cpu":
            load_kernels()
        pose = np.array(pose, float)
        lens = pinhole(self.info, pose)
        seen = self._seen
        seen.draw(primitives, lens)
        forward = frames.rotate(frames.normalize(pose[3:]), np.array([0.0, 0.0, 1.0]))
        near, far = self._sunlight.update(primitives, pose[:3], forward, time)
        illuminate = functools.partial(self._illuminate, primitives, near, far)
        seen.workers.share([functools.partial(illuminate, band) for band in seen.bands(lens)])
        self._update_surfaces(primitives)
        shape = (self.info.height, self.info.width)
        primitive = seen.primitive.numpy()
        surface = self._surface[primitive]
        turned = np.maximum(self._turned[primitive], self._sod.numpy())[:, None]
        first = self._reflectance[surface]
        reflected = first + turned * (self._reflectance[_SECOND_OF_SURFACE[surface]] - first)
        exact = np.ascontiguousarray((reflected * self._light.numpy()[:, None]).T).reshape(-1, *shape)
        frame = MultispectralFrame(
            time=float(time),
            name=self.name,
            info=self.info,
            pose=pose,
            bands=self.bands,
            reflectance=exact if self.is_exact else self._measure(exact),
            labels=seen.labels.numpy().reshape(shape).copy(),
        )
        self.image_index += 1
        return frame

    def _illuminate(self, primitives: Primitives, near: ShadowMap, far: ShadowMap, lens: Pinhole) -> None:
        """Compute the illumination of the pixels in the rows that ``lens`` draws."""
        seen = self._seen
        run = seen.width if self._device == "cpu" else 1  # on a CPU one thread takes a row, to pass structs less often
        wp.launch(
            illumination.illuminate_pixels,
            seen.width * (lens.end_row - lens.first_row) // run,
            inputs=[
                primitives.shapes,
                primitives.materials,
                self._sunlight.light,
                near,
                far,
                lens,
                seen.primitive,
                seen.keys,
                float(self.spec.transmission.value),
                run,
            ],
            outputs=[self._light, self._sod],
            device=self._device,
        )

    def _update_surfaces(self, primitives: Primitives) -> None:
        """Look up the surface of each primitive again if the set of primitives has changed."""
        if self._layout == (primitives, primitives.layout_version):
            return
        self._layout = primitives, primitives.layout_version
        material = primitives.materials.material.numpy()
        tint = primitives.materials.tint.numpy()
        green = tint[:, 1] / np.maximum(tint[:, 0], 1e-6)
        age = primitives.shapes.d.numpy()[:, 3]
        dark = np.clip((1.0 - green) / (1.0 - DARK_BERRY), 0.0, 1.0)
        dry = np.clip((age - GREEN_AGE) / (DRY_AGE - GREEN_AGE), 0.0, 1.0)
        is_blade = (primitives.shapes.kind.numpy() == LEAF) & (material == int(materials.FOLIAGE))
        turned = np.where(material == int(materials.BERRY), dark, np.where(is_blade, dry, 0.0))
        ends = [SURFACES.index("soil"), SURFACES.index("sky")]
        self._surface = np.append(_SURFACE_OF_MATERIAL[material], ends)
        self._turned = np.append(turned, [0.0, 0.0]).astype(np.float32)

    def _measure(self, exact: np.ndarray) -> np.ndarray:
        """Returns exact reflectances [band, height, width] with added noise, quantisation and saturation."""
        spec = self.spec
        rng = spec_file.noise_rng(self._seed, self.name, self.image_index)
        scale = np.float32(spec.full_well.value / spec.brightest.value)
        electrons = exact * scale
        spread = np.sqrt(electrons + np.float32(spec.read_noise.value**2))
        electrons += spread * rng.standard_normal(exact.shape, np.float32)
        step = np.float32(spec.brightest.value / (2 ** round(spec.bits.value) - 1))
        return np.clip(np.rint(electrons / (scale * step)) * step, 0.0, spec.brightest.value).astype(np.float32)


def ndvi_colours(ndvi: np.ndarray) -> np.ndarray:
    """Returns the NDVI [height, width] as RGB uint8: -1 is blue, 0 grey brown, 0.4 yellow, 1 dark green."""
    at = np.array([-1.0, 0.0, 0.4, 0.7, 1.0])
    colours = np.array([[40, 70, 160], [130, 110, 95], [240, 225, 110], [90, 170, 60], [0, 80, 30]], float)
    return np.stack([np.interp(ndvi, at, colours[:, k]) for k in range(3)], -1).astype(np.uint8)


@functools.cache
def load_kernels() -> None:
    """Compile the CPU kernels of multispectral cameras, or load them from the cache. Only one thread may do so at a
    time."""
    load_camera_kernels()
    wp.load_module(illumination, device="cpu")


def _make(mount: MultispectralMount, setting: SensorSetting) -> MultispectralCamera:
    spec = MultispectralSpec.load(mount.type)
    return MultispectralCamera(spec, spec.info(mount.frame, mount.size), mount.name, setting)


def _export(frame: MultispectralFrame) -> Export:
    """Returns what a data set stores of a frame: a 16-bit image of each band, and the NDVI in colours."""
    scaled = np.clip(np.rint(frame.reflectance * FULL_SCALE), 0, 65535).astype(np.uint16)
    images: dict[str, np.ndarray] = {band.name: scaled[k] for k, band in enumerate(frame.bands)}
    bands: list[dict[str, Any]] = [
        {"name": b.name, "centre_nm": b.centre, "width_nm": b.width, "irradiance_w_m2_nm": b.irradiance}
        for b in frame.bands
    ]
    return Export(images | {"ndvi": ndvi_colours(frame.ndvi)}, {"full_scale": FULL_SCALE, "bands": bands})


MAKER = SensorMaker(
    rate=lambda name: MultispectralSpec.load(name).rate.value,
    make=_make,
    load_kernels=load_kernels,
    channels=lambda name: tuple(band.name for band in MultispectralSpec.load(name).bands),
    export=_export,
)
