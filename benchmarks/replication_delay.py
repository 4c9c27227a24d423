"""``python -m benchmarks sync``: effect of network delay on contacts, on copies, and on two actors who push one bunch.

Everything but the last rows runs in simulated time over the bus in memory, with seeded delay, jitter and loss: real
clients with their physics, and the same figures on every machine. The last rows are processes over Zenoh and emulated
links, in real time.

Delays are one way. Jitter is plus or minus a fifth of the delay; one message in a hundred is lost.
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np

from vinesim.client.client import Client
from vinesim.client.recording.bunch_trace import Trace
from vinesim.client.tasks.start_poses import bunch_centres, find_reachable_bunch, spawn_pose
from vinesim.core import frames
from vinesim.net.codec.control import decode_time, encode_time
from vinesim.net.codec.robot import decode_robot, encode_robot
from vinesim.net.codec.trees import TreeStates, decode_trees, encode_trees
from vinesim.net.replication import dead_reckoning
from vinesim.net.replication.interest import POSE_RATE
from vinesim.net.replication.jitter_buffer import JitterBuffer
from vinesim.net.replication.receiver import Inbox
from vinesim.net.transport.bus import KEEP_ALL
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description as load_robot
from vinesim.robot.drives.robot_instance import RemoteRobot
from vinesim.robot.tasks.push import Phase, PushBunch
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene, load_scene
from vinesim.scene.values import Measurement, TreeUpdate
from vinesim.world import Physics

DT = 0.01
DELAYS = (0.0, 0.020, 0.050, 0.100)
"""Measured delays, one way [s]."""

JITTER = 0.2
LOSS = 0.01
"""Probability that a message is lost. ``JITTER`` is the largest deviation from the delay, as a share of it."""

LATE = (0.020, 0.050, 0.100, 0.150)
"""Ages of states that are extrapolated to the present [s]."""

REST_AT = 0.050
"""Delay at which a pushed bunch is followed until it rests [s]."""

BUFFERS = (0.0, 0.050, 0.080, 0.100, 0.150)
BUFFERED_JITTER = (0.0, 0.020, 0.040)
"""Jitter at which the jitter buffers are tested, at a delay of 50 ms [s]. ``BUFFERS`` has the lengths of the buffers
[s]."""

SEEN = 0.001
"""Rotation of a joint from which the tree's bunch counts as visibly moved [rad]: about half a millimetre at the
bunch."""


@functools.cache
def _load_scene() -> tuple[Scene, Model, RobotDescription]:
    scene = msgspec.structs.replace(load_scene("demo"), boxes=())  # the second robot stands in place of the boxes
    model = generate(scene)
    model.bunch_pull[:] = model.bunch_bend[:] = 1e6  # a client that fights by the wrong rule would tear the bunch off
    return scene, model, load_robot("vinebot")


class Pair:
    """Two robots within reach of one bunch, each in a client of its own, on a bus with delay."""

    def __init__(self, delay: float, *, jitter: float = JITTER, loss: float = LOSS, seed: int = 1) -> None:
        self.scene, self.model, robot = _load_scene()
        self.now = 100.0
        self.hub = MemoryHub(delay=delay, jitter=jitter * delay, loss=loss if delay else 0.0, seed=seed)
        server = self.hub.bus("server")
        server.declare_queryable("clock/*", lambda asked: encode_time(decode_time(asked)[0], self.now))
        start = spawn_pose(self.scene, 0)
        self.bunch = find_reachable_bunch(self.model, start)
        self.tree = int(self.model.body_tree[self.model.bunch_body[self.bunch]])
        self.clients: list[Client] = []
        middle = bunch_centres(self.model)[self.bunch]
        opposite = 2.0 * middle[:2] - start[:2]
        heading = np.arctan2(*(middle[:2] - opposite)[::-1])
        poses = {"first": start, "second": frames.pose([*opposite, 0.0], frames.from_yaw(heading))}
        for name, pose in poses.items():
            client = Client(
                self.scene, self.model, robot, self.hub.bus(name), name=name, pose=pose, clock=lambda: self.now
            )
            body = int(self.model.bunch_body[self.bunch])
            client.trace = Trace(self.model, self.bunch, client.physics.state.body_q[body].copy(), 1 << 14)
            self.clients.append(client)
        self.first, self.second = self.clients
        self.inbox = Inbox()
        """Messages that the second client received in its last tick."""
        receive = self.second.replicator.receive

        def receive_and_keep(now: float) -> Inbox:
            self.inbox = receive(now)
            return self.inbox

        self.second.replicator.receive = receive_and_keep

    def push(self, who: Client, **options: Any) -> PushBunch:
        """Let the robot of the client ``who`` push the bunch once; returns the task."""
        rest = _trace(who).centre()
        reach = PushBunch(who.robot, who.side_of(rest), lambda: rest, repeat=False, **options)
        who.pre_step.append(reach.control)
        return reach

    def enable_naive_authority(self) -> None:
        """For comparison, let every touch take the tree from its owner, again and again."""
        for client in self.clients:
            rule = functools.partial(_grab, client, client.replicator.send)
            vars(client.replicator)["send"] = rule  # hides the method of the class

    def tick(self) -> None:
        """Step both clients once."""
        for client in self.clients:
            client.tick()
        self.hub.advance(DT)
        self.now += DT

    def meet(self) -> None:
        """Step until each client has a copy of the other's robot and knows the network clock."""
        for _ in range(150):
            self.tick()
        assert self.first.remote_actors
        assert self.second.remote_actors


