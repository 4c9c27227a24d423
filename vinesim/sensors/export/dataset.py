"""Data sets: random pictures of random vineyards with ground truth, in files that a killed run leaves complete.

The content of an image depends only on the plan and the image's index: any process may render the images, in any order,
with equal results. An image is complete when its record exists, which is written last, and its files have the sizes in
the record. Files that were deleted, truncated or partly copied are rendered again. Checksums would also find changed
bytes, but would require reading the whole data set at every start; a check of sizes needs one system call for each
file.

The files that trainers read (COCO, YOLO) are made of the records after the last image, in the forms that they are asked
for. So a finished data set takes another form without rendering.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any, Protocol

import msgspec
import numpy as np

from vinesim.core import frames
from vinesim.core.errors import WriteError
from vinesim.core.version import __version__
from vinesim.scene.berries import VARIETIES
from vinesim.scene.camera_geometry import depth_millimetres
from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.ids import LABEL_STRIDE, Organ, label
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene, Season, sun_direction
from vinesim.scene.terrain import ground_height
from vinesim.scene.values import CameraInfo, RenderedMount, Snapshot
from vinesim.sensors import ground_truth
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export import annotations as formats
from vinesim.sensors.export import images as picture
from vinesim.sensors.export.files import remove_partial_files, write_files
from vinesim.sensors.primitives.bunch_primitives import Ripeness
from vinesim.sensors.primitives.ray_caster import RayCaster, enclosing_primitive
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.sensors.sensor import SensorSetting, export_frame
from vinesim.sensors.spec_file import SensorError

IMAGES_PER_VINEYARD = 5
"""Number of images that are rendered of one vineyard, before the next vineyard is generated."""
MIN_IMAGE_SIZE = 16
MAX_IMAGE_SIZE = 4096
"""Largest width and height of pictures [px]; ``MIN_IMAGE_SIZE`` is the smallest."""
CAMERA_HEIGHT = (0.7, 1.7)
"""Lowest and highest height of the camera above the ground [m], as on arms and heads of robots."""
BUNCH_DISTANCE = (0.35, 1.8)
"""Least and largest distance [m] from the camera to the bunch at which it looks."""
MAX_ACTOR_DISTANCE = 2.5
"""Largest horizontal distance [m] from the actors' place of work to the bunch in view."""
MIN_CLEARANCE = 0.15
"""Depth [m] below which at most a fiftieth of a picture's pixels may be; other views are rejected."""
LATITUDE = np.radians(41.6)
"""Latitude [rad] of the vineyards near Aprilia, Italy, where CANOPIES picks; it determines the sun's path."""
MIN_ACTOR_SHARE = 0.01
"""Least share of a picture's pixels that show actors or boxes, in scenes that have any."""
MIN_PLANT_SHARE = 0.02
"""Least share of the pixels of a picture without bunches that show a plant."""
_MAX_TRIES = 60
_TRIES_WITH_ACTORS = 30
_TRIES_WITHOUT_BUNCHES = 300
_TRIES_UNTIL_DOWN = 60
_FOLDERS = ("images", "labels", "depth", "measured", "ids", "berries", "records")
_DERIVED_FOLDERS = ("labels", "records")
"""Folders without files that an image's record lists."""
_SUFFIXES = {"labels": ".txt", "records": ".json"}
"""File suffixes in the folders of a data set that do not contain PNG files."""
SPLITS = ("train", "val", "test")
_VAL_VINEYARD = 1
_TEST_VINEYARD = 2
_SPLIT_PERIOD = 10
"""Number of vineyards after which the split repeats: the second of them is for validation, the third for tests."""


class DatasetError(SensorError):
    """Error: a data set cannot be made or continued. The message is one line."""


def split_of(image: int) -> str:
    """Returns the split (``train``, ``val``, ``test``) of an image; all images of a vineyard belong to one split."""
    place = image // IMAGES_PER_VINEYARD % _SPLIT_PERIOD
    return {_VAL_VINEYARD: "val", _TEST_VINEYARD: "test"}.get(place, "train")


def split_needs(split: str) -> int:
    """Returns the smallest number of images with which a split is not empty."""
    return next(image + 1 for image in range(IMAGES_PER_VINEYARD * _SPLIT_PERIOD) if split_of(image) == split)


