"""Mixes: what the vineyards and pictures of a data set are drawn from, as TOML files in ``data/mixes``.

One law holds for every value of a mix. A list of rising numbers is a distribution by equally likely steps: of
``[0.5, 0.8, 2.0]`` half of the draws are between 0.5 and 0.8, the others between 0.8 and 2. A list of anything else is
a list of equally likely choices, a table of names and numbers is one of choices with weights, and any other value is a
constant.

Table ``vary`` has such values for fields of scene files, by their dotted names. So a new field of scenes needs no code
here. The scene with each value that a field may have is checked when the mix is read.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import pathlib
from collections.abc import Iterator
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np

from vinesim.core.data_files import DataFileNotFound, find_data_file
from vinesim.core.toml_loader import DataError, field_type, load_toml, to_struct
from vinesim.scene.spec import Count, Scene, Share, check_scene, load_scene, sun_direction
from vinesim.sensors.camera.camera import CameraSpec
from vinesim.sensors.spec_file import SensorError

LATITUDE = np.radians(41.6)
"""Latitude [rad] of the vineyards near Aprilia, Italy, where CANOPIES picks; it determines the sun's path."""
DECLINATION = (np.radians(-8.0), np.radians(16.0))
"""Range of the sun's declination [rad] from August to October."""

Weight = Annotated[float, msgspec.Meta(ge=0.0)]
"""A share of the draws, relative to the other weights."""
Numbers = float | Annotated[tuple[float, ...], msgspec.Meta(min_length=2)]
"""A number, or a distribution of numbers: rising numbers between which equally many draws are."""


class MixError(DataError):
    """Raised for a mix that cannot be used. The message is one line with file, field, error and correction."""


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class SceneEntry(_Table, frozen=True, kw_only=True):
    """A scene of which a share of the vineyards are."""

    scene: str
    """A scene file (the mix's folder is searched first), or the name of a shipped scene."""
    weight: Weight = 1.0
    vary: dict[str, Any] = {}
    """As :attr:`Mix.vary`, for this scene alone; it replaces equal fields there."""


class CameraEntry(_Table, frozen=True, kw_only=True):
    """A camera by which a share of the pictures are taken."""

    camera: str
    """A camera file, or the name of a shipped camera."""
    weight: Weight = 1.0
    size: tuple[Count, Count] | None = None
    """[px] Width and height at the same horizontal field of view; by default the camera's own."""
    zoom: Numbers = 1.0
    """Factor on the focal length, as of a lens that zooms, or of a picture that is cropped and enlarged."""


class ViewEntry(_Table, frozen=True, kw_only=True):
    """Views of a bunch that a share of the pictures are. Angles are in radians."""

    name: str
    weight: Weight = 1.0
    distance: Numbers
    """[m] Distance from the camera to the middle of the bunch; with ``bunch_height`` only its limits are used."""
    bunch_height: Numbers | None = None
    """Height of the bunch as a share of the picture's height, which then determines the distance."""
    pitch: Numbers = 0.0
    """Angle by which the camera looks up."""
    turn: Numbers = 0.0
    """Angle between the camera's direction and the normal of the row, seen from above."""
    roll: Numbers = 0.0
    across: Numbers = 0.0
    """Position of the bunch right of the picture's middle, as a share of the picture's width."""
    down: Numbers = 0.0
    """Position of the bunch below the picture's middle, as a share of the picture's height."""
    camera_height: tuple[float, float]
    """[m] Lowest and highest place of the camera above the ground."""
    bunches: Count = 1
    """Least number of bunches in view that are large enough to be annotated."""
    visible: Share = 0.0
    """Least visible share of the bunch, taken as an ellipse."""


_Entry = TypeVar("_Entry", CameraEntry, ViewEntry)


class SunTable(_Table, frozen=True, kw_only=True):
    """The sun: on its path at 41.6 degrees north on a day from August to October."""

    elevation: Numbers
    """[rad] Elevation; at most that at noon."""
    bearing: Numbers = 0.0
    """[rad] Direction of the rows, from east to north; it turns the sun's path about the vineyard."""


