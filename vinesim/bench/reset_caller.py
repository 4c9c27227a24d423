"""A stock ROS node that disturbs a robot's world and resets it by simulation_interfaces, again and again, and checks
the result.

``python -m vinesim.bench.reset_caller --resets 20`` prints a JSON object for each reset, then waits for a line on its
standard input before it goes on. Meanwhile, the caller can measure the robot client.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Pose, PoseStamped, TwistStamped
from rclpy.action.client import ActionClient
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, JointState, PointCloud2
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from vinesim.ros import middleware
from vinesim.ros.messages import message_packages

TIMEOUT = 180.0
"""Time limit of each wait [s]."""
SENSORS = {"/head_front_camera/rgb/image_raw": Image, "/lidar/points": PointCloud2}
"""Topics of vinebot's sensors, which must continue after a reset, with their types."""
ABORTED = 6
TRAVEL = 0.1
"""Distance from its start that the robot is driven before each reset [m]."""
AT_START = 0.02
"""Largest accepted distance of the robot from its start after a reset [m]."""
STANDS = 1e-3
"""Largest distance that a standing robot moves between two checks [m]."""


class ResetCaller:
    """The node that disturbs the world and resets it."""

    def __init__(self) -> None:
        import simulation_interfaces.srv as services
        from control_msgs.action import FollowJointTrajectory

        self.node = rclpy.create_node("reset_caller")
        self.newest: dict[str, float] = {}
        """Newest stamp of each topic [s]."""
        self.back = 0
        """Number of messages whose stamp was older than the stamp of the previous message."""
        for topic, kind in ({"/clock": Clock, "/joint_states": JointState} | SENSORS).items():
            self.node.create_subscription(kind, topic, lambda m, topic=topic: self._take(topic, m), 10)
        self._drive = self.node.create_publisher(TwistStamped, "/mobile_base_controller/cmd_vel", 1)
        self.head = ActionClient(self.node, FollowJointTrajectory, "/head_controller/follow_joint_trajectory")
        self._services = services
        self._clients: dict[str, Any] = {}

    def _take(self, topic: str, message: Any) -> None:
        stamp = message.clock if topic == "/clock" else message.header.stamp
        seconds = stamp.sec + 1e-9 * stamp.nanosec
        self.back += seconds < self.newest.get(topic, -1.0)
        self.newest[topic] = seconds

    def until(self, done: Callable[[], object], what: str, meanwhile: Callable[[], object] = lambda: None) -> None:
        """Process messages until ``done()`` is true, and call ``meanwhile()`` between them. Raises RuntimeError after
        :data:`TIMEOUT`."""
        end = time.monotonic() + TIMEOUT
        while not done():
            rclpy.spin_once(self.node, timeout_sec=0.05)
            meanwhile()
            if time.monotonic() > end:
                raise RuntimeError(f"waited {TIMEOUT:.0f} s in vain for {what}")

    def call(self, service: str, **fields: Any) -> Any:
        """Call a service, given by its type and name, and return its response. Raises RuntimeError unless the result is
        OK."""
        name = service
        kind = getattr(self._services, "".join(word.capitalize() for word in service.split("_")))
        client = self._clients.get(name) or self._clients.setdefault(name, self.node.create_client(kind, name))
        self.until(client.service_is_ready, name)
        answer = client.call_async(kind.Request(**fields))
        self.until(answer.done, name)
        response = answer.result()
        if response.result.result != 1:
            raise RuntimeError(f"{name}: {response.result.error_message}")
        return response

    def place(self, robot: str) -> np.ndarray:
        """Returns the position of the robot [2] m."""
        point = self.call("get_entity_state", entity=robot).state.pose.position
        return np.array([point.x, point.y])

    def graph(self) -> dict[str, int]:
        """Returns the numbers of nodes, publishers and services that belong to other nodes."""
        node = self.node
        topics = [name for name, _ in node.get_topic_names_and_types()]
        names = [name for name, _ in node.get_node_names_and_namespaces() if name != node.get_name()]
        services = sum(
            len(node.get_service_names_and_types_by_node(name, space))
            for name, space in node.get_node_names_and_namespaces()
            if name != node.get_name()
        )
        return {"nodes": len(names), "publishers": sum(map(node.count_publishers, topics)), "services": services}

    def begin_goal(self) -> Any:
        """Send a goal to the head that takes a minute; return its handle."""
        from control_msgs.action import FollowJointTrajectory

        point = JointTrajectoryPoint(positions=[0.2, 0.1], time_from_start=Duration(sec=60))
        trajectory = JointTrajectory(joint_names=["head_1_joint", "head_2_joint"], points=[point])
        self.until(self.head.server_is_ready, "the head's controller")
        future = self.head.send_goal_async(FollowJointTrajectory.Goal(trajectory=trajectory))
        self.until(future.done, "an answer to a goal")
        return future.result()

    def drive_away(self, robot: str, start: np.ndarray) -> None:
        """Drive the robot until it is :data:`TRAVEL` away from ``start`` [2] m, and stop it.

        The stop is repeated until the robot stands: velocities that still wait in a busy robot's queue would move it
        after the reset.
        """
        message = TwistStamped()
        message.twist.linear.x = 0.3
        while np.linalg.norm(self.place(robot) - start) < TRAVEL:
            end = time.monotonic() + 0.2
            self.until(lambda end=end: time.monotonic() > end, "", lambda: self._drive.publish(message))
        before = start
        while np.linalg.norm((now := self.place(robot)) - before) > STANDS:
            before = now
            end = time.monotonic() + 0.2
            self.until(lambda end=end: time.monotonic() > end, "", lambda: self._drive.publish(TwistStamped()))


