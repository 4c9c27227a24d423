"""The content of a scene file: a vineyard's layout, ground, season, fruit, boxes, sun, wind, and start positions of
robots.

Lengths are in metres, angles in radians, axes as in :mod:`vinesim.core.frames`. The first vine of the first row is at
the origin; vines follow along +x, rows along +y. So a longer row or an additional row changes the position of no other
vine.
"""

from __future__ import annotations

import datetime
import math
import pathlib
from typing import Annotated, Literal

import msgspec
import numpy as np
from PIL import Image, UnidentifiedImageError

from vinesim.core.data_files import DataFileNotFound, find_data_file, is_file
from vinesim.core.geodesy import APRILIA, Geodetic
from vinesim.core.numbers import is_whole
from vinesim.core.toml_loader import DataError, load_toml
from vinesim.scene import plant_parameters, scene_limits
from vinesim.scene.berries import VARIETIES
from vinesim.scene.palette import PaletteTable, resolve
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.plant_import.imported_plant import load_imported_plant
from vinesim.scene.season import SeasonState, state_on

MAX_ROBOTS = 10
"""Largest number of robots in one vineyard (CANOPIES D6.4 section 2.3)."""

Length = Annotated[float, msgspec.Meta(gt=0.0)]
"""A positive length [m]."""
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
"""A fraction from 0 to 1."""
Count = Annotated[int, msgspec.Meta(ge=1)]


class SceneError(DataError):
    """Raised for a scene that cannot be used. The message is one line with file, field, error and correction."""


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Layout(_Part, frozen=True, kw_only=True):
    """Positions of the vines."""

    rows: Count
    vines: Count
    """Number of vines in each row."""
    row_spacing: Length
    vine_spacing: Length
    height: Length
    """Height of the wire net (tendone) or of the fruiting wire (vsp)."""
    missing: tuple[tuple[int, int], ...] = ()
    """Row and place in the row, from 0, of vines that are left out, for example to make room for imported plants. Their
    poles remain."""


class Ruts(_Part, frozen=True, kw_only=True):
    """Ruts that wheels have left in every alley between rows, and beside the first and the last row."""

    depth: Annotated[float, msgspec.Meta(gt=0.0, le=0.4)] = 0.06
    """[m] Depth in the middle of a rut. The default is a guess: a tractor on moist loam."""
    width: Annotated[float, msgspec.Meta(ge=0.1, le=1.5)] = 0.35
    """[m] Width of a rut from edge to edge."""
    gauge: Annotated[float, msgspec.Meta(ge=0.3, le=4.0)] = 1.1
    """[m] Distance between the two ruts of an alley, from middle to middle: the track width of a narrow tractor."""


class Roughness(_Part, frozen=True, kw_only=True):
    """Smooth random unevenness; the scene's seed determines it."""

    deviation: Annotated[float, msgspec.Meta(gt=0.0, le=0.5)] = 0.015
    """[m] Standard deviation of the height."""
    wavelength: Annotated[float, msgspec.Meta(ge=0.2, le=50.0)] = 2.0
    """[m] Shortest wavelength."""


class TerrainTable(_Part, frozen=True, kw_only=True):
    """Uneven ground: the sum of an inclined plane, an image of heights, ruts and roughness. Without this table the
    ground is the plane z = 0."""

    slope: Annotated[float, msgspec.Meta(ge=0.0, le=0.6)] = 0.0
    """[1] Rise of the inclined plane over a metre; 0.1 is a slope of 10 %. The first vine stands at the height 0."""
    direction: float = 0.0
    """[rad] Direction in which the plane rises, from +x, counter-clockwise seen from above."""
    ruts: Ruts | None = None
    roughness: Roughness | None = None
    image: str | None = None
    """PNG file with one channel of 8 or 16 bits; black is the lowest height of ``range``, white the highest. Its first
    row has the highest y. The folder of the scene file is searched first."""
    range: tuple[float, float] = (0.0, 1.0)
    """[m] Heights of black and of white."""
    corner: tuple[float, float] | None = None
    """[m] x and y of the image's lower left pixel; by default the image's middle is the vineyard's."""
    cell: Annotated[float, msgspec.Meta(ge=0.02, le=2.0)] = 0.1
    """[m] Distance between the nodes of the ground, and between the image's pixels."""
    margin: Annotated[float, msgspec.Meta(ge=1.0, le=50.0)] = 8.0
    """[m] Width of the headland around the vineyard with these heights; beyond it the heights of the edge continue."""


