"""``vinesim render``: pictures of a scene with their ground truth, from one viewpoint or from many."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import logging
import pathlib
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from vinesim.core.errors import UsageError, WriteError
from vinesim.core.text_files import CUT, NumberReader, TextError, read_table, read_text

if TYPE_CHECKING:
    from vinesim.client.composition.scene_composer import SceneComposer
    from vinesim.scene.model import Model
    from vinesim.scene.spec import Scene
    from vinesim.scene.values import CameraInfo, RenderedMount, Snapshot
    from vinesim.sensors.camera.camera import CameraSpec
    from vinesim.sensors.primitives.ray_caster import RayCaster
    from vinesim.sensors.primitives.scene_primitives import Primitives

log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """Position of a camera, and the point that it looks at."""

    eye: np.ndarray
    """Position of the camera [3] m."""
    target: np.ndarray
    """Point that the camera looks at [3] m."""
    place: str
    """Place in the user's input where the viewpoint was given, for error messages."""

    def __post_init__(self) -> None:
        for name, point in (("position", self.eye), ("target", self.target)):
            if point.shape != (3,) or not np.isfinite(point).all() or np.abs(point).max() > 1e4:
                raise UsageError(f"{self.place} has the {name} {point.tolist()}; give x, y, z in metres")
        if np.linalg.norm(self.target - self.eye) < 1e-6:
            raise UsageError(f"{self.place} looks at the position of the camera; give another point")


