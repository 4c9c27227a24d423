"""Localises a robot without ground truth, from gyroscope and odometry, and publishes the transform map to odom on /tf.

    vinesim client --role robot --name vinebot           # in one terminal
    python examples/ros/localise.py vinebot              # in another

This is an ordinary ROS 2 node. It integrates the yaw rate of the IMU and the velocity of odometry. It sets a parameter
so that the robot no longer publishes its true pose. The origin of the map is the pose of the robot at the start.
"""

import math
import sys

import rclpy
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import Imu
from tf2_msgs.msg import TFMessage


class Localiser(Node):
    def __init__(self, robot: str) -> None:
        super().__init__("localiser")
        self.x = self.y = self.yaw = self.speed = 0.0  # of the base in the map
        self.last: float | None = None
        settings = AsyncParameterClient(self, robot)
        settings.wait_for_services()
        settings.set_parameters([Parameter("publish_map_to_odom", value=False)])
        self.tf = self.create_publisher(TFMessage, "/tf", 100)
        self.create_subscription(Imu, "/base_imu", self.turn, 1000)
        self.create_subscription(Odometry, "/mobile_base_controller/odom", self.travel, 100)

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


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Localiser(sys.argv[1] if len(sys.argv) > 1 else "vinebot"))
