"""Random scenes for the images of a data set: wind, and people, robots and crates where there is space for them.

A scene depends only on the random numbers of its image; nothing is kept from one image to the next.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from vinesim.client.composition.scene_composer import (
    CratePlacement,
    PersonPlacement,
    PlacementError,
    RobotPlacement,
    SceneComposer,
)
from vinesim.scene import appearance
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import Snapshot
from vinesim.scene.wind import Wind
from vinesim.wind.sway import Sway
from vinesim.world import Physics

ROBOT_NAMES = ("vinebot", "logistic")
FOOTPRINT_RADIUS = {"vinebot": 0.70, "logistic": 0.95, "person": 0.40, "crate": 0.38}
"""Radius of the ground that each kind covers, including arms and hands [m]. GUESSED."""
MIN_DISTANCE = 0.5
"""Smallest horizontal distance of an actor or crate from the bunch in view [m]."""
MAX_DISTANCE = 3.5
"""Largest horizontal distance of an actor or crate from the bunch in view [m]."""
CRATE_HEIGHTS = (0.15, 0.20, 0.24, 0.30)
"""Heights of crates [m]."""
WIND_SHARE = 0.6
"""Fraction of the images with actors in which wind blows."""
WIND_SPEED = (0.5, 3.5)
"""Range of the mean wind at the top of the canopy [m/s]. GUESSED: calm to a gentle breeze."""
WIND_STEPS = (50, 130)
"""Range of the number of steps with wind before the picture."""
_MAX_TRIES = 40


@dataclasses.dataclass(frozen=True, slots=True)
class SceneRandomizer:
    """Composes random scenes; implements :class:`vinesim.sensors.export.dataset.SnapshotSource`."""

    share: float = 0.4
    """Fraction of the images, or sequences, with actors."""

    def settings(self) -> dict[str, Any]:
        """All settings that determine the scenes, as JSON values."""
        return {"share": self.share, "robots": list(ROBOT_NAMES)}

    def snapshot(
        self, model: Model, rng: np.random.Generator, parameters: PhysicsParameters = PhysicsParameters()
    ) -> tuple[Snapshot, np.ndarray, dict[str, Any]] | None:
        """Returns a snapshot of a random scene, see :meth:`vinesim.sensors.export.dataset.SnapshotSource.snapshot`."""
        if rng.uniform() >= self.share or (staged := _stage(model, rng, parameters)) is None:
            return None
        physics, middle, happens = staged
        if rng.uniform() < WIND_SHARE:
            happens["wind"] = _simulate_wind(physics, rng)
        return Sway(model).apply(physics.snapshot()), middle, happens

    def frames(
        self, model: Model, rng: np.random.Generator, parameters: PhysicsParameters, period: float
    ) -> Iterator[tuple[Snapshot, np.ndarray | None, dict[str, Any]]]:
        """Yield states of a random scene with wind, see
        :meth:`vinesim.sensors.export.dataset.SnapshotSource.frames`."""
        staged = _stage(model, rng, parameters) if rng.uniform() < self.share else None
        physics, middle, happens = staged or (Physics(model, parameters=parameters), None, {})
        happens["wind"] = _simulate_wind(physics, rng)
        sway = Sway(model)
        while True:
            yield sway.apply(physics.snapshot()), middle, dict(happens)
            for _ in range(round(period / physics.dt)):
                physics.step()


def _stage(
    model: Model, rng: np.random.Generator, parameters: PhysicsParameters
) -> tuple[Physics, np.ndarray, dict[str, Any]] | None:
    """Returns physics with random actors around a random bunch, the bunch's place [2] m, and a record; None if no
    actors fit."""
    bunch = int(rng.integers(len(model.bunch_body)))
    middle = model.forward_kinematics(model.joint_settled)[model.bunch_body[bunch], :2].astype(float)
    for _ in range(_MAX_TRIES):
        stage = random_composition(model, middle, rng)
        physics = Physics(stage.with_crates(model), parameters=parameters)
        try:
            stage.populate(physics)
        except PlacementError:
            continue
        return physics, middle, {"actors": stage.actor_records(model)}
    return None


def random_composition(model: Model, middle: np.ndarray, rng: np.random.Generator) -> SceneComposer:
    """Returns random actors and crates around ``middle`` [2] m of the ground, clear of trunks, poles and each other."""
    wood = np.isin(model.fixed_organ, [Organ.POLE, Organ.TRUNK])
    taken = [(spot, 0.12) for spot in model.fixed_start[wood, :2].astype(float)]
    taken += [(spot, FOOTPRINT_RADIUS["crate"]) for spot in model.box_pose[:, :2].astype(float)]
    kinds = [ROBOT_NAMES[rng.integers(len(ROBOT_NAMES))] for _ in range(rng.integers(0, 2))]
    kinds += ["person"] * int(rng.integers(0, 3)) + ["crate"] * int(rng.integers(0, 3))
    robots = []
    people = []
    crates = []
    for kind in kinds or ["person"]:
        spot = _free_place(middle, taken, FOOTPRINT_RADIUS[kind], rng)
        yaw = float(rng.uniform(-np.pi, np.pi))
        if spot is None:
            continue
        taken.append((spot, FOOTPRINT_RADIUS[kind]))
        x, y = (round(float(v), 4) for v in spot)
        if kind == "person":
            posture = appearance.posture_names()[rng.integers(len(appearance.posture_names()))]
            people.append(PersonPlacement(x, y, round(yaw, 4), posture, round(float(rng.normal(1.72, 0.07)), 3)))
        elif kind == "crate":
            fill = round(float(rng.choice([0.0, rng.uniform(0.1, 0.5)])), 3)
            crates.append(CratePlacement(x, y, round(yaw, 4), fill, (0.6, 0.4, float(rng.choice(CRATE_HEIGHTS)))))
        else:
            robots.append(RobotPlacement(kind, x, y, round(yaw, 4)))
    return SceneComposer(tuple(robots), tuple(people), tuple(crates))


def _free_place(
    middle: np.ndarray, taken: list[tuple[np.ndarray, float]], radius: float, rng: np.random.Generator
) -> np.ndarray | None:
    """Returns a random place [2] m for a disc that overlaps no other disc; None if none is found.

    ``taken``: centre [2] m and radius [m] of the other discs.
    """
    for _ in range(_MAX_TRIES):
        away = rng.uniform(MIN_DISTANCE, MAX_DISTANCE)
        around = rng.uniform(0.0, 2.0 * np.pi)
        spot = middle + away * np.array([np.cos(around), np.sin(around)])
        if all(np.hypot(*(spot - other)) > radius + reach for other, reach in taken):
            return spot
    return None


def _simulate_wind(physics: Physics, rng: np.random.Generator) -> dict[str, Any]:
    """Step physics with a random wind. Returns the wind's parameters as JSON values."""
    speed = float(rng.uniform(*WIND_SPEED))
    heading = float(rng.uniform(-np.pi, np.pi))
    ticks = int(rng.integers(*WIND_STEPS))
    seed = int(rng.integers(1 << 31))
    mean = np.array([speed * np.cos(heading), speed * np.sin(heading), 0.0])
    physics.wind = Wind(mean, gusts=0.4 * speed, seed=seed)
    for _ in range(ticks):
        physics.step()
    return {"mean": mean.round(4).tolist(), "gusts": round(0.4 * speed, 4), "seed": seed, "seconds": ticks * physics.dt}
