"""A client: its own simulation of the vineyard, the actors that it controls, and copies of all remote actors.

    client = Client(scene, model, description, bus, name="picker", pose=pose)
    while running:
        client.tick()

A tick has five parts: receive, control, step, sense, send. None of them waits for the network or for a picture.

A client controls one human, or one robot or several (D6.4 section 4.1); each robot is an actor of its own on the
network.
"""

from __future__ import annotations

import collections
import functools
import logging
import time
import zlib
from collections.abc import Callable, Mapping, Set
from concurrent.futures import Executor
from typing import Any, NamedTuple

import numpy as np

from vinesim.avatar.local_human import LocalHuman
from vinesim.client.pace import Limit
from vinesim.client.recording.bunch_trace import Trace
from vinesim.client.remote.mesh_exchange import MeshExchange
from vinesim.client.remote.objects import ObjectSync
from vinesim.client.remote.plant_couplings import PlantCouplings
from vinesim.client.remote.remote_human import RemoteHuman
from vinesim.client.remote.spawner import RemoteSpawner
from vinesim.client.remote.stranger import StrangerLoader
from vinesim.client.remote.tree_copies import TreeCopies
from vinesim.client.signals import show_lights
from vinesim.client.sound.exchange import SoundExchange
from vinesim.client.world_time import WorldTime
from vinesim.core import frames
from vinesim.core.allocator import release_free_memory
from vinesim.net.codec.control import Description, Hello
from vinesim.net.codec.forces import COUPLINGS, WRENCHES, Coupling
from vinesim.net.replication import interest
from vinesim.net.replication.receiver import Inbox
from vinesim.net.replication.replicator import Replicator
from vinesim.net.transport.bus import Bus
from vinesim.rigid.human_posture import standing_pose
from vinesim.rigid.urdf import RobotError
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.sidecar import encode_sidecar
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.robot_instance import RemoteRobot
from vinesim.scene.ids import LABEL_STRIDE
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene
from vinesim.scene.values import HumanPose, HumanSpec, HumanUpdate, RobotUpdate
from vinesim.scene.wind import wind_of
from vinesim.world import Physics

log = logging.getLogger(__name__)


def label_index(name: str) -> int:
    """Returns the index of an actor's label in images. It follows from the name alone, so it is the same on every
    client.

    With 64 actors the chance that two of them have the same index is 0.2 %.
    """
    return zlib.crc32(name.encode()) % LABEL_STRIDE


CLOCK_POLL_PERIOD = 0.005
"""Time between two checks for the server's first reply [s]."""


BODY_KINDS = ("robot", "human")
"""Kinds of actors that have bodies."""


class Exchange(NamedTuple):
    """Two functions of a client for one kind of direct messages between actors: one makes the messages, one applies
    them."""

    say: Callable[[str], Any]
    """Function that returns, by name of an actor of this client, the actor's message to other actors in this step: the
    value for :meth:`vinesim.net.replication.direct_messages.MessageSync.publish`."""
    apply: Callable[[Mapping[str, Any]], None]
    """Function that applies, before a step, the valid messages from other actors. Its argument contains, by name of
    each actor of this client, the value of :meth:`vinesim.net.replication.direct_messages.MessageSync.current`."""


