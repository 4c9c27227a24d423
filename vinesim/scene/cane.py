"""Builds single canes from a few numbers: length, radius, Young's modulus, tip mass, damping ratio, shape.

    builder = CaneBuilder(length=1.0, radius=(0.006, 0.003), tip_mass=0.2, damping_ratio=0.05)
    model = builder.build()  # one cane
    model = assemble([builder, CaneBuilder()])  # several; wires, ties and boxes: vinesim.scene.surroundings

To add branches and bunches, use :meth:`CaneBuilder.tree`.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np

from vinesim.core import frames
from vinesim.core.numbers import is_number, is_whole
from vinesim.scene import builder, plausibility
from vinesim.scene.builder import RodMaterial, TreeBuilder
from vinesim.scene.model import Model
from vinesim.scene.surroundings import Box, Tie, Wire, surroundings

MODE_SEGMENTS = 64
"""Largest number of segments for which the frequency of a cane is checked; the check takes 0.3 ms for 64."""
_HORIZONTAL = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@dataclasses.dataclass(kw_only=True, eq=False)
class CaneBuilder:
    """Parameters of a cane: a tapered round rod of segments of equal length, joined by elastic ball joints.

    Raises :class:`ValueError` if a number is out of range; the message names the field, its value and the valid range.
    """

    length: float = 1.0
    """[m] Length of the cane."""
    radius: float | tuple[float, float] = 0.004
    """[m] Radius of the rod, or its radii at the base and at the tip."""
    youngs_modulus: float = 5e9
    """[Pa] Young's modulus E of bending."""
    shear_modulus: float | None = None
    """[Pa] Shear modulus G of torsion; E / 2.6 (Poisson's ratio 0.3) unless given."""
    density: float = 800.0
    """[kg/m^3] Density of the wood."""
    strength: float = 0.0
    """[Pa] Modulus of rupture: stress at which the wood cracks when it is bent; 0: it never breaks."""
    yield_strength: float = 0.0
    """[Pa] Stress above which the wood keeps a set; 0: none before it cracks."""
    toughness: float = 1e4
    """[J/m^2] Work that breaks cracked wood through, for each unit of its cross-section."""
    segments: int = 16
    """Number of rigid bodies of the cane."""
    tip_mass: float = 0.0
    """[kg] A point mass at the tip."""
    damping_ratio: float | None = None
    """[1] Damping ratio of the first bending mode (see :meth:`first_mode`); it sets ``beta`` = 2 ratio / angular
    frequency."""
    beta: float | None = None
    """[s] Stiffness-proportional damping: joint damping = beta * joint stiffness. If neither ``beta`` nor
    ``damping_ratio`` is given, beta is 0."""
    pose: np.ndarray | tuple[float, ...] = _HORIZONTAL
    """[7] m, 1, pose of the base in the world (position, quaternion xyzw); the cane grows along its x axis."""
    base: Literal["clamped", "pinned"] = "clamped"
    """``pinned``: the base joint has no spring, so that the cane swings on it as a pendulum."""
    bends: np.ndarray | None = None
    """[segments, 3] rad, the *drawn shape*: rotation vector of each segment relative to the previous segment. By
    default the cane is straight."""
    shape: Literal["slack", "equilibrium"] = "slack"
    """Meaning of the drawn shape, which ``bends`` gives. ``slack``: all springs are slack in this shape, and a released
    cane sags under its weight. ``equilibrium``: the springs balance gravity in this shape, and a released cane keeps
    it."""

    @property
    def angular_stiffness(self) -> np.ndarray:
        """[segments] N m/rad, bending stiffness of each joint, base first."""
        return np.array([body["stiffness"][2] for body in self.tree().bodies])

    @functools.cached_property
    def _undamped(self) -> TreeBuilder:
        tree = TreeBuilder(np.asarray(self.pose, float))
        material = RodMaterial(
            self.youngs_modulus,
            self.density,
            shear_modulus=self.shear_modulus,
            strength=self.strength,
            yield_strength=self.yield_strength,
            toughness=self.toughness,
        )
        turns = None if self.bends is None else frames.exp(np.asarray(self.bends, float))
        with plausibility.unchecked():  # tree() checks the numbers under the user's names
            tree.add_rod(-1, self.length, self._radii, material, self.segments, bends=turns)
        if self.tip_mass > 0.0:
            _add_point_mass(tree.bodies[-1], self.tip_mass)
        if self.base == "pinned":
            tree.bodies[0]["stiffness"] = np.zeros(3)
        return tree

    @property
    def _radii(self) -> tuple[float, float]:
        base, tip = np.broadcast_to(np.asarray(self.radius, float), 2).tolist()
        return base, tip

    def first_mode(self) -> float:
        """Returns the angular frequency [rad/s] of the first bending mode of the straight, clamped cane without
        gravity.

        This is the mode of the chain of segments. With many segments it converges to the mode of the Euler-Bernoulli
        beam, 1.8751^2 sqrt(E I / (rho A L^4)) for a cane without taper and tip mass.
        """
        self._check()
        bodies = self._undamped.bodies
        stiffness = np.array([body["stiffness"][2] for body in bodies])
        if stiffness[0] == 0.0:
            raise ValueError("cane: base is 'pinned', so it has no bending mode; give base 'clamped', or beta")
        joint = np.arange(self.segments) * (self.length / self.segments)
        com = joint + np.array([body["com"][0] for body in bodies])
        mass = np.array([body["mass"] for body in bodies])
        inertia = np.array([body["inertia"][2] for body in bodies])
        outer = np.tril(np.ones((self.segments, self.segments)))  # [segment, joint]: 1 if the joint carries the segment
        way = outer * (com[:, None] - joint)
        matrix = way.T @ (mass[:, None] * way) + outer.T @ (inertia[:, None] * outer)
        root = 1.0 / np.sqrt(stiffness)
        return float(1.0 / np.sqrt(np.linalg.eigvalsh(root[:, None] * matrix * root)[-1]))

    def tree(self) -> TreeBuilder:
        """Returns the cane as a :class:`~vinesim.scene.builder.TreeBuilder`, to which branches and bunches can be
        added."""
        self._check()
        self._check_plausibility()
        beta = self.beta or 0.0
        if self.damping_ratio is not None:
            beta = 2.0 * self.damping_ratio / self.first_mode()
        vars(self).pop("_undamped", None)  # fields may have changed since
        tree = self._undamped
        del self._undamped
        for body in tree.bodies:
            body["damping"], body["beta"] = beta * body["stiffness"], beta
        if self.shape == "equilibrium":
            tree.solve_rest_pose()
        return tree

    def build(self) -> Model:
        """Returns a model of this cane alone."""
        return builder.assemble([self.tree()])

    def _check(self) -> None:
        """Raise :class:`ValueError` for the first field that is out of range."""
        vars(self).pop("_undamped", None)
        if np.shape(self.radius) not in ((), (2,)):
            raise ValueError(f"cane: radius is {self.radius}; give one number, or two for base and tip")
        numbers = {"length": self.length, "youngs_modulus": self.youngs_modulus, "density": self.density}
        radii = np.broadcast_to(np.asarray(self.radius, object), 2)
        if self.shear_modulus is not None:
            numbers["shear_modulus"] = self.shear_modulus
        numbers |= {f"radius[{i}]": value for i, value in enumerate(radii.tolist())}
        for name, value in numbers.items():
            if not (is_number(value) and value > 0.0):
                raise ValueError(f"cane: {name} is {value}; give a finite number above 0")
        not_negative = ("tip_mass", "damping_ratio", "beta", "strength", "yield_strength", "toughness")
        for name, value in {name: getattr(self, name) for name in not_negative}.items():
            if value is not None and not (is_number(value) and value >= 0.0):
                raise ValueError(f"cane: {name} is {value}; give a finite number of 0 or more")
        if not is_whole(self.segments) or self.segments < 1:
            raise ValueError(f"cane: segments is {self.segments}; give a whole number, 1 or more")
        if self.damping_ratio is not None and self.beta is not None:
            raise ValueError(
                f"cane: damping_ratio {self.damping_ratio} and beta {self.beta} are given; give one of them"
            )
        if self.base not in ("clamped", "pinned"):
            raise ValueError(f"cane: base is {self.base!r}; give 'clamped' or 'pinned'")
        if self.shape not in ("slack", "equilibrium"):
            raise ValueError(f"cane: shape is {self.shape!r}; give 'slack' or 'equilibrium'")
        if self.shape == "equilibrium" and self.base == "pinned":
            raise ValueError("cane: a base that is 'pinned' carries no moment; give shape 'slack'")
        frames.checked_pose("cane: pose", self.pose)
        if self.bends is not None and np.shape(self.bends) != (self.segments, 3):
            raise ValueError(f"cane: bends has the shape {np.shape(self.bends)}; give [{self.segments}, 3]")

    def _check_plausibility(self) -> None:
        """Log a line for each number that no cane has."""
        plausibility.check_rod("cane", self._radii)
        plausibility.check("cane", "density", self.density)
        plausibility.check("cane", "modulus", self.youngs_modulus, "youngs_modulus")
        if self.tip_mass > 0.0:
            plausibility.check("cane", "mass", self.tip_mass, "tip_mass")
        if self.base == "clamped" and self.segments <= MODE_SEGMENTS:
            plausibility.check("cane", "frequency", self.first_mode() / (2.0 * np.pi), "frequency of its first mode")


