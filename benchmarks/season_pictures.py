"""Pictures for docs/season.md: one vine by date, and dormant vines with their labels:
``python -m benchmarks.season_pictures docs/pictures``"""

from __future__ import annotations

import datetime
import pathlib
import sys

import cv2
import msgspec
import numpy as np

from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import Layout, Scene, Season, load_scene
from vinesim.scene.values import CameraInfo
from vinesim.sensors import ground_truth
from vinesim.sensors.export.images import label_colours, look_at, render_overview
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot

DATES = ((1, 15), (4, 24), (5, 10), (5, 31), (7, 22), (9, 15), (11, 8))
"""Months and days of the strip: dormant, buds burst, young shoots, after flowering, veraison, harvest, autumn."""
TILE = (272, 400)
"""Width and height of a picture of the strip [px]."""
WIDE = (640, 480)
"""Width and height of a picture of dormant vines [px]."""
SUN = (0.25, -0.75, 0.61)


def strip(scene: Scene) -> np.ndarray:
    """Returns the pictures of one vine by date, side by side [height, width, 3] RGB."""
    tiles = []
    layout = Layout(rows=2, vines=3, row_spacing=2.6, vine_spacing=2.0, height=0.85)
    for month, day in DATES:
        date = datetime.date(2026, month, day)
        pulled = Season(leafiness=0.85, fruit_zone_leafiness=0.25)
        dated = msgspec.structs.replace(scene, date=date, layout=layout, season=pulled, spawns=())
        tile = _picture(dated, (2.55, -2.5, 1.3), (2.6, 0.0, 1.25), TILE, 0.66)[0]
        tile = tile.copy()
        cv2.putText(tile, f"{date:%-d %b}", (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 255), 2, cv2.LINE_AA)
        tiles.append(tile)
    return np.concatenate(tiles, 1)


def dormant() -> np.ndarray:
    """Returns pictures of dormant vines pruned to spurs and to canes, and of their labels [height, width, 3] RGB."""
    rows = []
    for name, near, at in (
        ("winter_spur", (2.55, -0.62, 1.05), (2.75, 0.0, 0.98)),
        ("winter_cane", (2.25, -0.72, 1.0), (2.2, 0.0, 0.95)),
    ):
        scene = load_scene(name)
        far = _picture(scene, (2.4, -2.4, 1.35), (3.4, 0.0, 1.1), WIDE, 1.05)[0]
        close, labels = _picture(scene, near, at, WIDE, 0.9)
        rows.append(np.concatenate([far, close, labels], 1))
    return np.concatenate(rows)


def _picture(
    scene: Scene, at: tuple[float, float, float], to: tuple[float, float, float], size: tuple[int, int], angle: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns a picture and its coloured labels [height, width, 3] RGB. ``angle``: [rad] horizontal angle of view."""
    model = generate(scene)
    snapshot = rest_snapshot(model)
    primitives = Primitives(model)
    pose = look_at(np.array(at), np.array(to))
    sun = tuple((np.array(SUN) / np.linalg.norm(SUN)).tolist())
    width, height = size
    rgb = render_overview(
        model, snapshot, pose=pose, width=width, height=height, view_angle=angle, sun=sun, primitives=primitives
    )
    focal = 0.5 * width / np.tan(0.5 * angle)
    info = CameraInfo(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), "picture")
    return rgb, label_colours(ground_truth.render_buffers(primitives, info, pose).labels)


if __name__ == "__main__":
    folder = pathlib.Path(sys.argv[1])
    quality = [cv2.IMWRITE_JPEG_QUALITY, 88]
    cv2.imwrite(str(folder / "season.jpg"), strip(load_scene("winter_spur"))[..., ::-1], quality)
    cv2.imwrite(str(folder / "winter.jpg"), dormant()[..., ::-1], quality)
