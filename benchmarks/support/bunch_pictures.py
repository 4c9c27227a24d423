"""Pictures of grapes with the pixels of each bunch: photographs, data sets of ``vinesim dataset``, and packs of both.

Only numpy and Pillow are needed, except for data sets: a pack can be read on a computer without vinesim's other
packages.
"""

from __future__ import annotations

import dataclasses
import io
import json
import pathlib
import re
import zipfile
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from vinesim.core.errors import UsageError, writing

LONGEST_SIDE = 768
"""[px] Width or height, whichever is larger, to which larger pictures are reduced."""
PHOTOGRAPH_SUFFIXES = (".jpg", ".jpeg")
_PACK_FORMAT = 1
_CONTENTS = "contents.json"


@dataclasses.dataclass(frozen=True, slots=True)
class BunchPicture:
    """A picture, and where its bunches are."""

    name: str
    rgb: np.ndarray
    """[height, width, 3] uint8."""
    bunches: np.ndarray | None
    """[height, width] uint16: 0 where there is no bunch, k on bunch k. None: nobody has marked the bunches' pixels."""
    boxes: np.ndarray
    """[n, 4] px: left, top, right, bottom of each bunch, as edges between pixels."""

    @property
    def group(self) -> str:
        """The first word of the name, which is the variety in the names of WGISD: ``CDY`` of ``CDY_2015``."""
        found = re.search(r"[A-Za-z]+", self.name)
        return found.group() if found else ""


def read_photographs(folder: pathlib.Path) -> list[BunchPicture]:
    """Returns the photographs in a folder with the layout of WGISD, in order of their names.

    ``STEM.jpg`` is a photograph. Its masks are ``STEM.png`` (0 is no bunch, k is bunch k; a mask of two values has one
    bunch for each connected part) or ``STEM.npz`` (an array [height, width, bunches]). Its boxes are ``STEM.txt``
    (lines ``class x y width height``: middle and size in shares of the picture); without that file they are those of
    the masks. Raises :class:`UsageError` for a folder without photographs, or with a file that cannot be read.
    """
    if not folder.is_dir():
        raise UsageError(f"--photos {folder}: there is no such folder; give one with photographs *.jpg")
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in PHOTOGRAPH_SUFFIXES)
    if not files:
        raise UsageError(f"--photos {folder} holds no photograph *.jpg; give a folder with photographs and their masks")
    return [_read_photograph(file) for file in files]


def read_dataset(folder: pathlib.Path, limit: int | None = None, skip: int = 0) -> list[BunchPicture]:
    """Returns the pictures of a folder of ``vinesim dataset`` without the first ``skip``, at most ``limit``.

    Raises :class:`UsageError` for a folder that holds none, or with a file that cannot be read.
    """
    files = sorted((folder / "images").glob("*.png")) if folder.is_dir() else []
    if not files:
        raise UsageError(f"--synthetic {folder} holds no pictures; give a folder that `vinesim dataset` has written")
    if skip >= len(files):
        raise UsageError(f"--skip is {skip}, but --synthetic {folder} holds {len(files)} pictures; skip fewer")
    pictures = []
    for file in files[skip : None if limit is None else skip + limit]:
        ids = folder / "ids" / f"{file.stem}.png"
        if not ids.is_file():
            raise UsageError(f"--synthetic {folder}: {ids} is missing; run `vinesim dataset` again to complete it")
        bunches = _bunches_of_ids(_pixels(ids, "RGB"))
        pictures.append(_picture(file.stem, _pixels(file, "RGB"), bunches, None, ids))
    return pictures


def _bunches_of_ids(ids: np.ndarray) -> np.ndarray:
    """Returns the number of the bunch of each pixel, from an image [height, width, 3] of labels."""
    from vinesim.scene.ids import LABEL_STRIDE, Organ  # not needed where packs are read

    labels = ids.astype(np.int64) @ [1, 256, 65536]
    is_bunch = labels // LABEL_STRIDE == Organ.BUNCH
    numbers = np.zeros(labels.shape, np.uint16)
    numbers[is_bunch] = np.unique(labels[is_bunch], return_inverse=True)[1] + 1
    return numbers


