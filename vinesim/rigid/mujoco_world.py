"""The MuJoCo world that all rigid bodies share: its actors, its compilation and its kinematics.

:class:`RigidWorld` adds the step; the classes between them add the access to robots, people and free bunches.
"""

from __future__ import annotations

import dataclasses
import logging
import threading
import weakref

import mujoco
import numpy as np

from vinesim.core.warp_arrays import SharedArrays
from vinesim.rigid import collision_geoms, free_bunch, recompile, static_world
from vinesim.rigid.body_tables import list_owners, list_visuals
from vinesim.rigid.effective_mass import EffectiveMass
from vinesim.rigid.free_bunch import FreeBunch
from vinesim.rigid.hand_body import HandBody
from vinesim.rigid.hulls import hull_arrays
from vinesim.rigid.human_body import HumanBody, HumanError
from vinesim.rigid.link_sensors import LinkSensors
from vinesim.rigid.pair_friction import PairFriction
from vinesim.rigid.recompile import WorldNames
from vinesim.rigid.robot_body import RobotBody
from vinesim.rigid.speculative_contacts import SpeculativeContacts
from vinesim.rigid.wire_contacts import SoftWires
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import RigidVisual

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class CompiledWorld:
    """A compiled MuJoCo model that is not in use yet."""

    robots: tuple[RobotBody, ...]
    humans: tuple[HumanBody, ...]
    boxes: tuple[int, ...]
    """Numbers of the boxes in it."""
    bunch_slots: int
    """Number of free bunches that it has bodies for."""
    mj_model: mujoco.MjModel
    names: WorldNames
    bunches: dict[int, tuple[int, FreeBunch]]
    """Free bunches that have bodies in it already, each with its slot."""
    hulls: SharedArrays
    """See :func:`vinesim.rigid.hulls.hull_arrays`."""
    removed: tuple[RobotBody | HumanBody, ...] = ()
    """Actors of the present world that it is made without."""


