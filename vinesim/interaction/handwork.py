"""Work of people and robots on plants that lasts: ties that they bind and open, and leaves that they take off.

A bound tie is a spring between a place of a cane and a point beside a wire. While it is being bound, its end moves from
where the place is to that point; then the tie stays, the tree may fall asleep, and other clients learn of it. The wire
does not yield to such a tie, and the tie never breaks. A tie of the model that was opened stays open; the cane can be
tied again. Leaves that are taken off vanish.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from vinesim.contact.contact_solver import ContactSolver
from vinesim.core import frames
from vinesim.core.errors import checked_index
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.ties import TieLimitError
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spare_bodies import PLACE_STEP

TIED = "tied"
UNTIED = "untied"
LEAVES = "leaves"
"""Kinds of :class:`~vinesim.scene.values.Breakage`."""
TIE_REACH = 0.12
"""[m] Largest gap between a cane and a wire to which it is tied: as far as a person pulls a shoot while tying it.
GUESSED."""
GRIP_STIFFNESS = 2000.0
"""[N/m] Stiffness of a hold or a new tie: that of ties in ``data/plants/vine.toml``."""
GRIP_DAMPING = 20.0
"""[N s/m] Damping of a hold or a new tie, as above."""
PULL_SPEED = 0.1
"""[m/s] Speed at which a new tie pulls a cane to its wire. GUESSED."""
PLANT_WORK = ("tie", "untie", "take_leaves")
"""What an actor can do at its tool."""
TOOL_REACH = 0.1
"""[m] Largest distance of a tool from what it works on. GUESSED: a hand's length."""
_TIED_PLACES = 65
"""Number of places of a body among which the one nearest to a wire is found."""


@dataclasses.dataclass(slots=True)
class BoundTie:
    """A tie that an actor has bound."""

    segment: int
    """Body of the model whose wood is tied, as it was before cuts."""
    steps: int
    """Distance of the tied place from the segment's origin, in 0.1 mm."""
    to: np.ndarray
    """[3] m, float32: point in the world to which the tie pulls."""
    actor: str = ""
    """Who binds the tie."""
    is_open: bool = False
    """Whether the tie was opened again."""
    body: int = -1
    """Part of the segment that the tie holds now; -1: it holds nothing."""
    row: int = -1
    """Row of the tie in :class:`~vinesim.plants.ties.TieTable`."""
    is_pulling: bool = False
    """Whether its end still moves. Other clients do not know of it yet."""

    @property
    def at(self) -> float:
        """[m] Distance of the tied place from the segment's origin."""
        return PLACE_STEP * self.steps


