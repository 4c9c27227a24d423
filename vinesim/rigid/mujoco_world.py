"""The MuJoCo world that all rigid bodies share: its actors, its compilation and its kinematics.

:class:`RigidWorld` adds the step, and access to robots, people and free bunches.
"""

from __future__ import annotations

import dataclasses
import logging
import threading
import weakref
from collections.abc import Collection, Mapping

import mujoco
import numpy as np

from vinesim.core.warp_arrays import SharedArrays
from vinesim.rigid import collision_geoms, free_bunch, recompile, static_world
from vinesim.rigid.collision_geoms import hull_arrays
from vinesim.rigid.effective_mass import EffectiveMass
from vinesim.rigid.free_bunch import FreeBunch
from vinesim.rigid.ground_contacts import GroundContacts
from vinesim.rigid.human_body import HandBody, HumanBody, HumanError
from vinesim.rigid.human_posture import BODY_PARTS, SIDES, VISUAL_PARTS
from vinesim.rigid.mujoco_contacts import PairFriction, SoftWires, SpeculativeContacts
from vinesim.rigid.recompile import WorldNames
from vinesim.rigid.robot_body import RobotBody
from vinesim.scene import appearance
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import RigidBox, RigidVisual

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class CompiledWorld:
    """A compiled MuJoCo model, with its bodies' names and owners, that is not in use yet."""

    robots: tuple[RobotBody, ...]
    humans: tuple[HumanBody, ...]
    boxes: tuple[int, ...]
    """Numbers of the boxes in the world."""
    bunch_slots: int
    """Number of bodies in the pool for free bunches."""
    mj_model: mujoco.MjModel
    names: WorldNames
    bunches: dict[int, tuple[int, FreeBunch]]
    """Free bunches that already have bodies in the world: index of the body in the pool for free bunches, and shapes,
    by number of the bunch.
    """
    hulls: SharedArrays
    """Convex hulls of all meshes, see :func:`vinesim.rigid.collision_geoms.hull_arrays`."""
    removed: tuple[RobotBody | HumanBody, ...] = ()
    """Actors of the present world that do not exist in the compiled one."""