def _grab(
    client: Client,
    send: Callable[..., list[TreeUpdate]],
    *args: Any,
    touched: list[int],
    grabbed: list[int],
    **options: Any,
) -> Any:
    others = [tree for tree in touched if client.replicator.owner(tree) not in (None, client.name)]
    return send(*args, touched=touched, grabbed=[*grabbed, *others], **options)


def _trace(client: Client) -> Trace:
    assert client.trace is not None
    return client.trace


class RemoteAuthority:
    """For comparison: a remote simulation that alone moves all plants, and a client that shows the states it sends.

    The remote simulation follows the poses of the robot as any client does, but its own physics decides what the robot
    touches. In every step it sends all trees that are awake.
    """

    def __init__(self, pair: Pair) -> None:
        self.pair = pair
        self._bus = pair.hub.bus("authority")
        self._screen = pair.hub.bus("screen")
        self._bus.subscribe("authority/pose")
        self._screen.subscribe("authority/trees", KEEP_ALL)
        self._say = self._screen.publisher("authority/pose")
        self._answer = self._bus.publisher("authority/trees")
        self.physics = Physics(pair.model, detachment=False)
        self._copy: RemoteRobot | None = None
        self.joint_q = pair.model.joint_settled[pair.model.bodies_of(pair.tree)].copy()
        """Joint rotations of the watched tree, as the client shows them [body, 4]."""

    def tick(self) -> None:
        """Step the remote simulation once, before the time of the hub advances."""
        pair = self.pair
        physics = self.physics
        robot = pair.first.robot
        self._say.put(encode_robot(robot.update(pair.now)))
        for _, payload in self._bus.poll():
            update = decode_robot(payload, "first")
            if self._copy is None:
                self._copy = RemoteRobot(physics.rigid, robot.description, "first", 1, update.base_q)
            self._copy.follow(update)
        physics.step()
        awake = np.sort(physics.plants.awake)
        if len(awake):
            bodies = np.concatenate([np.arange(b.start, b.stop) for b in map(pair.model.bodies_of, awake.tolist())])
            zeros = np.zeros(len(awake), int)
            said = TreeStates(
                pair.now,
                awake,
                zeros,
                zeros,
                zeros,
                pair.model.tree_size[awake].astype(int),
                physics.state.joint_q[bodies].astype(float),
                physics.state.joint_qd[bodies].astype(float),
            )
            for message in encode_trees(said)[0]:
                self._answer.put(message)
        for _, payload in self._screen.poll():
            for update in decode_trees(payload).updates("authority"):
                if update.tree == pair.tree:
                    self.joint_q = update.joint_q


