"""What moves, between two messages: what was last said of it, how wrong that has become, and what to say instead.

:class:`TreeStream` for trees, which stay in their cells, :class:`ThingStream` for boxes and loose bunches, which do
not. Sender and receiver remember the same quantised values and extrapolate them alike
(:mod:`vinesim.net.replication.dead_reckoning`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable

import numpy as np

from vinesim.net.codec import messages
from vinesim.net.codec.messages import ObjectStates, TreeStates
from vinesim.net.replication import dead_reckoning, interest
from vinesim.net.replication.authority import Claim
from vinesim.net.replication.interest import Cell
from vinesim.scene.model import Model
from vinesim.scene.values import ObjectUpdate, TreeUpdate

StateReader = Callable[[int], tuple[np.ndarray, np.ndarray]]
"""State and rate of one thing: joints of a tree ([n, 4], [n, 3] rad/s), pose and velocity of any other ([7], [6])."""

DetachedRoots = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Numbers [k] in their tree of bodies that were cut off it, where they are [k, 3] m, how fast [k, 3] m/s."""

NO_ROOTS: DetachedRoots = (np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


@dataclasses.dataclass(frozen=True, slots=True)
class ClaimColumns:
    """By whom and with what right the things of one message are moved, thing by thing."""

    claims: list[Claim]
    flags: list[int]

    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Ownership, authority and flags [k] each."""
        return (
            np.array([claim.ownership for claim in self.claims]),
            np.array([claim.authority for claim in self.claims]),
            np.array(self.flags),
        )


class TreeStream:
    """Trees that move."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.middle = _tree_centres(model)
        self.cell = [tuple(cell) for cell in interest.cells_of(self.middle).tolist()]
        body_count = len(model.body_mass)
        self._bodies = [model.bodies_of(tree) for tree in range(len(model.tree_first))]
        self._reach = _lever_arms(model)
        self._said_q = np.tile(np.array([0.0, 0.0, 0.0, 1.0]), (body_count, 1))
        self._said_rate = np.zeros((body_count, 4))
        self._said_roots: dict[int, DetachedRoots] = {}
        self._active: tuple[int, ...] | None = None
        self._sizes = self._starts = self._order = np.zeros(0, np.int64)
        self._q = self._qd = np.zeros((0, 4))
        self._roots: list[DetachedRoots] = []

    def positions(self, active: tuple[int, ...], read: StateReader) -> np.ndarray:
        """Where these trees are [k, 3] m."""
        return self.middle[list(active)]

    def cells(self, active: tuple[int, ...]) -> list[Cell]:
        """Under which cells they are said [k]."""
        return [self.cell[tree] for tree in active]

    def prediction_error(
        self, active: tuple[int, ...], silence: np.ndarray, read: StateReader, cut: Callable[[int], DetachedRoots]
    ) -> tuple[np.ndarray, np.ndarray]:
        """How far off everybody's copies are by now [k] m and [k] rad; ``silence`` [k] s since the last record."""
        if self._active != active:
            self._active = active
            self._sizes = self.model.tree_size[list(active)].astype(np.int64)
            self._order = np.concatenate([np.arange(b.start, b.stop) for b in (self._bodies[tree] for tree in active)])
            self._starts = np.cumsum(self._sizes) - self._sizes
        state = [read(tree) for tree in active]
        self._q = np.concatenate([joint_q for joint_q, _ in state]).astype(np.float64)
        self._qd = np.concatenate([joint_qd for _, joint_qd in state]).astype(np.float64)
        self._roots = [cut(tree) for tree in active]
        bodies, horizon = self._order, dead_reckoning.clamp_age(silence)
        dt = np.repeat(horizon, self._sizes)[:, None]
        off = dead_reckoning.angle_between(
            self._q, dead_reckoning.extrapolate(self._said_q[bodies], self._said_rate[bodies], dt)
        )
        position = np.add.reduceat(off * self._reach[bodies], self._starts)
        for row, (tree, roots) in enumerate(zip(active, self._roots, strict=True)):
            if len(roots[0]):
                said = self._said_roots.get(tree, NO_ROOTS)
                if len(said[0]) != len(roots[0]):
                    position[row] = np.inf
                else:
                    there = said[1] + said[2] * np.atleast_1d(horizon)[row]
                    position[row] += np.linalg.norm(roots[1] - there, axis=1).max()
        return position, np.maximum.reduceat(off, self._starts)

    def encode(self, rows: list[int], said: ClaimColumns, time: float, cell: Cell) -> list[bytes]:
        """Messages about some rows of the trees that were last judged; from now on this is what was said."""
        assert self._active is not None
        here = [self._active[row] for row in rows]
        part: slice | np.ndarray = slice(None)
        if len(rows) < len(self._active):
            part = np.concatenate([np.arange(self._starts[r], self._starts[r] + self._sizes[r]) for r in rows])
        batch = TreeStates(time, np.array(here), *said.columns(), self._sizes[rows], self._q[part], self._qd[part])
        payloads, heard = messages.encode_trees(with_roots(batch, [self._roots[row] for row in rows]))
        self._remember(self._order[part], heard, heard.updates(""))
        return payloads

    def _remember(self, bodies: np.ndarray, heard: TreeStates, updates: Iterable[TreeUpdate]) -> None:
        self._said_q[bodies] = heard.joint_q
        self._said_rate[bodies] = dead_reckoning.quaternion_rate(heard.joint_q, heard.joint_qd)
        if len(heard.root):
            for update in updates:
                self._said_roots[update.tree] = update.root, update.root_x, update.root_xd

    def extrapolated(self, news: dict[int, tuple[TreeStates, str]], now: float, time: float) -> list[TreeUpdate]:
        """The last record of each tree, now; what was said is remembered for the next prediction."""
        found: dict[int, TreeUpdate] = {}
        for trees, sender in {id(batch[0]): batch for batch in news.values()}.values():
            rate = dead_reckoning.quaternion_rate(trees.joint_q, trees.joint_qd)
            age = float(dead_reckoning.clamp_age(time - trees.time))
            here = dataclasses.replace(trees, time=now)
            if age > 0.0 and not (trees.flags & messages.RESTING).any():
                here = dataclasses.replace(
                    here,
                    joint_q=dead_reckoning.extrapolate(trees.joint_q, rate, age),
                    root_x=trees.root_x + age * trees.root_xd,
                )
            first = 0
            for heard, update in zip(trees.updates(sender), here.updates(sender), strict=True):
                last = first + len(update.joint_q)
                if news.get(update.tree, (None,))[0] is trees:
                    found[update.tree] = update
                    bodies = self._bodies[update.tree]
                    self._said_q[bodies], self._said_rate[bodies] = trees.joint_q[first:last], rate[first:last]
                    self._said_roots[update.tree] = heard.root, heard.root_x, heard.root_xd
                first = last
        return [found[tree] for tree in sorted(found)]


class ObjectStream:
    """Boxes and loose bunches that move."""

    def __init__(self) -> None:
        self._said: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._heard: dict[int, ObjectUpdate] = {}
        self._cell: dict[int, Cell] = {}
        self._pose = self._velocity = np.zeros((0, 7))
        self._active: tuple[int, ...] = ()

    def cell(self, thing: int) -> Cell | None:
        """Under which cell a thing was last said."""
        return self._cell.get(thing)

    def position(self, thing: int) -> np.ndarray:
        """Where a thing was when it was last spoken of [3] m."""
        return self._said[thing][0][:3] if thing in self._said else np.zeros(3)

    def positions(self, active: tuple[int, ...], read: StateReader) -> np.ndarray:
        """Where these things are [k, 3] m."""
        self._active = active
        state = [read(thing) for thing in active]
        self._pose = np.array([pose for pose, _ in state], float)
        self._velocity = np.array([velocity for _, velocity in state], float)
        for thing, cell in zip(active, interest.cells_of(self._pose).tolist(), strict=True):
            self._cell[thing] = tuple(cell)
        return self._pose[:, :3]

    def cells(self, active: tuple[int, ...]) -> list[Cell]:
        """Under which cells they are said [k]."""
        return [self._cell[thing] for thing in active]

    def prediction_error(
        self, active: tuple[int, ...], silence: np.ndarray, read: StateReader, cut: Callable[[int], DetachedRoots]
    ) -> tuple[np.ndarray, np.ndarray]:
        """How far off everybody's copies are by now [k] m and [k] rad; ``silence`` [k] s since the last record."""
        nothing: tuple[np.ndarray, np.ndarray] = np.full(7, np.inf), np.zeros(6)
        said = [self._said.get(thing, nothing) for thing in active]
        pose, velocity = np.array([pose for pose, _ in said]), np.array([velocity for _, velocity in said])
        pose[:, 3:] = np.where(np.isfinite(pose[:, 3:]), pose[:, 3:], self._pose[:, 3:])
        there = _extrapolate_pose(pose, velocity, np.asarray(dead_reckoning.clamp_age(silence))[:, None])
        return np.linalg.norm(self._pose[:, :3] - there[:, :3], axis=1), dead_reckoning.angle_between(
            self._pose[:, 3:], there[:, 3:]
        )

    def encode(self, rows: list[int], said: ClaimColumns, time: float, cell: Cell) -> list[bytes]:
        """Messages about some rows of the things that were last judged; from now on this is what was said."""
        ids = np.array([self._active[row] for row in rows])
        batch = ObjectStates(time, ids, *said.columns(), self._pose[rows], self._velocity[rows])
        payloads, heard = messages.encode_objects(batch, cell)
        for thing, pose, velocity in zip(ids.tolist(), heard.pose, heard.velocity, strict=True):
            self._said[thing] = pose, velocity
        return payloads

    def receive(self, update: ObjectUpdate, cell: Cell) -> None:
        """Take a record that is to be believed; its time is the network's."""
        self._heard[update.object] = update
        self._said[update.object] = update.pose, update.velocity
        self._cell[update.object] = cell

    def remove(self, thing: int) -> None:
        """It rests, or its owner is gone."""
        self._heard.pop(thing, None)

    def extrapolated(self, theirs: set[int], now: float, time: float) -> list[ObjectUpdate]:
        """Everything that others move, where it is now; after 150 ms without a word it stands still."""
        heard = [self._heard[thing] for thing in sorted(self._heard.keys() & theirs)]
        if not heard:
            return []
        age = time - np.array([update.time for update in heard])[:, None]
        velocity = np.array([update.velocity for update in heard])
        poses = _extrapolate_pose(np.array([update.pose for update in heard]), velocity, dead_reckoning.clamp_age(age))
        going = velocity * (age <= dead_reckoning.MAX_EXTRAPOLATION)
        return [
            dataclasses.replace(update, time=now, pose=pose, velocity=rate)
            for update, pose, rate in zip(heard, poses, going, strict=True)
        ]


def with_roots(trees: TreeStates, roots: list[DetachedRoots]) -> TreeStates:
    """A batch of trees with what was cut off each."""
    if not any(len(numbers) for numbers, _, _ in roots):
        return trees
    counts = np.array([len(numbers) for numbers, _, _ in roots])
    body, x, xd = (np.concatenate(column) for column in zip(*roots, strict=True))
    return dataclasses.replace(trees, roots=counts, root=body, root_x=x, root_xd=xd)


def object_counts(model: Model) -> tuple[int, ...]:
    """How many things of each kind a vineyard has: trees, bunches, boxes."""
    return len(model.tree_first), len(model.bunch_body), len(model.box_mass)


def _extrapolate_pose(pose: np.ndarray, velocity: np.ndarray, dt: float | np.ndarray) -> np.ndarray:
    """Poses [..., 7] after ``dt`` s at velocities [..., 6]."""
    turned = dead_reckoning.extrapolate(
        pose[..., 3:], dead_reckoning.quaternion_rate(pose[..., 3:], velocity[..., 3:]), dt
    )
    return np.concatenate([pose[..., :3] + velocity[..., :3] * dt, turned], -1)


def _tree_centres(model: Model) -> np.ndarray:
    """Where each tree is [tree, 3] m: the mean of its settled bodies."""
    origins = model.forward_kinematics(model.joint_settled)[:, :3]
    middles = np.zeros((len(model.tree_first), 3))
    np.add.at(middles, model.body_tree, origins)
    return middles / np.maximum(model.tree_size, 1)[:, None]


def _lever_arms(model: Model) -> np.ndarray:
    """How far from each body's joint the wood it carries ends, along the longest way [body] m."""
    reach = model.body_length.astype(float).copy()
    for body in range(len(reach) - 1, -1, -1):
        parent = model.body_parent[body]
        if parent >= 0:
            reach[parent] = max(reach[parent], float(np.linalg.norm(model.body_offset[body])) + reach[body])
    return reach