def resized_intrinsics(spec: CameraSpec, size: tuple[int, int] | None) -> CameraInfo:
    """Returns the intrinsics of a camera whose picture has another ``size`` [px], with an equal horizontal field of
    view and square pixels."""
    width, height = size or (int(spec.width.value), int(spec.height.value))
    if not (MIN_IMAGE_SIZE <= width <= MAX_IMAGE_SIZE and MIN_IMAGE_SIZE <= height <= MAX_IMAGE_SIZE):
        raise SensorError(
            f"size is {width}x{height}; give WxH from {MIN_IMAGE_SIZE}x{MIN_IMAGE_SIZE} to "
            f"{MAX_IMAGE_SIZE}x{MAX_IMAGE_SIZE}"
        )
    return spec.info("camera_optical_frame", size=size)


class SnapshotSource(Protocol):
    """Interface of a generator of random scenes with actors and wind, which provides the snapshots that sensors
    render."""

    def settings(self) -> dict[str, Any]:
        """Returns all settings that determine the scenes, for JSON."""
        ...

    def snapshot(self, model: Model, rng: np.random.Generator) -> tuple[Snapshot, np.ndarray, dict[str, Any]] | None:
        """Returns a snapshot, the point [2] m of the ground near which the camera shall look, and a record of the
        scene.

        None stands for the vineyard at rest. The result depends only on ``model`` and the random numbers of ``rng``.
        Entry ``actors`` of the record has the form that :func:`formats.actor_records` takes.
        """
        ...


@dataclasses.dataclass(frozen=True, slots=True)
class DatasetPlan:
    """The settings of a data set. Equal plans have equal images."""

    scene: Scene
    seed: int
    camera: str
    size: tuple[int, int] | None = None
    """Width and height of the pictures [px]; None: those of the camera."""
    snapshot_source: SnapshotSource | None = None
    """Generator of scenes with actors and wind; None: all plants hang at rest."""
    device: str = "cpu"
    sensors: tuple[RenderedMount, ...] = ()
    """Further sensors, which are rendered from the camera's pose."""
    negatives: float = 0.0
    """Share of the pictures in which no bunch is visible, 0 to 1."""

    semantic: bool = False
    """Whether to write an image of the class of each pixel too, see :func:`annotations.encode_classes`."""
    colour: str = "camera"
    """Colours of the pictures, one of :data:`vinesim.sensors.camera.camera.COLOURS`."""

    def is_negative(self, image: int) -> bool:
        """Returns whether no bunch shall be visible in image ``image``."""
        return bool(np.random.default_rng([self.seed, 7, image]).random() < self.negatives)

    def settings(self) -> dict[str, Any]:
        """Returns all settings that determine the images, for JSON."""
        info = resized_intrinsics(CameraSpec.load(self.camera).coloured(self.colour), self.size)
        return {
            "vinesim": __version__,
            "scene": msgspec.to_builtins(self.scene),
            "seed": self.seed,
            "camera": self.camera,
            "colour": self.colour,
            "size": [info.width, info.height],
            "device": self.device.partition(":")[0],  # without the index, because all GPUs render equal images
            "life": None if self.snapshot_source is None else self.snapshot_source.settings(),
            "sensors": {m.name: {"kind": m.kind} | msgspec.to_builtins(m) for m in self.sensors} or None,
            "negatives": self.negatives,
            "semantic": self.semantic,
            "classes": dict(enumerate(formats.SEMANTIC_CLASSES)) if self.semantic else None,
        }

    def vineyard(self, number: int) -> Scene:
        """Returns the scene of vineyard ``number``: with its own seed and leaves, and one row of each grape variety in
        random order."""
        rng = np.random.default_rng([self.seed, 1, number])
        names = [VARIETIES[k].name for k in rng.permutation(len(VARIETIES))]
        season = Season(leafiness=round(rng.uniform(0.5, 1.0), 3), yellow=round(rng.uniform(0.0, 0.5), 3))
        fruit = msgspec.structs.replace(self.scene.fruit, varieties=tuple(names))
        return msgspec.structs.replace(self.scene, seed=int(rng.integers(1 << 31)), season=season, fruit=fruit)


