"""Ground truth in file formats: JSON records, COCO, YOLO, images of ids, and an overlay to look at."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import cv2
import numpy as np

from vinesim.core.version import __version__
from vinesim.scene.berries import VARIETIES
from vinesim.scene.camera_geometry import distortion_model, intrinsic_matrix
from vinesim.scene.ids import LABEL_STRIDE, ObjectKind, Organ, object_id, object_name
from vinesim.scene.values import MIN_BERRY_PIXELS, Box, BunchTruth, CameraInfo
from vinesim.sensors.export.outlines import join_polygons, mask_polygons
from vinesim.sensors.ground_truth import PixelBuffers

_EXTRA_FIELDS = ("occlusion", "bunch", "tree", "variety", "ripeness", "attached", "berries", "berries_seen")
"""Fields of an annotated bunch in COCO files, in addition to the fields that COCO defines."""
_FONT = (cv2.FONT_HERSHEY_SIMPLEX, 0.42)
"""Font and scale of the text of an overlay."""
_LINE = 15
"""Height of a line of this text [px]."""
MIN_ANNOTATED_PIXELS = 16
"""Least number of visible pixels of an annotated bunch (COCO, YOLO); JSON records contain also smaller bunches."""

CATEGORY = 1
"""Id of the only category, bunches, in COCO files, whose ids begin with 1 by convention."""
CATEGORIES = [{"id": CATEGORY, "name": "bunch", "supercategory": "vine", "keypoints": ["cut"], "skeleton": []}]
"""List of categories for COCO files."""
LICENSES = [{"id": 1, "name": "Apache-2.0", "url": "https://www.apache.org/licenses/LICENSE-2.0"}]
"""List of licences for COCO files: that of vinesim, for all images."""
SEGMENTATIONS = ("polygons", "rle", "compressed")
"""Forms of ``segmentation`` in COCO files: polygons, run lengths as a list, and run lengths as text."""
YOLO_TASKS = ("detect", "segment", "pose")
"""Forms of YOLO label files, by the names of Ultralytics' tasks: box, polygon, and box with cut point."""

UNKNOWN_FLOW = 1e10
"""Optical flow [px] of pixels without one, in files of the Middlebury benchmark; its readers take 1e9 as the limit."""
_FLOW_MAGIC = 202021.25
"""First number of these files."""

SEMANTIC_CLASSES = (
    "sky",
    "soil",
    "grass",
    "leaf",
    "cane",
    "trunk",
    "arm",
    "wire",
    "post",
    "peduncle",
    "bunch",
    "berry",
    "person",
    "robot",
    "box",
    "spur",
    "node",
    "bud",
)
"""Names of the classes in semantic images, by value of the pixel. ``bunch`` is the part of a bunch that is no berry."""
_CLASS_OF_ORGAN = {
    Organ.NOTHING: "sky",
    Organ.GROUND: "soil",
    Organ.POLE: "post",
    Organ.HUMAN: "person",
}
"""Class of those organs that have another name than their class."""


def encode_mask(mask: np.ndarray) -> dict[str, Any]:
    """Returns a mask [height, width] encoded as COCO's compressed run lengths."""
    from pycocotools import mask as coco

    encoded = coco.encode(np.asfortranarray(mask, np.uint8))
    return {"size": [int(n) for n in encoded["size"]], "counts": encoded["counts"].decode("ascii")}  # pyright: ignore[reportAttributeAccessIssue]  # bytes, not str


def decode_mask(encoded: dict[str, Any]) -> np.ndarray:
    """Returns the mask, uint8 [height, width], that :func:`encode_mask` encoded."""
    from pycocotools import mask as coco

    return coco.decode(encoded)  # pyright: ignore[reportArgumentType]  # takes text, too


def list_run_lengths(encoded: dict[str, Any]) -> dict[str, Any]:
    """Returns a mask that :func:`encode_mask` encoded, with its run lengths as a list of numbers: down the columns,
    first the number of pixels outside the mask."""
    pixels = decode_mask(encoded).ravel(order="F")
    changes = np.flatnonzero(np.diff(pixels, prepend=0))
    return {"size": encoded["size"], "counts": np.diff(changes, prepend=0, append=len(pixels)).tolist()}


