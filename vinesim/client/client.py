"""One client: its own copy of the vineyard, the actor it controls, and the others as the network tells of them.

    client = Client(scene, model, description, bus, name="picker", pose=pose)
    while running:
        client.tick()

A tick is five steps: receive, control, step, sense, send. Nothing in it waits: not for the network, not for a picture.

One client moves one robot, or several (D6.4 section 4.1): then each is an actor of its own on the network. Or it moves
a person.
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
from vinesim.net.replication.exchange import Inbox, Replicator
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
    """The index of an actor's label, the same on every client without asking anybody."""
    return zlib.crc32(name.encode()) % 4096


class Client:
    """One actor's share of a world. ``clock`` is any steady clock in seconds; tests pass their own."""

    picking = True
    """Whether bunches part here when they are pulled too hard."""

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
        interest_radius: float = interest.INTEREST_RADIUS,
        jitter_buffer: float = 0.0,
        device: str = "cpu",
        threads: int = 1,
        clock: Callable[[], float] = time.monotonic,
        executor: Executor | None = None,
    ) -> None:
        """A robot of this ``description``; None: a person of ``height`` [m], still or where ``source`` says.

        ``executor`` prepares others who join, so that no tick has to; without one they are there at once.
        """
        self.name, self.model, self.scene = name, model, scene
        self.physics = Physics(model, parameters=scene.physics, device=device, threads=threads, detachment=self.picking)
        if any(scene.wind.mean) or scene.wind.gusts > 0.0:
            wind = scene.wind
            self.physics.wind = Wind(np.array(wind.mean), gusts=wind.gusts, scale=wind.scale, seed=scene.seed)
        self.robots: dict[str, Robot] = {}
        """All robots that this client moves, by name; the first is :attr:`robot`."""
        self.humans: dict[str, LocalHuman] = {}
        """All people that this client moves, by name."""
        self.replicators: dict[str, Replicator] = {}
        """The share of each in the world, by name; the first is :attr:`exchange`."""
        self.objects = ObjectSync(self.physics, self.replicators)
        self._interest_radius, self._jitter_buffer = interest_radius, jitter_buffer
        self._add_own_actor(description, pose, source, height, bus)
        self.replicator = self.replicators[name]
        self.remote_actors: dict[str, RemoteRobot | RemoteHuman] = {}
        self.pre_step: list[Callable[[float], None]] = []
        """Called every tick with the simulation time, before the drives: what the robot is to do."""
        self.post_step: list[Callable[[Client], None]] = []
        """Called every tick after the step: ROS, cameras, whoever wants to know."""
        self.frame_score: Callable[[], float] = lambda: 0.0 if self.trace is None else self.trace.displacement
        """How much there is to see now: of the pictures, that of the greatest moment is kept."""
        self.trace: Trace | None = None
        """If set, what happens to one bunch is noted in it."""
        self.interest_audit = InterestAudit()
        self._clock = clock
        self._remote_trees: dict[int, TreeUpdate] = {}
        self.spawner = RemoteSpawner(self.physics.rigid, description, executor)

    def _add_own_actor(
        self, description: RobotDescription | None, pose: np.ndarray, source: Callable[[float], HumanPose] | None,
        height: float, bus: Bus,
    ) -> None:  # fmt: skip
        """Come into the world as what this client is to be."""
        if description is None:
            spec = HumanSpec(self.name, label_index(self.name), standing_pose(pose, height), height)
            self.add_human(spec, source, bus)
        else:
            self.robot = self.add_robot(description, self.name, pose, bus)

    def add_robot(self, description: RobotDescription, name: str, pose: np.ndarray, bus: Bus) -> Robot:
        """Move one more robot, standing at ``pose`` [7]; ``bus`` is opened in its name."""
        hello = Hello(
            name=name, kind="robot", robot=description.name, urdf=description.urdf, scene=self.scene.name,
            digest=self.model.digest(), index=label_index(name), joints=len(description.joints),
            seed=self.scene.seed,
        )  # fmt: skip
        exchange = Replicator(bus, hello, self.model, near=self._interest_radius, jitter_buffer=self._jitter_buffer)
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
        exchange = Replicator(bus, hello, self.model, near=self._interest_radius, jitter_buffer=self._jitter_buffer)
        self.humans[spec.name] = person = LocalHuman(self.physics, spec, source or (lambda _: spec.pose))
        self._add_replicator(spec.name, exchange)
        return person

    def _add_replicator(self, name: str, exchange: Replicator) -> None:
        self.replicators[name] = exchange
        for own, share in self.replicators.items():
            share.local_actors = self.replicators.keys() - {own}

    def tick(self) -> None:
        """Ten milliseconds of the vineyard."""
        now = self._clock()
        self.receive(now)
        self.control()
        self.physics.step()
        self.sense()
        self.send(now)

    # ------------------------------------------------------------------ the five steps

    def receive(self, now: float) -> None:
        """Let others come and go, move their copies, and hear of the trees they touch."""
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
        """Do the jobs, then hand set-points to the drives; people go where they are told."""
        for job in self.pre_step:
            job(self.physics.time)
        for robot in self.robots.values():
            robot.control(self.physics.time)
        for person in self.humans.values():
            person.control(self.physics.time)

    def sense(self) -> None:
        """Note the watched bunch, and tell everybody who listens."""
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
        """Say where robots and people are, and what they touch to those who are near."""
        things = self.objects
        things.collect()
        moving, touching = things.moving, False
        for name, actor in (*self.robots.items(), *self.humans.items()):
            exchange, pose = self.replicators[name], actor.update(now)
            mine = exchange.owned
            parted = things.detached_by(name, all_others=name == self.name)
            touched = things.touched_by(name, mine)
            touching |= bool(touched)
            settled = exchange.send(
                now, pose, touched=touched, moving=moving, read=things.read_state,
                grabbed=things.with_trees(parted), parted=parted, cut=things.cut_roots, changed=things.is_changed,
                lies=self.physics.support_tracker.pose_on_support, pushed=actor.hand_wrenches_on(self.remote_actors) if isinstance(actor, LocalHuman) else None,
            )  # fmt: skip
            for update in settled:
                # the last word is what all copies hold: hold it too
                things.blend_tree(update, 1.0)
            for number in mine - exchange.owned:
                things.mark_resting(exchange.record(number))
        self.interest_audit.update(self, touching)

    def leave(self) -> None:
        """Before the buses close: say of what rides on our robots where it is, for with them its parent goes."""
        now = self._clock()
        for name, robot in self.robots.items():
            riders = self.objects.supported_by(name)
            if riders:
                self.replicators[name].send(
                    now, robot.update(now), read=self.objects.read_state, grabbed=riders, parted=riders,
                    lies=self.physics.support_tracker.pose_on_support,
                )  # fmt: skip

    def side_of(self, point: np.ndarray) -> str:
        """The arm that is on the same side as a point [3] in the world."""
        base, _ = self.physics.rigid.base_state(self.name)
        local = frames.rotate(frames.conjugate(base[3:]), point - base[:3])
        return "left" if local[1] >= 0.0 else "right"

    # ------------------------------------------------------------------ others

    def _receive_all(self, now: float) -> Inbox:
        """What all exchanges brought: of another actor, what is heard where it is nearest."""
        inboxes = {name: exchange.receive(now) for name, exchange in self.replicators.items()}
        for name in self.robots:
            self._apply_remote_wrenches(name, inboxes[name].wrenches)
        inbox = inboxes[self.name]
        if len(inboxes) == 1:
            return inbox
        here = {name: self.physics.rigid.actor_position(name)[:2] for name in inboxes}
        trees = {update.tree: update for update in inbox.trees}
        loose = {update.object: update for update in inbox.objects}
        nearest: dict[str, tuple[float, RobotUpdate | HumanUpdate]] = {}
        for name, heard in inboxes.items():
            for other, update in (*heard.robots.items(), *heard.people.items()):
                away = float(np.hypot(*(update.base_q[:2] - here[name])))
                if other not in nearest or away < nearest[other][0]:
                    nearest[other] = away, update
            trees.update((update.tree, update) for update in heard.trees)
            loose.update((update.object, update) for update in heard.objects)
            if heard is not inbox:
                inbox.records += heard.records
        shown = [update for _, (_, update) in sorted(nearest.items())]
        inbox.robots = {update.actor: update for update in shown if isinstance(update, RobotUpdate)}
        inbox.people = {update.actor: update for update in shown if isinstance(update, HumanUpdate)}
        inbox.trees = [trees[tree] for tree in sorted(trees)]
        inbox.objects = [loose[number] for number in sorted(loose) if self._is_owned_remotely(number)]
        return inbox

    def _is_owned_remotely(self, thing: int) -> bool:
        """Whether another client owns a thing: nobody of one's own does, and somebody is known to."""
        owners = {exchange.owner(thing) for exchange in self.replicators.values()} - {None}
        return bool(owners) and not owners & self.replicators.keys()

    def _apply_remote_wrenches(self, name: str, pushes: dict[str, np.ndarray]) -> None:
        """Let a robot feel what other clients' people do to it."""
        try:
            self.physics.rigid.set_remote_wrenches(name, pushes)
        except RobotError as error:
            log.debug("a push on nothing: %s", error)

    def _apply_remote_trees(self, inbox: Inbox) -> None:
        """Draw the copies of others' trees towards their owners' states, every tick; their own physics goes on."""
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
    """Counts what this client sends of touched plants while nobody is near: nothing, if all is well."""

    MARGIN = 3.0
    """A tree is not a point: others count as far beyond ``near`` and this [m]."""

    def __init__(self) -> None:
        self.bytes = 0
        """Environment bytes that left in ticks with nobody near."""
        self.ticks_touching = 0
        """Ticks in which this client touched plants with nobody near."""
        self._seen = 0

    def update(self, client: Client, touching: bool) -> None:
        """Judge one tick by where the others' copies stand."""
        sent = sum(exchange.counters.environment.bytes_out for exchange in client.replicators.values())
        rigid = client.physics.rigid
        here = [rigid.actor_position(name)[:2] for name in client.replicators]
        there = [rigid.actor_position(name)[:2] for name in client.remote_actors]
        distance = min((float(np.hypot(*(a - b))) for a in here for b in there), default=np.inf)
        if distance > client.replicator.interest_radius + self.MARGIN:
            self.bytes += sent - self._seen
            self.ticks_touching += touching
        self._seen = sent