class Season(_Part, frozen=True, kw_only=True):
    """State of the canopy on the day of the scene."""

    leafiness: Share = 1.0
    """Share of the nodes that still carry their leaf."""
    yellow: Share = 0.05
    """Share of the leaves that are yellow."""
    fruit_zone_leafiness: Share = 1.0
    """Share of the leaves in the fruit zone that are left after leaf pulling."""
    fruit_zone: Annotated[float, msgspec.Meta(ge=0.0, le=2.0)] = 0.35
    """[m] Distance from the base of its shoot within which a leaf is in the fruit zone; on upright shoots this is the
    height above the cordon. Hedges are pulled 0.3 to 0.4 m high (GUESSED from photographs)."""
    temperatures: tuple[float, float, float, float, float, float, float, float, float, float, float, float] | None = (
        None
    )
    """[degC] Mean temperature of each month, January to December, from which the stages of a scene with a date follow;
    by default those of Latina in Italy, near Aprilia."""


class Clutter(_Part, frozen=True, kw_only=True):
    """Old wood, and things that stand, hang and lie about in a vineyard. The defaults are a tidy vineyard of young
    vines.

    Old wood, stubs and posts can be touched. All else is only seen, by cameras and lidars.
    """

    old_wood: Share = 0.0
    """How gnarled trunks and arms are: bends, burls, spur heads with stubs of old cuts, peeling bark."""
    tendrils: Share = 0.0
    """Tendrils at the nodes of shoots and around wires; 1: at one node of eight."""
    dead_leaves: Share = 0.0
    """Brown curled leaves in the canopy and on wires; 1: one for every twelve leaves."""
    straw: Share = 0.0
    """Dry mown grass on the ground; 1: covers most of it."""
    prunings: Share = 0.0
    """Cut canes on the ground; 1: four on a square metre."""
    hose: Share = 0.0
    """Share of the rows with a drip hose."""
    posts: Literal["plain", "wood", "concrete", "steel", "mixed"] = "plain"
    """Kind of the posts: round grey ones (plain), round wooden ones, square concrete ones, steel profiles, or each row
    its own kind (mixed)."""
    ties: Share = 0.0
    """Plastic bands around arms, and around shoots at wires; 1: six on an arm, and one at every fourth tied place."""
    distant_rows: Share = 0.0
    """Rows of vines beyond the scene's own up to 60 m away, and trees behind them; 1: in every direction. Below 1 a
    share of the four sides is left open."""
    headland: Annotated[float, msgspec.Meta(ge=1.0, le=50.0)] = 5.0
    """[m] Least distance of distant vines from the scene's outermost vines. Below the spacings of rows and vines the
    distant rows continue those of the scene, so robots should not leave the scene's own rows."""


class Fruit(_Part, frozen=True, kw_only=True):
    """Bunches on the vines."""

    bunches: tuple[int, int]
    """Smallest and largest number of bunches on a vine."""
    varieties: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]
    """Names from :data:`vinesim.scene.berries.VARIETIES`. Row i has variety i modulo their number."""
    ripeness: tuple[Share, Share] | None = None
    """Least and greatest ripeness of a bunch, 0 (green) to 1 (ripe), between which bunches are uniformly distributed.
    By default all fruit is ripe, and data sets have bunches of every ripeness. Ripeness and the shares below change
    pictures only."""
    rot: Share = 0.0
    """Share of the bunches with a patch of grey mould (botrytis)."""
    shrivelled: Share = 0.0
    """Share of the bunches with shrivelled berries."""
    sunburn: Share = 0.0
    """Share of the bunches with sunburnt berries on one side."""


class Box(_Part, frozen=True, kw_only=True):
    """A picking box standing on the ground."""

    x: float
    y: float
    yaw: float = 0.0
    size: tuple[Length, Length, Length] = (0.6, 0.4, 0.24)
    """Outer length, width, height [m]."""
    mass: Annotated[float, msgspec.Meta(gt=0.0)] = 1.6
    """[kg] Mass of the empty box."""


