"""Strength of wood: how it is distributed over peduncles, and how a joint of a cane gives when it is bent too far.

Strengths of brittle fibres and stalks follow Weibull's distribution (Weibull 1951, J. Appl. Mech. 18:293): a stalk is
as strong as its weakest place. No measurement of grape peduncles is known, so the distribution is a choice, and its two
numbers are guesses.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from vinesim.core import portable_math
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model

WEAKEST = 0.05
"""[1] Share of peduncles that are weaker than the lower end of the range which a plant file gives, and share of those
that are stronger than the upper end."""
SAFETY = 2.0
"""[1] Least ratio of the strength of a joint to its stress at rest. Wood under load grows until it bears it with a
reserve; safety factors of branches against their own weight are 2 to 4 (Niklas 1992, Plant Biomechanics; GUESSED for
shoots with fruit)."""
TANGENT = 0.4
"""[1] Ratio of tangent modulus to Young's modulus between yield and crack. GUESSED from the shape of bending curves of
green wood, which bend over at two thirds of their strength and reach it at twice the deflection."""
GRAVITY = 9.81
"""[m/s^2] Gravity under which plants have grown."""
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


@dataclasses.dataclass(frozen=True, eq=False)
class BendingLaw:
    """How the joints of canes [k] bear moments: elastic, then with a set that grows, then with a crack.

    With ``flow`` [rad], the sum of all rotations by which a joint's set has changed, its capacity (the moment that it
    bears) rises from :attr:`yields` to :attr:`breaks` along :attr:`hardening`, and then falls to zero along
    :attr:`cracking`. The work of the fall, ``breaks * cracking / 2``, is toughness times cross-section: a thick cane
    snaps, a thin green one bends over and hangs on its fibres. The law depends on rotations only, not on time.
    """

    yields: np.ndarray
    """[k] N m, moment at which the set begins: yield strength times section modulus."""
    breaks: np.ndarray
    """[k] N m, largest moment: strength times section modulus pi r^3 / 4."""
    hardening: np.ndarray
    """[k] rad, flow from the yield to the crack."""
    cracking: np.ndarray
    """[k] rad, flow from the crack to the break."""

    @classmethod
    def of(
        cls, radius: np.ndarray, stiffness: np.ndarray, strength: np.ndarray, yields: np.ndarray, toughness: np.ndarray
    ) -> BendingLaw:
        """Returns the law of joints of round wood with radius [k] m, bending stiffness [k] N m/rad, modulus of rupture
        and yield strength [k] Pa (0: the modulus of rupture), and toughness [k] J/m^2."""
        radius = np.asarray(radius, float)
        section = 0.25 * np.pi * radius**3
        breaks = strength * section
        first = np.where((yields > 0.0) & (yields < strength), yields, strength) * section
        slope = np.maximum(stiffness, 1e-12) * TANGENT / (1.0 - TANGENT)
        work = np.maximum(toughness, 1e-9) * np.pi * radius**2
        return cls(first, breaks, (breaks - first) / slope, 2.0 * work / np.maximum(breaks, 1e-12))

    def __getitem__(self, rows: np.ndarray) -> BendingLaw:
        return BendingLaw(self.yields[rows], self.breaks[rows], self.hardening[rows], self.cracking[rows])

    def notched(self, area: np.ndarray, modulus: np.ndarray) -> BendingLaw:
        """Returns the law of wood of which cuts have left the shares ``area`` [k] of the cross-section and ``modulus``
        [k] of the section modulus: its moments are smaller by the latter, the work of its crack by the former.

        The slope of the rise stays, because a narrow cut hardly softens the wood.
        """
        modulus = np.maximum(modulus, 1e-9)
        return BendingLaw(
            self.yields * modulus,
            self.breaks * modulus,
            self.hardening * modulus,
            self.cracking * np.maximum(area, 1e-9) / modulus,
        )

    def capacity(self, flow: np.ndarray) -> np.ndarray:
        """Returns the moment [k] N m that joints bear after a ``flow`` [k] rad."""
        risen = np.clip(flow / np.maximum(self.hardening, 1e-12), 0.0, 1.0)
        up = self.yields + (self.breaks - self.yields) * np.where(self.hardening > 0.0, risen, 1.0)
        down = self.breaks * np.clip(1.0 - (flow - self.hardening) / self.cracking, 0.0, 1.0)
        return np.where(flow < self.hardening, up, down)

    def give(self, flow: np.ndarray, moment: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
        """Returns the flow [k] rad after joints with ``flow`` [k] rad have given way to elastic moments ``moment`` [k]
        N m, at an unchanged pose: the set takes over so much of the rotation that the moment is the capacity.

        ``stiffness`` [k] N m/rad. A joint that breaks has a flow of :attr:`hardening` + :attr:`cracking`, or more. It
        breaks at once if its wood stores more energy than its crack needs.
        """
        slope = (self.breaks - self.yields) / np.maximum(self.hardening, 1e-12)
        over = np.maximum(moment - self.capacity(flow), 0.0)
        room = np.maximum(self.hardening - flow, 0.0)
        first = np.minimum(over / (stiffness + slope), room)
        moment = moment - stiffness * first
        flow = flow + first
        over = np.where(flow >= self.hardening * (1.0 - 1e-9), np.maximum(moment - self.capacity(flow), 0.0), 0.0)
        fall = self.breaks / self.cracking
        second = np.where(stiffness > fall, over / np.maximum(stiffness - fall, 1e-12), np.inf)
        return np.where(over > 0.0, np.minimum(flow + second, self.hardening + self.cracking), flow)


def stalk_ends(model: Model) -> np.ndarray:
    """Returns for each bunch the bodies beyond the two joints at which its peduncle ends [bunch, 2]: the first segment
    of the peduncle, at the shoot, and the bunch. A bunch without a peduncle has its own body twice."""
    base = model.bunch_body.copy()
    above = model.body_parent[base]
    while (is_stalk := (above >= 0) & (model.body_organ[above] == int(Organ.PEDUNCLE))).any():
        base = np.where(is_stalk, above, base)
        above = np.where(is_stalk, model.body_parent[above], above)
    return np.stack([base, model.bunch_body], 1).astype(np.int32)


def with_reserve(model: Model) -> Model:
    """Raise the strength of canes and peduncles so that none has less than :data:`SAFETY` times its stress at rest.
    Writes ``body_strength``, ``body_yield_strength``, ``bunch_pull`` and ``bunch_bend`` of ``model`` and returns it."""
    wood = np.flatnonzero(model.body_strength > 0.0)
    moment = _moment_at_rest(model, wood)
    stress = np.sqrt(moment[:, 1] ** 2 + moment[:, 2] ** 2 + 0.75 * moment[:, 0] ** 2)
    stress /= 0.25 * np.pi * model.body_radius[wood, 0].astype(float) ** 3
    raised = np.maximum(SAFETY * stress / model.body_strength[wood], 1.0)
    model.body_strength[wood] *= raised
    model.body_yield_strength[wood] *= raised
    if len(model.bunch_body):
        weight = GRAVITY * model.body_mass[model.bunch_body].astype(float)
        model.bunch_pull[:] = np.maximum(model.bunch_pull, 1.25 * SAFETY * weight)
        bent = np.linalg.norm(_moment_at_rest(model, stalk_ends(model).ravel()), axis=1).reshape(-1, 2).max(1)
        model.bunch_bend[:] = np.maximum(model.bunch_bend, bent / (1.0 / SAFETY - weight / model.bunch_pull))
    return model


def _moment_at_rest(model: Model, bodies: np.ndarray) -> np.ndarray:
    """Returns the moments [k, 3] N m in the springs of ``bodies`` [k] in the drawn shape, in joint axes."""
    settled = model.joint_settled[bodies].astype(float)
    sine = np.sqrt((settled[:, :3] ** 2).sum(1))
    turn = 2.0 * portable_math.arctan2(sine, np.abs(settled[:, 3])) / np.maximum(sine, 1e-12)
    return model.joint_stiffness[bodies] * settled[:, :3] * turn[:, None]
