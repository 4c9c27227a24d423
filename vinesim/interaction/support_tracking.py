"""Support tracking: the support on which a box or free bunch rests, and whether the object moves relative to its
support.

Every object has a *support*: the ground, the box in which it lies, or the link of a robot that carries or grips it. An
object that has been still in its support's frame for ``support_rest_duration`` is at rest, even if the support moves,
as with a bunch in a carried box. It stays at rest until it leaves a band around its anchor pose. Then a new support is
chosen among the bodies in contact with it. The ground has priority, because a box pushed along the ground is not
supported by the pusher. Hands of people are not supports, because their copies on other clients are not exact enough.
Objects in hands are never at rest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Container, Iterator

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid.recompile import wake_body
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.ids import ObjectKind, object_id, parse_object_name

STILL_BAND = 0.005, float(np.radians(1.0))
"""[m, rad] Largest displacement and rotation in its support's frame of an object that is still. TUNED."""
CARRIED_BAND = 0.015, float(np.radians(5.0))
"""[m, rad] Band of an object on a link of a robot, which shakes the object. While it stays in the band, its pose is not
sent to other clients. TUNED."""
SHAKEN_BAND = 0.05, float(np.radians(30.0))
"""[m, rad] Band of a bunch in a moving box, in which the bunch rocks and rolls. In a box at rest :data:`STILL_BAND`
applies. TUNED."""

STOP_STEPS = 15
"""Number of steps for which a contact limits the corrections of a remote object after it has ended, as long as states
are extrapolated: an object that bounces has no contact for a few steps."""
SAME_NORMAL = 0.95
"""Cosine of the angle below which two contact normals count as one."""

GROUND = ""
"""Name of the ground as a support; boxes are ``box/3``, links ``actor/link``."""

_STATIC, _BOX, _LINK, _BUNCH, _HUMAN = range(5)
FARTHEST = 1e5
"""Largest coordinate of an object that rests on a support [m], as large as messages may have."""
_NONE = -1
_NO_PAIRS = np.zeros((0, 2), np.int64)


@dataclasses.dataclass(slots=True)
class _Stop:
    """A thing that stops an object which a remote actor moves."""

    normal: np.ndarray
    """Unit vector [3] away from the thing."""
    steps_left: int
    """Number of steps for which it still counts."""


