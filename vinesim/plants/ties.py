"""Ties: springs and dampers between bodies and points of the world, which are wires of the model or people's hands.
Also the rest poses of root springs.

The kernels need the ties of a body to be adjacent. So after the model's ties the arrays have spans of equal length for
bodies that hands hold or that actors have tied. Each such body gets one span: a copy of its model ties, followed by the
ties of the hands that hold it, and by the ties that actors have bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from vinesim.core import frames
from vinesim.scene.model import Model

TURNING_TIME = 0.05
"""[s] Ratio of a tie's rotational damping to the stiffness of the swing due to weight. A tie grips the wood and so
damps its rotation. GUESSED: a damping ratio of 0.1 for a swing of 1.5 s."""


MAX_BOUND_BODIES = 128
"""Largest number of bodies that can have ties which actors have bound."""
MAX_BOUND_TIES = 2
"""Largest number of such ties on one body."""


class TieLimitError(ValueError):
    """Raised if hands would hold too many plant bodies, or one body in too many places."""


class TieTable:
    """The table of all ties of a solver, with one row for each tie.

    Args:
        model: its ties come first in the table, sorted by body.
        max_bodies: largest number of bodies that can be held at once.
        max_hands: largest number of places in which one body can be held.
    """

    def __init__(self, model: Model, max_bodies: int, max_hands: int) -> None:
        self._max_bodies = max_bodies
        self._slots = max_bodies + MAX_BOUND_BODIES
        self._max_hands = max_hands
        self._model_ties = len(model.tie_body)
        self.tie_body = model.tie_body.copy()
        """[tie of the model] The body that each tie holds now. Only a cut changes it: a tie before the cut then holds
        the stump.
        """
        self.changes = 0
        """Number of cuts that have moved ties to stumps."""
        bodies = len(model.body_mass)
        self._max_model_ties = int(np.bincount(model.tie_body, minlength=bodies).max(initial=0))
        self._span_size = self._max_model_ties + max_hands + MAX_BOUND_TIES
        room = self._slots * self._span_size
        self.anchor = np.append(model.tie_anchor, np.zeros((room, 3), np.float32), 0)
        """[tie, 3] m, in the world: the fixed end of each tie."""
        self.anchor_velocity = np.zeros_like(self.anchor)
        """[tie, 3] m/s: velocity of the anchor."""
        self.axis = np.zeros_like(self.anchor)
        """[tie, 3] Unit vector along the wire that the tie is bound to; 0 for a tie that is not bound to a wire."""
        self.softening = np.zeros(len(self.anchor), np.float32)
        """[tie] N/m: stiffness of the tie alone, minus the stiffness of tie and wire in series when all awake trees on
        the wire move together; both across the wire. Only the sleep of trees uses it.
        """
        self.stiffness = np.append(model.tie_stiffness, np.zeros(room, np.float32))
        """[tie] N/m stiffness; a tie of zero stiffness does nothing."""
        self.damping = np.append(model.tie_damping, np.zeros(room, np.float32))
        """[tie] N s/m: damping of each tie."""
        self.slip = np.append(_endless(model.tie_slip), np.full(room, np.inf, np.float32))
        """[tie] N: force along the wire at which each tie slips; infinity: never."""
        self.strength = np.append(_endless(model.tie_strength), np.full(room, np.inf, np.float32))
        """[tie] N: force at which each tie breaks; infinity: never."""
        self.point = np.append(model.tie_point, np.zeros((room, 3), np.float32), 0)
        """[tie, 3] m, in the body's frame: the point of the body at which the tie acts."""
        ends = np.searchsorted(model.tie_body, np.arange(bodies + 1)).astype(np.int32)
        self.span = np.stack([ends[:-1], ends[1:]], -1)
        """[body, 2] First tie of a body, and the tie after its last."""
        bound = (model.tie_wire >= 0) & (model.fixed_tension[model.tie_wire] > 0.0) if len(model.fixed_tension) else []
        self.on_wire = np.flatnonzero(bound)
        """Ties of the model that are bound to wires under tension [k], sorted."""
        self._model_span = self.span.copy()
        self._slot_of: dict[int, int] = {}
        self._held: set[int] = set()
        self.on_slide: Callable[[int, np.ndarray], None] = lambda tie, way: None
        """Called with a tie of the model that slides and its way [3] m, by those who place its anchor."""

    @property
    def held_bodies(self) -> list[int]:
        """Bodies that have ties of :meth:`add` which are not bound."""
        return sorted(self._held)

    def are_tied(self, bodies: np.ndarray) -> np.ndarray:
        """Returns whether each of the ``bodies`` [k] has ties that hold it."""
        before = np.concatenate([[0], np.cumsum(self.stiffness > 0.0)])
        return before[self.span[bodies, 1]] > before[self.span[bodies, 0]]

    def number_on_body(self, ties: np.ndarray) -> np.ndarray:
        """Returns the number [k] of each of the model's ``ties`` [k] among those of its body, from 0."""
        return ties - self._model_span[self.tie_body[ties], 0]

    def can_split(self, body: int, at: float) -> bool:
        """Returns whether the ties of a body before ``at`` [m] stand together in the table, so that :meth:`split` can
        give them to a stump."""
        first, end = self._model_span[body].tolist()
        before = self.point[first:end, 0] < at
        return not (np.diff(before.astype(int)) != 0).sum() > 1

    def split(self, body: int, stump: int, at: float) -> None:
        """Give the model's ties of a body before ``at`` [m] to its stump, which has the same frame. Ties of hands stay
        with the body."""
        first, end = self._model_span[body].tolist()
        before = self.point[first:end, 0] < at
        count = int(before.sum())
        at_start = count == 0 or before[0]
        self._model_span[stump] = (first, first + count) if at_start else (end - count, end)
        self._model_span[body] = (first + count, end) if at_start else (first, end - count)
        self.tie_body[slice(*self._model_span[stump].tolist())] = stump
        for one in (body, stump):
            if one in self._slot_of:
                self._copy_model_ties(one)
            else:
                self.span[one] = self._model_span[one]
        self.changes += 1

    def rows_of(self, tie: int) -> list[int]:
        """Returns the rows of a tie of the model: its own, and its copy if hands hold the body."""
        body = int(self.tie_body[tie])
        here = int(self.span[body, 0]) + tie - int(self._model_span[body, 0])
        return [tie] if here == tie else [tie, here]

    def release(self, tie: int) -> None:
        """Let a tie of the model hold nothing any more."""
        rows = self.rows_of(tie)
        self.stiffness[rows] = self.damping[rows] = self.softening[rows] = 0.0

    def slide(self, tie: int, way: np.ndarray) -> None:
        """Move the anchor of a tie of the model by ``way`` [3] m."""
        rows = self.rows_of(tie)
        self.anchor[rows] += way.astype(np.float32)
        self.on_slide(tie, way)

    def add(
        self,
        body: int,
        point: np.ndarray,
        pose: np.ndarray,
        stiffness: float,
        damping: float,
        *,
        is_bound: bool = False,
    ) -> int:
        """Tie the point ``point`` [3] m of a body's frame to its present place in the world. ``pose`` [7]: world pose
        of the body. ``is_bound``: the tie stays without a hand. Returns the tie's index.

        Raises :class:`TieLimitError` if too many bodies are held, or this body in too many places.
        """
        if not (np.isfinite(point).all() and 0.0 < stiffness < math.inf and 0.0 <= damping < math.inf):
            raise ValueError(
                f"tie of body {body} at {point}, stiffness {stiffness} N/m, damping {damping} N s/m; give a finite "
                "point, a stiffness above 0 and a damping of 0 or more"
            )
        if not is_bound and body not in self._held and len(self._held) == self._max_bodies:
            raise TieLimitError(f"body {body} is one too many: {self._max_bodies} are held already, let go of one")
        if body not in self._slot_of:
            self._give_span(body)
        start, end = self._own_rows(body, is_bound=is_bound)
        spare = np.flatnonzero(self.stiffness[start:end] == 0.0)
        if len(spare) == 0:
            verb = "tied" if is_bound else "held"
            raise TieLimitError(f"body {body} is {verb} in {end - start} places already; let go of one")
        if not is_bound:
            self._held.add(body)
        tie = start + int(spare[0])
        self.anchor[tie] = pose[:3] + frames.rotate(pose[3:], np.asarray(point, float))
        self.point[tie] = point
        self.stiffness[tie] = stiffness
        self.damping[tie] = damping
        return tie

    def remove(self, body: int, tie: int) -> None:
        """Remove a tie that :meth:`add` added."""
        self.stiffness[tie] = self.damping[tie] = 0.0
        first, middle = self._own_rows(body, is_bound=False)
        end = middle + MAX_BOUND_TIES
        if not self.stiffness[first:middle].any():
            self._held.discard(body)
        if not self.stiffness[first:end].any():
            del self._slot_of[body]
            self.span[body] = self._model_span[body]

    def _own_rows(self, body: int, *, is_bound: bool) -> tuple[int, int]:
        """Returns the first row of a body's ties of hands, or of its bound ties, and the row after the last."""
        first = self._model_ties + self._span_size * self._slot_of[body] + self._max_model_ties
        middle = first + self._max_hands
        return (middle, middle + MAX_BOUND_TIES) if is_bound else (first, middle)

    def _give_span(self, body: int) -> None:
        taken = set(self._slot_of.values())
        free = [i for i in range(self._slots) if i not in taken]
        if not free:
            raise TieLimitError(f"body {body} is one too many: {MAX_BOUND_BODIES} are tied already, open a tie")
        self._slot_of[body] = free[0]
        start = self._model_ties + self._span_size * free[0]
        for values in self._rows():
            values[start : start + self._span_size] = 0.0
        self._copy_model_ties(body)
        self.span[body] = start, start + self._span_size

    def join(self, stump: int, body: int) -> None:
        """Undo :meth:`split`: give a stump's ties of the model to the body beyond it."""
        ours, theirs = self._model_span[[stump, body]].tolist()
        if ours[0] < ours[1]:
            self.tie_body[slice(*ours)] = body
            joined = [*ours, *theirs] if theirs[0] < theirs[1] else ours
            self._model_span[body] = min(joined), max(joined)
        self._model_span[stump] = 0
        for one in (body, stump):
            if one in self._slot_of:
                self._copy_model_ties(one)
            else:
                self.span[one] = self._model_span[one]
        self.changes += 1

    def _copy_model_ties(self, body: int) -> None:
        """Copy the model's ties of a held body to its span."""
        own = slice(*self._model_span[body].tolist())
        start = self._model_ties + self._span_size * self._slot_of[body]
        for values in self._rows():
            values[start : start + self._max_model_ties] = 0.0
            values[start : start + own.stop - own.start] = values[own]

    def _rows(self) -> tuple[np.ndarray, ...]:
        """Returns the arrays with a row for each tie."""
        return (
            self.anchor,
            self.anchor_velocity,
            self.axis,
            self.softening,
            self.stiffness,
            self.damping,
            self.slip,
            self.strength,
            self.point,
        )


