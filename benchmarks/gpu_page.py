"""Frame rate of the web page on a graphics card, in JSON lines.

    python benchmarks/gpu_page.py --record demo.page --scene demo    # where vinesim is installed
    python benchmarks/gpu_page.py --play demo.page                   # where a browser and a graphics card are
    python benchmarks/gpu_page.py --play demo.page --software        # without a graphics card: a laptop's page only
    python benchmarks/gpu_page.py --address ADDRESS --software    # the page of a running client, as it printed it

A recording holds all messages that a spectator's page receives: the vineyard, the shapes of a robot that pushes a bunch
and of two people, and the states of some seconds. ``--play`` needs aiohttp, msgspec, numpy and OpenCV. It sends the
states through vinesim's own page server to vinesim's own page. Each size of the page is measured twice: first the
pictures a second that the browser asks for, as often as it can; then the time of a picture from the page's first line
of script to the last pixel, while no other picture is drawn.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import pathlib
import sys
import threading
import time
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.support import browser
from vinesim.web import array_message
from vinesim.web.page_server import PageServer

VIEWS = {"demo": ((0.2, 0.9, 1.6), (3.0, 1.5, 1.25)), "vsp": ((1.2, 1.3, 1.6), (5.0, 1.3, 1.0)), "tendone": None}
"""Place of the eyes and the point that they look at [m], by scene. None: the view with which the page begins."""
RECORDED = 300
"""Number of states in a recording."""
STEPS = 2
"""Number of simulation steps between two recorded states."""
STATE_PERIOD = 0.01
"""Time between two states that are played [s]: shorter than the page takes to draw one, as in normal use."""
SIZES = {"phone": (390, 844, 2.0), "laptop": (1280, 720, 1.0), "desktop": (1920, 1080, 1.0)}
"""Width and height of the page [px], and how many pixels of the screen one of those has in each direction, by kind."""
EYES = (2 * 2064, 2208)
"""Width and height [px] of both eyes' pictures of a Quest 3 as iwer emulates it. A headset with half of the rows and
columns is measured, too."""
FEWER_TRIANGLES = 150_000
"""Number of triangles for each eye to which a headset is limited in one case. That case separates the time that
triangles cost from the time that pixels cost."""
BARS = {"phone": 30.0, "laptop": 60.0, "headset": 72.0}
"""Smallest acceptable number of pictures a second, by kind of screen [Hz]."""
SOFTWARE_BAR = 10.0
"""Smallest acceptable number of pictures a second without a graphics card [Hz]."""
SECONDS = 5.0
SETTLING = 10.0
"""Time [s] in which the page finds out how much it can draw, before a measurement."""
UNCHANGED = 75
PATIENCE = 60.0
"""Longest time to wait for a headset's scale to settle [s]. It has settled when ``UNCHANGED`` pictures in a row had the
same scale."""
GPU = (
    "--use-angle=vulkan",
    "--enable-features=Vulkan",
    "--disable-vulkan-surface",
    "--ignore-gpu-blocklist",
    "--enable-gpu",
    "--disable-frame-rate-limit",
    "--disable-gpu-vsync",
)
CARD = """(() => {
  const gl = vinesim.viewer.renderer.getContext(), names = gl.getExtension("WEBGL_debug_renderer_info");
  return gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
})()"""
VIEWPORT_SCALE = """(() => {
  const asked = {}, { getViewport } = XRWebGLLayer.prototype;
  device.givesScale = false;
  XRView.prototype.requestViewportScale = function (scale) {
    if (scale > 0 && scale <= 1) asked[this.eye] = scale;
  };
  XRWebGLLayer.prototype.getViewport = function (view) {
    const { x, y, width, height } = getViewport.call(this, view), scale = device.givesScale ? asked[view.eye] ?? 1 : 1;
    return { x, y, width: Math.floor(scale * width), height: Math.floor(scale * height) };
  };
})();"""
"""Script that runs before the page. While ``device.givesScale`` is set, the emulated headset's views shrink to the
scale that the page asks for, from the next picture on (WebXR Device API, dynamic viewport scaling). iwer itself ignores
the request."""
WAIT_FOR_PIXELS = """(() => {
  const { viewer } = vinesim, gl = viewer.renderer.getContext(), pixel = new Uint8Array(4), took = viewer.took = [];
  viewer.draw = (frame) => {
    const begin = performance.now();
    Object.getPrototypeOf(viewer).draw.call(viewer, frame);
    const drawn = performance.now(), bound = gl.getParameter(gl.FRAMEBUFFER_BINDING);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    gl.bindFramebuffer(gl.FRAMEBUFFER, bound);
    took.push([performance.now() - begin, drawn - begin]);
  };
})()"""
"""Script after which each picture is drawn to its last pixel before the next one begins, and is timed."""
DURATIONS = """(() => {
  const { viewer } = vinesim, { took } = viewer;
  delete viewer.draw;
  const middle = (k) => took.map((one) => one[k]).sort((a, b) => a - b)[took.length >> 1];
  return [middle(0), middle(1)];
})()"""
"""Script that ends :data:`WAIT_FOR_PIXELS`. Its value is the median time of a picture to its last pixel [ms], and the
median time of the page's script in it [ms]."""


