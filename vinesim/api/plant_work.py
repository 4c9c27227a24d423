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
from vinesim.interaction.handwork import GRIP_DAMPING, GRIP_STIFFNESS, BoundTie, Handwork
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.ties import TieLimitError


class Hold:
    """A spring that holds a place of a plant at a point of the world, which can be moved, as a hand does.
    :meth:`vinesim.api.simulation.Simulation.hold` makes one."""

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


class Binding:
    """A tie that was bound: a spring that holds a place of a cane beside a wire. The tree may fall asleep with it.
    :meth:`vinesim.api.simulation.Simulation.tie` makes one."""

    def __init__(self, handwork: Handwork, tie: BoundTie) -> None:
        self._handwork = handwork
        self._tie = tie

    @property
    def body(self) -> int:
        """Body that is tied: index in the model. It is a stump after a cut beyond the tie."""
        return self._tie.segment if self._tie.body < 0 else self._tie.body

    @property
    def along(self) -> float:
        """[m] Place on the body's x axis."""
        return self._tie.at

    @property
    def is_held(self) -> bool:
        """Whether the tie holds the cane."""
        return self._tie.body >= 0

    @property
    def is_done(self) -> bool:
        """Whether the tie has pulled the cane to the wire."""
        return not self._tie.is_pulling

    @property
    def target(self) -> np.ndarray:
        """[3] m, point of the world to which the tie pulls in the end."""
        return self._tie.to.astype(float)

    @property
    def position(self) -> np.ndarray:
        """[3] m, the tied place."""
        plants = self._handwork.plants
        plants.forward_kinematics(plants.model.body_tree[[self.body]])
        pose = plants.state.body_q[self.body].astype(float)
        return pose[:3] + frames.rotate(pose[3:], np.array([self.along, 0.0, 0.0]))

    @property
    def force(self) -> np.ndarray:
        """[3] N on the plant, without damping, world axes; zero after :meth:`release`."""
        if not self.is_held:
            return np.zeros(3)
        return GRIP_STIFFNESS * (self._handwork.plants.tie_anchor[self._tie.row].astype(float) - self.position)

    def release(self) -> None:
        """Open the tie; nothing happens if it was opened before."""
        self._handwork.open(self._tie)
