"""Who touches whom, and with what force: one contact solve a tick, shared by plants and rigid bodies.

Both sides say how fast they would move if the other were not there, and how an impulse changes that. The impulses
that keep them apart are then found for both at once, so they feel equal and opposite forces in the same tick. Solving
them in turn with penalty springs instead (a *staggered* scheme) blows up from 1e4 N/m on.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import numpy as np
import warp as wp

from vinesim import frames
from vinesim.kernels.contact import solver as kernels
from vinesim.kernels.launch import bind_launch
from vinesim.physics.contact.collision_geoms import PLANE_HALF_SIZE, RigidGeoms
from vinesim.physics.plants.articulation_solver import ArticulationSolver
from vinesim.physics.rigid.rigid_world import RigidWorld
from vinesim.physics.rigid.static_world import FRICTION
from vinesim.scene.model import Model
from vinesim.scene.values import Contact

CONTACT_STIFFNESS = 2e4
"""[N/m] of every contact, normal and (as the anchor of friction) tangential; its damping is 2 dt times this."""
MAX_SWEEPS = 100
"""Gauss-Seidel sweeps at most; warm-started and with leaps, up to six are usual."""
MAX_NEWTON_STEPS = 6
"""So many times an island is solved directly, as if its contacts stayed as they are, before sweeps go on alone."""
MAX_NEWTON_CONTACTS = 16
"""Islands of more contacts do not leap: it takes the cube of their number, sweeps take the square."""
IMPULSE_TOLERANCE = 1e-6
"""Of the largest impulse: a smaller change in a sweep ends them."""
MAX_CONTACTS_PER_TREE = 64
"""Contacts that one tree can have at once."""
MAX_STATIC_GEOMS_PER_TREE = 256
"""Standing things that can be close to one tree at once."""
REMOVED_GEOM = np.iinfo(np.int32).max
"""In place of a geom that is gone."""
BLOCK = int(kernels.BLOCK)
MIN_TREES_PER_THREAD = 16
"""Awake trees for each thread: fewer are not worth handing over."""
MIN_WAKING_SPEED = 1e-3
"""[m/s] A box or a loose bunch slower than this wakes nobody."""


@dataclasses.dataclass(frozen=True)
class PlantCapsules:
    """What of the plants can be touched: segments with a radius, sorted by body."""

    tree_start: np.ndarray
    """[tree + 1] first shape of each tree, then their number."""
    body: np.ndarray
    """[shape]"""
    bunch: np.ndarray
    """[shape] the bunch it belongs to, -1 for none. A peduncle goes with its bunch: what is left is in nobody's way."""
    level: np.ndarray
    """[shape] 0: always there; 1: while its tree is coarse; 2: while it is fine (see ``State.tree_fine``)."""
    start: np.ndarray
    """[shape, 3] m, in the body's frame; equal to ``end`` for a sphere."""
    end: np.ndarray
    radius: np.ndarray
    """[shape] m"""


def plant_capsules(model: Model) -> PlantCapsules:
    """A capsule for each piece of wood, a few spheres for each bunch, a capsule or sphere for each of its clusters.

    The spheres are the largest that fit a spheroid of the bunch's length and radius: a ball of radius
    R sqrt(1 - c^2 / (a^2 - R^2)) about each point c of the axis between its centres of curvature (a: half length).
    They stand for a bunch without clusters, and for one with clusters while its tree is coarse.
    """
    parts: list[tuple[int, int, int, float, float, float]] = []  # body, bunch, when, start and end along x, radius
    of_body = {int(b): i for i, b in enumerate(model.bunch_body)}
    of_cluster = {
        int(first) + k: i
        for i, (first, count) in enumerate(zip(model.bunch_cluster, model.bunch_clusters, strict=True))
        for k in range(count)
    }
    stalk_of = model.bunch_of_body().tolist()
    lengths, radii = model.body_length.tolist(), model.body_radius.mean(1).tolist()
    for b, (length, thick) in enumerate(zip(lengths, radii, strict=True)):
        if b in of_body:
            i = of_body[b]
            when = int(model.bunch_clusters[i] > 0)
            a, r = 0.5 * float(model.bunch_length[i]), float(model.bunch_radius[i])
            furthest = (a * a - r * r) / a if a > r else 0.0
            count = min(1 + 2 * int(np.ceil(furthest / r - 1e-6)), 7) if furthest > 1e-6 else 1
            for c in np.linspace(-furthest, furthest, count) if count > 1 else [0.0]:
                ball = min(a, r) * np.sqrt(1.0 - c * c / (a * a - r * r)) if count > 1 else min(a, r)
                parts.append((b, i, when, a + c, a + c, ball))
        elif b in of_cluster:
            half = 0.5 * length
            inset = min(thick, half)
            parts.append((b, of_cluster[b], 2, inset, length - inset, thick))
        else:
            parts.append((b, stalk_of[b], 0, 0.0, length, thick))
    body, bunch, when, start, end, radius = (np.array(column) for column in zip(*parts, strict=True))
    along = np.array([1.0, 0.0, 0.0], np.float32)
    return PlantCapsules(
        tree_start=np.searchsorted(body, np.append(model.tree_first, len(model.body_mass))).astype(np.int32),
        body=body.astype(np.int32),
        bunch=bunch.astype(np.int32),
        level=when.astype(np.int32),
        start=start.astype(np.float32)[:, None] * along,
        end=end.astype(np.float32)[:, None] * along,
        radius=radius.astype(np.float32),
    )


