"""One simulation in one object: plants, robots, contacts, energy.

    simulation = Simulation(CaneBuilder(tip_mass=0.1, damping_ratio=0.05))
    simulation.step(500)
    print(simulation.tip(), simulation.energy().total)

Positions are in m, forces in N, in world axes (:mod:`vinesim.core.frames`).
"""

from __future__ import annotations

import functools
import math
import numbers
import pathlib
import warnings
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Literal

import msgspec
import numpy as np

from vinesim.api.energy import Energy, Momentum, energy, momentum
from vinesim.api.plant_work import Binding, Hold
from vinesim.api.pusher import Pusher, checked_shape
from vinesim.client.faults import FaultLog, occurred
from vinesim.contact.bud_forces import bud_forces
from vinesim.core import frames, progress
from vinesim.core.errors import UsageError, checked_index
from vinesim.core.numbers import as_numbers, checked_vector, is_number, is_whole
from vinesim.interaction.blades import Blade
from vinesim.interaction.cutting_force import BLADE_FACTORS
from vinesim.interaction.handwork import nearest_place
from vinesim.kernels.compilation import PHYSICS_PACKAGES, compile_kernels
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.builder import TreeBuilder
from vinesim.scene.cane import CaneBuilder, assemble
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spec import Scene, load_scene
from vinesim.scene.state import State
from vinesim.scene.surroundings import Box, main_axis
from vinesim.scene.terrain import Terrain, on_ground
from vinesim.scene.values import (
    BladeClosing,
    Breakage,
    BunchHistory,
    Contact,
    Detachment,
    FruitEvent,
    RigidBox,
    Snapshot,
    WireBreak,
)
from vinesim.scene.wind import Wind, wind_of
from vinesim.wind.sway import Sway
from vinesim.world import Physics

if TYPE_CHECKING:
    from vinesim.sensors.primitives.scene_primitives import Primitives

Source = Model | Scene | str | pathlib.Path | CaneBuilder | TreeBuilder | Iterable[CaneBuilder | TreeBuilder]
"""Types that :class:`Simulation` accepts: a model; a scene; the name of a scene in ``data/scenes`` or the path of a
scene file; one or more builders of canes or trees."""


@functools.cache
def _compile_kernels() -> None:
    """Wait until the kernels of the physics are compiled, with a message; once in a process."""
    progress.show_by_default()
    compile_kernels(PHYSICS_PACKAGES)


