"""The page and a camera at the same place show plants in about the same light."""

import dataclasses

import cv2
import numpy as np
import pytest

from tests.support.waiting import wait
from vinesim.client.page.page_world import PageWorld
from vinesim.client.spectator import Spectator
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ, unlabel
from vinesim.scene.spec import load_scene
from vinesim.scene.values import CameraOutput
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.web.page_server import PageServer

VIEWS = {
    "demo": ((-0.6, 0.3, 1.5), (0.4, 0.75, 1.78)),
    "vsp": ((0.4, 1.0, 0.95), (0.5, 0.0, 1.0)),
    "slope": ((1.6, 0.9, 1.2), (2.0, 0.0, 1.1)),
}
"""By scene: where the eyes are, and a point that they look at [m]: bunches, leaves and wood are near."""
SIZE = (480, 270)
KINDS = {
    "bunches": (Organ.BUNCH,),
    "leaves": (Organ.LEAF,),
    "wood": (Organ.POLE, Organ.TRUNK, Organ.ARM, Organ.CANE),
    "ground": (Organ.GROUND,),
}
MOST = 0.2
"""Share by which the mean luminance of a kind may differ. 0.143 at most was seen: texels of the page's shadows are 9 mm
wide, those of the camera 3.5 mm, and the page's exposure is fixed."""
MOST_WITHOUT_CARD = {"bunches": 0.3, "leaves": 0.3, "wood": 0.5, "ground": 0.2}
"""The same for each kind on a page without a graphics card. 0.23, 0.22, 0.41 and 0.08 were seen: texels of the shadows
are twice as wide, and leaves are lit at their corners."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def luminance(picture):
    """Relative luminance [row, column] of an sRGB picture."""
    c = picture / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) @ LUMINANCE


def camera_picture(client, eye, target):
    """What a camera with the page's angle of view sees, and the organ at each pixel."""
    spec = CameraSpec.load("pinhole")
    focal = 0.5 * SIZE[1] / np.tan(np.radians(30.0))
    info = dataclasses.replace(spec.info("eyes", size=SIZE), fx=focal, fy=focal)
    primitives = Primitives(client.model)
    primitives.update(client.physics.snapshot())
    camera = Camera(spec, info, quality="still", sun=tuple(client.scene.sun.direction(0.0)))
    frame = camera.render(primitives, look_at(eye, target), outputs=CameraOutput.RGB | CameraOutput.LABELS)
    known = {int(label): int(unlabel(int(label))[0]) for label in np.unique(frame.labels)}
    return frame.rgb, np.vectorize(known.get)(frame.labels)


def page_picture(page, client, eye, target, *, has_card):
    """What the page shows there, without its controls. ``has_card``: whether it draws as with a graphics card."""
    world = PageWorld(client)
    with PageServer(world) as server:
        page.resize(*SIZE)
        page.open(server.address + "?triangles=300000&rate=2")
        wait(lambda: page.run("window.vinesim?.viewer !== undefined || window.vinesim?.failure"), "the page is there")
        assert page.run("vinesim.failure") is None
        page.run("['frame', 'names'].forEach((id) => { document.getElementById(id).style.visibility = 'hidden'; })")
        if not has_card:
            page.run("vinesim.viewer.world.simplify(), 0")
        page.look(eye, target)
        page.run("vinesim.viewer.world.listedAt = null, 0")
        drawn = page.run("vinesim.frames")
        wait(lambda: page.run("vinesim.frames") > drawn + 5, "a picture with shadows of what is drawn")
        failed = (
            "vinesim.viewer.renderer.info.programs.filter(({ diagnostics }) => diagnostics?.runnable === false).length"
        )
        assert page.run(failed) == 0, "all shaders are accepted"
        assert page.errors == []
        return page.picture()


@pytest.mark.long
@pytest.mark.xdist_group("browser")
@pytest.mark.parametrize("has_card", [True, False], ids=["graphics card", "none"])
@pytest.mark.parametrize("name", VIEWS)
def test_bunches_leaves_and_wood_are_as_bright_as_in_a_camera(name, has_card, page):
    eye, target = map(np.array, VIEWS[name])
    scene = load_scene(name)
    with MemoryHub().bus("viewer") as bus:
        client = Spectator(scene, generate(scene), None, bus, name="viewer", pose=frames.pose(eye))
        seen, organ = camera_picture(client, eye, target)
        shown = page_picture(page, client, eye, target, has_card=has_card)
    page_light = luminance(shown)
    camera_light = luminance(seen)
    found = {}
    for kind, organs in KINDS.items():
        # edges are where pixels of the two may show different things
        inside = cv2.erode(np.isin(organ, organs).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        assert inside.sum() > 500, kind
        found[kind] = float(page_light[inside].mean() / camera_light[inside].mean())
    most = dict.fromkeys(KINDS, MOST) if has_card else MOST_WITHOUT_CARD
    assert all(abs(ratio - 1.0) < most[kind] for kind, ratio in found.items()), found
