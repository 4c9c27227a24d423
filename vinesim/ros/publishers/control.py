"""Topics of a robot's controllers: their states, and the series elastic elements of joints (CANOPIES D6.4, 3.1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState

from vinesim.ros.messages import convert
from vinesim.ros.topic import RELIABLE, Advertise, PendingMessage
from vinesim.scene.values import ControllerKind, ControllerSpec, RobotSample

STATE_PERIOD = 2
"""Steps between two states of a trajectory controller: 50 Hz, the default of joint_trajectory_controller."""


class ControlPublisher:
    """``<controller>/controller_state`` every other step, ``see/<joint>/state`` after every one."""

    def __init__(self, advertise: Advertise, controllers: Sequence[ControllerSpec]) -> None:
        from control_msgs.msg import JointTrajectoryControllerState

        self._state_type = JointTrajectoryControllerState
        self._states = [
            (spec.joints, advertise(JointTrajectoryControllerState, f"{spec.name}/controller_state", RELIABLE))
            for spec in controllers
            if spec.kind is ControllerKind.JOINT_TRAJECTORY
        ]
        self._elements = [
            (joint, advertise(JointState, f"{spec.name}/{joint}/state", RELIABLE))
            for spec in controllers
            if spec.kind is ControllerKind.SERIES_ELASTIC
            for joint in spec.joints
        ]
        self._steps = 0

    def pending(self, sample: RobotSample) -> Iterator[PendingMessage]:
        """All messages of one step."""
        places = {name: i for i, name in enumerate(sample.joints.names)}
        self._steps += 1
        if sample.reference is not None and self._steps % STATE_PERIOD == 0:
            for joints, topic in self._states:
                yield topic, partial(self._state, sample, joints, np.array([places[joint] for joint in joints]))
        if sample.elements is not None:
            for joint, topic in self._elements:
                yield topic, partial(convert.elastic_state, sample.elements, places[joint])

    def _state(self, sample: RobotSample, joints: tuple[str, ...], places: np.ndarray) -> Any:
        points = convert.reference_points(sample, places)
        return self._state_type(
            header=convert.header(sample.joints.time, ""), joint_names=list(joints), reference=points["desired"],
            feedback=points["actual"], error=points["error"],
        )  # fmt: skip
