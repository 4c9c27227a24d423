"""A client: its own simulation of the vineyard, the actors that it controls, and copies of all remote actors.

    client = Client(scene, model, description, bus, name="picker", pose=pose)
    while running:
        client.tick()

A tick has five parts: receive, control, step, sense, send. None of them waits for the network or for a picture.

A client controls one human, or one robot or several (D6.4 section 4.1); each robot is an actor of its own on the
network.
"""

from __future__ import annotations

import logging
import time
import zlib
from collections.abc import Callable
from concurrent.futures import Executor

import numpy as np

from vinesim import frames
from vinesim.avatar.local_human import LocalHuman
from vinesim.client.recording.trace import Trace
from vinesim.client.remote.objects import BLEND_PER_STEP, ObjectSync
from vinesim.client.remote.remote_human import RemoteHuman
from vinesim.client.remote.spawner import RemoteSpawner
from vinesim.net.codec.messages import Hello
from vinesim.net.replication import interest
from vinesim.net.replication.exchange import Exchange, Inbox
from vinesim.net.transport.bus import Bus
from vinesim.physics.plants.wind import Wind
from vinesim.physics.rigid.human_posture import standing_pose
from vinesim.physics.rigid.urdf import RobotError
from vinesim.physics.step import Physics
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.drives.remote_robot import RemoteRobot
from vinesim.robot.drives.robot import Robot
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene
from vinesim.scene.values import HumanPose, HumanSpec, HumanUpdate, RobotUpdate, TreeUpdate

log = logging.getLogger(__name__)


def label_index(name: str) -> int:
    """Index of an actor's label in images: the same on every client, from the name alone."""
    return zlib.crc32(name.encode()) % 4096