class VineyardRenderer:
    """Generates one vineyard of a plan and renders its images."""

    def __init__(self, plan: DatasetPlan, number: int) -> None:
        self.plan = plan
        self.scene = plan.vineyard(number)
        self.model = generate_uncached(self.scene)
        if not len(self.model.bunch_body):
            raise DatasetError(f"scene {self.scene.name!r} bears no bunch to look at; raise fruit.bunches")
        self.rest: Snapshot = rest_snapshot(self.model)
        self.ripeness = Ripeness.for_pictures(self.model, self.scene.seed)
        self.primitives = Primitives(self.model, ripeness=self.ripeness, device=plan.device)
        self.primitives.update(self.rest)
        self.caster = RayCaster(self.primitives)
        self.spec = CameraSpec.load(plan.camera).coloured(plan.colour)
        self.info = resized_intrinsics(self.spec, plan.size)

    def write_image(self, image: int, folder: pathlib.Path) -> None:
        """Render image ``image`` and write all its files into ``folder``, the record last."""
        rng = np.random.default_rng([self.plan.seed, 2, image])
        hour, sun = _random_sun(rng)
        snapshot, near, activity = self._pose_scene(image)
        is_negative = self.plan.is_negative(image)
        if is_negative:
            seen = self._choose_view_without_bunches(rng, snapshot, near)
        else:
            seen = self._choose_view(rng, snapshot, near, [(one["x"], one["y"]) for one in activity.get("actors", [])])
        truths = ground_truth.bunch_truths(self.primitives, snapshot, seen, self.caster)
        camera = Camera(
            self.spec,
            self.info,
            "camera",
            sun,
            quality="still",
            threads=1,
            seed=self.plan.seed,
            image_index=image,
            device=self.plan.device,
        )
        frame = camera.render(self.primitives, seen.pose)
        assert frame.exact_depth is not None
        bunches = formats.bunch_records(truths, self.info, self.ripeness.bunch)
        activity["actors"] = formats.actor_records(activity.get("actors", []), seen.labels)
        record = {
            "image": image,
            "file": _file_of("images", image),
            "split": split_of(image),
            "negative": is_negative,
            "scene": {
                "name": self.scene.name,
                "seed": self.scene.seed,
                "digest": self.model.digest(),
                "leafiness": self.scene.season.leafiness,
                "yellow": self.scene.season.yellow,
            },
            "sun": {"hour": hour, "direction": list(sun)},
            **activity,
            "camera": formats.camera_record(self.spec.model, self.info, seen.pose),
            "bunches": bunches,
        }
        pixels = {
            "images": frame.rgb,
            "depth": depth_millimetres(frame.exact_depth),
            "measured": depth_millimetres(frame.depth),
            "ids": formats.encode_labels(frame.labels),
            "berries": formats.encode_berry_numbers(seen),
        }
        if self.plan.semantic:
            pixels["semantic"] = formats.encode_classes(seen)
        setting = SensorSetting(sun, self.plan.seed, image, self.plan.device, threads=1)
        for mount in self.plan.sensors:
            kept = export_frame(mount, self.primitives, snapshot, seen.pose, setting)
            pixels |= {f"{mount.name}/{name}": values for name, values in kept.images.items()}
            record.setdefault("sensors", {})[mount.name] = kept.record
        files = {_file_of(kind, image): picture.encode_png(values) for kind, values in pixels.items()}
        record["files"] = {name: len(data) for name, data in files.items()}
        files[_file_of("records", image)] = formats.json_text(record).encode()
        for kind in pixels:
            (folder / kind).mkdir(parents=True, exist_ok=True)
        write_files({folder / name: [data] for name, data in files.items()})

    def _pose_scene(self, image: int) -> tuple[Snapshot, np.ndarray | None, dict[str, Any]]:
        """Move all primitives to their poses in one image, independently of images that were rendered before.

        Returns the snapshot, the point [2] m of the ground near which to look (None: anywhere), and the scene's record.
        """
        all_trees = np.arange(len(self.model.tree_first))
        self.primitives.update(self.rest, all_trees)
        source = self.plan.snapshot_source
        activity = source.snapshot(self.model, np.random.default_rng([self.plan.seed, 5, image])) if source else None
        if activity is None:
            return self.rest, None, {}
        self.primitives.update(activity[0], all_trees)
        return activity

    def _choose_view(
        self, rng: np.random.Generator, snapshot: Snapshot, near: np.ndarray | None, actors: list[tuple[float, float]]
    ) -> ground_truth.PixelBuffers:
        """Returns the view of a random hanging bunch from a free place near it, in which the bunch is visible.

        ``near``: point [2] m of the ground near which the bunch hangs; ``actors``: positions [m], one of which is in
        view too, unless too many tries fail.
        """
        hanging = self._hanging_bunches(snapshot, near)
        for attempt in range(_MAX_TRIES):
            bunch = int(hanging[rng.integers(len(hanging))])
            middle = self._middle_of_bunch(snapshot, bunch)
            height = rng.uniform(*CAMERA_HEIGHT)
            away = rng.uniform(*BUNCH_DISTANCE)
            around = rng.uniform(0.0, 2.0 * np.pi)
            if actors and attempt < _TRIES_WITH_ACTORS:  # look from the side opposite to an actor
                behind = np.array(actors[rng.integers(len(actors))]) - middle[:2]
                around = np.arctan2(-behind[1], -behind[0]) + rng.normal(0.0, 0.3)
            height += float(ground_height(self.model.terrain, *middle[:2]))
            rise = height - middle[2]
            level = np.sqrt(max(away**2 - rise**2, rise**2))  # never steeper than 45 degrees
            eye = np.array([*(middle[:2] + level * np.array([np.cos(around), np.sin(around)])), height])
            aim = middle + rng.normal(0.0, 0.12, 3) * min(away, 1.0)
            roll = frames.exp(np.array([0.0, 0.0, rng.normal(0.0, 0.03)]))
            seen = self._look(eye, aim, roll)
            if seen is None:
                continue
            shown = (seen.labels == label(Organ.BUNCH, bunch)).sum()
            if (
                actors
                and attempt < _TRIES_WITH_ACTORS
                and (seen.labels >= label(Organ.BOX, 0)).mean() < MIN_ACTOR_SHARE
            ):
                continue
            if shown >= formats.MIN_ANNOTATED_PIXELS:
                return seen
        raise DatasetError(f"scene {self.scene.name!r} has no open place near its bunches, in {_MAX_TRIES} tries")

    def _choose_view_without_bunches(
        self, rng: np.random.Generator, snapshot: Snapshot, near: np.ndarray | None
    ) -> ground_truth.PixelBuffers:
        """Returns a view from a free place near a random hanging bunch, in a direction in which a plant is visible, but
        no bunch.

        ``near``: point [2] m of the ground near which the bunch hangs.
        """
        hanging = self._hanging_bunches(snapshot, near)
        for attempt in range(_TRIES_WITHOUT_BUNCHES):
            middle = self._middle_of_bunch(snapshot, int(hanging[rng.integers(len(hanging))]))
            bearing, heading = rng.uniform(0.0, 2.0 * np.pi, 2)
            away = rng.uniform(*BUNCH_DISTANCE)
            eye = np.array([*(middle[:2] + away * np.array([np.cos(bearing), np.sin(bearing)])), 0.0])
            eye[2] = rng.uniform(*CAMERA_HEIGHT)
            # Bunches hang at the height of the camera. So later tries look farther down, at trunks and the ground.
            pitch = rng.uniform(-0.3, 0.3) - 0.9 * min(attempt / _TRIES_UNTIL_DOWN, 1.0)
            level = np.array([np.cos(heading), np.sin(heading), 0.0])
            aim = eye + np.cos(pitch) * level + [0.0, 0.0, np.sin(pitch)]
            seen = self._look(eye, aim, frames.exp(np.array([0.0, 0.0, rng.normal(0.0, 0.03)])))
            if seen is None:
                continue
            organs = seen.labels // LABEL_STRIDE
            is_plant = (organs >= Organ.TRUNK) & (organs <= Organ.LEAF)
            if not (organs == Organ.BUNCH).any() and is_plant.mean() >= MIN_PLANT_SHARE:
                return seen
        raise DatasetError(
            f"scene {self.scene.name!r} has no view of a plant without bunches, in {_TRIES_WITHOUT_BUNCHES} tries; "
            "lower fruit.bunches, or give --negatives 0"
        )

    def _hanging_bunches(self, snapshot: Snapshot, near: np.ndarray | None) -> np.ndarray:
        """Returns the indices of the hanging bunches; if possible only of those around the point ``near`` [2] m of the
        ground."""
        hanging = np.flatnonzero(snapshot.bunch_attached)
        if near is not None:
            away = np.linalg.norm(snapshot.body_q[self.model.bunch_body[hanging], :2] - near, axis=1)
            hanging = hanging[away < MAX_ACTOR_DISTANCE] if (away < MAX_ACTOR_DISTANCE).any() else hanging
        if not len(hanging):
            raise DatasetError(f"scene {self.scene.name!r} bears too few bunches; raise fruit.bunches")
        return hanging

    def _middle_of_bunch(self, snapshot: Snapshot, bunch: int) -> np.ndarray:
        """Returns the middle [3] m of a bunch's rachis."""
        pose = snapshot.body_q[self.model.bunch_body[bunch]].astype(float)
        return pose[:3] + frames.rotate(pose[3:], np.array([0.5 * self.model.bunch_length[bunch], 0.0, 0.0]))

    def _look(self, eye: np.ndarray, aim: np.ndarray, roll: np.ndarray) -> ground_truth.PixelBuffers | None:
        """Returns the view from ``eye`` [3] m to ``aim`` [3] m, turned by the quaternion ``roll`` [4]; None if the
        place is not free, or something is too near."""
        if np.linalg.norm(aim - eye) < 0.1 or enclosing_primitive(self.primitives, eye) >= 0:
            return None
        optical = picture.look_at(eye, aim)
        optical[3:] = frames.multiply(optical[3:], roll)
        seen = ground_truth.render_buffers(self.primitives, self.info, optical)
        return seen if (seen.depth < MIN_CLEARANCE).mean() < 0.02 else None


