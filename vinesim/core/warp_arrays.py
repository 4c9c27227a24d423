"""NumPy arrays that Warp kernels work on in place, grouped under the names of a Warp struct's fields."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import warp as wp


def struct_fields(kind: Any) -> dict[str, Any]:
    """Returns the fields of a class decorated with ``wp.struct``: name and annotated type, in order of declaration."""
    return inspect.get_annotations(kind)


class SharedArrays:
    """A NumPy array for each field of a Warp struct, and the attribute ``struct``: the Warp struct over the same
    memory.

    The arrays are attributes of this object and keep their addresses during its lifetime.
    """

    def __init__(self, kind: Any, /, **arrays: np.ndarray) -> None:
        """``kind``: the class decorated with ``wp.struct``. Raises ValueError for an array that is not contiguous."""
        self.struct = kind()
        for name, field in struct_fields(kind).items():
            data = arrays.pop(name)
            shared = share(data, field.dtype)
            setattr(self.struct, name, shared)
            self.__dict__[name] = data
        if arrays:
            raise TypeError(f"{kind.__name__} has no field {', '.join(sorted(arrays))}")

    @classmethod
    def zeros(cls, kind: Any, /, *shape: int, **arrays: np.ndarray) -> SharedArrays:
        """Returns a ``SharedArrays`` of zeros. Every field has ``shape``, except the fields given in ``arrays``."""
        made = {name: zeros(field.dtype, shape) for name, field in struct_fields(kind).items() if name not in arrays}
        return cls(kind, **made, **arrays)

    def __getattr__(self, name: str) -> np.ndarray:
        raise AttributeError(f"no array {name!r}")


def share(data: np.ndarray, dtype: Any) -> wp.array:
    """Returns a Warp array over the memory of the NumPy array ``data``. Raises ValueError if ``data`` is not
    contiguous."""
    array = wp.array(data, dtype=dtype, device="cpu", copy=False)
    if data.size and array.ptr != data.ctypes.data:
        raise ValueError(f"an array of {data.shape} {data.dtype} is not contiguous: Warp would work on a copy")
    return array


def zeros(dtype: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Returns NumPy zeros that :func:`share` turns into a Warp array of ``shape``. A vector or matrix ``dtype`` adds
    dimensions; a struct ``dtype`` yields NumPy records."""
    element = host_element(dtype)
    return np.zeros(shape + element.shape, element.dtype)


def host_element(dtype: Any) -> np.ndarray:
    """Returns a NumPy array with the shape and dtype that one element of a Warp type has on the host.

    The shape is () for a number or a struct, [3] for ``wp.vec3``, [3, 3] for ``wp.mat33``.
    """
    one = wp.zeros(1, dtype=dtype, device="cpu").numpy()
    return one.reshape(one.shape[1:])
