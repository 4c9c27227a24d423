"""Sleep of trees: a tree at rest is put to sleep, together with all trees that it touches.

A tree is at rest when no point of it is faster than ``sleep_speed``, or further than ``sleep_distance`` from its rest
position. The tree is then moved into its rest pose. So it sleeps in the pose in which it would have come to rest, but
seconds earlier. A camera cannot resolve this motion. A tree in contact is not moved, since that would change the
contact forces: it falls asleep only much nearer to its rest pose. The distance from rest
(:mod:`vinesim.plants.equilibrium`) is computed only for trees in which all joints have been slower than ``sleep_rate``
for ``sleep_duration``. Trees in contact sleep together (an *island*), and only if nothing keeps one of them awake.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from vinesim.core.warp_arrays import share
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.plants.residual_motion import FAR
from vinesim.kernels.plants.tree_checks import count_quiet_steps
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.equilibrium import EquilibriumFinder
from vinesim.scene.physics_parameters import PhysicsParameters

CHECK_PERIOD = 0.05
"""[s] Period at which trees are tested for rest and put to sleep. All trees are tested in the same step, because the
computation of residual motion costs as much as the prediction of a step. TUNED.
"""

CONTACT_SHARE = 0.05
"""[1] Largest distance from its rest pose at which a tree in contact, or a cut-off part, falls asleep, as a share of
``sleep_distance``. It is small because such trees are not moved to their rest pose. TUNED: 0.01 mm, a thousandth of a
travel of 1 cm.
"""

STILL_DURATION = 5.0
"""[s] Duration after which some trees count as at rest if none of their bodies has moved by more than
:data:`CONTACT_SHARE` of ``sleep_distance``: trees in contact, cut-off parts, and trees whose distance from rest is not
known. In contact the distance may be overestimated, because the tangent stiffness does not contain the supporting
contacts. The distance is not known where the tangent stiffness is not positive definite, as in some canes that an actor
has tied. A tree that creeps with a time constant of five times this duration falls asleep 0.05 mm from its rest pose.
TUNED."""

_NO_PAIRS = np.zeros((0, 2), np.int32)


class SleepMonitor:
    """Finds the awake trees that are at rest, and puts to sleep those that nothing keeps awake."""

    def __init__(self, plants: ArticulationSolver, parameters: PhysicsParameters = PhysicsParameters()) -> None:
        """``parameters``: the fields ``sleep_...`` define when a tree is at rest."""
        self.plants = plants
        self.rate = parameters.sleep_rate
        self.speed = parameters.sleep_speed
        self.distance = parameters.sleep_distance
        self._equilibrium = EquilibriumFinder(plants)
        self.patience = parameters.steps(parameters.sleep_duration)
        """Number of steps for which the joints of a tree must have been slow before the tree is tested for rest."""
        self._check_steps = parameters.steps(CHECK_PERIOD)
        trees = len(plants.model.tree_first)
        self.quiet_steps = np.zeros(trees, np.int32)
        """[tree] Number of successive steps in which all joints of each awake tree were slower than ``sleep_rate``."""
        self._is_at_rest = np.zeros(trees, bool)
        self._still_steps = parameters.steps(STILL_DURATION)
        self._seen_tick = np.full(trees, -1, np.int64)
        """[tree] Tick in which the positions of each tree were stored in :attr:`_seen_x`; -1 if none are stored."""
        self._seen_x = np.zeros((len(plants.model.body_mass), 3), np.float32)
        """[body, 3] m Positions of bodies at the tick in ``_seen_tick``."""
        self._limit = np.zeros(1, np.float32)
        self._longest = np.zeros(1, np.int32)
        """[1] Largest entry of :attr:`quiet_steps` of an awake tree.

        ``_limit`` [1] rad/s: copy of :attr:`rate` for the kernel.
        """
        self._count_quiet_steps = KernelGraph(
            KernelLaunch(
                count_quiet_steps,
                [share(self._limit, wp.float32), *plants.awake_trees(), share(plants.tree_rate, wp.float32)],
                [
                    share(self.quiet_steps, wp.int32),
                    share(self._is_at_rest, wp.bool),
                    share(self._seen_tick, wp.int64),
                    share(self._longest, wp.int32),
                ],
            )
        )

    @property
    def restless(self) -> np.ndarray:
        """Awake trees [k] that are not at rest, sorted."""
        awake = self.plants.awake
        return awake[~self._is_at_rest[awake]]

    def wake(self, trees: np.ndarray) -> None:
        """Wake trees, or keep them awake, for at least :attr:`patience` more steps. Raises :class:`ValueError` if there
        is no such tree."""
        trees = np.atleast_1d(trees)
        self.plants.wake(trees)
        self._forget(trees)

    def wake_unbalanced(self) -> None:
        """Wake the sleeping trees that are not in equilibrium in their present pose."""
        asleep = np.flatnonzero(~self.plants.state.tree_awake).astype(np.int32)
        _, distance, _ = self._equilibrium.residual_motion(asleep)
        self.wake(asleep[distance > CONTACT_SHARE * self.distance])

    def update(
        self,
        keep_awake: np.ndarray | None = None,
        contact_pairs: np.ndarray = _NO_PAIRS,
        is_coupled: np.ndarray | None = None,
    ) -> np.ndarray:
        """Call :meth:`watch`, and :meth:`check` if it is due. Returns the trees that have been put to sleep [k].

        ``keep_awake`` [tree] bool: trees that must not fall asleep, because an actor is near, holds or owns them.
        ``contact_pairs`` [n, 2]: awake trees that touch each other. ``is_coupled`` [tree] bool: awake trees that share
        a wire or an arm with another awake tree. Coupled trees are not moved to their rest poses, since these poses
        depend on the other trees.
        """
        return self.check(keep_awake, contact_pairs, is_coupled) if self.watch() else self.plants.awake[:0]

    def watch(self) -> bool:
        """Count for each tree the successive steps in which its joints were slow. Returns whether some trees are due
        for :meth:`check`."""
        plants = self.plants
        self._limit[0] = self.rate
        self._longest[0] = 0
        if len(plants.awake):
            self._count_quiet_steps(len(plants.awake))
        return plants.tick % self._check_steps == 0 and bool(self._longest[0] >= self.patience)

    def check(
        self,
        keep_awake: np.ndarray | None = None,
        contact_pairs: np.ndarray = _NO_PAIRS,
        is_coupled: np.ndarray | None = None,
    ) -> np.ndarray:
        """Test the awake trees whose joints have been slow for long enough, and put those at rest to sleep.

        A tree is at rest if its largest speed and its largest distance from its rest pose are below the limits
        (:meth:`EquilibriumFinder.residual_motion`). Arguments: see :meth:`update`. Returns the trees [k] that have been
        put to sleep.
        """
        plants = self.plants
        awake = self.plants.awake
        slow = awake[self.quiet_steps[awake] >= self.patience]
        if keep_awake is not None:  # a tree at rest that is kept awake is measured again only after it has moved
            slow = slow[~(keep_awake[slow] & self._is_at_rest[slow])]
        if len(slow) == 0:
            return slow
        speed, distance, is_free = self._equilibrium.residual_motion(slow)
        tolerance = np.where(is_free, self.distance, CONTACT_SHARE * self.distance)
        self._is_at_rest[slow] = (speed < self.speed) & (distance < tolerance)
        is_free &= distance < 0.5 * FAR
        if len(bound := slow[~is_free & (speed < self.speed)]):
            self._find_still(bound)
        stays = ~self._is_at_rest if keep_awake is None else ~self._is_at_rest | keep_awake
        while len(spread := contact_pairs[stays[contact_pairs[:, 0]] != stays[contact_pairs[:, 1]]]):
            stays[spread] = True
        asleep = slow[~stays[slow]]
        if len(asleep) == 0:
            return asleep
        is_alone = is_free if is_coupled is None else is_free & ~is_coupled[slow]
        self._equilibrium.move_to_rest(slow[~stays[slow] & is_alone])
        plants.put_to_sleep(asleep)
        self._forget(asleep)
        return asleep

    def _find_still(self, trees: np.ndarray) -> None:
        """Mark trees [k] as at rest if they have not moved for :data:`STILL_DURATION`."""
        plants = self.plants
        now = self.plants.tick
        due = trees[(self._seen_tick[trees] >= 0) & (now - self._seen_tick[trees] >= self._still_steps)]
        if len(due):
            bodies = plants.bodies_of(due)
            moved = np.linalg.norm(plants.state.body_q[bodies, :3] - self._seen_x[bodies], axis=1)
            first = np.concatenate([[0], np.cumsum(plants.model.tree_size[due])[:-1]])
            self._is_at_rest[due] |= np.maximum.reduceat(moved, first) < CONTACT_SHARE * self.distance
        late = np.concatenate([trees[self._seen_tick[trees] < 0], due[~self._is_at_rest[due]]])
        if len(late):
            bodies = plants.bodies_of(late)
            self._seen_x[bodies] = plants.state.body_q[bodies, :3]
            self._seen_tick[late] = now

    def _forget(self, trees: np.ndarray) -> None:
        """Set the counts of slow steps of trees [k] to zero, and delete their stored positions."""
        self.quiet_steps[trees] = 0
        self._is_at_rest[trees] = False
        self._seen_tick[trees] = -1