def _random_sun(rng: np.random.Generator) -> tuple[float, tuple[float, float, float]]:
    """Returns a random solar time [h] on a day from August to October, and the unit vector towards the sun, which is at
    least 6 degrees high."""
    declination = np.radians(rng.uniform(-8.0, 16.0))
    lowest = np.sin(np.radians(6.0)) - np.sin(LATITUDE) * np.sin(declination)
    half_day = float(np.degrees(np.arccos(lowest / (np.cos(LATITUDE) * np.cos(declination))))) / 15.0
    hour = 12.0 + half_day * float(rng.uniform(-1.0, 1.0))
    return hour, sun_direction(hour, float(declination), float(LATITUDE))


# ---- files -----------------------------------------------------------------------------------------------------------


class _RecordedFiles(msgspec.Struct):
    """The part of an image's JSON record that lists the image's files."""

    files: dict[str, int]
    """Size of each file [byte], by path relative to the data set's folder."""


def _file_of(kind: str, image: int) -> str:
    """Returns the path of the file of an image in folder ``kind``, relative to the data set's folder."""
    return f"{kind}/{image:06d}{_SUFFIXES.get(kind, '.png')}"


def prepare_folder(plan: DatasetPlan, folder: pathlib.Path, images: int) -> None:
    """Create the folder of a data set with ``images`` images, or check that an existing data set can be continued.

    An existing folder must have been begun with the same plan, and must not contain more images. Raises
    :class:`DatasetError` otherwise.
    """
    file = folder / "dataset.json"
    settings = plan.settings()
    try:
        if file.exists():
            _check_same_settings(file, settings)
            _check_no_more_images(folder, images)
        elif folder.exists() and any(folder.iterdir()):
            raise DatasetError(f"{folder} holds other things than a data set; give an empty folder or a new one")
        for name in _FOLDERS:
            (folder / name).mkdir(parents=True, exist_ok=True)
        remove_partial_files(folder)
        if not file.exists():
            write_files({file: [formats.json_text(settings).encode()]})
    except OSError as bad:
        raise DatasetError(
            f"{folder} cannot be used: {bad.strerror or bad}; give a folder that can be written"
        ) from None