def _read_photograph(file: pathlib.Path) -> BunchPicture:
    rgb = _pixels(file, "RGB")
    mask = next((m for m in (file.with_suffix(".png"), file.with_suffix(".npz")) if m.is_file()), None)
    if mask is None:
        bunches = None
    elif mask.suffix == ".png":
        bunches = _numbered(_pixels(mask))
    else:
        bunches = _merged(mask)
    boxes = file.with_suffix(".txt")
    return _picture(file.stem, rgb, bunches, _read_boxes(boxes, rgb.shape) if boxes.is_file() else None, mask)


def _picture(
    name: str, rgb: np.ndarray, bunches: np.ndarray | None, boxes: np.ndarray | None, mask: pathlib.Path | None
) -> BunchPicture:
    """Returns a picture with a longest side of at most ``LONGEST_SIDE``."""
    if bunches is not None and bunches.shape != rgb.shape[:2]:
        sizes = f"{bunches.shape[1]}x{bunches.shape[0]} px, but its picture {rgb.shape[1]}x{rgb.shape[0]}"
        raise UsageError(f"{mask} has {sizes}; give a mask of the same size")
    height, width = rgb.shape[:2]
    scale = min(LONGEST_SIDE / max(height, width), 1.0)
    if scale < 1.0:
        size = (max(round(width * scale), 1), max(round(height * scale), 1))
        rgb = np.asarray(Image.fromarray(rgb).resize(size, Image.Resampling.BOX))
        if bunches is not None:
            bunches = np.asarray(Image.fromarray(bunches).resize(size, Image.Resampling.NEAREST))
        boxes = None if boxes is None else boxes * np.tile(np.array(size) / (width, height), 2)
    if boxes is None:
        boxes = mask_boxes(bunches) if bunches is not None else np.zeros((0, 4))
    return BunchPicture(name, rgb, bunches, boxes)


def mask_boxes(bunches: np.ndarray) -> np.ndarray:
    """Returns the boxes [n, 4] px around the pixels of each bunch in ``bunches`` [height, width], see
    :class:`BunchPicture`."""
    boxes = []
    for bunch in np.unique(bunches[bunches > 0]):
        rows, columns = np.nonzero(bunches == bunch)
        boxes.append((columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))
    return np.array(boxes, float).reshape(-1, 4)


def _numbered(mask: np.ndarray) -> np.ndarray:
    """Returns the number of the bunch of each pixel. A mask of two values does not separate bunches, so each of its
    connected parts becomes one."""
    if mask.ndim == 3:
        mask = mask[..., :3].max(-1)
    if len(np.unique(mask)) == 2:
        mask = cv2.connectedComponents((mask > mask.min()).astype(np.uint8), connectivity=8)[1]
    return mask.astype(np.uint16)


def _merged(file: pathlib.Path) -> np.ndarray:
    """Returns the number of the bunch of each pixel, from a file with an array [height, width, bunches]."""
    try:
        with np.load(file) as arrays:
            masks = arrays[arrays.files[0]]
    except (OSError, ValueError, IndexError, zipfile.BadZipFile) as bad:
        raise UsageError(f"{file} is no file of masks: {bad}; give an array [height, width, bunches]") from None
    if masks.ndim != 3:
        raise UsageError(f"{file} has an array of {masks.ndim} dimensions; give [height, width, bunches]")
    numbers = np.arange(1, masks.shape[2] + 1, dtype=np.uint16)
    return (masks.astype(bool) * numbers).max(-1, initial=0).astype(np.uint16)


def _read_boxes(file: pathlib.Path, shape: tuple[int, ...]) -> np.ndarray:
    """Returns the boxes [n, 4] px of a file with lines ``class x y width height`` in shares of the picture."""
    boxes = []
    for number, line in enumerate(file.read_text().splitlines(), 1):
        words = line.split()
        if not words:
            continue
        try:
            x, y, width, height = map(float, words[1:5])
        except ValueError:
            raise UsageError(
                f"{file}, line {number} is {line!r}; give `class x y width height` in shares of the picture"
            ) from None
        boxes.append((x - width / 2, y - height / 2, x + width / 2, y + height / 2))
    return np.array(boxes, float).reshape(-1, 4) * (shape[1], shape[0], shape[1], shape[0])


def _pixels(source: pathlib.Path | bytes, mode: str | None = None) -> np.ndarray:
    """Returns the pixels of an image file, or of its bytes; ``mode``: Pillow's mode, None for that of the file."""
    try:
        with Image.open(io.BytesIO(source) if isinstance(source, bytes) else source) as image:
            return np.array(image if mode is None else image.convert(mode))
    except (OSError, UnidentifiedImageError) as bad:
        name = "an image of the pack" if isinstance(source, bytes) else source
        raise UsageError(f"{name} cannot be read: {bad}; replace it or take it away") from None


