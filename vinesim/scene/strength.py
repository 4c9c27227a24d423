"""Strength of wood: how it is distributed over peduncles.

Strengths of brittle fibres and stalks follow Weibull's distribution (Weibull 1951, J. Appl. Mech. 18:293): a stalk is
as strong as its weakest place. No measurement of grape peduncles is known, so the distribution is a choice, and its two
numbers are guesses.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vinesim.core import portable_math

WEAKEST = 0.05
"""[1] Share of peduncles that are weaker than the lower end of the range which a plant file gives, and share of those
that are stronger than the upper end."""
LEAST_CHANCE = 1e-3
"""[1] Chances are kept this far from 0 and 1, so that no peduncle has no strength or an endless one."""


def weibull(low: Any, high: Any) -> tuple[Any, Any]:
    """Returns scale [...] and shape [...] of the Weibull distribution of which the share :data:`WEAKEST` lies below
    ``low`` [...] and the same share above ``high`` [...]."""
    below = -math.log(1.0 - WEAKEST)
    above = -math.log(WEAKEST)
    shape = math.log(above / below) / portable_math.log(np.asarray(high, float) / low)
    return low / portable_math.power(below, 1.0 / shape), shape


def weibull_quantile(chance: Any, scale: Any, shape: Any) -> Any:
    """Returns the value [...] below which the share ``chance`` [...] of a Weibull distribution lies."""
    chance = np.clip(chance, LEAST_CHANCE, 1.0 - LEAST_CHANCE)
    return scale * portable_math.power(-portable_math.log(1.0 - chance), 1.0 / shape)


def peduncle_strength(chance: Any, low: Any, high: Any) -> tuple[Any, Any]:
    """Returns the pulling force [...] N at which peduncles break, and their strength relative to the median [...].

    ``chance`` [...]: uniform random numbers from 0 to 1; ``low``, ``high`` [...] N: the range of the plant file.
    """
    scale, shape = weibull(low, high)
    pull = weibull_quantile(chance, scale, shape)
    return pull, pull / weibull_quantile(0.5, scale, shape)