class Client:
    """One simulation of the world with its local actors. ``clock``: any monotonic clock [s]; tests pass their own."""

    picking = True
    """Whether bunches and branches detach in this client's physics when they are pulled too hard."""

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
        interest_radius: float = interest.NEAR,
        jitter_buffer: float = 0.0,
        device: str = "cpu",
        threads: int = 1,
        clock: Callable[[], float] = time.monotonic,
        executor: Executor | None = None,
    ) -> None:
        """A robot of this ``description`` at ``pose`` [7] m, 1; None: a human of ``height`` [m].

        ``source(time)`` gives the human's pose; without one it stands still. ``interest_radius`` [m]: actors nearer
        than this to an object receive its motion. ``jitter_buffer`` [s]: delay of remote actors. ``executor`` compiles
        actors that join; without one that is done in the loop.
        """
        self.name, self.model, self.scene = name, model, scene
        self.physics = Physics(model, parameters=scene.physics, device=device, threads=threads, detachment=self.picking)
        if any(scene.wind.mean) or scene.wind.gusts > 0.0:
            wind = scene.wind
            self.physics.wind = Wind(np.array(wind.mean), gusts=wind.gusts, scale=wind.scale, seed=scene.seed)
        self.robots: dict[str, Robot] = {}
        """Robots that this client simulates, by name; the first is :attr:`robot`."""
        self.humans: dict[str, LocalHuman] = {}
        """Humans that this client simulates, by name."""
        self.replicators: dict[str, Exchange] = {}
        """Network replication of each local actor, by name; the first is :attr:`replicator`."""
        self.objects = ObjectSync(self.physics, self.replicators)
        self._interest_radius, self._jitter_buffer = interest_radius, jitter_buffer
        self._add_own_actor(description, pose, source, height, bus)
        self.replicator = self.replicators[name]
        self.remote_actors: dict[str, RemoteRobot | RemoteHuman] = {}
        self.pre_step: list[Callable[[float], None]] = []
        """Called before every step with the simulation time [s]: tasks and commands of robots."""
        self.post_step: list[Callable[[Client], None]] = []
        """Called after every step: sensors, ROS, recorders."""
        self.frame_score: Callable[[], float] = lambda: 0.0 if self.trace is None else self.trace.displacement
        """How much there is to see now; the picture with the highest score is kept."""
        self.trace: Trace | None = None
        """If set, force on and displacement of one bunch are recorded in it."""
        self.interest_audit = InterestAudit()
        self._clock = clock
        self._remote_trees: dict[int, TreeUpdate] = {}
        self.spawner = RemoteSpawner(self.physics.rigid, description, executor)

    def _add_own_actor(
        self, description: RobotDescription | None, pose: np.ndarray, source: Callable[[float], HumanPose] | None,
        height: float, bus: Bus,
    ) -> None:  # fmt: skip
        """Add the actor that gives this client its name."""
        if description is None:
            spec = HumanSpec(self.name, label_index(self.name), standing_pose(pose, height), height)
            self.add_human(spec, source, bus)
        else:
            self.robot = self.add_robot(description, self.name, pose, bus)

    def add_robot(self, description: RobotDescription, name: str, pose: np.ndarray, bus: Bus) -> Robot:
        """Add a local robot at ``pose`` [7] m, 1; ``bus`` must have its ``name``."""
        hello = Hello(
            name=name, kind="robot", robot=description.name, urdf=description.urdf, scene=self.scene.name,
            digest=self.model.digest(), index=label_index(name), joints=len(description.joints),
            seed=self.scene.seed,
        )  # fmt: skip
        exchange = Exchange(bus, hello, self.model, near=self._interest_radius, jitter_buffer=self._jitter_buffer)
        self.robots[name] = robot = Robot(self.physics.rigid, description, name, label_index(name), pose)
        robot.fit_cutters(self.physics)
        self._add_replicator(name, exchange)
        return robot

    def add_human(self, spec: HumanSpec, source: Callable[[float], HumanPose] | None, bus: Bus) -> LocalHuman:
        """Move one more person as ``source`` says (see :class:`Person`; None: still); ``bus`` is opened in its name."""
        hello = Hello(
            name=spec.name, kind="human", scene=self.scene.name, digest=self.model.digest(), index=spec.index,
            height=spec.height, seed=self.scene.seed,
        )  # fmt: skip
        exchange = Exchange(bus, hello, self.model, near=self._interest_radius, jitter_buffer=self._jitter_buffer)
        self.humans[spec.name] = person = LocalHuman(self.physics, spec, source or (lambda _: spec.pose))
        self._add_replicator(spec.name, exchange)
        return person

    def _add_replicator(self, name: str, exchange: Exchange) -> None:
        self.replicators[name] = exchange
        for own, share in self.replicators.items():
            share.kin = self.replicators.keys() - {own}

    def tick(self) -> None:
        """Simulate one step of ``physics.dt``."""
        now = self._clock()
        self.receive(now)
        self.control()
        self.physics.step()
        self.sense()
        self.send(now)

    # ------------------------------------------------------------------ the five parts of a tick

    def receive(self, now: float) -> None:
        """Add and remove remote actors, move their copies, and apply the states of trees and objects that they own."""
        inbox = self._receive_all(now)
        for hello in inbox.joined:
            log.info("%s joined as %s", hello.name, hello.kind)
            if hello.kind in ("robot", "human"):
                self.spawner.enqueue(hello)
        for name in inbox.left:
            self.spawner.cancel(name)
            if (other := self.remote_actors.pop(name, None)) is not None:
                other.remove()
                self.physics.contact_solver.remote_actors.discard(name)
                log.info("%s left", name)
        for name, update in (*inbox.robots.items(), *inbox.people.items()):
            if name in self.spawner and (other := self.spawner.spawn(name, update)) is not None:
                self.remote_actors[name] = other
                self.physics.contact_solver.remote_actors.add(name)
            if name in self.remote_actors:
                self.remote_actors[name].follow(update)
        self._apply_remote_trees(inbox)

    def control(self) -> None:
        """Run the callbacks of :attr:`pre_step`, then the drives of robots and the poses of humans."""
        for job in self.pre_step:
            job(self.physics.time)
        for robot in self.robots.values():
            robot.control(self.physics.time)
        for person in self.humans.values():
            person.control(self.physics.time)

    def sense(self) -> None:
        """Record the traced bunch, then run the callbacks of :attr:`post_step`."""
        if self.trace is not None:
            self.physics.update_kinematics()
            body = self.trace.body
            force = np.zeros(3)
            for contact in self.physics.contacts:
                if contact.body in self.trace.bodies:
                    force -= contact.force
            told = int(self.model.body_tree[body]) in self._remote_trees
            self.trace.add(self.physics.time, self.physics.state.body_q[body], force, told)
        for sense in self.post_step:
            sense(self)

    def send(self, now: float) -> None:
        """Publish poses of local actors, and to actors nearby the states of what they touch."""
        things = self.objects
        things.collect()
        moving, touching = things.moving, False
        for name, actor in (*self.robots.items(), *self.humans.items()):
            exchange, pose = self.replicators[name], actor.update(now)
            mine = exchange.mine
            parted = things.detached_by(name, all_others=name == self.name)
            touched = things.touched_by(name, mine)
            touching |= bool(touched)
            settled = exchange.send(
                now, pose, touched=touched, moving=moving, read=things.read_state,
                grabbed=things.with_trees(parted), parted=parted, cut=things.cut_roots, changed=things.is_changed,
                lies=self.physics.support_tracker.pose_on_support, pushed=actor.hand_wrenches_on(self.remote_actors) if isinstance(actor, LocalHuman) else None,
            )  # fmt: skip
            for update in settled:
                # the last message is what all copies hold: hold the same, quantised state
                things.blend_tree(update, 1.0)
            for number in mine - exchange.mine:
                things.mark_resting(exchange.fact(number))
        self.interest_audit.update(self, touching)

    def leave(self) -> None:
        """Before the buses close: publish objects at rest on local robots in the world frame, as their parent goes."""
        now = self._clock()
        for name, robot in self.robots.items():
            riders = self.objects.supported_by(name)
            if riders:
                self.replicators[name].send(
                    now, robot.update(now), read=self.objects.read_state, grabbed=riders, parted=riders,
                    lies=self.physics.support_tracker.pose_on_support,
                )  # fmt: skip

    def side_of(self, point: np.ndarray) -> str:
        """The arm, "left" or "right", on the side of a point [3] m in the world."""
        base, _ = self.physics.rigid.base_state(self.name)
        local = frames.rotate(frames.conjugate(base[3:]), point - base[:3])
        return "left" if local[1] >= 0.0 else "right"

    # ------------------------------------------------------------------ remote actors

    def _receive_all(self, now: float) -> Inbox:
        """What all exchanges brought: of another actor, what is heard where it is nearest."""
        inboxes = {name: exchange.receive(now) for name, exchange in self.replicators.items()}
        for name in self.robots:
            self._apply_remote_wrenches(name, inboxes[name].pushes)
        inbox = inboxes[self.name]
        if len(inboxes) == 1:
            return inbox
        here = {name: self.physics.rigid.actor_position(name)[:2] for name in inboxes}
        trees = {update.tree: update for update in inbox.trees}
        loose = {update.thing: update for update in inbox.things}
        nearest: dict[str, tuple[float, RobotUpdate | HumanUpdate]] = {}
        for name, heard in inboxes.items():
            for other, update in (*heard.robots.items(), *heard.people.items()):
                away = float(np.hypot(*(update.base_q[:2] - here[name])))
                if other not in nearest or away < nearest[other][0]:
                    nearest[other] = away, update
            trees.update((update.tree, update) for update in heard.trees)
            loose.update((update.thing, update) for update in heard.things)
            if heard is not inbox:
                inbox.facts += heard.facts
        shown = [update for _, (_, update) in sorted(nearest.items())]
        inbox.robots = {update.actor: update for update in shown if isinstance(update, RobotUpdate)}
        inbox.people = {update.actor: update for update in shown if isinstance(update, HumanUpdate)}
        inbox.trees = [trees[tree] for tree in sorted(trees)]
        inbox.things = [loose[number] for number in sorted(loose) if self._is_owned_remotely(number)]
        return inbox

    def _is_owned_remotely(self, thing: int) -> bool:
        """Whether an actor of another client owns an object or tree."""
        owners = {exchange.owner(thing) for exchange in self.replicators.values()} - {None}
        return bool(owners) and not owners & self.replicators.keys()

    def _apply_remote_wrenches(self, name: str, pushes: dict[str, np.ndarray]) -> None:
        """Apply the wrenches [6] N, N m of remote humans to the links of a local robot."""
        try:
            self.physics.rigid.set_remote_wrenches(name, pushes)
        except RobotError as error:
            log.debug("a wrench on an unknown link: %s", error)

    def _apply_remote_trees(self, inbox: Inbox) -> None:
        """Blend trees of remote owners towards their states, in every tick; local physics goes on beside."""
        things, told = self.objects, self.physics.contact_solver.remote_trees
        for update in inbox.trees:
            if update.tree not in self._remote_trees:
                self.physics.plants.wake(update.tree)
                things.blend_tree(update, 1.0)
                told[update.tree] = True
            self._remote_trees[update.tree] = update
        for tree in [tree for tree in self._remote_trees if not self._is_owned_remotely(tree)]:
            update = self._remote_trees.pop(tree)
            told[tree] = False
            if update.resting:
                things.blend_tree(update, 1.0)
        for tree, update in self._remote_trees.items():
            self.physics.plants.wake(tree)
            things.blend_tree(update, BLEND_PER_STEP)
        things.receive(inbox)


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
        """Count one tick, by the positions of the remote actors' copies."""
        sent = sum(exchange.counters.environment.bytes_out for exchange in client.replicators.values())
        rigid = client.physics.rigid
        here = [rigid.actor_position(name)[:2] for name in client.replicators]
        there = [rigid.actor_position(name)[:2] for name in client.remote_actors]
        distance = min((float(np.hypot(*(a - b))) for a in here for b in there), default=np.inf)
        if distance > client.replicator.near + self.MARGIN:
            self.bytes += sent - self._seen
            self.ticks_touching += touching
        self._seen = sent
