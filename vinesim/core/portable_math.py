"""Functions whose last bits do not depend on the CPU, for numbers that all machines must agree on.

NumPy computes these with vectors where a CPU has AVX-512, and rounds otherwise there: a vineyard generated on such a
CPU would be another one, by its digest, than on all others, and its clients would be refused. Here each number goes
through the C library, as NumPy's does on other CPUs. NumPy's sines, cosines, square roots and products are the same on
all. The C library itself rounds otherwise where a CPU has no FMA (x86 of 2012 and before).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np


def _elementwise(function: Callable[..., float], arguments: int) -> Callable[..., np.ndarray]:
    each = np.frompyfunc(function, arguments, 1)
    return lambda *values: np.asarray(each(*values), float)


exp = _elementwise(math.exp, 1)
cbrt = _elementwise(math.cbrt, 1)
arctan2 = _elementwise(math.atan2, 2)
power = _elementwise(math.pow, 2)
