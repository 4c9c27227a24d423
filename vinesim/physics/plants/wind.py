"""Wind: a mean that blows steadily and gusts that travel with it, felt by plants as drag on leaves and wood.

Turbulence is *frozen* (Taylor, Proc. R. Soc. A 164, 1938): a fixed pattern carried along by the mean, so what blows
here now blows downwind later, and trees in a row bend one after the other. The pattern is a sum of plane waves
(Kraichnan, Phys. Fluids 13, 1970), each without divergence, their wave numbers drawn from von Karman's spectrum of
length scale L, in which energy rises as k^4 and falls as k^-5/3. Near a canopy gusts are 0.3 to 0.6 of the mean in it
and a few canopy heights long (Raupach, Finnigan and Brunet, Boundary-Layer Meteorol. 78, 1996).
"""

from __future__ import annotations

import numpy as np

from vinesim import frames
from vinesim.kernels.articulation.forces import AIR_DENSITY
from vinesim.physics.parameters import PhysicsParameters
from vinesim.physics.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import GRAVITY

GUST_WAVES = 48
"""Plane waves of which gusts are made."""


class Wind:
    """A field of air velocity: a pure function of place and time, the same on every client with the same arguments.

    Args:
        mean: velocity of the steady wind [3] m/s, world axes; the gusts travel with it.
        gusts: standard deviation of each component about the mean [m/s].
        scale: length scale of the gusts [m].
        seed: of the pattern.
    """

    def __init__(self, mean: np.ndarray, *, gusts: float = 0.0, scale: float = 4.0, seed: int = 0) -> None:
        self.mean = np.asarray(mean, float)
        if self.mean.shape != (3,) or not np.isfinite(self.mean).all():
            raise ValueError(f"mean wind {mean}: give three finite numbers, m/s")
        if not 0.0 <= gusts < np.inf or not 0.0 < scale < np.inf:
            raise ValueError(f"gusts {gusts} m/s, scale {scale} m: need gusts of 0 or more and a positive scale")
        self.gusts, self.scale = gusts, scale
        rng = np.random.Generator(np.random.PCG64(seed))
        # wave numbers at equal shares of the energy; shuffled, since directions are drawn by number
        grid = np.geomspace(1e-2, 1e2, 4000) / scale
        energy = np.cumsum((grid * scale) ** 4 / (1.0 + (grid * scale) ** 2) ** (17.0 / 6.0) * np.gradient(grid))
        share = (np.arange(GUST_WAVES) + 0.5) / GUST_WAVES
        number = np.interp(rng.permutation(share), energy / energy[-1], grid)
        along = frames.normalize(rng.normal(size=(GUST_WAVES, 3)))
        self._wave = number[:, None] * along
        self._phase = rng.uniform(0.0, 2.0 * np.pi, GUST_WAVES)
        across = np.cross(along, frames.normalize(rng.normal(size=(GUST_WAVES, 3))))
        self._sway = frames.normalize(across) * gusts * np.sqrt(6.0 / GUST_WAVES)
        self._plants: ArticulationSolver | None = None
        self._round = 0

    def velocity_at(self, points: np.ndarray, time: float) -> np.ndarray:
        """Velocity of the air [..., 3] m/s at points [..., 3] m of the world at a time [s]."""
        points = np.asarray(points, float)
        if self.gusts == 0.0:
            return np.broadcast_to(self.mean, points.shape)
        return self.mean + np.cos((points - self.mean * time) @ self._wave.T + self._phase) @ self._sway

    def update(
        self,
        plants: ArticulationSolver,
        time: float,
        observers: tuple[np.ndarray, float] | None = None,
        parameters: PhysicsParameters = PhysicsParameters(),
    ) -> None:
        """Set ``plants.tree_air`` of awake trees for the next tick; wake sleepers that the wind would move.

        Wind blows everywhere and gusts let nothing rest, but ten thousand awake trees fit in no tick. ``observers`` =
        (points [n, 3] m, distance [m]) says who is there to see: only trees whose foot is so near to one of the points
        feel the wind. All others keep the air they felt last, so that they come to rest in it and stay asleep.
        """
        if plants is not self._plants:
            model, first = plants.model, plants.model.tree_first
            self._plants, self._foot = plants, model.tree_pose[:, :3].astype(float)
            self._area = np.add.reduceat(model.body_drag.astype(float), first)
            number = np.arange(len(model.body_mass)) - first[model.body_tree]
            core = number < model.tree_core[model.body_tree]  # a bunch's mass has its clusters in it
            self._weight = np.add.reduceat(model.body_mass * core, first) * -GRAVITY[2]
        awake = self._near_observers(plants.awake, observers)
        plants.tree_air[awake] = self.velocity_at(self._foot[awake], time)

        rounds = parameters.steps(parameters.wind_check_period)  # all sleepers are looked at once in so many steps
        self._round = (self._round + 1) % rounds
        some = np.arange(self._round, len(self._foot), rounds)
        some = self._near_observers(some[~plants.state.tree_awake[some] & (self._area[some] > 0.0)], observers)
        air, felt = self.velocity_at(self._foot[some], time), plants.tree_air[some].astype(float)
        change = air * np.linalg.norm(air, axis=-1, keepdims=True) - felt * np.linalg.norm(felt, axis=-1, keepdims=True)
        force = 0.5 * AIR_DENSITY * self._area[some] * np.linalg.norm(change, axis=-1)
        stirred = force > parameters.wind_wake_load * self._weight[some]
        plants.tree_air[some[stirred]] = air[stirred]
        plants.wake(some[stirred])

    def _near_observers(self, trees: np.ndarray, observers: tuple[np.ndarray, float] | None) -> np.ndarray:
        """Those of some trees whose foot is near one of the points."""
        if observers is None:
            return trees
        points, distance = np.atleast_2d(np.asarray(observers[0], float)), observers[1]
        near = np.zeros(len(trees), bool)
        for point in points:  # a handful of robots and people
            near |= ((self._foot[trees] - point) ** 2).sum(-1) < distance * distance
        return trees[near]
