"""How a model of camera turns light into 8-bit colours: the ``[colour]`` table of its data sheet.

Light from the lens is blurred, exposed, weakened towards the corners, and clipped where a pixel is full. It has the
shot noise of its electrons and the noise of the read-out. A colour matrix and a tone curve follow, then chroma
subsampling and JPEG. Without this table a camera has the exact colours of :mod:`vinesim.sensors.camera.exposure`.
"""

from __future__ import annotations

import functools
import itertools
from typing import Annotated

import cv2
import msgspec
import numpy as np
import warp as wp

from vinesim.core.thread_pool import ThreadPool
from vinesim.kernels.shading import colour_response
from vinesim.kernels.shading.colour_response import NOISE_STRIDE, TONE_ENTRIES
from vinesim.scene.plant_parameters import Number
from vinesim.sensors import spec_file
from vinesim.sensors.camera import exposure as automatic

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear red, green and blue in luminance (IEC 61966-2-1)."""
SHARPENED_SIGMA = 1.0
"""Standard deviation [px] of the filter of :attr:`ColourSpec.sharpening`: GUESSED."""
_NOISE_NUMBERS = 1 << 18
"""Number of normal numbers from which the noise of all pictures is taken; each row starts at a random one."""
_MOST_LIGHT = 4.0
"""Light of one sample at most, as a multiple of the clipping point."""
_JPEG = {
    (1, 1): cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    (2, 1): cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    (2, 2): cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
}
"""OpenCV's names by the pixels, across and down, that share one chroma sample: 4:4:4, 4:2:2 and 4:2:0."""
_YUV = {
    (2, 1): (cv2.COLOR_RGB2YUV_YUY2, cv2.COLOR_YUV2RGB_YUY2),
    (2, 2): (cv2.COLOR_RGB2YUV_I420, cv2.COLOR_YUV2RGB_I420),
}
"""OpenCV's conversions to 8 bits of video and back, by the pixels that share one chroma sample."""


class ColourSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Table ``[colour]`` of a camera's data sheet: from light to 8-bit colours."""

    key: Annotated[Number, "1", (0.001, 10.0)]
    """Geometric mean of the exposed luminance at which automatic exposure aims."""
    adaptation: Annotated[Number, "1", (0.0, 1.0)]
    """Share of the difference to ``key``, in stops, that automatic exposure corrects."""
    white: Annotated[Number, "1", (0.01, 100.0)]
    """Exposed radiance at which a pixel is full; all brighter light has the value 255."""
    shoulder: Annotated[Number, "1", (0.0, 100.0)]
    """Compression of bright light: the tone curve has the slope 1 + shoulder at black, 1 / (1 + shoulder) at white."""
    toe: Annotated[Number, "1", (0.0, 1.0)]
    """Light, as a share of white, below which the tone curve bends towards black."""
    contrast: Annotated[Number, "1", (0.2, 5.0)]
    """Slope of the tone curve at middle grey, after the sRGB encoding; 1 has no effect."""
    saturation: Annotated[Number, "1", (0.0, 4.0)]
    """Factor on the differences between a colour and its luminance, in linear light."""
    balance: Annotated[Number, "1", (0.0, 1.0)]
    """Standard deviation of the error of the white balance: of the logarithms of the factors on red and blue."""
    vignetting: Annotated[Number, "1", (0.0, 0.95)]
    """Share of the light that is lost in the corners; the loss grows with the square of the distance from the
    middle."""
    blur: Annotated[Number, "px", (0.0, 20.0)]
    """Standard deviation of the point spread of lens and sensor."""
    full_well: Annotated[Number, "e", (10.0, 1e9)]
    """Electrons of a pixel of the picture at the clipping point; they determine the shot noise."""
    read_noise: Annotated[Number, "e", (0.0, 1e6)]
    """Standard deviation of the noise of the read-out."""
    chroma: Annotated[spec_file.Numbers, "px", (1.0, 2.0)]
    """Pixels across and down that share one chroma sample: [1, 1] is 4:4:4, [2, 1] 4:2:2, [2, 2] 4:2:0."""
    sharpening: Annotated[Number | None, "1", (0.0, 3.0)] = None
    """Strength of the sharpening by the image processor, or by scaling: the factor on what a Gaussian filter of
    :data:`SHARPENED_SIGMA` takes away, on 8-bit levels. None: no sharpening."""
    jpeg: Annotated[Number | None, "1", (1.0, 100.0)] = None
    """Quality of the camera's JPEG files; None: the camera delivers uncompressed pictures."""
    exposure_time: Annotated[Number | None, "s", (0.0, 10.0)] = None
    """Time for which a row is exposed; None: 0. Only pictures of a moving camera or scene depend on it."""
    line_delay: Annotated[Number | None, "s", (0.0, 0.1)] = None
    """Time between the exposures of two neighbouring rows of a picture of the camera's own size (rolling shutter);
    None: a global shutter. The time to read a whole picture does not depend on its size."""
    flash: Annotated[Number | None, "m^2", (0.0, 1000.0)] = None
    """Strength of a flash at the lens, which fires when the sun is below the horizon: radiance of a white sheet that
    faces it, times the square of its distance. None: no flash."""

    def check(self, name: str) -> None:
        """Raises :class:`SensorError` if values of camera ``name`` do not fit each other."""
        if self.subsampling not in _JPEG:
            raise spec_file.SensorError(
                f"camera {name!r}: colour.chroma is {list(self.chroma.value)} px; give [1, 1], [2, 1] or [2, 2]"
            )

    @property
    def subsampling(self) -> tuple[int, ...]:
        """Pixels across and down that share one chroma sample."""
        return tuple(int(n) if n == int(n) else 0 for n in self.chroma.value)

    def tone_curve(self) -> np.ndarray:
        """Returns the tone curve [4096]: 8-bit value by the square root of light from 0 to the clipping point."""
        light = (np.arange(TONE_ENTRIES) / (TONE_ENTRIES - 1.0)) ** 2
        s = self.shoulder.value
        toe = self.toe.value
        light = light * (1.0 + s) / (1.0 + s * light)
        light = light * light * (1.0 + toe) / np.maximum(light + toe, 1e-12)
        seen = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
        above = seen > 0.5
        side = np.clip(2.0 * np.where(above, 1.0 - seen, seen), 0.0, 1.0)
        bent = 0.5 * side**self.contrast.value
        return np.round(255.0 * np.where(above, 1.0 - bent, bent)).astype(np.uint8)

    def matrix(self) -> np.ndarray:
        """Returns the colour matrix [3, 3] on linear RGB, which keeps luminance."""
        s = self.saturation.value
        return s * np.eye(3) + (1.0 - s) * np.tile(LUMINANCE, (3, 1))


