"""Data files of sensors. Every number has unit, grade and source; a wrong unit or a value out of range is an error."""

from __future__ import annotations

import pathlib
import typing
import zlib
from typing import Literal, TypeVar

import msgspec
import numpy as np

from vinesim.core.data_files import find_data_file
from vinesim.core.toml_loader import DataError, load_toml

T = TypeVar("T", bound=msgspec.Struct)


class Numbers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A list of numbers in a data file, with unit, grade and source."""

    value: tuple[float, ...]
    unit: str
    grade: Literal["READ", "DERIVED", "GUESSED"]
    source: str


class SensorError(DataError):
    """Error: a sensor's data file cannot be used. The message is one line."""


def load(folder: str, name: str, kind: type[T]) -> T:
    """Read a data file as a struct of type ``kind`` and check all units and ranges.

    ``name``: path of the file, or name of a file in ``data/<folder>``. The fields of ``kind`` declare unit and range as
    ``Annotated[Number, unit, (lowest, highest)]``.
    """
    path = find_data_file(folder, name, ".toml")
    spec = load_toml(path, kind, SensorError)
    _check(path, spec)
    return spec


def _check(path: pathlib.Path, spec: msgspec.Struct, place: str = "") -> None:
    for field, hint in typing.get_type_hints(type(spec), include_extras=True).items():
        found = getattr(spec, field)
        unit, *bounds = getattr(hint, "__metadata__", (None,))
        given = getattr(found, "unit", None)
        if isinstance(unit, str) and given is not None:
            if given != unit:
                raise SensorError(f"{path}: {place}{field}.unit is {given!r}; give the value in {unit!r}")
            for low, high in bounds:
                wrong = [v for v in np.atleast_1d(found.value) if not low <= v <= high]
                if wrong:
                    raise SensorError(f"{path}: {place}{field} is {wrong[0]:g} {unit}; give {low:g} to {high:g} {unit}")
        elif isinstance(found, msgspec.Struct):
            _check(path, found, f"{place}{field}.")
        elif isinstance(found, tuple):
            for number, one in enumerate(found):
                if isinstance(one, msgspec.Struct):
                    _check(path, one, f"{place}{field}[{number}].")


def noise_rng(seed: int, name: str, number: int) -> np.random.Generator:
    """Returns the random generator for one image or revolution of a sensor.

    Equal ``seed``, ``name`` of the sensor and ``number`` of the image yield equal random numbers on every machine.
    """
    return np.random.default_rng([seed & 0xFFFFFFFF, zlib.crc32(name.encode()), number & 0xFFFFFFFF])
