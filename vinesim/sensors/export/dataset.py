"""Data sets: random pictures of random vineyards with ground truth, in files that a killed run leaves complete.

The content of an image depends only on the plan and the image's index: any process may render the images, in any order,
with equal results. The images of a sequence are frames of one camera that drives along a row. An image is complete when
its record exists, which is written last, and its files have the sizes in the record. Files that were deleted, truncated
or partly copied are rendered again. Checksums would also find changed bytes, but would require reading the whole data
set at every start; a check of sizes needs one system call for each file.

The files that trainers read (COCO, YOLO) are made of the records after the last image, in the forms that they are asked
for. So a finished data set takes another form without rendering.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any, Protocol

import msgspec
import numpy as np

from vinesim.core.errors import WriteError
from vinesim.core.version import __version__
from vinesim.scene.camera_geometry import depth_millimetres
from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import CameraInfo, RenderedMount, Snapshot
from vinesim.sensors import ground_truth
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export import annotations as formats
from vinesim.sensors.export import images as picture
from vinesim.sensors.export.dormant_views import node_records, view_of_node
from vinesim.sensors.export.files import remove_partial_files, write_files
from vinesim.sensors.export.mix import LoadedMix, draw_entry, draw_number, draw_sun
from vinesim.sensors.export.views import Drive, ViewFinder
from vinesim.sensors.ground_truth import PixelBuffers
from vinesim.sensors.primitives.bunch_primitives import Ripeness
from vinesim.sensors.primitives.ray_caster import RayCaster
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.sensors.sensor import SensorSetting, export_frame
from vinesim.sensors.spec_file import SensorError

IMAGES_PER_VINEYARD = 5
"""Number of images that are rendered of one vineyard, before the next vineyard is generated."""
MIN_IMAGE_SIZE = 16
MAX_IMAGE_SIZE = 4096
"""Largest width and height of pictures [px]; ``MIN_IMAGE_SIZE`` is the smallest."""
_FOLDERS = ("images", "labels", "depth", "measured", "ids", "berries", "records")
_DERIVED_FOLDERS = ("labels", "records")
"""Folders without files that an image's record lists."""
_SUFFIXES = {"labels": ".txt", "records": ".json", "flow": ".flo"}
"""File suffixes in the folders of a data set that do not contain PNG files."""
SPLITS = ("train", "val", "test")
_VAL_VINEYARD = 1
_TEST_VINEYARD = 2
_SPLIT_PERIOD = 10
"""Number of vineyards after which the split repeats: the second of them is for validation, the third for tests."""


class DatasetError(SensorError):
    """Error: a data set cannot be made or continued. The message is one line."""


def split_of(image: int, each: int = IMAGES_PER_VINEYARD) -> str:
    """Returns the split (``train``, ``val``, ``test``) of an image; all images of a vineyard, of which there are
    ``each``, belong to one split."""
    place = image // each % _SPLIT_PERIOD
    return {_VAL_VINEYARD: "val", _TEST_VINEYARD: "test"}.get(place, "train")


def split_needs(split: str, each: int = IMAGES_PER_VINEYARD) -> int:
    """Returns the smallest number of images with which a split is not empty; ``each``: as in :func:`split_of`."""
    return next(image + 1 for image in range(each * _SPLIT_PERIOD) if split_of(image, each) == split)


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


Scenery = tuple[Snapshot, np.ndarray | None, dict[str, Any]]
"""A snapshot; the point [2] m of the ground near which the camera shall look, or None; and a record of the scene."""


class SnapshotSource(Protocol):
    """Interface of a generator of random scenes with actors and wind, which provides the snapshots that sensors
    render."""

    def settings(self) -> dict[str, Any]:
        """Returns all settings that determine the scenes, for JSON."""
        ...

    def snapshot(self, model: Model, rng: np.random.Generator, parameters: PhysicsParameters) -> Scenery | None:
        """Returns a snapshot, the point near which the camera shall look, and a record of the scene.

        None stands for the vineyard at rest. The result depends only on ``model``, its scene's ``parameters``, and the
        random numbers of ``rng``. Entry ``actors`` of the record has the form that :func:`formats.actor_records` takes.
        """
        ...

    def frames(
        self, model: Model, rng: np.random.Generator, parameters: PhysicsParameters, period: float
    ) -> Iterator[Scenery]:
        """Yield, without end, what :meth:`snapshot` returns, for the frames of a sequence with wind: ``period`` [s]
        after each other."""
        ...