class SupportTracker:
    """Poses, velocities and supports of all boxes and free bunches, and which of them are at rest.

    An object is identified by :func:`vinesim.scene.ids.object_id`. For each object the tracker counts the steps for
    which the object has stayed within its band around an anchor pose in its support's frame.
    """

    def __init__(self, rigid: RigidWorld) -> None:
        self.rigid = rigid
        self._rest_steps = rigid.parameters.steps(rigid.parameters.support_rest_duration)
        self.object_ids = np.zeros(0, np.int64)
        """[object] Ids of all objects, sorted: first boxes, then free bunches. The tables of this class have a row for
        each object."""
        self._generation = -1
        self._support = np.zeros(0, np.int64)
        """[object] MuJoCo body of the support, 0 for the ground."""
        self._anchor_pose = np.zeros((0, 7))
        """[object, 7] Anchor pose in the support's frame, around which the object may move within its band."""
        self._still_steps = self._slow_steps = np.zeros(0, np.int64)
        """[object] Number of successive steps for which the object has been slower than ``support_move_speed``.

        ``_still_steps`` [object]: number of successive steps for which the object has been within its band (the
        permitted displacement from its anchor pose).
        """
        self._row_of_object: dict[int, int] = {}
        self._touching_pairs = _NO_PAIRS
        """[k, 2] Pairs of an object's row and the MuJoCo body in contact with the object in the last step."""
        self._bands_before = self._bands_on_ground = np.zeros((0, 2))
        """[object, 2] m, rad: band of each object if it is on the ground (permitted displacement and rotation from the
        anchor pose).

        ``_bands_before`` [object, 2]: band of each object in the last step.
        """
        self._touched: list[tuple[int, str]] | None = None
        self._stops: dict[int, list[_Stop]] = {}
        """What has stopped objects that remote actors move, by row."""
        self._all_sleep = False
        """Whether all objects slept after the last step."""
        self._rebuild_tables()

    # ------------------------------------------------------------------ the tick

    def update(self) -> None:
        """Determine after a step which objects are still in their support's frame, and choose new supports for the
        other objects."""
        self._update_tables()
        d = self.rigid.mj_data
        move_speed = self.rigid.parameters.support_move_speed
        self._still_steps += 1
        self._still_steps[self._held_rows()] = 0
        asleep = d.tree_asleep[self._tree] >= 0
        all_slept = self._all_sleep
        self._all_sleep = bool(asleep.all())
        if all_slept and self._all_sleep and self._bands_before is self._bands_on_ground and not self._support.any():
            self._slow_steps += 1
            # MuJoCo reports no contacts of sleeping objects
            self._touching_pairs = _NO_PAIRS
            self._touched = None
            return
        speed = d.qvel[self._v[:, None] + np.arange(3)]
        self._slow_steps = np.where((speed * speed).sum(1) > move_speed * move_speed, 0, self._slow_steps + 1)
        self._touching_pairs = self._find_touching_pairs()
        self._touched = None
        bands = self._band_sizes()
        before = self._bands_before
        self._bands_before = bands
        # an object that fell asleep in a moving box is checked when the box has come to rest
        awake = np.flatnonzero(~asleep | (bands[:, 0] < before[:, 0]))
        if len(awake) == 0:
            return
        if (self._kind_of_body[self._support[awake]] == _LINK).any():
            self.rigid.update_kinematics()
        pose = self._poses(awake)
        relative = self._relative(pose, self._support[awake])
        out = _is_outside_band(relative, self._anchor_pose[awake], bands[awake])
        unsettled = awake[out | (self._still_steps[awake] < self._rest_steps)]
        if len(unsettled) == 0:
            return
        before_support = self._support[unsettled].copy()
        inside = np.zeros(len(self.object_ids), bool)
        inside[awake] = ~out
        self._support[unsettled] = self._find_supports(unsettled, inside)
        changed = unsettled[self._support[unsettled] != before_support]
        restarted = np.union1d(awake[out], changed)
        if len(restarted):
            self.rigid.update_kinematics()
            self._anchor_pose[restarted] = self._relative(self._poses(restarted), self._support[restarted])
            self._still_steps[restarted] = 0

    def _held_rows(self) -> list[int]:
        """Returns the rows of objects in hands. These must not be at rest: an object at rest would stay in place when
        the hand opens."""
        held = (hand.held for name in self.rigid.humans for hand in self.rigid.human(name).hands)
        numbers = (parse_object_name(one[0]) for one in held if one is not None)
        return [self._row_of_object[number] for number in numbers if number in self._row_of_object]

    @property
    def moving(self) -> list[int]:
        """Objects that are not at rest in their support's frame."""
        self._update_tables()
        return self.object_ids[self._still_steps < self._rest_steps].tolist()

    @property
    def touched(self) -> list[tuple[int, str]]:
        """Returns pairs (object, name) of each moving object and each robot, person, box (``box/3``) or free bunch that
        touches the object."""
        self._update_tables()
        if self._touched is None:
            self._touched = self._list_touched()
        return self._touched

    def objects_moved_by(self, actor: str) -> set[int]:
        """Returns the moving objects that ``actor`` touches directly or through other objects."""
        self._update_tables()
        moves = self._still_steps < self._rest_steps
        if not moves.any():
            return set()
        bodies = [body for body, (owner, _) in self.rigid.owners.items() if owner == actor]
        row, other = self._touching_pairs.T
        touched = np.zeros(len(self.object_ids), bool)
        touched[row[np.isin(other, bodies)]] = True
        for hand in self.rigid.human(actor).hands if actor in self.rigid.humans else ():
            held = None if hand.held is None else parse_object_name(hand.held[0])
            if held in self._row_of_object:
                touched[self._row_of_object[held]] = True
        on = self._row_of_body[other]
        while True:
            more = row[(on >= 0) & touched[on] & ~touched[row]]
            if not len(more):
                return set(self.object_ids[touched & moves].tolist())
            touched[more] = True

    def _list_touched(self) -> list[tuple[int, str]]:
        found = set()
        for row, body in self._touching_pairs[
            self._still_steps[self._touching_pairs[:, 0]] < self._rest_steps
        ].tolist():
            owner = self.rigid.owners.get(body)
            if owner is not None:
                found.add((int(self.object_ids[row]), owner[0]))
        for name in self.rigid.humans:
            for hand in self.rigid.human(name).hands:
                held = None if hand.held is None else parse_object_name(hand.held[0])
                if held in self._row_of_object and self._still_steps[self._row_of_object[held]] < self._rest_steps:
                    found.add((held, name))
        return sorted(found)

    @property
    def sleeping(self) -> list[int]:
        """Objects that MuJoCo does not move, because they and what they touch have been still for some steps."""
        self._update_tables()
        return self.object_ids[self.rigid.mj_data.tree_asleep[self._tree] >= 0].tolist()

    # ------------------------------------------------------------------ single objects

    def __contains__(self, object_id: int) -> bool:
        self._update_tables()
        return object_id in self._row_of_object

    def object_state(self, object_id: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pose [7] of an object, and its velocity [6] (linear velocity of the origin, then angular; world
        axes)."""
        row = self._row_of(object_id)
        d = self.rigid.mj_data
        pose = self._poses(np.array([row]))[0]
        v = d.qvel[self._v[row] : self._v[row] + 6]
        return pose, np.concatenate([v[:3], frames.rotate(pose[3:], v[3:])])

    def pose_on_support(self, object_id: int) -> tuple[str, np.ndarray]:
        """Returns the name of an object's support, and the pose [7] of the object in the support's frame."""
        row = self._row_of(object_id)
        self.rigid.update_kinematics()
        at = np.array([row])
        return self._support_name(int(self._support[row])), self._relative(self._poses(at), self._support[at])[0]

    def support_state(self, support: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns the pose [7] and velocity [6] of a support; None if the support does not exist."""
        if support == GROUND:
            return frames.pose([0.0, 0.0, 0.0]), np.zeros(6)
        self._update_tables()
        box = parse_object_name(support)
        if box is not None:
            return self.object_state(box) if box in self._row_of_object else None
        body = self._body_named.get(support)
        if body is None:
            return None
        m = self.rigid.mj_model
        d = self.rigid.mj_data
        self.rigid.update_kinematics()
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
        pose = np.concatenate([d.xpos[body], frames.from_wxyz(d.xquat[body])])
        return pose, np.concatenate([twist[3:], twist[:3]])

    def to_world(self, support: str, relative: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns the world poses [..., 7] and velocities [..., 6] of objects that rest on a support with the poses
        ``relative`` [..., 7] in its frame.

        None if the support does not exist. No object is beyond :data:`FARTHEST`: a chain of supports, each far from the
        one below, does not lead out of the world.
        """
        frame = self.support_state(support)
        if frame is None:
            return None
        pose = frames.compose(frame[0], relative)
        pose[..., :3] = np.clip(pose[..., :3], -FARTHEST, FARTHEST)
        velocity = np.broadcast_to(frame[1], (*pose.shape[:-1], 6)).copy()
        velocity[..., :3] += frames.cross(velocity[..., 3:], pose[..., :3] - frame[0][:3])
        return pose, velocity

    def set_state(self, object_id: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Set the world pose [7] and the velocity [6] (world axes) of an object."""
        self.set_states([object_id], np.asarray(pose, float)[None], np.asarray(velocity, float)[None])

    def set_states(self, object_ids: list[int], pose: np.ndarray, velocity: np.ndarray) -> None:
        """Set the world poses [k, 7] and the velocities [k, 6] (world axes) of objects [k]."""
        rows = np.array([self._row_of(object_id) for object_id in object_ids])
        d = self.rigid.mj_data
        turn = frames.normalize(pose[:, 3:])
        d.qpos[self._q[rows][:, None] + np.arange(7)] = np.concatenate([pose[:, :3], frames.to_wxyz(turn)], -1)
        spin = frames.rotate(frames.conjugate(turn), velocity[:, 3:])
        d.qvel[self._v[rows][:, None] + np.arange(6)] = np.concatenate([velocity[:, :3], spin], -1)
        for body in self._body[rows].tolist():
            wake_body(self.rigid.mj_model, d, body)
        self.rigid.invalidate_kinematics()

    def blend_towards(
        self,
        object_ids: list[int],
        pose: np.ndarray,
        velocity: np.ndarray,
        blend: np.ndarray,
        local_actors: Container[str] = (),
    ) -> None:
        """Move objects [k] towards ``pose`` [k, 7] by the share ``blend`` [k] of the difference, and set their
        ``velocity`` [k, 6], except where that would press them harder against things that their owner does not move:
        the ground, other objects, and ``local_actors``.

        The owner's object may have stopped there already, which is not known here yet. Call it in every step. Objects
        further away than ``support_snap_distance`` get the pose ``pose`` at once.
        """
        rows = np.array([self._row_of(object_id) for object_id in object_ids])
        here = self._poses(rows)
        far = np.linalg.norm(pose[:, :3] - here[:, :3], axis=1) > self.rigid.parameters.support_snap_distance
        there = pose.copy()
        there[(here[:, 3:] * pose[:, 3:]).sum(1) < 0.0, 3:] *= -1.0
        moved = here + np.where(far, 1.0, blend)[:, None] * (there - here)
        velocity = velocity.copy()
        place = {row: k for k, row in enumerate(rows.tolist()) if not far[k]}
        self._remember_stops(place, local_actors)
        for row, stops in self._stops.items():
            k = place[row]
            own = self.rigid.mj_data.qvel[self._v[row] : self._v[row] + 3]
            for stop in stops:
                moved[k, :3] -= min(0.0, float((moved[k, :3] - here[k, :3]) @ stop.normal)) * stop.normal
                velocity[k, :3] -= min(0.0, float((velocity[k, :3] - own) @ stop.normal)) * stop.normal
        self.set_states(object_ids, moved, velocity)

    def _remember_stops(self, rows: Collection[int], local_actors: Container[str]) -> None:
        """Add the contacts of the last step to what stops ``rows``, and forget old ones."""
        for stops in self._stops.values():
            for stop in stops:
                stop.steps_left -= 1
        self._stops = {
            row: [stop for stop in stops if stop.steps_left > 0] for row, stops in self._stops.items() if row in rows
        }
        for row, normal in self._contact_normals(rows, local_actors):
            stops = self._stops.setdefault(row, [])
            known = next((stop for stop in stops if stop.normal @ normal > SAME_NORMAL), None)
            if known is None:
                stops.append(_Stop(normal, STOP_STEPS))
            else:
                known.steps_left = STOP_STEPS

    def _contact_normals(self, rows: Collection[int], local_actors: Container[str]) -> Iterator[tuple[int, np.ndarray]]:
        """Yields the contacts of the last step between one of ``rows`` and a thing that is none of them and belongs to
        nobody else than ``local_actors``: the row and the unit vector [3] away from the thing."""
        d = self.rigid.mj_data
        active = np.flatnonzero(d.contact.efc_address >= 0)
        bodies = self.rigid.mj_model.geom_bodyid[d.contact.geom[active]]
        row = self._row_of_body[bodies]
        is_remote = np.zeros(len(self.object_ids) + 1, bool)  # the last one is for row -1, which is no object
        is_remote[list(rows)] = True
        for side, sign in ((0, -1.0), (1, 1.0)):  # MuJoCo's normals lead from the first geom to the second
            for k in np.flatnonzero(is_remote[row[:, side]] & ~is_remote[row[:, 1 - side]]).tolist():
                other = int(bodies[k, 1 - side])
                is_actor = self._kind_of_body[other] in (_LINK, _HUMAN)
                if not is_actor or self.rigid.owners[other][0] in local_actors:
                    yield int(row[k, side]), sign * d.contact.frame[active[k], :3]

    def set_at_rest(self, object_id: int, support: str, relative: np.ndarray) -> None:
        """Set an object at rest with the pose ``relative`` [7] in a support's frame, because the client that owns the
        object has sent this."""
        row = self._row_of(object_id)
        self._support[row] = self._body_of_support(support)
        self._anchor_pose[row] = relative
        self._still_steps[row] = self._rest_steps

    def set_moving(self, object_ids: list[int]) -> None:
        """Mark objects as moving, because the client that owns them has sent this."""
        rows = [self._row_of(object_id) for object_id in object_ids]  # before the tables are used: it may rebuild them
        self._still_steps[rows] = 0

    # ------------------------------------------------------------------ inside

    def _update_tables(self) -> None:
        """Build the tables of objects and bodies again if MuJoCo's model has changed."""
        if self._generation != self.rigid.generation:
            self._rebuild_tables()

    def _row_of(self, object_id: int) -> int:
        self._update_tables()
        return self._row_of_object[object_id]

    def _poses(self, rows: np.ndarray) -> np.ndarray:
        pose = self.rigid.mj_data.qpos[self._q[rows][:, None] + np.arange(7)]
        pose[:, 3:] = frames.from_wxyz(pose[:, 3:])
        return pose

    def _relative(self, pose: np.ndarray, support: np.ndarray) -> np.ndarray:
        """Returns the world poses ``pose`` [k, 7] expressed in the frames of the MuJoCo bodies ``support`` [k]."""
        moves = np.flatnonzero(support)
        if len(moves) == 0:
            return pose
        d = self.rigid.mj_data
        relative = pose.copy()
        frame = np.concatenate([d.xpos[support[moves]], frames.from_wxyz(d.xquat[support[moves]])], -1)
        row = self._row_of_body[support[moves]]
        free = np.flatnonzero(row >= 0)  # poses of objects are in qpos and need no forward kinematics
        frame[free] = self._poses(row[free])
        relative[moves] = frames.compose(frames.inverse(frame), pose[moves])
        return relative

    def _band_sizes(self) -> np.ndarray:
        """Returns the band [object, 2] m, rad of each object on its present support: the displacement and rotation from
        its anchor pose within which the object is still.
        """
        if not self._support.any():
            return self._bands_on_ground
        on = self._row_of_body[self._support]
        carried = self._kind_of_body[self._support] == _LINK
        shaken = (on >= 0) & ((np.minimum(self._still_steps, self._slow_steps)[on] < self._rest_steps) | carried[on])
        return np.where(shaken[:, None], SHAKEN_BAND, np.where(carried[:, None], CARRIED_BAND, STILL_BAND))

    def _find_touching_pairs(self) -> np.ndarray:
        """Returns the contacts of the last step as pairs [k, 2] of an object's row and the touching MuJoCo body. A
        contact between two objects is listed twice."""
        m = self.rigid.mj_model
        d = self.rigid.mj_data
        if d.ncon == 0:
            return _NO_PAIRS
        pairs = m.geom_bodyid[d.contact.geom[d.contact.efc_address >= 0]].astype(np.int64)
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
        row = self._row_of_body[pairs[:, 0]]
        here = row >= 0
        each = np.unique(row[here] * m.nbody + pairs[here, 1])
        return np.stack([each // m.nbody, each % m.nbody], -1)

    def _find_supports(self, rows: np.ndarray, inside: np.ndarray) -> np.ndarray:
        """Returns the supports, as MuJoCo bodies [k], of the objects ``rows`` [k]. ``inside`` [object]: whether each
        object is still in its band."""
        count = len(self.object_ids)
        row, other = self._touching_pairs.T
        kind = self._kind_of_body[other]
        best = np.full((3, count), np.iinfo(np.int64).max)
        for rank, wanted in enumerate((_STATIC, _BOX, _LINK)):
            these = kind == wanted
            np.minimum.at(best[rank], row[these], other[these])
        static, box, link = np.where(best == np.iinfo(np.int64).max, _NONE, best)
        bunch = self._kind_of_body[self._body] == _BUNCH
        first = np.where(bunch, box, link)
        second = np.where(bunch, link, box)
        second[~bunch & (second >= 0) & (self._support[self._row_of_body[np.maximum(second, 0)]] == self._body)] = _NONE
        found = np.where(static >= 0, 0, np.where(first >= 0, first, second))
        on_bunch = self._kind_of_body[other] == _BUNCH
        upper = row[on_bunch]
        lower = self._row_of_body[other[on_bunch]]
        for _ in range(count):  # an object on a bunch gets the support of that bunch
            supported = (found[upper] == _NONE) & (found[lower] != _NONE) & bunch[upper]
            if not supported.any():
                break
            found[upper[supported]] = found[lower[supported]]
        touches = np.zeros(count, bool)
        touches[row[np.where(self._kind_of_body[other] == _STATIC, 0, other) == self._support[row]]] = True
        asleep = self.rigid.mj_data.tree_asleep[self._tree] >= 0  # MuJoCo reports no contacts of sleeping objects
        keep = (inside & (touches | (found == _NONE))) | asleep
        return np.where(keep, self._support, np.where(found == _NONE, 0, found))[rows]

    def _rebuild_tables(self) -> None:
        """Build the tables of objects and bodies for MuJoCo's present model. Objects keep their supports, which are
        matched by name.
        """
        rigid = self.rigid
        m = rigid.mj_model
        rigid.update_kinematics()
        names = self._support_names() if self._row_of_object else []
        known = {
            number: (names[row], self._anchor_pose[row], self._still_steps[row], self._slow_steps[row])
            for number, row in self._row_of_object.items()
        }
        self._generation = rigid.generation
        boxes = [object_id(ObjectKind.BOX, i) for i in rigid.boxes]
        bunches = [object_id(ObjectKind.BUNCH, i) for i in rigid.free_bunches]
        self.object_ids = np.array(sorted(boxes + bunches), np.int64)
        self._row_of_object = {number: row for row, number in enumerate(self.object_ids.tolist())}
        self._kind_of_body = np.full(m.nbody, _STATIC)
        self._row_of_body = np.full(m.nbody, -1)
        self._body = np.zeros(len(self.object_ids), np.int64)
        self._body_named: dict[str, int] = {GROUND: 0}
        for body, (actor, link) in rigid.owners.items():
            number = parse_object_name(actor)
            if number is not None:
                self._kind_of_body[body] = _BOX if number >= object_id(ObjectKind.BOX, 0) else _BUNCH
                self._row_of_body[body] = self._row_of_object[number]
                self._body[self._row_of_object[number]] = body
                self._body_named[actor] = body
            else:
                self._kind_of_body[body] = _LINK if actor in rigid.robots else _HUMAN
                self._body_named[f"{actor}/{link}"] = body
        joint = m.body_jntadr[self._body]
        self._q = m.jnt_qposadr[joint]
        self._v = m.jnt_dofadr[joint]
        self._tree = m.body_treeid[self._body]
        self._support = np.zeros(len(self.object_ids), np.int64)
        self._anchor_pose = self._poses(np.arange(len(self.object_ids)))
        self._still_steps = np.where(self.object_ids >= object_id(ObjectKind.BOX, 0), self._rest_steps, 0)
        self._slow_steps = self._still_steps.copy()
        self._touching_pairs = np.zeros((0, 2), np.int64)
        self._touched = None
        self._stops = {}
        self._bands_before = self._bands_on_ground = np.tile(STILL_BAND, (len(self.object_ids), 1))
        for number, (support, anchor, still, slow) in known.items():
            if number in self._row_of_object:
                row = self._row_of_object[number]
                self._slow_steps[row] = slow
                self._support[row] = self._body_of_support(support)
                gone = support != GROUND and self._support[row] == 0
                self._still_steps[row] = 0 if gone else still
                if not gone:
                    self._anchor_pose[row] = anchor

    def _support_names(self) -> list[str]:
        names = {body: name for name, body in self._body_named.items()}
        return [names.get(body, GROUND) for body in self._support.tolist()]

    def _support_name(self, body: int) -> str:
        return next(name for name, other in self._body_named.items() if other == body)

    def _body_of_support(self, support: str) -> int:
        """Returns the MuJoCo body of a support; 0 (the ground) if the support does not exist."""
        return self._body_named.get(support, 0)


def _is_outside_band(a: np.ndarray, b: np.ndarray, band: np.ndarray) -> np.ndarray:
    """Returns [k] bool: whether poses ``a`` and ``b`` [k, 7] differ by more than ``band`` [k, 2] m, rad."""
    offset = a[:, :3] - b[:, :3]
    chord = np.minimum(np.square(a[:, 3:] - b[:, 3:]).sum(1), np.square(a[:, 3:] + b[:, 3:]).sum(1))
    return (np.square(offset).sum(1) > np.square(band[:, 0])) | (chord > np.square(0.5 * band[:, 1]))
