"""Task *prune*: cut a dormant cane above its second bud, with shears, without pressing buds and other canes."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.interaction.blades import Blade
from vinesim.interaction.cutting_force import DORMANT_ENERGY_SHARE, DORMANT_STRENGTH
from vinesim.kernels.graph import KernelLaunch
from vinesim.kernels.learn import prune as kernels
from vinesim.learn.arm import AXES, pruning_blade
from vinesim.learn.arm_arrays import ArmArrays
from vinesim.learn.arm_env import ArmEnv
from vinesim.learn.arm_task import ArmTask
from vinesim.learn.shoots import DENSITY, SPACING
from vinesim.learn.variation import Variation
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spare_bodies import with_spares

CANES = 2
"""Number of canes of a world."""
KEPT = 2
"""Number of buds that shall stay."""
INTERNODES = 16
"""Number of internodes of a cane, each a body, with a bud at its tip."""
TIP = 0.6
"""Thickness of a cane at its tip, relative to its base. GUESSED."""
LEAST_LENGTH = 0.03462
"""Length [m] of a cane whose first mode is as fast as a batch permits in a step of 10 ms (4.8 Hz), with a diameter of
1 m at its base and a modulus of 1 Pa. DERIVED: measured for :data:`TIP`, :data:`INTERNODES` and the density. The length
of other canes grows with the root of the diameter and the fourth root of the modulus."""
DISTANCE = 0.85
"""[m] Mean distance of the canes from the origin."""
HEIGHT = 0.7
"""[m] Mean height at which they grow."""
TOLERANCE = 0.01
"""[m] Largest distance of a cut from the middle of the internode. GUESSED: it leaves a stub of 3 to 5 cm."""
BUD = 0.015
"""[m] Distance from a bud within which a contact presses it. GUESSED: a bud is 5 to 10 mm long."""
SLOTS = 32
"""Contacts that the plants of a world can have at once."""


class Prune(ArmTask):
    """The task of :class:`PruneEnv`."""

    name = "prune"
    numbers = 2 * len(AXES) + 6 + 3 * (CANES - 1) + 2 + CANES
    actions = len(AXES) + 1
    choices = CANES
    failure = "a cane was cut elsewhere"
    parameters = PhysicsParameters(cutting_strength=DORMANT_STRENGTH, cutting_energy_share=DORMANT_ENERGY_SHARE)

    def __init__(self, arrays: ArmArrays) -> None:
        super().__init__(arrays)
        self._is_done = self._each(wp.bool)

    @staticmethod
    def plants(rng: np.random.Generator, variation: Variation) -> Model:
        """Returns two canes."""
        return canes(rng, variation)

    @staticmethod
    def wanted_body(model: Model, wanted: int) -> int:
        """Returns the internode that shall be cut."""
        return int(model.tree_first[wanted]) + KEPT

    @staticmethod
    def blade() -> Blade | None:
        """Returns the blade of the shears."""
        return pruning_blade()

    def moves(self, action: wp.array, dt: float) -> list[KernelLaunch]:
        """See :meth:`ArmTask.moves`."""
        arrays = self.arrays
        close = KernelLaunch(kernels.close_blade, [len(AXES), action], [arrays.closing], threads=arrays.worlds)
        return [*super().moves(action, dt), close]

    def counts(self) -> list[KernelLaunch]:
        """See :meth:`ArmTask.counts`."""
        arrays = self.arrays
        given = [self._numbers(), arrays.worlds, arrays.canes, self.wanted]
        return [KernelLaunch(kernels.judge_cuts, given, [self._is_done, self.failed], threads=arrays.worlds)]

    def observe(self, action: wp.array, observation: wp.array, reward: wp.array, success: wp.array) -> KernelLaunch:
        """See :meth:`ArmTask.observe`."""
        arrays = self.arrays
        given = [self._numbers(), arrays.worlds, arrays.arm, arrays.canes, self.wanted, self._is_done, action]
        given += [arrays.contacts, arrays.world_contacts]
        return KernelLaunch(kernels.observe, given, [observation, reward, success], threads=arrays.worlds)

    def _numbers(self) -> kernels.PruneNumbers:
        numbers = kernels.PruneNumbers()
        numbers.kept = KEPT
        numbers.tolerance = TOLERANCE
        numbers.bud = BUD
        numbers.success_reward = 10.0
        numbers.distance_cost = 1.0
        numbers.force_cost = 0.02
        numbers.action_cost = 0.01
        return numbers


class PruneEnv(ArmEnv):
    """Prune one cane of two to two buds, in ``num_envs`` worlds with different canes.

    Action [8], from -1 to 1: the speeds of the targets of the seven joints, in units of 1 rad/s, and the blade, which
    closes at the end of the action if this component is above 0. The fingers stand for the bars of shears: they stay
    open, 4.8 cm apart, and the blade cuts what is between their tips, across their plane. Dormant canes need the force
    of :data:`~vinesim.interaction.cutting_force.DORMANT_STRENGTH`.

    Observation [27] float32: positions [rad] of the seven joints; their rates [rad/s]; from the point between the
    fingers to the middle of the internode between the second and the third bud of the wanted cane [m], in world axes;
    the direction of the cane there; from the same point to that place of the other cane [m]; the sums of the forces on
    the other cane, and within 1.5 cm of the first two buds of the wanted one [N]; and two numbers of which that of the
    wanted cane is 1. Poses of canes are those of the end of the action.

    Reward of an action: 10 at success, minus the distance of the place of the cut from the point between the fingers
    [m], minus 0.02 for each newton on these buds and on the other cane, minus 0.01 for each unit of squared action.
    Success: the wanted cane is cut within 10 mm of the middle of that internode. An episode ends at success. It ends
    with a reward lower by 2 if a cane is cut elsewhere. It is truncated after 100 actions (4 s).

    :class:`~vinesim.learn.arm_env.ArmEnv` describes arguments. Of the variation, the canes take ``cane`` (their
    length), thickness, modulus and damping. Raises :class:`~vinesim.core.errors.UsageError` for canes that swing too
    fast.
    """

    task_class = Prune
    world_options: ClassVar[dict[str, Any]] = {"slots": SLOTS}


def least_length(thickness: float, modulus: float) -> float:
    """Returns the least length [m] of a cane that does not swing too fast, by its diameter [m] and modulus [Pa]."""
    return LEAST_LENGTH * thickness**0.5 * modulus**0.25


def canes(rng: np.random.Generator, variation: Variation) -> Model:
    """Returns :data:`CANES` upright dormant canes in front of the arm. Places and directions are GUESSED. Raises
    :class:`~vinesim.core.errors.UsageError` if canes in these ranges may swing too fast for a step of 10 ms."""
    least = least_length(variation.thickness[1], variation.modulus[1])
    if variation.cane[0] < least:
        raise UsageError(
            f"cane from {variation.cane[0]:g}: below {least:.3f} m, canes with a thickness of up to "
            f"{variation.thickness[1]:g} m and a modulus of up to {variation.modulus[1]:g} Pa swing too fast; "
            "give longer, thinner or softer ones"
        )
    side = SPACING * (np.arange(CANES) - 0.5 * (CANES - 1))
    return with_spares(assemble([_cane(rng, float(y), variation) for y in side]), 1)


def _cane(rng: np.random.Generator, side: float, variation: Variation) -> TreeBuilder:
    near = np.array([0.04, 0.03, 0.06])
    tree = TreeBuilder(frames.pose(np.array([DISTANCE, side, HEIGHT]) + rng.uniform(-near, near)))
    radius = 0.5 * rng.uniform(*variation.thickness)
    modulus = rng.uniform(*variation.modulus)
    wood = RodMaterial(modulus, DENSITY, rng.uniform(*variation.damping), shear_modulus=0.4 * modulus)
    up = frames.from_x_axis(np.array([*rng.uniform(-0.2, 0.2, 2), 1.0]))
    tree.add_rod(-1, rng.uniform(*variation.cane), (radius, TIP * radius), wood, INTERNODES, rest=up)
    tree.solve_rest_pose()
    return tree
