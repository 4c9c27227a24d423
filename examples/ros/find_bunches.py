"""Finds bunches in a robot's colour and depth images, and prints their positions.

    vinesim client --role robot --scene harvest          # in one terminal
    python examples/ros/find_bunches.py                  # in another

This is an ordinary ROS 2 node. It takes each connected area with the colour of fruit as a bunch. Positions are in the
camera's optical frame, in metres.
"""

import argparse
import signal
import threading

import cv2
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, Image

VIVIDNESS = 2.2
"""Factor on the distance of a colour from grey: a D435 has pale colours."""


FARTHEST = 2.5
"""Distance [m] beyond which yellow leaves look like bunches."""


class BunchFinder(Node):
    def __init__(self, camera: str = "/head_front_camera") -> None:
        super().__init__("find_bunches")
        self.parts: dict[str, Image | CameraInfo] = {}
        for kind, topic in ((Image, "rgb/image_raw"), (Image, "depth/image_raw"), (CameraInfo, "rgb/camera_info")):
            self.create_subscription(kind, f"{camera}/{topic}", lambda m, t=topic: self.take(t, m), 10)

    def take(self, topic: str, message: Image | CameraInfo) -> None:
        """Store a message. Find bunches once colour, depth and intrinsics with the same header stamp have arrived."""
        self.parts = {t: m for t, m in self.parts.items() if m.header.stamp == message.header.stamp} | {topic: message}
        if len(self.parts) == 3:
            rgb, depth, info = (self.parts[t] for t in ("rgb/image_raw", "depth/image_raw", "rgb/camera_info"))
            picture = np.frombuffer(rgb.data, np.uint8).reshape(rgb.height, rgb.width, 3)
            metres = np.frombuffer(depth.data, np.float32).reshape(depth.height, depth.width)
            print(f"picture at {rgb.header.stamp.sec} s", flush=True)
            for x, y, z in find(picture, metres, np.reshape(info.k, (3, 3))):
                print(f"{rgb.header.frame_id}: bunch at x {x:.2f} y {y:.2f} z {z:.2f} m", flush=True)


def find(picture: np.ndarray, metres: np.ndarray, k: np.ndarray) -> list[np.ndarray]:
    """Returns the positions [3] m of the bunches in an image [height, width, 3] with depth [height, width] m.

    ``k`` [3, 3]: camera matrix.
    """
    smooth = cv2.blur(picture, (5, 5)).astype(float)  # the noise of a pixel, and shade between berries
    grey = smooth.mean(axis=2, keepdims=True)
    red, green, blue = np.moveaxis(grey + VIVIDNESS * (smooth - grey), 2, 0)
    amber = (abs(red - green) < 0.1 * green) & (blue < 0.65 * green)
    fruit = (amber | ((red > 1.3 * green) & (blue > green - 8))).astype(np.uint8)
    fruit = cv2.morphologyEx(fruit, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    fruit = cv2.morphologyEx(fruit, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
    # a bunch ends where the distance jumps
    distance = np.nan_to_num(metres, nan=0.0, posinf=0.0, neginf=0.0)
    jump = cv2.morphologyEx(distance, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    fruit[(distance == 0.0) | (distance > FARTHEST) | (jump > 0.05)] = 0
    count, pieces = cv2.connectedComponents(fruit)
    places = []
    for piece in range(1, count):
        rows, columns = np.nonzero((pieces == piece) & np.isfinite(metres))
        if len(rows) > 150:
            z = np.median(metres[rows, columns])
            (near, far) = np.percentile(metres[rows, columns], (10, 90))
            size = np.ptp([columns, rows], axis=1) * z / k[0, 0]
            # yellow leaves are narrower; grass and soil extend over a larger range of depths
            if size.min() > 0.07 and size.max() < 0.3 and far - near < 0.1:
                places.append(np.linalg.inv(k) @ [np.median(columns) * z, np.median(rows) * z, z])
    return places


def main() -> None:
    # Ctrl-C and SIGTERM only set a flag, so that a callback that is running can still publish.
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = BunchFinder()
    print("waiting for pictures of /head_front_camera", flush=True)
    try:
        while not stop.is_set():
            rclpy.spin_once(node, timeout_sec=0.1)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
