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
from collections.abc import Callable, Mapping
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
from vinesim.client.remote.tree_copies import TreeCopies
from vinesim.client.signals import show_lights
from vinesim.client.sound.exchange import SoundExchange
from vinesim.client.world_time import WorldTime
from vinesim.core import frames
from vinesim.core.allocator import release_free_memory
from vinesim.net.codec.control import Hello
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
    """Index of an actor's label in images: the same on every client, from the name alone.

    With 64 actors the chance that two have the same is 0.2 %.
    """
    return zlib.crc32(name.encode()) % LABEL_STRIDE


CLOCK_POLL_PERIOD = 0.005
"""Time between two looks for the server's first reply [s]."""


class Exchange(NamedTuple):
    """What a client does with one kind of the messages that actors send each other directly."""

    say: Callable[[str], Any]
    """What a local actor tells others in this step: the value for
    :meth:`vinesim.net.replication.direct_messages.MessageSync.publish`."""
    apply: Callable[[Mapping[str, Any]], None]
    """Applies, before a step, what holds now of what others told each local actor:
    :meth:`vinesim.net.replication.direct_messages.MessageSync.current`, by its name."""


class Client:
    """One simulation of the world with its local actors. ``clock``: any monotonic clock [s]; tests pass their own."""

    picking = True
    """Whether bunches and branches detach in this client's physics when they are pulled too hard."""
    slows_the_world = True
    """Whether the clock of its world waits for this client where its machine is slow."""

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
        threads: int = 1,
        clock: Callable[[], float] = time.monotonic,
        executor: Executor | None = None,
    ) -> None:
        """A robot of this ``description`` at ``pose`` [7] m, 1; None: a human of ``height`` [m] in an
        ``outfit`` (:func:`vinesim.scene.appearance.outfit_names`; empty: what follows from its name).

        ``source(time)`` gives the human's pose; without one it stands still. ``interest_radius`` [m]: actors nearer
        than this to an object receive its motion. ``jitter_buffer`` [s]: delay of remote actors. ``executor`` compiles
        actors that join; without one that is done in the loop.
        """
        self.name = name
        self.model = model
        self.scene = scene
        self._new_physics = functools.partial(
            Physics, model, parameters=scene.physics, device=device, threads=threads, detachment=self.picking
        )
        self.physics = self._new_physics()
        self.physics.wind = wind_of(scene)
        self.robots: dict[str, Robot] = {}
        """Robots that this client simulates, by name; the first is :attr:`robot`."""
        self.humans: dict[str, LocalHuman] = {}
        """Humans that this client simulates, by name."""
        self.meshes = MeshExchange()
        """Meshes of local robots for other clients, and of remote ones for this client."""
        self.step_time: Callable[[], float] | None = None
        """Of a client whose steps follow the clock of its server: the world's time at the present step [s]."""
        self.replicators: dict[str, Replicator] = {}
        """Network replication of each local actor, by name; the first is :attr:`replicator`."""
        self.objects = ObjectSync(self.physics, self.replicators, self._is_present)
        self.couplings = PlantCouplings(self.physics)
        self.exchanges = {
            WRENCHES: Exchange(self._say_wrenches, self._apply_wrenches),
            COUPLINGS: Exchange(self._say_couplings, self._apply_couplings),
        }
        """What the actors of this client and of others tell each other, by kind of message."""
        self._description = description
        self._executor = executor
        self._outfit = outfit
        self._interest_radius = interest_radius
        self._jitter_buffer = jitter_buffer
        self._add_own_actor(description, pose, source, height, bus)
        self.replicator = self.replicators[name]
        self.meshes.bus = bus
        self.remote_actors: dict[str, RemoteRobot | RemoteHuman] = {}
        self.steps_before_pause: int | None = None
        """Steps that are still simulated before the simulation pauses; None: it runs."""
        self.between_steps: list[Callable[[], None]] = []
        """Called at the start of every tick, also while the simulation pauses."""
        self.pre_step: list[Callable[[float], None]] = []
        """Called before every step with the simulation time [s]: tasks and commands of robots."""
        self.post_step: list[Callable[[Client], None]] = []
        """Called after every step: sensors, ROS, recorders."""
        self.wake_readers: list[Callable[[], None]] = []
        """Called last in a tick: they wake the processes that take its results, which may get this core at once."""
        self.script = ""
        """Options by which its robots act by themselves; such a client is not reset by services."""
        self.after_reset: list[Callable[[], None]] = []
        """Called after :meth:`reset`: parts that keep the physics or a robot take the new ones."""
        self.earlier_faults: collections.Counter[str] = collections.Counter()
        """Faults of the physics and of couplings before the last reset."""
        self.other_faults: list[Callable[[], dict[str, int]]] = []  # counts of parts that serve it: of its page
        self.frame_score: Callable[[], float] = lambda: 0.0 if self.trace is None else self.trace.displacement
        """How much there is to see now; the picture with the highest score is kept."""
        self.trace: Trace | None = None
        """If set, force on and displacement of one bunch are recorded in it."""
        self.interest_audit = InterestAudit()
        self.world_time = WorldTime(self.physics.dt)
        """Time of the world, in which ROS messages are stamped."""
        self.pace_text: Callable[[], str] = lambda: ""
        """How fast time passes and what limits it, for people: see :func:`vinesim.net.pace.describe`."""
        self.holds: list[Callable[[], str]] = []
        """Each says why the next step has to wait, such as "sensors"; empty if it may begin."""
        self.pace_limits: list[Callable[[], Limit]] = []
        """Each says how fast a part that serves this client can follow."""
        self.clock = clock
        self.sound = SoundExchange(self)
        self.tree_copies = TreeCopies(self.physics, self.objects)
        self.spawner = RemoteSpawner(self.physics.rigid, description, executor, self.meshes)

    @property
    def is_alone(self) -> bool:
        """Whether this world is this client's alone: it follows no server, and no other client is in it."""
        return not (self.world_time.is_shared or self.remote_actors)

    def reset(self) -> None:
        """Begin the scene anew as it was generated, between steps: plants, boxes, robots where they started, at rest.

        People who are here stay. Simulated time goes on, and so do all counts of the network. Takes as long as a start
        of the physics. :class:`ValueError` unless the client :attr:`is_alone`.
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
        self.spawner = RemoteSpawner(self.physics.rigid, self._description, self._executor, self.meshes)
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
        """Add a local human with the poses of ``source(time)`` (None: still); ``bus`` must have its name."""
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
        """Remove a local human who is not this client's own actor, between steps; the bus is the caller's to close."""
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
        )

    def follow_steps(self, step_time: Callable[[], float] | None) -> None:
        """Stamp, send and show all of a step for the world's time of that step, ``step_time()`` [s]; None: for the
        moment at which it is made."""
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
        """Why the next step has to wait; empty if it may begin."""
        return next((cause for hold in self.holds if (cause := hold())), "")

    def wait_for_clock(self, timeout: float) -> None:
        """Before the first step: wait up to ``timeout`` [s] for the server's clock, so that no stamp jumps later."""
        until = self.clock() + timeout
        while not self.replicator.has_clock and self.clock() < until:
            self.receive(self.clock())
            time.sleep(CLOCK_POLL_PERIOD)

    # ------------------------------------------------------------------ the parts of a tick

    def receive(self, now: float) -> None:
        """Add and remove remote actors, move their copies, and apply the states of trees and objects that they own."""
        inbox = self._receive_all(now)
        for hello in inbox.joined:
            log.info("%s joined as %s", hello.name, hello.kind)
            if hello.kind in ("robot", "human"):
                self.spawner.enqueue(hello)
        for name in inbox.left:
            self.objects.carrier_left(name)
            self.spawner.cancel(name)
            self.meshes.forget(name)
            if (other := self.remote_actors.pop(name, None)) is not None:
                self.spawner.remove(name, other)
                log.info("%s left", name)
        updates: dict[str, RobotUpdate | HumanUpdate] = {**inbox.robots, **inbox.people}
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

    def control(self) -> None:
        """Run the callbacks of :attr:`pre_step`, then the drives of robots and the poses of humans."""
        for callback in self.pre_step:
            callback(self.physics.time)
        for robot in self.robots.values():
            robot.control(self.physics.time)
        for human in self.humans.values():
            human.control(self.physics.time)

    def sense(self) -> None:
        """Record the traced bunch, then run the callbacks of :attr:`post_step`."""
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
        """Publish poses of local actors, and to actors nearby the states of what they touch."""
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
            )
            for update in settled:
                # the last message is what all copies hold: hold the same, quantised state
                objects.blend_tree(update, 1.0)
            for number in mine.union(carried_on) - replicator.owned:
                objects.mark_resting(replicator.record(number))
        self.interest_audit.update(self, touching)

    def leave(self) -> None:
        """Before the buses close: publish objects at rest on local robots in the world frame, as their parent goes."""
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
                )

    def side_of(self, point: np.ndarray) -> str:
        """The arm, "left" or "right", on the side of a point [3] m in the world."""
        base, _ = self.physics.rigid.base_state(self.name)
        local = frames.rotate(frames.conjugate(base[3:]), point - base[:3])
        return "left" if local[1] >= 0.0 else "right"

    # ------------------------------------------------------------------ remote actors

    def _receive_all(self, now: float) -> Inbox:
        """Merge the inboxes of all local actors; of each remote actor the update of its nearest one counts."""
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
        """Whether an actor of another client is in the world now."""
        return any(replicator.is_present(name) for replicator in self.replicators.values())

    def _is_owned_remotely(self, number: int) -> bool:
        """Whether an actor of another client owns an object or tree."""
        owners = {replicator.owner(number) for replicator in self.replicators.values()} - {None}
        return bool(owners) and not owners & self.replicators.keys()

    def _link_centre(self, name: str, link: str) -> np.ndarray | None:
        """Centre of mass [3] m of a link of a local robot; None if it is no robot or has no such link."""
        try:
            return self.physics.rigid.link_centre(name, link) if name in self.robots else None
        except ValueError:
            return None

    def _say_wrenches(self, name: str) -> dict[str, dict[str, np.ndarray]] | None:
        """Wrenches [6] N, N m of a local human's hands on remote robots."""
        return self.humans[name].hand_wrenches_on(self.remote_actors) if name in self.humans else None

    def _apply_wrenches(self, received: Mapping[str, dict[str, np.ndarray]]) -> None:
        """Apply the wrenches [6] N, N m of remote humans to the links of local robots."""
        for name in self.robots:
            try:
                self.physics.rigid.set_remote_wrenches(name, received[name])
            except RobotError as error:
                log.debug("a wrench on an unknown link: %s", error)

    def _say_couplings(self, name: str) -> list[Coupling]:
        """Couplings of a local actor's contacts with trees that others move or touch, too."""
        return self.couplings.of_actor(name, self.tree_copies.trees | self.couplings.trees)

    def _apply_couplings(self, received: Mapping[str, dict[str, tuple[Coupling, ...]]]) -> None:
        """Hold trees by the couplings of remote actors."""
        couplings: dict[str, tuple[Coupling, ...]] = {}
        for by_actor in received.values():
            for actor, theirs in by_actor.items():
                couplings[actor] = couplings.get(actor, ()) + theirs
        self.couplings.apply(couplings)


class InterestAudit:
    """Counts bytes of touched plants that leave while no remote actor is near; they must be zero."""

    MARGIN = 3.0
    """A tree is not a point: actors count as far beyond the interest radius and this [m]."""

    def __init__(self) -> None:
        self.bytes = 0
        """Environment bytes that left in ticks with no remote actor near."""
        self.ticks_touching = 0
        """Ticks in which this client touched plants with no remote actor near."""
        self._seen = 0

    def update(self, client: Client, touching: bool) -> None:
        """Count one tick, by where the remote actors say that they are: copies appear later, spectators have none."""
        replicators = client.replicators.values()
        sent = sum(replicator.counters.environment.bytes_out for replicator in replicators)
        if touching or sent != self._seen:
            there = [position[:2] for replicator in replicators for position in replicator.peer_positions()]
            away = np.inf
            if there:
                here = [client.physics.rigid.actor_position(name)[:2] for name in client.replicators]
                away = np.linalg.norm(np.reshape(here, (-1, 1, 2)) - np.reshape(there, (1, -1, 2)), axis=-1).min()
            if away > client.replicator.interest_radius + self.MARGIN:
                self.bytes += sent - self._seen
                self.ticks_touching += touching
        self._seen = sent
