"""Pruning by rule: which canes of dormant vines stay, where all others are cut, and from where a robot cuts them.

    cuts = prune(model.nodes, model.canes, PruningRule())
    for cut in cuts:
        print(cut.cane, cut.body, cut.along, "is shortened" if cut.is_kept else "is removed")

The rule is a pure function of the tables of canes and nodes (docs/season.md). Pruners of a vineyard retained canes that
were on average 9.2 mm thick, 105 cm long, 11 cm from the trunk and 83 cm high (AJGWR 2022, abstract); :func:`rating`
measures the distance from these means. The spreads and bounds are GUESSED, since the abstract has no spreads.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from vinesim.client.tasks.start_poses import PlacementError, ground_clearance
from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.robot.tasks.prune import PruneStop, WoodCut
from vinesim.scene.model import Model
from vinesim.scene.nodes import DormantCanes, Nodes
from vinesim.scene.terrain import on_ground

REMOVED_AT = 0.7
"""Place at which a cane is removed, as a share of the way from its base to its first node. GUESSED: the wood dries back
over two to three diameters, so that about 3 cm are left; the blades are then beside no bud of the other cane of a spur,
which stands an internode higher or lower."""
ABOVE_BUD = 0.015
"""[m] Distance of a cut above the last bud that is kept. Handbooks ask for one to two centimetres; GUESSED."""
CANES_OF_SPUR = 3
"""Largest number of canes on a spur; longer two-year wood is a fruiting cane."""
ROW_DISTANCE = 0.95
"""[m] Distance of the base's centre from the cane, across the row; the row is to the robot's left. From here the arm of
Vinebot reaches cuts 0.15 to 0.45 m ahead from all directions that are tried; from 0.80 m its elbow would bend too far
for two of the seven."""
CANE_AHEAD = 0.35
"""[m] Distance of the cane ahead of the base's centre, along the row."""
ROW_ROOM = 0.42
"""[m] Free distance around the centre of a base that drives along a row."""


@dataclasses.dataclass(frozen=True)
class PruningRule:
    """Which canes are kept, and how many buds of them."""

    diameter: float = 0.0092
    """[m] Wanted thickness of a kept cane."""
    length: float = 1.05
    """[m] Wanted length before the cut."""
    from_trunk: float = 0.11
    """[m] Wanted distance of its base from the trunk."""
    height: float = 0.83
    """[m] Wanted height of its base."""
    thickest: float = 0.012
    """[m] Thicker canes are not kept. :attr:`thinnest` is the lower bound."""
    thinnest: float = 0.007
    shortest: float = 0.6
    """[m] Shorter canes are not kept."""
    buds: int = 2
    """Number of buds that stay on a kept cane of a spur."""
    cane_buds: int = 10
    """Number of buds that stay on a cane that becomes a fruiting cane. GUESSED: eight to twelve are usual."""
    keep: int = 1
    """Number of canes that stay of each group."""
    of: str = "spur"
    """Group of canes of which ``keep`` stay: ``"spur"``, the canes on one piece of two-year wood, or ``"vine"``. With
    ``"spur"`` the fruiting canes of vines that were pruned to canes are renewed, see :func:`prune`."""

    def __post_init__(self) -> None:
        """Raises :class:`UsageError` for values that no rule can have."""
        if self.of not in ("spur", "vine"):
            raise UsageError(f"rule: of is {self.of!r}; give 'spur' or 'vine'")
        for name in ("buds", "cane_buds", "keep"):
            if getattr(self, name) < 1:
                raise UsageError(f"rule: {name} is {getattr(self, name)}; give 1 or more")


_SPREAD = {"diameter": 0.001, "length": 0.15, "from_trunk": 0.10, "height": 0.05}
"""[m] Differences that count as much as each other. GUESSED"""


@dataclasses.dataclass(frozen=True)
class Cut:
    """One cut of a rule."""

    cane: int
    body: int
    """Body that is cut, ``along`` [m] from its origin."""
    along: float
    is_kept: bool
    """Whether the cane is shortened to its buds; otherwise it is removed."""