class Handwork:
    """The ties that actors have bound in one vineyard, and the leaves that they have taken off."""

    def __init__(
        self,
        plants: ArticulationSolver,
        contact_solver: ContactSolver,
        report: Callable[[str, str, int, float, str, int], None],
    ) -> None:
        """``report``: called with kind, cause, body, place [m], actor and tie of each piece of work."""
        self.plants = plants
        self.contact_solver = contact_solver
        self.ties: dict[tuple[int, int], BoundTie] = {}
        """All ties that were bound, by segment and place in 0.1 mm, also those that were opened again."""
        self._report = report
        self._pulling: list[BoundTie] = []
        self._changes = plants.ties.changes
        model = plants.model
        self._leaf_capsule = np.full(len(model.leaf_body), -1)
        shapes = contact_solver.capsules
        self._leaf_capsule[shapes.leaf] = int(shapes.leaf_start[0]) + np.arange(len(shapes.leaf))

    # ------------------------------------------------------------------ ties

    def bind(self, body: int, along: float, to: np.ndarray, actor: str = "") -> BoundTie:
        """Tie a cane or a part of one ``along`` [m] its segment to the point ``to`` [3] m, to which the tie pulls it
        within a second or two. Call this between steps.

        Raises :class:`ValueError` if the body has no wood there, or too many ties.
        """
        plants = self.plants
        body = checked_index("body", body, len(plants.body_mass))
        segment = plants.stumps.segment_of(body)
        start, end = float(plants.body_start[body]), float(plants.body_end[body])
        if plants.model.body_organ[segment] != int(Organ.CANE) or end <= start:
            raise ValueError(f"body {body} is no cane that can be tied")
        if not start <= along <= end:
            raise ValueError(f"body {body} has wood from {start:.4g} to {end:.4g} m, not at {along:.4g} m")
        steps = round(along / PLACE_STEP)
        while (segment, steps) in self.ties:
            steps += 1 if PLACE_STEP * (steps + 1) <= end else -1
            if not start <= PLACE_STEP * steps <= end:
                raise ValueError(f"body {body} has been tied at all places from {along:.4g} m on; tie it elsewhere")
        tie = BoundTie(segment, steps, np.asarray(to, np.float32), actor, is_pulling=True)
        self._hold(tie, body)
        self.ties[segment, steps] = tie
        self._pulling.append(tie)
        return tie

    def open(self, tie: BoundTie, actor: str = "") -> None:
        """Open a tie that an actor has bound. Nothing happens if it was opened before. Call this between steps."""
        if tie.is_open:
            return
        self._let_go(tie)
        tie.is_open = True
        if tie.is_pulling:  # nobody else knows of it
            self._pulling.remove(tie)
            del self.ties[tie.segment, tie.steps]
            return
        self._report(UNTIED, "command", tie.segment, tie.at, actor, -1)

    def untie(self, tie: int, actor: str = "") -> None:
        """Open a tie of the model. Nothing happens if it was opened before. Call this between steps."""
        plants = self.plants
        tie = checked_index("tie", tie, len(plants.model.tie_body))
        if plants.state.tie_broken[tie]:
            return
        plants.break_tie(tie)
        body = int(plants.ties.tie_body[tie])
        plants.wake(int(plants.model.body_tree[body]))
        self._report(UNTIED, "command", body, float(plants.model.tie_point[tie, 0]), actor, tie)

    def update(self) -> None:
        """Before a step: move the ends of ties that are being bound, and let ties follow the parts of cut segments."""
        if self._changes != self.plants.ties.changes:
            self._changes = self.plants.ties.changes
            for tie in self.ties.values():
                if tie.body >= 0 and self._part(tie) != tie.body:
                    self._let_go(tie)
                    self._hold(tie, self._part(tie))
                    if not tie.is_pulling:
                        self.plants.tie_anchor[tie.row] = tie.to
        if not self._pulling:
            return
        plants = self.plants
        plants.wake(np.unique(plants.model.body_tree[[tie.body for tie in self._pulling]]))
        for tie in tuple(self._pulling):
            here = plants.tie_anchor[tie.row].astype(float)
            way = tie.to.astype(float) - here
            length = float(np.linalg.norm(way))
            step = PULL_SPEED * plants.dt
            if length > step:
                plants.tie_anchor[tie.row] = here + way * (step / length)
                continue
            plants.tie_anchor[tie.row] = tie.to
            tie.is_pulling = False
            self._pulling.remove(tie)
            self._report(TIED, "command", tie.segment, tie.at, tie.actor, -1)

    @property
    def touched(self) -> tuple[tuple[int, str], ...]:
        """Pairs (tree, actor) for each tree that an actor ties now."""
        return tuple((int(self.plants.model.body_tree[tie.segment]), tie.actor) for tie in self._pulling if tie.actor)

    def learn_tie(self, segment: int, steps: int, to: np.ndarray, *, is_open: bool) -> None:
        """Bind a tie that another client has bound, without waking the tree, or open it if ``is_open``."""
        tie = self.ties.get((segment, steps))
        if tie is None:
            tie = self.ties[segment, steps] = BoundTie(segment, steps, np.asarray(to, np.float32), is_open=is_open)
            if is_open:
                return
            try:
                self._hold(tie, self._part(tie))
            except (TieLimitError, ValueError):  # it stays known, and holds nothing here
                return
            self.plants.tie_anchor[tie.row] = tie.to
        elif is_open and not tie.is_open:
            self._let_go(tie)
            tie.is_open = True

    def of_tree(self, tree: int) -> list[BoundTie]:
        """Returns the ties that were bound in a tree and that other clients may know, by segment and place."""
        return [
            self.ties[key]
            for key in sorted(self.ties)
            if self.plants.model.body_tree[key[0]] == tree and not self.ties[key].is_pulling
        ]

    def _part(self, tie: BoundTie) -> int:
        """Returns the part of its segment on which a tie is."""
        parts = self.plants.stumps.parts_of(tie.segment)
        return next((body for body, _, end in parts if tie.at < end), parts[-1][0])

    def _hold(self, tie: BoundTie, body: int) -> None:
        point = np.array([tie.at, 0.0, 0.0])
        tie.row = self.plants.add_tie(body, point, GRIP_STIFFNESS, GRIP_DAMPING, is_bound=True)
        tie.body = body

    def _let_go(self, tie: BoundTie) -> None:
        if tie.body >= 0:
            self.plants.remove_tie(tie.body, tie.row)
            self.plants.wake(int(self.plants.model.body_tree[tie.segment]))
        tie.body = tie.row = -1

    # ------------------------------------------------------------------ at a tool

    def work_at(self, what: str, point: np.ndarray, actor: str) -> str:
        """Let an actor work on the wood nearest to ``point`` [3] m: ``what`` is one of :data:`PLANT_WORK`. Call this
        between steps. Returns what was done, as a sentence without the actor.

        "tie" ties the cane to the nearest wire, "untie" opens the nearest tie, "take_leaves" takes the leaves off
        the segment. Raises :class:`ValueError` if there is nothing of this kind within :data:`TOOL_REACH`.
        """
        if what not in PLANT_WORK:
            raise ValueError(f"no work on plants {what!r}; give one of {', '.join(PLANT_WORK)}")
        if what == "untie":
            return self._untie_at(point, actor)
        body, along = self._wood_at(point)
        if what == "tie":
            at, to = nearest_place(self.plants, body, along)
            self.bind(body, at, to, actor)
            return f"ties body {body} at {1e3 * at:.0f} mm to the nearest wire"
        count = self.take_leaves(self.leaves_on(body), actor)
        return f"takes {count} leaves off body {body}"

    def _wood_at(self, point: np.ndarray) -> tuple[int, float]:
        """Returns the piece of cane nearest to a point [3] m, and the place [m] along it."""
        plants = self.plants
        plants.forward_kinematics()
        model = plants.model
        wood = np.flatnonzero((plants.body_end > plants.body_start) & (model.body_organ != int(Organ.BUNCH)))
        whole = np.where(plants.state.stump_of[wood] >= 0, plants.state.stump_of[wood], wood)
        wood = wood[model.body_organ[whole] == int(Organ.CANE)]
        pose = plants.state.body_q[wood].astype(float)
        axis = frames.rotate(pose[:, 3:], np.array([1.0, 0.0, 0.0]))
        along = ((point - pose[:, :3]) * axis).sum(1)
        along = np.clip(along, plants.body_start[wood], plants.body_end[wood]).astype(float)
        away = np.linalg.norm(pose[:, :3] + along[:, None] * axis - point, axis=1)
        if len(wood) == 0 or away.min() > TOOL_REACH:
            nearest = f"the nearest is {1e3 * away.min():.0f} mm away" if len(wood) else "there is none"
            raise ValueError(f"no cane within {1e3 * TOOL_REACH:.0f} mm of the tool; {nearest}; move the tool there")
        best = int(np.argmin(away))
        return int(wood[best]), float(along[best])

    def _untie_at(self, point: np.ndarray, actor: str) -> str:
        """Open the tie nearest to a point [3] m, of the model or of an actor."""
        plants = self.plants
        plants.forward_kinematics()
        model = plants.model
        bound = [tie for tie in self.ties.values() if tie.body >= 0]
        held = np.flatnonzero(~plants.state.tie_broken)
        bodies = np.concatenate([plants.ties.tie_body[held], np.array([tie.body for tie in bound], int)]).astype(int)
        places = np.concatenate([model.tie_point[held], np.array([[tie.at, 0.0, 0.0] for tie in bound]).reshape(-1, 3)])
        pose = plants.state.body_q[bodies].astype(float)
        away = np.linalg.norm(pose[:, :3] + frames.rotate(pose[:, 3:], places.astype(float)) - point, axis=1)
        if len(bodies) == 0 or away.min() > TOOL_REACH:
            nearest = f"the nearest is {1e3 * away.min():.0f} mm away" if len(bodies) else "there is none"
            raise ValueError(f"no tie within {1e3 * TOOL_REACH:.0f} mm of the tool; {nearest}; move the tool there")
        best = int(np.argmin(away))
        if best < len(held):
            self.untie(int(held[best]), actor)
            return f"opens tie {held[best]}"
        self.open(bound[best - len(held)], actor)
        return f"opens the tie of body {bodies[best]}"

    # ------------------------------------------------------------------ leaves

    def leaves_on(self, body: int, start: float = 0.0, end: float = np.inf) -> np.ndarray:
        """Returns the leaves [k] that grow on a segment, or a part of one, between ``start`` and ``end`` [m], sorted,
        and are still on."""
        plants = self.plants
        model = plants.model
        segment = plants.stumps.segment_of(checked_index("body", body, len(plants.body_mass)))
        is_first = plants.body_start[body] <= 0.0
        is_last = plants.body_end[body] >= model.body_length[segment]
        low = max(start, -np.inf if is_first and start <= 0.0 else float(plants.body_start[body]))
        high = min(end, np.inf if is_last else float(plants.body_end[body]))
        base = model.leaf_base[:, 0]
        here = (model.leaf_body == segment) & (base >= (low if low > 0.0 else -np.inf)) & (base < high)
        return np.flatnonzero(here & ~plants.state.leaf_off)

    def take_leaves(self, leaves: np.ndarray, actor: str = "", *, is_remote: bool = False) -> int:
        """Take ``leaves`` [k] off: they have no mass and no area any more, cannot be touched, and are not drawn. Call
        this between steps. Returns how many were still on.

        ``is_remote``: another client has taken them off; the tree does not wake, and nothing is reported. Raises
        :class:`ValueError` if there is no such leaf.
        """
        plants = self.plants
        model = plants.model
        state = plants.state
        leaves = np.unique(np.asarray(leaves, int))
        for leaf in leaves.tolist():
            checked_index("leaf", leaf, len(model.leaf_body))
        leaves = leaves[~state.leaf_off[leaves]]
        if len(leaves) == 0:
            return 0
        off = state.leaf_off.copy()
        off[leaves] = True
        state.leaf_off = off
        for segment in np.unique(model.leaf_body[leaves]).tolist():
            plants.stumps.shed(segment)
        self.contact_solver.hide_leaves(self._leaf_capsule[leaves])
        if not is_remote:
            plants.wake(np.unique(model.body_tree[model.leaf_body[leaves]]))
            for segment in np.unique(model.leaf_body[leaves]).tolist():
                self._report(LEAVES, "command", segment, 0.0, actor, -1)
        return len(leaves)


