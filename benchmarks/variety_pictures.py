"""A picture of one bunch of each variety, and of bunches in other states, for docs/sensors.md:
``python -m benchmarks.variety_pictures docs/pictures/varieties.jpg``"""

from __future__ import annotations

import sys
from typing import Any

import cv2
import msgspec
import numpy as np

from vinesim.scene.berries import VARIETIES
from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.ids import Organ, label
from vinesim.scene.spec import Fruit, Season, load_scene
from vinesim.scene.values import CameraInfo
from vinesim.sensors import ground_truth
from vinesim.sensors.export.images import look_at, render_overview
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot

SIZE = 240
"""Width and height of the picture of a bunch [px]."""
STATES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("chardonnay", {"ripeness": (0.0, 0.1)}),
    ("syrah", {"ripeness": (0.0, 0.1)}),
    ("cabernet-sauvignon", {"ripeness": (0.45, 0.55)}),
    ("merlot", {"ripeness": (0.6, 0.7)}),
    ("riesling", {"rot": 1.0}),
    ("merlot", {"rot": 1.0}),
    ("chardonnay", {"shrivelled": 1.0}),
    ("syrah", {"shrivelled": 1.0}),
    ("sauvignon-blanc", {"sunburn": 1.0}),
)


def picture(variety: str, fruit: dict[str, Any]) -> np.ndarray:
    """Returns a picture [SIZE, SIZE, 3] of the bunch that is least hidden from the alley."""
    scene = load_scene("vsp")
    layout = msgspec.structs.replace(scene.layout, rows=1, vines=2)
    kinds = Fruit(bunches=(16, 20), varieties=(variety,), **fruit)
    scene = msgspec.structs.replace(scene, layout=layout, boxes=(), season=Season(leafiness=0.35), fruit=kinds)
    model = generate_uncached(scene)
    snapshot = rest_snapshot(model)
    primitives = Primitives(model, grass=20.0)
    primitives.update(snapshot)
    shown = []
    poses = []
    angles = 2.0 * np.arctan(0.75 * model.bunch_length.astype(float) / 0.7)
    for bunch, angle in enumerate(angles):
        middle = snapshot.body_q[model.bunch_body[bunch], :3].astype(float)
        middle[2] -= 0.5 * model.bunch_length[bunch]
        poses.append(look_at(middle + np.array([-0.1, -0.7, 0.05]), middle))
        focal = 32.0 / np.tan(0.5 * angle)
        info = CameraInfo(64, 64, focal, focal, 31.5, 31.5, "thumb")
        labels = ground_truth.render_buffers(primitives, info, poses[-1]).labels
        shown.append(int((labels == label(Organ.BUNCH, bunch)).sum()))
    best = int(np.argmax(shown))
    sun = np.array([0.2, -0.5, 0.9]) / np.linalg.norm([0.2, -0.5, 0.9])
    options: dict[str, Any] = {"width": SIZE, "height": SIZE, "view_angle": angles[best], "sun": tuple(sun)}
    return render_overview(model, snapshot, pose=poses[best], primitives=primitives, **options)


def main(path: str) -> None:
    pictures = [picture(*one) for one in [(kind.name, {}) for kind in VARIETIES] + list(STATES)]
    sheet = np.vstack([np.hstack(pictures[i : i + 6]) for i in range(0, len(pictures), 6)])
    cv2.imwrite(path, sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main(sys.argv[1])