class SequenceTable(_Table, frozen=True, kw_only=True):
    """Motion of the camera in sequences: along the row, on uneven ground."""

    rate: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)] = 10.0
    """[Hz] Frames in a second; rounded so that a whole number of steps is between two frames."""
    speed: Numbers = (0.2, 0.8)
    """[m/s] Speed along the row."""
    heave: Annotated[float, msgspec.Meta(ge=0.0, le=0.2)] = 0.004
    """[m] Amplitude of the camera's motion up and down. GUESSED: a tracked robot on sod."""
    rock: Annotated[float, msgspec.Meta(ge=0.0, le=0.3)] = 0.006
    """[rad] Amplitude of the camera's pitch and roll. GUESSED, as ``heave``."""


class Mix(_Table, frozen=True, kw_only=True):
    """The content of a mix file."""

    scenes: Annotated[tuple[SceneEntry, ...], msgspec.Meta(min_length=1)]
    cameras: Annotated[tuple[CameraEntry, ...], msgspec.Meta(min_length=1)]
    views: Annotated[tuple[ViewEntry, ...], msgspec.Meta(min_length=1)]
    sun: SunTable
    vary: dict[str, Any] = {}
    """Values of scene fields by their dotted names, one draw for each vineyard."""
    actors: Share = 0.4
    """Share of the pictures with people, robots, crates and wind."""
    negatives: Share = 0.0
    """Share of the pictures in which no bunch is visible."""
    sequence: SequenceTable = SequenceTable()


@dataclasses.dataclass(frozen=True, slots=True)
class LoadedMix:
    """A mix with its scenes."""

    table: Mix
    scenes: tuple[Scene, ...]
    """The scenes of :attr:`Mix.scenes`, as their files describe them."""

    def settings(self) -> dict[str, Any]:
        """Returns everything that determines the draws, for JSON."""
        return {**msgspec.to_builtins(self.table), "scene_files": [msgspec.to_builtins(one) for one in self.scenes]}

    def vineyard(self, rng: np.random.Generator) -> tuple[Scene, dict[str, Any]]:
        """Returns the scene of a vineyard, with a seed of its own, and the drawn values of its fields."""
        number = _weighted(rng, [one.weight for one in self.table.scenes])
        scene = msgspec.structs.replace(self.scenes[number], seed=int(rng.integers(1 << 31)))
        vary = {**self.table.vary, **self.table.scenes[number].vary}
        drawn = {name: _draw(rng, field_type(Scene, name), value) for name, value in vary.items()}
        return _with_fields(scene, drawn, f"scene {scene.name!r} of the mix"), drawn


def load_mix(path_or_name: str | pathlib.Path, scene: str | None = None, camera: str | None = None) -> LoadedMix:
    """Returns the mix in a file, or the mix of that name in ``data/mixes``.

    Args:
        path_or_name: a file or a name.
        scene: scene file, or name of a scene, that replaces the scenes of the mix.
        camera: camera file, or name of a camera, that replaces the cameras of the mix.

    Raises :class:`MixError` if the mix, or one of the scenes or cameras that it names, cannot be used.
    """
    try:
        path = find_data_file("mixes", str(path_or_name), ".toml")
    except DataFileNotFound as missing:
        raise MixError(str(missing)) from None
    mix = load_toml(path, Mix, MixError)
    if camera is not None:
        CameraSpec.load(camera)
        mix = msgspec.structs.replace(mix, cameras=(CameraEntry(camera=camera),))
    if scene is not None:
        own = next((one.vary for one in mix.scenes if one.scene == scene), {})
        mix = msgspec.structs.replace(mix, scenes=(SceneEntry(scene=scene, vary=own),))
        loaded = [load_scene(scene)]
    else:
        loaded = [_load_scene(path, i, one.scene) for i, one in enumerate(mix.scenes)]
    _check_numbers(path, mix)
    for i, one in enumerate(mix.cameras):
        try:
            CameraSpec.load(one.camera)
        except (DataFileNotFound, SensorError) as bad:
            raise MixError(f"{path}: cameras[{i}].camera is {one.camera!r}; {bad}") from None
    for i, (entry, one) in enumerate(zip(mix.scenes, loaded, strict=True)):
        for name in {**mix.vary, **entry.vary}:
            place = f"scenes[{i}].vary" if name in entry.vary else "vary"
            _check_field(f'{path}: {place}."{name}"', one, name, entry.vary.get(name, mix.vary.get(name)))
    return LoadedMix(mix, tuple(loaded))


