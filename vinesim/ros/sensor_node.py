"""The ROS 2 node of a robot's sensors. It publishes what the drivers of the sensors publish on a real robot.

The rendering thread passes frames to the node. The node's sending thread builds and sends the messages. Each topic has
at most one waiting message: a newer message replaces it, which is counted as dropped.
"""

from __future__ import annotations

import importlib
import pathlib
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Protocol

from vinesim.ros.messages import message_packages
from vinesim.ros.node import Node
from vinesim.ros.parameters import Parameters
from vinesim.ros.topic import Advertise, Build, PendingMessage, Topic
from vinesim.scene.values import SENSOR_KINDS, CameraOutput, SensorFrame

TRUTH = "publish_truth"
"""Name of the parameter that switches the topics with ground truth on and off."""


class SensorPublisher(Protocol):
    """Interface of a class that publishes the topics of one sensor. :class:`~vinesim.scene.values.SensorKind` names
    the module whose ``PUBLISHER`` is the class for a kind of sensor."""

    packages: ClassVar[tuple[str, ...]]
    """Message packages that the publisher needs and that ROS may lack."""

    def __init__(
        self, advertise: Advertise, name: str, parameters: Parameters, *, number: int, channels: Sequence[str]
    ) -> None:
        """``number``: index of the sensor among those of its kind, from 0. ``channels``: names of its images, if its
        data file defines them."""
        ...

    @property
    def truth(self) -> Sequence[Topic]:
        """Topics with ground truth, which no real sensor has."""
        ...

    def wanted(self) -> CameraOutput:
        """Returns the sensor outputs that the present subscribers need."""
        ...

    def pending(self, frame: Any) -> Iterator[PendingMessage]:
        """Returns the messages of one frame, cheap ones first."""
        ...


def publisher(kind: str) -> type[SensorPublisher]:
    """Returns the class that publishes sensors of ``kind``, one of :data:`vinesim.scene.values.SENSOR_KINDS`."""
    return importlib.import_module(SENSOR_KINDS[kind].publisher).PUBLISHER


class SensorNode(Node):
    """A node that publishes ``sensors``: a dictionary from the name of each sensor, which its topics begin with, to
    its kind."""

    def __init__(
        self,
        name: str,
        *,
        namespace: str = "",
        sensors: Mapping[str, str],
        channels: Mapping[str, Sequence[str]] | None = None,
        rates: Mapping[str, float] | None = None,
        params_file: pathlib.Path | None = None,
        parameters: Mapping[str, Any] | None = None,
    ) -> None:
        """``channels``: names of a sensor's images, by sensor, if its data file defines them. ``rates``: initial
        values of the ``rate`` parameters [Hz], by sensor; sensors that are not listed have no such parameter.
        ``params_file``, ``parameters``: see :class:`Node`."""
        self._kinds = sensors
        self._channels = channels or {}
        needed = {package: None for kind in sensors.values() for package in publisher(kind).packages}
        if needed:
            message_packages.ensure_importable(needed)
        self._rates = rates or {}
        self._pending: dict[Topic, Build] = {}
        """Function that builds the newest message of each topic, by topic. The topic that has waited longest is
        first."""
        self._changed = threading.Condition()
        self._sending = False
        super().__init__(name, namespace, tuple(sensors), params_file, parameters)

    def _open(self) -> None:
        parameters = self._parameters
        self._publishers: dict[str, SensorPublisher] = {}
        count = dict.fromkeys(self._kinds.values(), 0)
        for sensor, kind in self._kinds.items():
            self._publishers[sensor] = publisher(kind)(
                self._advertise, sensor, parameters, number=count[kind], channels=self._channels.get(sensor, ())
            )
            count[kind] += 1
        for sensor, rate in self._rates.items():
            parameters.declare(
                f"{sensor}.rate", rate, "Pictures or revolutions a second [Hz].", (0.1, max(rate, 100.0))
            )
        parameters.declare(TRUTH, True, "Publish labels of pictures, and detections.", changed=self._mute_truth)

    def _mute_truth(self) -> None:
        for one in self._publishers.values():
            for topic in one.truth:
                topic.mute(not self._parameters[TRUTH])

    def rate(self, sensor: str) -> float:
        """Returns the requested rate [Hz] of a sensor, which must be listed in ``rates``."""
        return self._parameters[f"{sensor}.rate"]

    def _own_threads(self, name: str) -> list[threading.Thread]:
        return [threading.Thread(target=self._send, name=f"ros send {name}", daemon=True)]

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def publish(self, frame: SensorFrame) -> None:
        """Publish one frame of a sensor. Raises :class:`ValueError` if the node does not have this sensor."""
        self._enqueue(self._publisher(frame.name).pending(frame))

    def outputs_wanted(self, sensor: str) -> CameraOutput:
        """Returns the outputs of a sensor that subscribers need. Raises :class:`ValueError` for an unknown sensor."""
        return self._publisher(sensor).wanted()

    @property
    def has_pending(self) -> bool:
        """Whether any message waits to be sent or is being sent."""
        with self._changed:
            return bool(self._pending) or self._sending

    def _publisher(self, name: str) -> SensorPublisher:
        if name not in self._publishers:
            known = ", ".join(self._publishers) or "none"
            raise ValueError(f"no sensor {name!r} in this node; it has: {known}")
        return self._publishers[name]

    def _enqueue(self, messages: Iterable[PendingMessage], *, always: bool = False) -> None:
        with self._changed:
            for topic, build in messages:
                if topic.subscription_count or always:
                    topic.dropped += topic in self._pending
                    self._pending[topic] = build
            self._changed.notify()

    def _send(self) -> None:
        """Body of the sending thread: build and send waiting messages. The topic that has waited longest is served
        first."""
        while True:
            with self._changed:
                self._sending = False
                self._changed.wait_for(lambda: self._pending or self._closing.is_set())
                if self._closing.is_set():
                    return
                self._sending = True
                topic = next(iter(self._pending))
                build = self._pending.pop(topic)
            topic.build_and_send(build)