@dataclasses.dataclass(frozen=True, slots=True)
class DatasetPlan:
    """The settings of a data set. Equal plans have equal images."""

    mix: LoadedMix
    """What vineyards, cameras, views and light are drawn from."""
    seed: int
    size: tuple[int, int] | None = None
    """Width and height of the pictures [px]; None: those of the mix or the camera."""
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
    sequence: int = 0
    """Number of frames of each sequence; 0: single pictures."""

    @property
    def images_per_vineyard(self) -> int:
        """Number of images of one vineyard: five single pictures, or one sequence."""
        return self.sequence or IMAGES_PER_VINEYARD

    def is_negative(self, image: int) -> bool:
        """Returns whether no bunch shall be visible in image ``image``."""
        return bool(np.random.default_rng([self.seed, 7, image]).random() < self.negatives)

    def settings(self) -> dict[str, Any]:
        """Returns all settings that determine the images, for JSON."""
        for entry in self.mix.table.cameras:
            resized_intrinsics(CameraSpec.load(entry.camera).coloured(self.colour), self.size or entry.size)
        return {
            "vinesim": __version__,
            "mix": self.mix.settings(),
            "seed": self.seed,
            "colour": self.colour,
            "size": self.size,
            "device": self.device.partition(":")[0],  # without the index, because all GPUs render equal images
            "life": None if self.snapshot_source is None else self.snapshot_source.settings(),
            "sensors": {m.name: {"kind": m.kind} | msgspec.to_builtins(m) for m in self.sensors} or None,
            "negatives": self.negatives,
            "semantic": self.semantic,
            "classes": dict(enumerate(formats.SEMANTIC_CLASSES)) if self.semantic else None,
            "sequence": self.sequence,
        }


@dataclasses.dataclass(frozen=True, slots=True)
class _Shot:
    """What one image shows: a state of the vineyard, and a camera."""

    image: int
    snapshot: Snapshot
    activity: dict[str, Any]
    """Record of actors and wind."""
    spec: CameraSpec
    seen: PixelBuffers
    record: dict[str, Any]
    """Entries of the image's record that tell what was drawn."""


@dataclasses.dataclass(frozen=True, slots=True)
class _Files:
    """The files of one image, encoded, and its record."""

    image: int
    seen: PixelBuffers
    files: dict[str, bytes]
    """Content by path relative to the data set's folder."""
    record: dict[str, Any]

    def add(self, kind: str, data: bytes) -> None:
        self.files[_file_of(kind, self.image)] = data

    def write(self, folder: pathlib.Path) -> int:
        """Write all files into ``folder``, the record last. Returns the image's index."""
        self.record["files"] = {name: len(data) for name, data in self.files.items()}
        self.add("records", formats.json_text(self.record).encode())
        for name in self.files:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_files({folder / name: [data] for name, data in self.files.items()})
        return self.image


