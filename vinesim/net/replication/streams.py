"""Streams of states of moving objects. A stream stores the last published states, computes the errors of the copies on
other clients, and encodes the messages that correct the copies.

:class:`TreeStream` is for trees, which stay in one cell. :class:`ObjectStream` is for boxes and free bunches, which
move between cells. Sender and receiver store the same quantised states and extrapolate them in the same way
(:mod:`vinesim.net.replication.dead_reckoning`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from vinesim.net.codec.objects import ObjectStates, encode_objects
from vinesim.net.codec.trees import RESTING, TreeStates, encode_trees
from vinesim.net.replication import dead_reckoning, interest
from vinesim.net.replication.authority import Claim
from vinesim.net.replication.interest import Cell
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.values import ObjectUpdate, TreeUpdate

StateReader = Callable[[int], tuple[np.ndarray, np.ndarray]]
"""Function that returns the present state and rate of an object, by its id.

For a tree: joint rotations [n, 4] and rates [n, 3] rad/s. For a box or bunch: pose [7] and velocity [6]."""

DetachedRoots = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Bodies that were cut off a tree: indices [k] within the tree, positions [k, 3] m, velocities [k, 3] m/s."""

NO_ROOTS: DetachedRoots = (np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


@dataclasses.dataclass(frozen=True, slots=True)
class ClaimColumns:
    """Claims and flags of the objects in one message."""

    claims: list[Claim]
    flags: list[int]

    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the ownership sequences, authority sequences and flags of ``k`` objects, each as an array [k]."""
        return (
            np.array([claim.ownership for claim in self.claims]),
            np.array([claim.authority for claim in self.claims]),
            np.array(self.flags),
        )


class TreeStream:
    """The last published and received states of all trees."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.middle = _tree_centres(model)
        self.cell = [tuple(cell) for cell in interest.cells_of(self.middle).tolist()]
        self.layer_cell = [tuple(cell) for cell in interest.cells_of(self.middle, interest.TREE_CELL_SIZE).tolist()]
        """Cell of :data:`interest.TREE_CELL_SIZE` under which the states of each tree are published."""
        body_count = len(model.body_mass)
        layers = len(interest.TREE_LAYERS)
        self._bodies = [model.bodies_of(tree) for tree in range(len(model.tree_first))]
        self._lever_arm = _lever_arms(model)
        self._published_q = np.tile(np.array([0.0, 0.0, 0.0, 1.0]), (layers, body_count, 1))
        """Last published joint rotations [layer, body, 4]: those that peers know which receive all layers up to
        ``layer``."""
        self._published_rate = np.zeros((layers, body_count, 4))
        self._published_roots: tuple[dict[int, DetachedRoots], ...] = tuple({} for _ in range(layers))
        self._active: tuple[int, ...] | None = None
        self._sizes = self._starts = self._order = np.zeros(0, np.int64)
        self._q = self._qd = np.zeros((0, 4))
        self._roots: list[DetachedRoots] = []

    def read(self, active: tuple[int, ...], read: StateReader, cut: Callable[[int], DetachedRoots]) -> None:
        """Store the present states of the trees ``active``, for :meth:`prediction_error` and :meth:`encode`.

        ``cut(tree)``: function that returns the bodies that were cut off a tree.
        """
        if self._active != active:
            self._active = active
            self._sizes = self.model.tree_size[list(active)].astype(np.int64)
            self._order = np.concatenate([np.arange(b.start, b.stop) for b in (self._bodies[tree] for tree in active)])
            self._starts = np.cumsum(self._sizes) - self._sizes
        state = [read(tree) for tree in active]
        self._q = np.concatenate([joint_q for joint_q, _ in state]).astype(np.float64)
        self._qd = np.concatenate([joint_qd for _, joint_qd in state]).astype(np.float64)
        self._roots = [cut(tree) for tree in active]

    def prediction_error(self, layer: int, silence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the errors of the copies, on other clients, of the ``k`` trees that were last read: positions [k] m,
        angles [k] rad.

        The copies are those of peers that receive no layer after ``layer``. ``silence`` [k]: time since the last state
        that these peers received [s].
        """
        assert self._active is not None
        bodies = self._order
        horizon = dead_reckoning.clamp_age(silence)
        dt = np.repeat(dead_reckoning.faded_age(silence), self._sizes)[:, None]
        angle = dead_reckoning.angle_between(
            self._q,
            dead_reckoning.extrapolate(self._published_q[layer, bodies], self._published_rate[layer, bodies], dt),
        )
        position = np.add.reduceat(angle * self._lever_arm[bodies], self._starts)
        for row, (tree, roots) in enumerate(zip(self._active, self._roots, strict=True)):
            if len(roots[0]):
                published = self._published_roots[layer].get(tree, NO_ROOTS)
                if len(published[0]) != len(roots[0]):
                    position[row] = np.inf
                else:
                    predicted = published[1] + published[2] * np.atleast_1d(horizon)[row]
                    position[row] += np.linalg.norm(roots[1] - predicted, axis=1).max()
        return position, np.maximum.reduceat(angle, self._starts)

    def encode(self, rows: list[int], published: ClaimColumns, time: float, layer: int) -> list[bytes]:
        """Encode the states of some of the trees that were last read, and return the messages.

        The states become the last published ones on ``layer`` and all layers after it. ``rows``: indices into the trees
        that were last read. ``published``: claims and flags of these trees. ``time``: network time [s].
        """
        assert self._active is not None
        here = [self._active[row] for row in rows]
        part: slice | np.ndarray = slice(None)
        if len(rows) < len(self._active):
            part = np.concatenate([np.arange(self._starts[r], self._starts[r] + self._sizes[r]) for r in rows])
        batch = TreeStates(time, np.array(here), *published.columns(), self._sizes[rows], self._q[part], self._qd[part])
        payloads, received = encode_trees(with_roots(batch, [self._roots[row] for row in rows]))
        bodies = self._order[part]
        self._published_q[layer:, bodies] = received.joint_q
        self._published_rate[layer:, bodies] = dead_reckoning.quaternion_rate(received.joint_q, received.joint_qd)
        for update in received.updates("") if len(received.root) else ():
            for roots in self._published_roots[layer:]:
                roots[update.tree] = update.root, update.root_x, update.root_xd
        return payloads

    def extrapolated(self, news: dict[int, tuple[TreeStates, str]], now: float, time: float) -> list[TreeUpdate]:
        """Returns received states of trees, extrapolated to network ``time`` [s], with own time ``now`` [s] as their
        time.

        ``news``: the newest batch that contains a tree, and its owner, by tree. The states in ``news`` become the last
        published ones.
        """
        found: dict[int, TreeUpdate] = {}
        for trees, sender in {id(batch[0]): batch for batch in news.values()}.values():
            rate = dead_reckoning.quaternion_rate(trees.joint_q, trees.joint_qd)
            age = float(dead_reckoning.clamp_age(time - trees.time))
            here = dataclasses.replace(trees, time=now)
            if age > 0.0 and not (trees.flags & RESTING).any():
                here = dataclasses.replace(
                    here,
                    joint_q=dead_reckoning.extrapolate(trees.joint_q, rate, dead_reckoning.faded_age(age)),
                    root_x=trees.root_x + age * trees.root_xd,
                )
            first = 0
            for received, update in zip(trees.updates(sender), here.updates(sender), strict=True):
                last = first + len(update.joint_q)
                if news.get(update.tree, (None,))[0] is trees:
                    found[update.tree] = update
                    bodies = self._bodies[update.tree]
                    self._published_q[:, bodies] = trees.joint_q[first:last]
                    self._published_rate[:, bodies] = rate[first:last]
                    for roots in self._published_roots:
                        roots[update.tree] = received.root, received.root_x, received.root_xd
                first = last
        return [found[tree] for tree in sorted(found)]


class ObjectStream:
    """The last published and received states of all boxes and free bunches."""

    def __init__(self) -> None:
        self._published: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._received: dict[int, ObjectUpdate] = {}
        self._cell: dict[int, Cell] = {}
        self._pose = self._velocity = np.zeros((0, 7))
        self._active: tuple[int, ...] = ()

    def cell(self, object_id: int) -> Cell | None:
        """Returns the cell under which an object was last published, or None."""
        return self._cell.get(object_id)

    def position(self, object_id: int) -> np.ndarray:
        """Returns the last known position of an object [3] m; zero if it is unknown."""
        return self._published[object_id][0][:3] if object_id in self._published else np.zeros(3)

    def positions(self, active: tuple[int, ...], read: StateReader) -> np.ndarray:
        """Store the present states of the objects ``active``, and return their positions [k, 3] m."""
        self._active = active
        state = [read(object_id) for object_id in active]
        self._pose = np.array([pose for pose, _ in state], float)
        self._velocity = np.array([velocity for _, velocity in state], float)
        for object_id, cell in zip(active, interest.cells_of(self._pose).tolist(), strict=True):
            self._cell[object_id] = tuple(cell)
        return self._pose[:, :3]

    def cells(self, active: tuple[int, ...]) -> list[Cell]:
        """Returns the cells under which the objects ``active`` are published."""
        return [self._cell[object_id] for object_id in active]

    def prediction_error(self, active: tuple[int, ...], silence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the errors of the copies, on other clients, of the ``k`` objects that were last read: positions [k]
        m, angles [k] rad.

        ``silence`` [k]: time since the last published state [s].
        """
        unknown: tuple[np.ndarray, np.ndarray] = np.full(7, np.inf), np.zeros(6)
        published = [self._published.get(object_id, unknown) for object_id in active]
        pose = np.array([pose for pose, _ in published])
        velocity = np.array([velocity for _, velocity in published])
        pose[:, 3:] = np.where(np.isfinite(pose[:, 3:]), pose[:, 3:], self._pose[:, 3:])
        predicted = _extrapolate_pose(pose, velocity, np.asarray(dead_reckoning.clamp_age(silence))[:, None])
        return np.linalg.norm(self._pose[:, :3] - predicted[:, :3], axis=1), dead_reckoning.angle_between(
            self._pose[:, 3:], predicted[:, 3:]
        )

    def encode(self, rows: list[int], published: ClaimColumns, time: float, cell: Cell) -> list[bytes]:
        """Encode the states of some of the objects that were last read, and return the messages.

        The states become the last published ones. ``rows``: indices into the objects that were last read.
        ``published``: claims and flags of these objects. ``time``: network time [s].
        """
        ids = np.array([self._active[row] for row in rows])
        batch = ObjectStates(time, ids, *published.columns(), self._pose[rows], self._velocity[rows])
        payloads, received = encode_objects(batch, cell)
        for object_id, pose, velocity in zip(ids.tolist(), received.pose, received.velocity, strict=True):
            self._published[object_id] = pose, velocity
        return payloads

    def receive(self, update: ObjectUpdate, cell: Cell) -> None:
        """Store a state of a peer's object that was accepted. The time of ``update`` is network time."""
        self._received[update.object] = update
        self._published[update.object] = update.pose, update.velocity
        self._cell[update.object] = cell

    def remove(self, object_id: int) -> None:
        """Forget the received state of an object that is at rest or has lost its owner."""
        self._received.pop(object_id, None)

    def shift_time(self, step: float) -> None:
        """Shift all stored times, because the network clock was set by ``step`` [s]."""
        for object_id, update in self._received.items():
            self._received[object_id] = dataclasses.replace(update, time=update.time + step)

    def extrapolated(self, remote: set[int], now: float, time: float) -> list[ObjectUpdate]:
        """Returns the states of the objects ``remote``, extrapolated to network ``time`` [s], with own time ``now``
        [s].

        ``remote``: objects that peers own. After 150 ms without a message an object stands still.
        """
        received = [self._received[object_id] for object_id in sorted(self._received.keys() & remote)]
        if not received:
            return []
        age = time - np.array([update.time for update in received])[:, None]
        velocity = np.array([update.velocity for update in received])
        poses = _extrapolate_pose(
            np.array([update.pose for update in received]), velocity, dead_reckoning.clamp_age(age)
        )
        velocity_shown = velocity * (age <= dead_reckoning.MAX_EXTRAPOLATION)
        return [
            dataclasses.replace(update, time=now, pose=pose, velocity=rate)
            for update, pose, rate in zip(received, poses, velocity_shown, strict=True)
        ]


def with_roots(trees: TreeStates, roots: list[DetachedRoots]) -> TreeStates:
    """Returns a batch of trees with the detached bodies of each tree added."""
    if not any(len(numbers) for numbers, _, _ in roots):
        return trees
    counts = np.array([len(numbers) for numbers, _, _ in roots])
    body, x, xd = (np.concatenate(column) for column in zip(*roots, strict=True))
    return dataclasses.replace(trees, roots=counts, root=body, root_x=x, root_xd=xd)


def object_counts(model: Model) -> tuple[int, ...]:
    """Returns the number of objects of each kind in a scene: trees, bunches, boxes."""
    return len(model.tree_first), len(model.bunch_body), len(model.box_mass)


def _extrapolate_pose(pose: np.ndarray, velocity: np.ndarray, dt: float | np.ndarray) -> np.ndarray:
    """Returns poses [..., 7] after ``dt`` [s] at constant velocities [..., 6] m/s, rad/s."""
    turned = dead_reckoning.extrapolate(
        pose[..., 3:], dead_reckoning.quaternion_rate(pose[..., 3:], velocity[..., 3:]), dt
    )
    return np.concatenate([pose[..., :3] + velocity[..., :3] * dt, turned], -1)


def _tree_centres(model: Model) -> np.ndarray:
    """Returns the centre of each tree [tree, 3] m: the mean position of its bodies at rest."""
    origins = model.forward_kinematics(model.joint_settled)[:, :3]
    middles = np.zeros((len(model.tree_first), 3))
    np.add.at(middles, model.body_tree, origins)
    return middles / np.maximum(model.tree_size, 1)[:, None]


def _lever_arms(model: Model) -> np.ndarray:
    """Returns the largest distance from the joint of each body to the end of a body that it carries [body] m."""
    reach = model.body_length.astype(float).copy()
    reach[model.is_spare()] = model.body_length[model.body_organ == int(Organ.CANE)].max(
        initial=0.0
    )  # if it is a stump
    for body in range(len(reach) - 1, -1, -1):
        parent = model.body_parent[body]
        if parent >= 0:
            reach[parent] = max(reach[parent], float(np.linalg.norm(model.body_offset[body])) + reach[body])
    return reach