def record(path: pathlib.Path, name: str) -> None:
    """Write to ``path`` all messages that a page of the scene ``name`` receives."""
    from vinesim.client.client import Client
    from vinesim.client.page.page_world import PageWorld
    from vinesim.client.tasks.motions import LookAt
    from vinesim.client.tasks.start_poses import (
        PlacementError,
        bunch_centres,
        find_reachable_bunch,
        spawn_pose,
        start_pose,
    )
    from vinesim.core import frames
    from vinesim.kernels.compilation import compile_kernels
    from vinesim.net.transport.memory_bus import MemoryHub
    from vinesim.rigid.human_posture import standing_pose
    from vinesim.robot.description.loader import load_description
    from vinesim.robot.tasks.push import PushBunch
    from vinesim.scene.generation.vineyard import generate
    from vinesim.scene.spec import load_scene
    from vinesim.scene.values import HumanSpec

    scene = load_scene(name)
    model = generate(scene)
    robot = load_description("vinebot")
    compile_kernels()
    client = Client(scene, model, robot, MemoryHub().bus("robot"), name="robot", pose=start_pose(scene, 0))
    base = start_pose(scene, 0)
    with contextlib.suppress(PlacementError):  # without a reachable bunch, the robot stands still
        bunch = find_reachable_bunch(model, spawn_pose(scene, 0))
        centre = bunch_centres(model)[bunch]
        push = PushBunch(client.robot, client.side_of(centre), lambda: centre)
        client.pre_step += [push.control, LookAt(client.robot, lambda: centre)]
    for k, who in enumerate(("anna", "bert")):
        place = base[:3] + frames.rotate(base[3:], np.array([-0.8, 0.9 - 1.8 * k, 0.0]))
        client.physics.add_human(HumanSpec(who, 100 + k, standing_pose(frames.pose(place)), 1.75))
    world = PageWorld(client)

    class Server:
        """Stands in for the page server: it reports viewers, so that states are made."""

        has_viewers = True

        def notify(self) -> None:
            """Ignore the notice of a new state: :func:`record` reads states from the world."""

    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("scene", world.scene())
        before = -1
        for k in range(RECORDED):
            for _ in range(STEPS):
                client.tick()
                world.collect(Server())  # pyright: ignore[reportArgumentType]
            state = world.state(before)
            assert state is not None
            before = state[0]
            archive.writestr(f"state{k:04d}", state[1])
            if k % 50 == 0:
                sys.stderr.write(f"{k} of {RECORDED} states\n")
        archive.writestr("rigid", world.rigid())
        archive.writestr("name", name)


class Recorded:
    """A world for the page server that plays a recording in a loop, one state for each call of :meth:`advance`."""

    def __init__(self, path: pathlib.Path) -> None:
        with zipfile.ZipFile(path) as archive:
            self._scene = archive.read("scene")
            self._rigid = archive.read("rigid")
            self.name = archive.read("name").decode()
            self._states = [archive.read(f"state{k:04d}") for k in range(RECORDED)]
        self._count = 0
        self._sent = 0

    def advance(self) -> None:
        """Make the next state due."""
        self._count += 1

    def scene(self) -> bytes:
        """Returns the recorded message with the vineyard."""
        return self._scene

    def plants(self, place: Any) -> bytes:
        """Returns the recorded vineyard for any ``place`` of the eyes: they do not move in this benchmark."""
        return self._scene

    def rigid(self) -> bytes:
        """Returns the recorded message with the shapes of the robot and the people."""
        return self._rigid

    def state(self, since: int, page: int) -> tuple[int, bytes] | None:
        """Returns the number and the message of the next state, or None if none is due."""
        if self._sent >= self._count:
            return None
        self._sent += 1
        values, arrays = array_message.decode(self._states[self._sent % RECORDED])
        return self._sent, array_message.encode(values | {"tick": self._sent}, arrays)

    def take(self, page: int, said: Any) -> None:
        """Ignore a page's input: a spectator moves nothing."""

    def leave(self, page: int) -> None:
        """Ignore a page that leaves: it may come back."""


@contextlib.contextmanager
def served(world: Recorded) -> Iterator[str]:
    """Serve the page with the states of ``world`` until the context ends; yields its address."""
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(STATE_PERIOD):
            world.advance()
            server.notify()

    with PageServer(world) as server:
        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield server.address
        finally:
            stop.set()
            thread.join()