class Sun(_Part, frozen=True, kw_only=True):
    """Direction of the sun: either fixed by two angles, or moving from a given hour on."""

    azimuth: float = 0.9
    """[rad] Azimuth from +x, counter-clockwise seen from above."""
    elevation: Annotated[float, msgspec.Meta(ge=-math.pi / 2, le=math.pi / 2)] = 0.9
    """[rad] Elevation above the horizon."""
    hour: Annotated[float, msgspec.Meta(ge=0.0, le=24.0)] | None = None
    """Solar time at the start [h]. If given, the sun moves with simulated time, with x to the east and y to the north,
    and ``azimuth`` and ``elevation`` are ignored."""
    day: Annotated[int, msgspec.Meta(ge=1, le=366)] = 258
    """Day of the year; 258 is the middle of September, the season of table grapes."""
    latitude: Annotated[float, msgspec.Meta(ge=-math.pi / 2, le=math.pi / 2)] = 0.726
    """[rad] Latitude, positive to the north; 41.6 degrees is Aprilia, Italy, where CANOPIES picks."""

    def direction(self, time: float = 0.0) -> tuple[float, float, float]:
        """Returns the unit vector from the ground to the sun, world axes, at simulated ``time`` [s]."""
        if self.hour is not None:
            # Cooper (1969), accurate to 0.4 degrees
            declination = math.radians(23.45) * math.sin(2.0 * math.pi * (284 + self.day) / 365.0)
            return sun_direction(self.hour + time / 3600.0, declination, self.latitude)
        level = math.cos(self.elevation)
        return level * math.cos(self.azimuth), level * math.sin(self.azimuth), math.sin(self.elevation)


def sun_direction(hour: float, declination: float, latitude: float) -> tuple[float, float, float]:
    """Returns the unit vector to the sun (x east, y north, z up) at an hour of solar time [h]; declination and latitude
    [rad]."""
    turn = math.radians(15.0) * (hour - 12.0)
    east = -math.cos(declination) * math.sin(turn)
    north = math.cos(latitude) * math.sin(declination) - math.sin(latitude) * math.cos(declination) * math.cos(turn)
    up = math.sin(latitude) * math.sin(declination) + math.cos(latitude) * math.cos(declination) * math.cos(turn)
    return east, north, up


class Wind(_Part, frozen=True, kw_only=True):
    """The wind, see :class:`vinesim.scene.wind.Wind`. The default is calm air."""

    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[m/s] Velocity of the steady wind, world axes, at the top of the canopy upwind of the first row."""
    gusts: Annotated[float, msgspec.Meta(ge=0.0)] = 0.0
    """Standard deviation of each component about the mean [m/s]."""
    scale: Length = 4.0
    """Length scale of the gusts [m]."""


class Spawn(_Part, frozen=True, kw_only=True):
    """A named start position on the ground for a robot or a person."""

    name: Annotated[str, msgspec.Meta(min_length=1)]
    x: float
    y: float
    yaw: float = 0.0


class Imported(_Part, frozen=True, kw_only=True):
    """A plant imported from another program, and its position."""

    file: str
    """File written by ``vinesim scene import-plant``; the folder of the scene file is searched first."""
    x: float
    y: float
    z: float = 0.0
    """[m] Height of the plant's base above the ground."""
    yaw: float = 0.0
    leaves: bool = True
    """Whether the plant's shoots have leaves, according to the season."""
    tie_gap: Annotated[float, msgspec.Meta(ge=0.0)] = 0.02
    """[m] Largest gap at which a shoot is tied to a wire that it passes; 0: no ties."""


class Datum(_Part, frozen=True, kw_only=True):
    """Position of the world's origin on WGS 84, for GNSS receivers. x points to the east, y to the north."""

    latitude: Annotated[float, msgspec.Meta(ge=-90.0, le=90.0)] = APRILIA.latitude
    """[deg] Latitude, positive to the north."""
    longitude: Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)] = APRILIA.longitude
    """[deg] Longitude, positive to the east."""
    altitude: Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)] = APRILIA.altitude
    """[m] Height above the ellipsoid."""

    @property
    def place(self) -> Geodetic:
        """The position as the functions of :mod:`vinesim.core.geodesy` take it."""
        return Geodetic(self.latitude, self.longitude, self.altitude)