def disturb_and_reset(caller: ResetCaller, robot: str, start: np.ndarray, entities: list[str]) -> dict[str, Any]:
    """Disturb the world and reset it. Returns one row: whether the world is as in the beginning, whether the goal was
    aborted, when the sensors continued, and the numbers of other nodes' publishers and services."""
    place = PoseStamped(header=Header(frame_id="map"), pose=Pose(position=Point(x=9.0, y=-3.0)))
    caller.call("spawn_entity", name="crate", uri="vinesim:box", initial_pose=place)
    goal = caller.begin_goal()
    caller.drive_away(robot, start)
    begin = time.monotonic()
    caller.call("reset_simulation")
    answered = time.monotonic()
    moment = caller.newest["/clock"]
    ended = goal.get_result_async()
    caller.until(ended.done, "the result of a goal")
    caller.until(lambda: all(caller.newest.get(topic, -1.0) > moment + 0.1 for topic in SENSORS), "the sensors")
    back_after = time.monotonic() - answered
    off = float(np.linalg.norm(caller.place(robot) - start))
    there = sorted(caller.call("get_entities").entities)
    right = off < AT_START and there == entities and ended.result().status == ABORTED
    return {
        "kind": "reset",
        "right": right,
        "off": off,
        "goal": ended.result().status,
        "more": len(there) - len(entities),
        "s": answered - begin,
        "sensors_s": back_after,
        "stamps_back": caller.back,
        **caller.graph(),
    }


def main(arguments: list[str] | None = None) -> int:
    """Reset the world a number of times. Returns 0 if all resets could be done."""
    parser = argparse.ArgumentParser(prog="python -m vinesim.bench.reset_caller", description="Reset a robot's world.")
    parser.add_argument("--resets", type=int, default=20)
    given = parser.parse_args(arguments)
    middleware.clear_profile()
    message_packages.ensure_importable(["control_msgs", "simulation_interfaces"])
    rclpy.init(args=[])
    caller = ResetCaller()
    caller.until(lambda: caller.newest.keys() >= {"/clock", "/joint_states", *SENSORS}, "the robot's topics")
    from simulation_interfaces.msg import EntityCategory, EntityFilters

    robots = EntityFilters(categories=[EntityCategory(category=EntityCategory.CATEGORY_ROBOT)])
    robot = caller.call("get_entities", filters=robots).entities[0]
    caller.call("reset_simulation")  # others may have driven the robot anywhere
    entities = sorted(caller.call("get_entities").entities)
    start = caller.place(robot)
    for _ in range(given.resets):
        sys.stdout.write(json.dumps(disturb_and_reset(caller, robot, start, entities)) + "\n")
        sys.stdout.flush()
        sys.stdin.readline()
    caller.node.destroy_node()
    rclpy.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
