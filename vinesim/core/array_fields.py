"""Dataclasses of arrays: each field declares its name, shape, unit and type in one line.

A struct of arrays declares its fields with :func:`array`; allocation, checks and documentation are
derived from that one declaration, so a shape is never written twice.

    @dataclass
    class Wires(StructOfArrays):
        start: np.ndarray = array("wire", 3, unit="m")
        radius: np.ndarray = array("wire", unit="m", fill=0.002)

    Wires.allocate(wire=12)
"""

from __future__ import annotations

import dataclasses
from typing import Any, Self

import numpy as np


@dataclasses.dataclass(frozen=True, slots=True)
class ArraySpec:
    """Shape, unit and type of one array field. A named axis is a count shared by all fields of a struct."""

    shape: tuple[str | int, ...]
    unit: str
    dtype: np.dtype
    fill: float | tuple[float, ...] = 0.0

    def __str__(self) -> str:
        axes = ", ".join(str(axis) for axis in self.shape)
        return f"[{axes}] {self.dtype} [{self.unit}]"


def array(*shape: str | int, unit: str, dtype: Any = np.float32, fill: float | tuple[float, ...] = 0.0) -> Any:
    """Declare an array field of a :class:`StructOfArrays`.

    Args:
        *shape: one entry for each axis. A name is a count shared by all fields of the struct, a number is a fixed size.
        unit: SI unit, ``"1"`` for pure numbers.
        dtype: type of the elements.
        fill: default value of an element or of a row.
    """
    return dataclasses.field(metadata={"dim": ArraySpec(shape, unit, np.dtype(dtype), fill)})


class StructOfArrays:
    """Base of the structs of arrays; subclasses are dataclasses with :func:`array` fields."""

    @classmethod
    def array_fields(cls) -> dict[str, ArraySpec]:
        """Returns every array field with its :class:`ArraySpec`, in order of declaration."""
        fields = dataclasses.fields(cls)  # type: ignore[arg-type]
        return {field.name: field.metadata["dim"] for field in fields if "dim" in field.metadata}

    @classmethod
    def allocate(cls, **counts: int) -> Self:
        """Returns a struct with all fields filled with their default values. ``counts``: count of each named axis."""
        fields = {}
        for name, dim in cls.array_fields().items():
            missing = [axis for axis in dim.shape if isinstance(axis, str) and axis not in counts]
            if missing:
                raise ValueError(f"{cls.__name__}.{name} needs a count for {missing[0]!r}; give {missing[0]}=N")
            shape = tuple(counts[axis] if isinstance(axis, str) else axis for axis in dim.shape)
            fields[name] = np.broadcast_to(np.asarray(dim.fill, dim.dtype), shape).copy()
        return cls(**fields)

    def counts(self) -> dict[str, int]:
        """Returns the count of each named axis, read from the arrays. Raises :class:`ValueError` if two fields
        disagree."""
        counts: dict[str, int] = {}
        seen: dict[str, str] = {}
        owner = type(self).__name__
        for name, dim in self.array_fields().items():
            value = getattr(self, name)
            if value.ndim != len(dim.shape):
                raise ValueError(f"{owner}.{name} has {value.ndim} axes, expected {dim}")
            for axis, size in zip(dim.shape, value.shape, strict=True):
                expected = counts.setdefault(axis, size) if isinstance(axis, str) else axis
                if size != expected:
                    other = f" as in {seen[axis]}" if isinstance(axis, str) else ""
                    raise ValueError(f"{owner}.{name} has {size} along {axis!r}, expected {expected}{other}")
                if isinstance(axis, str):
                    seen.setdefault(axis, name)
        return counts

    def check(self) -> Self:
        """Check all fields and return ``self``. Raises :class:`ValueError` for the first field with a wrong type or
        shape, a NaN or an infinity."""
        self.counts()
        for name, dim in self.array_fields().items():
            value = getattr(self, name)
            if value.dtype != dim.dtype:
                raise ValueError(f"{type(self).__name__}.{name} is {value.dtype}, expected {dim}")
            if value.dtype.kind == "f" and not np.isfinite(value).all():
                where = np.argwhere(~np.isfinite(value))[0].tolist()
                raise ValueError(f"{type(self).__name__}.{name}{where} is not finite, expected {dim}")
        return self

    def copy(self) -> Self:
        """Returns a deep copy of the arrays."""
        return type(self)(**{name: getattr(self, name).copy() for name in self.array_fields()})
