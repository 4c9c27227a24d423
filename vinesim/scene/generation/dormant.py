"""Dormant vines: bare canes of lignified wood on two-year wood, with nodes and buds.

Each piece of two-year wood (:mod:`~vinesim.scene.generation.bearers`) is a tree with the canes that it bears. A cane
has the shape of the shoot of the same scene in summer, up to where its wood was ripe.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene import builder
from vinesim.scene.builder import RodMaterial, TreeBuilder
from vinesim.scene.generation.bearers import Bearer, without_arms
from vinesim.scene.generation.fixed_structure import FixedStructure
from vinesim.scene.generation.gnarl import vine_generators
from vinesim.scene.generation.plant_bodies import build_bodies
from vinesim.scene.generation.shoot_slots import AXIS_SEGMENTS
from vinesim.scene.generation.shoots import Shoots
from vinesim.scene.generation.ties import find_ties, nearest_wire
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.nodes import DormantCanes, Nodes
from vinesim.scene.plant_parameters import VineParameters
from vinesim.scene.season import SeasonState, load_season
from vinesim.scene.spec import Scene

_STAGE = 5
"""Stage of the random generators of :func:`~vinesim.scene.generation.gnarl.vine_generators`, for buds."""
_NODE_OFFSET = 0.7
"""Distance of the first node from the base of a cane, in internodes; leaves in summer stand at the same places."""
_ON_WIRE = 0.03
"""[m] Depth below the fruiting wire down to which a fruiting cane is tied to it."""
_BUD_FOOT = 1.12
"""Distance of a bud's base from the axis of its cane, in radii of the cane: it stands on the swelling of its node."""
_BUD_LEAN = 0.7
"""Tangent of the angle between a bud and its cane. GUESSED from photographs."""


