"""What boxes and loose bunches ride on, and whether they move against it.

Everything loose has a *parent*: the ground, the box it lies in, or the link of a robot that carries or grips it. What
has been still in its parent's frame for half a second is at rest, wherever the parent goes: a bunch in a box, a box on
a robot. It stays at rest until it has moved by more than a band; then its parent is looked for anew, among what it
touches: the ground before all others, for what is pushed along it does not ride on whoever pushes. People's hands
are no parents: their copies elsewhere are not exact enough.
"""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim import frames
from vinesim.physics.rigid.human_body import wake_body
from vinesim.physics.rigid.rigid_world import RigidWorld
from vinesim.scene.ids import Kind, thing, thing_named

STILL = 0.005, float(np.radians(1.0))
"""[m] and [rad] What moves and turns less than this in its parent's frame is still."""
CARRIED = 0.015, float(np.radians(5.0))
"""The same on a robot's link: what it carries is shaken, and need not be told of while it stays about there."""
SHAKEN = 0.05, float(np.radians(30.0))
"""The same in a box that moves, where bunches rock and roll; when the box has come to rest, :data:`STILL` counts."""
JERK = 0.01
"""[m/s] A box that is as fast moves already, before it has left its band."""
PATIENCE = 50
"""[tick] So long must a thing be still to be at rest."""
FAR = 0.5
"""[m] A copy that is farther than this from where it should be is put there at once."""

GROUND = ""
"""Name of the ground as a parent; boxes are ``box/3``, links ``actor/link``."""

_STANDS, _BOX, _LINK, _BUNCH, _PERSON = range(5)
_NONE = -1