class Client:
    """One simulation of the world with its local actors. ``clock``: any monotonic clock [s]; tests pass a simulated
    one."""

    picking = True
    """Whether bunches and branches detach in this client's physics when they are pulled too hard."""
    slows_the_world = True
    """Whether the clock of the world slows down if this client's machine cannot keep up with it."""

    def __init__(
        self,
        scene: Scene,
        model: Model,
        description: RobotDescription | None,
        bus: Bus,
        *,
        name: str,
        pose: np.ndarray,
        source: Callable[[float], HumanPose] | None = None,
        height: float = 1.75,
        outfit: str = "",
        interest_radius: float = interest.INTEREST_RADIUS,
        jitter_buffer: float = 0.0,
        device: str = "cpu",
        clock: Callable[[], float] = time.monotonic,
        executor: Executor | None = None,
        loader: StrangerLoader | None = None,
    ) -> None:
        """Create the simulation and the client's own actor.

        The actor is a robot of this ``description`` at ``pose`` [7] m, 1. If ``description`` is None, the actor is a
        human of ``height`` [m] in an ``outfit`` (:func:`vinesim.scene.appearance.outfit_names`; if empty, the outfit
        follows from the human's name).

        ``source(time)`` returns the human's pose; without a source the human stands still. ``interest_radius`` [m]:
        actors nearer than this to an object receive its motion. ``jitter_buffer`` [s]: delay of remote actors.
        ``executor`` compiles the bodies of actors that join; without an executor the loop compiles them.
        ``loader`` loads robots of strangers in processes.
        """
        self.name = name
        self.model = model
        self.scene = scene
        self._new_physics = functools.partial(
            Physics, model, parameters=scene.physics, device=device, detachment=self.picking
        )
        self.physics = self._new_physics()
        self.physics.wind = wind_of(scene)
        self.robots: dict[str, Robot] = {}
        """Robots that this client simulates, by name; the first is :attr:`robot`."""
        self.humans: dict[str, LocalHuman] = {}
        """Humans that this client simulates, by name."""
        self._descriptions: dict[str, Description] = {}
        """Descriptions of robots by digest, for all local actors."""
        self.meshes = MeshExchange()
        """Sends the meshes of local robots to other clients, and receives the meshes of remote robots."""
        self.step_time: Callable[[], float] | None = None
        """Function that returns the world's time at the present step [s]. None if the steps do not follow the server's
        clock."""
        self.replicators: dict[str, Replicator] = {}
        """Network replication of each local actor, by name; the first is :attr:`replicator`."""
        self.objects = ObjectSync(self.physics, self.replicators, self._is_present)
        self.couplings = PlantCouplings(self.physics)
        self.exchanges = {
            WRENCHES: Exchange(self._say_wrenches, self._apply_wrenches),
            COUPLINGS: Exchange(self._say_couplings, self._apply_couplings),
        }
        """Functions that make and apply the direct messages between actors, by kind of message."""
        self._description = description
        self._executor = executor
        self._loader = loader
        self._outfit = outfit
        self._interest_radius = interest_radius
        self._jitter_buffer = jitter_buffer
        self._add_own_actor(description, pose, source, height, bus)
        self.replicator = self.replicators[name]
        self.meshes.bus = bus
        self.remote_actors: dict[str, RemoteRobot | RemoteHuman] = {}
        self.steps_before_pause: int | None = None
        """Number of steps that are still simulated before the simulation pauses. None: it runs without a pause."""
        self.between_steps: list[Callable[[], None]] = []
        """Functions that are called at the start of every tick, also while the simulation pauses."""
        self.pre_step: list[Callable[[float], None]] = []
        """Functions that are called before every step with the simulation time [s]: tasks and commands of robots."""
        self.post_step: list[Callable[[Client], None]] = []
        """Functions that are called after every step with this client: sensors, ROS, recorders."""
        self.wake_readers: list[Callable[[], None]] = []
        """Functions that are called at the end of a tick and wake the processes that take the tick's results. They come
        last because a woken process may get this core immediately."""
        self.script = ""
        """Command line option that lets the robots act by themselves, or "". ROS services refuse to reset a client that
        has such an option."""
        self.after_reset: list[Callable[[], None]] = []
        """Functions that are called after :meth:`reset`, so that parts with references to the physics or a robot take
        the new objects."""
        self.earlier_faults: collections.Counter[str] = collections.Counter()
        """Number of faults before the last reset, by kind of fault. Refused couplings (virtual springs of other
        clients' actors) are counted, too."""
        # Each returns the fault counts of a part that serves this client, such as its page.
        self.other_faults: list[Callable[[], dict[str, int]]] = []
        self.frame_score: Callable[[], float] = lambda: 0.0 if self.trace is None else self.trace.displacement
        """Function that returns how useful a picture would be now. The picture taken at the highest value is kept."""
        self.trace: Trace | None = None
        """Record of the force on one bunch and of its displacement. None: nothing is recorded."""
        self.interest_audit = InterestAudit()
        self.world_time = WorldTime(self.physics.dt)
        """Time of the world, in which ROS messages are stamped."""
        self.pace_text: Callable[[], str] = lambda: ""
        """Function that returns a text for people: how fast time passes and what limits it
        (:func:`vinesim.net.pace.describe`)."""
        self.holds: list[Callable[[], str]] = []
        """Functions that return the reason why the next step has to wait, such as "sensors", or "" if the step may
        begin."""
        self.pace_limits: list[Callable[[], Limit]] = []
        """Functions that return the largest real-time factor with which a part of this client, such as its sensors, can
        keep up."""
        self.clock = clock
        self.sound = SoundExchange(self)
        self.tree_copies = TreeCopies(self.physics, self.objects)
        self.spawner = RemoteSpawner(self.physics.rigid, description, executor, self.meshes, loader)

    @property
    def is_alone(self) -> bool:
        """Whether this client is alone in its world: it follows no server, and no other client is present."""
        return not (self.world_time.is_shared or self.remote_actors or self.replicator.peers)

    def reset(self) -> None:
        """Restore the scene as it was generated: plants, boxes and robots return to their start, at rest.

        Call it between steps. Human actors who are present stay. Simulated time continues, and so do all counters of
        the network. A reset takes as long as the start of the physics. Raises :class:`ValueError` unless the client
        :attr:`is_alone`.
        """
        if not self.is_alone:
            raise ValueError("a world that other clients share cannot be reset by one of them")
        before = self.physics
        starts = {name: before.rigid.robot(name).spec.pose for name in self.robots}
        people = {name: (before.rigid.human(name).spec, human.source) for name, human in self.humans.items()}
        self.physics = self._new_physics()
        self.physics.wind = wind_of(self.scene)
        self.physics.tick = before.tick
        self.physics.rigid.mj_data.time = before.time
        self.earlier_faults.update(before.faults | {"couplings_refused": self.couplings.refused})
        self.objects, self.couplings = ObjectSync(self.physics, self.replicators), PlantCouplings(self.physics)
        self.tree_copies = TreeCopies(self.physics, self.objects)
        self.spawner = RemoteSpawner(self.physics.rigid, self._description, self._executor, self.meshes, self._loader)
        for name, pose in starts.items():
            self._add_robot_body(self.robots[name].description, name, pose)
        for name, (spec, source) in people.items():
            self.humans[name] = LocalHuman(self.physics, spec, source)
        if self.name in self.robots:
            self.robot = self.robots[self.name]
        for callback in self.after_reset:
            callback()
        del before
        release_free_memory()

    def _add_own_actor(
        self,
        description: RobotDescription | None,
        pose: np.ndarray,
        source: Callable[[float], HumanPose] | None,
        height: float,
        bus: Bus,
    ) -> None:
        """Add the actor that gives this client its name."""
        if description is None:
            standing = standing_pose(pose, height)
            index = label_index(self.name)
            self.add_human(HumanSpec(self.name, index, standing, height, outfit=self._outfit), source, bus)
        else:
            self.robot = self.add_robot(description, self.name, pose, bus)

    def add_robot(self, description: RobotDescription, name: str, pose: np.ndarray, bus: Bus) -> Robot:
        """Add a local robot at ``pose`` [7] m, 1; ``bus`` must have its ``name``."""
        hello = Hello(
            name=name,
            kind="robot",
            robot=description.name,
            urdf=description.urdf,
            sidecar=encode_sidecar(description.base_limits, description.groups),
            scene=self.scene.name,
            digest=self.model.digest(),
            index=label_index(name),
            joints=len(description.joints),
            seed=self.scene.seed,
        )
        replicator = self._new_replicator(bus, hello)
        robot = self._add_robot_body(description, name, pose)
        self.meshes.offer(bus, description.urdf)
        self._add_replicator(name, replicator)
        return robot

    def _add_robot_body(self, description: RobotDescription, name: str, pose: np.ndarray) -> Robot:
        self.robots[name] = robot = Robot(self.physics.rigid, description, name, label_index(name), pose)
        robot.fit_cutters(self.physics)
        return robot

    def add_human(self, spec: HumanSpec, source: Callable[[float], HumanPose] | None, bus: Bus) -> LocalHuman:
        """Add a local human that follows the poses of ``source(time)`` (None: stands still); ``bus`` must have the
        human's name."""
        hello = Hello(
            name=spec.name,
            kind="human",
            scene=self.scene.name,
            digest=self.model.digest(),
            index=spec.index,
            height=spec.height,
            seed=self.scene.seed,
            outfit=spec.outfit,
        )
        replicator = self._new_replicator(bus, hello)
        self.humans[spec.name] = human = LocalHuman(self.physics, spec, source or (lambda _: spec.pose))
        self._add_replicator(spec.name, replicator)
        return human

    def remove_human(self, name: str) -> None:
        """Remove a local human who is not this client's own actor. Call it between steps, and close the human's bus
        afterwards."""
        self.physics.remove_human(name)
        del self.humans[name], self.replicators[name]
        self._share_client()

    def _new_replicator(self, bus: Bus, hello: Hello) -> Replicator:
        return Replicator(
            bus,
            hello,
            self.model,
            interest_radius=self._interest_radius,
            jitter_buffer=self._jitter_buffer,
            hand_force=self.physics.parameters.hand_force,
            link_centre=functools.partial(self._link_centre, hello.name),
            descriptions=self._descriptions,
        )

    def follow_steps(self, step_time: Callable[[], float] | None) -> None:
        """Set the function that returns the world's time of a step [s].

        The results of the step are stamped, sent and shown with this time. None: they get the time at which the step is
        computed.
        """
        self.step_time = step_time
        for replicator in self.replicators.values():
            replicator.step_time = step_time

    def _add_replicator(self, name: str, replicator: Replicator) -> None:
        self.replicators[name] = replicator
        replicator.step_time = self.step_time
        self._share_client()

    def _share_client(self) -> None:
        for own in self.replicators.values():
            own.share_client(other for other in self.replicators.values() if other is not own)

    def tick(self) -> None:
        """Simulate one step of ``physics.dt``; none while :attr:`steps_before_pause` is 0."""
        for callback in self.between_steps:
            callback()
        if self.steps_before_pause is not None:
            if self.steps_before_pause == 0:
                return
            self.steps_before_pause -= 1
        now = self.clock()
        self.receive(now)
        if self.step_time is not None:
            if self.replicator.has_clock:
                self.world_time.take(self.step_time() - self.physics.time)
        elif self.replicator.has_clock:
            self.world_time.follow(self.physics.time, self.replicator.network_time(now))
        self.physics.wind_time_offset = self.world_time.offset
        self.control()
        self.physics.step()
        show_lights((*self.robots.values(), *self.remote_actors.values()), self.physics.time + self.world_time.offset)
        self.sense()
        self.send(now)
        for callback in self.wake_readers:
            callback()

    def held(self) -> str:
        """Returns the reason why the next step has to wait, or "" if it may begin."""
        return next((cause for hold in self.holds if (cause := hold())), "")

    def wait_for_clock(self, timeout: float) -> None:
        """Before the first step: wait up to ``timeout`` [s] for the server's clock, so that no stamp jumps later."""
        until = self.clock() + timeout
        while not self.replicator.has_clock and self.clock() < until:
            self.receive(self.clock())
            time.sleep(CLOCK_POLL_PERIOD)

    # ------------------------------------------------------------------ the parts of a tick

    def receive(self, now: float) -> None:
        """Add and remove bodies of remote actors, move their copies, and apply the states of trees and objects that
        they own."""
        inbox = self._receive_all(now)
        for hello in inbox.joined:
            log.info("%s joined as %s", hello.name, hello.kind)
        for name in inbox.left:
            self.objects.carrier_left(name)
            log.info("%s left", name)
        updates: dict[str, RobotUpdate | HumanUpdate] = {**inbox.robots, **inbox.people}
        self._choose_bodies(updates.keys())
        spawned = self.spawner.spawn(updates)
        self.remote_actors.update(spawned)
        self.physics.contact_solver.remote_actors.difference_update(self.spawner.removed())
        self.physics.contact_solver.remote_actors.update(spawned)
        for name, update in updates.items():
            match self.remote_actors.get(name), update:
                case [RemoteRobot() as robot, RobotUpdate()]:
                    robot.follow(update)
                case [RemoteHuman() as human, HumanUpdate()]:
                    human.follow(update)
        for renewed in self.spawner.renewed():
            self.remote_actors[renewed.name] = renewed
        self.tree_copies.apply(
            inbox.trees,
            self.replicator.received_at,
            is_owned_remotely=self._is_owned_remotely,
            local_actors=self.replicators.keys(),
            coupled_trees=self.couplings.trees,
        )
        self.objects.receive(inbox)

    def _choose_bodies(self, near: Set[str]) -> None:
        """Begin to make bodies of remote actors that are ``near`` now, and remove the bodies of those that are not."""
        for name in sorted(near - self.remote_actors.keys()):
            if self.spawner.may_enqueue(name) and (hello := self._describe(name)) is not None:
                self.spawner.enqueue(hello)
        for name in sorted((self.remote_actors.keys() | self.spawner.waiting) - near):
            self.spawner.cancel(name)
            self.meshes.forget(name)
            if (other := self.remote_actors.pop(name, None)) is not None:
                self.spawner.remove(name, other)

    def _describe(self, name: str) -> Hello | None:
        """Returns the hello of a remote robot, with its URDF, or of a remote human. None: it is a spectator, or its
        description has not arrived yet."""
        knowing = next((one for one in self.replicators.values() if one.is_peer(name)), None)
        hello = None if knowing is None else knowing.describe(name)
        return hello if hello is not None and hello.kind in BODY_KINDS else None

    def far_actors(self) -> dict[str, np.ndarray]:
        """Returns the last known positions [3] m of the robots and humans of other clients that have no body here, by
        name, sorted: those that are far away, and those whose bodies are being made."""
        hellos = self.replicator.peers
        return {
            name: place
            for name, place in sorted(self.replicator.peer_positions().items())
            if name not in self.remote_actors and hellos[name].kind in BODY_KINDS
        }

    def control(self) -> None:
        """Call the functions of :attr:`pre_step`, then pass the set-points of robots and the poses of humans to the
        physics."""
        for callback in self.pre_step:
            callback(self.physics.time)
        for robot in self.robots.values():
            robot.control(self.physics.time)
        for human in self.humans.values():
            human.control(self.physics.time)

    def sense(self) -> None:
        """Record the traced bunch, then call the functions of :attr:`post_step`."""
        if self.trace is not None:
            self.physics.update_kinematics()
            body = self.trace.body
            force = np.zeros(3)
            for contact in self.physics.contacts:
                if contact.body in self.trace.bodies:
                    force -= contact.force
            is_remote = int(self.model.body_tree[body]) in self.tree_copies
            self.trace.add(self.physics.time, self.physics.state.body_q[body], force, is_remote)
        for callback in self.post_step:
            callback(self)

    def send(self, now: float) -> None:
        """Publish the poses of local actors, and send the states of the objects that they touch to actors nearby."""
        objects = self.objects
        objects.collect()
        moving = objects.moving
        touching = False
        for name, actor in (*self.robots.items(), *self.humans.items()):
            replicator = self.replicators[name]
            pose = actor.update(now)
            mine = replicator.owned
            detached = objects.detached_by(name, all_others=name == self.name)
            touched = objects.touched_by(name, mine)
            touching |= bool(touched)
            carried_on = objects.carried_on(name)
            settled = replicator.send(
                now,
                pose,
                touched=touched,
                moving=moving,
                read=objects.read_state,
                grabbed=objects.with_trees(detached),
                detached=detached,
                detached_roots=objects.cut_roots,
                is_changed=objects.is_changed,
                pose_on_support=self.physics.support_tracker.pose_on_support,
                has_body=self.physics.support_tracker.__contains__,
                messages={kind: exchange.say(name) for kind, exchange in self.exchanges.items()},
                carried_on=carried_on,
                stalk_of=objects.stalk_of,
                stumps_of=objects.stumps_of,
                wood_of=objects.wood_of,
                fruit_of=objects.fruit_of,
                passed_by=objects.passed_by,
            )
            for update in settled:
                # All copies hold the quantised state of the last message, so this client takes it, too.
                objects.blend_tree(update, 1.0)
            for number in mine.union(carried_on) - replicator.owned:
                objects.mark_resting(replicator.record(number))
        self.interest_audit.update(self, touching)

    def leave(self) -> None:
        """Publish world poses of the objects that rest on this client's robots, because the robots are about to
        disappear.

        Call it before the buses close.
        """
        self.meshes.close()
        now = self.clock()
        for name, robot in self.robots.items():
            supported = self.objects.supported_by(name)
            if supported:
                self.replicators[name].send(
                    now,
                    robot.update(now),
                    read=self.objects.read_state,
                    grabbed=supported,
                    detached=supported,
                    pose_on_support=self.physics.support_tracker.pose_on_support,
                    stalk_of=self.objects.stalk_of,
                    wood_of=self.objects.wood_of,
                    fruit_of=self.objects.fruit_of,
                    passed_by=self.objects.passed_by,
                )

    def side_of(self, point: np.ndarray) -> str:
        """Returns the arm, "left" or "right", on the side of a point [3] m in the world."""
        base, _ = self.physics.rigid.base_state(self.name)
        local = frames.rotate(frames.conjugate(base[3:]), point - base[:3])
        return "left" if local[1] >= 0.0 else "right"

    # ------------------------------------------------------------------ remote actors

    def _receive_all(self, now: float) -> Inbox:
        """Merge the inboxes of all local actors. If several actors received updates of the same remote actor, the
        update that the nearest local actor received counts."""
        inboxes = {name: replicator.receive(now) for name, replicator in self.replicators.items()}
        for kind, exchange in self.exchanges.items():
            exchange.apply({name: one.messages[kind] for name, one in inboxes.items()})
        inbox = inboxes[self.name]
        if len(inboxes) == 1:
            return inbox
        trees = {update.tree: update for update in inbox.trees}
        moved = {update.object: update for update in inbox.objects}
        nearest: dict[str, tuple[float, RobotUpdate | HumanUpdate]] = {}
        for name, other_inbox in inboxes.items():
            seen = (*other_inbox.robots.items(), *other_inbox.people.items())
            here = self.physics.rigid.actor_position(name)[:2] if seen else None
            for other, update in seen:
                away = float(np.hypot(*(update.base_q[:2] - here)))
                if other not in nearest or away < nearest[other][0]:
                    nearest[other] = away, update
            trees.update((update.tree, update) for update in other_inbox.trees)
            moved.update((update.object, update) for update in other_inbox.objects)
            if other_inbox is not inbox:
                inbox.records += other_inbox.records
        shown = [update for _, (_, update) in sorted(nearest.items())]
        inbox.robots = {update.actor: update for update in shown if isinstance(update, RobotUpdate)}
        inbox.people = {update.actor: update for update in shown if isinstance(update, HumanUpdate)}
        inbox.trees = [trees[tree] for tree in sorted(trees)]
        inbox.objects = [moved[number] for number in sorted(moved) if self._is_owned_remotely(number)]
        return inbox

    def _is_present(self, name: str) -> bool:
        """Returns whether an actor of another client is in the world now."""
        return any(replicator.is_present(name) for replicator in self.replicators.values())

    def _is_owned_remotely(self, number: int) -> bool:
        """Returns whether an actor of another client owns the object with the id ``number``, which may be a tree."""
        owners = {replicator.owner(number) for replicator in self.replicators.values()} - {None}
        return bool(owners) and not owners & self.replicators.keys()

    def _link_centre(self, name: str, link: str) -> np.ndarray | None:
        """Returns the centre of mass [3] m of a link of a local robot. None if ``name`` is no robot or the robot has no
        such link."""
        try:
            return self.physics.rigid.link_centre(name, link) if name in self.robots else None
        except ValueError:
            return None

    def _say_wrenches(self, name: str) -> dict[str, dict[str, np.ndarray]] | None:
        """Returns the wrenches [6] N, N m of a local human's hands on remote robots."""
        return self.humans[name].hand_wrenches_on(self.remote_actors) if name in self.humans else None

    def _apply_wrenches(self, received: Mapping[str, dict[str, np.ndarray]]) -> None:
        """Apply the wrenches [6] N, N m of remote humans to the links of local robots."""
        for name in self.robots:
            try:
                self.physics.rigid.set_remote_wrenches(name, received[name])
            except RobotError as error:
                log.debug("a wrench on an unknown link: %s", error)

    def _say_couplings(self, name: str) -> list[Coupling]:
        """Returns the couplings (virtual springs) that stand for the contacts of a local actor with trees that other
        clients also move or touch."""
        return self.couplings.of_actor(name, self.tree_copies.trees | self.couplings.trees)

    def _apply_couplings(self, received: Mapping[str, dict[str, tuple[Coupling, ...]]]) -> None:
        """Apply the couplings (virtual springs) that actors of other clients have sent to the trees that they touch."""
        couplings: dict[str, tuple[Coupling, ...]] = {}
        for by_actor in received.values():
            for actor, theirs in by_actor.items():
                couplings[actor] = couplings.get(actor, ()) + theirs
        self.couplings.apply(couplings)