@dataclasses.dataclass
class RunRows:
    """States on both clients, one row a step."""

    force: np.ndarray
    """Force on the bunch [tick, 2] N: of the first robot in its own client, and of the second robot in its own
    client."""
    bunch: np.ndarray
    """Displacement of the bunch on both clients [tick, 2, 3] m."""
    tree: np.ndarray
    """Joint rotations of the bunch's tree on both clients and as a remote authority would show them [tick, 3, body, 4];
    the last ones are recorded only until the contact was visible."""
    rate: np.ndarray
    """Joint rates of the tree on the first client [tick, body, 3] rad/s."""
    joints: np.ndarray
    """Joint positions of the first robot: its own, as shown to the second client, and of the second client's copy
    [tick, 3, joint]."""
    speed: np.ndarray
    """Joint rates of the first robot [tick, joint] rad/s, m/s."""

    @property
    def touch(self) -> int:
        """Index of the first step with a force of the first robot."""
        return int(np.argmax(self.force[:, 0] > 0.0))

    def seen(self, who: int) -> float:
        """Returns the time from the first force until the bunch visibly moves on client ``who`` [s]; 2: the remote
        authority."""
        turned = dead_reckoning.angle_between(self.tree[self.touch :, who], self.tree[self.touch - 1, who]).max(-1)
        return DT * float(np.argmax(turned > SEEN)) if (turned > SEEN).any() else float("nan")

    def divergence(self) -> np.ndarray:
        """Returns the distance between the bunches of both clients at the same instant [step] mm, for the steps in
        which the bunch is displaced by at least 2 mm on one client."""
        moved = np.linalg.norm(self.bunch, axis=-1).max(-1) > 0.002
        return 1e3 * np.linalg.norm(self.bunch[moved, 0] - self.bunch[moved, 1], axis=-1)


class RunRecorder:
    """Records one row a step."""

    def __init__(self, pair: Pair, authority: RemoteAuthority | None = None) -> None:
        self.pair = pair
        self.authority = authority
        self._rows: list[tuple] = []

    def tick(self) -> None:
        """Step both clients and record a row."""
        pair = self.pair
        pair.tick()
        here = pair.model.bodies_of(pair.tree)
        states = [client.physics.state for client in pair.clients]
        shown = [state.joint_q[here].astype(float) for state in states]
        if self.authority is not None:
            self.authority.tick()
        shown.append(self.authority.joint_q if self.authority is not None else shown[0])
        told = pair.inbox.robots["first"].position
        position, speed = (x.copy() for x in pair.first.physics.rigid.joint_measurements("first")[:2])
        copy = pair.second.physics.rigid.joint_measurements("first")[0].copy()
        force = [np.linalg.norm(_trace(client).rows().force[-1]) for client in pair.clients]
        bunch = np.stack([_trace(client).rows().displacement[-1] for client in pair.clients])
        joints = np.stack([position, told, copy])
        self._rows.append((force, bunch, np.stack(shown), states[0].joint_qd[here].astype(float), joints, speed))

    def rows(self) -> RunRows:
        """Returns all recorded rows."""
        return RunRows(*(np.array(column) for column in zip(*self._rows, strict=True)))


def one_push(delay: float, *, quiet: float = 0.0) -> RunRows:
    """Let the first robot push the bunch while the second looks on, then give both clients ``quiet`` [s] to come to
    rest."""
    pair = Pair(delay)
    pair.meet()
    reach = pair.push(pair.first, hold_time=0.5)
    recorder = RunRecorder(pair, RemoteAuthority(pair))
    until = 0
    for tick in range(2000):
        recorder.tick()
        if recorder.authority is not None and reach.phase is Phase.HOLD:
            recorder.authority = None  # the remote authority has shown the contact long ago
        if reach.phase is Phase.DONE:
            until = tick
            break
    robot = pair.first.robot
    robot.command_position(robot.description.home)
    for _ in range(round(quiet / DT)):
        recorder.tick()
        if all(client.replicator.owner(pair.tree) is None for client in pair.clients):
            until += 1
            if until > 100:
                break
    return recorder.rows()


def both_push(delay: float, *, naive: bool = False, hold: float = 4.0) -> RunRows:
    """Let both robots push the bunch at once from opposite sides. ``naive``: with
    :meth:`Pair.enable_naive_authority`."""
    pair = Pair(delay)
    if naive:
        pair.enable_naive_authority()
    pair.meet()
    reaches = [pair.push(client, hold_time=hold) for client in pair.clients]
    recorder = RunRecorder(pair)
    for _ in range(2000):
        recorder.tick()
        if all(reach.phase in (Phase.RETREAT, Phase.DONE) for reach in reaches):
            break
    return recorder.rows()