class SupportTracker:
    """Boxes and loose bunches as the network sees them: poses, velocities, parents and rest."""

    def __init__(self, rigid: RigidWorld) -> None:
        self.rigid = rigid
        self.object_ids = np.zeros(0, np.int64)
        """[n] :func:`vinesim.scene.ids.thing`: boxes, then loose bunches."""
        self._generation = -1
        self._parent = np.zeros(0, np.int64)
        self._anchor = np.zeros((0, 7))
        self._still = self._calm = np.zeros(0, np.int64)
        self._at: dict[int, int] = {}
        self._pairs = np.zeros((0, 2), np.int64)
        self._bands_before = np.zeros((0, 2))
        self._touched: list[tuple[int, str]] | None = None
        self._renew()

    # ------------------------------------------------------------------ the tick

    def update(self) -> None:
        """After a tick: who is still, who is not, and on what."""
        self._keep_up()
        d = self.rigid.mj_data
        self._still += 1
        speed = d.qvel[self._v[:, None] + np.arange(3)]
        self._calm = np.where((speed * speed).sum(1) > JERK * JERK, 0, self._calm + 1)
        self._pairs, self._touched = self._touching(), None
        bands, before = self._bands(), self._bands_before
        self._bands_before = bands
        # what fell asleep in a box that moved is judged when the box has come to rest
        awake = np.flatnonzero((d.tree_asleep[self._tree] < 0) | (bands[:, 0] < before[:, 0]))
        if len(awake) == 0:
            return
        if (self._kind[self._parent[awake]] == _LINK).any():
            self.rigid.update_kinematics()
        pose = self._poses(awake)
        relative = self._relative(pose, self._parent[awake])
        out = _apart(relative, self._anchor[awake], bands[awake])
        loose = awake[out | (self._still[awake] < PATIENCE)]
        if len(loose) == 0:
            return
        parent = self._parent[loose].copy()
        inside = np.zeros(len(self.object_ids), bool)
        inside[awake] = ~out
        self._parent[loose] = self._supports(loose, inside)
        changed = loose[self._parent[loose] != parent]
        anew = np.union1d(awake[out], changed)
        if len(anew):
            self.rigid.update_kinematics()
            self._anchor[anew] = self._relative(self._poses(anew), self._parent[anew])
            self._still[anew] = 0

    @property
    def moving(self) -> list[int]:
        """Things that are not at rest in their parent's frame."""
        self._keep_up()
        return self.object_ids[self._still < PATIENCE].tolist()

    @property
    def touched(self) -> list[tuple[int, str]]:
        """(thing, actor) for everything that moves and is touched: by robots, people, boxes (``box/3``) or bunches."""
        self._keep_up()
        if self._touched is None:
            self._touched = self._list_touched()
        return self._touched

    def objects_moved_by(self, actor: str) -> set[int]:
        """Things that move and that an actor touches, itself or through others that it touches: boxes, bunches."""
        self._keep_up()
        moves = self._still < PATIENCE
        if not moves.any():
            return set()
        bodies = [body for body, (owner, _) in self.rigid.owners.items() if owner == actor]
        row, other = self._pairs.T
        touched = np.zeros(len(self.object_ids), bool)
        touched[row[np.isin(other, bodies)]] = True
        for hand in self.rigid.human(actor).hands if actor in self.rigid.humans else ():
            held = None if hand.held is None else thing_named(hand.held[0])
            if held in self._at:
                touched[self._at[held]] = True
        on = self._row[other]
        while True:
            more = row[(on >= 0) & touched[on] & ~touched[row]]
            if not len(more):
                return set(self.object_ids[touched & moves].tolist())
            touched[more] = True

    def _list_touched(self) -> list[tuple[int, str]]:
        found = set()
        for row, body in self._pairs[self._still[self._pairs[:, 0]] < PATIENCE].tolist():
            owner = self.rigid.owners.get(body)
            if owner is not None:
                found.add((int(self.object_ids[row]), owner[0]))
        for name in self.rigid.humans:
            for hand in self.rigid.human(name).hands:
                held = None if hand.held is None else thing_named(hand.held[0])
                if held in self._at and self._still[self._at[held]] < PATIENCE:
                    found.add((held, name))
        return sorted(found)

    # ------------------------------------------------------------------ one thing

    def __contains__(self, thing: int) -> bool:
        self._keep_up()
        return thing in self._at

    def object_state(self, thing: int) -> tuple[np.ndarray, np.ndarray]:
        """Pose [7] and velocity [6] (of its origin, angular; world axes)."""
        row, d = self._row_of(thing), self.rigid.mj_data
        pose = self._poses(np.array([row]))[0]
        v = d.qvel[self._v[row] : self._v[row] + 6]
        return pose, np.concatenate([v[:3], frames.rotate(pose[3:], v[3:])])

    def pose_on_support(self, thing: int) -> tuple[str, np.ndarray]:
        """Its parent, and its pose [7] in that frame."""
        row = self._row_of(thing)
        self.rigid.update_kinematics()
        at = np.array([row])
        return self._name(int(self._parent[row])), self._relative(self._poses(at), self._parent[at])[0]

    def support_state(self, parent: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Pose [7] and velocity [6] of a parent; None if it is not here."""
        if parent == GROUND:
            return frames.pose([0.0, 0.0, 0.0]), np.zeros(6)
        self._keep_up()
        box = thing_named(parent)
        if box is not None:
            return self.object_state(box) if box in self._at else None
        body = self._body_named.get(parent)
        if body is None:
            return None
        m, d = self.rigid.mj_model, self.rigid.mj_data
        self.rigid.update_kinematics()
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
        pose = np.concatenate([d.xpos[body], frames.from_wxyz(d.xquat[body])])
        return pose, np.concatenate([twist[3:], twist[:3]])

    def to_world(self, parent: str, relative: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """World poses [..., 7] and velocities [..., 6] of what is still in a parent's frame; None if that is gone."""
        frame = self.support_state(parent)
        if frame is None:
            return None
        pose = frames.compose(frame[0], relative)
        velocity = np.broadcast_to(frame[1], (*pose.shape[:-1], 6)).copy()
        velocity[..., :3] += frames.cross(velocity[..., 3:], pose[..., :3] - frame[0][:3])
        return pose, velocity

    def set_state(self, thing: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Put one thing somewhere: pose [7], velocity [6] in world axes."""
        self.set_states([thing], np.asarray(pose, float)[None], np.asarray(velocity, float)[None])

    def set_states(self, things: list[int], pose: np.ndarray, velocity: np.ndarray) -> None:
        """Put things [k] somewhere: poses [k, 7], velocities [k, 6] in world axes."""
        rows, d = np.array([self._row_of(thing) for thing in things]), self.rigid.mj_data
        turn = frames.normalize(pose[:, 3:])
        d.qpos[self._q[rows][:, None] + np.arange(7)] = np.concatenate([pose[:, :3], frames.to_wxyz(turn)], -1)
        spin = frames.rotate(frames.conjugate(turn), velocity[:, 3:])
        d.qvel[self._v[rows][:, None] + np.arange(6)] = np.concatenate([velocity[:, :3], spin], -1)
        for body in self._body[rows].tolist():
            wake_body(self.rigid.mj_model, d, body)
        self.rigid.invalidate_kinematics()

    def blend_towards(self, things: list[int], pose: np.ndarray, velocity: np.ndarray, blend: np.ndarray) -> None:
        """Move things [k] by ``blend`` [k] of the way towards poses [k, 7]; as fast as ``velocity`` [k, 6] at once."""
        here = self._poses(np.array([self._row_of(thing) for thing in things]))
        far = np.linalg.norm(pose[:, :3] - here[:, :3], axis=1) > FAR
        there = pose.copy()
        there[(here[:, 3:] * pose[:, 3:]).sum(1) < 0.0, 3:] *= -1.0
        self.set_states(things, here + np.where(far, 1.0, blend)[:, None] * (there - here), velocity)

    def set_at_rest(self, thing: int, parent: str, relative: np.ndarray) -> None:
        """Take it for at rest in a parent's frame, as others say it is."""
        row = self._row_of(thing)
        self._parent[row] = self._body_of(parent)
        self._anchor[row], self._still[row] = relative, PATIENCE

    def set_moving(self, things: list[int]) -> None:
        """Take things for moving, as others say they do."""
        rows = [self._row_of(thing) for thing in things]  # first: what has just come renews the rows
        self._still[rows] = 0

    # ------------------------------------------------------------------ inside

    def _keep_up(self) -> None:
        """Find everything again if the world was compiled or listed anew since."""
        if self._generation != self.rigid.generation:
            self._renew()

    def _row_of(self, thing: int) -> int:
        self._keep_up()
        return self._at[thing]

    def _poses(self, rows: np.ndarray) -> np.ndarray:
        pose = self.rigid.mj_data.qpos[self._q[rows][:, None] + np.arange(7)]
        pose[:, 3:] = frames.from_wxyz(pose[:, 3:])
        return pose

    def _relative(self, pose: np.ndarray, parent: np.ndarray) -> np.ndarray:
        """Poses [k, 7] in the frames of MuJoCo bodies [k]."""
        moves = np.flatnonzero(parent)
        if len(moves) == 0:
            return pose
        d, relative = self.rigid.mj_data, pose.copy()
        frame = np.concatenate([d.xpos[parent[moves]], frames.from_wxyz(d.xquat[parent[moves]])], -1)
        row = self._row[parent[moves]]
        free = np.flatnonzero(row >= 0)  # boxes know where they are without being asked anew
        frame[free] = self._poses(row[free])
        relative[moves] = frames.compose(frames.inverse(frame), pose[moves])
        return relative

    def _bands(self) -> np.ndarray:
        """How far each thing may move and turn and still be still [n, 2] m, rad."""
        on = self._row[self._parent]
        carried = self._kind[self._parent] == _LINK
        shaken = (on >= 0) & ((np.minimum(self._still, self._calm)[on] < PATIENCE) | carried[on])
        return np.where(shaken[:, None], SHAKEN, np.where(carried[:, None], CARRIED, STILL))

    def _touching(self) -> np.ndarray:
        """(row, MuJoCo body) of all contacts of the last tick [k, 2], each seen from both sides."""
        m, d = self.rigid.mj_model, self.rigid.mj_data
        if d.ncon == 0:
            return np.zeros((0, 2), np.int64)
        pairs = m.geom_bodyid[d.contact.geom[d.contact.efc_address >= 0]].astype(np.int64)
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
        row = self._row[pairs[:, 0]]
        here = row >= 0
        each = np.unique(row[here] * m.nbody + pairs[here, 1])
        return np.stack([each // m.nbody, each % m.nbody], -1)

    def _supports(self, rows: np.ndarray, inside: np.ndarray) -> np.ndarray:
        """On what these rows [k] ride now: MuJoCo bodies [k]; ``inside`` [n] are those still within their band."""
        count = len(self.object_ids)
        row, other = self._pairs.T
        kind = self._kind[other]
        best = np.full((3, count), np.iinfo(np.int64).max)
        for place, wanted in enumerate((_STANDS, _BOX, _LINK)):
            these = kind == wanted
            np.minimum.at(best[place], row[these], other[these])
        stands, box, link = np.where(best == np.iinfo(np.int64).max, _NONE, best)
        bunch = self._kind[self._body] == _BUNCH
        first, second = np.where(bunch, box, link), np.where(bunch, link, box)
        second[~bunch & (second >= 0) & (self._parent[self._row[np.maximum(second, 0)]] == self._body)] = _NONE
        found = np.where(stands >= 0, 0, np.where(first >= 0, first, second))
        stands_on = self._kind[other] == _BUNCH
        leaning, on = row[stands_on], self._row[other[stands_on]]
        for _ in range(count):  # what lies on bunches rides on what they ride on
            helped = (found[leaning] == _NONE) & (found[on] != _NONE) & bunch[leaning]
            if not helped.any():
                break
            found[leaning[helped]] = found[on[helped]]
        touches = np.zeros(count, bool)
        touches[row[np.where(self._kind[other] == _STANDS, 0, other) == self._parent[row]]] = True
        asleep = self.rigid.mj_data.tree_asleep[self._tree] >= 0  # of these MuJoCo tells no contacts
        keep = (inside & (touches | (found == _NONE))) | asleep
        return np.where(keep, self._parent, np.where(found == _NONE, 0, found))[rows]

    def _renew(self) -> None:
        """Find everything in the world as it is now; parents keep their names, not their numbers."""
        rigid = self.rigid
        m = rigid.mj_model
        rigid.update_kinematics()
        names = self._parent_names() if self._at else []
        known = {
            number: (names[row], self._anchor[row], self._still[row], self._calm[row])
            for number, row in self._at.items()
        }
        self._generation = rigid.generation
        boxes = [thing(Kind.BOX, i) for i in range(len(rigid.model.box_mass))]
        bunches = [thing(Kind.BUNCH, i) for i in rigid.free_bunches]
        self.object_ids = np.array(sorted(boxes + bunches), np.int64)
        self._at = {number: row for row, number in enumerate(self.object_ids.tolist())}
        self._kind = np.full(m.nbody, _STANDS)
        self._row = np.full(m.nbody, -1)
        self._body = np.zeros(len(self.object_ids), np.int64)
        self._body_named: dict[str, int] = {GROUND: 0}
        for body, (actor, link) in rigid.owners.items():
            number = thing_named(actor)
            if number is not None:
                self._kind[body] = _BOX if number >= thing(Kind.BOX, 0) else _BUNCH
                self._row[body] = self._at[number]
                self._body[self._at[number]] = body
                self._body_named[actor] = body
            else:
                self._kind[body] = _LINK if actor in rigid.robots else _PERSON
                self._body_named[f"{actor}/{link}"] = body
        joint = m.body_jntadr[self._body]
        self._q, self._v = m.jnt_qposadr[joint], m.jnt_dofadr[joint]
        self._tree = m.body_treeid[self._body]
        self._parent = np.zeros(len(self.object_ids), np.int64)
        self._anchor = self._poses(np.arange(len(self.object_ids)))
        self._still = np.where(self.object_ids >= thing(Kind.BOX, 0), PATIENCE, 0)
        self._calm = self._still.copy()
        self._pairs, self._touched = np.zeros((0, 2), np.int64), None
        self._bands_before = np.tile(STILL, (len(self.object_ids), 1))
        for number, (parent, anchor, still, calm) in known.items():
            if number in self._at:
                row = self._at[number]
                self._calm[row] = calm
                self._parent[row] = self._body_of(parent)
                gone = parent != GROUND and self._parent[row] == 0
                self._still[row] = 0 if gone else still
                if not gone:
                    self._anchor[row] = anchor

    def _parent_names(self) -> list[str]:
        names = {body: name for name, body in self._body_named.items()}
        return [names.get(body, GROUND) for body in self._parent.tolist()]

    def _name(self, body: int) -> str:
        return next(name for name, other in self._body_named.items() if other == body)

    def _body_of(self, parent: str) -> int:
        """The MuJoCo body of a parent; the ground if it is gone."""
        return self._body_named.get(parent, 0)


def _apart(a: np.ndarray, b: np.ndarray, band: np.ndarray) -> np.ndarray:
    """Which poses [k, 7] differ by more than a ``band`` [k, 2] m, rad: [k] bool."""
    off = a[:, :3] - b[:, :3]
    chord = np.minimum(np.square(a[:, 3:] - b[:, 3:]).sum(1), np.square(a[:, 3:] + b[:, 3:]).sum(1))
    return (np.square(off).sum(1) > np.square(band[:, 0])) | (chord > np.square(0.5 * band[:, 1]))