@functools.cache
def _normal_numbers() -> np.ndarray:
    """Returns normal numbers with variance 1, for the noise of all pictures."""
    return np.random.default_rng(20).standard_normal(_NOISE_NUMBERS, np.float32)


class Response:
    """The colour response of one camera, with its automatic exposure and its error of the white balance."""

    def __init__(
        self,
        spec: ColourSpec,
        width: int,
        height: int,
        samples: int,
        fixed: float | None,
        rng: np.random.Generator,
        device: str = "cpu",
        workers: ThreadPool | None = None,
    ) -> None:
        """``width``, ``height``: of the picture [px]; ``samples``: number of colour samples along each side of a pixel;
        ``fixed``: fixed exposure, None: automatic; ``rng``: source of the error of the white balance, which the camera
        keeps; ``workers``: threads that share the rows."""
        self.spec = spec
        self.width = width
        self.height = height
        self.samples = samples
        self.device = device
        self._workers = workers or ThreadPool(1)
        self._meter = automatic.LightMeter(
            width * samples, height * samples, samples, fixed, device, spec.key.value, spec.adaptation.value
        )
        red, blue = np.exp(spec.balance.value * rng.standard_normal(2))
        self.balance_error = np.array([red, 1.0, blue])
        """Factors [3] on linear light."""
        self._light = wp.empty(width * height, dtype=wp.vec3, device=device)
        self._rgb = wp.empty((width * height, 3), dtype=wp.uint8, device="cpu")
        numbers = colour_response.ColourResponse()
        numbers.matrix = wp.mat33(*spec.matrix().ravel().tolist())
        numbers.shot = 1.0 / spec.full_well.value
        numbers.read = (spec.read_noise.value / spec.full_well.value) ** 2
        numbers.falloff = spec.vignetting.value
        numbers.tone = wp.array(spec.tone_curve(), dtype=wp.uint8, device="cpu")
        numbers.noise = wp.array(_normal_numbers(), dtype=float, device="cpu")
        self._starts = np.zeros(height, np.int32)
        numbers.noise_start = wp.array(self._starts, dtype=wp.int32, device="cpu", copy=False)
        self._numbers = numbers

    def meter(self, radiance: wp.array, time: float, brightness: float) -> float:
        """Returns the exposure for ``radiance`` [sample] at simulated ``time`` [s]; ``brightness``: of the daylight."""
        return float(self._meter.update(radiance, time, brightness).numpy()[0])

    def most_light(self, exposure: float) -> float:
        """Returns the radiance that the light of one sample counts as at most, so that edges of lights are smooth."""
        return _MOST_LIGHT * self.spec.white.value / max(exposure, 1e-9)

    def light(self, radiance: wp.array, exposure: float) -> np.ndarray:
        """Returns linear RGB [height, width, 3] of the pixels, before the lens blurs it. The array may be that of
        ``radiance`` [sample].

        ``exposure``: light that is brighter than ``_MOST_LIGHT`` times the clipping point then counts as that bright.
        """
        source = radiance
        if self.samples > 1 or self.device != "cpu":
            most = self.most_light(exposure)
            wp.launch(
                colour_response.average_samples,
                self.width * self.height,
                inputs=[radiance, self.width, self.samples, most],
                outputs=[self._light],
                device=self.device,
            )
            source = self._light
        return source.numpy().reshape(self.height, self.width, 3)

    def develop(self, light: np.ndarray, exposure: float, balance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Returns the 8-bit picture [height, width, 3] before compression.

        ``light`` [height, width, 3]: linear RGB, which may be changed; ``balance``: white balance, factors [3];
        ``rng``: source of the noise of this picture.
        """
        blur = self.spec.blur.value
        if blur > 0.0:
            reach = max(1, round(2.0 * blur))
            cv2.GaussianBlur(light, (2 * reach + 1, 2 * reach + 1), blur, dst=light, borderType=cv2.BORDER_REPLICATE)
        numbers = self._numbers
        numbers.gain = wp.vec3(*(balance * self.balance_error / self.spec.white.value).tolist())
        self._starts[:] = rng.integers(_NOISE_NUMBERS - 2 * NOISE_STRIDE - self.width, size=self.height)
        flat = wp.array(light.reshape(-1, 3), dtype=float, device="cpu", copy=False)
        count = self._workers.size if self.device == "cpu" else 1
        rows = [self.height * i // count for i in range(count + 1)]

        def respond(first: int, end: int) -> None:
            wp.launch(
                colour_response.respond_rows,
                end - first,
                inputs=[flat, self.width, self.height, exposure, numbers, first],
                outputs=[self._rgb],
                device="cpu",
            )

        self._workers.share([functools.partial(respond, *ends) for ends in itertools.pairwise(rows)])
        rgb = self._rgb.numpy().reshape(self.height, self.width, 3)
        strength = self.spec.sharpening.value if self.spec.sharpening is not None else 0.0
        return sharpened(rgb, strength) if strength > 0.0 else rgb

    def compress(self, rgb: np.ndarray) -> np.ndarray:
        """Returns ``rgb`` [height, width, 3] as the camera delivers it: with its chroma subsampling, and after JPEG."""
        return compressed(rgb, self.spec.subsampling, self.spec.jpeg and round(self.spec.jpeg.value))


def sharpened(rgb: np.ndarray, strength: float) -> np.ndarray:
    """Returns the 8-bit picture ``rgb`` [height, width, 3] with ``strength`` times its fine detail added (an unsharp
    mask)."""
    smooth = cv2.GaussianBlur(rgb, (0, 0), SHARPENED_SIGMA, borderType=cv2.BORDER_REPLICATE)
    return cv2.addWeighted(rgb, 1.0 + strength, smooth, -strength, 0.0)


def compressed(rgb: np.ndarray, subsampling: tuple[int, ...], quality: int | None) -> np.ndarray:
    """Returns the picture ``rgb`` [height, width, 3] after chroma subsampling and JPEG.

    ``subsampling``: pixels across and down that share one chroma sample; ``quality``: of JPEG, 1 to 100; None: only the
    chroma is subsampled.
    """
    if quality is None:
        return rgb.copy() if subsampling == (1, 1) else _subsampled(rgb, *subsampling)
    factor = _JPEG[subsampling[0], subsampling[1]]
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(
        ".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, factor]
    )
    if not done:
        raise RuntimeError(f"OpenCV does not encode a picture of {bgr.shape[1]}x{bgr.shape[0]} px")
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert decoded is not None, "OpenCV reads what it has written"
    return cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB)


def _subsampled(rgb: np.ndarray, across: int, down: int) -> np.ndarray:
    """Returns the picture with one chroma sample for each block of ``across`` x ``down`` pixels, in the 8 bits of video
    (ITU-R BT.601)."""
    height, width = rgb.shape[:2]
    even = rgb
    if width % 2 or height % 2:
        even = cv2.copyMakeBorder(rgb, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    there, back = _YUV[across, down]
    return np.ascontiguousarray(cv2.cvtColor(cv2.cvtColor(even, there), back)[:height, :width])