def rating(canes: DormantCanes, rule: PruningRule) -> np.ndarray:
    """Returns the distance of each cane from the rule's wanted cane [cane], in units of :data:`_SPREAD`; infinite for
    canes that may not be kept."""
    parts = [((getattr(canes, name) - getattr(rule, name)) / spread) ** 2 for name, spread in _SPREAD.items()]
    off = np.sqrt(np.sum(parts, axis=0))
    allowed = (canes.year == 1) & (canes.diameter >= rule.thinnest) & (canes.diameter <= rule.thickest)
    return np.where(allowed & (canes.length >= rule.shortest), off, np.inf)


def prune(nodes: Nodes, canes: DormantCanes, rule: PruningRule) -> tuple[Cut, ...]:
    """Returns the cuts of a rule, vine by vine and group by group: first those that shorten kept canes, then those that
    remove the others.

    Vines that were pruned to canes have a fruiting cane on either side, and a renewal spur. Each fruiting cane is cut
    off with all that stands on it. Of the canes on a renewal spur the best becomes the next fruiting cane, and keeps
    ``rule.cane_buds``. The others become the next renewal spur.

    Raises :class:`UsageError` if there are no dormant canes, or the rule lets none of them stay.
    """
    last = np.flatnonzero(canes.year == 1)
    if not len(last):
        raise UsageError("there is no dormant cane to prune; give a scene with a date in winter, as winter_spur")
    rated = rating(canes, rule)
    if not np.isfinite(rated[last]).any():
        raise UsageError(
            f"no cane of {len(last)} satisfies the rule: {1e3 * rule.thinnest:g} to {1e3 * rule.thickest:g} mm thick, "
            f"{rule.shortest:g} m or longer; the canes are {1e3 * canes.diameter[last].min():.1f} to "
            f"{1e3 * canes.diameter[last].max():.1f} mm and up to {canes.length[last].max():.2f} m"
        )
    group = canes.parent if rule.of == "spur" else canes.vine
    fruiting = _fruiting_canes(canes)
    renewed = np.unique(canes.vine[fruiting])
    found: list[Cut] = []
    for one in np.unique(np.column_stack([canes.vine[last], group[last]]), axis=0):
        mine = last[(canes.vine[last] == one[0]) & (group[last] == one[1])]
        if rule.of == "spur" and one[1] in fruiting:
            found.append(_removed(nodes, canes, int(one[1])))
            continue
        mine = mine[np.argsort(rated[mine], kind="stable")]
        kept = [cane for cane in mine[: rule.keep].tolist() if np.isfinite(rated[cane])]
        if rule.of == "spur" and one[0] in renewed:
            buds = [rule.cane_buds if cane in kept else rule.buds for cane in mine.tolist()]
            cuts = [_shortened(nodes, cane, many) for cane, many in zip(mine.tolist(), buds, strict=True)]
            found += [cut for cut in cuts if cut is not None]
            continue
        found += [cut for cane in kept if (cut := _shortened(nodes, cane, rule.buds)) is not None]
        found += [_removed(nodes, canes, cane) for cane in mine.tolist() if cane not in kept]
    return tuple(found)


def _fruiting_canes(canes: DormantCanes) -> np.ndarray:
    """Returns the ids of pieces of two-year wood that bear more canes than a spur [k]."""
    parents, count = np.unique(canes.parent[canes.year == 1], return_counts=True)
    return parents[count > CANES_OF_SPUR]


def _shortened(nodes: Nodes, cane: int, buds: int) -> Cut | None:
    """Returns the cut above the last of ``buds`` buds of a cane; None if it has no further node."""
    mine = np.flatnonzero(nodes.cane == cane)
    mine = mine[np.argsort(nodes.rank[mine], kind="stable")]
    with_bud = mine[nodes.bud[mine] >= 0]
    if len(with_bud) <= buds:
        return None
    last = with_bud[buds - 1]
    return Cut(cane, int(nodes.body[last]), float(nodes.along[last]) + ABOVE_BUD, is_kept=True)


