"""Reader of tours: RGB-D pictures with poses, as ``vinesim render`` and ``vinesim dataset`` write them."""

from __future__ import annotations

import dataclasses
import json
import pathlib
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from vinesim.scene.values import CameraFrame, CameraInfo


class TourError(ValueError):
    """A tour cannot be read. The message is one line with the file and the remedy."""


@dataclasses.dataclass(frozen=True, slots=True)
class Vineyard:
    """What determines the shape of a vineyard in a picture."""

    digest: str
    seed: int
    motion: str
    """Wind and simulated time as JSON; empty in calm air."""


@dataclasses.dataclass(frozen=True, slots=True)
class TourPicture:
    """Files of one picture of a tour."""

    record: pathlib.Path
    """JSON file with intrinsics and pose: ``camera.json``, or the record of a data set's image."""
    files: dict[str, pathlib.Path]
    """PNG files: ``rgb``, ``depth`` (exact, mm), ``measured`` (mm) and ``labels``."""

    def vineyard(self) -> Vineyard | None:
        """Returns the vineyard that the picture shows; None if no file says so. Raises :class:`TourError`."""
        file = self.record.with_name("truth.json") if self.record.name == "camera.json" else self.record
        if not file.exists():
            return None
        try:
            record = json.loads(file.read_text("utf-8"))
            scene = record if "digest" in record else record["scene"]
            wind = record.get("wind")
            motion = "" if wind is None else json.dumps([wind, record.get("time")])
            return Vineyard(scene["digest"], scene["seed"], motion)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as bad:
            raise TourError(f"{file}: no scene with digest and seed: {bad!r}") from None

    def read(self) -> CameraFrame:
        """Returns the picture. Raises :class:`TourError` if a file is missing or invalid."""
        try:
            record = json.loads(self.record.read_text("utf-8"))
            camera = record.get("camera", record)
            k = camera["k"]
            pose = np.array([*camera["position"], *camera["quaternion_xyzw"]], float)
            lens = tuple(camera["d"]) if any(camera["d"]) else ()
            info = CameraInfo(camera["width"], camera["height"], k[0], k[4], k[2], k[5], "optical", lens)
            if pose.shape != (7,):
                raise ValueError("the pose has not 7 numbers")
        except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError) as bad:
            raise TourError(f"{self.record}: no camera with k, d, position and quaternion_xyzw: {bad!r}") from None
        rgb = self._image("rgb", info)[..., ::-1]
        encoded = self._image("labels", info).astype(np.int32)
        return CameraFrame(
            time=0.0,
            name=self.record.parent.name if self.record.name == "camera.json" else self.record.stem,
            info=info,
            pose=pose,
            rgb=np.ascontiguousarray(rgb),
            depth=_metres(self._image("measured", info)),
            labels=encoded[..., 2] | encoded[..., 1] << 8 | encoded[..., 0] << 16,
            exact_depth=_metres(self._image("depth", info)),
        )

    def _image(self, name: str, info: CameraInfo) -> np.ndarray:
        file = self.files[name]
        kind = cv2.IMREAD_UNCHANGED if name in ("depth", "measured") else cv2.IMREAD_COLOR
        image: Any = cv2.imread(str(file), kind) if file.exists() else None
        if image is None:
            raise TourError(f"{file}: no picture; render the tour again")
        if image.shape[:2] != (info.height, info.width):
            size = f"{image.shape[1]}x{image.shape[0]}"
            raise TourError(f"{file}: {size} px, but {self.record.name} has {info.width}x{info.height}")
        return image


def open_tour(folder: str | pathlib.Path) -> list[TourPicture]:
    """Returns the pictures of a tour in order.

    A tour is a folder that ``vinesim render --path`` has written (folders ``0000``, ``0001``, ...), one picture of
    ``vinesim render``, or a data set of ``vinesim dataset``. Raises :class:`TourError` if there is none.
    """
    folder = pathlib.Path(folder)
    records = [folder / "camera.json"] if (folder / "camera.json").exists() else sorted(folder.glob("*/camera.json"))
    names = ("rgb", "depth", "measured", "labels")
    found = [TourPicture(one, {name: one.with_name(f"{name}.png") for name in names}) for one in records]
    if not found:
        kinds = dict(zip(names, ("images", "depth", "measured", "ids"), strict=True))
        found = [
            TourPicture(one, {name: folder / kind / f"{one.stem}.png" for name, kind in kinds.items()})
            for one in sorted((folder / "records").glob("*.json"))
        ]
    if not found:
        what = "is not there" if not folder.exists() else "has neither */camera.json nor records/"
        raise TourError(f"{folder} {what}; write a tour by: vinesim render SCENE --path FILE --out {folder}")
    return found


def check_one_vineyard(pictures: Sequence[TourPicture]) -> None:
    """Raise :class:`TourError` if two pictures show different vineyards, or one vineyard in different wind."""
    first: tuple[TourPicture, Vineyard] | None = None
    for picture in pictures:
        shown = picture.vineyard()
        if shown is None:
            continue
        first = first or (picture, shown)
        if shown != first[1]:
            what = f"vineyards (seeds {first[1].seed} and {shown.seed})"
            if shown.digest == first[1].digest:
                what = "moments of the wind"
            raise TourError(
                f"{first[0].record} and {picture.record} show different {what}; write a tour of one vineyard by: "
                "vinesim render SCENE --path FILE --out FOLDER"
            )


def _metres(millimetres: np.ndarray) -> np.ndarray:
    """Returns depth [m] from 16-bit millimetres; NaN where there is none (0)."""
    return np.where(millimetres > 0, millimetres * np.float32(1e-3), np.float32(np.nan)).astype(np.float32)
