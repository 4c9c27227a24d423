"""Makes a robot's left arm compliant: the arm gives way when something pushes it, and comes back.

    vinesim client --role robot --scene harvest          # in one terminal
    python examples/ros/compliant_arm.py                 # in another

This is an ordinary ROS 2 node. It holds the arm at its present pose with low stiffness, and prints when a joint gives
way.
"""

import argparse
import signal
import threading

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

# gains of the impedance controller: N m/rad, N m s/rad
STIFFNESS = 50.0
DAMPING = 15.0
# deflection of a joint [rad] above which the arm counts as pushed, and below which it is back
PUSHED = 0.03
BACK = 0.01


class CompliantArm(Node):
    def __init__(self, arm: str = "arm_left") -> None:
        super().__init__("compliant_arm")
        self.joints = [f"{arm}_{i}_joint" for i in range(1, 8)]
        self.equilibrium: list[float] = []
        self.is_pushed = False
        self.topics = {
            what: self.create_publisher(Float64MultiArray, f"/{arm}_impedance_controller/{what}", 10)
            for what in ("stiffness", "damping", "equilibrium")
        }
        self.create_subscription(JointState, "/joint_states", self.take, 10)

    def take(self, message: JointState) -> None:
        """Make the arm compliant once the controller has subscribed; afterwards, watch the joints."""
        places = dict(zip(message.name, message.position, strict=True))
        here = [places[joint] for joint in self.joints]
        if not self.equilibrium:
            if all(topic.get_subscription_count() for topic in self.topics.values()):
                self.equilibrium = here
                for what, values in (("stiffness", [STIFFNESS] * 7), ("damping", [DAMPING] * 7), ("equilibrium", here)):
                    self.topics[what].publish(Float64MultiArray(data=values))
                print("soft", flush=True)
            return
        away, joint = max((abs(a - b), name) for a, b, name in zip(here, self.equilibrium, self.joints, strict=True))
        if away > PUSHED and not self.is_pushed:
            print(f"{joint} gives way by {away:.3f} rad", flush=True)
        elif away < BACK and self.is_pushed:
            print("back", flush=True)
        self.is_pushed = away > (BACK if self.is_pushed else PUSHED)


def main() -> None:
    # Ctrl-C and SIGTERM only set a flag, so that a callback that is running can still publish.
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = CompliantArm()
    print("waiting for the controller of the arm", flush=True)
    try:
        while not stop.is_set():
            rclpy.spin_once(node, timeout_sec=0.1)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
