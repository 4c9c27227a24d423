"""Interfaces through which the scheduler, the sensor process and the command line use any rendered sensor."""

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
    """One sensor. It renders the present state of the :class:`Primitives`, from a pose in the world."""

    name: str

    @property
    def rate(self) -> float:
        """Frame rate [Hz]."""
        ...

    def frame(self, primitives: Primitives, snapshot: Snapshot, pose: np.ndarray, outputs: CameraOutput) -> SensorFrame:
        """One frame from ``pose`` [7] at the time of ``snapshot``, to which the primitives are posed. Only ``outputs``
        of the frame are needed."""
        ...


class Sweep(Protocol):
    """Frames that a sensor takes little by little, each part at its own time and from where the sensor was then."""

    dropped: int
    """Number of frames that could not be begun in time."""

    def add_pose(self, time: float, pose: np.ndarray) -> None:
        """Record that the sensor was at ``pose`` [7] at ``time`` [s]."""
        ...

    def set_demand(self, period: float, outputs: CameraOutput) -> None:
        """Set the time between two frames [s] and the outputs that are needed, from the next frame on."""
        ...

    def is_due(self, now: float) -> bool:
        """Whether a part of a frame is due at ``now`` [s]."""
        ...

    def advance(self, primitives: Primitives, now: float) -> Iterator[SensorFrame]:
        """Take the parts that are due at ``now`` [s]; yields the frames that this completes."""
        ...

    def cancel(self, now: float) -> None:
        """Abandon the present frame at ``now`` [s]."""
        ...


@runtime_checkable
class SweptSensor(Protocol):
    """A :class:`Sensor` that takes the parts of a frame at different times."""

    def sweep(self, rate: float | None) -> Sweep:
        """The sweep of this sensor, with ``rate`` frames a second [Hz]: at most the sensor's own rate, and that rate
        unless given."""
        ...


@dataclasses.dataclass(frozen=True, slots=True)
class SensorSetting:
    """Settings with which a sensor is made, in addition to its mount."""

    sun: tuple[float, float, float] | SunPath = DEFAULT_SUN
    """Unit vector towards the sun, or a function that gives it for a time."""
    seed: int = 0
    """Seed of the noise. The noise follows from the seed, the sensor's name and the number of the frame."""
    number: int = 0
    """Number of the sensor's first frame."""
    device: str = "cpu"
    threads: int | None = None
    """Number of CPU threads that draw; the number of cores, up to four, unless given."""


@dataclasses.dataclass(frozen=True, slots=True)
class Export:
    """The part of a frame that a data set stores."""

    images: dict[str, np.ndarray]
    """Images by name: RGB uint8 or grey uint16 [height, width]."""
    record: dict[str, Any]
    """Meaning of the numbers in the images, as JSON."""


@dataclasses.dataclass(frozen=True, slots=True)
class SensorMaker:
    """Makes the sensors of one kind. It is ``MAKER`` of the module that the kind's
    :class:`~vinesim.scene.values.SensorKind` names."""

    rate: Callable[[str], float]
    """Frame rate [Hz] of a sensor, by the name of its data file; :class:`~vinesim.sensors.spec_file.SensorError` if the
    file cannot be used."""
    make: Callable[[Any, SensorSetting], Sensor]
    """Makes the sensor of a mount of this kind."""
    load_kernels: Callable[[], None]
    """Compiles the CPU kernels of this kind, or reads them from the cache, before the first frame is due."""
    channels: Callable[[str], tuple[str, ...]] = lambda _: ()
    """Names of the images of a sensor, by the name of its data file, where the file decides which images there are."""
    export: Callable[[Any], Export] | None = None
    """Converts a frame to what a data set stores; None: a data set stores nothing of this kind."""


def maker(kind: str) -> SensorMaker:
    """The maker of one of :data:`vinesim.scene.values.SENSOR_KINDS`."""
    return importlib.import_module(SENSOR_KINDS[kind].maker).MAKER


def export_frame(
    mount: RenderedMount, primitives: Primitives, snapshot: Snapshot, pose: np.ndarray, setting: SensorSetting
) -> Export:
    """Make a sensor, take one frame from ``pose`` [7], and return what a data set stores of it; its kind must have an
    export."""
    kind = maker(mount.kind)
    assert kind.export is not None
    whole = SENSOR_KINDS[mount.kind].whole
    return kind.export(kind.make(mount, setting).frame(primitives, snapshot, np.array(pose, float), whole))


def load_kernels(*kinds: str) -> None:
    """Load the CPU kernels of some kinds of sensors: threads must not do so at the same time."""
    wp.load_module(transform_primitives, device="cpu")
    for kind in kinds:
        maker(kind).load_kernels()
