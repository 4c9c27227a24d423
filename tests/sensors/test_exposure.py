"""From light to pixels: what is metered, how fast exposure follows, and the halo of a lamp."""

import cv2
import numpy as np
import pytest

from vinesim.sensors.camera import exposure
from vinesim.sensors.camera.exposure import Exposure

PLAIN = np.ones(3)


class _Lamps:
    """Primitives of which number 7 shines."""

    lamp_primitives = np.array([7])
    count = 9


def _exposed(of: Exposure) -> float:
    return float(of._exposure.numpy()[0])


def _even(light: float, width: int = 64, height: int = 48, **others) -> Exposure:
    film = Exposure(width, height, **others)
    film.radiance.fill_(light)
    return film


@pytest.mark.parametrize("light", [0.1, 0.3, 0.8])
def test_half_of_the_stops_are_made_up(light: float) -> None:
    """The stops between light and key that exposure takes out are the share it says."""
    film = _even(light)
    film.tone_map(PLAIN, 0.0)
    wanted = exposure.NOON_EXPOSURE * (exposure.KEY_VALUE / light / exposure.NOON_EXPOSURE) ** exposure.ADAPTED_SHARE
    assert _exposed(film) == pytest.approx(wanted, rel=1e-3)


def test_exposure_settles_as_it_says() -> None:
    """After one settling time, 1/e of the stops to go is left; a first picture has no past."""
    film = _even(0.2)
    film.tone_map(PLAIN, 0.0)
    first = _exposed(film)
    film.radiance.fill_(0.8)
    film.tone_map(PLAIN, exposure.ADAPTATION_TIME)
    now = _exposed(film)
    final = first * 0.25**exposure.ADAPTED_SHARE
    assert np.log(now / final) / np.log(first / final) == pytest.approx(np.exp(-1.0), rel=1e-3)
    fresh = _even(0.8)
    fresh.tone_map(PLAIN, 5.0)
    assert _exposed(fresh) == pytest.approx(final, rel=1e-3)


def test_fixed_exposure_stays() -> None:
    film = _even(0.7, fixed=0.5)
    film.tone_map(PLAIN, 0.0)
    assert _exposed(film) == 0.5


def test_grey_stays_grey_and_balance_takes_a_cast_out() -> None:
    grey = _even(0.3).tone_map(PLAIN, 0.0).numpy()
    assert (grey == grey[0, 0]).all()
    film = Exposure(64, 48)
    film.radiance.assign(np.tile([0.4, 0.3, 0.2], (64 * 48, 1)).astype(np.float32))
    balanced = film.tone_map(np.array([0.75, 1.0, 1.5]), 0.0).numpy()
    assert np.ptp(balanced[0].astype(int)) <= 1


def test_samples_are_averaged_as_light() -> None:
    """Half a pixel of light and half of dark is half of the light, which the tone curve brightens."""
    film = Exposure(16, 16, samples=2, fixed=1.0)
    light = np.zeros((32, 32, 3), np.float32)
    light[:, ::2] = 0.4
    film.radiance.assign(light.reshape(-1, 3))
    mixed = film.tone_map(PLAIN, 0.0).numpy()
    assert np.array_equal(mixed, _even(0.2, 16, 16, fixed=1.0).tone_map(PLAIN, 0.0).numpy())


def test_a_lamp_has_glare_and_nothing_else_has() -> None:
    """The glare falls off with distance, is even in all directions, and its light is the share that a lens scatters."""
    import warp as wp

    film = Exposure(161, 161, fixed=1.0)
    film.radiance.zero_()
    light = film.radiance.numpy().reshape(161, 161, 3)
    light[80, 80] = [0.0, 50.0, 0.0]
    light[20, 20] = [50.0, 50.0, 50.0]
    seen = np.full((161, 161), 3, np.int32)
    seen[80, 80] = 7
    film.add_glare(_Lamps(), wp.array(seen.ravel(), dtype=int))
    around = light[..., 1] - np.where(seen == 7, 50.0, 0.0)
    around[20, 20] = 0.0
    assert around[80, 84] > around[80, 90] > around[80, 100] > 0.0
    assert around[80, 90] == pytest.approx(around[90, 80], rel=1e-4)
    assert around.sum() == pytest.approx(50.0 * sum(strength for _, strength in exposure._GLARE), rel=0.02)
    assert (light[..., 0] == 0.0).sum() == 161 * 161 - 1


def test_glare_is_a_gaussian_blur_of_the_lamps() -> None:
    """Of several lamps of several pixels, as OpenCV blurs the whole picture; beyond the border there is no light."""
    rng = np.random.default_rng(2)
    light = rng.uniform(0.0, 1.0, (120, 200, 3)).astype(np.float32)
    lit = np.zeros((120, 200), bool)
    lit[50:53, 60:64] = lit[70, 130] = lit[75:77, 140] = True
    light[lit] *= 40.0
    wanted = light.copy()
    for width, strength in exposure._GLARE:
        padded = np.pad(light * lit[..., None], ((60, 60), (60, 60), (0, 0)))
        wanted += strength * cv2.GaussianBlur(padded, (0, 0), width * 1.2)[60:-60, 60:-60]
    exposure.glare(light, lit)
    assert np.allclose(light, wanted, rtol=1e-3, atol=1e-3)
