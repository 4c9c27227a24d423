"""A headless browser for tests, driven by the DevTools protocol: scripts in the page, keys, and pictures of it."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from typing import Any

import aiohttp
import cv2
import numpy as np

from tests.support.waiting import TIMEOUT

PROGRAMS = ("chromium", "google-chrome")
OPTIONS = (
    "--headless", "--no-sandbox", "--no-first-run", "--disable-quic", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage", "--remote-debugging-port=0", "--window-size=640,480",
)  # fmt: skip


def program() -> str | None:
    """The browser of this machine, or None."""
    return next((path for name in PROGRAMS if (path := shutil.which(name))), None)


class Page:
    """One page of a browser. All calls wait until the browser has answered."""

    def __init__(self, loop: asyncio.AbstractEventLoop, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._loop, self._socket, self._count = loop, socket, 0
        self.errors: list[str] = []
        """What the page has thrown."""

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Result of a method of the DevTools protocol."""
        return self._loop.run_until_complete(asyncio.wait_for(self._call(method, parameters), TIMEOUT))

    async def _call(self, method: str, parameters: dict[str, Any]) -> dict[str, Any]:
        self._count += 1
        number = self._count
        await self._socket.send_json({"id": number, "method": method, "params": parameters})
        while True:
            answer = await self._socket.receive_json()
            if answer.get("method") == "Runtime.exceptionThrown":
                self.errors.append(json.dumps(answer["params"]["exceptionDetails"])[:500])
            if answer.get("id") == number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]

    def open(self, address: str, *, before: str = "") -> None:
        """Go to an address; the script ``before`` runs before those of the page."""
        self.call("Runtime.enable")
        if before:
            self.call("Page.enable")
            self.call("Page.addScriptToEvaluateOnNewDocument", source=before)
        self.call("Page.navigate", url=address)

    def run(self, script: str) -> Any:
        """Value of an expression in the page."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def key(self, code: str, *, down: bool) -> None:
        """Press or release a key."""
        self.call("Input.dispatchKeyEvent", type="keyDown" if down else "keyUp", code=code)

    def picture(self) -> np.ndarray:
        """What the page shows [row, column, 3] RGB."""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.cvtColor(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


@contextlib.contextmanager
def browser_page(*options: str) -> Iterator[Page]:
    """A page of a browser, started with these further options, that ends with the block."""
    path = program()
    assert path is not None, "a browser is needed: install chromium"
    profile = tempfile.mkdtemp()
    child = subprocess.Popen(
        [path, *OPTIONS, *options, f"--user-data-dir={profile}", "about:blank"], stderr=subprocess.PIPE, text=True
    )
    loop = asyncio.new_event_loop()
    try:
        assert child.stderr is not None
        said = next((line for line in child.stderr if "DevTools listening on" in line), "")
        assert said, "the browser ended before it listened"
        threading.Thread(target=child.stderr.read, daemon=True).start()
        host = said.split("ws://")[1].split("/")[0]
        session = loop.run_until_complete(_session())
        try:
            socket = loop.run_until_complete(_first_page(session, host))
            yield Page(loop, socket)
        finally:
            loop.run_until_complete(session.close())
    finally:
        child.kill()
        child.wait()
        loop.close()
        shutil.rmtree(profile, ignore_errors=True)


async def _session() -> aiohttp.ClientSession:
    return aiohttp.ClientSession()


async def _first_page(session: aiohttp.ClientSession, host: str) -> aiohttp.ClientWebSocketResponse:
    async with session.get(f"http://{host}/json/list") as answer:
        pages = [one for one in await answer.json() if one["type"] == "page"]
    return await session.ws_connect(pages[0]["webSocketDebuggerUrl"], max_msg_size=0)
