"""The year of a vine: what a date means for shoots, leaves, berries and wood. Numbers and their sources are in
``data/seasons``.

A date's month and day count, not its year: temperatures are means of many years. Flowering and veraison follow sums of
temperature (the Grapevine Flowering Veraison model, Parker et al. 2011), leaves appear at a constant sum, and berries
grow in two phases with a lag phase between them.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import math
from typing import Annotated, Literal

import msgspec

from vinesim.core import portable_math
from vinesim.core.data_files import find_data_file
from vinesim.core.toml_loader import DataError, load_toml
from vinesim.scene.plant_parameters import Grade, Number, Range, check_units

DAYS = 365
"""Days of the year that the curves know; 29 February counts as 1 March."""
_FIRST_OF_MARCH = 60
"""Day of the year on which the sum for flowering and veraison begins: Parker et al. 2011, Aust. J. Grape Wine Res."""
_LATEST_SUM = 300
"""Last day of the year on which flowering or veraison may fall."""

_EDGE = 2.2924316695611777
"""Time constants from the middle of a logistic curve to where its curvature changes fastest: ln(5 + 2 sqrt(6))."""

Form = Literal["dormant", "bursting", "growing"]
"""Bare canes; bare canes with bursting buds; shoots with leaves."""


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class Months(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A number for each month, January to December, with unit, grade and source."""

    value: tuple[float, float, float, float, float, float, float, float, float, float, float, float]
    unit: str
    grade: Grade
    source: str


class Climate(_Table, frozen=True):
    """Climate of a vineyard."""

    temperatures: Months
    """[degC] Mean temperature of each month."""


class Stages(_Table, frozen=True):
    """Dates of a vine's stages."""

    flowering_sum: Annotated[Number, "degC d"]
    veraison_sum: Annotated[Number, "degC d"]
    budburst_to_flowering: Annotated[Number, "d"]
    veraison_to_maturity: Annotated[Number, "d"]
    harvest: Annotated[Number, "d"]
    leaf_turn: Annotated[Range, "d"]
    leaf_fall: Annotated[Range, "d"]


class Growth(_Table, frozen=True):
    """Growth of shoots and leaves."""

    base_temperature: Annotated[Number, "degC"]
    phyllochron: Annotated[Number, "degC d"]
    internode: Annotated[Number, "1"]
    leaf: Annotated[Number, "d"]
    young_diameter: Annotated[Number, "1"]
    shortest: Annotated[Number, "m"]


class BerryGrowth(_Table, frozen=True):
    """Growth and colour of berries."""

    set: Annotated[Number, "d"]
    lag: Annotated[Number, "d"]
    first_share: Annotated[Number, "1"]
    density: Annotated[Range, "kg/m^3"]
    colouring: Annotated[Number, "d"]


class Dormant(_Table, frozen=True):
    """Wood and buds of dormant vines."""

    ripe_share: Annotated[Number, "1"]
    tip_diameter: Annotated[Number, "m"]
    modulus: Annotated[Number, "Pa"]
    density: Annotated[Number, "kg/m^3"]
    damping: Annotated[Number, "s"]
    cutting_strength: Annotated[Range, "Pa"]
    two_year_diameter: Annotated[Number, "m"]
    spur_internodes: Annotated[Range, "m"]
    fruiting_cane_drop: Annotated[Number, "m"]
    fruiting_cane_diameter: Annotated[Range, "m"]
    renewal_spur: Annotated[Number, "m"]
    tie_spacing: Annotated[Number, "m"]
    bud_length: Annotated[Range, "m"]
    bud_diameter: Annotated[Range, "m"]
    burst_length: Annotated[Number, "m"]


class SeasonCurves(_Table, frozen=True):
    """Content of a file in ``data/seasons``."""

    climate: Climate
    stages: Stages
    growth: Growth
    berry: BerryGrowth
    dormant: Dormant


@functools.cache
def load_season(name: str = "vine") -> SeasonCurves:
    """Returns the curves in the file ``name``, or else in the file of that name in ``data/seasons``.

    Raises :class:`DataError` if the file cannot be used.
    """
    path = find_data_file("seasons", name, ".toml")
    curves = load_toml(path, SeasonCurves)
    for table in curves.__struct_fields__:
        check_units(getattr(curves, table), f"{path}: {table}")
    if curves.climate.temperatures.unit != "degC":
        raise DataError(
            f"{path}: climate.temperatures.unit is {curves.climate.temperatures.unit!r}; give the value in 'degC'"
        )
    return curves