def _removed(nodes: Nodes, canes: DormantCanes, cane: int) -> Cut:
    """Returns the cut that removes a cane, between its base and its first node."""
    mine = np.flatnonzero(nodes.cane == cane)
    first = mine[np.argmin(nodes.rank[mine])]
    body = int(canes.body[cane])
    reach = float(nodes.along[first]) if int(nodes.body[first]) == body else 2.0 * ABOVE_BUD
    return Cut(cane, body, REMOVED_AT * reach, is_kept=False)


def placed(model: Model, cut: Cut) -> Cut:
    """Returns the cut with a place within its body: beyond the end of a body, the place is in the next one."""
    body = cut.body
    along = cut.along
    last = int(model.canes.body[cut.cane] + model.canes.size[cut.cane]) - 1
    while along > float(model.body_length[body]) and body < last:
        along -= float(model.body_length[body])
        body += 1
    return dataclasses.replace(cut, body=body, along=min(along, float(model.body_length[body])))


# From where a robot cuts.


def plan_pruning(
    model: Model, near: np.ndarray, rule: PruningRule, *, vines: int = 1, spurs: int | None = None
) -> list[PruneStop]:
    """Returns the stops of a robot that prunes the ``vines`` vines nearest to ``near`` [2] m, with the cuts at each
    stop; along each row from its one end to the other.

    ``spurs``: largest number of pieces of two-year wood of each vine; all unless given. Raises :class:`PlacementError`
    if a robot can stand before none of them.
    """
    cuts = [placed(model, cut) for cut in prune(model.nodes, model.canes, rule)]
    q = model.forward_kinematics(model.joint_settled).astype(float)
    canes = model.canes
    bases = q[canes.body, :3]
    by_vine: dict[int, list[Cut]] = {}
    for cut in cuts:
        by_vine.setdefault(int(canes.vine[cut.cane]), []).append(cut)
    order = sorted(by_vine, key=lambda vine: float(np.linalg.norm(_middle(bases, by_vine[vine]) - near)))
    stops: list[PruneStop] = []
    for vine in order:
        found = list(_stops_of_vine(model, q, by_vine[vine], near, spurs))
        stops += found
        vines -= bool(found)
        if not vines:
            break
    if not stops:
        raise PlacementError(f"no vine has {ROW_ROOM} m of room for a robot that drives along its row")
    return stops


def _middle(bases: np.ndarray, cuts: list[Cut]) -> np.ndarray:
    return bases[[cut.cane for cut in cuts], :2].mean(0)


def _stops_of_vine(
    model: Model, q: np.ndarray, cuts: list[Cut], near: np.ndarray, spurs: int | None
) -> Iterator[PruneStop]:
    """Yields the stops along one vine: one for each group of canes on one tree."""
    place = {cut: _place(q, cut) for cut in cuts}
    points = np.array(list(place.values()))[:, :2]
    spread = points - points.mean(0)
    row = np.linalg.svd(spread, full_matrices=False)[2][0] if len(points) > 2 else np.array([1.0, 0.0])
    across = np.array([-row[1], row[0]])
    if (near - points.mean(0)) @ across > 0.0:  # the robot drives with the row to its left
        row = -row
        across = -across
    heading = float(np.arctan2(row[1], row[0]))
    groups: dict[int, list[Cut]] = {}
    for cut in cuts:
        groups.setdefault(int(model.body_tree[cut.body]), []).append(cut)
    middle = float(np.median(points @ across))
    ordered = sorted(groups.values(), key=lambda group: float(np.mean([place[cut][:2] @ row for cut in group])))
    for group in ordered[:spurs]:
        along = float(np.mean([place[cut][:2] @ row for cut in group])) - CANE_AHEAD
        base = along * row + (middle - ROW_DISTANCE) * across
        if float(ground_clearance(model, base[None])[0]) < ROW_ROOM:
            continue
        pose = on_ground(model.terrain, frames.pose(np.append(base, 0.0), frames.from_yaw(heading)))
        ahead = np.append(across, 0.0)
        yield PruneStop(pose, tuple(WoodCut(one.cane, one.body, one.along, one.is_kept, ahead) for one in group))


def _place(q: np.ndarray, cut: Cut) -> np.ndarray:
    return frames.compose(q[cut.body], frames.pose([cut.along, 0.0, 0.0]))[:3]