def run(
    scene: str,
    *,
    camera: str,
    at: str | None,
    look: str | None,
    path: pathlib.Path | None = None,
    size: str | None,
    seed: int | None,
    out: pathlib.Path,
    robots: Sequence[str] = (),
    people: Sequence[str] = (),
    crates: Sequence[str] = (),
    hour: float | None = None,
    palette: str | None = None,
    time: float = 0.0,
    device: str = "cpu",
    sensors: Sequence[str] = (),
    colour: str = "camera",
    velocity: str | None = None,
) -> int:
    """Render and write ``rgb``, ``depth``, ``measured``, ``labels``, ``overlay`` PNGs, ``camera``, ``truth`` JSON.

    Each of ``sensors`` measures from the viewpoint as well and writes ``<sensor>_<image>.png`` and ``<sensor>.json``.
    The viewpoint is ``at`` and ``look``. Viewpoints of a ``path`` file go to the folders ``0000``, ``0001``, ... of
    ``out``. Pictures of the same tour that are there already are not rendered again. Returns the exit code.
    """
    viewpoints = _viewpoints(at, look, path)
    if device != "cpu":  # the imports for a GPU cost half a second
        from vinesim.plants.device_buffers import find_device

        find_device(device)
    from vinesim.sensors.camera.camera import CameraSpec
    from vinesim.sensors.export.dataset import resized_intrinsics

    pixels = None if size is None else parse_size(size)
    spec = CameraSpec.load(camera).coloured(colour)
    moving = None if velocity is None else parse_velocity(velocity)
    if moving is not None and spec.colour is None:
        raise UsageError(
            f"--velocity {velocity} has no effect with exact colours; leave it out, or give a --camera whose file has "
            "[colour], such as d435"
        )
    info = resized_intrinsics(spec, pixels)
    mounts = parse_sensors(sensors, pixels)
    staged = parse_composition(robots, people, crates)
    from vinesim.scene.spec import load_scene, with_palette, with_seed

    plan = with_seed(load_scene(scene), seed)
    if palette is not None:
        plan = with_palette(plan, palette)
    if hour is not None:
        plan = msgspec.structs.replace(plan, sun=msgspec.structs.replace(plan.sun, hour=hour))
    actors = {"robots": list(robots), "people": list(people), "crates": list(crates)}
    work = _Work(
        out, viewpoints, path is not None, mounts, plan, camera, spec, info, time, device, actors, colour, moving
    )
    try:
        work.do(staged)
    except KeyboardInterrupt:
        print(work.stopped())
        return 130
    except OSError as bad:
        raise WriteError(
            f"--out {out} cannot be written: {bad.strerror or bad}; free some space or give another folder, and "
            "render again"
        ) from None
    return 0


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Work:
    """Pictures to render, and the folders for them."""

    out: pathlib.Path
    viewpoints: list[Viewpoint]
    is_tour: bool
    """Whether each viewpoint has a folder of its own."""
    sensors: tuple[RenderedMount, ...]
    """Further sensors that measure from the camera's place."""
    plan: Scene
    camera: str
    """File or name of the camera, as the user gave it."""
    spec: CameraSpec
    info: CameraInfo
    time: float
    """Simulated time, which determines wind and sun [s]."""
    device: str
    actors: dict[str, list[str]]
    """Robots, people and crates as the user gave them."""
    colour: str
    velocity: tuple[float, ...] | None
    """Velocity [m/s] and angular velocity [rad/s] of the camera, world axes; None: at rest."""

    def do(self, staged: SceneComposer) -> None:
        """Render and write the missing pictures. Raises OSError if they cannot be written."""
        from vinesim.kernels.compilation import SENSOR_PACKAGES, compile_kernels
        from vinesim.scene.generation.vineyard import generate
        from vinesim.scene.wind import wind_of
        from vinesim.sensors.export import tour_folder
        from vinesim.sensors.primitives.ray_caster import RayCaster
        from vinesim.sensors.primitives.scene_primitives import Primitives

        if self.is_tour:
            tour_folder.check(self.out, self.settings())
        compile_kernels(SENSOR_PACKAGES, self.device)
        model = generate(self.plan)
        view = staged.compose(model, self.plan.physics)
        if (wind := wind_of(self.plan)) is not None:
            from vinesim.wind.sway import windblown  # loading the kernels of plants takes half a second

            view = windblown(model, view, wind, self.time)
        primitives = Primitives(model, device=self.device)
        primitives.update(view)
        for viewpoint in self.viewpoints:
            _check_above_ground(model, viewpoint)
            _check_not_enclosed(primitives, viewpoint)
        if self.is_tour:
            tour_folder.begin(self.out, self.settings())
        else:
            self.out.mkdir(parents=True, exist_ok=True)
        stage = _Stage(
            self.plan,
            model,
            staged,
            view,
            primitives,
            RayCaster(primitives),
            self.spec,
            self.info,
            self.time,
            self.sensors,
            self.velocity,
        )
        done = self.done()
        if done:
            print(f"{self.out}: {len(done)} of {len(self.viewpoints)} pictures are there")
        with concurrent.futures.ThreadPoolExecutor(1, "png") as writer:
            written: concurrent.futures.Future[None] | None = None
            for number, viewpoint in enumerate(self.viewpoints):
                if number in done:
                    continue
                picture, sight = stage.render(viewpoint)
                if written is not None:
                    written.result()
                folder = self.folder(number)
                written = writer.submit(picture.write, folder)  # written while the next picture is rendered
                print(f"{folder}: {sight}", flush=True)
            if written is not None:
                written.result()

    def folder(self, number: int) -> pathlib.Path:
        """Returns the folder of a picture."""
        return self.out / f"{number:04d}" if self.is_tour else self.out

    def done(self) -> set[int]:
        """Returns the numbers of the pictures of this tour that are written. A single picture is always rendered."""
        last = f"{self.sensors[-1].name if self.sensors else 'truth'}.json"  # the last file that _Picture writes
        numbers = range(len(self.viewpoints) if self.is_tour else 0)
        return {number for number in numbers if (self.folder(number) / last).exists()}

    def stopped(self) -> str:
        """Returns the text for the user after an interruption, and removes the folder if it is empty."""
        if self.is_tour:
            return (
                f"stopped with {len(self.done())} of {len(self.viewpoints)} pictures in {self.out}; run the same "
                "command to continue"
            )
        with contextlib.suppress(OSError):  # it has files, or is not there
            self.out.rmdir()
        return f"stopped; no new picture is in {self.out}"

    def settings(self) -> dict[str, Any]:
        """Returns all settings that determine the pictures, for JSON."""
        from vinesim.core.version import __version__

        return {
            "vinesim": __version__,
            "seed": self.plan.seed,
            "camera": self.camera,
            "colour": self.colour,
            "velocity": self.velocity and list(self.velocity),
            "size": [self.info.width, self.info.height],
            "time": self.time,
            "device": self.device.partition(":")[0],  # all GPUs render equal pictures
            **self.actors,
            "sensors": [msgspec.to_builtins(mount) for mount in self.sensors],
            "path": [[*one.eye.tolist(), *one.target.tolist()] for one in self.viewpoints],
            "scene": msgspec.to_builtins(self.plan),
        }


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Picture:
    """A rendered picture with its ground truth, ready to be written."""

    images: dict[str, np.ndarray]
    records: dict[str, Any]

    def write(self, folder: pathlib.Path) -> None:
        """Write all PNG and JSON files, or none. Raises OSError if that fails."""
        from vinesim.sensors.export import annotations as formats
        from vinesim.sensors.export import images as picture
        from vinesim.sensors.export.files import write_files

        folder.mkdir(parents=True, exist_ok=True)
        files = {folder / f"{name}.png": [picture.encode_png(image)] for name, image in self.images.items()}
        files |= {folder / f"{name}.json": [formats.json_text(one).encode()] for name, one in self.records.items()}
        write_files(files)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Stage:
    """A composed scene, ready to be rendered."""

    plan: Scene
    model: Model
    composer: SceneComposer
    view: Snapshot
    primitives: Primitives
    caster: RayCaster
    spec: CameraSpec
    info: CameraInfo
    time: float
    """Simulated time, which determines the position of the sun [s]."""
    sensors: tuple[RenderedMount, ...]
    """Further sensors that measure from the camera's place."""
    velocity: tuple[float, ...] | None
    """Velocity [m/s] and angular velocity [rad/s] of the camera, world axes; None: at rest."""

    def render(self, viewpoint: Viewpoint) -> tuple[_Picture, str]:
        """Returns the picture from a viewpoint, and a text with the numbers of visible bunches, berries and cut
        points."""
        from vinesim.scene.camera_geometry import depth_millimetres
        from vinesim.scene.wind import wind_of
        from vinesim.sensors import ground_truth
        from vinesim.sensors.camera.camera import Camera
        from vinesim.sensors.camera.motion import Motion
        from vinesim.sensors.export import annotations as formats
        from vinesim.sensors.export import images as picture
        from vinesim.sensors.sensor import SensorSetting, export_frame

        pose = picture.look_at(viewpoint.eye, viewpoint.target)
        seen = ground_truth.render_buffers(self.primitives, self.info, pose)
        truths = ground_truth.bunch_truths(self.primitives, self.view, seen, self.caster)
        # each picture has a new camera, so that no picture depends on the one before
        camera = Camera(
            self.spec,
            self.info,
            "camera",
            self.plan.sun.direction(self.time),
            quality="still",
            device=self.primitives.device,
        )
        motion = None if self.velocity is None else Motion(self.velocity[:3], self.velocity[3:])
        frame = camera.render(self.primitives, pose, motion=motion)
        assert frame.exact_depth is not None, "a camera that renders by itself gives exact depth"
        images = {
            "rgb": frame.rgb,
            "depth": depth_millimetres(frame.exact_depth),
            "measured": depth_millimetres(frame.depth),
            "labels": formats.encode_labels(frame.labels),
            "overlay": formats.draw_overlay(frame.rgb, truths),
        }
        actors = formats.actor_records(self.composer.actor_records(self.model), seen.labels)
        described: dict[str, Any] = {
            "scene": self.plan.name,
            "seed": self.plan.seed,
            "digest": self.model.digest(),
            "time": self.time,
            "wind": None if wind_of(self.plan) is None else msgspec.to_builtins(self.plan.wind),
            "actors": actors,
        }
        records = {
            "camera": formats.camera_record(self.spec.model, self.info, pose),
            "truth": {**described, "bunches": formats.bunch_records(truths, self.info)},
        }
        setting = SensorSetting(self.plan.sun.direction(self.time), device=self.primitives.device)
        for mount in self.sensors:
            kept = export_frame(mount, self.primitives, self.view, pose, setting)
            images |= {f"{mount.name}_{name}": values for name, values in kept.images.items()}
            records[mount.name] = kept.record
        in_sight = [one for one in truths if one.pixels]
        return _Picture(images, records), (
            f"{len(in_sight)} bunches, {sum(t.berries_seen for t in in_sight)} of "
            f"{sum(t.berries for t in in_sight)} berries and {sum(t.cut_seen for t in in_sight)} cut points in sight"
        )


