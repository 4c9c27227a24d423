"""A stock ROS node that publishes joint states from a timer, as a peer of vinesim's publishers. It imports nothing from
vinesim.

Each message is stamped with the time at which it was due [s since the start of the timer].
"""

from __future__ import annotations

import contextlib
import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

TOPIC = "/stock/joint_states"


def main(joints: int, period: float) -> int:
    """Publish messages with ``joints`` joints every ``period`` [s] until SIGINT. Returns the exit code."""
    rclpy.init(args=[])
    node = rclpy.create_node("stock_publisher")
    publisher = node.create_publisher(JointState, TOPIC, QoSProfile(depth=100))
    names = [f"joint_{i}" for i in range(joints)]
    start = time.monotonic()

    def publish() -> None:
        message = JointState(name=names, position=[0.0] * joints, velocity=[0.0] * joints, effort=[0.0] * joints)
        due = int((time.monotonic() - start) / period) * period
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(due * 1e9), 10**9)
        publisher.publish(message)

    node.create_timer(period, publish)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), float(sys.argv[2])))
