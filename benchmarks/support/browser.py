"""A headless browser that is driven by the DevTools protocol: runs scripts in a page, presses keys, takes pictures."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import pathlib
import shutil
import subprocess
import tempfile
import threading
import wave
from collections.abc import Iterator, Sequence
from subprocess import PIPE
from typing import Any

import aiohttp
import cv2
import numpy as np

from vinesim.audio.frame import to_pcm

TIMEOUT = 120.0
"""Time limit for each answer of the browser [s]."""
PROGRAMS = ("chromium", "google-chrome")
OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--no-first-run",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--remote-debugging-port=0",
    "--window-size=640,480",
)
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Options of a browser that draws without a graphics card."""
IWER = pathlib.Path(__file__).parents[2] / "build" / "page" / "iwer.min.js"
"""Path of the headset emulator, which ``tools/build_page`` copies."""

GUARD = '"$@" & read -r _; kill -9 $!'
"""Shell script that runs a program until the script's standard input ends: it ends with this process, however that
ends."""

AS_RECORDED = """
  const media = navigator.mediaDevices, open = media.getUserMedia.bind(media);
  const raw = { echoCancellation: false, noiseSuppression: false, autoGainControl: false };
  media.getUserMedia = () => open({ audio: raw });
"""
"""Script that runs before the page and switches the browser's sound filters off: they would remove test tones as
noise."""


def microphone(path: pathlib.Path) -> tuple[str, ...]:
    """Returns options of a browser whose microphone plays a sound file in a loop."""
    return (
        "--use-fake-ui-for-media-stream",
        "--use-fake-device-for-media-stream",
        f"--use-file-for-fake-audio-capture={path}",
        "--autoplay-policy=no-user-gesture-required",
    )


def write_tone(path: pathlib.Path, frequency: float, level: float) -> pathlib.Path:
    """Write one second of a tone at 48 kHz that can be repeated without a gap; returns ``path``."""
    return write_sound(path, level * np.sin(2.0 * np.pi * frequency * np.arange(48_000) / 48_000))


def write_sound(path: pathlib.Path, samples: np.ndarray) -> pathlib.Path:
    """Write ``samples`` [n] at 48 kHz; returns ``path``."""
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(48_000)
        file.writeframes(to_pcm(samples))
    return path


def emulated_headset() -> str:
    """Returns a script that runs before the page and emulates a Quest 3; further scripts find it as ``device``."""
    device = ";window.device = new IWER.XRDevice(IWER.metaQuest3); device.stereoEnabled = true;"
    return IWER.read_text() + device + "device.installRuntime({forceInstall: true});"


def program() -> str | None:
    """Returns the path of this machine's browser, or None."""
    return next((path for name in PROGRAMS if (path := shutil.which(name))), None)


class BrowserMissing(RuntimeError):
    """There is no browser on this machine."""

    exit_code = 3


class Page:
    """One page of a browser. Each method returns when the browser has answered."""

    def __init__(self, loop: asyncio.AbstractEventLoop, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._loop = loop
        self._socket = socket
        self._count = 0
        self._before: str | None = None
        """Identifier of the script that runs before the page."""
        self.errors: list[str] = []
        """Errors that the page has thrown."""

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the DevTools protocol and return its result."""
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

    def resize(self, width: int, height: int, ratio: float = 1.0) -> None:
        """Set the size of the page [px]. ``ratio``: pixels of the screen for each pixel of the page, in each
        direction."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=ratio, mobile=False
        )

    def look(self, eye: np.ndarray, target: np.ndarray) -> None:
        """Move the eyes of vinesim's page to ``eye`` [3] m in the world, looking at the point ``target`` [3] m."""
        x, y, z = target - eye
        look = {"place": eye.tolist(), "yaw": float(np.arctan2(y, x)), "pitch": float(np.arctan2(z, np.hypot(x, y)))}
        self.run(f"Object.assign(vinesim.viewer.eyes, {json.dumps(look)}), 0")

    def open(self, address: str, *, before: str = "") -> None:
        """Go to an address. The script ``before`` runs before the scripts of the page. The list of errors starts
        empty."""
        self.call("Runtime.enable")
        self.call("Page.enable")
        if self._before is not None:
            self.call("Page.removeScriptToEvaluateOnNewDocument", identifier=self._before)
        added = self.call("Page.addScriptToEvaluateOnNewDocument", source=before) if before else {}
        self._before = added.get("identifier")
        self.call("Page.navigate", url=address)
        self.errors.clear()

    def run(self, script: str) -> Any:
        """Evaluate an expression in the page and return its value."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def key(self, code: str, *, down: bool) -> None:
        """Press or release a key."""
        self.call("Input.dispatchKeyEvent", type="keyDown" if down else "keyUp", code=code)

    def picture(self) -> np.ndarray:
        """Returns a picture of the page [row, column, 3] RGB."""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


@contextlib.contextmanager
def browser_page(*options: str, graphics: Sequence[str] = SOFTWARE) -> Iterator[Page]:
    """Start a browser and yield a page of it; the browser ends with the context. ``options``: further options of the
    browser; ``graphics``: options that choose how it draws."""
    path = program()
    if path is None:
        raise BrowserMissing(f"a browser is needed, one of {', '.join(PROGRAMS)}: install chromium")
    profile = tempfile.mkdtemp()
    command = [path, *OPTIONS, *graphics, *options, f"--user-data-dir={profile}", "about:blank"]
    child = subprocess.Popen(["sh", "-c", GUARD, "sh", *command], stdin=PIPE, stderr=PIPE, text=True)
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
        assert child.stdin is not None
        child.stdin.close()
        child.wait()
        loop.close()
        shutil.rmtree(profile, ignore_errors=True)


async def _session() -> aiohttp.ClientSession:
    return aiohttp.ClientSession()


async def _first_page(session: aiohttp.ClientSession, host: str) -> aiohttp.ClientWebSocketResponse:
    async with session.get(f"http://{host}/json/list") as answer:
        pages = [one for one in await answer.json() if one["type"] == "page"]
    return await session.ws_connect(pages[0]["webSocketDebuggerUrl"], max_msg_size=0)
