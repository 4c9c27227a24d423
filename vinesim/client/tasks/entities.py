"""Entities of a client's world for simulation_interfaces: listing, spawning, deleting, moving and resetting.

Boxes and bunches have the names of ``tf_environment`` (``box_3``, ``bunch_00017``), robots and people their own names,
and spawned entities the names given to them. All methods are called between two steps.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np

from vinesim.client.client import Client, label_index
from vinesim.client.remote.remote_human import RemoteHuman
from vinesim.core import frames
from vinesim.net.codec.header import is_valid_name
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.ros.commands.types import (
    Entity,
    EntityArguments,
    EntityCategory,
    Refusal,
    RequestRefused,
    Spawnable,
)
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.terrain import on_ground
from vinesim.scene.values import HumanSpec, RigidBox

BOX_SIZE = (0.6, 0.4, 0.24)
"""[m] Outer size of a spawned crate, as in composed scenes."""
BOX_MASS = 1.6
"""[kg] Mass of a spawned crate, as in composed scenes."""
PERSON_HEIGHT = 1.75
"""[m] Height of a spawned person."""
BUNCH_REACH = 0.35
"""Half edge of the bounding box that is reported for a bunch to be spawned [m]; no bunch is longer."""
MAX_DISTANCE = 10_000.0
"""[m] Poses further from the origin are refused, because single precision does not resolve a millimetre there."""
_UNKNOWN = np.full(6, np.nan)
_BOX_URI = "vinesim:box"
_PERSON_URI = "vinesim:person"
_BUNCH_URI = "vinesim:bunch"
_SPAWNABLES = (
    Spawnable(
        _BOX_URI,
        "an empty harvest crate of 60 x 40 x 24 cm; its pose is that of its underside's middle",
        (-0.3, -0.2, 0.0),
        (0.3, 0.2, 0.24),
    ),
    Spawnable(
        _PERSON_URI,
        "a person of 1.75 m who stands; x, y and yaw of the pose count",
        (-0.3, -0.4, 0.0),
        (0.5, 0.4, 1.75),
    ),
    Spawnable(
        _BUNCH_URI,
        f"the bunch that hangs furthest from all robots, taken off its vine; {_BUNCH_URI}/17 takes bunch 17",
        (-BUNCH_REACH, -BUNCH_REACH, -BUNCH_REACH),
        (BUNCH_REACH, BUNCH_REACH, BUNCH_REACH),
    ),
)


@dataclasses.dataclass(frozen=True, slots=True)
class _Spawned:
    """An entity that a request from ROS has added to the world."""

    kind: EntityCategory
    number: int
    """Number of the box or bunch; -1 for a person."""
    pose: np.ndarray
    """[7] Pose at which it was spawned."""


class WorldEditor:
    """Lists and changes the entities of one client. :class:`RequestRefused` has the reason of a refusal.

    Changes are possible only in a client without a server, because otherwise they would affect other clients and
    owners.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._spawned: dict[str, _Spawned] = {}

    # ------------------------------------------------------------------ what there is

    @property
    def spawnables(self) -> tuple[Spawnable, ...]:
        """Things that can be spawned."""
        return _SPAWNABLES

    def entities(self) -> Iterator[Entity]:
        """Yields the robots, people, boxes and bunches in this client's world."""
        client = self._client
        physics = client.physics
        rigid = client.physics.rigid
        tracker = client.physics.support_tracker
        physics.update_kinematics()
        for name in sorted(rigid.actors):
            if name in client.humans or isinstance(client.remote_actors.get(name), RemoteHuman):
                pose = frames.pose(rigid.actor_position(name).astype(float))
                yield Entity(name, EntityCategory.HUMAN, pose, _UNKNOWN, "a person; the pose is that of the hips")
            else:
                pose, velocity = rigid.base_state(name)
                yield Entity(name, EntityCategory.ROBOT, np.array(pose, float), np.array(velocity, float), "a robot")
        given = {(one.kind, one.number): name for name, one in self._spawned.items() if one.number >= 0}
        for box in rigid.boxes:
            name = given.get((EntityCategory.DYNAMIC_OBJECT, box), f"box_{box}")
            state = tracker.object_state(object_id(ObjectKind.BOX, box))
            yield Entity(name, EntityCategory.DYNAMIC_OBJECT, *state, f"a crate; frame box_{box} of tf_environment")
        yield from self._bunches(given)

    def _bunches(self, given: dict[tuple[EntityCategory, int], str]) -> Iterator[Entity]:
        physics = self._client.physics
        model = self._client.model
        tracker = physics.support_tracker
        attached = physics.state.bunch_attached
        dormant = {one.index: row for row, one in enumerate(physics.dormant_bunches.visuals())}
        dormant_q = physics.dormant_bunches.visual_q()
        for bunch in range(len(attached)):
            body = model.bunch_body[bunch]
            number = object_id(ObjectKind.BUNCH, bunch)
            name = f"bunch_{bunch:05d}"
            frame = f"picked_bunch_{bunch:05d}"
            if attached[bunch]:
                state = physics.state.body_q[body].astype(float), physics.state.body_qd[body].astype(float)
                yield Entity(
                    name, EntityCategory.OBJECT, *state, f"a bunch on its vine; frame {name} of tf_environment"
                )
                continue
            if number in tracker:
                state = tracker.object_state(number)
            elif bunch in dormant:
                state = dormant_q[dormant[bunch]].copy(), _UNKNOWN
            else:
                continue
            name = given.get((EntityCategory.OBJECT, bunch), name)
            yield Entity(name, EntityCategory.DYNAMIC_OBJECT, *state, f"a loose bunch; frame {frame} of tf_environment")

    # ------------------------------------------------------------------ changes

    def spawn(self, given: EntityArguments) -> str:
        """Add a box, a person or a loose bunch. Returns its name."""
        self._require_alone("spawns nothing")
        if not given.uri:
            raise RequestRefused(Refusal.NO_RESOURCE, f"no uri; give {_BOX_URI}, {_PERSON_URI} or {_BUNCH_URI}")
        scheme, _, number = given.uri.partition("/")
        if scheme not in {one.uri for one in _SPAWNABLES} or (number and scheme != _BUNCH_URI):
            raise RequestRefused(Refusal.UNSUPPORTED_FORMAT, f"unknown uri {given.uri!r}; get_spawnables lists all")
        pose = _checked_pose(given.pose)
        bunch = self._bunch_to_spawn(number) if scheme == _BUNCH_URI else -1
        name = self._free_name(given, scheme.removeprefix("vinesim:"))
        if scheme == _BOX_URI:
            taken = {one.number for one in self._spawned.values() if one.kind == EntityCategory.DYNAMIC_OBJECT}
            numbers = itertools.count(len(self._client.model.box_size))
            one = _Spawned(EntityCategory.DYNAMIC_OBJECT, next(i for i in numbers if i not in taken), pose)
        elif scheme == _PERSON_URI:
            one = _Spawned(EntityCategory.HUMAN, -1, self._upright(pose))
        else:
            one = _Spawned(EntityCategory.OBJECT, bunch, pose)
        self._add(name, one)
        self._spawned[name] = one
        return name

    def delete(self, name: str) -> None:
        """Remove a box, a loose bunch or a spawned person."""
        self._require_alone("deletes nothing")
        entity, number = self._movable(name)
        client = self._client
        rigid = self._client.physics.rigid
        if entity.category is EntityCategory.ROBOT:
            raise RequestRefused(Refusal.UNSUPPORTED, f"robot {name!r} stays: end its client instead")
        if entity.category is EntityCategory.HUMAN:
            if name not in self._spawned:
                raise RequestRefused(Refusal.UNSUPPORTED, f"person {name!r} was not spawned: end its client instead")
            client.remove_human(name)
        else:
            kind, index = number
            (rigid.remove_box if kind is ObjectKind.BOX else rigid.remove_bunch)(index)
            client.objects.forget(object_id(*number))
        self._spawned.pop(name, None)

    def set_state(self, given: EntityArguments) -> None:
        """Move a box, a loose bunch, a robot's base or a person. A moved robot or person stands still afterwards."""
        self._require_alone("moves nothing by services")
        entity, number = self._movable(given.name)
        pose = _checked_pose(given.pose)
        client = self._client
        rigid = self._client.physics.rigid
        if entity.category is EntityCategory.ROBOT:
            rigid.place_robot(given.name, self._upright(pose), rigid.joint_state(given.name)[0].copy())
            client.robots[given.name].stop()
        elif entity.category is EntityCategory.HUMAN:
            if given.name not in self._spawned:
                raise RequestRefused(
                    Refusal.UNSUPPORTED, f"person {given.name!r} belongs to another client, which moves it"
                )
            self._stand(given.name, self._upright(pose))
        else:
            velocity = np.zeros(6) if given.velocity is None else np.nan_to_num(given.velocity, posinf=0.0, neginf=0.0)
            client.objects.forget(object_id(*number))
            client.physics.support_tracker.set_state(object_id(*number), pose, velocity)
            client.physics.support_tracker.set_moving([object_id(*number)])

    def reset(self, *, keep_state: bool = False, keep_spawned: bool = False) -> None:
        """Reset the world.

        By default all states return to the generated scene and spawned entities are removed. ``keep_state``: only
        remove spawned entities. ``keep_spawned``: return spawned entities to their poses of spawning.
        """
        self._require_alone("resets nothing")
        if keep_state:
            for name in list(self._spawned):
                self.delete(name)
            return
        if script := self._client.script:
            raise RequestRefused(
                Refusal.INCORRECT_STATE, f"the task of {script} cannot be started again; start the client without it"
            )
        spawned = self._spawned
        self._spawned = {}
        for name, one in spawned.items():
            if one.kind is EntityCategory.HUMAN:
                self._client.remove_human(name)
        self._client.reset()
        for name, one in spawned.items() if keep_spawned else ():
            self._add(name, one)
            self._spawned[name] = one

    # ------------------------------------------------------------------ inside

    def _require_alone(self, what: str) -> None:
        if not self._client.is_alone:
            raise RequestRefused(
                Refusal.INCORRECT_STATE, f"a client of a shared world {what}; start it without --connect"
            )

    def _movable(self, name: str) -> tuple[Entity, tuple[ObjectKind, int]]:
        """Returns an entity that can be moved, with the kind and number of its object; (TREE, -1) for actors."""
        entity = next((one for one in self.entities() if one.name == name), None)
        if entity is None:
            raise RequestRefused(Refusal.NOT_FOUND, f"no entity {name!r}; get_entities lists them")
        if entity.category is EntityCategory.OBJECT:
            raise RequestRefused(Refusal.FAILED, f"{name} hangs on its vine: a robot or person has to pick it")
        if entity.category is not EntityCategory.DYNAMIC_OBJECT:
            return entity, (ObjectKind.TREE, -1)
        if (one := self._spawned.get(name)) is not None:
            return entity, (ObjectKind.BUNCH if one.kind is EntityCategory.OBJECT else ObjectKind.BOX, one.number)
        kind, _, number = name.partition("_")
        return entity, (ObjectKind.BUNCH if kind == "bunch" else ObjectKind.BOX, int(number))

    def _free_name(self, given: EntityArguments, stem: str) -> str:
        """Returns the requested name, or another one if renaming is allowed."""
        taken = {one.name for one in self.entities()}
        if given.name in taken and not given.allow_renaming:
            raise RequestRefused(Refusal.NAME_NOT_UNIQUE, f"there is an entity {given.name!r}; allow renaming")
        if given.name and not _is_free_form(given.name):
            raise RequestRefused(
                Refusal.NAME_INVALID,
                f"name {given.name!r}; give up to 48 letters, digits, _, - or ., but not box_N or bunch_N",
            )
        if not given.name and not given.allow_renaming:
            raise RequestRefused(Refusal.NAME_INVALID, "no name; give one, or allow renaming")
        if given.name and given.name not in taken:
            return given.name
        stem = given.name or f"spawned_{stem}"
        return next(name for i in itertools.count(1) if (name := f"{stem[:40]}_{i}") not in taken)

    def _bunch_to_spawn(self, number: str) -> int:
        """Returns the bunch with the number in a URI; it must hang on its vine."""
        physics = self._client.physics
        model = self._client.model
        attached = physics.state.bunch_attached
        if number:
            if not (number.isdecimal() and len(number) < 10):
                raise RequestRefused(
                    Refusal.RESOURCE_PARSE_ERROR, f"bunch {number!r}; give its index, as {_BUNCH_URI}/17"
                )
            if int(number) >= len(attached) or not attached[int(number)]:
                raise RequestRefused(Refusal.MISSING_ASSETS, f"no bunch {number} hangs on a vine")
            return int(number)
        if not attached.any():
            raise RequestRefused(Refusal.MISSING_ASSETS, "no bunch hangs on a vine")
        where = physics.state.body_q[model.bunch_body, :2]
        robots = np.array([physics.rigid.base_state(name)[0][:2] for name in physics.rigid.robots]).reshape(-1, 2)
        away = np.linalg.norm(where[:, None] - robots, axis=-1).min(1, initial=np.inf)
        return int(np.argmax(np.where(attached, away, -1.0)))

    def _add(self, name: str, one: _Spawned) -> None:
        """Add a spawned entity to the world at its pose of spawning."""
        client = self._client
        physics = self._client.physics
        if one.kind is EntityCategory.DYNAMIC_OBJECT:
            physics.rigid.add_box(one.number, RigidBox(one.pose, np.array(BOX_SIZE), BOX_MASS))
        elif one.kind is EntityCategory.HUMAN:
            spec = HumanSpec(name, label_index(name), standing_pose(one.pose, PERSON_HEIGHT), PERSON_HEIGHT)
            client.add_human(spec, None, MemoryHub().bus(name))
        else:
            physics.pick(one.number)
            physics.support_tracker.set_state(object_id(ObjectKind.BUNCH, one.number), one.pose, np.zeros(6))

    def _upright(self, pose: np.ndarray) -> np.ndarray:
        """Returns the pose on the ground with the same x, y and yaw."""
        level = frames.pose(np.array([pose[0], pose[1], 0.0]), frames.from_yaw(frames.to_yaw(pose[3:])))
        return on_ground(self._client.model.terrain, level)

    def _stand(self, name: str, root: np.ndarray) -> None:
        """Place a spawned person standing at ``root`` [7]."""
        pose = standing_pose(root, PERSON_HEIGHT)
        self._client.humans[name].source = lambda _: pose


def _is_free_form(name: str) -> bool:
    """Returns whether a name is valid and differs from the names of the scene's boxes and bunches."""
    kind, _, number = name.partition("_")
    return is_valid_name(name) and not (kind in ("box", "bunch") and number.isdecimal())


def _checked_pose(pose: np.ndarray | None) -> np.ndarray:
    """Returns a pose [7] with a unit quaternion. Raises :class:`RequestRefused` if ``pose`` is not a pose."""
    if pose is None:
        raise RequestRefused(Refusal.INVALID_POSE, "the pose is not in the frame map, which is the only known frame")
    if not np.isfinite(pose).all() or np.abs(pose[:3]).max() > MAX_DISTANCE:
        raise RequestRefused(Refusal.INVALID_POSE, f"position {pose[:3].tolist()} m; give three numbers up to 10 km")
    if abs(float(np.linalg.norm(pose[3:])) - 1.0) > 1e-3:
        raise RequestRefused(Refusal.INVALID_POSE, f"quaternion {pose[3:].tolist()}; give one of length 1")
    return frames.pose(pose[:3], frames.normalize(pose[3:]))