# ---------------------------------------------------------------- figures


def extrapolation(rows: RunRows, ahead: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Returns RMS errors of a state that is ``ahead`` [s] old: of the tree [rad] and of the robot [rad], each with
    extrapolation by its velocity and without.

    Only ticks in which the tree or the robot moves count.
    """
    shift = round(ahead / DT)
    tree = rows.tree[:, 0]
    later = tree[shift:]
    rate = dead_reckoning.quaternion_rate(tree, rows.rate)
    told = dead_reckoning.extrapolate(tree, rate, dead_reckoning.faded_age(ahead))[:-shift]
    errors = [dead_reckoning.angle_between(later, guess).max(-1) for guess in (told, tree[:-shift])]
    moves = np.abs(rows.rate).max((1, 2))[:-shift] > 0.02
    own = rows.joints[:, 0]
    speed = rows.speed
    robot = [np.abs(own[shift:] - guess).max(-1) for guess in ((own + ahead * speed)[:-shift], own[:-shift])]
    drives = np.abs(speed).max(-1)[:-shift] > 0.02

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return (rms(errors[0][moves]), rms(errors[1][moves])), (rms(robot[0][drives]), rms(robot[1][drives]))


def count_reversals(signal: np.ndarray, least: float = 0.010) -> int:
    """Returns how often a signal [step] reverses its direction, by at least ``least`` each time."""
    count = 0
    way = 0
    extreme = float(signal[0])
    for value in signal.tolist():
        if way == 0:
            way = int(np.sign(value - extreme)) if abs(value - extreme) >= least else 0
            extreme = value if way else extreme
        elif way * (value - extreme) > 0.0:
            extreme = value
        elif way * (extreme - value) >= least:
            count = count + 1
            way = -way
            extreme = value
    return count


def displacement_along(rows: RunRows) -> np.ndarray:
    """Returns the displacement of the bunch on both clients along the line from the first robot to the bunch [step, 2]
    m."""
    start = spawn_pose(_load_scene()[0], 0)[:2]
    line = (
        bunch_centres(_load_scene()[1])[find_reachable_bunch(_load_scene()[1], spawn_pose(_load_scene()[0], 0))][:2]
        - start
    )
    return rows.bunch[..., :2] @ (line / np.linalg.norm(line))


def oscillation(rows: RunRows) -> tuple[float, float]:
    """Returns the period [s] with which the bunch oscillates while both robots push (infinite without oscillation), and
    the range of its displacement [mm]."""
    both = np.flatnonzero((rows.force > 0.0).any(1))
    pulled = displacement_along(rows)[both[0] + 100 : both[-1]]
    count = max(count_reversals(pulled[:, who]) for who in (0, 1))
    span = 1e3 * float(np.percentile(pulled, 97.5) - np.percentile(pulled, 2.5))
    return (2.0 * DT * len(pulled) / count if count >= 4 else float("inf")), span


def buffered(rows: RunRows, delay: float, jitter: float, wait: float, seed: int = 5) -> tuple[float, float]:
    """Play the robot's joints through a jitter buffer of ``wait`` [s]. Returns two RMS errors [mrad] of the joint with
    the largest error: to the present positions, and to the positions ``wait`` earlier, that is to the path.
    """
    chance = np.random.default_rng(seed)
    own = rows.joints[:, 0]
    speed = rows.speed
    sent = np.arange(0.0, DT * (len(own) - 1), 1.0 / POSE_RATE)
    tick = np.rint(sent / DT).astype(int)
    arrives = DT * tick + delay + chance.uniform(-jitter, jitter, len(sent))
    arrives[chance.random(len(sent)) < LOSS] = np.inf
    mail = sorted(zip(arrives.tolist(), tick.tolist(), strict=True))
    buffer = JitterBuffer(wait)
    now_errors = []
    path_errors = []
    for k in range(len(own)):
        while mail and mail[0][0] <= DT * k:
            _, when = mail.pop(0)
            buffer = buffer.insert(DT * when, own[when], speed[when])
        if DT * k < 1.0:
            continue
        shown = buffer.sample(DT * k)
        now_errors.append(np.abs(shown - own[k]).max())
        path_errors.append(np.abs(shown - own[k - round(wait / DT)]).max())
    return tuple(1e3 * float(np.sqrt(np.mean(np.square(e)))) for e in (now_errors, path_errors))  # type: ignore[return-value]


def sync(delays: tuple[float, ...] = DELAYS, *, plot: pathlib.Path | None = None) -> Iterator[Measurement]:
    """Yields all rows of the benchmark; ``plot``: file for a picture of them."""
    lines: list[Measurement] = []
    fights: dict[tuple[float, bool], RunRows] = {}
    for line in _sync(delays, fights):
        lines.append(line)
        yield line
    if plot is not None:
        from benchmarks.replication_delay_plot import draw

        draw(lines, {key: 1e3 * displacement_along(rows) for key, rows in fights.items()}, plot)


def _sync(delays: tuple[float, ...], fights: dict[tuple[float, bool], RunRows]) -> Iterator[Measurement]:
    def line(case: str, value: float, unit: str, peer: str = "", peer_value: float | None = None) -> Measurement:
        ratio = None if peer_value is None or not value else peer_value / value
        return Measurement("sync", case, float(value), unit, peer, peer_value, ratio)

    for delay in delays:
        at = f"{1e3 * delay:.0f} ms"
        rows = one_push(delay, quiet=40.0 if delay == REST_AT else 0.0)
        own, seen, far = (1e3 * rows.seen(who) for who in range(3))
        yield line(f"{at}: touch to motion, one's own", own, "ms", "one authority far away", far)
        yield line(f"{at}: touch to motion, seen by another", seen, "ms")
        mine = rows.divergence()
        for share in (50, 95):
            yield line(f"{at}: copy of a pushed bunch, p{share}", float(np.percentile(mine, share)), "mm")
        if delay == REST_AT:
            rest = 1e3 * np.linalg.norm(rows.bunch[-1, 0] - rows.bunch[-1, 1])
            yield line(f"{at}: copy of a bunch that was pushed and rests", float(rest), "mm")
        moves = np.abs(rows.speed).max(1) > 0.02
        for what, which in (("shown", 1), ("copy", 2)):
            off = 1e3 * np.abs(rows.joints[moves, 0] - rows.joints[moves, which]).max(1)
            for share in (50, 95):
                yield line(f"{at}: joints of another robot, {what}, p{share}", float(np.percentile(off, share)), "mrad")
        if delay == delays[0]:
            for late in LATE:
                for what, (with_, without) in zip(("tree", "robot"), extrapolation(rows, late), strict=True):
                    case = f"{what} known {1e3 * late:.0f} ms late, RMS"
                    yield line(case, 1e3 * with_, "mrad", "without velocities", 1e3 * without)
            for jitter in BUFFERED_JITTER:
                for wait in BUFFERS:
                    now, path = buffered(rows, 0.050, jitter, wait)
                    case = f"50 ms, jitter {1e3 * jitter:.0f} ms: buffer {1e3 * wait:.0f} ms"
                    yield line(f"{case}, off where it is now", now, "mrad")
                    yield line(f"{case}, off its path", path, "mrad")
        fight = both_push(delay)
        naive = both_push(delay, naive=True)
        fights[delay, False], fights[delay, True] = fight, naive
        theirs, worse = (float(np.percentile(one.divergence(), 95)) for one in (fight, naive))
        one = float(np.percentile(mine, 95))
        yield line(f"{at}: copy of a bunch that two push, p95", theirs, "mm", "one pushes", one)
        yield line(f"{at}: the same if touching took it each time, p95", worse, "mm")
        for what, fought in (("", fight), (" if touching took it each time", naive)):
            period, span = oscillation(fought)
            if np.isfinite(period):
                yield line(f"{at}: tug of war{what}, period", period, "s")
            yield line(f"{at}: tug of war{what}, span", span, "mm")
        both = (fight.force > 0.0).all(1)
        forces = fight.force[both].mean(0)
        yield line(f"{at}: force of the first on the bunch", forces[0], "N", "of the second on its copy", forces[1])
