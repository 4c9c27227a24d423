"""Palettes: the colours of one vineyard - leaves, wood, ground, sky - drawn from the ranges of a file in
``data/palettes``.

A file gives a colour as ranges of hue, saturation and value: the sRGB colour that a photograph in white light shows
(without a tone curve). A :class:`Palette` holds linear RGB reflectances, because renderers compute with these. The
palette ``default`` has no file: its colours are the defaults of the classes below. The palette ``any`` takes leaves,
wood, ground and sky from four palettes that its seed chooses.
"""

from __future__ import annotations

import colorsys
import math
import typing
import zlib
from typing import Annotated, Protocol

import msgspec
import numpy as np

from vinesim.core.data_files import DataFileNotFound, data_dir, find_data_file
from vinesim.core.toml_loader import DataError, load_toml
from vinesim.scene.plant_parameters import Grade, Range

DEFAULT_NAME = "default"
ANY_NAME = "any"

Rgb = tuple[float, float, float]
"""A linear RGB reflectance, or a relative radiance of sky and light."""


class PaletteTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table ``[palette]`` of a scene: which colours the vineyard has."""

    name: Annotated[str, msgspec.Meta(min_length=1)] = DEFAULT_NAME
    """Name from :func:`palette_names`, ``any``, or path of a file."""
    seed: Annotated[int, msgspec.Meta(ge=0)] | None = None
    """Seed of the draw from the ranges; the scene's seed unless given."""


class _Colours(msgspec.Struct, frozen=True, kw_only=True):
    pass


class LeafColours(_Colours, frozen=True, kw_only=True):
    """Colours of leaves. The defaults are GUESSED, by eye."""

    grown: Rgb = (0.042, 0.115, 0.016)
    """Mean reflectance of the upper side of grown leaves."""
    young: Rgb = (0.042, 0.115, 0.016)
    """Mean reflectance of the youngest leaves, at the tip of a shoot."""
    pale: Rgb = (0.030, 0.035, 0.0)
    """Reflectance that a pale leaf has in addition, once to twice."""
    hue_spread: float = 8.0
    """[deg] Standard deviation of the hue from leaf to leaf."""
    value_spread: float = 0.10
    """[1] Relative standard deviation of the reflectance from leaf to leaf, besides its dependence on age."""
    under: Rgb = (0.22, 0.27, 0.16)
    """Felt of the lower side."""
    under_vein: Rgb = (0.34, 0.38, 0.20)
    vein: Rgb = (0.20, 0.28, 0.08)
    through: Rgb = (2.3, 2.0, 0.75)
    """Transmittance divided by reflectance."""
    margins: float = 1.0
    """Share by which old leaves that have not turned yellow show yellow margins, 0 to 1. Leaves that
    ``season.yellow`` has turned always show them."""
    margin: Rgb = (0.40, 0.34, 0.05)
    scorch: Rgb = (0.16, 0.085, 0.03)
    """Dead edge of a leaf."""
    petiole: Rgb = (0.21, 0.13, 0.06)
    shade: Rgb = (0.14, 0.19, 0.075)
    """Light inside the canopy that leaves transmit, relative to white light at noon."""


class WoodColours(_Colours, frozen=True, kw_only=True):
    """Colours of canes, old wood and trellis. The defaults are GUESSED, by eye."""

    cane: Rgb = (0.30, 0.17, 0.08)
    node: Rgb = (0.24, 0.15, 0.07)
    blotch: Rgb = (0.20, 0.10, 0.045)
    """Dark blotches on canes."""
    stem: Rgb = (0.19, 0.22, 0.075)
    """Green stems: tips of shoots, stalks of bunches."""
    bark_dark: Rgb = (0.085, 0.063, 0.045)
    bark_light: Rgb = (0.23, 0.175, 0.125)
    post: Rgb = (0.36, 0.33, 0.29)
    wire: Rgb = (0.33, 0.34, 0.35)