def play(
    path: pathlib.Path, graphics: tuple[str, ...], pictures: pathlib.Path | None, query: str
) -> Iterator[dict[str, Any]]:
    """Play the recording at ``path`` to a page of every size, and yield one result a measurement."""
    world = Recorded(path)
    with browser.browser_page(graphics=graphics) as page, served(world) as address:
        _open(page, world, address + query)
        yield {"case": f"{world.name}: drawn by", "value": page.run(CARD), "unit": ""}
        for kind, (width, height, ratio) in SIZES.items():
            page.resize(width, height, ratio)
            page.run("vinesim.viewer.resize(), 0")
            yield from _measure(page, f"{world.name}, {kind}, {width}x{height}, {ratio:g}x", BARS.get(kind))
            _save(page, pictures, f"{world.name}-{kind}")
        yield from _errors(page)
        for eyes in (EYES, (EYES[0] // 2, EYES[1] // 2)):
            yield from _headset(page, world, address + query, eyes, pictures)
        _wear(page, world, f"{address}?triangles={FEWER_TRIANGLES}", EYES)
        case = f"{world.name}, headset, {EYES[0]}x{EYES[1]}, all pixels, triangles={FEWER_TRIANGLES}"
        yield from _measure(page, case, BARS["headset"])
        yield from _errors(page)


def play_without_card(path: pathlib.Path, pictures: pathlib.Path | None) -> Iterator[dict[str, Any]]:
    """Play the recording at ``path`` to a laptop's page without a graphics card, and yield one result a measurement."""
    world = Recorded(path)
    with browser.browser_page(graphics=browser.SOFTWARE) as page, served(world) as address:
        _open(page, world, address)
        yield from _measure(page, f"{world.name}, laptop without a graphics card, 1280x720", SOFTWARE_BAR)
        yield {"case": f"{world.name}, laptop without a graphics card: pixels", "value": page.run(CANVAS), "unit": "1"}
        _save(page, pictures, f"{world.name}-software")
        yield from _errors(page)


def look_at_client(address: str, graphics: tuple[str, ...], pictures: pathlib.Path | None) -> Iterator[dict[str, Any]]:
    """Measure the page of a running client at an ``address``: physics and page share the machine."""
    with browser.browser_page(graphics=graphics) as page:
        page.resize(1280, 720)
        page.open(address)
        _wait(page, "window.vinesim?.viewer !== undefined && vinesim.drawn > 20")
        yield from _measure(page, "page of a client on this machine, 1280x720", SOFTWARE_BAR)
        yield {"case": "page of a client on this machine: pixels", "value": page.run(CANVAS), "unit": "1"}
        _save(page, pictures, "client")
        yield from _errors(page)


CANVAS = "vinesim.viewer.renderer.domElement.width * vinesim.viewer.renderer.domElement.height"
"""Expression for the number of pixels that a page draws."""


def _headset(
    page: browser.Page, world: Recorded, address: str, eyes: tuple[int, int], pictures: pathlib.Path | None
) -> Iterator[dict[str, Any]]:
    """Measure a headset with ``eyes`` [px], width and height of its canvas.

    First all pixels are drawn, then as many as the page asks for. At last the scene is hidden: what remains is the
    canvas, which the emulator copies and the browser antialiases.
    """
    case = f"{world.name}, headset, {eyes[0]}x{eyes[1]}"
    _wear(page, world, address, eyes)
    yield from _measure(page, f"{case}, all pixels", BARS["headset"])
    _save(page, pictures, f"{world.name}-headset-{eyes[0]}")
    page.run("device.givesScale = true, 0")
    _wait_for_scale(page)
    yield {"case": f"{case}, scale asked for: scale", "value": page.run(SCALE), "unit": "1"}
    yield {"case": f"{case}, scale asked for: pixels", "value": page.run(PIXELS), "unit": "1"}
    yield from _measure(page, f"{case}, scale asked for", BARS["headset"])
    yield {"case": f"{case}, scale asked for: scale at the end", "value": page.run(SCALE), "unit": "1"}
    _save(page, pictures, f"{world.name}-headset-{eyes[0]}-scaled")
    page.run("vinesim.viewer.scene.visible = false, vinesim.viewer.shadowAt = Infinity, 0")
    yield from _measure(page, f"{case}, nothing drawn", None)
    yield from _errors(page)


SCALE = "vinesim.viewer.headset.scale.value"
"""Expression for the share of rows and columns that the page asks a headset for."""
PIXELS = """vinesim.viewer.renderer.xr.getCamera().cameras
  .reduce((sum, { viewport }) => sum + viewport.z * viewport.w, 0)"""
"""Expression for the number of pixels of both eyes in the last picture."""


def _open(page: browser.Page, world: Recorded, address: str) -> None:
    page.resize(1280, 720)
    page.open(address, before=browser.emulated_headset() + VIEWPORT_SCALE)
    _wait(page, "window.vinesim?.viewer !== undefined && vinesim.drawn > 20")
    if (view := VIEWS[world.name]) is not None:
        page.look(*map(np.array, view))


def _wear(page: browser.Page, world: Recorded, address: str, eyes: tuple[int, int]) -> None:
    """Enter a headset on a page that is newly loaded, so that it has not yet measured how much it can draw on a
    screen."""
    _open(page, world, address)
    page.resize(*eyes)
    page.run("vinesim.viewer.resize(), 0")
    page.run("device.position.set(0, 1.6, 0), document.getElementById('enter').click()")
    _wait(page, "vinesim.viewer.headset.isWorn")


def _wait_for_scale(page: browser.Page) -> None:
    """Return when a headset's page has asked for the same scale for ``UNCHANGED`` pictures, or after ``PATIENCE``
    [s]."""
    ask = f"[{SCALE}, vinesim.frames]"
    end = time.monotonic() + PATIENCE
    scale, since = page.run(ask)
    while time.monotonic() < end:
        time.sleep(0.2)
        now, count = page.run(ask)
        if now != scale:
            scale = now
            since = count
        elif count - since >= UNCHANGED:
            break


def _save(page: browser.Page, folder: pathlib.Path | None, name: str) -> None:
    import cv2

    if folder is not None:
        picture = page.picture()[..., ::-1]
        cv2.imwrite(str(folder / f"{name}.jpg"), picture[::2, ::2] if picture.shape[1] > EYES[0] // 2 else picture)


def _errors(page: browser.Page) -> Iterator[dict[str, Any]]:
    for error in page.errors:
        yield {"case": "error of the page", "value": error, "unit": ""}


def _measure(page: browser.Page, case: str, bar: float | None) -> Iterator[dict[str, Any]]:
    time.sleep(SETTLING)
    before = page.run("[vinesim.frames, vinesim.states, performance.now()]")
    time.sleep(SECONDS)
    after = page.run("[vinesim.frames, vinesim.states, performance.now(), vinesim.calls, vinesim.triangles]")
    seconds = 1e-3 * (after[2] - before[2])
    rate = {"case": f"{case}: pictures", "value": (after[0] - before[0]) / seconds, "unit": "Hz"}
    yield rate | ({} if bar is None else {"peer": "bar, at least", "peer_value": bar})
    yield {"case": f"{case}: states", "value": (after[1] - before[1]) / seconds, "unit": "Hz"}
    yield {"case": f"{case}: calls", "value": after[3], "unit": "1"}
    yield {"case": f"{case}: triangles", "value": after[4], "unit": "1"}
    page.run(WAIT_FOR_PIXELS)
    time.sleep(SECONDS)
    whole, script = page.run(DURATIONS)
    yield {"case": f"{case}: a picture, to its last pixel, median", "value": whole, "unit": "ms"}
    yield {"case": f"{case}: of it the page's script", "value": script, "unit": "ms"}


def _wait(page: browser.Page, script: str, patience: float = 120.0) -> None:
    end = time.monotonic() + patience
    while not page.run(script):
        if time.monotonic() > end:
            raise SystemExit(f"waited {patience:.0f} s in vain for: {script}; the page says {page.run(FAILURE)}")
        time.sleep(0.2)


FAILURE = "window.vinesim?.failure ?? document.body.innerText.slice(0, 300)"


def main() -> None:
    """Record, or play a recording and print a line for each figure."""
    parser = argparse.ArgumentParser(description="Pictures a second of the page on a graphics card.")
    parser.add_argument("--record", type=pathlib.Path)
    parser.add_argument("--scene", default="demo", choices=sorted(VIEWS))
    parser.add_argument("--play", type=pathlib.Path)
    parser.add_argument("--software", action="store_true", help="without a graphics card")
    parser.add_argument("--pictures", type=pathlib.Path, help="folder for what the page shows")
    parser.add_argument("--address", help="page of a running client")
    parser.add_argument("--query", default="", help="added to the page's address")
    given = parser.parse_args()
    if given.record is not None:
        record(given.record, given.scene)
    graphics = browser.SOFTWARE if given.software else GPU
    lines: Iterator[dict[str, Any]] = iter(())
    if given.address is not None:
        lines = look_at_client(given.address, graphics, given.pictures)
    elif given.play is not None and given.software:
        lines = play_without_card(given.play, given.pictures)
    elif given.play is not None:
        lines = play(given.play, graphics, given.pictures, given.query)
    for line in lines:
        sys.stdout.write(json.dumps({"bench": "gpu page", **line}) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