def _check_field(source: str, scene: Scene, name: str, value: Any) -> None:
    """Raise :class:`MixError` if the field ``name`` of the scene cannot have each value that ``value`` stands for."""
    try:
        kind = field_type(Scene, name)
    except DataError as bad:
        raise MixError(f"{source}: {bad}") from None
    for possible in _possible(source, kind, value):
        _with_fields(scene, {name: possible}, f"{source} in scene {scene.name!r}")


def _load_scene(mix: pathlib.Path, number: int, name: str) -> Scene:
    beside = mix.parent / name
    try:
        return load_scene(beside if beside.is_file() else name)
    except DataError as bad:
        raise MixError(f"{mix}: scenes[{number}].scene is {name!r}; {bad}") from None


def _check_numbers(path: pathlib.Path, mix: Mix) -> None:
    """Check rules that the types cannot express. Raises :class:`MixError`."""
    for place, entries in (("scenes", mix.scenes), ("cameras", mix.cameras), ("views", mix.views)):
        if not any(one.weight for one in entries):
            raise MixError(f"{path}: {place} have no weight above 0; give one of them a weight")
    limits = {"zoom": (0.1, 20.0), "distance": (0.1, 20.0), "bunch_height": (0.01, 2.0), "pitch": (-1.5, 1.5)}
    limits |= {"across": (-0.5, 0.5), "down": (-0.5, 0.5), "camera_height": (0.05, 10.0), "speed": (-5.0, 5.0)}
    limits |= {"elevation": (0.0, 0.5 * math.pi)}
    tables = [
        *((f"cameras[{i}]", one) for i, one in enumerate(mix.cameras)),
        *((f"views[{i}]", one) for i, one in enumerate(mix.views)),
        ("sun", mix.sun),
        ("sequence", mix.sequence),
    ]
    for place, table in tables:
        for name in table.__struct_fields__:
            value = getattr(table, name)
            if name == "size" or not isinstance(value, float | tuple):
                continue
            numbers = list(value) if isinstance(value, tuple) else [value]
            source = f"{path}: {place}.{name}"
            _check_rising(source, numbers)
            low, high = limits.get(name, (-math.inf, math.inf))
            if not low <= numbers[0] <= numbers[-1] <= high:
                raise MixError(f"{source} is {_shown(value)}; give numbers from {low:g} to {high:g}")


def _check_rising(source: str, numbers: list[float]) -> None:
    if any(a > b for a, b in itertools.pairwise(numbers)):
        raise MixError(f"{source} is {numbers}; give rising numbers: [least, ..., largest]")


