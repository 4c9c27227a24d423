"""``python -m benchmarks page``: latency from an input on a page to the state that contains it, and sizes of messages.

The client is a person's, started as users start it. This process stands in for the page: it acknowledges each state at
once, like a page that draws without delay, and moves the person's head to and fro. The figures do not include the time
that a browser needs to draw.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator
from typing import Any

import aiohttp
import numpy as np

from vinesim.bench.live_client import own_processes
from vinesim.client.programs import START_TIMEOUT, free_port
from vinesim.scene.values import Measurement
from vinesim.web import array_message
from vinesim.web.page_token import lasting_address

NAME = "person"
MOVES = 300
"""Number of measured moves of the head."""
STEP = 0.02
"""Distance that the head moves to the left and back [m]."""
SEEN = 0.5
"""Share of a move after which a state counts as showing it [1]."""
PAUSE = 0.06
"""Time between two moves [s]. Up to one tick is added, so that moves fall into all phases of the client's steps."""
P50 = 25.0
P99 = 60.0
"""Budgets of the median and of the 99th percentile from input to picture [ms], drawing included."""


def page() -> Iterator[Measurement]:
    """Measure the latency from an input to the state that shows it, and sizes of messages."""
    with own_processes() as group:
        port = free_port()
        options = ["--role", "human", "--name", NAME, "--page", str(port), "--status", "json"]
        client = group.start(NAME, "-m", "vinesim", "client", *options)
        client.next_line(START_TIMEOUT)
        address = lasting_address(port)
        assert address is not None, "the folder for caches can be written"
        found = asyncio.run(_measure(address))
    took = 1e3 * np.array(found["took"])
    yield Measurement("page", "vineyard that a page loads", found["scene_bytes"] / 1e6, "MB")
    yield Measurement("page", "states a second", found["rate"], "Hz")
    yield Measurement("page", "a state, mean", float(np.mean(found["bytes"])) / 1e3, "kB")
    for share, budget in ((50, P50), (99, P99)):
        value = float(np.percentile(took, share))
        yield Measurement(
            "page",
            f"input to state, percentile {share} of {len(took)}",
            value,
            "ms",
            "budget with drawing",
            budget,
            budget / value,
        )


async def _measure(address: str) -> dict[str, Any]:
    async with aiohttp.ClientSession() as session:
        async with session.get(address + "scene") as answer:
            body = await answer.read()
        _, arrays = array_message.decode(body)
        head = [*arrays["start"].tolist()]
        head[3:] = (np.array(head[3:]) / np.linalg.norm(head[3:])).tolist()
        async with session.ws_connect(address + "state", max_msg_size=0) as socket:
            page = _Page(session, address, socket, head)
            await page.settle()
            sizes = page.sizes
            start = time.monotonic()
            page.sizes = []
            rng = np.random.default_rng(1)
            took = [await page.move(float(rng.uniform(0.0, 0.01))) for _ in range(MOVES)]
            rate = len(page.sizes) / (time.monotonic() - start)
    return {"scene_bytes": len(body), "took": took, "bytes": page.sizes or sizes, "rate": rate}


class _Page:
    """Connection of a page: receives states, acknowledges each at once, and moves the head."""

    def __init__(
        self, session: aiohttp.ClientSession, address: str, socket: aiohttp.ClientWebSocketResponse, head: list[float]
    ) -> None:
        self._session = session
        self._address = address
        self._socket = socket
        self._head = head
        self._side = 0
        self._row = -1
        self._rigid = 0
        self._y = np.nan
        self._tick = -1
        self.sizes: list[int] = []
        """Sizes of the states received since the list was last cleared [B]."""

    async def settle(self) -> None:
        """Receive until the person's head is among the rigid bodies and stands still."""
        for _ in range(200):
            await self._receive()

    async def move(self, pause: float) -> float:
        """Wait, move the head, and return the time until a state shows it [s]."""
        until = time.monotonic() + PAUSE + pause
        while time.monotonic() < until:
            await self._receive()
        before = self._y
        self._side = 1 - self._side
        start = time.monotonic()
        await self._send()
        while abs(self._y - before) < SEEN * STEP:
            await self._receive()
        return time.monotonic() - start

    async def _receive(self) -> None:
        message = await self._socket.receive_bytes(timeout=START_TIMEOUT)
        self.sizes.append(len(message))
        header, arrays = array_message.decode(message)
        self._tick = header["tick"]
        if header["rigid"] != self._rigid:
            async with self._session.get(self._address + "rigid") as answer:
                names = array_message.decode(await answer.read())[0]["names"]
            self._rigid = header["rigid"]
            self._row = names.index(f"{NAME}/head")
        self._y = float(arrays["rigid_place"].reshape(-1, 3)[self._row, 1])
        await self._send()

    async def _send(self) -> None:
        head = list(self._head)
        head[1] += STEP * self._side
        person = {"head": head, "left": None, "right": None}
        await self._socket.send_str(json.dumps({"drawn": self._tick, "view": head, "person": person}))
