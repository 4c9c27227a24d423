"""Rows of a test that only ``make test-long`` runs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import pytest


def long(*rows: Any) -> list:
    """Rows that are marked ``long``, for ``pytest.mark.parametrize``. A row of several arguments is a tuple."""
    return [pytest.param(*(row if isinstance(row, tuple) else (row,)), marks=pytest.mark.long) for row in rows]


def each_once(*axes: Sequence[Any]) -> list:
    """All combinations of values of several arguments. ``make test`` runs as many as the longest axis has values, so
    that each value occurs; the others are marked ``long``."""
    count = max(len(axis) for axis in axes)
    # the second of two axes of one length is shifted, so that not only their equals meet
    kept = {tuple((number + place) % len(axis) for place, axis in enumerate(axes)) for number in range(count)}
    rows = []
    for places in itertools.product(*(range(len(axis)) for axis in axes)):
        values = [axis[place] for axis, place in zip(axes, places, strict=True)]
        rows.append(pytest.param(*values, marks=[] if places in kept else pytest.mark.long))
    return rows
