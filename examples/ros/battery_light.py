"""Lights the signal tower when the battery runs low, and sounds it when it is nearly empty.

    vinesim client --role robot --name vinebot           # in one terminal
    python examples/ros/battery_light.py                 # in another
    ros2 topic pub -r 1 /battery_state sensor_msgs/BatteryState "{percentage: 0.15}"

A stock ROS 2 node: /battery_state comes from whatever knows the charge; vinesim simulates no battery.
"""

import rclpy
from rclpy.node import Node
from sensor_msgs.msg import BatteryState
from std_msgs.msg import Bool, String

# share of the charge
LOW = 0.20
EMPTY = 0.05
MARGIN = 0.02  # by which it has to rise before a light goes off again


class BatteryLight(Node):
    def __init__(self) -> None:
        super().__init__("battery_light")
        self.pattern = "off"
        self.light = self.create_publisher(String, "/indicator_lights/command", 1)
        self.sound = self.create_publisher(Bool, "/indicator_lights/sound", 1)
        self.create_subscription(BatteryState, "/battery_state", self.take, 10)

    def take(self, message: BatteryState) -> None:
        """Choose the pattern by the charge; a charge that is not known (NaN) changes nothing."""
        charge = message.percentage
        before = self.pattern
        for pattern, limit in (("alarm", EMPTY), ("warning", LOW)):
            if charge < limit or (before in (pattern, "alarm") and charge < limit + MARGIN):
                self.pattern = pattern
                break
        else:
            if charge == charge:
                self.pattern = "off"
        # With every message: a robot that has only just started hears it, too.
        self.light.publish(String(data=self.pattern))
        self.sound.publish(Bool(data=self.pattern == "alarm"))
        if self.pattern != before:
            print(self.pattern, flush=True)


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(BatteryLight())