# ---- packs -----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(slots=True)
class Collection:
    """Pictures to train on and photographs to test on, each list with the name of its folder."""

    photographs: dict[str, list[BunchPicture]] = dataclasses.field(default_factory=dict)
    synthetic: dict[str, list[BunchPicture]] = dataclasses.field(default_factory=dict)


def read_folders(
    photos: Iterable[pathlib.Path],
    synthetic: Iterable[pathlib.Path],
    limit: int | None = None,
    skip: int = 0,
    announce: Callable[[str], None] = lambda _: None,
) -> Collection:
    """Returns the pictures of folders of photographs and of data sets; ``limit``, ``skip``: see
    :func:`read_dataset`."""
    collection = Collection()
    for folder in photos:
        announce(f"reading {folder}")
        _add(collection.photographs, "--photos", folder, read_photographs(folder))
    for folder in synthetic:
        announce(f"reading {folder}")
        _add(collection.synthetic, "--synthetic", folder, read_dataset(folder, limit, skip))
    return collection


def _add(lists: dict[str, list[BunchPicture]], option: str, folder: pathlib.Path, pictures: list[BunchPicture]) -> None:
    name = folder.resolve().name
    if name in lists:
        raise UsageError(f"{option} {folder}: another folder is named {name!r}, too; rename one of them")
    lists[name] = pictures


def write_pack(collection: Collection, file: pathlib.Path, quality: int) -> None:
    """Write all pictures into one file, to carry them to another computer: JPEG of ``quality`` (1 to 95) for colours,
    PNG for masks. Raises :class:`WriteError` if the file cannot be written."""
    contents: dict[str, Any] = {"format": _PACK_FORMAT}
    with writing(file), zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for kind in ("photographs", "synthetic"):
            contents[kind] = {}
            for folder, pictures in getattr(collection, kind).items():
                contents[kind][folder] = [
                    {"name": p.name, "masks": p.bunches is not None, "boxes": p.boxes.round(2).tolist()}
                    for p in pictures
                ]
                for number, picture in enumerate(pictures):
                    stem = f"{kind}/{folder}/{number}"
                    archive.writestr(f"{stem}.jpg", _encoded(picture.rgb, "JPEG", quality=quality))
                    if picture.bunches is not None:
                        archive.writestr(f"{stem}.png", _encoded(picture.bunches, "PNG"))
        archive.writestr(_CONTENTS, json.dumps(contents))


def read_packs(files: Sequence[pathlib.Path]) -> Collection:
    """Returns the pictures of all ``files`` that :func:`write_pack` has written. Pictures of folders with the same name
    are joined. Raises :class:`UsageError` for other files."""
    collection = Collection()
    for file in files:
        try:
            with zipfile.ZipFile(file) as archive:
                contents = json.loads(archive.read(_CONTENTS))
                if contents["format"] != _PACK_FORMAT:
                    raise UsageError(f"{file} has format {contents['format']}; write it again with --pack")
                for kind in ("photographs", "synthetic"):
                    lists = getattr(collection, kind)
                    for folder, entries in contents[kind].items():
                        stem = f"{kind}/{folder}"
                        lists.setdefault(folder, []).extend(
                            _unpacked(archive, f"{stem}/{number}", entry) for number, entry in enumerate(entries)
                        )
        except (OSError, zipfile.BadZipFile, KeyError, ValueError) as bad:
            if isinstance(bad, UsageError):
                raise
            raise UsageError(f"--packed {file} is no pack: {bad}; give a file that --pack has written") from None
    return collection


def _unpacked(archive: zipfile.ZipFile, stem: str, entry: dict[str, Any]) -> BunchPicture:
    rgb = _pixels(archive.read(f"{stem}.jpg"), "RGB")
    bunches = _pixels(archive.read(f"{stem}.png")).astype(np.uint16) if entry["masks"] else None
    return BunchPicture(entry["name"], rgb, bunches, np.array(entry["boxes"], float).reshape(-1, 4))


def _encoded(pixels: np.ndarray, form: str, **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, form, **options)
    return buffer.getvalue()