def camera_record(model: str, info: CameraInfo, pose: np.ndarray) -> dict[str, Any]:
    """Returns intrinsics [px], named as in sensor_msgs/CameraInfo, and the ``pose`` [7] of the optical frame, for
    JSON."""
    distortion, coefficients = distortion_model(info)
    return {
        "model": model,
        "width": info.width,
        "height": info.height,
        "distortion_model": distortion,
        "d": list(coefficients),
        "k": intrinsic_matrix(info),
        "frame": "optical (REP-103): x right, y down, z forward",
        "position": pose[:3].tolist(),
        "quaternion_xyzw": pose[3:].tolist(),
    }


def bunch_records(
    truths: Iterable[BunchTruth], info: CameraInfo, ripeness: np.ndarray | None = None
) -> list[dict[str, Any]]:
    """Returns the ground truth of a picture's bunches for JSON: points in m in the world, boxes as [column, row, width,
    height] px.

    ``ripeness``: [bunch] from 0 (green) to 1 (ripe); None: all bunches are ripe.
    """
    return [
        {
            "bunch": one.bunch,
            "name": object_name(object_id(ObjectKind.BUNCH, one.bunch)),
            "label": one.label,
            "tree": one.tree,
            "variety": VARIETIES[one.variety].name,
            "ripeness": 1.0 if ripeness is None else float(ripeness[one.bunch]),
            "attached": one.attached,
            "pixels": one.pixels,
            "amodal_pixels": one.amodal_pixels,
            "occlusion": one.occlusion,
            "box": _xywh(one.visible_box),
            "amodal_box": _xywh(one.amodal_box),
            "mask": encode_mask(one.mask(one.visible, info)),
            "polygons": mask_polygons(one.mask(one.visible, info)),
            "amodal_mask": encode_mask(one.mask(one.amodal, info)),
            "berries": one.berries,
            "berries_seen": one.berries_seen,
            "box_3d": {
                "position": one.frame[:3].tolist(),
                "quaternion_xyzw": one.frame[3:].tolist(),
                "size": one.size.tolist(),
            },
            "cut": None if one.cut is None else one.cut.tolist(),
            "cut_pixel": None if one.cut_pixel is None else one.cut_pixel.tolist(),
            "cut_seen": one.cut_seen,
        }
        for one in truths
    ]


def actor_records(actors: list[dict[str, Any]], labels: np.ndarray) -> list[dict[str, Any]]:
    """Returns the records of those ``actors`` (and crates) that are visible in a picture, with pixel counts and
    bounding boxes added.

    ``labels``: [height, width] labels of the picture.
    """
    found = []
    for one in actors:
        rows, columns = np.nonzero(labels == one["label"])
        box = (int(columns.min()), int(rows.min()), int(columns.max()), int(rows.max())) if len(rows) else None
        found.append({**one, "pixels": len(rows), "box": _xywh(box)})
    return found


def _xywh(box: Box | None) -> list[int] | None:
    """Returns a bounding box in COCO's format: column, row, width, height [px]."""
    return None if box is None else [box[0], box[1], box[2] - box[0] + 1, box[3] - box[1] + 1]