class ContactSolver:
    """Contacts between the plants and the rigid world of one tick.

    ``wake_near_trees()`` (before ``plants.predict()``) wakes whatever a rigid body comes near; ``solve()`` (after it) leaves
    ``bodies`` and ``wrenches`` for ``plants.integrate()`` and ``rigid_force`` for ``rigid.finish()``.

    Robots, boxes and loose bunches wake the trees that they come near. What stands (ground, poles, trunks) and other
    branches only hold back what moves already; what overlaps in the shape as drawn does so only beyond that.

    Args:
        capacity: contacts solved in one tick; of more, the deepest are kept, and ``dropped_contacts`` and ``overflow_message`` report it.
        stiffness: [N/m] see :data:`CONTACT_STIFFNESS`.
        branches: whether branches and bunches of awake trees touch each other too.
    """

    def __init__(
        self,
        model: Model,
        plants: ArticulationSolver,
        rigid: RigidWorld,
        *,
        capacity: int = 128,
        stiffness: float = CONTACT_STIFFNESS,
        plant_plant_contacts: bool = True,
    ) -> None:
        self.model, self.plants, self.rigid = model, plants, rigid
        self.dt, self.capacity = rigid.dt, capacity
        self.stiffness, self.damping = stiffness, 2.0 * stiffness * rigid.dt
        self.plant_plant_contacts = plant_plant_contacts
        self.capsules = plant_capsules(model)
        self.count = 0
        """Contacts of the last tick, those that do not press included."""
        self.bodies = np.zeros(0, np.int32)
        """Plant bodies in contact [n], sorted."""
        self.wrenches = np.zeros((0, 6))
        """[n, 6] N, N m on them, at their origins, world axes."""
        self.rigid_force: np.ndarray | None = None
        """[dof] generalised force of the same contacts on the rigid world; None without contact."""
        self.sweeps = self.islands = 0
        """Of the last solve: sweeps that its slowest island took; islands, which do not feel each other."""
        self.dropped_contacts = 0
        """Contacts left out since the start, for want of room."""
        self.overflow_message = ""
        """When contacts were last left out and how many: empty if never."""
        self.near_trees = np.zeros(0, np.int32)
        """Trees [k] whose box a robot or a moving box reaches into: these must not fall asleep."""
        self.remote_actors: set[str] = set()
        """Robots that another client controls. What they touch is that client's to compute: here they touch only trees
        of whose state it tells, so that a touch counts once and a copy in the distance disturbs nothing.
        """
        self.remote_trees = np.zeros(len(model.tree_first), np.bool_)
        """[tree] whose state another client tells."""
        self._generation = 0
        self._dof_names: list[tuple[str, int]] = []
        self._dof_free = self._dof_held = self._dof_held_before = np.zeros(0)
        self._awake = np.zeros(0, np.int32)
        self._allocate()
        self._renew()
        drawn = model.forward_kinematics(model.joint_settled)[self.capsules.body]
        for kept, end in ((self._start_drawn, self.capsules.start), (self._end_drawn, self.capsules.end)):
            kept[:] = drawn[:, :3] + frames.rotate(drawn[:, 3:], end.astype(float))
        self._bound(np.arange(len(model.tree_first), dtype=np.int32))
        self._bound_tree_blocks(np.arange(len(self._block_low), dtype=np.int32))

    # ------------------------------------------------------------------ the two halves of a tick

    def wake_near_trees(self) -> None:
        """Wake the trees that a robot or a moving box is about to reach; the rest cost one comparison each."""
        if self._generation != self.rigid.generation:
            self._renew()
        fallen_asleep = self._awake[~self.plants.state.tree_awake[self._awake]]
        if len(fallen_asleep):
            self._bound(fallen_asleep)
            self._bound_tree_blocks(np.unique(fallen_asleep // BLOCK))
        self._dof_held_before[:] = self._dof_held
        np.subtract(self.rigid.mj_data.qvel, self._dof_free, out=self._dof_held)
        self._dof_free[:] = self.rigid.velocity_free
        if self._standing_bound:
            self._bound_geoms(self._movable)
        else:
            self._bound_geoms(len(self._geoms.id))
            self._bound_standing()
        self._bound_actors(len(self._actor_lies))
        self._near[:] = False
        self._reach(len(self._block_low))
        self.near_trees = np.flatnonzero(self._near)
        if len(self.near_trees) and not self.plants.state.tree_awake[self.near_trees].all():
            self.plants.wake(self.near_trees)

    def solve(self) -> None:
        """Find the contacts of all awake trees and the forces that go with them."""
        self._awake = awake = self.plants.awake
        self.count, self.bodies, self.wrenches, self.rigid_force = 0, self.bodies[:0], self.wrenches[:0], None
        self._values: tuple[Contact, ...] | None = ()
        if len(awake) and len(self._geoms.id):
            self._meet(awake)
            self._brace(awake)
        if self.count:
            self._press()
        else:
            self._known_count[0] = 0

    # ------------------------------------------------------------------ what came of it

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """The contacts of the last tick that press, sorted by (tree, body, shape, other).

        What stands has the actor ``world`` (links ``ground``, ``fixed/7``), another branch the actor ``plants`` (links
        ``body/42``).
        """
        if self._values is None:
            n = self.count
            force, push = self._force[:n], self._impulse[0 : 3 * n : 3]
            self._values = tuple(
                Contact(
                    *self._actor_and_link(other), int(self._contact_body[c]), self._point[c].copy(), -force[c],
                    float(self._gap[c]),
                )
                for c, other in enumerate(self._other[:n].tolist())
                if push[c] > 0.0
            )  # fmt: skip
        return self._values

    @property
    def touched_trees(self) -> tuple[tuple[int, str], ...]:
        """(tree, actor) for every tree that somebody presses on in the last tick, sorted."""
        return tuple(sorted({(int(self.model.body_tree[c.body]), c.actor) for c in self.contacts}))

    def nearest_body(self, points: np.ndarray, reach: float) -> tuple[float, int] | None:
        """What of the plants is nearest to one of some ``points`` [k, 3]: distance [m] to its surface, and its body.

        Of a bunch the bunch's own body, whether or not its clusters move. None if nothing is below ``reach``.
        """
        low, high = points.min(0) - reach, points.max(0) + reach
        trees = np.flatnonzero(((self._tree_low <= high) & (low <= self._tree_high)).all(1))
        if len(trees) == 0:
            return None
        self.plants.forward_kinematics(trees)
        s, state, model = self.capsules, self.plants.state, self.model
        at = np.concatenate([np.arange(s.tree_start[tree], s.tree_start[tree + 1]) for tree in trees])
        fine = state.tree_fine[model.body_tree[s.body[at]]]
        at = at[(s.level[at] == 0) | (s.level[at] == 1 + fine)]
        there = s.bunch[at] < 0
        there[~there] = state.bunch_attached[s.bunch[at[~there]]]
        at = at[there]
        pose = state.body_q[s.body[at]].astype(float)
        start = pose[:, :3] + frames.rotate(pose[:, 3:], s.start[at].astype(float))
        along = frames.rotate(pose[:, 3:], (s.end[at] - s.start[at]).astype(float))
        square = np.maximum((along * along).sum(1), 1e-12)
        apart = points[:, None] - start
        share = np.clip((apart * along).sum(-1) / square, 0.0, 1.0)
        gap = (np.linalg.norm(apart - share[..., None] * along, axis=-1) - s.radius[at]).min(0)
        best = int(np.argmin(gap)) if len(gap) else -1
        if best < 0 or gap[best] >= reach:
            return None
        body, bunch = int(s.body[at[best]]), int(s.bunch[at[best]])
        tree = model.body_tree[body]
        clustered = body - model.tree_first[tree] >= model.tree_core[tree]
        return float(gap[best]), int(model.bunch_body[bunch]) if clustered else body

    def _actor_and_link(self, other: int) -> tuple[str, str]:
        """Actor and link of what a plant touches."""
        if other < 0:
            return "plants", f"body/{self.capsules.body[-1 - other]}"
        return self._actor[other], self._link[other]

    # ------------------------------------------------------------------ who is close

    def update_tree_bounds(self, trees: np.ndarray) -> None:
        """Trees [k] were put elsewhere while they slept."""
        self._bound(trees)
        self._bound_tree_blocks(np.unique(trees // BLOCK))

    def _bound(self, trees: np.ndarray) -> None:
        """Bring the boxes around some trees up to their bodies."""
        self._trees[: len(trees)] = trees
        self._deal(len(trees), self._bound_trees)

    def _deal(self, count: int, *launches: Callable[..., None]) -> None:
        """Launch over so many trees of the list, for each one launch after the other; threads take turns in it."""
        crew = self.plants.thread_pool
        threads = 1 if crew is None or count < MIN_TREES_PER_THREAD * crew.size else crew.size
        if self._dealt != (count, threads):
            self._dealt = (count, threads)
            self._every[:count] = np.concatenate([np.arange(i, count, threads) for i in range(threads)])
        if threads == 1:
            for launch in launches:
                launch(count)
            return
        share = [len(range(i, count, threads)) for i in range(threads)]
        first = [sum(share[:i]) for i in range(threads)]
        crew.run([partial(_all, launches, share[i], first[i], i) for i in range(threads)])

    def _bound_tree_blocks(self, blocks: np.ndarray) -> None:
        """Bring the boxes around some blocks of trees up to their trees."""
        self._blocks[: len(blocks)] = blocks
        self._bound_blocks(len(blocks))

    def _bound_standing(self) -> None:
        """Boxes around blocks of what stands; the ground goes down for ever."""
        first = self._movable
        deep = np.flatnonzero(self._geoms.kind[first:] == 0) + first
        self._geom_low[deep, 2] = -PLANE_HALF_SIZE
        for block in range(len(self._standing_low)):
            of = slice(first + BLOCK * block, first + BLOCK * (block + 1))
            self._standing_low[block], self._standing_high[block] = (
                self._geom_low[of].min(0),
                self._geom_high[of].max(0),
            )
        self._standing_bound = True

    def _meet(self, awake: np.ndarray) -> None:
        """List the contacts of the awake trees."""
        trees = len(awake)
        if trees > self._room:
            self._make_room(2 * trees)
        self._trees[:trees] = awake
        self._tally[kernels.TREES] = trees
        self._deal(trees, self._bound_trees, self._meeting)
        if self.plant_plant_contacts:
            low = self._tree_low[awake]
            axis = self._tally[kernels.AXIS] = int(np.argmax(low.max(0) - low.min(0)))
            self._order[:trees] = np.argsort(low[:, axis], kind="stable")
            self._deal(trees, self._meeting_branches)
        self._gathering(1)
        count, missed = int(self._tally[kernels.HITS]), int(self._tally[kernels.MISSED])
        if count > self.capacity:
            missed += count - self.capacity
            hits = np.flatnonzero(self._slot < self._found[:trees, None])
            deepest = np.argsort(self._hit_gap.ravel()[hits], kind="stable")[: self.capacity]
            self._hits[:] = np.sort(hits[deepest])
            self._tally[kernels.HITS] = count = self.capacity
        if missed:
            self.dropped_contacts += missed
            self.overflow_message = (
                f"{missed} of {count + missed} contacts of one tick were left out, the shallowest; there is room "
                f"for {self.capacity}, and for {MAX_CONTACTS_PER_TREE} at one tree: raise ContactSolver's capacity or touch less at once"
            )
        self.count = count

    def _brace(self, awake: np.ndarray) -> None:
        """Step trees that are about to take a blow with phi = 1 from this tick on.

        The trapezoidal rule moves a body by the mean of its velocities before and after: what is hit from rest would
        give way only half as far as it must, overlap, and be thrown out again.
        """
        if self._tally[kernels.STRUCK]:
            struck = awake[self._onset[: len(awake)]]
            if (self.plants.phi_used[struck] < 1.0).any():
                self.plants.use_backward_euler(struck)
                self.plants.predict()

    # ------------------------------------------------------------------ with what force

    def _press(self) -> None:
        """Impulses of all contacts at once, and what they do to either side."""
        n, rows = self.count, 3 * self.count
        self._group[:] = self.rigid.islands
        self._indexing(1)
        touched, islands = int(self._tally[kernels.BODIES]), int(self._tally[kernels.ISLANDS])
        self.bodies = bodies = self._bodies[:touched].copy()
        rigid_rows, rigid_answer = self._rigid_rows[:rows], self._rigid_answer[:rows]
        rigid_rows[:] = 0.0
        rigid_answer[:] = 0.0
        self._coupling(n)

        self._y[:touched, :, :touched] = self.plants.impulse_response(bodies)
        bound = self._tally[kernels.BOUND] = self.rigid.is_constrained(self._geoms.body[self._other[:n].clip(0)])
        self._answering(rows)
        if bound:
            rigid_answer[:] = self.rigid.impulse_response(rigid_rows).T
        self._assembling(rows)
        self._relaxing(islands)
        self.sweeps = int(self._sweeps[:islands].max())
        self.islands = islands

        self._known_count[0] = n
        self._remembering(n)
        self._adding(touched)
        self.wrenches = self._wrench[:touched].copy()
        self.rigid_force = self._impulse[:rows] @ rigid_rows / -self.dt
        self._values = None

    # ------------------------------------------------------------------ memory and launches

    def _allocate(self) -> None:
        """Everything whose size does not depend on who is here."""
        n, trees, shapes = self.capacity, len(self.model.tree_first), len(self.capsules.body)
        self._trees = np.zeros(trees, np.int32)
        self._tree_low, self._tree_high = np.zeros((trees, 3), np.float32), np.zeros((trees, 3), np.float32)
        self._every, self._dealt = np.zeros(trees, np.int32), (0, 0)
        self._near = np.zeros(trees, np.bool_)
        for name in ("start", "end", "shape_low", "shape_high"):
            setattr(self, "_" + name, np.zeros((shapes, 3), np.float32))
        self._wood_low, self._wood_high = np.zeros((trees, 3), np.float32), np.zeros((trees, 3), np.float32)
        ends = np.maximum(np.linalg.norm(self.capsules.start, axis=1), np.linalg.norm(self.capsules.end, axis=1))
        self._reach_of_shape = (ends + self.capsules.radius).astype(np.float32)
        self._last_bunch = np.full(trees, -1, np.int32)
        np.maximum.at(self._last_bunch, self.model.body_tree[self.capsules.body], self.capsules.bunch)
        self._shape_speed = np.zeros(shapes, np.float32)
        for name in ("start_drawn", "end_drawn"):
            setattr(self, "_" + name, np.zeros((shapes, 3), np.float32))
        blocks = -(-trees // BLOCK)
        self._blocks = np.zeros(blocks, np.int32)
        self._block_low, self._block_high = np.zeros((blocks, 3), np.float32), np.zeros((blocks, 3), np.float32)
        self._order, self._tally = np.zeros(trees, np.int32), np.zeros(8, np.int32)
        for name in ("hits", "contact_shape", "contact_body", "place", "other", "other_body", "other_place", "island",
                     "known_shape", "known_other"):  # fmt: skip
            setattr(self, "_" + name, np.zeros(n, np.int32))
        for name in ("gap", "friction", "known_push"):
            setattr(self, "_" + name, np.zeros(n))
        for name in ("point", "known_rub", "known_anchor", "force"):
            setattr(self, "_" + name, np.zeros((n, 3)))
        for name in ("free", "offset", "impulse"):
            setattr(self, "_" + name, np.zeros(3 * n))
        self._axes = np.zeros((n, 3, 3))
        self._bodies, self._wrench = np.zeros(2 * n + 1, np.int32), np.zeros((2 * n, 6))
        self._plant_rows, self._A = np.zeros((3 * n, 12)), np.zeros((3 * n, 3 * n))
        self._y, self._plant_answer = np.zeros((2 * n, 6, 2 * n, 6), np.float32), np.zeros((3 * n, 12 * n))
        self._island_first, self._island_member = np.zeros(n + 1, np.int32), np.zeros(n, np.int32)
        self._sweeps, self._rows = np.zeros(n, np.int32), np.zeros((3 * n, 3 * n + 2))
        self._known_count = np.zeros(1, np.int32)
        self._values = ()
        self._room = 0
        self._geoms = None

    def _make_room(self, trees: int) -> None:
        """Room for the contacts of so many awake trees."""
        self._room = trees
        self._close = np.zeros((trees, min(len(self._geoms.id), self._movable + MAX_STATIC_GEOMS_PER_TREE)), np.int32)
        self._found, self._slot = np.zeros(trees, np.int32), np.arange(MAX_CONTACTS_PER_TREE)
        self._hit_shape, self._hit_other = (
            np.zeros((trees, MAX_CONTACTS_PER_TREE), np.int32),
            np.zeros((trees, MAX_CONTACTS_PER_TREE), np.int32),
        )
        self._onset = np.zeros(trees, np.bool_)
        self._hit_gap, self._hit_room = (
            np.zeros((trees, MAX_CONTACTS_PER_TREE)),
            np.zeros((trees, MAX_CONTACTS_PER_TREE)),
        )
        self._hit_normal, self._hit_point = (
            np.zeros((trees, MAX_CONTACTS_PER_TREE, 3)),
            np.zeros((trees, MAX_CONTACTS_PER_TREE, 3)),
        )
        self._record()

    def _renew(self) -> None:
        """Take over the rigid world after an actor came or went; contacts remember by the names of the geoms."""
        old = None if self._geoms is None else self._names
        move, stand, d = self.rigid.geoms, self.rigid.static_geoms, self.rigid.mj_data
        both = {f.name: (getattr(move, f.name), getattr(stand, f.name)) for f in dataclasses.fields(move)}
        g = self._geoms = RigidGeoms(
            **{k: a + b if isinstance(a, tuple) else np.concatenate([a, b]) for k, (a, b) in both.items()}
        )
        self._actor, self._link = g.actor, g.link
        self._movable, self._standing_bound = len(move.id), False
        blocks = -(-len(stand.id) // BLOCK)
        self._standing_low, self._standing_high = (np.zeros((blocks, 3), np.float32) for _ in range(2))
        self._generation = self.rigid.generation
        self._names = _names(g)
        if old is not None:
            at = {name: i for i, name in enumerate(self._names)}
            for k, other in enumerate(self._known_other[: self._known_count[0]].tolist()):
                if other >= 0:
                    self._known_other[k] = at.get(old[other], REMOVED_GEOM)
        count = len(g.id)
        self._geom_middle, self._geom_velocity = np.zeros((count, 3)), np.zeros((count, 3))
        self._geom_spin, self._geom_speed = np.zeros((count, 3)), np.zeros(count)
        self._geom_low, self._geom_high = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
        self._rigid_rows, self._rigid_answer = (np.zeros((3 * self.capacity, self.rigid.mj_model.nv)) for _ in range(2))
        at = {name: i for i, name in enumerate(self._dof_names)}
        self._dof_names = self.rigid.dof_names
        same = np.array([at.get(name, -1) for name in self._dof_names], int)
        free, held, held_before = self._dof_free, self._dof_held, self._dof_held_before
        self._dof_free = self.rigid.velocity_free
        self._dof_held, self._dof_held_before = np.zeros(len(same)), np.zeros(len(same))
        self._dof_free[same >= 0] = free[same[same >= 0]]
        self._dof_held[same >= 0] = held[same[same >= 0]]
        self._dof_held_before[same >= 0] = held_before[same[same >= 0]]
        self._group = np.zeros(self.rigid.mj_model.ntree, np.int32)
        self._dof_parent = self.rigid.mj_model.dof_parentid
        self._mujoco = {"xpos": d.geom_xpos, "xmat": d.geom_xmat, "cvel": d.cvel, "cdof": d.cdof, "com": d.subtree_com}
        m = self.rigid.mj_model
        self._mujoco["sparse"] = (
            m.dof_treeid, m.tree_dofadr, m.tree_dofnum, m.M_rowadr, m.M_rownnz, m.M_colind
        )  # fmt: skip
        self._mujoco["factors"] = (d.qH, d.qHDiagInv, d.qLD, d.qLDiagInv)
        first = [i for i in range(self._movable) if i == 0 or g.actor[i] != g.actor[i - 1]]
        self._actor_first = np.array([*first, self._movable], np.int32)
        self._actor_copy = np.array([g.actor[i] in self.remote_actors for i in first], np.bool_)
        self._geom_copy = np.array([actor in self.remote_actors for actor in g.actor], np.bool_)
        self._actor_lies = np.array([g.actor[i] not in self.rigid.actors for i in first], np.bool_)
        self._actor_low, self._actor_high = np.zeros((len(first), 3), np.float32), np.zeros((len(first), 3), np.float32)
        self._make_room(max(self._room, 64))

    def _record(self) -> None:
        """Bind every kernel to its arrays once: a recorded launch costs a fifth of a plain one."""
        s, g, state, mj = self.capsules, self._geoms, self.plants.state, self._mujoco

        def shared(data: np.ndarray, dtype: type) -> wp.array:
            array = wp.array(data, dtype=dtype, device="cpu", copy=False)
            if data.size and array.ptr != data.ctypes.data:
                raise ValueError(f"an array of {data.shape} {data.dtype} is not contiguous: Warp would work on a copy")
            return array

        def ints(*names: str) -> list[wp.array]:
            return [shared(getattr(self, "_" + name), wp.int32) for name in names]

        def doubles(*names: str) -> list[wp.array]:
            return [shared(getattr(self, "_" + name), wp.float64) for name in names]

        def vectors(*names: str) -> list[wp.array]:
            return [shared(getattr(self, "_" + name), wp.vec3d) for name in names]

        g_id, g_body, g_root = (shared(x, wp.int32) for x in (g.id, g.body, g.root))
        g_kind, g_dof = shared(g.kind, wp.int32), shared(g.dof, wp.int32)
        g_center, g_half, g_size = (shared(x, wp.vec3d) for x in (g.center, g.half, g.size))
        g_radius, g_friction = shared(g.radius, wp.float64), shared(g.friction, wp.float64)
        g_box = [shared(x, wp.vec3) for x in (self._geom_low, self._geom_high)]
        t_box = [shared(x, wp.vec3) for x in (self._tree_low, self._tree_high)]
        a_box = [shared(x, wp.vec3) for x in (self._actor_low, self._actor_high)]
        a_first, a_lies = shared(self._actor_first, wp.int32), shared(self._actor_lies, wp.bool)
        s_tree, s_body, s_bunch, s_when = (shared(x, wp.int32) for x in (s.tree_start, s.body, s.bunch, s.level))
        s_drawn = [shared(x, wp.vec3) for x in (self._start_drawn, self._end_drawn)]
        fine, cut = shared(state.tree_fine, wp.bool), shared(state.body_cut, wp.bool)
        blocks = [shared(x, wp.vec3) for x in (self._block_low, self._block_high)]
        standing = [shared(x, wp.vec3) for x in (self._standing_low, self._standing_high)]
        s_radius, s_speed = shared(s.radius, float), shared(self._shape_speed, float)
        s_at = [shared(x, wp.vec3) for x in (self._start, self._end)]
        s_box = [shared(x, wp.vec3) for x in (self._shape_low, self._shape_high)]
        w_box = [shared(x, wp.vec3) for x in (self._wood_low, self._wood_high)]
        m_parent, m_tree = (shared(x, wp.int32) for x in (self.model.body_parent, self.model.body_tree))
        d_parent = shared(self._dof_parent, wp.int32)
        xpos, com = shared(mj["xpos"], wp.vec3d), shared(mj["com"], wp.vec3d)
        xmat = shared(mj["xmat"].reshape(-1, 3, 3), wp.mat33d)
        cvel, cdof = shared(mj["cvel"], wp.float64), shared(mj["cdof"], wp.float64)
        body_q, body_qd = shared(state.body_q, wp.transform), shared(state.body_qd, wp.spatial_vector)
        body_qd_free = shared(self.plants.velocity_free, wp.spatial_vector)
        attached = shared(state.bunch_attached, wp.bool)
        moving, speed = vectors("geom_middle", "geom_velocity", "geom_spin"), doubles("geom_speed")[0]
        dt, k, c = self.dt, self.stiffness, self.damping
        softness = 1.0 / (dt * (k * dt + c))
        dealt = {"index_list": "every", "partitions": self.plants.threads}

        self._bound_geoms = bind_launch(
            kernels.bound_geoms,
            [dt, g_id, g_body, g_root, g_center, g_half, g_dof, d_parent, xpos, xmat, cvel, cdof,
             *doubles("dof_free", "dof_held", "dof_held_before"), com],
            [*moving, speed, *g_box],
        )  # fmt: skip
        self._bound_actors = bind_launch(
            kernels.bound_actors, [MIN_WAKING_SPEED, a_first, a_lies, speed, *g_box], a_box
        )
        self._bound_trees = bind_launch(
            kernels.bound_trees,
            [dt, s_tree, s_body, s_bunch, s_when, shared(s.start, wp.vec3), shared(s.end, wp.vec3), s_radius,
             shared(self._reach_of_shape, float), *ints("every", "trees"), body_q, body_qd, fine],
            [*s_at, s_speed, *s_box, *w_box, *t_box],
            **dealt,
        )  # fmt: skip
        told = shared(self.remote_trees, wp.bool)
        a_copy, g_copy = shared(self._actor_copy, wp.bool), shared(self._geom_copy, wp.bool)
        self._reach = bind_launch(
            kernels.reach, [a_first, a_copy, told, *blocks, *t_box, *a_box, *g_box], [shared(self._near, wp.bool)]
        )
        self._bound_blocks = bind_launch(kernels.bound_blocks, [*ints("blocks"), *t_box], blocks)
        hit = [shared(x, wp.int32) for x in (self._hit_shape, self._hit_other)]
        hit += [
            shared(self._hit_gap, wp.float64),
            shared(self._hit_room, wp.float64),
            shared(self._hit_normal, wp.vec3d),
            shared(self._hit_point, wp.vec3d),
        ]
        onset, now = shared(self._onset, wp.bool), [body_q, body_qd, body_qd_free, *s_at, cut, s_speed, *s_box]
        self._meeting = bind_launch(
            kernels.meet,
            [dt, MAX_CONTACTS_PER_TREE, self._movable, m_parent, s_tree, s_body, s_bunch, s_when, s_radius, *s_drawn, g_id, g_kind,
             g_size, g_radius, g_copy, *ints("every"), told, fine, attached, *ints("trees"), *t_box, *now, xmat,
             *moving, speed, *g_box, *standing],
            [*ints("close", "found"), *hit, onset],
            **dealt,
        )  # fmt: skip
        self._meeting_branches = bind_launch(
            kernels.meet_branches,
            [dt, MAX_CONTACTS_PER_TREE, m_parent, s_tree, s_body, s_bunch, s_when, s_radius, *s_drawn, *ints("last_bunch", "every"),
             fine, attached, *ints("order", "tally", "trees"), *t_box, *w_box, *now],
            [*ints("found"), *hit, onset],
            **dealt,
        )  # fmt: skip
        flat = [x.flatten() for x in hit]
        known = [*ints("known_shape", "known_other"), *doubles("known_push"), *vectors("known_rub", "known_anchor")]
        axes, sparse = shared(self._axes, wp.mat33d), [shared(x, wp.int32) for x in mj["sparse"]]
        self._gathering = bind_launch(
            kernels.gather, [MAX_CONTACTS_PER_TREE, *ints("found"), onset], ints("hits", "tally")
        )
        self._indexing = bind_launch(
            kernels.index,
            [s_body, m_tree, g_dof, sparse[0], *ints("hits"), *flat[:2], *ints("group")],
            ints("tally", "bodies", "contact_shape", "contact_body", "place", "other_body", "other_place", "island",
                 "island_first", "island_member"),
        )  # fmt: skip
        self._coupling = bind_launch(
            kernels.couple,
            [dt, k, c, FRICTION, g_friction, g_dof, g_root, d_parent, *ints("hits"),
             *flat[1:], *ints("contact_shape", "contact_body", "other_body"), body_q,
             body_qd_free, *doubles("dof_free"), cdof, com, *ints("known_count"), *known],
            [*ints("other"), *doubles("gap", "friction"), *vectors("point"), axes,
             *doubles("plant_rows", "rigid_rows", "free", "offset", "impulse")],
        )  # fmt: skip
        pairs, rows = ints("other", "place", "other_place"), doubles("plant_rows", "rigid_rows")
        answers, y = doubles("plant_answer", "rigid_answer"), shared(self._y, float).reshape((12 * self.capacity, -1))
        blocks = ints("island", "island_first", "island_member")
        self._answering = bind_launch(
            kernels.answer,
            [*sparse[:3], g_dof, *sparse[3:], m_tree, *ints("bodies", "tally"), *pairs, *rows, y,
             *(shared(x, wp.float64) for x in mj["factors"])],
            answers,
        )  # fmt: skip
        self._assembling = bind_launch(
            kernels.assemble, [g_dof, d_parent, *blocks, *pairs, *rows, *answers], doubles("A")
        )
        self._adding = bind_launch(
            kernels.add_up, [dt, *ints("tally"), *pairs, rows[0], *doubles("impulse")], doubles("wrench")
        )
        self._relaxing = bind_launch(
            kernels.relax,
            [softness, MAX_SWEEPS, MAX_NEWTON_STEPS, MAX_NEWTON_CONTACTS, IMPULSE_TOLERANCE, *blocks[1:],
             *doubles("friction", "A", "free", "offset")],
            [*doubles("rows", "impulse"), *ints("sweeps")],
        )  # fmt: skip
        self._remembering = bind_launch(
            kernels.remember,
            [dt, k, c, *blocks, *ints("contact_shape", "other"), axes, *doubles("A", "free", "impulse")],
            [*vectors("force"), *known],
        )  # fmt: skip


def _all(launches: tuple[Callable[..., None], ...], count: int, first: int, share: int) -> None:
    """One thread's share of several launches."""
    for launch in launches:
        launch(count, first, share)


def _names(geoms) -> list[tuple[str, str, int]]:
    """A name for each geom that outlives recompilation: actor, link and its number on that link."""
    seen: dict[tuple[str, str], int] = {}
    names = []
    for actor, link in zip(geoms.actor, geoms.link, strict=True):
        number = seen[actor, link] = seen.get((actor, link), -1) + 1
        names.append((actor, link, number))
    return names
