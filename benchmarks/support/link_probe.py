"""Numbered messages through a server: how many arrive, how late, and how long it takes to hand one over."""

from __future__ import annotations

import struct
import threading
import time
from typing import Self

import numpy as np
import zenoh

from vinesim.net.transport.endpoints import client_links
from vinesim.net.transport.zenoh_bus import ROOT, WORLD, ZenohBus
from vinesim.net.transport.zenoh_session import called_directly, close_session, open_client

PERIOD = 0.1
"""Time between two messages of each kind [s]."""
KINDS = {"reliable": True, "best effort": False}
"""Whether the messages of a kind are reliable, by kind."""
_HEADER = struct.Struct("<Id")
"""Number of a message, and the time at which it was published [s, monotonic]."""
SIZE = 256
"""Size of a message [B]: about that of a robot's pose."""


class LinkProbe:
    """A publisher of the product and a plain subscriber of Zenoh, both at one server. A context manager.

    No client subscribes to the probe's messages.
    """

    def __init__(self, endpoint: str) -> None:
        self._bus = ZenohBus("link_probe", connect=endpoint, live=False)
        self._session = open_client(client_links(endpoint, secured=False).bulk, {})
        self.sent = dict.fromkeys(KINDS, 0)
        """Number of messages that were published, by kind."""
        self.unsent = dict.fromkeys(KINDS, 0)
        """Number of messages that were not published because the server was known to be gone, by kind."""
        self.calls: list[float] = []
        """Duration of each call that published a message [s]."""
        self.delays: dict[str, list[float]] = {kind: [] for kind in KINDS}
        """Time from the call to the arrival of each message that arrived [s], by kind."""
        self._subscribers = [self._subscribe(kind) for kind in KINDS]
        self._publishers = {kind: self._bus.publisher(_key(kind), reliable) for kind, reliable in KINDS.items()}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="link probe", daemon=True)

    def _subscribe(self, kind: str) -> object:
        def arrived(sample: zenoh.Sample) -> None:
            now = time.monotonic()
            _, sent = _HEADER.unpack_from(sample.payload.to_bytes())
            self.delays[kind].append(now - sent)

        return self._session.declare_subscriber(f"{ROOT}/{WORLD}/{_key(kind)}", called_directly(arrived))

    def _run(self) -> None:
        number = 0
        while not self._stop.wait(PERIOD):
            for kind, publisher in self._publishers.items():
                start = time.monotonic()
                is_sent = publisher.put(_HEADER.pack(number, start).ljust(SIZE, b"\0"))
                if is_sent:
                    self.calls.append(time.monotonic() - start)
                    self.sent[kind] += 1
                else:
                    self.unsent[kind] += 1
            number += 1

    def delivered(self, kind: str) -> float:
        """Returns the share of published messages of a ``kind`` that arrived; 1 if none was published."""
        return len(self.delays[kind]) / self.sent[kind] if self.sent[kind] else 1.0

    def delay(self, kind: str, percent: float) -> float:
        """Returns a percentile of the delays of a ``kind`` [s]; NaN if no message arrived."""
        return float(np.percentile(self.delays[kind], percent)) if self.delays[kind] else float("nan")

    def call(self, percent: float) -> float:
        """Returns a percentile of the durations of the calls that publish [s]; NaN without a call."""
        return float(np.percentile(self.calls, percent)) if self.calls else float("nan")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        close_session(self._session)
        self._bus.close()


def _key(kind: str) -> str:
    return f"probe/{kind.replace(' ', '_')}"
