"""An action of a package that vinesim builds itself, between two processes of stock rclpy."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.support.waiting import TIMEOUT
from vinesim.ros import middleware

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(middleware.unavailable_reason() is not None, reason=str(middleware.unavailable_reason())),
]

SERVER = """
from vinesim.ros.messages import message_packages
message_packages.ensure_importable(["control_msgs"])
import sys, threading
import rclpy
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionServer
from rclpy.executors import ExternalShutdownException
rclpy.init()
node = rclpy.create_node("arm_controller")
def follow(handle):
    trajectory = handle.request.trajectory
    for point in trajectory.points:
        feedback = FollowJointTrajectory.Feedback(joint_names=trajectory.joint_names, desired=point)
        handle.publish_feedback(feedback)
    result = FollowJointTrajectory.Result(error_code=FollowJointTrajectory.Result.GOAL_TOLERANCE_VIOLATED)
    result.error_string = f"{handle.request.goal_tolerance[0].name} by {handle.request.goal_tolerance[0].position}"
    handle.abort()
    return result
server = ActionServer(node, FollowJointTrajectory, "~/follow_joint_trajectory", follow)
threading.Thread(target=lambda: (sys.stdin.read(), rclpy.try_shutdown()), daemon=True).start()
try:
    rclpy.spin(node)
except ExternalShutdownException:
    pass
"""

CLIENT = """
from vinesim.ros.messages import message_packages
message_packages.ensure_importable(["control_msgs"])
import sys
import rclpy
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance
from rclpy.action import ActionClient
from trajectory_msgs.msg import JointTrajectoryPoint
rclpy.init()
node = rclpy.create_node("planner")
client = ActionClient(node, FollowJointTrajectory, "/arm_controller/follow_joint_trajectory")
assert client.wait_for_server(float(sys.argv[1]))
goal = FollowJointTrajectory.Goal(goal_tolerance=[JointTolerance(name="arm_left_1_joint", position=0.25)])
goal.trajectory.joint_names = ["arm_left_1_joint", "arm_left_2_joint"]
goal.trajectory.points = [JointTrajectoryPoint(positions=[0.5 * i, -1.0]) for i in range(3)]
def wait(future):
    rclpy.spin_until_future_complete(node, future, timeout_sec=float(sys.argv[1]))
    return future.result()
heard = []
while len(heard) < 3:  # the server may not have found this node's subscription to feedback yet; then it has next time
    heard = []
    handle = wait(client.send_goal_async(goal, feedback_callback=lambda told, into=heard: into.append(told.feedback)))
    answer = wait(handle.get_result_async())
    for _ in range(10):
        rclpy.spin_once(node, timeout_sec=0.05)
assert [list(f.desired.positions) for f in heard] == [[0.0, -1.0], [0.5, -1.0], [1.0, -1.0]], heard
assert heard[0].joint_names == goal.trajectory.joint_names
assert answer.status == GoalStatus.STATUS_ABORTED
assert answer.result.error_code == FollowJointTrajectory.Result.GOAL_TOLERANCE_VIOLATED == -5
assert answer.result.error_string == "arm_left_1_joint by 0.25"
rclpy.shutdown()
"""


def test_a_trajectory_is_followed_in_another_process():
    surroundings = os.environ | {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER], env=surroundings, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        client = subprocess.run(
            [sys.executable, "-c", CLIENT, str(TIMEOUT)],
            env=surroundings,
            capture_output=True,
            text=True,
            timeout=2 * TIMEOUT,
            check=False,
        )
        assert client.returncode == 0, client.stderr
    finally:
        _, complaint = server.communicate(timeout=TIMEOUT)
    assert server.returncode == 0, complaint
