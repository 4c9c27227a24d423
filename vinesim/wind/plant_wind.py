"""Wind on the plants: it is simulated on trees near robots and people. Sensors compute the motion of all other trees.

Trees in gusts never sleep, and a step has no time for ten thousand awake trees. So wind is simulated only on trees near
a robot or a person. All other trees sleep in their last rest pose. Their motion in the wind is a function of position
and time, which sensors compute for visible trees (:mod:`vinesim.wind.sway`).

Each tree has a phase from 0 (its motion is drawn) to 1 (its motion is simulated). The phase rises while the tree is
awake and near an observer. From 0 to 0.5 the air velocity at the simulated tree grows to the wind's; from 0.5 to 1 the
drawn motion fades out. Otherwise the phase falls, and the tree keeps its last air velocity. So visible motion is
continuous.
"""

from __future__ import annotations

import numpy as np

from vinesim.kernels.plants.forces import AIR_DENSITY
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import GRAVITY
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State
from vinesim.scene.values import WindState
from vinesim.scene.wind import Wind
from vinesim.wind.shelter import TreeDrag

FADE_DURATION = 2.0
"""[s] Half of the duration of a change between drawn and simulated motion, and the duration in which wind begins or
ends. TUNED: twice the period of a slow shoot, so that a simulated tree follows its growing load."""

Observers = tuple[np.ndarray, float]
"""Points [n, 3] m and a distance [m]: wind is simulated on trees whose foot is within the distance of a point."""


class WindOnPlants:
    """Sets ``plants.tree_air`` before each step, and wakes sleeping trees near observers if the wind has changed."""

    def __init__(self, plants: ArticulationSolver, parameters: PhysicsParameters = PhysicsParameters()) -> None:
        self.plants = plants
        self.parameters = parameters
        model = plants.model
        first = plants.model.tree_first
        number = np.arange(len(model.body_mass)) - first[model.body_tree]
        core = number < model.tree_core[model.body_tree]  # a bunch's mass includes its clusters
        self._foot = model.tree_pose[:, :3].astype(float)
        self._weight = np.add.reduceat(model.body_mass * core, first) * -GRAVITY[2] if len(first) else np.zeros(0)
        self.phase = np.zeros(len(first), np.float32)
        """[tree] 0: the motion of the tree in the wind is drawn; 1: it is simulated."""
        self._drag: TreeDrag | None = None
        self._wind: Wind | None = None
        self._strength = 0.0
        self._time = 0.0
        self._round = 0
        self._steps = 0

    def update(self, wind: Wind | None, time: float, observers: Observers | None = None) -> None:
        """Set the air velocity at each tree for ``wind`` (None: calm air) at world ``time`` [s]. Call it before a step.

        Without ``observers`` wind is simulated on all awake trees. A wind given in the first step has full strength at
        once. A wind that begins or ends later fades in or out.
        """
        self._follow(wind)
        self._time = time
        self._steps = self._steps + 1
        if self._wind is None:
            return
        plants = self.plants
        driven = np.zeros(len(self.phase), bool)
        driven[awake := self._near(plants.awake, observers)] = True
        step = 0.5 * self.parameters.dt / FADE_DURATION
        if self._steps == 1:
            self.phase[driven] = 1.0
        fading = np.flatnonzero((self.phase > 0.0) & ~driven)
        self.phase[fading] = np.maximum(self.phase[fading] - step, 0.0)
        before = np.minimum(2.0 * self.phase[awake], 1.0)[:, None]
        self.phase[awake] = np.minimum(self.phase[awake] + step, 1.0)
        after = np.minimum(2.0 * self.phase[awake], 1.0)[:, None]
        growth = np.where(before < 1.0, (after - before) / np.maximum(1.0 - before, 1e-6), 1.0)
        plants.tree_air[awake] += growth * (self._air(awake) - plants.tree_air[awake])
        if wind is self._wind:
            self._wake_stirred(observers)
        else:
            self._calm(~driven)

    @property
    def state(self) -> WindState | None:
        """The wind at this instant, for snapshots from which sensors compute the sway of trees; None in calm air."""
        if self._wind is None:
            return None
        fade = np.clip(2.0 - 2.0 * self.phase, 0.0, 1.0)
        drawn = fade * fade * (3.0 - 2.0 * fade)
        return WindState(self._wind, self._time, self._strength, self.plants.tree_air.copy(), drawn)

    def _follow(self, wind: Wind | None) -> None:
        """Fade the present wind in or out by one step, towards the strength that ``wind`` requires. The present wind
        fades out before another wind begins.
        """
        step = self.parameters.dt / FADE_DURATION
        if wind is self._wind:
            self._strength = min(self._strength + step, 1.0)
            return
        self._strength = max(self._strength - step, 0.0)
        if self._strength == 0.0:
            self._wind = wind
            self.plants.tree_air[:] = 0.0
            if wind is not None:
                if self._drag is None:
                    self._drag = TreeDrag.of(self.plants.model, State.at_rest(self.plants.model).body_q)
                self._share = self._drag.air_share(wind.mean)
                self._strength = 1.0 if self._steps == 0 else step

    def _air(self, trees: np.ndarray) -> np.ndarray:
        """Returns the velocity [k, 3] m/s of the wind at ``trees`` [k]."""
        assert self._wind is not None
        velocity = self._wind.velocity_at(self._foot[trees], self._time)
        return self._strength * self._share[trees, None] * velocity

    def _calm(self, trees: np.ndarray) -> None:
        """Reduce the air velocity of ``trees`` [tree] bool while a wind fades out, and wake these trees."""
        felt = np.flatnonzero(trees & (self.plants.tree_air != 0.0).any(1))
        if len(felt):
            self.plants.wake(felt)
            ago = self._strength + self.parameters.dt / FADE_DURATION
            self.plants.tree_air[felt] *= self._strength / ago

    def _wake_stirred(self, observers: Observers | None) -> None:
        """Wake sleeping trees whose drag has changed. Each step checks a fixed share of the sleeping trees."""
        plants = self.plants
        parameters = self.parameters
        rounds = parameters.steps(parameters.wind_check_period)
        self._round = (self._round + 1) % rounds
        some = np.arange(self._round, len(self._foot), rounds)
        assert self._drag is not None
        area = self._drag.area
        some = self._near(some[~plants.state.tree_awake[some] & (area[some] > 0.0)], observers)
        air = self._air(some)
        felt = plants.tree_air[some].astype(float)
        change = air * np.linalg.norm(air, axis=-1, keepdims=True) - felt * np.linalg.norm(felt, axis=-1, keepdims=True)
        force = 0.5 * AIR_DENSITY * area[some] * np.linalg.norm(change, axis=-1)
        plants.wake(some[force > parameters.wind_wake_load * self._weight[some]])

    def _near(self, trees: np.ndarray, observers: Observers | None) -> np.ndarray:
        """Returns the subset of ``trees`` whose foot is near an observer."""
        if observers is None:
            return trees
        points = np.atleast_2d(np.asarray(observers[0], float))
        distance = observers[1]
        near = np.zeros(len(trees), bool)
        for point in points:  # there are few robots and people
            near |= ((self._foot[trees] - point) ** 2).sum(-1) < distance * distance
        return trees[near]