def yolo_labels(bunches: list[dict[str, Any]], width: int, height: int, task: str = "detect") -> str:
    """Returns the text of a YOLO label file: a line for each annotated bunch, in shares of the picture's width and
    height.

    Args:
        bunches: records of the picture's bunches.
        width: width of the picture [px].
        height: height of the picture [px].
        task: one of :data:`YOLO_TASKS`.

    A line for ``detect`` is class 0, centre and size of the visible bounding box; for ``segment`` class 0 and one
    polygon of all visible parts, 0.05 px inside of them; for ``pose`` as for ``detect``, then the cut point and 2 if it
    is visible, 1 if it is hidden, or three zeros if it is not in the picture.
    """
    size = np.array([width, height], float)
    lines = []
    for one in annotated_bunches(bunches):
        if task == "segment":
            polygon = join_polygons(mask_polygons(decode_mask(one["mask"]), inset=True))
            values = (np.array(polygon).reshape(-1, 2) / size).ravel()
        else:
            x, y, w, h = one["box"]
            values = np.array([x + 0.5 * w, y + 0.5 * h, w, h]) / np.tile(size, 2)
        words = ["0", *(f"{share:.6f}" for share in values)]
        if task == "pose":
            column, row, seen = _cut_keypoint(one, width, height)
            place = (np.array([column, row]) + 0.5) / size if seen else np.zeros(2)  # the middle of pixel 0 is 0.5
            words += [*(f"{share:.6f}" for share in place), str(seen)]
        lines.append(" ".join(words))
    return "".join(f"{line}\n" for line in lines)


def yolo_settings(splits: Iterable[str], task: str = "detect") -> str:
    """Returns the text of ``data.yaml`` for Ultralytics, with a list of images ``SPLIT.txt`` for each of the
    ``splits``."""
    # Without `path`, Ultralytics uses the folder of data.yaml; a relative `path` would count from its working folder.
    lists = "".join(f"{split}: {split}.txt\n" for split in splits)
    keypoints = "kpt_shape: [1, 3]\nflip_idx: [0]\n" if task == "pose" else ""
    return f"{lists}{keypoints}names:\n  0: bunch\n"


