"""Tests whether what a user gave is a number: True, texts, NaN and infinity are none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

_LARGEST = float(np.finfo(np.float32).max)


def as_numbers(value: Any) -> np.ndarray:
    """Returns ``value``, a number or (nested) sequence of numbers, as an array of floats. The array is a single NaN if
    ``value`` contains anything that is no number, such as True or a text."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "iuf" or (not isinstance(value, np.ndarray) and _contains_bool(value)):
            return np.array(np.nan)
        return array.astype(float)
    except (TypeError, ValueError, OverflowError):
        return np.array(np.nan)


def is_number(value: Any) -> bool:
    """Returns whether ``value`` is one finite number, not True or False."""
    return bool((number := as_numbers(value)).ndim == 0 and np.isfinite(number))


def is_whole(value: Any) -> bool:
    """Returns whether ``value`` is an integer, not True or False."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def checked_vector(what: str, value: Any, unit: str, error: type[ValueError] = ValueError) -> np.ndarray:
    """Returns three numbers as an array. Raises ``error``, with a message that names ``what``, for other values, and
    for numbers beyond the range of single precision, in which the simulation computes."""
    vector = as_numbers(value)
    if vector.shape != (3,) or not (np.abs(vector) <= _LARGEST).all():
        raise error(f"{what} is {value}; give three finite numbers [{unit}]")
    return vector


def checked_number(
    what: str, value: Any, unit: str, *, positive: bool = False, error: type[ValueError] = ValueError
) -> float:
    """Returns a number of 0 or more, or above 0 if ``positive``. Raises ``error``, with a message that names ``what``,
    for other values."""
    if not is_number(value) or value < 0.0 or (positive and value == 0.0):
        raise error(f"{what} is {value}; give a finite number {'above 0' if positive else 'of 0 or more'} [{unit}]")
    return float(value)


def _contains_bool(value: Any) -> bool:
    if isinstance(value, Sequence):
        return any(_contains_bool(part) for part in value)
    return isinstance(value, bool | np.bool_)
