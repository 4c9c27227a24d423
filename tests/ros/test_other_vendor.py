"""A peer of another DDS vendor, Eclipse Cyclone, with types of its own: it hears the robot and commands it."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from tests.support.stock_node import TIMEOUT, wait_until
from vinesim.ros.commands.types import JointTrajectory
from vinesim.ros.robot_node import RobotNode
from vinesim.scene.values import ControllerKind, ControllerSpec, JointSample, RobotSample

PEER = """
import sys, time
from dataclasses import dataclass
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32

@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str

@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]

@dataclass
class Point(IdlStruct, typename="trajectory_msgs::msg::dds_::JointTrajectoryPoint_"):
    positions: sequence[float64]
    velocities: sequence[float64]
    accelerations: sequence[float64]
    effort: sequence[float64]
    time_from_start: Time

@dataclass
class Trajectory(IdlStruct, typename="trajectory_msgs::msg::dds_::JointTrajectory_"):
    header: Header
    joint_names: sequence[str]
    points: sequence[Point]

participant = DomainParticipant(int(sys.argv[1]))
qos = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(10))
reader = DataReader(participant, Topic(participant, "rt/joint_states", JointState), qos=qos)
writer = DataWriter(participant, Topic(participant, "rt/head_controller/joint_trajectory", Trajectory), qos=qos)
heard, until = None, time.monotonic() + float(sys.argv[2])
while time.monotonic() < until:
    for sample in reader.take(100):
        if isinstance(sample, JointState) and heard is None:
            heard = sample
            print("heard", sample.header.stamp.sec, sample.name[1], sample.position[1], flush=True)
    if heard is not None:  # until it is killed: the first may come before its reader is found
        point = Point([0.35, -0.1], [], [], [], Time(1, 500000000))
        writer.write(Trajectory(Header(Time(0, 0), ""), ["head_1_joint", "head_2_joint"], [point]))
    time.sleep(0.05)
"""
CYCLONE = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex><Peers><Peer Address="127.0.0.1"/></Peers></Discovery>'
    "</Domain></CycloneDDS>"
)
"""Loopback only, without multicast: as the tests' own ROS nodes."""


def test_a_peer_of_another_vendor_hears_and_commands(monkeypatch, tmp_path):
    """Fields of /joint_states as sent, to a reader that knows neither vinesim nor ROS; and its trajectory back."""
    domain = str(1 + os.getpid() % 100)
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    names, rest = ("head_1_joint", "head_2_joint"), np.array([0, 0, 0, 0, 0, 0, 1.0])
    joints = JointSample(7.25, names, np.array([0.1, -0.2]), np.zeros(2), np.zeros(2), np.zeros(2))
    zeros = np.zeros((2, 3, 3))
    sample = RobotSample("robot", joints, rest, np.zeros(6), rest, np.zeros(6), zeros, (), np.zeros((0, 7)))
    spec = ControllerSpec("head_controller", ControllerKind.JOINT_TRAJECTORY, names)
    peer = subprocess.Popen(
        [sys.executable, "-c", PEER, domain, str(TIMEOUT)], env=os.environ | {"CYCLONEDDS_URI": CYCLONE},
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        with RobotNode("robot", "<robot name='small'/>", controllers=[spec]) as node:
            received: list[JointTrajectory] = []

            def step() -> None:
                node.publish_robot_state(sample)
                received.extend(c for c in node.commands() if isinstance(c, JointTrajectory))
                assert peer.poll() is None

            def step_slowly() -> None:
                step()
                node._closing.wait(0.01)

            wait_until(lambda: received, step_slowly, "a trajectory of the other vendor's peer")
            assert (received[0].controller, received[0].joints) == ("head_controller", names)
            assert received[0].positions.tolist() == [[0.35, -0.1]]
            assert received[0].times.tolist() == [1.5]
    finally:
        peer.kill()
        heard = peer.communicate()[0].split()
    assert heard == ["heard", "7", "head_2_joint", "-0.2"]
