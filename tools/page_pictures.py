"""Write ``docs/pictures/page-*.jpg``: the page beside what a camera sees from the same place.

    python tools/page_pictures.py [SCENE ...]

Takes minutes without a graphics card. Needs chromium and what ``tools/build_page`` installs.
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import time
from collections.abc import Iterator

import cv2
import numpy as np

from benchmarks.support.browser import Page, browser_page, emulated_headset
from vinesim.avatar.gestures import GESTURES
from vinesim.client.page.page_world import PageWorld
from vinesim.client.spectator import Spectator
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.robot.description.loader import load_description
from vinesim.scene.appearance import apply_posture
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.scene.values import CameraOutput, HumanSpec
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.web.page_server import PageServer

ROOT = pathlib.Path(__file__).resolve().parent.parent
TARGET = ROOT / "docs" / "pictures"
VIEWS = {"demo": ((0.2, 0.9, 1.6), (3.0, 1.5, 1.25)), "vsp": ((1.2, 1.3, 1.6), (5.0, 1.3, 1.0))}
"""By scene: where the eyes are, and a point that they look at [m]."""
SIZES = {"desktop": (1280, 720), "phone": (390, 844)}
IN_HEADSET = (1280, 640)
"""Of both eyes [px]."""
FIELD = 60.0
"""Vertical angle of view of the page [degrees]."""
PATIENCE = 300.0
"""[s]"""


def inhabited(name: str) -> Spectator:
    """A spectator of a scene in which a robot stands, and a person points at what is beside it."""
    scene = load_scene(name)
    eye, target = map(np.array, VIEWS[name])
    ahead = (target - eye) * [1.0, 1.0, 0.0] / np.linalg.norm((target - eye)[:2])
    left = np.array([-ahead[1], ahead[0], 0.0])
    ground = eye * [1.0, 1.0, 0.0]
    client = Spectator(scene, generate(scene), None, MemoryHub().bus("viewer"), name="viewer", pose=frames.pose(eye))
    root = frames.pose(ground + 2.1 * ahead - 0.45 * left, frames.from_yaw(np.arctan2(-ahead[1], -ahead[0]) - 0.5))
    pose = apply_posture(standing_pose(root), "pick", 1.75)
    client.physics.add_human(HumanSpec("anna", 1, dataclasses.replace(pose, right_fingers=GESTURES["point"])))
    facing = frames.from_yaw(np.arctan2(-ahead[1], -ahead[0]) + 0.4)
    base = frames.pose(ground + 3.2 * ahead + 0.35 * left, facing)
    client.physics.rigid.add_robot(load_description("vinebot").to_spec("vinebot", pose=base))
    return client


def as_camera(client: Spectator, pose: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """[row, column, 3] RGB as a camera with the page's angle of view sees it."""
    spec = CameraSpec.load("pinhole")
    focal = 0.5 * size[1] / np.tan(np.radians(0.5 * FIELD))
    info = dataclasses.replace(spec.info("eyes", size=size), fx=focal, fy=focal)
    primitives = Primitives(client.model)
    primitives.update(client.physics.snapshot())
    sun = client.scene.sun.direction(0.0)
    camera = Camera(spec, info, quality="still", sun=tuple(sun))
    return camera.render(primitives, pose, outputs=CameraOutput.RGB).rgb


class Photographer:
    """A browser before the page of a client, which steps while the browser draws."""

    def __init__(self, client: Spectator, page: Page) -> None:
        self.client = client
        self.page = page
        self.world = PageWorld(client)

    def wait(self, script: str) -> None:
        """Step until a script is true in the page."""
        end = time.monotonic() + PATIENCE
        while not self.page.run(script):
            if time.monotonic() > end:
                raise SystemExit(f"waited {PATIENCE:.0f} s in vain for: {script}")
            self.client.tick()
            self.world.collect(self.server)
            time.sleep(0.2)

    def settled(self) -> np.ndarray:
        """The page's picture when so many more were drawn that the shadows are of now."""
        self.wait(f"vinesim.frames > {self.page.run('vinesim.frames')} + 5")
        return self.page.picture()

    def photographs(self, name: str) -> Iterator[tuple[str, np.ndarray]]:
        """Names and pictures of the page in all sizes, beside the camera's, and in a headset."""
        page = self.page
        (eye, target) = map(np.array, VIEWS[name])
        with PageServer(self.world) as self.server:
            page.open(self.server.address + "?triangles=300000&rate=1", before=emulated_headset())
            self.wait("window.vinesim?.viewer !== undefined")
            page.look(eye, target)
            for passing in ("notices", "state"):  # what they say is of this slow browser
                page.run(f"document.getElementById('{passing}').style.visibility = 'hidden'")
            self.wait("vinesim.viewer.world.rigidVersion > 0")
            for kind, size in SIZES.items():
                page.resize(*size)
                picture = self.settled()
                yield kind, np.hstack([picture, as_camera(self.client, look_at(eye, target), size)])
            page.resize(*IN_HEADSET)
            page.run("device.position.set(0, 1.6, 0), document.getElementById('enter').click()")
            self.wait("vinesim.viewer.headset.isWorn")
            page.run("document.querySelectorAll('.panel, #enter').forEach((one) => { one.style.display = 'none'; })")
            yield "headset", self.settled()


def main() -> None:
    """Write the pictures of the given scenes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=list(VIEWS))
    for name in parser.parse_args().scenes:
        with browser_page() as page:
            for kind, picture in Photographer(inhabited(name), page).photographs(name):
                path = TARGET / f"page-{name}-{kind}.jpg"
                cv2.imwrite(str(path), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 65])
                print(path.relative_to(ROOT), flush=True)


if __name__ == "__main__":
    main()
