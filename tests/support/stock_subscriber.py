"""A stock rclpy program with its own process: it subscribes to topics with the default QoS, and notes the stamps.

``python -m tests.support.stock_subscriber TOPIC...`` prints "listening" when it has had a message of every topic,
and when its standard input is closed a JSON object: of each topic the stamps and the wall times [ns] in order of
arrival.
"""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

ROOT = pathlib.Path(__file__).resolve().parents[2]
TYPES = {
    "/clock": "rosgraph_msgs/msg/Clock",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/mobile_base_controller/odom": "nav_msgs/msg/Odometry",
    "/vine/contacts": "sensor_msgs/msg/PointCloud2",
}
DEPTH = 10
"""Of the history: rclpy's default."""


class StockSubscriber:
    """The program as a child process."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self._first = threading.Event()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.process.stdout.readline()
        self._first.set()

    @property
    def listens(self) -> bool:
        """Whether a message of every topic has come."""
        return self._first.is_set()

    def stop(self) -> None:
        """Hold the process, as a debugger or Ctrl-Z does."""
        os.kill(self.process.pid, signal.SIGSTOP)

    def go_on(self) -> None:
        """Let it run again."""
        os.kill(self.process.pid, signal.SIGCONT)

    @contextlib.contextmanager
    def starved(self, held: float, free: float) -> Iterator[None]:
        """Hold the process for ``held`` [s] again and again, with ``free`` [s] between."""
        done = threading.Event()

        def hold() -> None:
            while not done.wait(free):
                self.stop()
                time.sleep(held)
                self.go_on()

        thread = threading.Thread(target=hold)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    def report(self) -> dict[str, list[list[int]]]:
        """Stamps and times of arrival [ns], by topic; it ends."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        text = self.process.stdout.read()
        code = self.process.wait()
        assert text, f"the program ended with {code}"
        return json.loads(text)


@contextlib.contextmanager
def stock_subscriber(*topics: str) -> Iterator[StockSubscriber]:
    """A running program that subscribes to ``topics``."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.support.stock_subscriber", *topics],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    try:
        yield StockSubscriber(process)
    finally:
        process.kill()
        process.wait()


def main(topics: list[str]) -> int:
    """Subscribe until standard input is closed."""
    import rclpy

    from vinesim.ros import middleware
    from vinesim.ros.messages import message_packages
    from vinesim.ros.tools.subscribing import message_class

    middleware.clear_profile()
    message_packages.ensure_importable(["tf2_msgs"])
    rclpy.init(args=[])
    node = rclpy.create_node(f"stock_subscriber_{os.getpid()}")
    arrived: dict[str, tuple[list[int], list[int]]] = {topic: ([], []) for topic in topics}

    def note(topic: str, message: object) -> None:
        if topic == "/tf":
            stamp = message.transforms[0].header.stamp
        else:
            stamp = message.clock if topic == "/clock" else message.header.stamp
        arrived[topic][0].append(stamp.sec * 10**9 + stamp.nanosec)
        arrived[topic][1].append(time.time_ns())

    for topic in topics:
        node.create_subscription(message_class(TYPES[topic]), topic, lambda m, t=topic: note(t, m), DEPTH)
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    has_all = False
    while not ended.is_set():
        rclpy.spin_once(node, timeout_sec=0.1)
        if not has_all and all(stamps for stamps, _ in arrived.values()):
            has_all = True
            print("listening", flush=True)
    print(json.dumps(arrived), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