def annotated_bunches(bunches: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns those of the ``bunches`` in a record that have at least :data:`MIN_ANNOTATED_PIXELS` visible pixels."""
    return [one for one in bunches if one["pixels"] >= MIN_ANNOTATED_PIXELS]


def coco_json(read: Callable[[], Iterable[dict[str, Any]]], seed: int, segmentation: str = "polygons") -> Iterator[str]:
    """Yield the text of a COCO instances (and keypoints) file, piece by piece, from the records of its images.

    Args:
        read: returns an iterator of the records of all images, in order. It is called twice, so that only one record
            at a time is in memory.
        seed: seed of the data set.
        segmentation: form of the visible masks, one of :data:`SEGMENTATIONS`.
    """
    info = {
        "description": "vinesim",
        "version": __version__,
        "seed": seed,
        "berry_pixels": MIN_BERRY_PIXELS,
        "least_pixels": MIN_ANNOTATED_PIXELS,
    }
    yield f'{{"info": {json.dumps(info)},\n"licenses": {json.dumps(LICENSES)},\n'
    yield f'"categories": {json.dumps(CATEGORIES)},\n"images": ['
    videos: dict[int, dict[str, float]] = {}
    tracks: dict[tuple[int, int], int] = {}
    for number, one in enumerate(read()):
        image = {
            "id": one["image"],
            "file_name": one["file"],
            "width": one["camera"]["width"],
            "height": one["camera"]["height"],
            "license": LICENSES[0]["id"],
            "split": one["split"],
            "camera": one["camera"],
        }
        if "sequence" in one:
            image |= {"video_id": one["sequence"]["number"], "frame_id": one["sequence"]["frame"]}
            videos.setdefault(one["sequence"]["number"], {"fps": 1.0 / one["sequence"]["period"]})
        yield (",\n" if number else "\n") + json.dumps(image)
    yield '],\n"annotations": ['
    number = 0
    for one in read():
        for bunch in annotated_bunches(one["bunches"]):
            annotation = _annotation(number + 1, one, bunch, segmentation)
            if "sequence" in one:
                video = one["sequence"]["number"]
                annotation |= {
                    "video_id": video,
                    "track_id": tracks.setdefault((video, bunch["bunch"]), len(tracks) + 1),
                }
            yield (",\n" if number else "\n") + json.dumps(annotation)
            number += 1
    listed = [{"id": number, "name": f"{number:06d}", **video} for number, video in videos.items()]
    yield f'],\n"videos": {json.dumps(listed)}}}\n' if listed else "]}\n"


def _annotation(number: int, image: dict[str, Any], bunch: dict[str, Any], segmentation: str) -> dict[str, Any]:
    point = _cut_keypoint(bunch, image["camera"]["width"], image["camera"]["height"])
    return {
        "id": number,
        "image_id": image["image"],
        "category_id": CATEGORY,
        "iscrowd": 0,
        "bbox": bunch["box"],
        "area": bunch["pixels"],
        "segmentation": _segmentation(bunch, segmentation),
        "keypoints": point,
        "num_keypoints": int(point[2] > 0),
        "amodal_bbox": bunch["amodal_box"],
        "amodal_segmentation": bunch["amodal_mask"],
        **{name: bunch[name] for name in _EXTRA_FIELDS},
    }


def metadata_line(record: dict[str, Any]) -> str:
    """Returns the line of ``metadata.jsonl`` for an image, from its record: what Hugging Face ``datasets`` reads beside
    images, with boxes as in COCO and category 0, ``bunch``."""
    shown = annotated_bunches(record["bunches"])
    line = {
        "file_name": record["file"].partition("/")[2],
        "image_id": record["image"],
        "split": record["split"],
        "width": record["camera"]["width"],
        "height": record["camera"]["height"],
        "objects": {
            "id": [one["bunch"] for one in shown],
            "bbox": [[float(value) for value in one["box"]] for one in shown],
            "area": [one["pixels"] for one in shown],
            "categories": [0] * len(shown),
        },
    }
    return json.dumps(line) + "\n"


def encode_flow(flow: np.ndarray) -> bytes:
    """Returns an optical flow [height, width, 2] px, NaN where unknown, as a file of the Middlebury benchmark
    (``.flo``, float32)."""
    height, width = flow.shape[:2]
    head = np.array([_FLOW_MAGIC], "<f4").tobytes() + np.array([width, height], "<i4").tobytes()
    return head + np.where(np.isnan(flow), UNKNOWN_FLOW, flow).astype("<f4").tobytes()


def _segmentation(bunch: dict[str, Any], form: str) -> Any:
    """Returns the visible mask of a bunch in one of the forms :data:`SEGMENTATIONS`."""
    if form == "polygons":
        return bunch["polygons"]
    return list_run_lengths(bunch["mask"]) if form == "rle" else bunch["mask"]


def _cut_keypoint(bunch: dict[str, Any], width: int, height: int) -> list[Any]:
    """Returns column and row [px] of a bunch's cut point, and 2 if it is visible, 1 if it is hidden; zeros if it is not
    in the picture."""
    column, row = bunch["cut_pixel"] or (-1.0, -1.0)
    if not (-0.5 <= column < width - 0.5 and -0.5 <= row < height - 0.5):
        return [0, 0, 0]
    return [column, row, 2 if bunch["cut_seen"] else 1]


def encode_labels(labels: np.ndarray) -> np.ndarray:
    """Returns labels [height, width] encoded as RGB with ``id = R + 256 G + 65536 B``, as in COCO's panoptic images."""
    return np.stack([labels & 255, labels >> 8 & 255, labels >> 16 & 255], -1).astype(np.uint8)


def encode_classes(seen: PixelBuffers) -> np.ndarray:
    """Returns an image [height, width] uint8 with the index of each pixel's class in :data:`SEMANTIC_CLASSES`."""
    index = {name: number for number, name in enumerate(SEMANTIC_CLASSES)}
    table = np.array([index[_CLASS_OF_ORGAN.get(organ, organ.name.lower())] for organ in Organ], np.uint8)
    organs = seen.labels // LABEL_STRIDE
    classes = table[organs]
    is_on_ground = (organs == Organ.GROUND) & (seen.primitive >= 0)  # the surface of the ground is no primitive
    classes[is_on_ground] = index["grass"]
    classes[seen.berries >= 0] = index["berry"]
    return classes


def encode_berry_numbers(seen: PixelBuffers) -> np.ndarray:
    """Returns an image [height, width] uint16 with the berry's index in its bunch plus one, and 0 where no berry is
    visible."""
    return (seen.berries + 1).astype(np.uint16)


def draw_overlay(rgb: np.ndarray, truths: Iterable[BunchTruth]) -> np.ndarray:
    """Returns the picture ``rgb`` with the ground truth drawn on it.

    A small picture is enlarged by a whole factor, to about 1280 px. Visible boxes are green, amodal boxes that differ
    are white, cut points are yellow discs (rings where hidden). Text at the large bunches: index, visible and total
    number of berries, and share of the bunch's outline that other things cover (the bunch's own front berries, which
    hide the berries behind them, do not count). Where texts would overlap, only that of the largest bunch is drawn.
    """
    scale = max(1, round(1280 / rgb.shape[1]))
    image = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    shown = [(one, one.visible_box) for one in truths if one.visible_box is not None]
    shown.sort(key=lambda pair: pair[0].pixels)

    def corner(column: float, row: float) -> tuple[int, int]:
        return round((column + 0.5) * scale), round((row + 0.5) * scale)

    for one, box in shown:  # large bunches come last, on top
        if one.amodal_box != box:
            cv2.rectangle(image, corner(*one.amodal_box[:2]), corner(*one.amodal_box[2:]), (255, 255, 255), 1)
        cv2.rectangle(image, corner(*box[:2]), corner(*box[2:]), (60, 255, 60), 1)
        if one.cut_pixel is not None and np.abs(one.cut_pixel).max() < 20000:
            cv2.circle(image, corner(*one.cut_pixel), 5, (255, 230, 0), -1 if one.cut_seen else 1)
    texts = []
    corners = []
    for one, box in reversed(shown):
        if one.amodal_pixels * scale * scale > 1500:  # the text would cover a smaller bunch
            texts.append(
                (f"{one.bunch}: {one.berries_seen}/{one.berries} berries", f"{100.0 * one.occlusion:.0f}% covered")
            )
            corners.append(corner(*box[:2]))
    sizes = [(max(cv2.getTextSize(line, *_FONT, 1)[0][0] for line in lines), len(lines) * _LINE) for lines in texts]
    for lines, place in zip(texts, label_places(corners, sizes, (image.shape[1], image.shape[0])), strict=True):
        if place is not None:
            for number, line in enumerate(lines, 1):
                for colour, thick in (((0, 0, 0), 3), ((255, 255, 255), 1)):
                    cv2.putText(image, line, (place[0], place[1] + number * _LINE - 4), *_FONT, colour, thick)
    return image


def label_places(
    corners: Sequence[tuple[int, int]], sizes: Sequence[tuple[int, int]], picture: tuple[int, int]
) -> list[tuple[int, int] | None]:
    """Returns the upper left corner (column, row) [px] of each label: above the corner that it belongs to, moved into
    the picture. None where an earlier label is in the way.

    Args:
        corners: column and row of what each label belongs to, the most important first [px].
        sizes: width and height of each label [px].
        picture: width and height of the picture [px].
    """
    places: list[tuple[int, int] | None] = []
    taken: list[tuple[int, int, int, int]] = []
    for (column, row), (width, height) in zip(corners, sizes, strict=True):
        left = max(min(column, picture[0] - width), 0)
        top = max(min(row - height, picture[1] - height), 0)
        right, bottom = left + width, top + height
        is_free = all(left >= x1 or right <= x0 or top >= y1 or bottom <= y0 for x0, y0, x1, y1 in taken)
        places.append((left, top) if is_free else None)
        if is_free:
            taken.append((left, top, right, bottom))
    return places


def json_text(value: dict[str, Any]) -> str:
    """Returns ``value`` as JSON with one line for each entry of the outermost object."""
    lines = ",\n".join(f"  {json.dumps(k)}: {json.dumps(v)}" for k, v in value.items())
    return f"{{\n{lines}\n}}\n"
