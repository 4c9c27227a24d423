"""Wind: a steady mean and gusts that travel with it. It acts on plants as drag on leaves and wood.

Turbulence is *frozen* (Taylor, Proc. R. Soc. A 164, 1938): the mean carries a fixed pattern along, so a gust that is
here now is downwind later, and trees in a row bend one after the other. The pattern is a sum of divergence-free plane
waves (Kraichnan, Phys. Fluids 13, 1970). Their wave numbers are drawn from von Karman's spectrum of length scale L, in
which energy rises as k^4 and falls as k^-5/3. Near a canopy, gusts are 0.3 to 0.6 of the mean inside the canopy and a
few canopy heights long (Raupach, Finnigan and Brunet, Boundary-Layer Meteorol. 78, 1996).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from vinesim.core import frames
from vinesim.scene.spec import Scene

GUST_WAVES = 48
"""Number of plane waves in the pattern of gusts."""


class Wind:
    """A field of air velocity, a pure function of position and time. Equal arguments give equal fields on all clients.

    Args:
        mean: velocity of the steady wind [3] m/s, world axes, at the top of the canopy upwind of the first row; the
            gusts travel with it.
        gusts: standard deviation of each component about the mean [m/s].
        scale: length scale of the gusts [m].
        seed: seed of the pattern.
    """

    def __init__(self, mean: npt.ArrayLike, *, gusts: float = 0.0, scale: float = 4.0, seed: int = 0) -> None:
        self.mean = np.asarray(mean, float)
        if self.mean.shape != (3,) or not np.isfinite(self.mean).all():
            raise ValueError(f"mean wind {mean}: give three finite numbers, m/s")
        if not 0.0 <= gusts < np.inf or not 0.0 < scale < np.inf:
            raise ValueError(f"gusts {gusts} m/s, scale {scale} m: need gusts of 0 or more and a positive scale")
        self.gusts = gusts
        self.scale = scale
        rng = np.random.Generator(np.random.PCG64(seed))
        # wave numbers at equal shares of the energy; shuffled, because directions are drawn in order
        grid = np.geomspace(1e-2, 1e2, 4000) / scale
        energy = np.cumsum((grid * scale) ** 4 / (1.0 + (grid * scale) ** 2) ** (17.0 / 6.0) * np.gradient(grid))
        share = (np.arange(GUST_WAVES) + 0.5) / GUST_WAVES
        number = np.interp(rng.permutation(share), energy / energy[-1], grid)
        along = frames.normalize(rng.normal(size=(GUST_WAVES, 3)))
        self.wave_number = number[:, None] * along
        self.wave_phase = rng.uniform(0.0, 2.0 * np.pi, GUST_WAVES)
        across = np.cross(along, frames.normalize(rng.normal(size=(GUST_WAVES, 3))))
        self.wave_amplitude = frames.normalize(across) * gusts * np.sqrt(6.0 / GUST_WAVES)
        """[wave, 3] m/s, velocity amplitudes of the plane waves. ``wave_number`` [wave, 3] rad/m are their wave vectors
        and ``wave_phase`` [wave] rad their phases."""

    def velocity_at(self, points: np.ndarray, time: float) -> np.ndarray:
        """Returns the velocity of the undisturbed air [..., 3] m/s at world ``points`` [..., 3] m and ``time`` [s]."""
        points = np.asarray(points, float)
        if self.gusts == 0.0:
            return np.broadcast_to(self.mean, points.shape)
        phase = (points - self.mean * time) @ self.wave_number.T + self.wave_phase
        return self.mean + np.cos(phase) @ self.wave_amplitude


def wind_of(scene: Scene) -> Wind | None:
    """Returns the wind that a scene file describes; None for calm air."""
    wind = scene.wind
    if not any(wind.mean) and wind.gusts == 0.0:
        return None
    return Wind(np.array(wind.mean), gusts=wind.gusts, scale=wind.scale, seed=scene.seed)