class GroundColours(_Colours, frozen=True, kw_only=True):
    """Colours and shares of soil, sod, straw, grass and fallen leaves. The defaults are GUESSED, by eye."""

    soil_dark: Rgb = (0.11, 0.072, 0.042)
    soil_light: Rgb = (0.28, 0.195, 0.12)
    turf_dark: Rgb = (0.035, 0.055, 0.014)
    turf_light: Rgb = (0.13, 0.15, 0.042)
    field: Rgb = (0.055, 0.085, 0.022)
    """Sod of the fields around the vineyard."""
    dry: Rgb = (0.33, 0.26, 0.12)
    """Dry grass."""
    straw: Rgb = (0.42, 0.33, 0.17)
    cover: float = 0.0
    """Added to the noise that decides where sod is: below 0 there is less sod, above 0 more."""
    most_cover: float = 0.85
    """Largest share of sod at one place."""
    far_cover: float = 1.0
    """Share of sod of the fields around the vineyard, relative to the default's."""
    strip: float = 1.0
    """Contrast between bare ground under the vines and sod between the rows; negative: bare between the rows."""
    dry_share: float = 0.0
    """Share of the sod and of the grass that is dry."""
    straw_share: float = 0.0
    """Share of the bare soil that straw covers."""
    grass: Rgb = (0.075, 0.12, 0.022)
    weathered: Rgb = (0.10, 0.07, 0.02)
    """Reflectance that a weathered tuft of grass has in addition, at most."""
    litter_pale: Rgb = (0.30, 0.24, 0.05)
    litter_brown: Rgb = (0.17, 0.10, 0.045)
    litter: float = 1.0
    """Number of fallen leaves, relative to the default's."""
    bounce: Rgb = (0.26, 0.21, 0.13)
    """Light that the ground reflects onto plants, relative to white light at noon."""


class SkyColours(_Colours, frozen=True, kw_only=True):
    """Colours of sky, haze and horizon, and the light of the sky. The defaults are GUESSED, by eye."""

    zenith: Rgb = (0.13, 0.30, 0.78)
    horizon: Rgb = (0.52, 0.68, 0.92)
    cloud: Rgb = (1.35, 1.33, 1.30)
    clouds: float = 0.55
    """Opacity of thin clouds, 0 to 1."""
    overcast: float = 0.0
    """Share of a closed layer of clouds, 0 to 1: it whitens the sky, and dims the sun."""
    far_hills: Rgb = (0.36, 0.47, 0.62)
    hills: Rgb = (0.22, 0.32, 0.36)
    trees: Rgb = (0.095, 0.14, 0.085)
    trees_spread: Rgb = (0.10, 0.14, 0.05)
    """Range of the trees' colour, from dark to light."""
    light: Rgb = (0.52, 0.70, 1.0)
    """Light of the sky on the ground at noon."""
    sun: float = 1.0
    """Sunlight relative to that of a clear sky."""
    haze: Rgb = (0.50, 0.60, 0.72)
    haze_rate: float = 0.006
    """[1/m] Rate at which things fade into the haze with distance."""


class Palette(msgspec.Struct, frozen=True, kw_only=True):
    """The colours of one vineyard. Colours are linear RGB."""

    name: str = DEFAULT_NAME
    leaf: LeafColours = LeafColours()
    wood: WoodColours = WoodColours()
    ground: GroundColours = GroundColours()
    sky: SkyColours = SkyColours()


DEFAULT = Palette()
"""The palette of scenes that name none."""