def _shown(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_list(kind: msgspec.inspect.Type) -> bool:
    return isinstance(kind, msgspec.inspect.CollectionType | msgspec.inspect.TupleType)


def _is_constant(kind: msgspec.inspect.Type, value: Any) -> bool:
    """Returns whether ``value`` has the form of a field of the type ``kind``, so that nothing is drawn."""
    if _is_list(kind):
        return isinstance(value, list) and not any(isinstance(one, list) for one in value)
    return not isinstance(value, list | dict)


def _possible(source: str, kind: msgspec.inspect.Type, value: Any) -> Iterator[Any]:
    """Yield values that :func:`_draw` may return, among them the extreme ones. Raises :class:`MixError` for a
    ``value`` from which nothing can be drawn."""
    if _is_constant(kind, value):
        yield value
    elif not value:
        raise MixError(f"{source} is {value}; give a value, a range or choices")
    elif isinstance(value, dict):
        if not all(_is_number(weight) and weight >= 0.0 for weight in value.values()) or not any(value.values()):
            raise MixError(f"{source} is {value}; give names with weights of 0 or more, one of them above 0")
        yield from ([name] if _is_list(kind) else name for name in value)
    elif all(map(_is_number, value)):
        _check_rising(source, value)
        yield from (value[0], value[-1])
    else:
        yield from value


def _draw(rng: np.random.Generator, kind: msgspec.inspect.Type, value: Any) -> Any:
    """Returns a value for a field of the type ``kind``, drawn by the law at the top of this module.

    For a field that is a list, a table of names and weights is an order of all names with a weight above 0, in which
    names with a large weight tend to be first.
    """
    if _is_constant(kind, value):
        return value
    if isinstance(value, dict):
        names = [name for name, weight in value.items() if weight > 0.0]
        weights = np.array([value[name] for name in names], float)
        if not _is_list(kind):
            return names[_weighted(rng, weights)]
        return [names[k] for k in np.argsort(rng.exponential(size=len(names)) / weights)]
    if not all(map(_is_number, value)):
        return value[int(rng.integers(len(value)))]
    if isinstance(kind, msgspec.inspect.IntType):
        return min(math.floor(draw_number(rng, (*value[:-1], value[-1] + 1))), int(value[-1]))
    return round(draw_number(rng, tuple(value)), 4)


def draw_number(rng: np.random.Generator, numbers: Numbers) -> float:
    """Returns a number drawn from a distribution."""
    if isinstance(numbers, float | int):
        return float(numbers)
    return float(np.interp(rng.random(), np.linspace(0.0, 1.0, len(numbers)), numbers))


def draw_entry(rng: np.random.Generator, entries: tuple[_Entry, ...]) -> _Entry:
    """Returns one of the entries, by their weights."""
    return entries[_weighted(rng, [one.weight for one in entries])]


def _weighted(rng: np.random.Generator, weights: Any) -> int:
    ends = np.cumsum(np.asarray(weights, float))
    return int(np.searchsorted(ends, rng.random() * ends[-1], side="right"))


def _with_fields(scene: Scene, fields: dict[str, Any], source: str) -> Scene:
    """Returns the scene with other values in ``fields`` (by dotted names). Raises :class:`MixError` if they do not
    fit; the message begins with ``source``."""
    data = msgspec.to_builtins(scene)
    for name, value in fields.items():
        *tables, last = name.split(".")
        table = data
        for word in tables:
            table[word] = table.get(word) or {}
            table = table[word]
        table[last] = value
    try:
        return check_scene(to_struct(data, Scene, source, MixError), source)
    except DataError as bad:
        raise MixError(str(bad)) from None


def draw_sun(rng: np.random.Generator, table: SunTable, bearing: float) -> dict[str, Any]:
    """Returns solar time ``hour`` [h], ``elevation`` [rad] and ``direction``, the unit vector towards the sun, in a
    vineyard whose rows have the direction ``bearing`` [rad] from east."""
    declination = rng.uniform(*DECLINATION)
    level = math.cos(LATITUDE) * math.cos(declination)
    rise = math.sin(LATITUDE) * math.sin(declination)
    elevation = draw_number(rng, table.elevation)
    turn = math.acos(min((math.sin(elevation) - rise) / level, 1.0))  # at noon if the sun never stands so high
    hour = 12.0 + math.degrees(turn) / 15.0 * (1.0 if rng.random() < 0.5 else -1.0)
    east, north, up = sun_direction(hour, declination, float(LATITUDE))
    c, s = math.cos(bearing), math.sin(bearing)
    return {
        "hour": hour,
        "elevation": math.asin(up),
        "direction": [c * east + s * north, c * north - s * east, up],
    }
