"""Mathematical functions that return the same bits on every CPU.

On CPUs with AVX-512, NumPy computes these functions with vector instructions, which round differently. A vineyard
generated on such a CPU would have another digest than on other CPUs, and the server would refuse its clients. In this
module each number is computed by the C library, as NumPy does on other CPUs. NumPy's sines, cosines, square roots and
products agree on all CPUs. The C library itself rounds differently on CPUs without FMA (x86 of 2012 and before).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np


def _elementwise(function: Callable[..., float], arguments: int) -> Callable[..., np.ndarray]:
    each = np.frompyfunc(function, arguments, 1)
    return lambda *values: np.asarray(each(*values), float)


exp = _elementwise(math.exp, 1)
log = _elementwise(math.log, 1)
cbrt = _elementwise(math.cbrt, 1)
arctan2 = _elementwise(math.atan2, 2)
power = _elementwise(math.pow, 2)
