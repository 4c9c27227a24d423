"""Reader of recorded RGB-D pictures: files of rosbag2, without ROS, or folders written by ``vinesim dataset``.

Of ROS messages (CDR, XCDR1), only sensor_msgs/Image and sensor_msgs/CameraInfo are decoded.
"""

from __future__ import annotations

import collections
import dataclasses
import json
import logging
import pathlib
import struct
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from vinesim.core.bag_files import Bag, BagError, open_bag
from vinesim.scene.values import CameraFrame, CameraInfo

log = logging.getLogger(__name__)

LEVEL_POSE = np.array([0.0, 0.0, 0.0, -np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""[7] Pose of the optical frame of a level camera that looks along the world's y axis: x to the right, z up."""
PAIR_TIME = 0.01
"""Largest time [s] between the stamps of a colour picture and of its depth picture."""
IMAGE = "sensor_msgs/msg/Image"
INFO = "sensor_msgs/msg/CameraInfo"
_COLOURS = {"rgb8": (3, [0, 1, 2]), "bgr8": (3, [2, 1, 0]), "rgba8": (4, [0, 1, 2]), "bgra8": (4, [2, 1, 0])}
"""For each encoding: number of channels, and the channels that are red, green and blue."""
_DEPTHS = {"32FC1": "f4", "16UC1": "u2", "mono16": "u2"}
_LENSES = ("plumb_bob", "rational_polynomial", "")


class RecordedPicturesError(ValueError):
    """Error: recorded pictures cannot be used. The message is one line with file, topic and remedy."""


def read_pictures(
    path: pathlib.Path,
    *,
    image: str | None = None,
    depth: str | None = None,
    pose: np.ndarray | None = None,
    rate: float | None = None,
) -> Iterator[CameraFrame]:
    """Yield the pictures of a file of rosbag2 (MCAP, SQLite), a folder of such files, or a data set, sorted by time.

    A colour picture without a depth picture has depth NaN.

    Args:
        path: file or folder.
        image: topic of the colours; by default the only topic with rgb or color in its name. ``camera_info`` is read
            from the same namespace.
        depth: topic of the depth, aligned with the colours; by default the only topic with depth in its name.
        pose: [7] pose of the optical frame in the world; by default that of the data set, or :data:`LEVEL_POSE`.
        rate: pictures a second [Hz] of a data set whose records have no ``time``.

    Raises :class:`RecordedPicturesError` before the first picture if there are no pictures, or at a picture that cannot
    be read.
    """
    if not path.exists():
        raise RecordedPicturesError(f"{path}: is not there; give an MCAP file, a rosbag2 folder or a data set")
    if path.is_dir() and (path / "records").is_dir():
        return _dataset(path, pose, rate)
    try:
        bag = open_bag(path)
    except BagError as bad:
        raise RecordedPicturesError(str(bad)) from None
    return _bag(bag, image, depth, LEVEL_POSE if pose is None else pose)


# ---------------------------------------------------------------------- data sets


def _dataset(folder: pathlib.Path, pose: np.ndarray | None, rate: float | None) -> Iterator[CameraFrame]:
    records = sorted((folder / "records").glob("*.json"))
    if not records:
        raise RecordedPicturesError(f"{folder}/records: is empty; give a data set with pictures")
    for number, file in enumerate(records):
        try:
            record = json.loads(file.read_text("utf-8"))
            camera = record["camera"]
            k = camera["k"]
            own = np.array([*camera["position"], *camera["quaternion_xyzw"]], float)
            lens = tuple(camera["d"]) if any(camera["d"]) else ()
            info = CameraInfo(camera["width"], camera["height"], k[0], k[4], k[2], k[5], "optical", lens)
        except (OSError, ValueError, KeyError, TypeError, IndexError) as bad:
            raise RecordedPicturesError(f"{file}: no record of a camera: {bad!r}; see vinesim dataset") from None
        if "time" not in record and rate is None:
            raise RecordedPicturesError(f"{file}: has no 'time'; say how many pictures a second there are (--rate)")
        time = record["time"] if "time" in record else number / float(rate or 1.0)
        rgb = _png(folder / "images" / f"{file.stem}.png", cv2.IMREAD_COLOR)[..., ::-1]
        millimetres = _png(folder / "measured" / f"{file.stem}.png", cv2.IMREAD_UNCHANGED)
        yield CameraFrame(
            float(time),
            folder.name,
            info,
            own if pose is None else pose,
            rgb,
            _metres(millimetres),
            np.zeros((0, 0), np.int32),
        )


def _png(file: pathlib.Path, flags: int) -> np.ndarray:
    image = cv2.imread(str(file), flags) if file.exists() else None
    if image is None:
        raise RecordedPicturesError(f"{file}: no picture; each record needs one in images/ and one in measured/")
    return image


def _metres(depth: np.ndarray) -> np.ndarray:
    """Returns depth [m], NaN where it is missing, from an array in metres or in 16-bit millimetres (0: missing)."""
    if depth.dtype.kind == "u":
        return np.where(depth > 0, 1e-3 * depth, np.nan).astype(np.float32)
    return np.where(depth > 0.0, depth, np.nan).astype(np.float32)


# ---------------------------------------------------------------------- ROS recordings


def _bag(bag: Bag, image: str | None, depth: str | None, pose: np.ndarray) -> Iterator[CameraFrame]:
    name = bag.path.name
    types = {topic: about.type_name for topic, about in bag.topics.items()}
    if bag.damage:
        log.warning("%s; the pictures before are read", bag.damage)
    known = bag.damage
    image = _choose(name, types, image, ("rgb", "color", "colour"), "--image")
    depth = _choose(name, types, depth, ("depth",), "--depth")
    beside = image.rsplit("/", 1)[0] + "/camera_info"
    if types.get(beside) != INFO:
        raise RecordedPicturesError(
            f"{name}: no topic {beside}, which has the focal length of {image}; record it with the pictures"
        )
    info = None
    waiting = collections.deque()
    depths = collections.deque()
    for topic, _, data in bag.messages({image, depth, beside}):
        try:
            if topic == beside:
                info = info or _read_info(data)
            else:
                (waiting if topic == image else depths).append(_read_image(data))
        except (struct.error, ValueError, KeyError, IndexError, UnicodeDecodeError) as bad:
            raise RecordedPicturesError(f"{name}: a message of {topic} cannot be read: {bad}") from None
        if info is not None:
            yield from _pair(name, image, waiting, depths, info, pose, last=False)
    if bag.damage != known:
        log.warning("%s; the pictures before were read", bag.damage)
    if info is None:
        raise RecordedPicturesError(f"{name}: {beside} has no messages; record it with the pictures")
    yield from _pair(name, image, waiting, depths, info, pose, last=True)


def _choose(name: str, types: dict[str, str], given: str | None, words: tuple[str, ...], option: str) -> str:
    """Returns a topic of images: ``given`` if not None, else the only topic whose name contains one of ``words``.

    ``name``: file, and ``option``: command line option, for error messages; ``types``: message type by topic.
    """
    images = sorted(topic for topic, kind in types.items() if kind == IMAGE)
    if given is not None:
        if given not in images:
            raise RecordedPicturesError(f"{name}: no topic {given} of images; there are: {', '.join(images) or 'none'}")
        return given
    if not images:
        raise RecordedPicturesError(
            f"{name}: has no topic of {IMAGE}; give raw colour and depth, as vinesim ros record writes them"
        )
    found = [topic for topic in images if any(word in topic for word in words)]
    if words != ("depth",):
        found = [topic for topic in found if "depth" not in topic]
    aligned = [topic for topic in found if "aligned" in topic]
    found = aligned if len(aligned) == 1 else found
    if len(found) != 1:
        count = "several topics" if found else "no topic"
        raise RecordedPicturesError(
            f"{name}: {count} of images with {' or '.join(words)} in the name; name one with {option}, of: "
            f"{', '.join(found or images)}"
        )
    return found[0]


def _pair(
    name: str,
    image: str,
    waiting: collections.deque,
    depths: collections.deque,
    info: CameraInfo,
    pose: np.ndarray,
    last: bool,
) -> Iterator[CameraFrame]:
    """Yield the frames of those waiting colour pictures whose depth picture has been read, or can no longer follow.

    ``waiting``, ``depths``: colour and depth pictures that were read but not used yet; ``last``: no more will be read.
    """
    while waiting:
        time, rgb = waiting[0]
        while depths and depths[0][0] < time - PAIR_TIME:
            depths.popleft()
        if not depths and not last:
            return
        waiting.popleft()
        depth = np.full(rgb.shape[:2], np.nan, np.float32)
        if depths and depths[0][0] <= time + PAIR_TIME:
            depth = depths[0][1]
        if rgb.ndim != 3 or depth.ndim != 2 or rgb.shape[:2] != depth.shape or depth.shape != (info.height, info.width):
            raise RecordedPicturesError(
                f"{name}: {image} has {rgb.shape[:2]} pixels, the depth {depth.shape[:2]}, camera_info "
                f"{(info.height, info.width)}; record depth that is aligned with the colours"
            )
        yield CameraFrame(time, image, info, pose, rgb, depth, np.zeros((0, 0), np.int32))


@dataclasses.dataclass(slots=True)
class _Cdr:
    """Reader of a serialised CDR message, member by member."""

    data: bytes
    at: int = 4
    """Index of the next byte to read; reading starts after the encapsulation header, from which alignment counts."""

    def number(self, code: str) -> Any:
        size = struct.calcsize(code)
        self.at += -(self.at - 4) % size
        (value,) = struct.unpack_from(("<" if self.data[1] & 1 else ">") + code, self.data, self.at)
        self.at += size
        return value

    def block(self) -> bytes:
        size = self.number("I")
        if self.at + size > len(self.data):
            raise ValueError("it is cut off")
        self.at += size
        return self.data[self.at - size : self.at]

    def text(self) -> str:
        return self.block().rstrip(b"\0").decode()

    def stamp(self) -> float:
        """Read a std_msgs/Header and return its stamp [s]; the frame id is skipped."""
        time = self.number("i") + 1e-9 * self.number("I")
        self.text()
        return time


def _read_image(data: bytes) -> tuple[float, np.ndarray]:
    """Returns the stamp [s] of a serialised image message, and its colours [height, width, 3] uint8 or its depth
    [height, width] m."""
    cdr = _Cdr(data)
    time = cdr.stamp()
    height = cdr.number("I")
    width = cdr.number("I")
    encoding = cdr.text()
    order = "><"[not cdr.number("B")]
    step = cdr.number("I")
    rows = np.frombuffer(cdr.block(), np.uint8).reshape(height, step)
    if encoding in _COLOURS:
        channels, order = _COLOURS[encoding]
        return time, rows[:, : width * channels].reshape(height, width, channels)[..., order]
    if encoding in _DEPTHS:
        kind = np.dtype(order + _DEPTHS[encoding])
        return time, _metres(np.ascontiguousarray(rows[:, : width * kind.itemsize]).view(kind))
    raise ValueError(f"encoding {encoding!r}; give {', '.join((*_COLOURS, *_DEPTHS))}")


def _read_info(data: bytes) -> CameraInfo:
    cdr = _Cdr(data)
    cdr.stamp()
    height = cdr.number("I")
    width = cdr.number("I")
    model = cdr.text()
    lens = tuple(cdr.number("d") for _ in range(cdr.number("I")))
    k = [cdr.number("d") for _ in range(9)]
    if k[0] <= 0.0:
        raise ValueError("the focal length is 0; calibrate the camera")
    if any(lens) and (model not in _LENSES or len(lens) not in (5, 8)):
        raise ValueError(f"distortion {model!r} with {len(lens)} coefficients; give rectified pictures")
    return CameraInfo(width, height, k[0], k[4], k[2], k[5], "optical", lens if any(lens) else ())
