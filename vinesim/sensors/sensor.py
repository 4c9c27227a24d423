"""Interfaces of rendered sensors of all kinds, for the scheduler, the sensor process and the command line."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np
import warp as wp

from vinesim.core.geodesy import APRILIA, Geodetic
from vinesim.kernels.raster import transform_primitives
from vinesim.scene.values import SENSOR_KINDS, CameraOutput, RenderedMount, SensorFrame, Snapshot
from vinesim.sensors.camera.sunlight import DEFAULT_SUN, SunPath
from vinesim.sensors.primitives.scene_primitives import Primitives


class Sensor(Protocol):
    """Interface of one rendered sensor, which renders the present state of the :class:`Primitives` from a given
    pose."""

    name: str

    @property
    def rate(self) -> float:
        """Frame rate [Hz]."""
        ...

    def frame(self, primitives: Primitives, snapshot: Snapshot, pose: np.ndarray, outputs: CameraOutput) -> SensorFrame:
        """Render one frame from ``pose`` [7] at the time of ``snapshot``, to which the primitives are already posed.

        Only ``outputs`` are needed; other arrays of the frame may be empty.
        """
        ...


class Sweep(Protocol):
    """Interface of a sequence of frames that are rendered in parts, each part for its own time and pose of the
    sensor."""

    dropped: int
    """Number of frames that were left out, because they could not begin in time."""

    def add_pose(self, time: float, pose: np.ndarray) -> None:
        """Record that the sensor was at ``pose`` [7] at simulated ``time`` [s]."""
        ...

    def set_demand(self, period: float, outputs: CameraOutput) -> None:
        """Set the time between two frames, ``period`` [s], and the needed ``outputs``, from the next frame on."""
        ...

    def is_due(self, now: float) -> bool:
        """Returns whether a part of a frame is due at simulated time ``now`` [s]."""
        ...

    def advance(self, primitives: Primitives, now: float) -> Iterator[SensorFrame]:
        """Render the parts that are due at simulated time ``now`` [s], and yield the frames that become complete."""
        ...

    def cancel(self, now: float) -> None:
        """Abandon the unfinished frame at simulated time ``now`` [s]."""
        ...


@runtime_checkable
class SweptSensor(Protocol):
    """Interface of a :class:`Sensor` that measures the parts of a frame at different times, such as a spinning
    lidar."""

    def sweep(self, rate: float | None) -> Sweep:
        """Returns a new sweep of this sensor with ``rate`` frames a second [Hz], at most the sensor's own rate, which
        is the default."""
        ...


@dataclasses.dataclass(frozen=True, slots=True)
class SensorSetting:
    """Settings with which a sensor is made, in addition to its mount: sun, noise and device."""

    sun: tuple[float, float, float] | SunPath = DEFAULT_SUN
    """Unit vector towards the sun, or a function from simulated time [s] to that vector."""
    seed: int = 0
    """Seed of the noise, which the seed, the sensor's name and the index of the frame determine."""
    number: int = 0
    """Index of the sensor's first frame."""
    device: str = "cpu"
    threads: int | None = None
    """Number of CPU threads that render; None: the number of cores, at most four."""
    datum: Geodetic = APRILIA
    """Position of the world's origin on the Earth; x points to the east, y to the north."""


@dataclasses.dataclass(frozen=True, slots=True)
class Export:
    """The parts of a sensor's frame that a data set stores."""

    images: dict[str, np.ndarray]
    """Images by name: RGB uint8 or grey uint16 [height, width]."""
    record: dict[str, Any]
    """Description of the images (meaning and scale of their numbers), for JSON."""


@dataclasses.dataclass(frozen=True, slots=True)
class SensorMaker:
    """Functions that make and export the sensors of one kind.

    Each kind's module, which :class:`~vinesim.scene.values.SensorKind` names, has one as ``MAKER``.
    """

    rate: Callable[[str], float]
    """Function from the name of a sensor's data file to its frame rate [Hz]; raises
    :class:`~vinesim.sensors.spec_file.SensorError` if the file cannot be used."""
    make: Callable[[Any, SensorSetting], Sensor]
    """Function that makes the sensor of a mount of this kind."""
    load_kernels: Callable[[], None]
    """Function that compiles the CPU kernels of this kind, or loads them from the cache, before the first frame."""
    channels: Callable[[str], tuple[str, ...]] = lambda _: ()
    """Function from the name of a sensor's data file to the names of its images, for kinds whose file defines these."""
    export: Callable[[Any], Export] | None = None
    """Function that converts a frame for a data set; None: data sets store nothing of this kind."""


def maker(kind: str) -> SensorMaker:
    """Returns the maker of sensors of a ``kind``, one of :data:`vinesim.scene.values.SENSOR_KINDS`."""
    return importlib.import_module(SENSOR_KINDS[kind].maker).MAKER


def export_frame(
    mount: RenderedMount, primitives: Primitives, snapshot: Snapshot, pose: np.ndarray, setting: SensorSetting
) -> Export:
    """Make a sensor, render one frame from ``pose`` [7], and return the parts of it that a data set stores.

    The maker of the sensor's kind must have an ``export``.
    """
    kind = maker(mount.kind)
    assert kind.export is not None
    whole = SENSOR_KINDS[mount.kind].whole
    return kind.export(kind.make(mount, setting).frame(primitives, snapshot, np.array(pose, float), whole))


def load_kernels(*kinds: str) -> None:
    """Compile the CPU kernels of some kinds of sensors, or load them from the cache. Only one thread may do so at a
    time."""
    wp.load_module(transform_primitives, device="cpu")
    for kind in kinds:
        maker(kind).load_kernels()