class VineyardRenderer:
    """Generates one vineyard of a plan and renders its images."""

    def __init__(self, plan: DatasetPlan, number: int) -> None:
        self.plan = plan
        self.number = number
        self.scene, self.drawn = plan.mix.vineyard(np.random.default_rng([plan.seed, 1, number]))
        self.bearing = draw_number(np.random.default_rng([plan.seed, 8, number]), plan.mix.table.sun.bearing)
        self.model = generate_uncached(self.scene)
        self.is_dormant = len(self.model.nodes.body) > 0
        self._source = None if self.is_dormant else plan.snapshot_source  # actors stand at bunches
        if not (len(self.model.bunch_body) or self.is_dormant):
            raise DatasetError(f"scene {self.scene.name!r} bears no bunch to look at; raise fruit.bunches")
        self.rest: Snapshot = rest_snapshot(self.model)
        self.ripeness = Ripeness.for_pictures(self.model, self.scene.seed)
        self.primitives = Primitives(self.model, ripeness=self.ripeness, device=plan.device)
        self.primitives.update(self.rest)
        self.caster = RayCaster(self.primitives)

    def write_images(self, images: list[int], folder: pathlib.Path) -> Iterator[int]:
        """Render ``images`` of this vineyard, which rise, and write all their files into ``folder``. Yields the index
        of each image when it is complete."""
        if self.plan.sequence:
            yield from self._write_sequence(images, folder)
            return
        for image in images:
            yield self._render(self._random_shot(image)).write(folder)

    def _write_sequence(self, images: list[int], folder: pathlib.Path) -> Iterator[int]:
        """Render those frames of the vineyard's sequence that are among ``images``; see :meth:`write_images`.

        Each state depends on the state before, so the states before the first image are computed, too. An image waits
        for the next state, to which its optical flow leads; the last frame of a sequence has no flow.
        """
        waiting: _Files | None = None
        last = images[-1] % self.plan.sequence
        for frame, shot in enumerate(self._frames()):
            if waiting is not None:
                flow, shown = ground_truth.optical_flow(waiting.seen, shot.seen)
                waiting.add("flow", formats.encode_flow(flow))
                waiting.add("flow_seen", picture.encode_png(np.where(shown, 255, 0).astype(np.uint8)))
                yield waiting.write(folder)
                waiting = None
            if frame > last:
                return
            if shot.image in images:
                waiting = self._render(shot)
                if frame == self.plan.sequence - 1:
                    yield waiting.write(folder)
                    return

    def _frames(self) -> Iterator[_Shot]:
        """Yield the shots of the vineyard's sequence; the primitives are posed to the state of each."""
        plan = self.plan
        rng = np.random.default_rng([plan.seed, 2, self.number])
        drive = Drive.random(rng, plan.mix.table.sequence, plan.sequence, self.scene.physics.dt)
        states: Iterator[Scenery] = itertools.repeat((self.rest, None, {}))
        if self._source is not None:
            life = np.random.default_rng([plan.seed, 5, self.number])
            states = self._source.frames(self.model, life, self.scene.physics, drive.period)
        shot: _Shot | None = None
        start = np.zeros(7)
        for frame in range(plan.sequence):
            image = self.number * plan.sequence + frame
            snapshot, near, activity = next(states)
            self.primitives.update(snapshot, np.arange(len(self.model.tree_first)))
            if shot is None:
                shot = self._draw_shot(rng, image, (snapshot, near, activity), drive=drive)
                start = shot.seen.pose
            else:
                pose = drive.pose(start, frame, self.model)
                seen = ground_truth.render_buffers(self.primitives, shot.seen.info, pose)
                shot = dataclasses.replace(shot, image=image, snapshot=snapshot, activity=activity, seen=seen)
            times = {"frame": frame, "time": frame * drive.period, "period": drive.period, "speed": drive.speed}
            yield dataclasses.replace(shot, record=shot.record | {"sequence": {"number": self.number, **times}})

    def _random_shot(self, image: int) -> _Shot:
        """Returns the shot of a single picture, independently of images that were rendered before."""
        rng = np.random.default_rng([self.plan.seed, 2, image])
        all_trees = np.arange(len(self.model.tree_first))
        self.primitives.update(self.rest, all_trees)
        source = self._source
        scenery: Scenery = (self.rest, None, {})
        if source is not None:
            life = np.random.default_rng([self.plan.seed, 5, image])
            scenery = source.snapshot(self.model, life, self.scene.physics) or scenery
        if scenery[0] is not self.rest:
            self.primitives.update(scenery[0], all_trees)
        return self._draw_shot(rng, image, scenery, is_negative=self.plan.is_negative(image))

    def _draw_shot(
        self,
        rng: np.random.Generator,
        image: int,
        scenery: Scenery,
        *,
        is_negative: bool = False,
        drive: Drive | None = None,
    ) -> _Shot:
        """Returns a shot with sun, camera and view drawn from the mix. The primitives must be posed to the
        ``scenery``."""
        snapshot, near, activity = scenery
        table = self.plan.mix.table
        sun = draw_sun(rng, table.sun, self.bearing)
        entry = draw_entry(rng, table.cameras)
        zoom = draw_number(rng, entry.zoom)
        spec = CameraSpec.load(entry.camera).coloured(self.plan.colour)
        info = resized_intrinsics(spec, self.plan.size or entry.size)
        info = dataclasses.replace(info, fx=info.fx * zoom, fy=info.fy * zoom)
        view = draw_entry(rng, table.views)
        finder = ViewFinder(self.scene.name, self.primitives, snapshot, near, drive)
        if self.is_dormant:
            seen, values = view_of_node(finder, rng, view, info)
        elif is_negative:
            seen, values = finder.without_bunches(rng, view, info)
        else:
            places = [(one["x"], one["y"]) for one in activity.get("actors", [])]
            seen, values = finder.of_bunch(rng, view, info, places)
        record = {
            "negative": is_negative,
            "sun": {**sun, "bearing": self.bearing},
            "view": {"name": view.name, "camera": entry.camera, "zoom": zoom, **values},
        }
        return _Shot(image, snapshot, activity, spec, seen, record)

    def _render(self, shot: _Shot) -> _Files:
        """Render a shot, to whose state the primitives are posed."""
        image = shot.image
        seen = shot.seen
        sun = tuple(shot.record["sun"]["direction"])
        truths = ground_truth.bunch_truths(self.primitives, shot.snapshot, seen, self.caster)
        camera = Camera(
            shot.spec,
            seen.info,
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
        record = {
            "image": image,
            "file": _file_of("images", image),
            "split": split_of(image, self.plan.images_per_vineyard),
            "scene": {
                "name": self.scene.name,
                "seed": self.scene.seed,
                "digest": self.model.digest(),
                "leafiness": self.scene.season.leafiness,
                "yellow": self.scene.season.yellow,
                "drawn": self.drawn,
            },
            **shot.record,
            **shot.activity,
            "actors": formats.actor_records(shot.activity.get("actors", []), seen.labels),
            "camera": formats.camera_record(shot.spec.model, seen.info, seen.pose),
            "bunches": formats.bunch_records(truths, seen.info, self.ripeness.bunch),
        }
        pixels = {
            "images": frame.rgb,
            "depth": depth_millimetres(frame.exact_depth),
            "measured": depth_millimetres(frame.depth),
            "ids": formats.encode_labels(frame.labels),
            "berries": formats.encode_berry_numbers(seen),
        }
        if self.is_dormant:
            record["nodes"] = node_records(self.model, shot.snapshot, seen)
        if self.plan.semantic:
            pixels["semantic"] = formats.encode_classes(seen)
        setting = SensorSetting(sun, self.plan.seed, image, self.plan.device, threads=1)
        for mount in self.plan.sensors:
            kept = export_frame(mount, self.primitives, shot.snapshot, seen.pose, setting)
            pixels |= {f"{mount.name}/{name}": values for name, values in kept.images.items()}
            record.setdefault("sensors", {})[mount.name] = kept.record
        files = _Files(image, seen, {}, record)
        for kind, values in pixels.items():
            files.add(kind, picture.encode_png(values))
        return files


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
            was, asked = ("another one", "this one") if name == "mix" else (there.get(name), value)
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
    for number, group in itertools.groupby(images, lambda image: image // plan.images_per_vineyard):
        of_vineyard = list(group)
        done = number * plan.images_per_vineyard
        vineyard = VineyardRenderer(plan, number)
        try:
            for image in vineyard.write_images(of_vineyard, folder):
                done = image + 1
                yield image
        except OSError as bad:
            left = next((image for image in of_vineyard if image >= done), done)
            raise _not_written(f"image {left}", folder, bad) from None


def finish(folder: pathlib.Path, images: int, segmentation: str = "polygons", yolo: str = "detect") -> pathlib.Path:
    """Write the files that trainers read, from the records of the first ``images`` images: ``annotations.json`` (COCO),
    ``images/metadata.jsonl`` (Hugging Face), and for YOLO the folder ``labels``, ``data.yaml`` and the lists of images
    that it names, one for each split that has images.

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
    settings = json.loads((folder / "dataset.json").read_text(encoding="utf-8"))
    each = settings["sequence"] or IMAGES_PER_VINEYARD
    coco = formats.coco_json(lambda: map(record, range(images)), settings["seed"], segmentation)
    files: dict[pathlib.Path, Iterable[bytes]] = {target: map(str.encode, coco)}
    files |= {folder / _file_of("labels", number): labels(number) for number in range(images)}
    files[folder / "images" / "metadata.jsonl"] = (formats.metadata_line(record(n)).encode() for n in range(images))
    some = [split for split in SPLITS if split_needs(split, each) <= images]
    for split in some:  # `./` is relative to the list
        names = [f"./{_file_of('images', n)}\n" for n in range(images) if split_of(n, each) == split]
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
