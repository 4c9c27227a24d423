"""Work on plants as people do it: hold a shoot, move it, tie it to a wire, untie it.

hold = simulation.hold(body, along=0.03)  # a hand at this place of a cane
hold.follow((1.2, 0.05, 1.3), speed=0.1)  # tuck it between the wires
while not hold.is_done:
    simulation.step()
simulation.tie(body)  # to the nearest wire
hold.release()
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.core.numbers import as_numbers, checked_number
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.ties import TieLimitError
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model

TIE_REACH = 0.12
"""[m] Largest gap between a cane and a wire to which it is tied: as far as a person pulls a shoot while tying it.
GUESSED."""
GRIP_STIFFNESS = 2000.0
"""[N/m] Stiffness of a hold or a new tie: that of ties in ``data/plants/vine.toml``."""
GRIP_DAMPING = 20.0
"""[N s/m] Damping of a hold or a new tie, as above."""
_TIED_PLACES = 65
"""Number of places of a body among which the one nearest to a wire is found."""
PULL_SPEED = 0.1
"""[m/s] Speed at which a new tie pulls a cane to its wire. GUESSED."""


class Hold:
    """A spring that holds a place of a plant at a point of the world, which can be moved: a hand, or a tie.
    :meth:`vinesim.api.simulation.Simulation.hold` and ``tie`` make one."""

    def __init__(self, plants: ArticulationSolver, body: int, along: float) -> None:
        self.body = body
        """Body that is held: index in the model."""
        self.along = along
        """[m] Place on the body's x axis."""
        self._plants = plants
        self._place = np.array([along, 0.0, 0.0])
        try:
            self._tie: int | None = plants.add_tie(body, self._place, GRIP_STIFFNESS, GRIP_DAMPING)
        except (TieLimitError, ValueError) as bad:
            raise UsageError(str(bad)) from None
        self._path = self.target[None]
        self._speed = 0.0

    @property
    def is_held(self) -> bool:
        """Whether the plant is still held."""
        return self._tie is not None

    @property
    def target(self) -> np.ndarray:
        """[3] m, point of the world to which the held place is pulled."""
        self._check()
        return self._plants.tie_anchor[self._tie].astype(float)

    @property
    def position(self) -> np.ndarray:
        """[3] m, the held place."""
        self._plants.forward_kinematics(self._plants.model.body_tree[[self.body]])
        pose = self._plants.state.body_q[self.body].astype(float)
        return pose[:3] + frames.rotate(pose[3:], self._place)

    @property
    def force(self) -> np.ndarray:
        """[3] N on the plant, without damping, world axes; zero after :meth:`release`."""
        return GRIP_STIFFNESS * (self.target - self.position) if self.is_held else np.zeros(3)

    @property
    def is_done(self) -> bool:
        """Whether the target has reached the end of its path."""
        return len(self._path) == 1

    def follow(self, path: Sequence[float] | Sequence[Sequence[float]] | np.ndarray, speed: float) -> None:
        """Move the target from where it is along ``path`` at ``speed`` [m/s].

        ``path``: a point [3] m or points [k, 3] m. Raises :class:`UsageError` if the plant was let go.
        """
        self._check()
        points = np.atleast_2d(as_numbers(path))
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise UsageError(f"path is {path}; give a point [3] or points [k, 3] of finite numbers [m]")
        checked_number("speed", speed, "m/s", positive=True, error=UsageError)
        self._path = np.concatenate([self.target[None], points])
        self._speed = float(speed)

    def release(self) -> None:
        """Let the plant go; nothing happens if it was let go before."""
        if self._tie is not None:
            self._plants.remove_tie(self.body, self._tie)
            self._plants.wake(int(self._plants.model.body_tree[self.body]))
            self._tie = None

    def control(self) -> None:
        """Move the target before a step. The held tree stays awake while it moves."""
        if self._tie is None or self.is_done:
            return
        left = self._speed * self._plants.dt
        at = self._path[0]
        while left > 0.0 and len(self._path) > 1:
            way = self._path[1] - at
            length = float(np.linalg.norm(way))
            if length > left:
                at = at + way * (left / length)
                break
            left -= length
            at = self._path[1]
            self._path = self._path[1:]
        self._path[0] = at
        self._plants.tie_anchor[self._tie] = at
        self._plants.wake(int(self._plants.model.body_tree[self.body]))

    def _check(self) -> None:
        if self._tie is None:
            raise UsageError(f"body {self.body} was let go; hold it again")


def tied_places(length: float) -> np.ndarray:
    """Returns the places [k] m of a body of ``length`` [m] at which a tie may be bound."""
    return np.linspace(0.0, length, _TIED_PLACES)


def place_at_wire(model: Model, places: np.ndarray, radius: float, reach: float) -> tuple[int, np.ndarray]:
    """Find where a cane of ``radius`` [m] is nearest to a straight wire.

    Returns the index of the nearest of the points ``places`` [k, 3] m of its axis, and where this point [3] m is when
    the cane touches the wire on the side on which it is. Raises :class:`UsageError` if no wire is nearer than ``reach``
    [m].
    """
    wires = np.flatnonzero(model.fixed_organ == int(Organ.WIRE))
    start = model.fixed_start[wires].astype(float)
    way = model.fixed_end[wires].astype(float) - start
    square = np.maximum((way * way).sum(1), 1e-12)
    share = np.clip(((places[:, None] - start) * way).sum(2) / square, 0.0, 1.0)
    off = places[:, None] - start - share[..., None] * way
    gaps = np.linalg.norm(off, axis=2)
    if not len(wires) or gaps.min() > reach:
        nearest = f"the nearest is {gaps.min():.3f} m away" if len(wires) else "there is none"
        middle = np.round(places[len(places) // 2], 3).tolist()
        raise UsageError(f"no wire within {reach} m of {middle}; {nearest}; give to = [x, y, z]")
    place, wire = (int(n) for n in np.unravel_index(np.argmin(gaps), gaps.shape))
    gap = float(gaps[place, wire])
    side = off[place, wire] / gap if gap > 1e-6 else np.array([0.0, 0.0, 1.0])
    return place, places[place] + side * (radius + float(model.fixed_radius[wires[wire]].mean()) - gap)