def _check_same_settings(file: pathlib.Path, wanted: dict[str, Any]) -> None:
    folder = file.parent
    try:
        there = msgspec.json.decode(file.read_bytes(), type=dict[str, Any])
    except msgspec.DecodeError as bad:
        raise DatasetError(f"{file} is not what a data set was begun with: {bad}; give another folder") from None
    wanted = json.loads(json.dumps(wanted))
    for name, value in wanted.items():
        if there.get(name) != value:
            was, asked = ("another one", "this one") if name == "scene" else (there.get(name), value)
            raise DatasetError(
                f"{folder} was begun with {name} {was}, not {asked}; go on as it was begun, or give another folder"
            )


def _check_no_more_images(folder: pathlib.Path, images: int) -> None:
    """Raise :class:`DatasetError` if the folder contains more than ``images`` images, because its lists would then not
    name all images in its folders."""
    records = (path.stem for path in (folder / "records").glob("*.json"))
    there = 1 + max((int(stem) for stem in records if stem.isdigit()), default=-1)
    if images < there:
        raise DatasetError(
            f"{folder} holds image {there - 1:06d}, more than {images} images have; give --images {there} or more, or "
            "another folder"
        )


def missing_images(folder: pathlib.Path, images: int) -> list[int]:
    """Returns the indices of those among the first ``images`` images that are missing or have missing or changed
    files."""
    return [n for n in range(images) if not _is_whole(folder, n)]