def _check_above_ground(model: Model, viewpoint: Viewpoint) -> None:
    """Raise :class:`UsageError` if the camera is not above the ground."""
    from vinesim.scene.terrain import ground_height

    ground = float(ground_height(model.terrain, *viewpoint.eye[:2]))
    if viewpoint.eye[2] <= ground:
        raise UsageError(f"{viewpoint.place} is below the ground; give a height above {ground:.4g}")


def _check_not_enclosed(primitives: Primitives, viewpoint: Viewpoint) -> None:
    """Raise :class:`UsageError` if the camera is inside an object."""
    from vinesim.scene.ids import unlabel
    from vinesim.sensors.primitives.ray_caster import enclosing_primitive

    inside = enclosing_primitive(primitives, viewpoint.eye)
    if inside >= 0:
        organ, index = unlabel(int(primitives.label[inside]))
        raise UsageError(f"{viewpoint.place} is inside {organ.name.lower()} {index}; move the camera out of it")


def _viewpoints(at: str | None, look: str | None, path: pathlib.Path | None) -> list[Viewpoint]:
    """Returns the viewpoints of the command line. Raises :class:`UsageError` if one is wrong or none is given."""
    if path is not None:
        if at is not None or look is not None:
            raise UsageError("--path has the viewpoints; leave out --at and --look")
        return _read_path(path)
    if at is None or look is None:
        raise UsageError("no viewpoint; give --at X,Y,Z and --look X,Y,Z, or --path FILE")
    return [Viewpoint(parse_point("--at", at), parse_point("--look", look), f"--at {at}")]