Hue = Annotated[float, msgspec.Meta(ge=0.0, le=360.0)]
Part = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class Tone(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A range of colours: sRGB in white light as hue [deg], saturation [1] and value [1], with grade and source."""

    hue: tuple[Hue, Hue]
    saturation: tuple[Part, Part]
    value: tuple[Part, Part]
    grade: Grade
    source: str


class _Ranges(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class LeafRanges(_Ranges, frozen=True, kw_only=True):
    """Table ``[leaf]`` of a palette's file; see :class:`LeafColours`."""

    grown: Tone | None = None
    young: Tone | None = None
    under: Tone | None = None
    petiole: Tone | None = None
    margin: Tone | None = None
    scorch: Tone | None = None
    hue_spread: Annotated[Range, "deg", (0.0, 60.0)] | None = None
    value_spread: Annotated[Range, "1", (0.0, 0.5)] | None = None
    margins: Annotated[Range, "1", (0.0, 1.0)] | None = None


class WoodRanges(_Ranges, frozen=True, kw_only=True):
    """Table ``[wood]`` of a palette's file; see :class:`WoodColours`."""

    cane: Tone | None = None
    stem: Tone | None = None
    bark_dark: Tone | None = None
    bark_light: Tone | None = None
    post: Tone | None = None
    wire: Tone | None = None


class GroundRanges(_Ranges, frozen=True, kw_only=True):
    """Table ``[ground]`` of a palette's file; see :class:`GroundColours`."""

    soil_dark: Tone | None = None
    soil_light: Tone | None = None
    turf_dark: Tone | None = None
    turf_light: Tone | None = None
    dry: Tone | None = None
    straw: Tone | None = None
    litter_brown: Tone | None = None
    cover: Annotated[Range, "1", (0.0, 1.0)] | None = None
    """Share of the vineyard's ground that is covered with sod."""
    strip: Annotated[Range, "1", (-2.0, 2.0)] | None = None
    dry_share: Annotated[Range, "1", (0.0, 1.0)] | None = None
    straw_share: Annotated[Range, "1", (0.0, 1.0)] | None = None
    litter: Annotated[Range, "1", (0.0, 4.0)] | None = None


class SkyRanges(_Ranges, frozen=True, kw_only=True):
    """Table ``[sky]`` of a palette's file; see :class:`SkyColours`."""

    zenith: Tone | None = None
    horizon: Tone | None = None
    haze: Tone | None = None
    hills: Tone | None = None
    trees: Tone | None = None
    clouds: Annotated[Range, "1", (0.0, 1.0)] | None = None
    overcast: Annotated[Range, "1", (0.0, 1.0)] | None = None
    haze_rate: Annotated[Range, "1/m", (0.0, 0.1)] | None = None


class PaletteRanges(_Ranges, frozen=True, kw_only=True):
    """Content of a file of ``data/palettes``. What a file leaves out is as in the palette ``default``."""

    leaf: LeafRanges = LeafRanges()
    wood: WoodRanges = WoodRanges()
    ground: GroundRanges = GroundRanges()
    sky: SkyRanges = SkyRanges()


def palette_names() -> tuple[str, ...]:
    """Returns the names of the palettes that ship with vinesim: ``default``, and those of ``data/palettes``.

    A scene may also name ``any``, which mixes them: ``[palette] name = "any"`` draws other leaves, wood, ground and sky
    for each seed.
    """
    return DEFAULT_NAME, *sorted(path.stem for path in (data_dir() / "palettes").glob("*.toml"))


class _Coloured(Protocol):
    @property
    def seed(self) -> int: ...
    @property
    def palette(self) -> PaletteTable: ...


def resolve(scene: _Coloured) -> Palette:
    """Returns the colours of a scene, drawn from the ranges of its palette with the seed of ``[palette]``, or else of
    the scene.

    Raises :class:`~vinesim.core.toml_loader.DataError` if the palette does not exist or cannot be used.
    """
    table = scene.palette
    return draw(table.name, scene.seed if table.seed is None else table.seed)


def draw(name: str, seed: int) -> Palette:
    """Returns the palette ``name``, drawn from its ranges with ``seed``.

    Raises :class:`~vinesim.core.toml_loader.DataError` if it does not exist or cannot be used.
    """
    if name != ANY_NAME:
        return _draw_one(name, seed)
    names = palette_names()
    parts = {}
    for part in ("leaf", "wood", "ground", "sky"):
        chosen = names[int(_generator(seed, part).integers(len(names)))]
        parts[part] = getattr(_draw_one(chosen, seed), part)
    return Palette(name=ANY_NAME, **parts)


def load_palette(name: str) -> PaletteRanges:
    """Returns the ranges in the file ``name``, or else in the file of that name in ``data/palettes``.

    Raises :class:`~vinesim.core.toml_loader.DataError` if there is no such file, or if it cannot be used.
    """
    try:
        path = find_data_file("palettes", name, ".toml")
    except DataFileNotFound:
        known = ", ".join((ANY_NAME, *palette_names()))
        raise DataError(f"no palette {name!r}; give the path of a file or one of: {known}") from None
    ranges = load_toml(path, PaletteRanges)
    for part in ranges.__struct_fields__:
        _check(getattr(ranges, part), f"{path}: {part}")
    return ranges


def _check(ranges: _Ranges, place: str) -> None:
    """Check units, limits and order of the ranges of one table; ``place`` names it in messages."""
    hints = typing.get_type_hints(type(ranges), include_extras=True)
    for name in ranges.__struct_fields__:
        found = getattr(ranges, name)
        if isinstance(found, Tone):
            for key in ("hue", "saturation", "value"):
                low, high = getattr(found, key)
                if low > high:
                    raise DataError(f"{place}.{name}.{key} is [{low}, {high}]; give [lowest, highest]")
        elif isinstance(found, Range):
            unit, (least, most) = typing.get_args(hints[name])[0].__metadata__
            low, high = found.value
            if found.unit != unit:
                raise DataError(f"{place}.{name}.unit is {found.unit!r}; give the value in {unit!r}")
            if not least <= low <= high <= most:
                raise DataError(
                    f"{place}.{name}.value is [{low}, {high}]; give [lowest, highest] from {least:g} to {most:g}"
                )


def _generator(seed: int, key: str) -> np.random.Generator:
    """Returns the random numbers of one quantity: a new quantity in a file does not change those of others."""
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(key.encode())]))