def _log_mujoco_warnings() -> None:
    """Let MuJoCo's warnings go to the log, unless the program handles them: MuJoCo itself would write a file
    ``MUJOCO_LOG.TXT`` into the working folder. It warns once of each kind."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_log.warning)


class WorldCore:
    """MuJoCo's model and data, and what they contain; compiled anew when an actor joins or leaves."""

    def __init__(self, model: Model, *, parameters: PhysicsParameters = PhysicsParameters()) -> None:
        self.model = model
        self.parameters = parameters
        self._robots: dict[str, RobotBody] = {}
        self._humans: dict[str, HumanBody] = {}
        self._boxes = static_world.boxes_of(model)
        self._free_bunches: dict[int, FreeBunch] = {}
        self._bunch_slot: dict[int, int] = {}
        """By free bunch: the number of its body in the pool."""
        self._passing_bunches: set[int] = set()
        """Free bunches that touch no fixed piece: they overlapped one when they were picked, and still do."""
        self._derived: weakref.WeakKeyDictionary[FreeBunch, mujoco.MjModel] = weakref.WeakKeyDictionary()
        """Constants that MuJoCo derives from the mass and shapes of each free bunch."""
        self._pool_size = 0
        self._static_spec = static_world.build_static_world(model, parameters)
        self._compile_lock = threading.Lock()
        self.mj_model: mujoco.MjModel
        self.mj_data: mujoco.MjData
        self.contact_force: np.ndarray
        """[dof] N or N m: generalised force of all contacts and of remote people in the last step."""
        self._names: WorldNames
        self.generation = 0
        """Counts changes of MuJoCo's model: views of its arrays must be renewed when this changes."""
        self.owners: dict[int, tuple[str, str]] = {}
        """Actor and link of every MuJoCo body that can be added, removed or moved, as in :class:`RigidGeoms`."""
        self._link_sensors = LinkSensors()
        self._pair_friction = PairFriction(parameters)
        self._speculative_contacts = SpeculativeContacts()
        self._soft_wires: SoftWires | None = None
        _log_mujoco_warnings()
        self._recompile()

    @property
    def dt(self) -> float:
        """[s] Duration of a step; fixed."""
        return self.parameters.dt

    # ------------------------------------------------------------------ actors

    @property
    def robots(self) -> tuple[str, ...]:
        """Names in the order in which they joined."""
        return tuple(self._robots)

    @property
    def humans(self) -> tuple[str, ...]:
        """Names in the order in which they joined."""
        return tuple(self._humans)

    @property
    def boxes(self) -> tuple[int, ...]:
        """Numbers of the boxes that are here, in the order in which they came."""
        return tuple(self._boxes)

    @property
    def free_bunches(self) -> tuple[int, ...]:
        """Bunches that lie, fall or are held, in the order in which they left their vines."""
        return tuple(self._free_bunches)

    @property
    def actors(self) -> tuple[str, ...]:
        """Names of robots, then of people."""
        return (*self._robots, *self._humans)

    def robot(self, name: str) -> RobotBody:
        """The body of a robot; ``ValueError`` if there is none of this name."""
        try:
            return self._robots[name]
        except KeyError:
            raise ValueError(f"no robot {name!r} here; there are: {', '.join(self._robots) or 'none'}") from None

    def human(self, name: str) -> HumanBody:
        """The body of a person; :class:`HumanError` if there is none of this name."""
        try:
            return self._humans[name]
        except KeyError:
            raise HumanError(f"no human {name!r} here; there are: {', '.join(self._humans) or 'none'}") from None

    def _link_body(self, name: str, link: str) -> int:
        """MuJoCo body of a robot's link; ``ValueError`` if there is none of this name."""
        robot = self.robot(name)
        try:
            return robot.bodies[link]
        except KeyError:
            raise ValueError(f"robot {name!r} has no link {link!r}; it has: {', '.join(robot.bodies)}") from None

    def _body_of_object(self, actor: str, link: str) -> int:
        """MuJoCo body of a link of an actor, of a box (``box/3``), of a free bunch (``bunch/7``) or of the
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
        """Compute MuJoCo's poses from the present state: after a step they are those of the step's start."""
        if not self._kinematics_current:
            mujoco.mj_kinematics(self.mj_model, self.mj_data)
            mujoco.mj_comPos(self.mj_model, self.mj_data)
            self._kinematics_current = True

    def invalidate_kinematics(self) -> None:
        """Note that MuJoCo's state was changed from outside: its poses must be computed anew."""
        self._kinematics_current = False

    def link_pose(self, name: str, link: str) -> np.ndarray:
        """World pose [7] of a robot's link, also of one that is fixed to its parent, or of a person's.

        ``ValueError`` if there is none of this name.
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
        return np.array([*self.mj_data.xpos[body].tolist(), x, y, z, w])  # in Python floats: half the time

    def visuals(self) -> tuple[RigidVisual, ...]:
        """All rigid bodies that have a shape; the same tuple until one is added or removed."""
        return self._visuals

    def visual_q(self) -> np.ndarray:
        """World poses [visual, 7] of :meth:`visuals`."""
        self.update_kinematics()
        d = self.mj_data
        body = self._visual_body
        pose = np.empty((len(body), 7))
        pose[:, :3] = d.xpos[body]
        pose[:, 3:] = d.xquat[body][:, [1, 2, 3, 0]]
        for human in self._humans.values():  # exactly as prescribed: MuJoCo normalises quaternions
            pose[self._visual_row[human.part_bodies]] = human.part_poses
            hands = self._visual_row[[hand.body for hand in human.hands]]
            first = hands[-1] + 1
            placed = human.visual_poses(pose[hands])
            pose[first : first + len(placed)] = placed
        return pose

    # ------------------------------------------------------------------ compilation

    def _compile_world(self, robots: tuple[RobotBody, ...], humans: tuple[HumanBody, ...]) -> CompiledWorld:
        """Compile a world with these actors and a pool of bodies for free bunches; the world in use is not changed."""
        # steps may go on meanwhile
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
        # MuJoCo's solver tolerance is relative to it: an actor that joins would change when the solver stops for all
        # others
        mj_model.stat.meaninertia = 1.0
        for slot in range(slots):
            free_bunch.disable_collision(mj_model, slot)
        for slot, body in bunches.values():
            free_bunch.activate(mj_model, slot, body, self._derive(body))
        return CompiledWorld(
            robots, humans, boxes, slots, mj_model, WorldNames.of(mj_model), bunches, hull_arrays(mj_model)
        )

    def _derive(self, body: FreeBunch) -> mujoco.MjModel:
        """Constants of a free bunch; ``ValueError`` if it has too many shapes or none."""
        derived = self._derived.get(body)
        if derived is None:
            derived = self._derived[body] = free_bunch.compile_alone(body, self.parameters)
        return derived

    def _recompile(self) -> None:
        """Compile the world anew with the present actors and use it."""
        self._replace_world(self._compile_world(tuple(self._robots.values()), tuple(self._humans.values())))

    def _replace_world(self, compiled: CompiledWorld) -> None:
        """Use another compiled world; the state of every joint and body is transferred by its name."""
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
            self.static_geoms = collision_geoms.static_geoms(m)
        self._update_tables()

    def _restore_grasp(self, hand: HandBody) -> None:
        """Weld a hand in a world that was compiled anew to what it holds, if that still exists."""
        if hand.held is None:
            return
        try:
            body = None if hand.on_plant else self._body_of_object(*hand.held)
        except (KeyError, ValueError):
            hand.release(self.mj_model, self.mj_data)
        else:
            hand.weld_to(self.mj_model, self.mj_data, body)

    def _update_tables(self) -> None:
        """List all bodies and geoms anew after bodies were added or removed, and count :attr:`generation`."""
        bunch_body = self._list_visuals()
        self.owners = list_owners(self._boxes, self._names, self._robots, self._humans, bunch_body)
        self._owned_geoms = collision_geoms.owned_geoms(self.mj_model, self.owners)
        self._update_geoms()

    def _list_visuals(self) -> dict[int, int]:
        """List what sensors draw anew after bodies were added or removed, or a hand took shears or put them away; the
        MuJoCo body of every free bunch."""
        bunch_body = {i: self._names.body[free_bunch.slot_name(slot)] for i, slot in self._bunch_slot.items()}
        bunches = {i: (body, bunch_body[i]) for i, body in self._free_bunches.items()}
        self._visuals, self._visual_body = list_visuals(self._boxes, self._names, self._robots, self._humans, bunches)
        self._visual_row = np.zeros(self.mj_model.nbody, int)
        own = self._visual_body > 0
        self._visual_row[self._visual_body[own]] = np.flatnonzero(own)
        return bunch_body

    def _show_lamps(self, robot: RobotBody) -> None:
        """List the shapes of a robot anew after its indicator lights changed; only sensors need to know."""
        prefix = robot.spec.name + "/"
        shown = robot.shown_shapes
        self._visuals = tuple(
            dataclasses.replace(one, shapes=shown[one.name.removeprefix(prefix)])
            if one.name.startswith(prefix) and one.organ == Organ.ROBOT
            else one
            for one in self._visuals
        )

    def _update_geoms(self) -> None:
        """List the geoms that collide anew after a hand closed or opened, and count :attr:`generation`."""
        self.generation += 1
        self.geoms = collision_geoms.colliding(self.mj_model, self._owned_geoms)