def ripe_canes(shoots: Shoots) -> Shoots:
    """Returns the shoots as far as their wood is ripe, without laterals and bunches: what stands in winter."""
    share = load_season().dormant.ripe_share.value
    at = share * np.arange(AXIS_SEGMENTS + 1)
    piece = np.minimum(at.astype(int), AXIS_SEGMENTS - 1)
    rest = (at - piece)[:, None]
    points = shoots.points[:, piece] * (1.0 - rest) + shoots.points[:, piece + 1] * rest
    return dataclasses.replace(
        shoots,
        points=points,
        length=share * shoots.length,
        has_lateral=np.zeros_like(shoots.has_lateral),
        has_bunch=np.zeros_like(shoots.has_bunch),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Vines:
    """Trunks, wires and shoots of a vineyard, on level ground or on its terrain."""

    structure: FixedStructure
    shoots: Shoots
    """Ripe canes, see :func:`ripe_canes`."""


def build_dormant(scene: Scene, parameters: VineParameters, level: Vines, vines: Vines, state: SeasonState) -> Model:
    """Returns the model of dormant vines, not yet in equilibrium. ``level``: the vines on level ground, from which ties
    are found; ``vines``: the same on the scene's terrain."""
    shoots = vines.shoots
    canes = _Canes(vines)
    for bearer in shoots.bearers:
        canes.add(bearer)
    structure = vines.structure
    if scene.pruning == "cane":
        structure = without_arms(structure)
        level = dataclasses.replace(level, structure=without_arms(level.structure))
    boxes = [frames.pose(np.array([box.x, box.y, 0.0]), frames.from_yaw(box.yaw)) for box in scene.boxes]
    model = builder.assemble(
        canes.trees,
        box_pose=np.reshape(boxes, (-1, 7)),
        box_size=np.reshape([box.size for box in scene.boxes], (-1, 3)),
        box_mass=np.array([box.mass for box in scene.boxes]),
        **structure.fixed,
        **_find_ties(scene, parameters, level, vines, canes),
    )
    if scene.pruning == "spur":  # trunks and wires hold fruiting canes, which do not sit on arms
        arms = np.flatnonzero(model.fixed_organ == int(Organ.ARM))
        model.tree_piece[:] = arms[[one.piece for one in shoots.bearers]]
    model.body_drag[:] = parameters.cane.drag.value * model.body_radius.sum(1) * model.body_length
    model.canes, model.nodes = _place_nodes(scene, vines, canes, state)
    return model


class _Canes:
    """Trees of two-year wood and canes, and the rows of the table of canes."""

    def __init__(self, vines: Vines) -> None:
        dormant = load_season().dormant
        shoots = vines.shoots
        self.trees: list[TreeBuilder] = []
        self.rows: list[dict[str, float]] = []
        self.bearers: list[Bearer] = []
        self.first = np.full(len(shoots.vine), -1)
        """[shoot] First body of each shoot's cane."""
        self.cane = np.full(len(shoots.vine), -1)
        """[shoot] Id of each shoot's cane."""
        self.bearer_rows: list[int] = []
        """Id of each bearer's cane."""
        self._shoots = shoots
        self._structure = vines.structure
        self._tip = 0.5 * dormant.tip_diameter.value
        self._wood = RodMaterial(dormant.modulus.value, dormant.density.value, dormant.damping.value)
        self._bodies = 0
        self._turns: list[np.ndarray] = []
        """Orientation in the world of each body of the last tree."""

    def add(self, bearer: Bearer) -> None:
        """Add a tree: a bearer with its canes."""
        shoots = self._shoots
        up = shoots.up[bearer.shoots[0]]
        turns = frames.from_x_axis(np.diff(bearer.points, axis=0), up)
        tree = TreeBuilder(frames.pose(bearer.points[0], turns[0]), vine=bearer.vine)
        self._turns = []
        number = len(self.trees)
        row = len(self.rows)
        pieces = self._add_rods(tree, -1, np.zeros(3), bearer.points, bearer.radius, up)
        self.bearer_rows.append(row)
        self.bearers.append(bearer)
        self._add_row(bearer.vine, number, 0, bearer.points, bearer.radius, year=2)
        for shoot, at in zip(bearer.shoots, bearer.at, strict=True):
            points = shoots.points[shoot]
            parent = at - 1
            offset = frames.rotate(frames.conjugate(turns[parent]), points[0] - bearer.points[parent])
            radius = np.linspace(shoots.base[shoot], self._tip, len(points))
            local = self._add_rods(tree, pieces[parent], offset, points, radius, up)
            self.first[shoot] = self._bodies + local[0]
            self.cane[shoot] = len(self.rows)
            self._add_row(bearer.vine, number, local[0], points, radius, shoot=shoot, parent=row)
        self._bodies += len(tree.bodies)
        self.trees.append(tree)

    def _add_rods(
        self,
        tree: TreeBuilder,
        parent: int,
        offset: np.ndarray,
        points: np.ndarray,
        radius: np.ndarray,
        up: np.ndarray,
    ) -> list[int]:
        """Add a body for each piece of a polyline ``points`` [point, 3] m that begins at ``offset`` [3] m in the frame
        of the body ``parent``, and return their numbers in the tree."""
        along = np.diff(points, axis=0)
        turns = frames.from_x_axis(along, up)
        above = tree.pose[3:] if parent < 0 else self._turns[parent]
        numbers = []
        for piece, length in enumerate(np.linalg.norm(along, axis=1)):
            (parent,) = tree.add_rod(
                parent,
                float(length),
                (float(radius[piece]), float(radius[piece + 1])),
                self._wood,
                1,
                offset=offset if piece == 0 else None,
                rest=frames.multiply(frames.conjugate(above), turns[piece]),
            )
            above = turns[piece]
            self._turns.append(above)
            numbers.append(parent)
        return numbers

    def _add_row(
        self,
        vine: int,
        tree: int,
        local: int,
        points: np.ndarray,
        radius: np.ndarray,
        year: int = 1,
        shoot: int = -1,
        parent: int = -1,
    ) -> None:
        head = self._structure.trunk[vine, -1]
        nodes = self._shoots.nodes[shoot] if shoot >= 0 else 1
        measured = (
            (1.5 + _NODE_OFFSET) / max(nodes * load_season().dormant.ripe_share.value, 1.0) if shoot >= 0 else 0.0
        )
        self.rows.append(
            {
                "body": self._bodies + local,
                "size": len(points) - 1,
                "tree": tree,
                "vine": vine,
                "year": year,
                "shoot": shoot,
                "parent": parent,
                "length": float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()),
                "diameter": 2.0 * float(radius[0] + (radius[-1] - radius[0]) * min(measured, 1.0)),
                "from_trunk": float(np.sqrt(((points[0, :2] - head[:2]) ** 2).sum())),
                "height": float(points[0, 2] - self._structure.foot[vine, 2]),
            }
        )

    def table(self) -> DormantCanes:
        """Returns the table of all canes; their nodes are filled in later."""
        table = DormantCanes.allocate(cane=len(self.rows))
        for name in self.rows[0] if self.rows else ():
            getattr(table, name)[:] = [row[name] for row in self.rows]
        return table


