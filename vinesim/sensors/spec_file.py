"""Sensor data files. Every number has unit, grade and source; a wrong unit or an absurd value is refused in one
line."""

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
    """A list of numbers with unit, grade and source."""

    value: tuple[float, ...]
    unit: str
    grade: Literal["READ", "DERIVED", "GUESSED"]
    source: str


class SensorError(DataError):
    """A sensor's data file cannot be used. The text is one line."""


def load(folder: str, name: str, kind: type[T]) -> T:
    """Read the file ``name``, or the one of that name in ``data/<folder>``, as a struct of type ``kind``.

    The fields of ``kind`` declare unit and range: ``Annotated[Number, unit, (lowest, highest)]``.
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
    """Random generator for one image or revolution. It gives the same numbers for the same (seed, sensor, number), on
    every machine."""
    return np.random.default_rng([seed & 0xFFFFFFFF, zlib.crc32(name.encode()), number & 0xFFFFFFFF])
