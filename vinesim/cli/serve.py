"""``vinesim server``."""

from __future__ import annotations

import signal
import threading

from vinesim.net.server import Server


def run(listen: str) -> int:
    """Carry messages until SIGINT or SIGTERM."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with Server(listen) as server:
        print(f"listening on {server.endpoint}", flush=True)
        stop.wait()
    return 0