def tied_places(start: float, end: float) -> np.ndarray:
    """Returns the places [k] m between ``start`` and ``end`` [m] along a body at which a tie may be bound."""
    return np.linspace(start, end, _TIED_PLACES)


def place_at_wire(model: Model, places: np.ndarray, radius: float, reach: float) -> tuple[int, np.ndarray]:
    """Find where a cane of ``radius`` [m] is nearest to a straight wire.

    Returns the index of the nearest of the points ``places`` [k, 3] m of its axis, and where this point [3] m is when
    the cane touches the wire on the side on which it is. Raises :class:`ValueError` if no wire is nearer than ``reach``
    [m].
    """
    wires = np.flatnonzero(model.fixed_organ == int(Organ.WIRE))
    start = model.fixed_start[wires].astype(float)
    way = model.fixed_end[wires].astype(float) - start
    square = np.maximum((way * way).sum(1), 1e-12)
    share = np.clip(((places[:, None] - start) * way).sum(2) / square, 0.0, 1.0)
    off = places[:, None] - start - share[..., None] * way
    gaps = np.linalg.norm(off, axis=2)
    if not len(wires) or gaps.min() > reach:
        nearest = f"the nearest is {gaps.min():.3f} m away" if len(wires) else "there is none"
        middle = np.round(places[len(places) // 2], 3).tolist()
        raise ValueError(f"no wire within {reach} m of {middle}; {nearest}; give to = [x, y, z]")
    place, wire = (int(n) for n in np.unravel_index(np.argmin(gaps), gaps.shape))
    gap = float(gaps[place, wire])
    side = off[place, wire] / gap if gap > 1e-6 else np.array([0.0, 0.0, 1.0])
    return place, places[place] + side * (radius + float(model.fixed_radius[wires[wire]].mean()) - gap)


def nearest_place(plants: ArticulationSolver, body: int, along: float | None = None) -> tuple[float, np.ndarray]:
    """Returns the place [m] along a piece of cane that is nearest to a wire, or ``along`` [m] if it is given, and the
    point [3] m to which a tie pulls it. Raises :class:`ValueError` if no wire is within :data:`TIE_REACH`."""
    plants.forward_kinematics(plants.model.body_tree[[body]])
    pose = plants.state.body_q[body].astype(float)
    start, end = float(plants.body_start[body]), float(plants.body_end[body])
    places = tied_places(start, end) if along is None else np.array([float(along)])
    points = pose[:3] + frames.rotate(pose[3:], places[:, None] * np.array([1.0, 0.0, 0.0]))
    radius = float(plants.model.body_radius[plants.stumps.segment_of(body)].mean())
    nearest, to = place_at_wire(plants.model, points, radius, TIE_REACH)
    return float(places[nearest]), to
