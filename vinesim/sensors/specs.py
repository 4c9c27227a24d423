"""Sensor data files: every number with unit, grade and source; a wrong unit is refused in one line."""

from __future__ import annotations

import typing
from typing import TypeVar

import msgspec

from vinesim.world.places import find
from vinesim.world.reading import DataError, read

T = TypeVar("T", bound=msgspec.Struct)


class SensorError(DataError):
    """A camera or lidar file that cannot be used. The text is one line."""


def load(folder: str, name: str, kind: type[T]) -> T:
    """The file ``name``, or the one of that name in ``data/<folder>``, as a ``kind`` whose units are checked."""
    path = find(folder, name, ".toml")
    spec = read(path, kind, SensorError)
    for field, hint in typing.get_type_hints(kind, include_extras=True).items():
        unit = getattr(hint, "__metadata__", (None,))[0]
        given = getattr(getattr(spec, field), "unit", None)
        if isinstance(unit, str) and given is not None and given != unit:
            raise SensorError(f"{path}: {field}.unit is {given!r}; give the value in {unit!r}")
    return spec