def _endless(force: np.ndarray) -> np.ndarray:
    """Returns forces [k] with infinity in place of 0."""
    return np.where(force > 0.0, force, np.inf).astype(np.float32)


class RootRests:
    """Rotations of the rest poses of the root springs of trees, by the twist of the cordon arms on which the trees
    stand; see :mod:`vinesim.wires.elastic_supports`.
    """

    def __init__(self, model: Model) -> None:
        trees = len(model.tree_first)
        self.turn = np.zeros((trees, 3), np.float32)
        """[tree, 3] rad: rotation of each tree's rest pose, in joint axes."""
        self.rate = np.zeros((trees, 3), np.float32)
        """[tree, 3] rad/s: rate of the rotation in ``turn``, in joint axes."""
        self.softening = np.zeros((trees, 3), np.float32)
        """[tree, 3] (N m/rad)^(1/2), in joint axes. The outer product of this vector with itself is the stiffness of
        the root spring minus the stiffness of spring and arm in series, when all awake trees on the arm move together.
        Only the sleep of trees uses it."""


def turning_damping(model: Model, bodies: np.ndarray, root: np.ndarray, tied: np.ndarray, gravity: float) -> np.ndarray:
    """Returns the damping [k] N m s/rad by which ties resist the rotation of floating components. It is 0 for bodies
    that are not floating roots.

    The damping is :data:`TURNING_TIME` times the stiffness of the component's swing due to weight if the component
    hangs straight down: the sum of weights times lengths along the wood to the nearest tie. It depends on the model,
    the cuts and the ties alone, so a client that joins later computes the same value.

    Args:
        model: model of the trees.
        bodies: all bodies of some trees [k].
        root: [k] the floating root that each body moves with, -1 for none.
        tied: [k] bool, whether each body has ties.
        gravity: gravitational acceleration [m/s^2].
    """
    damping = np.zeros(len(bodies), np.float32)
    along = np.zeros(len(bodies))
    up = bodies
    while (up >= 0).any():
        along += np.where(up >= 0, np.linalg.norm(model.body_offset[up], axis=1), 0.0)
        up = np.where(up >= 0, model.body_parent[up], -1)
    tree = model.body_tree[bodies]
    core = bodies - model.tree_first[tree] < model.tree_core[tree]  # the mass of a bunch includes its clusters
    middle = along + model.body_com[bodies, 0]
    for cut in np.unique(root[tied & (root >= 0)]):
        own = (root == cut) & core
        arm = np.abs(middle[own, None] - along[own & tied]).min(1)
        damping[bodies == cut] = TURNING_TIME * gravity * float(model.body_mass[bodies[own]] @ arm)
    return damping
