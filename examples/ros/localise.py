"""Localises a robot without ground truth, from gyroscope and odometry, and publishes the transform map to odom on /tf.

    vinesim client --role robot --scene harvest          # in one terminal
    python examples/ros/localise.py                      # in another

This is an ordinary ROS 2 node. It integrates the yaw rate of the IMU and the velocity of odometry. It sets a parameter
so that the robot no longer publishes its true pose. The origin of the map is the pose of the robot at the start.
"""

import argparse
import math
import signal
import threading

import rclpy
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Imu
from tf2_msgs.msg import TFMessage


class Localiser(Node):
    def __init__(self, robot: str) -> None:
        super().__init__("localiser")
        self.x = self.y = self.yaw = self.speed = 0.0  # of the base in the map
        self.last: float | None = None
        self.settings = AsyncParameterClient(self, robot)
        self.asking = self.create_timer(0.2, self.ask)
        self.tf = self.create_publisher(TFMessage, "/tf", 10)
        self.create_timer(1.0, self.report)
        self.create_subscription(Imu, "/base_imu", self.turn, 10)
        self.create_subscription(Odometry, "/mobile_base_controller/odom", self.travel, 10)

    def ask(self) -> None:
        """Ask the robot to publish no true pose, once it is there."""
        if self.settings.services_are_ready():
            self.settings.set_parameters([Parameter("publish_map_to_odom", value=False)])
            self.asking.cancel()

    def restore(self) -> None:
        """Ask the robot to publish its true pose again, and wait for the answer for at most half a second."""
        if self.asking.is_canceled():
            answer = self.settings.set_parameters([Parameter("publish_map_to_odom", value=True)])
            rclpy.spin_until_future_complete(self, answer, timeout_sec=0.5)

    def report(self) -> None:
        if self.last is None:
            print("waiting for /base_imu", flush=True)
        else:
            print(f"x {self.x:.3f} m, y {self.y:.3f} m, yaw {self.yaw:.3f} rad", flush=True)

    def turn(self, message: Imu) -> None:
        """Integrate yaw and position since the last IMU message."""
        now = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        if self.last is not None:
            turn = message.angular_velocity.z * (now - self.last)
            way = self.speed * (now - self.last)
            self.x += way * math.cos(self.yaw + 0.5 * turn)
            self.y += way * math.sin(self.yaw + 0.5 * turn)
            self.yaw += turn
        self.last = now

    def travel(self, message: Odometry) -> None:
        """Publish the transform map to odom, so that the pose of the base in odometry becomes the integrated pose in
        the map."""
        if not self.asking.is_canceled():
            return  # the robot still publishes the true transform
        self.speed = message.twist.twist.linear.x
        place = message.pose.pose.position
        q = message.pose.pose.orientation
        angle = self.yaw - math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))
        odom = TransformStamped(child_frame_id="odom")
        odom.header.frame_id = "map"
        odom.header.stamp = message.header.stamp
        odom.transform.translation.x = self.x - math.cos(angle) * place.x + math.sin(angle) * place.y
        odom.transform.translation.y = self.y - math.sin(angle) * place.x - math.cos(angle) * place.y
        odom.transform.rotation.z = math.sin(0.5 * angle)
        odom.transform.rotation.w = math.cos(0.5 * angle)
        self.tf.publish(TFMessage(transforms=[odom]))


def main() -> None:
    # Ctrl-C and SIGTERM only set a flag, so that a callback that is running can still publish.
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robot", nargs="?", default="robot", help="node of the robot")
    robot = parser.parse_args().robot
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Localiser(robot)
    try:
        while not stop.is_set():
            rclpy.spin_once(node, timeout_sec=0.1)
        node.restore()
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
