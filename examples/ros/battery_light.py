"""Turns on a robot's indicator lights when the battery is low, and also their tone when it is nearly empty.

    vinesim client --role robot --scene harvest          # in one terminal
    python examples/ros/battery_light.py                 # in another
    vinesim ros pub /battery_state '{"percentage": 0.15}'       # in a third; or:
    ros2 topic pub -r 1 /battery_state sensor_msgs/msg/BatteryState '{percentage: 0.15}'

This is an ordinary ROS 2 node. Another node must publish /battery_state, because vinesim simulates no battery.
"""

import argparse
import signal
import threading

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import BatteryState
from std_msgs.msg import Bool, String

# shares of the full charge
LOW = 0.20
EMPTY = 0.05
MARGIN = 0.02  # by which the charge must rise above a limit before its pattern ends


class BatteryLight(Node):
    def __init__(self) -> None:
        super().__init__("battery_light")
        self.pattern = "off"
        self.light = self.create_publisher(String, "/indicator_lights/command", 10)
        self.sound = self.create_publisher(Bool, "/indicator_lights/sound", 10)
        self.create_subscription(BatteryState, "/battery_state", self.take, 10)

    def take(self, message: BatteryState) -> None:
        """Choose the pattern by the charge. An unknown charge (NaN) changes nothing."""
        charge = message.percentage
        before = self.pattern
        for pattern, limit in (("alarm", EMPTY), ("warning", LOW)):
            if charge < limit or (before in (pattern, "alarm") and charge < limit + MARGIN):
                self.pattern = pattern
                break
        else:
            if charge == charge:
                self.pattern = "off"
        # Published with every message, so that a robot that starts later receives the commands, too.
        self.light.publish(String(data=self.pattern))
        self.sound.publish(Bool(data=self.pattern == "alarm"))
        if self.pattern != before:
            print(self.pattern, flush=True)


def main() -> None:
    # Ctrl-C and SIGTERM only set a flag, so that a callback that is running can still publish.
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = BatteryLight()
    print("waiting for /battery_state", flush=True)
    try:
        while not stop.is_set():
            rclpy.spin_once(node, timeout_sec=0.1)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