def _log_mujoco_warnings() -> None:
    """Send MuJoCo's warnings to the log, unless the program has set its own handler.

    Otherwise MuJoCo would write a file ``MUJOCO_LOG.TXT`` into the working folder. MuJoCo reports each kind of warning
    once.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_log.warning)


class MujocoWorld:
    """MuJoCo's model and data and the bodies in them; recompiled when an actor joins or leaves."""

    def __init__(self, model: Model, *, parameters: PhysicsParameters = PhysicsParameters()) -> None:
        self.model = model
        self.parameters = parameters
        self._robots: dict[str, RobotBody] = {}
        self._humans: dict[str, HumanBody] = {}
        self._boxes = static_world.boxes_of(model)
        self._free_bunches: dict[int, FreeBunch] = {}
        self._bunch_slot: dict[int, int] = {}
        """Index in the pool of each free bunch's body, by number of the bunch."""
        self._passing_bunches: set[int] = set()
        """Free bunches that do not collide with fixed pieces, because they have overlapped one ever since they were
        picked."""
        self._derived: weakref.WeakKeyDictionary[FreeBunch, mujoco.MjModel] = weakref.WeakKeyDictionary()
        """Models of single free bunches (:func:`compile_alone`), with the constants that MuJoCo derives for each bunch.
        """
        self._pool_size = 0
        self._static_spec = static_world.build_static_world(model, parameters)
        self._compile_lock = threading.Lock()
        self.mj_model: mujoco.MjModel
        self.mj_data: mujoco.MjData
        self.contact_force: np.ndarray
        """[dof] N or N m, generalised force of all contacts and of remote people in the last step."""
        self._names: WorldNames
        self.generation = 0
        """Counter of changes of MuJoCo's model; views of MuJoCo's arrays must be renewed when it changes."""
        self.owners: dict[int, tuple[str, str]] = {}
        """Actor and link of every MuJoCo body that can be added, removed or moved, as in :class:`RigidGeoms`."""
        self._link_sensors = LinkSensors()
        self._pair_friction = PairFriction(parameters)
        self._speculative_contacts = SpeculativeContacts()
        self._soft_wires: SoftWires | None = None
        self._ground_contacts = None if model.terrain is None else GroundContacts(model.terrain)
        _log_mujoco_warnings()
        self._recompile()

    @property
    def dt(self) -> float:
        """Duration of a step [s], which is constant."""
        return self.parameters.dt

    # ------------------------------------------------------------------ actors

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots in the order in which they joined."""
        return tuple(self._robots)

    @property
    def humans(self) -> tuple[str, ...]:
        """Names of the people in the order in which they joined."""
        return tuple(self._humans)

    @property
    def boxes(self) -> tuple[int, ...]:
        """Numbers of the boxes in the order in which they were added."""
        return tuple(self._boxes)

    @property
    def free_bunches(self) -> tuple[int, ...]:
        """Picked bunches with bodies, in the order in which they were added."""
        return tuple(self._free_bunches)

    @property
    def actors(self) -> tuple[str, ...]:
        """Names of the robots, then of the people."""
        return (*self._robots, *self._humans)

    def robot(self, name: str) -> RobotBody:
        """Returns the body of a robot; ``ValueError`` if no robot has this name."""
        try:
            return self._robots[name]
        except KeyError:
            raise ValueError(f"no robot {name!r} here; there are: {', '.join(self._robots) or 'none'}") from None

    def human(self, name: str) -> HumanBody:
        """Returns the body of a person; :class:`HumanError` if no person has this name."""
        try:
            return self._humans[name]
        except KeyError:
            raise HumanError(f"no human {name!r} here; there are: {', '.join(self._humans) or 'none'}") from None

    def _link_body(self, name: str, link: str) -> int:
        """Returns the MuJoCo body of a robot's link; ``ValueError`` if no link has this name."""
        robot = self.robot(name)
        try:
            return robot.bodies[link]
        except KeyError:
            raise ValueError(f"robot {name!r} has no link {link!r}; it has: {', '.join(robot.bodies)}") from None

    def _body_of_object(self, actor: str, link: str) -> int:
        """Returns the MuJoCo body of an actor's link, of a box (``box/3``), of a free bunch (``bunch/7``) or of the
        ``world``."""
        if actor in self._humans:
            return self._humans[actor].bodies[link]
        if actor in self._robots:
            return self._link_body(actor, link)
        kind, _, number = actor.partition("/")
        if actor == "world":
            return 0
        return self._names.body[free_bunch.slot_name(self._bunch_slot[int(number)]) if kind == "bunch" else actor]

    # ------------------------------------------------------------------ kinematics

    def update_kinematics(self) -> None:
        """Compute MuJoCo's poses (``xpos`` etc.) from the present state, because after a step they are still those at
        the step's start."""
        if not self._kinematics_current:
            mujoco.mj_kinematics(self.mj_model, self.mj_data)
            mujoco.mj_comPos(self.mj_model, self.mj_data)
            self._kinematics_current = True

    def invalidate_kinematics(self) -> None:
        """Mark MuJoCo's poses as out of date, because its state was changed from outside."""
        self._kinematics_current = False

    def link_pose(self, name: str, link: str) -> np.ndarray:
        """Returns the world pose [7] of a link of a robot (including links fixed to their parents) or of a person.

        ``ValueError`` if no link has this name.
        """
        if name in self._humans:
            bodies = self._humans[name].bodies
            if link not in bodies:
                raise HumanError(f"human {name!r} has no link {link!r}; it has: {', '.join(bodies)}")
            body = bodies[link]
        else:
            body = self._link_body(name, link)
        self.update_kinematics()
        w, x, y, z = self.mj_data.xquat[body].tolist()
        return np.array([*self.mj_data.xpos[body].tolist(), x, y, z, w])  # Python floats take half the time

    def visuals(self) -> tuple[RigidVisual, ...]:
        """Returns the visible rigid bodies, each with its shapes. The same tuple object is returned until a body is
        added or removed.
        """
        return self._visuals

    def visual_bodies(self) -> np.ndarray:
        """Returns the MuJoCo bodies [visual] of the visible rigid bodies, in the order of :meth:`visuals`; 0 for arms
        and fingers of people."""
        return self._visual_body

    def visual_q(self) -> np.ndarray:
        """Returns the world poses [visual, 7] of the visible rigid bodies, in the order of :meth:`visuals`."""
        self.update_kinematics()
        d = self.mj_data
        body = self._visual_body
        pose = np.empty((len(body), 7))
        pose[:, :3] = d.xpos[body]
        pose[:, 3:] = d.xquat[body][:, [1, 2, 3, 0]]
        for human in self._humans.values():  # exactly the prescribed poses, because MuJoCo normalises quaternions
            pose[self._visual_row[human.part_bodies]] = human.part_poses
            hands = self._visual_row[[hand.body for hand in human.hands]]
            first = hands[-1] + 1
            placed = human.visual_poses(pose[hands])
            pose[first : first + len(placed)] = placed
        return pose

    # ------------------------------------------------------------------ compilation

    def _compile_world(self, robots: tuple[RobotBody, ...], humans: tuple[HumanBody, ...]) -> CompiledWorld:
        """Compile a world with these actors and a pool of bodies for free bunches. The world in use does not change."""
        # a copy, because another thread may step the world meanwhile
        slot_of = dict(self._bunch_slot)
        bodies = dict(self._free_bunches)
        slots = max(slot_of.values(), default=-1) + 1 + self.parameters.bunch_pool_size
        bunches = {bunch: (slot_of[bunch], body) for bunch, body in bodies.items() if bunch in slot_of}
        with self._compile_lock:
            spec = self._static_spec.copy()
            boxes = self.boxes
            for robot in robots:
                robot.add_to(spec)
            for human in humans:
                human.add_to(spec)
            for slot in range(slots):
                free_bunch.add_slot(spec, slot)
            mj_model = recompile.compile_without_contacts(spec)
        # MuJoCo's solver tolerance is relative to this number, so an actor that joins would change all other results
        mj_model.stat.meaninertia = 1.0
        for slot in range(slots):
            free_bunch.disable_collision(mj_model, slot)
        for slot, body in bunches.values():
            free_bunch.activate(mj_model, slot, body, self._derive(body))
        hulls = hull_arrays(mj_model, self.model.terrain)
        return CompiledWorld(robots, humans, boxes, slots, mj_model, WorldNames.of(mj_model), bunches, hulls)

    def _derive(self, body: FreeBunch) -> mujoco.MjModel:
        """Returns MuJoCo's constants of a free bunch, computed once; ``ValueError`` if it has too many shapes or
        none."""
        derived = self._derived.get(body)
        if derived is None:
            derived = self._derived[body] = free_bunch.compile_alone(body, self.parameters)
        return derived

    def _recompile(self) -> None:
        """Recompile the world with the present actors."""
        self._replace_world(self._compile_world(tuple(self._robots.values()), tuple(self._humans.values())))

    def _replace_world(self, compiled: CompiledWorld) -> None:
        """Use another compiled world and transfer the states of all joints and bodies by their names."""
        before = (self.mj_model, self._names, self.mj_data, self.contact_force) if self.generation else None
        self.mj_model = compiled.mj_model
        self._names = compiled.names
        self._pool_size = compiled.bunch_slots
        m = self.mj_model
        self.hulls = compiled.hulls
        for bunch, (slot, body) in compiled.bunches.items():
            if self._free_bunches.get(bunch) is not body or self._bunch_slot[bunch] != slot:
                free_bunch.disable_collision(m, slot)  # it was removed meanwhile
        for bunch, body in self._free_bunches.items():
            slot = self._bunch_slot[bunch]
            if compiled.bunches.get(bunch) != (slot, body):
                free_bunch.activate(m, slot, body, self._derive(body))
        if before is None:
            self.mj_data = mujoco.MjData(m)
            self.contact_force = np.zeros(m.nv)
        else:
            slots = set(range(self._pool_size)) - set(self._bunch_slot.values())
            unused = {free_bunch.slot_name(slot) for slot in slots}
            self.mj_data, self.contact_force = recompile.transfer_state(*before, m, self._names, unused)
        self._effective_mass = EffectiveMass(m)
        self._valid_qpos = self.mj_data.qpos.copy()
        self._kinematics_current = False
        for actor in (*self._robots.values(), *self._humans.values()):
            actor.find_indices(m, self._names)
        self._link_sensors.find_indices(m, self._robots)
        self._pair_friction.find_materials(m)
        self._speculative_contacts.find_crates(m, self._boxes)
        if self._soft_wires is not None:
            self._soft_wires.use_world(m)
        for human in self._humans.values():
            for hand in human.hands:
                self._restore_grasp(hand)
        if before is None:
            self.static_geoms = collision_geoms.static_geoms(m, self.model.terrain)
        self._update_tables()

    def _restore_grasp(self, hand: HandBody) -> None:
        """In a recompiled world, weld a hand to the object that it holds, if the object still exists."""
        if hand.held is None:
            return
        try:
            body = None if hand.on_plant else self._body_of_object(*hand.held)
        except (KeyError, ValueError):
            hand.release(self.mj_model, self.mj_data)
        else:
            hand.weld_to(self.mj_model, self.mj_data, body)

    def _update_tables(self) -> None:
        """Update the lists of bodies and geoms after bodies were added or removed, and increment :attr:`generation`."""
        bunch_body = self._list_visuals()
        self.owners = list_owners(self._boxes, self._names, self._robots, self._humans, bunch_body)
        self._owned_geoms = collision_geoms.owned_geoms(self.mj_model, self.owners)
        self._update_geoms()

    def _list_visuals(self) -> dict[int, int]:
        """Update the list of visible bodies, after bodies were added or removed, or a hand took or put away shears.

        Returns the MuJoCo body of every free bunch, by number of the bunch.
        """
        bunch_body = {i: self._names.body[free_bunch.slot_name(slot)] for i, slot in self._bunch_slot.items()}
        bunches = {i: (body, bunch_body[i]) for i, body in self._free_bunches.items()}
        self._visuals, self._visual_body = list_visuals(self._boxes, self._names, self._robots, self._humans, bunches)
        self._visual_row = np.zeros(self.mj_model.nbody, int)
        own = self._visual_body > 0
        self._visual_row[self._visual_body[own]] = np.flatnonzero(own)
        return bunch_body

    def _show_lamps(self, robot: RobotBody) -> None:
        """Set the visible shapes of a robot again after its indicator lights changed."""
        prefix = robot.spec.name + "/"
        shown = robot.shown_shapes
        self._visuals = tuple(
            dataclasses.replace(one, shapes=shown[one.name.removeprefix(prefix)])
            if one.name.startswith(prefix) and one.organ == Organ.ROBOT
            else one
            for one in self._visuals
        )

    def _update_geoms(self) -> None:
        """Update the list of colliding geoms after a hand closed or opened, and increment :attr:`generation`."""
        self.generation += 1
        if self._ground_contacts is not None:
            self._ground_contacts.use_world()
        self.geoms = collision_geoms.colliding(self.mj_model, self._owned_geoms)