class Scene(_Part, frozen=True, kw_only=True):
    """One vineyard as described by a scene file."""

    name: Annotated[str, msgspec.Meta(min_length=1)]
    seed: Annotated[int, msgspec.Meta(ge=0)]
    training: Literal["tendone", "vsp"]
    """Overhead net (tendone) or vertical shoot positioning (vsp)."""
    plants: str = "vine"
    """File of plant parameters in ``data/plants``."""
    layout: Layout
    terrain: TerrainTable | None = None
    """Uneven ground; the plane z = 0 unless given."""
    date: datetime.date | None = None
    """Date, of which month and day count: shoots, leaves, berries and colours are those of that day, and in winter the
    vines are bare canes with buds (:mod:`vinesim.scene.season`). Without a date the vines are those of harvest."""
    pruning: Literal["spur", "cane"] = "spur"
    """What pruning leaves of last year's canes, in a scene with a date: spurs of two buds on a cordon, or a cane on
    either side of the trunk and a renewal spur."""
    season: Season = Season()
    clutter: Clutter = Clutter()
    palette: PaletteTable = PaletteTable()
    """Colours of leaves, wood, ground and sky. They are not part of the vineyard's digest."""
    fruit: Fruit
    boxes: tuple[Box, ...] = ()
    imported: tuple[Imported, ...] = ()
    sun: Sun = Sun()
    wind: Wind = Wind()
    datum: Datum = Datum()
    spawns: tuple[Spawn, ...] = ()
    physics: PhysicsParameters = PhysicsParameters()
    """Physics parameters. They are not part of the vineyard's digest."""


def load_scene(path_or_name: str | pathlib.Path, seed: int | None = None) -> Scene:
    """Returns the scene in a file, or the scene of that name in ``data/scenes``. Raises :class:`SceneError` if the
    scene cannot be used.

    ``seed`` replaces the seed of the file: the layout stays the same, but the vines differ.
    """
    try:
        path = find_data_file("scenes", str(path_or_name), ".toml")
    except DataFileNotFound as missing:
        raise SceneError(str(missing)) from None
    scene = load_toml(path, Scene, SceneError)
    beside = [msgspec.structs.replace(one, file=str(_beside(path, one.file))) for one in scene.imported]
    scene = msgspec.structs.replace(scene, imported=tuple(beside))
    if scene.terrain is not None and scene.terrain.image is not None:
        image = str(_beside(path, scene.terrain.image))
        scene = msgspec.structs.replace(scene, terrain=msgspec.structs.replace(scene.terrain, image=image))
    return with_seed(check_scene(scene, str(path)), seed)


def check_scene(scene: Scene, source: str) -> Scene:
    """Returns ``scene`` if it is valid. Raises :class:`SceneError` otherwise; the message begins with ``source``."""
    if trouble := _find_error(scene):
        raise SceneError(f"{source}: {trouble}")
    return scene


def _beside(scene: pathlib.Path, file: str) -> pathlib.Path:
    """Returns the path of a file that a scene names: in the scene's folder if the file exists there, else ``file``
    unchanged."""
    return near if is_file(near := scene.parent / file) else pathlib.Path(file)