class InterestAudit:
    """Counts the bytes with states of touched plants that are sent while no remote actor is near. The count must stay
    0."""

    MARGIN = 3.0
    """Distance beyond the interest radius from which a remote actor counts as far [m]. It is not 0, because a tree is
    not a point."""

    def __init__(self) -> None:
        self.bytes = 0
        """Bytes with states of the environment that were sent in ticks in which no remote actor was near."""
        self.ticks_touching = 0
        """Number of ticks in which this client touched plants and no remote actor was near."""
        self._seen = 0

    def update(self, client: Client, touching: bool) -> None:
        """Count one tick. ``touching``: whether this client touched plants in it.

        Positions of remote actors are those of the near ones in their messages, because their copies appear later, and
        spectators have no copy.
        """
        replicators = client.replicators.values()
        sent = sum(replicator.counters.environment.bytes_out for replicator in replicators)
        if touching or sent != self._seen:
            there = np.concatenate([replicator.near_positions()[:, :2] for replicator in replicators])
            away = np.inf
            if len(there):
                here = [client.physics.rigid.actor_position(name)[:2] for name in client.replicators]
                away = np.linalg.norm(np.reshape(here, (-1, 1, 2)) - np.reshape(there, (1, -1, 2)), axis=-1).min()
            if away > client.replicator.interest_radius + self.MARGIN:
                self.bytes += sent - self._seen
                self.ticks_touching += touching
        self._seen = sent
