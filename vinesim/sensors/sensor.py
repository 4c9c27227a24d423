"""What the schedule, the sensor process and the command line know of any sensor that is rendered."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np
import warp as wp

from vinesim.kernels.raster import transform_primitives
from vinesim.scene.values import SENSOR_KINDS, CameraOutput, RenderedMount, SensorFrame, Snapshot
from vinesim.sensors.camera.sunlight import DEFAULT_SUN, SunPath
from vinesim.sensors.primitives.scene_primitives import Primitives


class Sensor(Protocol):
    """One sensor. It renders what :class:`Primitives` show, from a pose in the world."""

    name: str

    @property
    def rate(self) -> float:
        """Frames a second [Hz]."""
        ...

    def frame(self, primitives: Primitives, snapshot: Snapshot, pose: np.ndarray, outputs: CameraOutput) -> SensorFrame:
        """One frame from ``pose`` [7] at the time of ``snapshot``, which the primitives show; ``outputs`` of it are
        needed."""
        ...


class Sweep(Protocol):
    """Frames that a sensor takes little by little, each part at its own time and from where the sensor was then."""

    dropped: int
    """Frames that could not be begun in time."""

    def add_pose(self, time: float, pose: np.ndarray) -> None:
        """The sensor was at ``pose`` [7] at ``time`` [s]."""
        ...

    def set_demand(self, period: float, outputs: CameraOutput) -> None:
        """From the next frame on: the time between two [s], and what is needed of them."""
        ...

    def is_due(self, now: float) -> bool:
        """Whether there is something to take at ``now`` [s]."""
        ...

    def advance(self, primitives: Primitives, now: float) -> Iterator[SensorFrame]:
        """Take what is due at ``now`` [s]; yields the frames that this completes."""
        ...

    def cancel(self, now: float) -> None:
        """Abandon the present frame at ``now`` [s]."""
        ...


@runtime_checkable
class SweptSensor(Protocol):
    """A :class:`Sensor` whose frames take time."""

    def sweep(self, rate: float | None) -> Sweep:
        """Its frames, ``rate`` a second [Hz], at most its own rate, which counts unless given."""
        ...


@dataclasses.dataclass(frozen=True, slots=True)
class SensorSetting:
    """What a sensor is made for, beside its mount."""

    sun: tuple[float, float, float] | SunPath = DEFAULT_SUN
    """Towards the sun, or where it is when."""
    seed: int = 0
    """With the sensor's name and the number of the frame it decides the noise."""
    number: int = 0
    """Of its first frame."""
    device: str = "cpu"
    threads: int | None = None
    """Threads of the CPU that draw; as many as there are cores, up to four, unless given."""


@dataclasses.dataclass(frozen=True, slots=True)
class Export:
    """What a data set keeps of one frame."""

    images: dict[str, np.ndarray]
    """By name: RGB uint8 or grey uint16 [height, width]."""
    record: dict[str, Any]
    """What the numbers in the images mean, as JSON."""


@dataclasses.dataclass(frozen=True, slots=True)
class SensorMaker:
    """A kind of sensor, as this package knows it: ``MAKER`` of the module that its
    :class:`~vinesim.scene.values.SensorKind` names."""

    rate: Callable[[str], float]
    """Rate of the sensor with a data file of this name [Hz]; :class:`~vinesim.sensors.spec_file.SensorError` if the
    file cannot be used."""
    make: Callable[[Any, SensorSetting], Sensor]
    """The sensor of a mount of this kind."""
    load_kernels: Callable[[], None]
    """Compiles its kernels for the CPU, or reads them from the cache, before the first frame is due."""
    channels: Callable[[str], tuple[str, ...]] = lambda _: ()
    """Names of the images of a sensor where its data file decides which there are."""
    export: Callable[[Any], Export] | None = None
    """What a data set keeps of its frames; None: nothing."""


def maker(kind: str) -> SensorMaker:
    """What makes sensors of one of :data:`vinesim.scene.values.SENSOR_KINDS`."""
    return importlib.import_module(SENSOR_KINDS[kind].maker).MAKER


def export_frame(
    mount: RenderedMount, primitives: Primitives, snapshot: Snapshot, pose: np.ndarray, setting: SensorSetting
) -> Export:
    """What a data set keeps of one frame of a sensor, made for it, from ``pose`` [7]; its kind must have an export."""
    kind = maker(mount.kind)
    assert kind.export is not None
    whole = SENSOR_KINDS[mount.kind].whole
    return kind.export(kind.make(mount, setting).frame(primitives, snapshot, np.array(pose, float), whole))


def load_kernels(*kinds: str) -> None:
    """Load the CPU kernels of some kinds of sensors: threads must not do so at the same time."""
    wp.load_module(transform_primitives, device="cpu")
    for kind in kinds:
        maker(kind).load_kernels()