@dataclasses.dataclass(frozen=True, slots=True)
class Calendar:
    """Days of the year on which the stages of a vine fall, as real numbers."""

    budburst: float
    flowering: float
    veraison: float
    maturity: float
    last_harvest: float
    """Later there is no fruit on the vines."""


@dataclasses.dataclass(frozen=True, slots=True)
class SeasonState:
    """State of a vineyard's vines on one day."""

    day: int
    """Day of the year, 1 to 365."""
    form: Form
    calendar: Calendar
    unfolded: float
    """Number of leaves that have unfolded on a shoot that is never topped."""
    shown: float
    """Share of the leaves that have not fallen."""
    yellow: float
    """Share of the leaves that have turned yellow."""
    woody: float
    """Share of a shoot's length that has turned woody, from its base, in units of that at harvest."""
    berry_mass: float
    """Mass of a berry as a share of that at maturity; 0: there is no fruit."""
    berry_size: float
    """Diameter of a berry as a share of that at maturity."""
    ripeness: tuple[float, float]
    """Least and greatest ripeness (0 green, 1 ripe) of a bunch."""
    burst: float
    """How far buds have burst, 0 (closed) to 1 (as long as ``Dormant.burst_length``)."""

    @property
    def has_shoots(self) -> bool:
        """Whether there are green shoots; otherwise the vines have their winter form."""
        return self.form == "growing"


def day_of_year(date: datetime.date) -> int:
    """Returns the day of the year, 1 to 365, of a date's month and day."""
    day = 28 if (date.month, date.day) == (2, 29) else date.day
    return datetime.date(2026, date.month, day).timetuple().tm_yday + ((date.month, date.day) == (2, 29))


def mean_temperature(temperatures: tuple[float, ...], day: float) -> float:
    """Returns the mean temperature [degC] on a day of the year, linear between the middles of the months."""
    place = (day - 0.5) / DAYS * 12.0 - 0.5
    month = math.floor(place)
    share = place - month
    return temperatures[month % 12] * (1.0 - share) + temperatures[(month + 1) % 12] * share


def thermal_time(temperatures: tuple[float, ...], base: float, first: int, last: int) -> float:
    """Returns the sum [degC d] of daily mean temperatures above ``base`` [degC] over the days ``first`` to ``last`` of
    the year, both included; 0 if ``last`` is before ``first``."""
    return sum(max(mean_temperature(temperatures, day) - base, 0.0) for day in range(first, last + 1))


def calendar_of(curves: SeasonCurves, temperatures: tuple[float, ...]) -> Calendar:
    """Returns the dates of the stages in a climate with these mean temperatures of the months [degC].

    Raises :class:`ValueError` with one line if the vines do not flower or ripen there.
    """
    days = {}
    for stage, needed in (("flowering", curves.stages.flowering_sum), ("veraison", curves.stages.veraison_sum)):
        total = 0.0
        for day in range(_FIRST_OF_MARCH, _LATEST_SUM + 1):
            step = max(mean_temperature(temperatures, day), 0.0)
            if total + step >= needed.value:
                days[stage] = day + (needed.value - total) / step
                break
            total += step
        else:
            raise ValueError(
                f"the sum of temperatures for {stage} reaches {total:.0f} of {needed.value:.0f} degC d by day "
                f"{_LATEST_SUM}; give warmer months"
            )
    flowering = days["flowering"]
    veraison = days["veraison"]
    budburst = flowering - curves.stages.budburst_to_flowering.value
    maturity = veraison + curves.stages.veraison_to_maturity.value
    if budburst < 15.0:
        raise ValueError(f"buds would burst on day {budburst:.0f} of the year; the curves need a winter: cooler months")
    if veraison - flowering <= curves.berry.lag.value:
        raise ValueError(
            f"from flowering to veraison there are {veraison - flowering:.0f} d; the curves of berries are valid from "
            f"{curves.berry.lag.value:.0f} d on; give cooler months"
        )
    return Calendar(budburst, flowering, veraison, maturity, maturity + curves.stages.harvest.value)