# Tables of a compiled MuJoCo world: visible bodies, and the owner of each body.


def list_visuals(
    boxes: Mapping[int, RigidBox],
    names: WorldNames,
    robots: Mapping[str, RobotBody],
    humans: Mapping[str, HumanBody],
    bunches: Mapping[int, tuple[FreeBunch, int]],
) -> tuple[tuple[RigidVisual, ...], np.ndarray]:
    """Returns all rigid bodies with visible shapes (``RigidVisual``), and the MuJoCo body [visual] of each.

    The MuJoCo body is 0 for arms and fingers of people, whose poses :class:`PostureSolver` computes. ``bunches``:
    shapes and MuJoCo body of every free bunch.
    """
    visuals = []
    bodies = []
    for number, box in boxes.items():
        length, width, height = map(float, box.size)
        shapes = appearance.crate_shapes((length, width, height), number)
        visuals.append(RigidVisual(f"box/{number}", Organ.BOX, number, shapes))
        bodies.append(names.body[f"box/{number}"])
    for name, robot in robots.items():
        for link, shapes in robot.shown_shapes.items():
            if shapes:
                visuals.append(RigidVisual(f"{name}/{link}", Organ.ROBOT, robot.spec.index, shapes))
                bodies.append(robot.bodies[link])
    shears = {f"{side}_{part}": shapes for side in SIDES for part, shapes in appearance.load_shears().parts.items()}
    for name, human in humans.items():
        shapes_of_part = human.looks.parts | shears
        simulated = [(part, human.bodies[part]) for part in (*BODY_PARTS, *(hand.link for hand in human.hands))]
        for part, body in (*simulated, *((part, 0) for part in (*VISUAL_PARTS, *human.shears_parts))):
            visuals.append(RigidVisual(f"{name}/{part}", Organ.HUMAN, human.spec.index, shapes_of_part[part]))
            bodies.append(body)
    for bunch, (free, body) in bunches.items():
        visuals.append(RigidVisual(f"bunch/{bunch}", Organ.BUNCH, bunch, free.shapes, free.stalk))
        bodies.append(body)
    return tuple(visuals), np.array(bodies, int)