def _is_whole(folder: pathlib.Path, image: int) -> bool:
    """Returns whether the record of an image exists, and each of the image's files has the size in the record."""
    expected = {_file_of(kind, image) for kind in _FOLDERS if kind not in _DERIVED_FOLDERS}
    try:
        record = msgspec.json.decode((folder / _file_of("records", image)).read_bytes(), type=_RecordedFiles)
        return record.files.keys() >= expected and all(
            (folder / name).stat().st_size == size for name, size in record.files.items()
        )
    except (OSError, msgspec.DecodeError):
        return False


def render_images(plan: DatasetPlan, folder: pathlib.Path, images: Iterable[int]) -> Iterator[int]:
    """Render and write ``images`` in order, and yield the index of each image when it is complete.

    Raises :class:`WriteError` if an image cannot be written.
    """
    number = -1
    vineyard = None
    for image in images:
        if vineyard is None or image // IMAGES_PER_VINEYARD != number:
            number = image // IMAGES_PER_VINEYARD
            vineyard = VineyardRenderer(plan, number)
        try:
            vineyard.write_image(image, folder)
        except OSError as bad:
            raise _not_written(f"image {image}", folder, bad) from None
        yield image


def finish(folder: pathlib.Path, images: int, segmentation: str = "polygons", yolo: str = "detect") -> pathlib.Path:
    """Write the files that trainers read, from the records of the first ``images`` images: ``annotations.json`` (COCO),
    and for YOLO the folder ``labels``, ``data.yaml`` and the lists of images that it names, one for each split that has
    images.

    Args:
        folder: folder of the data set.
        images: number of images.
        segmentation: form of the masks in ``annotations.json``, one of :data:`annotations.SEGMENTATIONS`.
        yolo: task that the labels are for, one of :data:`annotations.YOLO_TASKS`.

    Returns the path of ``annotations.json``. Raises :class:`WriteError` if one of the files cannot be written; then no
    file is written.
    """

    def record(number: int) -> dict[str, Any]:
        return json.loads((folder / _file_of("records", number)).read_text(encoding="utf-8"))

    def labels(number: int) -> Iterator[bytes]:
        one = record(number)
        yield formats.yolo_labels(one["bunches"], one["camera"]["width"], one["camera"]["height"], yolo).encode()

    target = folder / "annotations.json"
    seed = json.loads((folder / "dataset.json").read_text(encoding="utf-8"))["seed"]
    coco = formats.coco_json(lambda: map(record, range(images)), seed, segmentation)
    files: dict[pathlib.Path, Iterable[bytes]] = {target: map(str.encode, coco)}
    files |= {folder / _file_of("labels", number): labels(number) for number in range(images)}
    some = [split for split in SPLITS if split_needs(split) <= images]
    for split in some:  # `./` is relative to the list
        names = [f"./{_file_of('images', n)}\n" for n in range(images) if split_of(n) == split]
        files[folder / f"{split}.txt"] = map(str.encode, names)
    files[folder / "data.yaml"] = [formats.yolo_settings(some, yolo).encode()]
    try:
        write_files(files)
    except OSError as bad:
        raise _not_written("annotations.json, the labels and the lists", folder, bad) from None
    return target


def _not_written(what: str, folder: pathlib.Path, bad: OSError) -> WriteError:
    return WriteError(
        f"{what} cannot be written into {folder}: {bad.strerror or bad}; make room there, and the same command goes on"
    )