def _find_error(scene: Scene) -> str:
    """Check rules that the types cannot express. Returns a message with field, error and correction; empty if the scene
    is valid."""
    if excess := scene_limits.find_excess(msgspec.to_builtins(scene)):
        return excess
    low, high = scene.fruit.bunches
    if not 0 <= low <= high:
        return f"fruit.bunches is [{low}, {high}]; give [fewest, most] with 0 <= fewest <= most"
    if scene.fruit.ripeness is not None and scene.fruit.ripeness[0] > scene.fruit.ripeness[1]:
        return f"fruit.ripeness is {list(scene.fruit.ripeness)}; give [least, greatest], 0 to 1, rising"
    rows = scene.layout.rows
    vines = scene.layout.vines
    for i, (row, place) in enumerate(scene.layout.missing):
        if not (0 <= row < rows and 0 <= place < vines):
            return f"layout.missing[{i}] is [{row}, {place}]; give [0 to {rows - 1}, 0 to {vines - 1}]: row, place"
    if len(set(scene.layout.missing)) == rows * vines:
        return f"layout.missing names all {rows * vines} vines; leave one"
    known = [v.name for v in VARIETIES]
    for i, name in enumerate(scene.fruit.varieties):
        if name not in known:
            return f"fruit.varieties[{i}] is {name!r}; give one of: {', '.join(known)}"
    if len(scene.spawns) > MAX_ROBOTS:
        return f"spawns has {len(scene.spawns)} entries; give at most {MAX_ROBOTS}"
    try:
        plant_parameters.load_plant(scene.plants)
    except (DataFileNotFound, DataError) as bad:
        return f"plants is {scene.plants!r}; {bad}"
    try:
        resolve(scene)
    except DataError as bad:
        return f"palette.name is {scene.palette.name!r}; {bad}"
    for i, one in enumerate(scene.imported):
        try:
            load_imported_plant(one.file)
        except DataError as bad:
            return f"imported[{i}].file: {bad}"
    if trouble := _find_date_error(scene) or _find_terrain_error(scene):
        return trouble
    names = [s.name for s in scene.spawns]
    for i, name in enumerate(names):
        if name in names[:i]:
            return f"spawns[{i}].name is {name!r}, as spawns[{names.index(name)}].name; give each its own name"
    return ""


def _find_date_error(scene: Scene) -> str:
    """Check rules of the date that the types cannot express; see :func:`_find_error`."""
    if scene.pruning == "cane" and scene.training != "vsp":
        return 'pruning is "cane" and training is "tendone"; give training = "vsp", or pruning = "spur"'
    if scene.date is None:
        for key, given in (
            ("pruning", scene.pruning != "spur"),
            ("season.temperatures", scene.season.temperatures is not None),
        ):
            if given:
                return f"{key} is given without date; add date = 2026-01-15, or remove {key}"
        return ""
    if scene.datum.latitude < 0.0:
        return (
            f"date is {scene.date} and datum.latitude is {scene.datum.latitude}; the curves are those of the north: "
            "give the date half a year later and a latitude above 0, or remove date"
        )
    try:
        season_of(scene)
    except ValueError as bad:
        return f"date is {scene.date}: {bad}"
    return ""


def season_of(scene: Scene) -> SeasonState | None:
    """Returns the state of the scene's vines on its date; None without a date.

    Raises :class:`ValueError` with one line if the vines do not flower or ripen with the scene's temperatures.
    """
    if scene.date is None:
        return None
    cane = plant_parameters.load_plant(scene.plants).cane
    mean_shoot = float(cane.length.at(0.5)), float(cane.nodes.at(0.5))
    return state_on(scene.date, scene.season.temperatures, mean_shoot)


def on_its_date(scene: Scene) -> Scene:
    """Returns the scene with leaves and fruit of its date: leafiness, share of yellow leaves, and ripeness unless the
    scene gives one. Without a date the scene is returned unchanged."""
    state = season_of(scene)
    if state is None:
        return scene
    season = msgspec.structs.replace(
        scene.season,
        leafiness=scene.season.leafiness * state.shown,
        yellow=1.0 - (1.0 - scene.season.yellow * state.woody) * (1.0 - state.yellow),
    )
    fruit = scene.fruit
    if fruit.ripeness is None:
        fruit = msgspec.structs.replace(fruit, ripeness=state.ripeness)
    return msgspec.structs.replace(scene, season=season, fruit=fruit)


MAX_NODES = 1_000_000
"""Largest number of nodes of uneven ground."""
MAX_PIXELS = 4_000_000
"""Largest number of pixels of an image of heights."""
MAX_SIDE_SLOPE = 1.0
"""[1] Steepest side of a rut, 45 degrees. GUESSED: moist soil slides off steeper sides."""
_RUT_STEEPNESS = 8.0 / (3.0 * math.sqrt(3.0))
"""[1] Steepest slope of a rut's profile (1 - u^2)^2, in units of its depth over half its width."""