def list_owners(
    boxes: Collection[int],
    names: WorldNames,
    robots: Mapping[str, RobotBody],
    humans: Mapping[str, HumanBody],
    bunch_body: Mapping[int, int],
) -> dict[int, tuple[str, str]]:
    """Returns the actor and link of every MuJoCo body that can be added, removed or moved."""
    owners = {names.body[f"box/{i}"]: (f"box/{i}", "box") for i in boxes}
    actors: dict[str, RobotBody | HumanBody] = {**robots, **humans}
    for name, actor in actors.items():
        owners.update({body: (name, link) for link, body in actor.bodies.items()})
    owners.update({body: (f"bunch/{i}", "bunch") for i, body in bunch_body.items()})
    return owners


# Force-torque sensors and accelerometers in links of robots, measured in every step for all sensors at once.


class LinkSensors:
    """Measurements of all sensors in links of robots (wrench on the parent link, acceleration) in the last step.

    Arrays have one row for each sensor. Frames are those at the start of the step.
    """

    def __init__(self) -> None:
        self._row: dict[tuple[str, str], int] = {}
        """Row of a sensor, by robot and link."""
        self._body = self._root = np.zeros(0, int)
        """[sensor] MuJoCo index of the root body of the sensor's robot. ``_body`` [sensor]: MuJoCo index of the
        sensor's link.
        """
        self._wrench = np.zeros((0, 6))
        """[sensor, 6] N m, N, moment about ``_com`` and force that the parent link exerts on the link, world axes."""
        self._com = np.zeros((0, 3))
        """[sensor, 3] m, centre of mass of the robot in the world."""
        self._position = np.zeros((0, 3))
        """[sensor, 3] m, position of the link in the world."""
        self._rotation = np.zeros((0, 9))
        """[sensor, 9] rotation matrix of the link in the world, row by row."""
        self._acceleration = np.zeros((0, 6))
        """[sensor, 6] rad/s^2, m/s^2, result of :meth:`acceleration`."""

    def find_indices(self, m: mujoco.MjModel, robots: Mapping[str, RobotBody]) -> None:
        """Look up the links with sensors in a recompiled world. Measurements of the last step are kept."""
        keys = [(name, link) for name, robot in robots.items() for link in robot.sensor_links]
        kept = np.array([self._row.get(key, -1) for key in keys], int)
        for name in ("_wrench", "_com", "_position", "_rotation", "_acceleration"):
            before: np.ndarray = getattr(self, name)
            after = np.zeros((len(keys), before.shape[1]))
            after[kept >= 0] = before[kept[kept >= 0]]
            setattr(self, name, after)
        self._rotation[kept < 0] = np.eye(3).ravel()
        self._row = {key: row for row, key in enumerate(keys)}
        self._body = np.array([robots[name].bodies[link] for name, link in keys], int)
        self._root = m.body_rootid[self._body]

    def measure(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """Store the measurements of all sensors. Call it at the end of a step, while MuJoCo's poses are still those of
        the start of the step.
        """
        body = self._body
        if not len(body):
            return
        mujoco.mj_rnePostConstraint(m, d)
        self._wrench = d.cfrc_int[body]
        self._com = d.subtree_com[self._root]
        self._position = d.xpos[body]
        self._rotation = d.xmat[body]
        for row, link in enumerate(body.tolist()):
            mujoco.mj_objectAcceleration(m, d, mujoco.mjtObj.mjOBJ_XBODY, link, self._acceleration[row], 1)

    def wrench(self, robot: str, link: str) -> np.ndarray:
        """Returns the wrench [6] that a link exerts on its parent link: force [N], and moment [N m] about the link's
        origin, in the link's axes."""
        row = self._find(robot, link)
        (x, y, z) = (self._com[row] - self._position[row]).tolist()
        (u, v, w) = self._wrench[row, 3:].tolist()
        moment = self._wrench[row, :3] + np.array([y * w - z * v, z * u - x * w, x * v - y * u])
        rotation = self._rotation[row].reshape(3, 3)
        return -np.concatenate([self._wrench[row, 3:] @ rotation, moment @ rotation])

    def acceleration(self, robot: str, link: str) -> np.ndarray:
        """Returns angular acceleration [rad/s^2] and proper linear acceleration [m/s^2] of a link's origin [6], in the
        link's axes. Proper acceleration includes gravity, as an accelerometer measures it."""
        return self._acceleration[self._find(robot, link)].copy()

    def _find(self, robot: str, link: str) -> int:
        try:
            return self._row[robot, link]
        except KeyError:
            raise ValueError(f"link {link!r} of robot {robot!r} has no sensor; call add_link_sensor() first") from None