class Simulation:
    """A world that moves when :meth:`step` is called; nothing runs in the background.

    Plants consist of *trees*: kinematic trees of rigid bodies, such as a cane with its leaves and bunches. Trees in
    equilibrium start asleep, all other trees awake. A sleeping tree does not move and costs no time. A tree falls
    asleep when it has come to rest (see ``sleep_distance`` and related fields of ``parameters``) and wakes when
    something touches it.
    """

    def __init__(
        self,
        source: Source,
        *,
        dt: float | None = None,
        parameters: PhysicsParameters | None = None,
        sleep: bool | None = None,
        detach: bool = True,
        device: str = "cpu",
    ) -> None:
        """Build the world; it does not move until :meth:`step`.

        The first simulation on a computer waits until its kernels are compiled, and shows that on standard error.

        Args:
            source: see :data:`Source`. A scene provides its physics parameters and its wind.
            dt: duration of a step [s], 0.01 unless given here or in ``parameters``.
            parameters: all numbers of the physics; they replace the parameters of the scene.
            sleep: whether trees at rest fall asleep, which saves time; it replaces ``parameters.sleep``.
            detach: whether bunches detach when they are pulled too hard, and wood and ties give.
            device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``, for stepping plants and for cameras and lidars.
        """
        if not isinstance(detach, bool):
            raise UsageError(f"detach is {detach!r}; give True or False")
        _compile_kernels()
        self.scene: Scene | None = None
        """The simulated scene; None for a model or canes."""
        if isinstance(source, (str, pathlib.Path)):
            source = load_scene(source)
        if isinstance(source, Scene):
            self.scene = source
        model = model_of(source)
        if parameters is not None and not isinstance(parameters, PhysicsParameters):
            raise UsageError(f"parameters is a {type(parameters).__name__}; give PhysicsParameters, or none")
        chosen = parameters or (self.scene.physics if self.scene else PhysicsParameters())
        changes = {name: value for name, value in (("dt", dt), ("sleep", sleep)) if value is not None}
        self.parameters: PhysicsParameters = msgspec.structs.replace(chosen, **changes)
        """All numbers of the physics. They cannot be changed after the simulation was made."""
        self.device = device
        """Device for stepping plants and for sensors."""
        self.physics = Physics(model, parameters=self.parameters, device=device, detachment=detach)
        """The underlying physics, for functions that this class does not offer."""
        self.robots: dict[str, Robot] = {}
        """Robots by name; their commands take effect in the next step."""
        self.pushers: dict[str, Pusher] = {}
        """Bodies of :meth:`add_pusher`, by name."""
        self._robots_added = 0
        if self.scene is not None:
            self.physics.wind = wind_of(self.scene)
        self._loads: dict[int, np.ndarray] = {}
        self._pushed: set[tuple[str, str]] = set()
        self._detachments: list[Detachment] = []
        self._breakages: list[Breakage] = []
        self._closings: list[BladeClosing] = []
        self._wire_breaks: list[WireBreak] = []
        self._fruit_events: list[FruitEvent] = []
        self._holds: list[Hold] = []
        self._primitives: Primitives | None = None
        self._sway = Sway(model)
        self._fault_log = FaultLog(_warn_caller_of_step)
        self.physics.sleep_monitor.wake_unbalanced()

    # ------------------------------------------------------------------ time

    def step(self, count: int = 1) -> None:
        """Advance by ``count`` steps of :attr:`dt`. Wrenches of :meth:`apply_wrench` and :meth:`push_robot` act in all
        these steps and then end.

        At the first fault of each kind (see :attr:`faults`), a ``RuntimeWarning`` says what happened.
        """
        if not is_whole(count) or count < 0:
            raise UsageError(f"count is {count}; give a whole number of steps, 0 or more")
        self._check_joints(self.physics.plants.awake)
        self._detachments = []
        self._breakages = []
        self._closings = []
        self._wire_breaks = []
        self._fruit_events = []
        for name in self.robots.keys() - set(self.physics.rigid.robots):  # robots that are no longer in the physics
            self._forget_robot(name)
        for _ in range(count):
            for robot in self.robots.values():
                robot.control(self.physics.time)
            for pusher in self.pushers.values():
                pusher.control()
            for held in self._holds:
                held.control()
            self.physics.step()
            self._detachments += self.physics.detachments
            self._breakages += self.physics.detachment_monitor.breakages
            self._closings += self.physics.closings
            self._wire_breaks += self.physics.wire_breaks
            self._fruit_events += self.physics.fruit_monitor.events
        for body, before in self._loads.items():
            self.physics.plants.body_load[body] = before
        if self._loads:  # a tree that fell asleep under its load must move again
            self.physics.wake(np.unique(self.model.body_tree[list(self._loads)]))
        self._loads.clear()
        for robot, link in self._pushed:
            self.physics.rigid.apply_wrench(robot, link, np.zeros(3))
        self._pushed.clear()
        self._fault_log.update(self.faults, self.time)

    @property
    def time(self) -> float:
        """[s] Simulated time since the start."""
        return self.physics.time

    @property
    def dt(self) -> float:
        """[s] Duration of a step."""
        return self.physics.dt

    # ------------------------------------------------------------------ state

    @property
    def model(self) -> Model:
        """Constants of the plants: masses, springs, topology."""
        return self.physics.model

    @property
    def state(self) -> State:
        """State of the plants at the current time; shapes and units in :class:`~vinesim.scene.state.State`.

        Joint rotations and rates may be written; call :meth:`wake` afterwards.
        """
        self.physics.update_kinematics()
        return self.physics.state

    @property
    def awake(self) -> np.ndarray:
        """[k] Indices of the awake trees (the trees that the next step moves), sorted."""
        return self.physics.plants.awake.copy()

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Contacts of robots, boxes and people with plants in the last step, each with position [3] m and force [3]
        N."""
        return self.physics.contacts

    @property
    def bud_forces(self) -> np.ndarray:
        """[bud] N, force on each bud of dormant canes in the last step: the sum of the magnitudes of the forces of
        contacts at its place along the cane. The id of a bud is its index; :attr:`~vinesim.scene.model.Model.nodes`
        tells where buds are."""
        return bud_forces(self.model, self.state, self.contacts)

    @property
    def detachments(self) -> tuple[Detachment, ...]:
        """Bunches and canes that left their plant in the last call of :meth:`step`."""
        return tuple(self._detachments)

    @property
    def breakages(self) -> tuple[Breakage, ...]:
        """What gave without parting in the last call of :meth:`step`: canes that cracked, ties that slipped or
        broke."""
        return tuple(self._breakages)

    @property
    def closings(self) -> tuple[BladeClosing, ...]:
        """Closings of blades that ended in the last call of :meth:`step`: force, energy, depth, and why a blade did not
        close."""
        return tuple(self._closings)

    @property
    def wire_breaks(self) -> tuple[WireBreak, ...]:
        """Pieces of wire that broke in the last call of :meth:`step`: tension [N], and the ties that they held."""
        return tuple(self._wire_breaks)

    @property
    def fruit_events(self) -> tuple[FruitEvent, ...]:
        """Falls of bunches, and berries that burst or fell off, in the last call of :meth:`step`."""
        return tuple(self._fruit_events)

    def bunch_history(self, bunch: int) -> BunchHistory:
        """Returns what has happened to a bunch since the start: forces, pressure, drops, time in hands, berries burst
        and lost. ``bunch``: index in the model."""
        return self.physics.fruit_monitor.history(checked_index("bunch", bunch, len(self.model.bunch_body), UsageError))

    @property
    def faults(self) -> dict[str, int]:
        """Number of faults since the start, by kind; empty if none occurred. After a fault the motion is not that of
        the model: results may be wrong.

        Kinds: ``trees_stopped`` and ``robots_stopped`` (too fast or not finite, so put at rest), ``trees_slowed`` (in
        how many steps a joint of a tree exceeded ``max_joint_rate``), ``contacts_dropped`` (more than the capacity),
        ``geoms_skipped`` (static objects near a tree, more than ``max_static_geoms_per_tree``), ``grasps_refused``.
        """
        return occurred(self.physics.faults)

    def energy(self, tree: int | None = None) -> Energy:
        """Returns the kinetic, elastic and gravitational energy [J] of the plants, or of one tree."""
        self.physics.update_kinematics()
        return energy(self.physics.plants, self.parameters.gravity, self._one(tree))

    def momentum(self, tree: int | None = None) -> Momentum:
        """Returns the linear [kg m/s] and the angular momentum about the world's origin [kg m^2/s] of the plants, or of
        one tree."""
        self.physics.update_kinematics()
        return momentum(self.physics.plants, self._one(tree))

    def body_pose(self, body: int) -> np.ndarray:
        """Returns the pose [7] (m, quaternion xyzw) of a body of a plant in the world at the current time. ``body``:
        index in the model."""
        body = self._body(body)
        return self.state.body_q[body].astype(float)

    def tip(self, tree: int = 0) -> np.ndarray:
        """Returns the position [3] m of the tip of a tree's main axis in the world at the current time."""
        body = self.tip_body(tree)
        pose = self.body_pose(body)
        return pose[:3] + frames.rotate(pose[3:], np.array([float(self.model.body_length[body]), 0.0, 0.0]))

    def tip_body(self, tree: int = 0) -> int:
        """Returns the index of the last body of a tree's main axis. From its root, the main axis continues with the
        first child of each body that is a segment of cane."""
        return main_axis(self.model, self._tree(tree))[-1]

    def snapshot(self) -> Snapshot:
        """Returns the whole world at the current time, for sensors. The returned snapshot does not change when the
        simulation steps."""
        return self.physics.snapshot()

    # ------------------------------------------------------------------ actions

    def wake(self, tree: int | None = None) -> None:
        """Wake a tree, or all trees, for the next step. Call it after joint rotations were written.

        Raises :class:`UsageError` if a joint rotation is not a unit quaternion, or a joint rate is not finite.
        """
        trees = np.arange(len(self.model.tree_first)) if tree is None else np.array([self._tree(tree)])
        self._check_joints(trees)
        self.physics.wake(trees)

    def apply_wrench(
        self,
        body: int,
        force: Sequence[float] | np.ndarray,
        torque: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
        at: Sequence[float] | np.ndarray | None = None,
    ) -> None:
        """Push a plant's body during the next call of :meth:`step`. Several wrenches add up. The body's tree wakes.

        Args:
            body: index of the body in the model.
            force: [3] N, world axes.
            torque: [3] N m, world axes.
            at: [3] m in the world, the point where the force acts; the body's centre of mass unless given.
        """
        body = self._body(body)
        force = checked_vector("force", force, "N", UsageError)
        torque = checked_vector("torque", torque, "N m", UsageError)
        pose = self.body_pose(body)
        point = pose[:3] + frames.rotate(pose[3:], self.physics.plants.body_com[body].astype(float))
        if at is not None:
            point = checked_vector("at", at, "m", UsageError)
        load = self.physics.plants.body_load
        self._loads.setdefault(body, load[body].copy())
        load[body] += np.concatenate([force, torque + np.cross(point - pose[:3], force)]).astype(load.dtype)
        self.wake(int(self.model.body_tree[body]))

    def push_robot(
        self,
        robot: str,
        link: str,
        force: Sequence[float] | np.ndarray,
        torque: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
        at: Sequence[float] | np.ndarray | None = None,
    ) -> None:
        """Push a link of a robot during the next call of :meth:`step`, as a person's hand would.

        Args:
            robot: name of the robot.
            link: name of a link of its URDF; ``RobotError`` if there is none of that name.
            force: [3] N, world axes; replaces the force of an earlier call for this link.
            torque: [3] N m, world axes.
            at: [3] m in the world, the point where the force acts; the link's centre of mass unless given.
        """
        if robot not in self.robots:
            raise UsageError(f"no robot {robot!r}; there are: {', '.join(self.robots) or 'none'}")
        force = checked_vector("force", force, "N", UsageError)
        torque = checked_vector("torque", torque, "N m", UsageError)
        if at is not None:
            torque = torque + np.cross(
                checked_vector("at", at, "m", UsageError) - self.physics.rigid.link_centre(robot, link), force
            )
        self.physics.rigid.apply_wrench(robot, link, force, torque)
        self._pushed.add((robot, link))

    def cut(self, body: int, at: float | None = None) -> None:
        """Cut a cane or a peduncle. What is beyond the cut falls, and the stump stays.

        Args:
            body: index in the model of the segment, or of a stump that a cut has left.
            at: place of the cut [m] from the body's origin. None: in the middle of a peduncle, of which the bunch keeps
                the stalk beyond the cut, and at the joint between a segment of a cane and its parent. A tree leaves as
                many stumps as it has spare bodies: two in scenes, none in a model that was built without
                :func:`vinesim.with_spares`. Further cuts are made at the joint (``cuts_moved`` in :attr:`faults`).

        Raises :class:`UsageError` if the place is not on the segment.
        """
        body = self._body(body)
        if at is not None:
            plants = self.physics.plants
            start, end = float(plants.body_start[body]), float(plants.body_end[body])
            organ = self.model.body_organ[plants.stumps.segment_of(body)]
            if organ not in (int(Organ.CANE), int(Organ.PEDUNCLE)) or end <= start:
                raise UsageError(f"at {at!r}: body {body} has no wood; leave out at")
            if not (is_number(at) and start <= at <= end):
                raise UsageError(f"at {at!r}: body {body} has wood from {start:.4g} to {end:.4g} m; give a place in it")
        self.physics.cut(body, at)

    def pick(self, bunch: int) -> None:
        """Detach a bunch from its vine, so that it falls. ``bunch``: index in the model."""
        self.physics.pick(checked_index("bunch", bunch, len(self.model.bunch_body), UsageError))

    def untie(self, tie: int) -> None:
        """Open a tie of the model, so that it holds its cane no longer. ``tie``: index into ``model.tie_body``. A tie
        that was opened before stays open. :meth:`Binding.release` opens ties of :meth:`tie`."""
        self.physics.handwork.untie(checked_index("tie", tie, len(self.model.tie_body), UsageError))

    def hold(self, body: int, along: float = 0.0) -> Hold:
        """Hold a cane or a bunch as a hand does, where it is now; see :class:`Hold`.

        Args:
            body: index in the model.
            along: distance of the held place from the body's origin [m].
        """
        body = self._body(body)
        length = float(self.model.body_length[body])
        if not (is_number(along) and 0.0 <= along <= length):
            raise UsageError(f"along is {along}: body {body} is {length:.4g} m long; give 0 to {length:.4g}")
        held = Hold(self.physics.plants, body, float(along))
        self._holds = [one for one in self._holds if one.is_held] + [held]
        self.wake(int(self.model.body_tree[body]))
        return held

    def tie(self, body: int, along: float | None = None, to: Sequence[float] | np.ndarray | None = None) -> Binding:
        """Tie a cane. The tie pulls its place to the wire within a second or two, and holds it there.

        Args:
            body: index in the model.
            along: distance of the tied place from the body's origin [m]; with neither ``along`` nor ``to`` the place
                nearest to a wire.
            to: [3] m, the point to which the place is tied; unless given, beside the nearest wire, which does not
                yield to this tie.

        Raises :class:`UsageError` if no wire is near, the body is no cane, or it is tied in two places already.
        """
        plants = self.physics.plants
        body = self._body(body)
        try:
            if to is not None:
                to = checked_vector("to", to, "m", UsageError)
                along = float(plants.body_start[body]) if along is None else along
            else:
                along, to = nearest_place(plants, body, along)
            if not is_number(along):
                raise UsageError(f"along is {along!r}; give a number [m]")
            tie = self.physics.tie(body, float(along), to)
        except ValueError as bad:
            raise UsageError(str(bad)) from None
        self.wake(int(self.model.body_tree[body]))
        return Binding(self.physics.handwork, tie)

    def take_leaves(self, body: int, start: float = 0.0, end: float = math.inf) -> int:
        """Take the leaves off a piece of a shoot. They have no mass and no area any more, and no sensor sees them.

        Args:
            body: index in the model of the segment.
            start: distance from the body's origin [m] from which leaves are taken off,
            end: and to which.

        Returns the number of leaves taken off. Raises :class:`UsageError` if ``end`` is before ``start``.
        """
        body = self._body(body)
        if not (is_number(start) and (is_number(end) or end == math.inf) and 0.0 <= start <= end):
            raise UsageError(f"leaves from {start!r} to {end!r} m; give two distances, 0 or more, in this order")
        return self.physics.take_leaves(self.physics.handwork.leaves_on(body, float(start), float(end)))

    def add_robot(
        self,
        robot: str | pathlib.Path,
        pose: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
        *,
        name: str = "",
        base: str = "auto",
    ) -> Robot:
        """Add a robot, given by a name from ``data/robots`` or the path of a URDF, xacro, SDF or MJCF file.

        Args:
            robot: name or path; :class:`~vinesim.robot.description.urdf.DescriptionError` if it cannot be used.
            pose: (x, y, yaw) in m and rad, or [7] position and quaternion of the base.
            name: unique name of this robot; ``robot_0``, ``robot_1``, ... unless given.
            base: how the base moves: ``planar`` (driven), ``free`` (the robot stands on its legs), ``fixed``, or
                ``auto``: as the robot's files say.
        """
        described = load_description(robot, base=base)
        index = self._robots_added
        name = self._free_name(name, f"robot_{index}")
        self.robots[name] = added = Robot(
            self.physics.rigid, described, name, index, base_pose(pose, self.model.terrain)
        )
        self._robots_added += 1
        added.fit_cutters(self.physics)
        return added

    def remove_robot(self, name: str) -> None:
        """Remove a robot and its cutters; objects that it held fall."""
        if name not in self.robots:
            raise UsageError(f"no robot {name!r}; there are: {', '.join(self.robots) or 'none'}")
        self.robots[name].remove()
        self._forget_robot(name)

    def add_pusher(
        self,
        *,
        shape: Literal["sphere", "capsule", "box"] = "sphere",
        size: Sequence[float] = (0.02,),
        position: Sequence[float] | np.ndarray,
        mass: float = 1.0,
        force: float = 50.0,
        name: str = "",
    ) -> Pusher:
        """Add a rigid body that :meth:`Pusher.follow` drives along a path with a limited force. It stays where it is
        until then, and meets plants, robots and boxes.

        Args:
            shape: ``sphere``, ``capsule`` (along its z axis) or ``box``.
            size: (radius,), (radius, length of the axis) or three edges [m].
            position: [3] m, its centre, or [7] centre and quaternion xyzw.
            mass: [kg]; it costs no force to carry.
            force: [N] largest force of the drive along each axis of the world.
            name: unique name, also of the ``actor`` in :attr:`contacts`; ``pusher_0``, ``pusher_1``, ... unless given.
        """
        pose = checked_shape(shape, size, position, mass, force)
        index = self._robots_added
        name = self._free_name(name, f"pusher_{index}")
        self.pushers[name] = added = Pusher(self.physics, name, index, shape, size, pose, mass, force)
        self._robots_added += 1
        return added

    def remove_pusher(self, name: str) -> None:
        """Remove a pusher and its blades."""
        if name not in self.pushers:
            raise UsageError(f"no pusher {name!r}; there are: {', '.join(self.pushers) or 'none'}")
        self.physics.remove_robot(name)
        del self.pushers[name]

    def add_blade(
        self,
        actor: str,
        link: str,
        pose: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        *,
        size: Sequence[float],
        force: float = np.inf,
        speed: float = np.inf,
        kind: Literal["bypass", "anvil", "saw"] = "bypass",
    ) -> Blade:
        """Attach a cutter to a robot's link, or to the link ``body`` of a pusher. :meth:`Blade.close` cuts the wood
        between its blades (:attr:`closings` has the result). The cutters of a robot's files are there already
        (:meth:`~vinesim.robot.drives.controlled_robot.Robot.cutter_blades`).

        Args:
            actor: name of the robot or pusher.
            link: name of its link.
            pose: [7] centre of the mouth in the link's frame: x along the blades, y from one blade to the other.
            size: [3] m, edges of the mouth along x, y and z.
            force: [N] largest closing force. Blades stall in wood that takes more.
            speed: [m/s] speed with which the edges approach each other. Infinite: they close within a step.
            kind: ``bypass``, ``anvil`` or ``saw``.
        """
        if actor not in self.robots and actor not in self.pushers:
            there = ", ".join([*self.robots, *self.pushers]) or "none"
            raise UsageError(f"no robot or pusher {actor!r}; there are: {there}")
        edges = checked_vector("size", size, "m", UsageError)
        if not (edges > 0.0).all():
            raise UsageError(f"size is {size}; give three edges above 0 [m]")
        for name, value, unit in (("force", force, "N"), ("speed", speed, "m/s")):
            if isinstance(value, bool) or not (isinstance(value, numbers.Real) and value > 0.0):
                raise UsageError(f"{name} is {value!r}; give more than 0 {unit}")
        if kind not in BLADE_FACTORS:
            raise UsageError(f"kind is {kind!r}; give {', '.join(BLADE_FACTORS)}")
        pose = frames.checked_pose("pose", pose, UsageError)
        return self.physics.add_blade(actor, link, pose, 0.5 * edges, force=force, speed=speed, kind=kind)

    def add_box(self, box: Box) -> int:
        """Add an open box, which falls if nothing holds it, and return its number."""
        if not isinstance(box, Box):
            raise UsageError(f"box is a {type(box).__name__}; give vinesim.Box")
        number = max(self.boxes, default=-1) + 1
        self.physics.rigid.add_box(number, RigidBox(box.pose, np.asarray(box.size, float), box.mass))
        return number

    def remove_box(self, number: int) -> None:
        """Remove a box; objects in it or on it fall."""
        self._box(number)
        self.physics.rigid.remove_box(int(number))

    def box_pose(self, number: int) -> np.ndarray:
        """Returns the pose [7] of the middle of a box's underside in the world at the current time."""
        return self.boxes[self._box(number)]

    @property
    def boxes(self) -> dict[int, np.ndarray]:
        """Poses [7] of the middles of the undersides of all boxes in the world at the current time, by number."""
        rigid = self.physics.rigid
        rows = zip(rigid.visuals(), rigid.visual_q(), strict=True)
        return {one.index: pose.astype(float) for one, pose in rows if one.name.startswith("box/")}

    @property
    def wind(self) -> Wind | None:
        """The wind; None for calm air. It may be set between steps; the air then changes to the new wind within two
        seconds."""
        return self.physics.wind

    @wind.setter
    def wind(self, wind: Wind | None) -> None:
        if wind is not None and not isinstance(wind, Wind):
            raise UsageError(f"wind is a {type(wind).__name__}; give vinesim.Wind, or None for calm air")
        self.physics.wind = wind

    def _free_name(self, name: str, usual: str) -> str:
        if not isinstance(name, str):
            raise UsageError(f"name is {name!r}; give a text, or none")
        name = name or usual
        if name in self.physics.rigid.robots:
            raise UsageError(f"robot {name!r} exists already; give another name")
        return name

    def _box(self, number: int) -> int:
        there = self.boxes
        if not is_whole(number) or number not in there:
            raise UsageError(f"no box {number}; there are: {', '.join(map(str, there)) or 'none'}")
        return int(number)

    def _forget_robot(self, name: str) -> None:
        del self.robots[name]
        self._pushed = {(robot, link) for robot, link in self._pushed if robot != name}

    # ------------------------------------------------------------------ sensors

    def primitives(self) -> Primitives:
        """Returns the shapes of the world that cameras and lidars render (cones, ellipsoids, leaves and others), at the
        current time. The first call builds them."""
        if self._primitives is None:
            from vinesim.sensors.primitives.scene_primitives import Primitives

            self._primitives = Primitives(self.model, device=self.device)
        self._primitives.update(self._sway.apply(self.snapshot()))
        return self._primitives

    # ------------------------------------------------------------------

    def _tree(self, tree: int) -> int:
        return checked_index("tree", tree, len(self.model.tree_first), UsageError)

    def _one(self, tree: int | None) -> np.ndarray | None:
        return None if tree is None else np.array([self._tree(tree)])

    def _check_joints(self, trees: np.ndarray) -> None:
        """Raise :class:`UsageError` for the first body of ``trees`` [k] with an impossible joint rotation or rate: a
        user may have written it."""
        if len(trees) == 0:
            return
        model = self.model
        state = self.physics.state
        here = np.zeros(len(model.tree_first), bool)
        here[trees] = True
        bodies = np.flatnonzero(here[model.body_tree])
        rotation = state.joint_q.take(bodies, 0)
        rate = state.joint_qd.take(bodies, 0)
        for name, bad, remedy in (
            ("joint_q", ~(abs(np.einsum("bi,bi->b", rotation, rotation) - 1.0) < 2e-3), "a unit quaternion xyzw"),
            ("joint_qd", ~np.isfinite(np.einsum("bi->b", rate)), "three finite rates [rad/s]"),
        ):
            if bad.any():
                body = int(bodies[np.argmax(bad)])
                value = getattr(state, name)[body].tolist()
                raise UsageError(f"state.{name}[{body}] is {value}; give {remedy}")

    def _body(self, body: int) -> int:
        return checked_index("body", body, len(self.model.body_mass), UsageError)


