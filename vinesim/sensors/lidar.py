"""Spinning lidars: firing times and angles from a table, exact ranges, intensity by matter and angle.

One revolution is taken at one instant of the world: nothing moves while the head turns. Ranges carry no noise yet.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
import warp as wp

from vinesim import frames
from vinesim.kernels import lidar
from vinesim.sensors import specs
from vinesim.sensors.primitives import Primitives
from vinesim.sensors.raycast import RayCaster
from vinesim.world.ids import Organ, label
from vinesim.world.values import LidarScan
from vinesim.world.vine import Number


class Numbers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sourced list of numbers."""

    value: tuple[float, ...]
    unit: str
    grade: str
    source: str


class LidarSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One kind of lidar (``data/lidars``)."""

    model: str
    elevation: Annotated[Numbers, "deg"]
    """By laser, in the order of firing."""
    laser_period: Annotated[Number, "s"]
    """Between two lasers."""
    firing_period: Annotated[Number, "s"]
    """Between two firings of all lasers."""
    rate: Annotated[Number, "Hz"]
    """Revolutions a second."""
    nearest: Annotated[Number, "m"]
    farthest: Annotated[Number, "m"]
    reflectance: dict[str, Number]
    """Diffuse, by organ in lower case."""

    @classmethod
    def load(cls, name: str) -> LidarSpec:
        """The spec in a file, or the one of that name in ``data/lidars``."""
        spec = specs.load("lidars", name, cls)
        organs = {o.name.lower() for o in Organ if o != Organ.NOTHING}
        if set(spec.reflectance) != organs:
            wrong = sorted(set(spec.reflectance) ^ organs)[0]
            raise specs.SensorError(
                f"{name}: reflectance.{wrong} is missing or unknown; give one for each of {', '.join(sorted(organs))}"
            )
        return spec


class Lidar:
    """One lidar: a table of firings, and the rays' way through the vineyard."""

    def __init__(self, spec: LidarSpec, name: str = "lidar", frame_id: str = "lidar", device: str = "cpu") -> None:
        self.spec, self.name, self.frame_id, self.device = spec, name, frame_id, device
        lasers = len(spec.elevation.value)
        firings = round(1.0 / (spec.rate.value * spec.firing_period.value))
        within = np.arange(lasers) * spec.laser_period.value
        offset = np.arange(firings)[:, None] * spec.firing_period.value + within
        self.offset = offset.ravel().astype(np.float32)
        """Time of each shot after the first [shot] s."""
        # the head turns clockwise seen from above; the first shot looks forward
        azimuth = -2.0 * np.pi * spec.rate.value * offset.ravel()
        elevation = np.radians(spec.elevation.value)
        order = np.argsort(np.argsort(elevation, kind="stable"), kind="stable")
        self.ring = np.tile(order, firings).astype(np.uint16)
        """[shot], 0 for the lowest laser."""
        reflectance = np.zeros(len(Organ), np.float32)
        for organ, number in spec.reflectance.items():
            reflectance[Organ[organ.upper()]] = number.value
        count = len(self.offset)
        self._azimuth, self._elevation, self._reflectance = (
            wp.array(v.astype(np.float32), dtype=float, device=device) for v in (azimuth, elevation, reflectance)
        )
        self._xyz = wp.empty(count, dtype=wp.vec3, device=device)
        self._intensity = wp.empty(count, dtype=float, device=device)
        self._label = wp.empty(count, dtype=wp.int32, device=device)
        self._caster: RayCaster | None = None

    @property
    def rate(self) -> float:
        """Revolutions a second [Hz]."""
        return self.spec.rate.value

    def scan(self, primitives: Primitives, pose: np.ndarray, time: float = 0.0) -> LidarScan:
        """One revolution from ``pose`` [7], the lidar in the world (x forward, z up)."""
        if self._caster is None or self._caster.primitives is not primitives:
            self._caster = RayCaster(primitives)
        pose = np.array(pose, float)
        if not np.isfinite(pose).all():
            raise ValueError(f"lidar {self.name!r} has the pose {pose.tolist()}; give finite numbers")
        turn = frames.normalize(pose[3:])
        run = (
            len(self.spec.elevation.value) if self.device == "cpu" else 1
        )  # structs are handed to a thread, not to a ray
        wp.launch(
            lidar.sweep,
            len(self.offset) // run,
            inputs=[
                primitives.shapes,
                primitives.labels,
                primitives.organs,
                self._reflectance,
                self._elevation,
                self._caster.hierarchies(),
                wp.transform(*map(float, pose[:3]), *map(float, turn)),
                self._azimuth,
                label(Organ.GROUND, 0),
                int(Organ.GROUND),
                self.spec.nearest.value,
                self.spec.farthest.value,
                run,
            ],
            outputs=[self._xyz, self._intensity, self._label],
            device=self.device,
        )
        labels = self._label.numpy()
        back = labels >= 0
        return LidarScan(
            time=float(time),
            name=self.name,
            frame_id=self.frame_id,
            pose=pose,
            xyz=self._xyz.numpy()[back],
            intensity=self._intensity.numpy()[back],
            ring=self.ring[back],
            offset=self.offset[back],
            labels=labels[back],
        )