def berry_mass(curves: SeasonCurves, calendar: Calendar, day: float) -> float:
    """Returns the mass of a berry on a day of the year as a share of that at maturity: the sum of two logistic curves.

    The first phase lasts from fruit set to the lag phase. The second begins with veraison (Roychev et al., OENO One,
    metrics for berry growth kinetics: the accelerated growth of the second phase begins there) and ends with maturity.
    Beginning and end of a logistic curve are where its curvature changes fastest, 2.29 time constants from its middle.
    Valid from fruit set to a month after maturity.
    """

    def grown(at: float) -> float:
        total = 0.0
        start = calendar.flowering + curves.berry.set.value
        phases = (
            (curves.berry.first_share.value, start, calendar.flowering + curves.berry.lag.value),
            (1.0 - curves.berry.first_share.value, calendar.veraison, calendar.maturity),
        )
        for share, first, last in phases:
            middle = 0.5 * (first + last)
            constant = 0.5 * (last - first) / _EDGE
            total += share / (1.0 + float(portable_math.exp(-(at - middle) / constant)))
        return total

    return grown(day) / grown(calendar.maturity)


def berry_size(curves: SeasonCurves, mass: float) -> float:
    """Returns the diameter of a berry as a share of that at maturity, from its mass as a share of that at maturity.

    Its density rises in proportion to the mass between the lag phase and maturity.
    """
    green, ripe = curves.berry.density.value
    first = curves.berry.first_share.value
    density = green + (ripe - green) * min(max((mass - first) / (1.0 - first), 0.0), 1.0)
    return float(portable_math.power(mass * ripe / density, 1.0 / 3.0))


def internode_share(curves: SeasonCurves, unfolded: float, rank: float) -> float:
    """Returns the length of the internode below leaf ``rank`` (from 0) as a share of its final length, when
    ``unfolded`` leaves have unfolded."""
    return _smoothstep((unfolded - rank) / curves.growth.internode.value)


def shoot_share(curves: SeasonCurves, unfolded: float, nodes: float) -> float:
    """Returns the length of a shoot as a share of its final length with ``nodes`` nodes, when ``unfolded`` leaves have
    unfolded."""
    count = max(round(nodes), 1)
    return sum(internode_share(curves, unfolded, rank) for rank in range(count)) / count


def leaf_share(curves: SeasonCurves, days: float) -> float:
    """Returns the area of a leaf as a share of its final area, ``days`` after it unfolded."""
    return _smoothstep(days / curves.growth.leaf.value)


def unfolded_leaves(curves: SeasonCurves, temperatures: tuple[float, ...], budburst: float, day: float) -> float:
    """Returns the number of leaves that have unfolded on ``day`` of the year; linear in thermal time."""
    total = thermal_time(temperatures, curves.growth.base_temperature.value, math.ceil(budburst), math.floor(day))
    return total / curves.growth.phyllochron.value


def state_on(
    date: datetime.date, temperatures: tuple[float, ...] | None, mean_shoot: tuple[float, float]
) -> SeasonState:
    """Returns the state of vines on a date.

    Args:
        date: its month and day count.
        temperatures: [degC] mean temperature of each month, January to December; None: those of the file.
        mean_shoot: final length [m] and number of nodes of a mean shoot.

    Raises :class:`ValueError` with one line if the vines do not flower or ripen in this climate.
    """
    curves = load_season()
    months = curves.climate.temperatures.value if temperatures is None else temperatures
    calendar = calendar_of(curves, months)
    day = day_of_year(date)
    stages = curves.stages
    unfolded = unfolded_leaves(curves, months, calendar.budburst, day)
    share = shoot_share(curves, unfolded, mean_shoot[1])
    enough = curves.growth.shortest.value / mean_shoot[0]
    first_fallen, last_fallen = stages.leaf_fall.value
    form: Form = "growing"
    if day < calendar.budburst or day >= last_fallen:
        form = "dormant"
    elif share < enough:
        form = "bursting"
    ripe_from = calendar.veraison - 0.5 * curves.berry.colouring.value
    place = (day - ripe_from) / curves.berry.colouring.value
    mass = 0.0
    if form == "growing" and calendar.flowering + curves.berry.set.value <= day <= calendar.last_harvest:
        mass = berry_mass(curves, calendar, day)
    return SeasonState(
        day=day,
        form=form,
        calendar=calendar,
        unfolded=unfolded,
        shown=1.0 - _ramp(day, first_fallen, last_fallen),
        yellow=_ramp(day, *stages.leaf_turn.value),
        woody=_ramp(day, calendar.flowering, calendar.maturity),
        berry_mass=mass,
        berry_size=berry_size(curves, mass) if mass else 0.0,
        ripeness=(_smoothstep(place - 0.25), _smoothstep(place + 0.25)),
        burst=min(share / enough, 1.0) if form == "bursting" else 0.0,
    )


def _ramp(at: float, first: float, last: float) -> float:
    return min(max((at - first) / (last - first), 0.0), 1.0)


def _smoothstep(share: float) -> float:
    share = min(max(share, 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)
