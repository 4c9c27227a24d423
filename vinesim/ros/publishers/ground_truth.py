"""Topics of true poses apart from the robot's own tf."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from vinesim.ros.messages.transforms import SerializedTransforms
from vinesim.ros.publishers.robot import MAP_FRAME
from vinesim.ros.topic import RELIABLE, TRANSIENT_LOCAL, Advertise, PendingMessage


class GroundTruthPublisher:
    """``tf_environment`` (what moves) and ``tf_environment_static`` (poles) in the map."""

    def __init__(self, advertise: Advertise, tf_message: type) -> None:
        self._moving = advertise(tf_message, "tf_environment", RELIABLE)
        self._static = advertise(tf_message, "tf_environment_static", TRANSIENT_LOCAL)
        self._poles: tuple[Sequence[str], np.ndarray] = (), np.zeros((0, 7))
        self._names: Sequence[str] | None = None
        self._transforms = SerializedTransforms([])
        self._is_muted = False

    def pending(self, time: float, names: tuple[str, ...], poses: np.ndarray) -> Iterator[PendingMessage]:
        """The message of true poses [name, 7] of what moves. Pass the same tuple object as long as the names stay."""
        yield self._moving, partial(self._message, time, names, poses)

    def pending_static(self, names: tuple[str, ...], poses: np.ndarray) -> Iterator[PendingMessage]:
        """The message of true poses [name, 7] of what never moves."""
        self._poles = names, poses
        yield self._static, self._static_message

    def mute(self, is_muted: bool) -> None:
        """Whether true poses are kept back; late subscribers then receive an empty message of what never moves."""
        self._is_muted = is_muted
        self._moving.mute(is_muted)
        self._static.send(self._static_message())

    def _static_message(self) -> bytes:
        names, poses = ((), np.zeros((0, 7))) if self._is_muted else self._poles
        return SerializedTransforms([(MAP_FRAME, name) for name in names]).message(0.0, poses)

    def _message(self, time: float, names: tuple[str, ...], poses: np.ndarray) -> bytes:
        if names is not self._names:
            self._transforms = SerializedTransforms([(MAP_FRAME, name) for name in names])
            self._names = names
        return self._transforms.message(time, poses)
