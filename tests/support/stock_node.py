"""A stock rclpy node with a context of its own, as a peer of the node under test; import it only where ROS is
installed."""

from __future__ import annotations

import time
from collections.abc import Callable

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from tests.support import waiting
from tests.support.waiting import TIMEOUT as TIMEOUT


def wait_until(
    condition: Callable[[], object], meanwhile: Callable[[], object] = lambda: time.sleep(0.01), name: str = "condition"
) -> None:
    """Call ``meanwhile`` until ``condition`` holds, at most :func:`waiting.deadline`; a failure shows the ``name``."""
    end = time.monotonic() + waiting.deadline()
    while not condition():
        assert time.monotonic() < end, f"waited in vain for: {name}"
        meanwhile()


class StockNode:
    """A stock node with a context of its own."""

    def __init__(self) -> None:
        self._context = Context()
        self._context.init([])
        self.node = rclpy.create_node("stock_node", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def spin(self, timeout: float = 0.05) -> None:
        """Take one message, or wait up to ``timeout`` [s] for one."""
        self._executor.spin_once(timeout_sec=timeout)

    def __enter__(self) -> StockNode:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.shutdown()