def _draw_one(name: str, seed: int) -> Palette:
    if name == DEFAULT_NAME:
        return DEFAULT
    ranges = load_palette(name)
    drawn = {part: _draw_table(getattr(ranges, part), part, seed) for part in ranges.__struct_fields__}
    return Palette(
        name=name,
        leaf=_leaf(drawn["leaf"]),
        wood=_wood(drawn["wood"]),
        ground=_ground(drawn["ground"]),
        sky=_sky(drawn["sky"]),
    )


def _draw_table(ranges: _Ranges, part: str, seed: int) -> dict[str, typing.Any]:
    """Returns the colours and numbers of one table, drawn uniformly from its ranges.

    The dark and the light colour of one thing are drawn at the same place of their ranges.
    """
    drawn: dict[str, typing.Any] = {}
    for name in ranges.__struct_fields__:
        found = getattr(ranges, name)
        if isinstance(found, Tone):
            at = _generator(seed, f"{part}.{name.partition('_')[0]}").uniform(size=3)
            ranges_of = (found.hue, found.saturation, found.value)
            drawn[name] = from_hsv(*(low + (high - low) * u for (low, high), u in zip(ranges_of, at, strict=True)))
        elif isinstance(found, Range):
            drawn[name] = float(found.at(_generator(seed, f"{part}/{name}").uniform()))
    return drawn


def from_hsv(hue: float, saturation: float, value: float) -> Rgb:
    """Returns the linear RGB of an sRGB colour with ``hue`` [deg], ``saturation`` and ``value`` (0 to 1)."""
    encoded = colorsys.hsv_to_rgb(hue / 360.0, saturation, value)
    return _rounded([c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in encoded])


def to_hsv(linear: Rgb) -> tuple[float, float, float]:
    """Returns hue [deg], saturation and value of linear RGB ``linear`` in sRGB; larger values are clipped to 1."""
    clipped = [min(max(c, 0.0), 1.0) for c in linear]
    encoded = [12.92 * c if c <= 0.0031308 else 1.055 * c ** (1.0 / 2.4) - 0.055 for c in clipped]
    hue, saturation, value = colorsys.rgb_to_hsv(*encoded)
    return 360.0 * hue, saturation, value


def _rounded(colour: typing.Iterable[float]) -> Rgb:
    """Returns a colour rounded to 1e-6, so that machines whose powers differ in the last bit draw the same colours."""
    red, green, blue = (round(float(c), 6) for c in colour)
    return red, green, blue


def _mixed(a: Rgb, b: Rgb, share: float) -> Rgb:
    return _rounded(x + (y - x) * share for x, y in zip(a, b, strict=True))


def _times(a: Rgb, factor: float | Rgb) -> Rgb:
    factors = factor if isinstance(factor, tuple) else (factor, factor, factor)
    return _rounded(x * f for x, f in zip(a, factors, strict=True))


_WARMTH = 0.5
"""How much yellower light through a leaf is than light from it, relative to the default palette."""
_BOUNCE = 0.7
"""Exponent by which the light from the ground follows its reflectance: a part of the ground is in shade."""


# What a file does not give is derived from what it gives, in the ratios of the default palette: GUESSED.