MAX_SPEED = 100.0
"""Largest speed [m/s] and angular speed [rad/s] of a camera, in each axis."""
_COLUMNS = ("x", "y", "z", "look_x", "look_y", "look_z")


def _read_path(path: pathlib.Path) -> list[Viewpoint]:
    """Returns the viewpoints of a CSV file with the columns x, y, z, look_x, look_y, look_z [m], or of a JSON list of
    objects with those keys. Raises :class:`UsageError` if there are none or one is wrong."""
    try:
        points = _read_json(path) if path.suffix.lower() == ".json" else _read_csv(path)
    except OSError as bad:
        raise UsageError(f"--path {path} cannot be read: {bad.strerror}; give a CSV or JSON file") from None
    except TextError as bad:
        raise UsageError(f"--path {bad.at(path)}") from None
    if not points:
        raise UsageError(f"--path {path} has no viewpoint; give a line for each")
    return [Viewpoint(np.array(p[:3]), np.array(p[3:]), f"--path {path}, viewpoint {i}") for i, p in enumerate(points)]


def _read_csv(path: pathlib.Path) -> list[list[float]]:
    """Returns the rows of the six columns. Raises :class:`TextError`."""
    table = read_table(path)
    if table is None:
        return []
    names = [name.lower() for name in table.head.cells]
    for name in _COLUMNS:
        if names.count(name) != 1:
            raise TextError(
                f"{names.count(name)} columns are named {name!r}; give the columns {', '.join(_COLUMNS)} in metres, "
                "once each",
                table.head.line,
            )
    numbers = NumberReader()
    points = []
    for line, cells in table.rows:
        points.append([])
        for name in _COLUMNS:
            try:
                points[-1].append(numbers.read(cells[names.index(name)]))
            except TextError as bad:
                raise TextError(f"column {name!r} is {bad}", line) from None
    if table.is_cut:
        log.warning("%s: %s", path, CUT)
    return points


def _read_json(path: pathlib.Path) -> list[list[float]]:
    """Returns the six numbers of each object in a list. Raises :class:`TextError`."""
    keys = f"give a list of objects with {', '.join(_COLUMNS)} in metres"
    try:
        rows = msgspec.json.decode(read_text(path))
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise TextError(f"is no list of objects; {keys}")
        points = [[float(row[name]) for name in _COLUMNS] for row in rows]
    except msgspec.DecodeError as bad:
        raise TextError(f"is no JSON: {bad}; {keys}") from None
    except TextError:
        raise
    except (KeyError, TypeError, ValueError) as bad:
        raise TextError(f"has no viewpoint with all numbers ({type(bad).__name__} {bad}); {keys}") from None
    if not np.isfinite(points).all():
        raise TextError(f"has a number that is not finite; {keys}")
    return points