def base_pose(pose: Sequence[float] | np.ndarray, terrain: Terrain | None = None) -> np.ndarray:
    """Returns the pose [7] of a robot's base from (x, y, yaw) in m and rad, on the ground, or from a pose [7]. Raises
    :class:`UsageError` for other values."""
    given = as_numbers(pose)
    if given.shape not in ((3,), (7,)) or not np.isfinite(given).all():
        shown = given.tolist() if given.ndim else pose
        raise UsageError(f"pose is {shown}; give (x, y, yaw) in m and rad, or position and quaternion [7]")
    if len(given) == 7:
        return frames.checked_pose("pose", given, UsageError)
    return on_ground(terrain, frames.pose(np.array([given[0], given[1], 0.0]), frames.from_yaw(given[2])))


def model_of(source: Model | Scene | CaneBuilder | TreeBuilder | Iterable[CaneBuilder | TreeBuilder]) -> Model:
    """Returns the model of a source that is no name or file. Raises :class:`UsageError` for other values."""
    if isinstance(source, Model):
        return source
    if isinstance(source, Scene):
        return generate(source)
    if isinstance(source, (CaneBuilder, TreeBuilder)):
        return assemble([source])
    canes = list(source) if isinstance(source, Iterable) else [source]
    if not all(isinstance(one, (CaneBuilder, TreeBuilder)) for one in canes):
        raise UsageError(f"cannot simulate a {type(source).__name__}; give a scene, a model or cane builders")
    return assemble(canes)


def _warn_caller_of_step(text: str) -> None:
    """Warn at the line that called :meth:`Simulation.step`."""
    warnings.warn(text, RuntimeWarning, stacklevel=4)  # above: FaultLog.update, Simulation.step, the caller