def _find_terrain_error(scene: Scene) -> str:
    """Check rules of the terrain that the types cannot express; see :func:`_find_error`."""
    table = scene.terrain
    if table is None:
        return ""
    layout = scene.layout
    ruts = table.ruts
    if ruts is not None:
        steep = _RUT_STEEPNESS * ruts.depth / (0.5 * ruts.width)
        if steep > MAX_SIDE_SLOPE:
            least = _RUT_STEEPNESS * ruts.depth / (0.5 * MAX_SIDE_SLOPE)
            return f"terrain.ruts.width is {ruts.width} m; give {least:.2f} m or more, or a depth below {ruts.depth} m"
        if ruts.gauge + ruts.width > layout.row_spacing or ruts.width > ruts.gauge:
            return (
                f"terrain.ruts.gauge is {ruts.gauge} m; give {ruts.width} m (their width) or more, and at most "
                f"{layout.row_spacing - ruts.width:.2f} m, so that ruts and rows stay apart"
            )
        if table.cell > ruts.width / 3.0:
            return f"terrain.cell is {table.cell} m; give {ruts.width / 3.0:.3f} m or less, a third of a rut's width"
    if table.roughness is not None and table.cell > 0.25 * table.roughness.wavelength:
        most = 0.25 * table.roughness.wavelength
        return f"terrain.cell is {table.cell} m; give {most:.3f} m or less, a quarter of the roughness' wavelength"
    size = [
        count * spacing + 2.0 * table.margin
        for count, spacing in ((layout.vines, layout.vine_spacing), (layout.rows, layout.row_spacing))
    ]
    nodes = size[0] * size[1] / table.cell**2
    if nodes > MAX_NODES:
        least = math.ceil(100.0 * math.sqrt(size[0] * size[1] / MAX_NODES)) / 100.0
        return f"terrain.cell is {table.cell} m, {nodes / 1e6:.0f} million heights; give {least:.2f} m or more"
    low, high = table.range
    if not -100.0 <= low < high <= 100.0:
        return f"terrain.range is [{low}, {high}] m; give [height of black, height of white], -100 to 100 m, rising"
    if table.image is None:
        for key, given in (("range", table.range != (0.0, 1.0)), ("corner", table.corner is not None)):
            if given:
                return f"terrain.{key} is given without terrain.image; add image = ..., or remove {key}"
        return ""
    try:
        load_heights(table)
    except SceneError as bad:
        return str(bad)
    return ""


def load_heights(table: TerrainTable) -> np.ndarray:
    """Returns the heights [row, column] m of a terrain's image; the first row has the lowest y.

    Raises :class:`SceneError` if the image cannot be used.
    """
    path = table.image
    try:
        with Image.open(str(path)) as image:
            mode = image.mode
            if image.width * image.height > MAX_PIXELS:
                raise SceneError(
                    f"terrain.image is {path!r} with {image.width} x {image.height} pixels; give at most {MAX_PIXELS}"
                )
            pixels = np.asarray(image)
    except SceneError:
        raise
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise SceneError(f"terrain.image is {path!r}, which cannot be read; give a grey PNG of 8 or 16 bits") from None
    if pixels.ndim != 2 or mode not in ("L", "I;16", "I;16B", "I") or min(pixels.shape) < 2:
        raise SceneError(
            f"terrain.image is {path!r} with mode {mode} and size {list(pixels.shape[1::-1])}; give a grey PNG of 8 or "
            "16 bits with 2 x 2 pixels or more"
        )
    white = 255.0 if mode == "L" else 65535.0
    low, high = table.range
    return low + (high - low) * (pixels[::-1].astype(float) / white)


def with_palette(scene: Scene, name: str, seed: int | None = None) -> Scene:
    """Returns a copy of the scene with the palette ``name``, drawn with ``seed`` (by default the scene's).

    Raises :class:`SceneError` if the palette does not exist or cannot be used.
    """
    table = PaletteTable(name=name, seed=seed)
    changed = msgspec.structs.replace(scene, palette=table)
    try:
        resolve(changed)
    except DataError as bad:
        raise SceneError(str(bad)) from None
    return changed


def with_seed(scene: Scene, seed: int | None) -> Scene:
    """Returns a copy of the scene with the given seed; None keeps the scene's own seed."""
    if seed is None:
        return scene
    if not is_whole(seed) or not 0 <= seed <= scene_limits.MAX_SEED:
        raise SceneError(f"seed is {seed}: give a whole number of 0 to {scene_limits.MAX_SEED}")
    return msgspec.structs.replace(scene, seed=seed)