def _find_ties(
    scene: Scene, parameters: VineParameters, level: Vines, vines: Vines, canes: _Canes
) -> dict[str, np.ndarray]:
    """Returns the ``tie_`` arrays of the model: canes are tied to the wires as shoots in summer, and fruiting canes to
    the fruiting wire."""
    trellis = parameters.trellis
    flat = build_bodies(parameters, level.shoots)
    found = find_ties(scene, parameters, level.structure, level.shoots, flat)
    shoot = found["shoot"]
    slot = found["slot"]
    share = found["point"][:, :1] / flat.length[shoot, slot][:, None]
    start = vines.shoots.points[shoot, slot]
    end = vines.shoots.points[shoot, slot + 1]
    body = canes.first[shoot] + slot
    point = share * np.linalg.norm(end - start, axis=1, keepdims=True) * [1.0, 0.0, 0.0]
    anchor = start + share * (end - start)
    wire = found["wire"]
    every = load_season().dormant.tie_spacing.value
    more = []
    for number, (bearer, row) in enumerate(zip(vines.shoots.bearers, canes.bearer_rows, strict=True)):
        if bearer.is_spur:
            continue
        points = level.shoots.bearers[number].points
        way = np.cumsum(np.append(0.0, np.linalg.norm(np.diff(points, axis=0), axis=1)))
        last = -np.inf
        for at in np.flatnonzero(points[:-1, 2] > scene.layout.height - _ON_WIRE).tolist():
            if way[at] - last >= every:
                last = way[at]
                more.append((int(canes.rows[row]["body"]) + at, bearer.points[at], points[at]))
    if more:
        place = np.array([flat_place for _, _, flat_place in more])
        body = np.concatenate([body, [number for number, _, _ in more]])
        point = np.concatenate([point, np.zeros((len(more), 3))])
        anchor = np.concatenate([anchor, [place for _, place, _ in more]])
        wire = np.concatenate([wire, nearest_wire(level.structure, place, np.zeros(len(more), int))])
    order = np.argsort(body, kind="stable")
    stiffness = np.full(len(order), trellis.tie_stiffness.value)
    return {
        "tie_body": body[order],
        "tie_point": point[order],
        "tie_anchor": anchor[order],
        "tie_wire": wire[order],
        "tie_stiffness": stiffness,
        "tie_damping": trellis.tie_damping.value * stiffness,
    }


def _place_nodes(scene: Scene, vines: Vines, canes: _Canes, state: SeasonState) -> tuple[DormantCanes, Nodes]:
    """Returns the tables of canes and of nodes. Buds stand alternately on both sides of their cane."""
    dormant = load_season().dormant
    table = canes.table()
    shoots = vines.shoots
    share = dormant.ripe_share.value
    rngs = vine_generators(scene, vines.structure.row, vines.structure.place, _STAGE)
    parts: list[dict[str, np.ndarray]] = []
    count = 0
    bearers = dict(zip(canes.bearer_rows, shoots.bearers, strict=True))
    for cane in range(len(table.body)):
        first = int(table.body[cane])
        if cane in bearers:
            bearer = bearers[cane]
            length = np.linalg.norm(np.diff(bearer.points, axis=0), axis=1)
            many = len(length)
            body = first + np.arange(many)
            along = length
            for shoot, at in zip(bearer.shoots, bearer.at, strict=True):
                table.node[canes.cane[shoot]] = count + at - 1
            part = {"bud": np.zeros(many, bool)}
        else:
            shoot = int(table.shoot[cane])
            points = shoots.points[shoot]
            length = np.linalg.norm(np.diff(points, axis=0), axis=1)
            way = np.cumsum(np.append(0.0, length))
            place = (np.arange(shoots.nodes[shoot]) + _NODE_OFFSET) / (shoots.nodes[shoot] * share)
            place = place[place < 0.995] * way[-1]
            many = len(place)
            piece = np.minimum(np.searchsorted(way, place, "right") - 1, AXIS_SEGMENTS - 1)
            body = first + piece
            along = place - way[piece]
            g = rngs[int(table.vine[cane])]
            turn = frames.from_x_axis(np.diff(points, axis=0), shoots.up[shoot])[piece]
            axis = frames.rotate(turn, np.array([1.0, 0.0, 0.0]))
            hand = np.where((np.arange(many) + shoot) % 2, 1.0, -1.0)[:, None]
            side = hand * frames.normalize(frames.cross(shoots.up[shoot], axis)) + 0.25 * g.normal(size=(many, 3))
            local = frames.rotate(frames.conjugate(turn), side) * [0.0, 1.0, 1.0]
            local = frames.normalize(local)
            wide = shoots.base[shoot] + (0.5 * dormant.tip_diameter.value - shoots.base[shoot]) * place / way[-1]
            foot = local * _BUD_FOOT * wide[:, None] + along[:, None] * [1.0, 0.0, 0.0]
            points_to = frames.normalize(local * _BUD_LEAN + [1.0, 0.0, 0.0])
            tall = dormant.bud_length.at(g.random(many))
            part = {
                "bud": np.ones(many, bool),
                "bud_pose": frames.pose(foot, frames.from_x_axis(points_to, np.array([0.0, 0.0, 1.0]))),
                "bud_length": tall + state.burst * g.random(many) * (dormant.burst_length.value - tall),
                "bud_radius": 0.5 * dormant.bud_diameter.at(g.random(many)),
            }
        part |= {"body": body, "along": along, "cane": np.full(many, cane), "rank": np.arange(many)}
        parts.append(part)
        count += many
    nodes = Nodes.allocate(node=count)
    at = 0
    for part in parts:
        rows = slice(at, at + len(part["body"]))
        for name, value in part.items():
            if name != "bud":
                getattr(nodes, name)[rows] = value
        nodes.bud[rows] = np.where(part["bud"], 0, -1)
        at = rows.stop
    has = nodes.bud >= 0
    nodes.bud[has] = np.arange(int(has.sum()))
    return table, nodes