def parse_composition(robots: Sequence[str], people: Sequence[str], crates: Sequence[str]) -> SceneComposer:
    """Returns the actors and crates of ``--robot``, ``--person`` and ``--crate``. Raises :class:`UsageError` if one is
    wrong."""
    from vinesim.client.composition.scene_composer import CratePlacement, PersonPlacement, RobotPlacement, SceneComposer
    from vinesim.robot.description.loader import load_description
    from vinesim.scene import appearance

    placed_robots = []
    placed_people = []
    placed_crates = []
    for text in robots:
        name, mark, where = text.rpartition("@")
        if not (mark and name):
            raise UsageError(f"--robot is {text!r}; give NAME@X,Y,YAW, such as vinebot@1.5,0.8,3.14")
        load_description(name)  # raises DescriptionError
        placed_robots.append(RobotPlacement(name, *_parse_place("--robot", where, 3)))
    for text in people:
        parts = text.split(",")
        posture = parts.pop() if len(parts) > 1 and parts[-1].strip().isidentifier() else "stand"
        if posture not in appearance.posture_names():
            raise UsageError(f"--person {text}: posture {posture!r} is none of {', '.join(appearance.posture_names())}")
        x, y, yaw = (*_parse_place("--person", ",".join(parts), 3), 0.0)[:3]
        placed_people.append(PersonPlacement(x, y, yaw, posture))
    for text in crates:
        x, y, yaw, fill = (*_parse_place("--crate", text, 4), 0.0, 0.0)[:4]
        crate = CratePlacement(x, y, yaw, fill)
        if not 0.0 <= crate.fill <= 1.0:
            raise UsageError(f"--crate {text}: the fill is {crate.fill:g}; give 0 (empty) to 1 (full)")
        placed_crates.append(crate)
    return SceneComposer(tuple(placed_robots), tuple(placed_people), tuple(placed_crates))


def _parse_place(option: str, text: str, most: int) -> list[float]:
    """Returns ``X,Y[,YAW[,...]]`` as two to ``most`` numbers."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not 2 <= len(values) <= most or not np.isfinite(values).all() or max(map(abs, values)) > 1e4:
        fields = ",".join(("X", "Y", "YAW", "FILL")[:most])
        raise UsageError(f"{option} is at {text!r}; give {fields} in metres and radians, such as 1.5,0.8,3.14")
    return values


def parse_point(option: str, text: str) -> np.ndarray:
    """Returns ``X,Y,Z`` as a point [3] m."""
    try:
        value = np.array([float(part) for part in text.split(",")])
    except ValueError:
        value = np.zeros(0)
    if value.shape != (3,) or not np.isfinite(value).all() or np.abs(value).max() > 1e4:
        raise UsageError(f"{option} is {text!r}; give X,Y,Z in metres, such as 1.2,0.8,1.4")
    return value


def parse_sensors(texts: Sequence[str], size: tuple[int, int] | None) -> tuple[RenderedMount, ...]:
    """Returns the sensors of ``--sensor``, with pictures of the given ``size`` [px]. Raises :class:`UsageError` if one
    is wrong."""
    from vinesim.scene.values import SENSOR_KINDS, PictureMount
    from vinesim.sensors.sensor import maker

    mounts: dict[str, RenderedMount] = {}
    kinds = [kind for kind in SENSOR_KINDS if texts and maker(kind).export is not None]
    for text in texts:
        kind, _, file = text.partition(":")
        if kind not in kinds or not file:
            raise UsageError(f"--sensor is {text!r}; give KIND:FILE, of the kind {' or '.join(kinds)}")
        maker(kind).rate(file)  # raises SensorError
        mount = SENSOR_KINDS[kind].mount(pathlib.Path(file).stem, "camera_optical_frame", file)
        if isinstance(mount, PictureMount):
            mount = msgspec.structs.replace(mount, size=size)
        if mount.name in mounts:
            raise UsageError(f"--sensor {text}: there are two of the name {mount.name!r}; rename one of the files")
        mounts[mount.name] = mount
    return tuple(mounts.values())


def parse_velocity(text: str) -> tuple[float, ...]:
    """Returns ``VX,VY,VZ[,WX,WY,WZ]`` as velocity [m/s] and angular velocity [rad/s]."""
    with contextlib.suppress(ValueError):
        numbers = [float(one) for one in text.split(",")]
        if len(numbers) in (3, 6) and all(abs(one) <= MAX_SPEED for one in numbers):  # excludes NaN
            return tuple(numbers + [0.0] * (6 - len(numbers)))
    raise UsageError(
        f"--velocity is {text!r}; give VX,VY,VZ in m/s, or with WX,WY,WZ in rad/s, each {MAX_SPEED:g} at most"
    )


def parse_size(text: str) -> tuple[int, int]:
    """Returns ``WxH`` as width and height [px]."""
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    if match is None:
        raise UsageError(f"--size is {text!r}; give WxH in pixels, such as 640x480")
    return int(match[1]), int(match[2])