def _leaf(drawn: dict[str, typing.Any]) -> LeafColours:
    if not drawn:
        return DEFAULT.leaf
    usual = DEFAULT.leaf
    if "grown" in drawn:
        grown = drawn["grown"]
        drawn.setdefault("young", grown)
        drawn["pale"] = _times(_mixed(grown, drawn["young"], 0.1), 0.4)
        hue, saturation, value = to_hsv(grown)
        # light through a leaf is yellower than light from it, least for a blue green leaf
        warmth = _WARMTH * min(max((140.0 - hue) / 50.0, 0.5), 1.0)
        drawn["through"] = _mixed((2.0, 2.0, 2.0), usual.through, warmth)
        # veins are paler than the blade
        drawn["vein"] = from_hsv(hue, 0.75 * saturation, min(1.5 * value, 0.75))
        brighter = [min(max((new / old) ** 0.5, 0.4), 2.5) for new, old in zip(grown, usual.grown, strict=True)]
        drawn["shade"] = _times(usual.shade, _rounded(brighter))
    if "under" in drawn:
        hue, saturation, value = to_hsv(drawn["under"])
        drawn["under_vein"] = from_hsv(hue, min(1.15 * saturation, 1.0), min(1.17 * value, 1.0))
    return LeafColours(**drawn)


def _wood(drawn: dict[str, typing.Any]) -> WoodColours:
    if "cane" in drawn:
        drawn["node"] = _times(drawn["cane"], (0.80, 0.88, 0.88))
        drawn["blotch"] = _times(drawn["cane"], (0.67, 0.59, 0.56))
    return WoodColours(**drawn)


def _ground(drawn: dict[str, typing.Any]) -> GroundColours:
    if not drawn:
        return DEFAULT.ground
    usual = DEFAULT.ground
    share = 0.5
    if "cover" in drawn:
        share = drawn["cover"]
        # the noise is nearly normal: a logistic law turns a share into a threshold
        odds = min(max(share, 0.004), 0.996)
        drawn["cover"] = round(0.085 * math.log(odds / (1.0 - odds)) - 0.02, 6)
        drawn["most_cover"] = max(0.85, min(0.97, share + 0.2))
        drawn["far_cover"] = min(2.0 * share, 1.6)
    if "turf_light" in drawn:
        dark = drawn.setdefault("turf_dark", _times(drawn["turf_light"], 0.35))
        drawn["field"] = _mixed(dark, drawn["turf_light"], 0.25)
        drawn["grass"] = _mixed(dark, drawn["turf_light"], 0.55)
    if "litter_brown" in drawn:
        drawn["litter_pale"] = _times(drawn["litter_brown"], (1.8, 2.0, 1.4))
    if "dry" in drawn:
        drawn["weathered"] = _times(drawn["dry"], 0.3)
    colours = GroundColours(**drawn)
    ratio = [(new / old) ** _BOUNCE for new, old in zip(_mean(colours, share), _mean(usual, 0.5), strict=True)]
    return msgspec.structs.replace(colours, bounce=_times(usual.bounce, _rounded(ratio)))


def _mean(ground: GroundColours, share: float) -> Rgb:
    """Returns the mean reflectance of the ground with ``share`` of sod."""
    soil = _mixed(_mixed(ground.soil_dark, ground.soil_light, 0.5), ground.straw, ground.straw_share)
    turf = _mixed(_mixed(ground.turf_dark, ground.turf_light, 0.5), ground.dry, ground.dry_share)
    return _mixed(soil, turf, share)


def _sky(drawn: dict[str, typing.Any]) -> SkyColours:
    if not drawn:
        return DEFAULT.sky
    usual = DEFAULT.sky
    if "trees" in drawn:
        drawn["trees_spread"] = drawn["trees"]
    if "hills" in drawn:
        drawn["far_hills"] = _mixed(drawn["hills"], drawn.get("horizon", usual.horizon), 0.45)
    closed = drawn.get("overcast", 0.0)
    # under a closed layer of clouds the ground gets a third of the light, all of it from the sky: GUESSED
    drawn["sun"] = round(1.0 - 0.96 * closed, 6)
    drawn["light"] = _mixed(usual.light, (1.15, 1.2, 1.25), closed)
    return SkyColours(**drawn)