def _add_point_mass(body: dict, mass: float) -> None:
    """Add a point mass [kg] at the tip of a segment to the segment's mass, centre of mass and moments of inertia."""
    own = body["mass"]
    com = body["com"][0]
    tip = body["length"]
    together = (own * com + mass * tip) / (own + mass)
    across = own * (com - together) ** 2 + mass * (tip - together) ** 2
    body["mass"], body["com"] = own + mass, (together, 0.0, 0.0)
    body["inertia"] = body["inertia"] + np.array([0.0, across, across])


def cane(**fields: object) -> Model:
    """Returns a model of one cane. ``fields``: fields of :class:`CaneBuilder`."""
    return CaneBuilder(**fields).build()  # pyright: ignore[reportArgumentType] # checked by the builder


def assemble(
    canes: Iterable[CaneBuilder | TreeBuilder],
    *,
    wires: Sequence[Wire] = (),
    ties: Sequence[Tie] = (),
    boxes: Sequence[Box] = (),
) -> Model:
    """Returns one model of canes and their surroundings. Each cane is a tree; trees, wires and boxes are numbered
    in the given order. Raises :class:`ValueError` if a tie names a cane, place or wire that does not exist."""
    trees = [one.tree() if isinstance(one, CaneBuilder) else one for one in canes]
    if not (wires or ties or boxes):
        return builder.assemble(trees)
    return builder.assemble(trees, **surroundings(builder.assemble(trees), wires, ties, boxes))
