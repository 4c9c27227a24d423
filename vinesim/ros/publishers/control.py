"""Topics of a robot's controllers: their states, and the series elastic elements of joints (CANOPIES D6.4, 3.1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState

from vinesim.ros.messages import convert
from vinesim.ros.topic import EVERY_STEP, Advertise, PendingMessage
from vinesim.scene.values import ControllerKind, ControllerSpec, RobotSample

STATE_PERIOD = 2
"""Steps between two states of a trajectory controller: 50 Hz, the default of joint_trajectory_controller."""


class ControlPublisher:
    """``<controller>/controller_state`` every other step, ``see/<joint>/state`` after every one."""

    def __init__(self, advertise: Advertise, controllers: Sequence[ControllerSpec]) -> None:
        from control_msgs.msg import JointTrajectoryControllerState

        self._state_type = JointTrajectoryControllerState
        self._states = [
            (spec.joints, advertise(JointTrajectoryControllerState, f"{spec.name}/controller_state", EVERY_STEP))
            for spec in controllers
            if spec.kind is ControllerKind.JOINT_TRAJECTORY
        ]
        self._elements = [
            (joint, advertise(JointState, f"{spec.name}/{joint}/state", EVERY_STEP))
            for spec in controllers
            if spec.kind is ControllerKind.SERIES_ELASTIC
            for joint in spec.joints
        ]
        self._names: tuple[str, ...] | None = None
        self._places: dict[str, int] = {}
        """Of joints in the arrays of samples."""
        self._steps = 0

    def pending(self, sample: RobotSample) -> Iterator[PendingMessage]:
        """All messages of one step."""
        if sample.joints.names is not self._names:  # the same tuple every step
            self._names = sample.joints.names
            self._places = {name: i for i, name in enumerate(self._names)}
        self._steps += 1
        if sample.reference is not None and self._steps % STATE_PERIOD == 0:
            for joints, topic in self._states:
                yield topic, partial(self._state, sample, joints, np.array([self._places[joint] for joint in joints]))
        if sample.elements is not None:
            for joint, topic in self._elements:
                yield topic, partial(convert.elastic_state, sample.elements, self._places[joint])

    def _state(self, sample: RobotSample, joints: tuple[str, ...], places: np.ndarray) -> Any:
        points = convert.reference_points(sample, places)
        return self._state_type(
            header=convert.header(sample.joints.time, ""),
            joint_names=list(joints),
            reference=points["desired"],
            feedback=points["actual"],
            error=points["error"],
        )
