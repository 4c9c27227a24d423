"""PNG files of pictures: colour, depth (as colours and as millimetres), label colours; overview pictures of a scene."""

from __future__ import annotations

import pathlib

import cv2
import numpy as np

from vinesim.core import frames
from vinesim.scene.camera_geometry import depth_millimetres
from vinesim.scene.ids import LABEL_STRIDE, Organ
from vinesim.scene.model import Model
from vinesim.scene.terrain import ground_height
from vinesim.scene.values import CameraFrame, CameraInfo, Snapshot
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.camera.sunlight import DEFAULT_SUN
from vinesim.sensors.export.files import write_files
from vinesim.sensors.primitives.scene_primitives import Primitives


def look_at(eye: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Returns the pose [7] of an optical frame at ``eye`` [3] m that looks at the point ``at`` [3] m, with a level
    horizon."""
    eye = np.asarray(eye, float)
    at = np.asarray(at, float)
    forward = frames.normalize(at - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = frames.normalize(right) if np.linalg.norm(right) > 1e-6 else np.array([1.0, 0.0, 0.0])
    turn = frames.from_matrix(np.stack([right, np.cross(forward, right), forward], -1))
    return frames.pose(eye, turn)


def depth_colours(depth: np.ndarray, farthest: float = 6.0) -> np.ndarray:
    """Returns depth [height, width] m as RGB: from red (near) to blue (``farthest`` [m]), NaN black, beyond range
    white."""
    with np.errstate(invalid="ignore"):
        share = np.clip(1.0 - depth / farthest, 0.0, 1.0)
    tone = np.nan_to_num(share, nan=0.0, posinf=1.0, neginf=0.0) * 255.0
    colours = cv2.applyColorMap(tone.astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    colours[~np.isfinite(depth)] = 0
    colours[np.isposinf(depth)] = 255
    return colours


_ORGAN_COLOUR = {
    Organ.NOTHING: (0, 0, 0),
    Organ.GROUND: (110, 85, 60),
    Organ.POLE: (160, 160, 160),
    Organ.WIRE: (220, 220, 220),
    Organ.TRUNK: (105, 60, 25),
    Organ.ARM: (150, 90, 40),
    Organ.CANE: (205, 140, 70),
    Organ.LEAF: (60, 150, 50),
    Organ.PEDUNCLE: (255, 255, 0),
    Organ.BUNCH: (190, 30, 140),
    Organ.BOX: (40, 90, 230),
    Organ.ROBOT: (235, 235, 235),
    Organ.HUMAN: (250, 120, 40),
    Organ.SPUR: (120, 100, 90),
    Organ.NODE: (70, 200, 220),
    Organ.BUD: (255, 60, 60),
}


def label_colours(labels: np.ndarray) -> np.ndarray:
    """Returns labels [height, width] as RGB: a colour for each organ, varied in brightness (for bunches in hue) by
    instance."""
    organ = labels // LABEL_STRIDE
    index = labels % LABEL_STRIDE
    table = np.array([_ORGAN_COLOUR[o] for o in Organ], np.float32)
    bright = 0.7 + 0.3 * ((index * 0.618034) % 1.0)
    colours = table[organ] * bright[..., None]
    bunch = organ == int(Organ.BUNCH)
    hue = (index[bunch] * 0.618034 * 180.0 % 180.0).astype(np.uint8)
    hsv = np.stack([hue, np.full_like(hue, 200), np.full_like(hue, 255)], -1)[None]
    if bunch.any():
        colours[bunch] = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0]
    return colours.astype(np.uint8)


def encode_png(image: np.ndarray) -> bytes:
    """Returns an image, RGB uint8, or grey uint8 or uint16, encoded as PNG; :class:`ValueError` for other types."""
    data = image[..., ::-1] if image.ndim == 3 else image
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(data))
    if not done:
        raise ValueError(
            f"an image of shape {image.shape}, {image.dtype}, cannot be a PNG; give uint8 RGB, or uint8 or uint16 grey"
        )
    return encoded.tobytes()


def write_png(path: str | pathlib.Path, image: np.ndarray) -> pathlib.Path:
    """Write an image, RGB uint8 or grey uint16, as a PNG file. Raises :class:`OSError` without leaving a partial
    file."""
    path = pathlib.Path(path)
    write_files({path: [encode_png(image)]})
    return path


def save_frame(frame: CameraFrame, folder: str | pathlib.Path, stem: str = "frame") -> list[pathlib.Path]:
    """Write the PNG files ``<stem>_rgb``, ``<stem>_depth`` (colours), ``<stem>_depth_mm`` (16UC1) and
    ``<stem>_labels``.

    With an empty ``stem`` the names are ``rgb.png`` and so on. Returns the paths.
    """
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    images = {
        "rgb": frame.rgb,
        "depth": depth_colours(frame.depth),
        "depth_mm": depth_millimetres(frame.depth),
        "labels": label_colours(frame.labels),
    }
    prefix = f"{stem}_" if stem else ""
    return [write_png(folder / f"{prefix}{name}.png", image) for name, image in images.items()]


def overview_pose(model: Model) -> np.ndarray:
    """Returns the pose [7] of an optical frame for an overview of a scene: in the alley, at eye height, looking along
    the rows."""
    spots = np.concatenate([model.tree_pose[:, :2], model.fixed_start[:, :2], model.fixed_end[:, :2], np.zeros((1, 2))])
    low = spots.min(0)
    high = spots.max(0)
    middle = 0.5 * (low + high)
    eye = np.array([low[0] - 0.6, middle[1] - 0.25, 1.45])
    target = np.array([high[0], middle[1] + 0.1, 1.40])
    for point in (eye, target):
        point[2] += ground_height(model.terrain, *point[:2])
    return look_at(eye, target)


def render_overview(
    model: Model,
    snapshot: Snapshot,
    out: str | pathlib.Path | None = None,
    *,
    pose: np.ndarray | None = None,
    width: int = 960,
    height: int = 640,
    view_angle: float = 1.2,
    sun: tuple[float, float, float] = DEFAULT_SUN,
    quality: str = "still",
    primitives: Primitives | None = None,
) -> np.ndarray:
    """Render a picture of a scene [height, width, 3] uint8, and write it to the file ``out`` if given.

    ``pose``: [7] pose of the optical frame (default :func:`overview_pose`); ``view_angle``: horizontal field of view
    [rad].
    """
    primitives = primitives or Primitives(model)
    primitives.update(snapshot)
    focal = 0.5 * width / np.tan(0.5 * view_angle)
    info = CameraInfo(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), "portrait")
    camera = Camera(CameraSpec.load("pinhole"), info, "portrait", sun, quality=quality)
    image = camera.render(primitives, overview_pose(model) if pose is None else pose, snapshot.time).rgb
    if out is not None:
        write_png(out, image)
    return image
