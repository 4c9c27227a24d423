"""The network as a client's tick sees it: :meth:`Exchange.receive` before the step, :meth:`Exchange.send` after it.

What is decided here is decided by pure functions: who owns (:mod:`authority`), who is near (:mod:`interest`), whether
a record is due (:mod:`smooth`). This class only holds what was said and heard. Environment records leave only when
another actor is near the moved tree and somebody listens to its cell; else not one byte does.

Keys: ``a/<actor>`` pose at the full rate for those who are near, ``a/<actor>/far`` the same at 5 Hz for everybody,
``c/<x>/<y>/<actor>`` moving trees of a cell, ``own/<x>/<y>/<actor>`` claims and rest (reliable), and the questions
``hello/<actor>`` and ``clock``.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable

import numpy as np

from vinesim.net import authority, interest, messages, smooth
from vinesim.net.authority import NOBODY, UNTOUCHED, Claim
from vinesim.net.bus import EVERY, NEWEST, RECENT, Bus, Publisher, Subscription
from vinesim.net.clock import WINDOW, Clock, Ping
from vinesim.net.interest import Cell
from vinesim.net.messages import Hello, MessageError, Trees
from vinesim.world.model import Model
from vinesim.world.values import RobotUpdate, TreeUpdate

log = logging.getLogger(__name__)

ACTOR_PERIOD = 1.0 / 60.0
"""Between poses for those who are near [s]."""

FAR_PERIOD = 1.0 / 5.0
"""Between poses for everybody [s]."""

ASK_PERIOD = 0.5
"""Between two attempts to hear an actor's greeting [s]."""

PING_PERIOD = (0.05, 2.0)
"""Between pings of the clock at the start, twice as many as are needed, and later [s]."""

ANSWER_PERIOD = 0.2
"""Between two corrections of the same tree [s]."""

FORGOTTEN = 3.0
"""An owner that says nothing of its tree for so long [s] (three heartbeats) is believed to own it no more."""

ONLOOKER = "spectator"
"""Kind of actor that owns nothing and says nothing but where it is."""

_LONG_AGO = -1e9


class Mismatch(RuntimeError):
    """Actors that cannot share a world: their vineyards or their protocols differ."""

    exit_code = 4


@dataclasses.dataclass(slots=True)
class Traffic:
    """Messages and payload bytes of one family, each way."""

    messages_in: int = 0
    bytes_in: int = 0
    messages_out: int = 0
    bytes_out: int = 0


@dataclasses.dataclass(slots=True)
class Counters:
    """What crossed the network and what was not believed."""

    actor: Traffic = dataclasses.field(default_factory=Traffic)
    """Poses of robots and humans."""
    environment: Traffic = dataclasses.field(default_factory=Traffic)
    """Moving trees."""
    event: Traffic = dataclasses.field(default_factory=Traffic)
    """Claims, corrections and rest."""
    control: Traffic = dataclasses.field(default_factory=Traffic)
    """Greetings and clock (received only)."""
    malformed: int = 0
    """Messages that could not be believed."""
    dropped: int = 0
    """Sound messages and records not used: overtaken, of a stranger, too far away, or of a lesser claim."""


@dataclasses.dataclass(slots=True)
class Inbox:
    """What the network brought for this tick. States are extrapolated to now, times are the client's own."""

    joined: list[Hello] = dataclasses.field(default_factory=list)
    left: list[str] = dataclasses.field(default_factory=list)
    robots: dict[str, RobotUpdate] = dataclasses.field(default_factory=dict)
    """Every other actor whose pose is known, every tick: extrapolated at most 150 ms, corrections blended in 100 ms."""
    trees: list[TreeUpdate] = dataclasses.field(default_factory=list)
    """Trees of which their owner sent news: the last record of each, extrapolated at most 150 ms."""
    released: list[int] = dataclasses.field(default_factory=list)
    """Trees another actor owned until now and nobody does any more: they rest, or their owner is gone."""


class _Actor:
    """Another actor and the last that is known of its pose."""

    def __init__(self, hello: Hello) -> None:
        self.hello = hello
        self.joints = hello.joints
        self.update: RobotUpdate | None = None
        self.near: Subscription | None = None
        self.moved_at = _LONG_AGO
        self._state = np.zeros(0)
        self._rate = np.zeros(0)
        self._off = np.zeros(0)

    def hear(self, update: RobotUpdate, time: float) -> bool:
        """Take a newer pose at network ``time``; False if it is not newer."""
        if self.update is not None and update.time <= self.update.time:
            return False
        if self.joints < 0:
            self.joints = len(update.position)
        if len(update.position) != self.joints:
            raise MessageError(f"pose of {update.actor!r} with {len(update.position)} joints, it has {self.joints}")
        shown = None if self.update is None else self._shown(time)
        q = update.base_q[3:]
        self.update = update
        self._state = np.concatenate([update.base_q, update.position])
        self._rate = np.concatenate([update.base_qd[:3], smooth.spin(q, update.base_qd[3:]), update.velocity])
        if shown is not None:
            if shown[3:7] @ q < 0.0:
                shown[3:7] *= -1.0
            self._off = np.zeros(0)
            self._off = shown - self._shown(time)
            self.moved_at = time
        return True

    def at(self, time: float, now: float) -> RobotUpdate:
        """The pose at network ``time``, to be shown ``now``."""
        heard = self.update
        assert heard is not None
        shown = self._shown(time)
        going = 1.0 if time - heard.time <= smooth.EXTRAPOLATION else 0.0
        shown[3:7] /= np.sqrt(shown[3:7] @ shown[3:7])
        return RobotUpdate(
            heard.actor, now, shown[:7], heard.base_qd * going, shown[7:], heard.velocity * going
        )  # fmt: skip

    def _shown(self, time: float) -> np.ndarray:
        assert self.update is not None
        shown = self._state + self._rate * smooth.horizon(time - self.update.time)
        if len(self._off):
            shown += self._off * smooth.remaining(time - self.moved_at)
        return shown


class Exchange:
    """One client's share in a world: call :meth:`receive` and :meth:`send` once a tick, from one thread.

    ``now`` is any clock of the client that runs in seconds; the offset to the server's clock is kept inside.
    """

    def __init__(self, bus: Bus, me: Hello, model: Model, *, near: float = interest.NEAR) -> None:
        """``near`` [m]: others nearer than this to a tree see what I do to it (at most 5 m, what cells cover)."""
        if me.name != bus.name:
            raise ValueError(f"greeting of {me.name!r} on the bus of {bus.name!r}: one actor has one name")
        self.bus, self.me, self.model = bus, me, model
        self.near = interest.checked(near)
        self.kin: set[str] = set()
        """Actors of the same client: they share its world and need not be told of it, nor heard."""
        self.counters = Counters()
        self.clock = Clock()
        greeting = messages.encode_hello(me)
        bus.serve(f"hello/{me.name}", lambda _: greeting)
        self._elders = bus.alive() - {me.name}

        # others
        self._actors: dict[str, _Actor] = {}
        self._asked: dict[str, float] = {}
        self._refused: set[str] = set()
        self._blamed: set[str] = set()

        # trees: what was last said of each, by me or by its owner
        self._claims: dict[int, Claim] = {}
        self._touching: dict[int, bool] = {}
        self._before: dict[int, Claim] = {}
        self._announced: set[int] = set()
        self._mine: set[int] = set()
        self._theirs: set[int] = set()
        self._silent: set[int] = set()
        self._answered: dict[int, float] = {}
        tree_count, body_count = len(model.tree_first), len(model.body_mass)
        self._said_at = np.full(tree_count, _LONG_AGO)
        self._heard_at = np.full(tree_count, _LONG_AGO)
        self._said_to = np.zeros(tree_count, np.int64)
        self._said_q = np.tile(np.array([0.0, 0.0, 0.0, 1.0]), (body_count, 1))
        self._said_rate = np.zeros((body_count, 4))
        self._middle = _middles(model)
        self._cells: list[Cell] = [tuple(cell) for cell in interest.cells(self._middle).tolist()]
        self._reach = _reaches(model)
        self._bodies = [model.bodies_of(tree) for tree in range(tree_count)]
        self._plan: tuple[tuple[int, ...], np.ndarray, np.ndarray, np.ndarray] | None = None

        # keys
        self._window: Cell | None = None
        self._heard_cells: dict[Cell, tuple[Subscription, Subscription]] = {}
        self._spoken_cells: dict[Cell, tuple[Publisher, Publisher]] = {}
        self._pose = bus.publisher(f"a/{me.name}")
        self._far_pose = bus.publisher(f"a/{me.name}/far")
        bus.subscribe("a/*/far", NEWEST)
        self._pose_due: dict[Publisher, float] = {}
        self._pinged, self._pings = _LONG_AGO, 0
        self._now: float | None = None
        self._last_sent = _LONG_AGO

    # ------------------------------------------------------------ questions

    def owner(self, tree: int) -> str | None:
        """Who owns a tree now: a live actor's name (perhaps one's own), or None."""
        owner = self._claims.get(tree, UNTOUCHED).owner
        if owner == self.me.name:
            return owner
        return owner if owner in self._actors and tree not in self._silent else None

    def claim(self, tree: int) -> Claim:
        """The greatest claim on a tree that was made or heard."""
        return self._claims.get(tree, UNTOUCHED)

    @property
    def actors(self) -> dict[str, Hello]:
        """The greetings of all others who are in this world now."""
        return {name: actor.hello for name, actor in self._actors.items()}

    @property
    def offset(self) -> float:
        """Network time minus the client's own [s]."""
        return self.clock.offset

    # ------------------------------------------------------------ receive

    def receive(self, now: float) -> Inbox:
        """All that arrived since the last call, decided upon; :class:`Mismatch` if I do not belong to this world."""
        inbox = Inbox()
        self.clock = self.clock.after(now - self._now if self._now is not None else 0.0)
        self._now = now
        time = now + self.clock.offset
        self._roster(now, inbox)
        self._answers(now, inbox)
        news: dict[int, tuple[Trees, str]] = {}
        lost: list[tuple[int, Claim, bool]] = []
        for key, payload in self.bus.drain():
            family, _, rest = key.partition("/")
            parts = rest.split("/")
            sender = parts[0] if family == "a" else parts[-1]
            traffic = {"a": self.counters.actor, "c": self.counters.environment}.get(family, self.counters.event)
            traffic.messages_in += 1
            traffic.bytes_in += len(payload)
            actor = self._actors.get(sender)
            if actor is None:
                if sender in self.kin:
                    continue
                self.counters.dropped += 1
                continue
            try:
                if family == "a":
                    self.counters.dropped += not actor.hear(messages.decode_robot(payload, sender), time)
                elif messages.kind_of(payload) == messages.CLAIMS:
                    for tree, claim, touching in messages.decode_claims(payload, len(self._said_at)):
                        self._hear_claim(tree, claim, touching, sender, time, lost)
                else:
                    self._hear_trees(messages.decode_trees(payload, self.model.tree_size), sender, time, news, lost)
            except MessageError as error:
                self._blame(sender, error)
        self._forget(time)
        for tree in sorted(self._theirs):
            if self.owner(tree) is None or tree in self._mine:
                self._theirs.discard(tree)
                if tree not in self._mine:
                    inbox.released.append(tree)
        inbox.trees = self._extrapolated(news, now, time)
        inbox.robots = {n: a.at(time, now) for n, a in self._actors.items() if a.update is not None}
        self._correct(lost, time)
        return inbox

    def _roster(self, now: float, inbox: Inbox) -> None:
        """Notice who came and who went."""
        alive = self.bus.alive() - self.kin
        for name in sorted(self._actors.keys() - alive):
            self._leave(name, now + self.clock.offset)
            inbox.left.append(name)
        self._refused &= alive
        self._elders &= alive
        for name in sorted(alive - self._actors.keys() - self._refused - {self.me.name}):
            if now - self._asked.get(name, _LONG_AGO) >= ASK_PERIOD:
                self._asked[name] = now
                self.bus.ask(f"hello/{name}")
        if now - self._pinged >= PING_PERIOD[self._pings >= 2 * WINDOW]:
            self._pinged, self._pings = now, self._pings + 1
            self.bus.ask("clock", messages.encode_time(now))

    def _answers(self, now: float, inbox: Inbox) -> None:
        """Take greetings and the clock's answers."""
        for key, payload, age in self.bus.answers():
            self.counters.control.messages_in += 1
            self.counters.control.bytes_in += len(payload)
            name = key.partition("/")[2]
            try:
                if key == "clock":
                    asked, server = messages.decode_time(payload)
                    received = now - age
                    if asked <= received:
                        self.clock = self.clock.heard(Ping(asked, server, received))
                elif name in self.bus.alive() and name not in self._actors and name not in self._refused:
                    self._greet(name, payload, inbox)
            except MessageError as error:
                self._blame(name or "the clock", error)

    def _greet(self, name: str, payload: bytes, inbox: Inbox) -> None:
        """Let an actor in, unless it lives in another vineyard or speaks another protocol."""
        try:
            hello = messages.decode_hello(payload)
        except messages.WrongVersion as error:
            self._refuse(name, f"speaks protocol version {error.theirs}, {self.me.name!r} version {messages.PROTOCOL}")
            return
        if hello.name != name:
            raise MessageError(f"{name!r} introduces itself as {hello.name!r}")
        if hello.digest != self.me.digest:
            self._refuse(
                name,
                f"has scene {hello.scene!r} with digest {hello.digest!r}, "
                f"{self.me.name!r} has {self.me.scene!r} with {self.me.digest!r}",
            )
            return
        self._actors[name] = _Actor(hello)
        inbox.joined.append(hello)

    def _refuse(self, name: str, why: str) -> None:
        """Whoever was here first is right: the newcomer stops, those who were here ignore it."""
        text = f"{name!r} {why}: start both with the same scene, seed and release of vinesim"
        if name in self._elders:
            raise Mismatch(text)
        log.warning("ignoring a newcomer: %s", text)
        self._refused.add(name)

    def _leave(self, name: str, time: float) -> None:
        """An actor is gone: what it still moved goes to the nearest of those who remain, then the lowest name."""
        actor = self._actors.pop(name)
        self._asked.pop(name, None)
        self._blamed.discard(name)
        if actor.near is not None:
            actor.near.close()
        where = {
            n: a.update.base_q for n, a in self._actors.items() if a.update is not None and a.hello.kind != ONLOOKER
        }
        if self._window is not None and self.me.kind != ONLOOKER:
            where[self.me.name] = self._position
        # its claims still hold, should it come back; only its silence counts, or two would never agree again
        for tree in [tree for tree, claim in sorted(self._claims.items()) if claim.owner == name]:
            recent = tree not in self._silent and time - self._heard_at[tree] < FORGOTTEN
            self._silent.add(tree)
            if recent and authority.successor(self._middle[tree], where) == self.me.name:
                self._take(tree, authority.touched(self._claims[tree], self.me.name, False))

    def _blame(self, sender: str, error: MessageError) -> None:
        """Count a message that cannot be believed, and say so once for each sender."""
        self.counters.malformed += 1
        if sender not in self._blamed:
            self._blamed.add(sender)
            log.warning("dropped a message of %r, further ones only counted: %s", sender, error)

    def _hear_trees(self, trees: Trees, sender: str, time: float, news: dict, lost: list) -> None:
        """Judge every record by its claim."""
        near = self._near_me(trees.tree)
        rows = zip(
            trees.tree.tolist(), trees.ownership.tolist(), trees.authority.tolist(), trees.flags.tolist(), strict=True
        )
        for row, (tree, ownership, seq, flags) in enumerate(rows):
            resting = bool(flags & messages.RESTING)
            claim = Claim(ownership, seq, NOBODY if resting else sender)
            held = self._claims.get(tree, UNTOUCHED)
            fresh = trees.time > self._said_at[tree]
            if claim != held and not authority.wins(claim, held):
                self.counters.dropped += 1
                if fresh and not resting:
                    lost.append((tree, claim, True))
                continue
            if not fresh and claim == held:
                self.counters.dropped += 1
                continue
            self._adopt(tree, claim, bool(flags & messages.TOUCHED))
            self._said_at[tree], self._heard_at[tree] = trees.time, time
            if near[row]:
                news[tree] = (trees, sender)
            else:
                self.counters.dropped += 1

    def _hear_claim(self, tree: int, claim: Claim, touching: bool, sender: str, time: float, lost: list) -> None:
        held = self._claims.get(tree, UNTOUCHED)
        if claim == held:
            if claim.owner == sender:
                self._adopt(tree, claim, touching)
                self._heard_at[tree] = time
        elif authority.wins(claim, held):
            self._adopt(tree, claim, touching)
            self._heard_at[tree] = time
        elif claim.owner == sender:
            lost.append((tree, claim, touching))

    def _adopt(self, tree: int, claim: Claim, touching: bool) -> None:
        """Hold a claim that somebody else made or reported."""
        self._claims[tree] = claim
        self._touching[tree] = touching
        self._announced.add(tree)
        self._silent.discard(tree)
        if claim.owner == self.me.name:
            self._mine.add(tree)
            return
        self._mine.discard(tree)
        if claim.owner != NOBODY:
            self._theirs.add(tree)

    def _forget(self, time: float) -> None:
        """Owners who fell silent own no more, until they are heard again: their claim still holds."""
        for tree in self._theirs:
            if time - self._heard_at[tree] > FORGOTTEN:
                self._silent.add(tree)

    def _extrapolated(self, news: dict[int, tuple[Trees, str]], now: float, time: float) -> list[TreeUpdate]:
        """The last record of each tree, now; what was said is remembered for the next prediction."""
        found: dict[int, TreeUpdate] = {}
        for trees, sender in {id(batch[0]): batch for batch in news.values()}.values():
            rate = smooth.spin(trees.joint_q, trees.joint_qd)
            age = float(smooth.horizon(time - trees.time))
            here = dataclasses.replace(trees, time=now)
            if age > 0.0 and not (trees.flags & messages.RESTING).any():
                here = dataclasses.replace(here, joint_q=smooth.ahead(trees.joint_q, rate, age))
            first = 0
            for update in here.updates(sender):
                last = first + len(update.joint_q)
                if news.get(update.tree, (None,))[0] is trees:
                    found[update.tree] = update
                    bodies = self._bodies[update.tree]
                    self._said_q[bodies], self._said_rate[bodies] = trees.joint_q[first:last], rate[first:last]
                first = last
        return [found[tree] for tree in sorted(found)]

    def _correct(self, lost: list[tuple[int, Claim, bool]], time: float) -> None:
        """Tell whoever claims from old knowledge what holds: that is how everybody agrees again after a loss."""
        if self.me.kind == ONLOOKER:
            return
        for tree, claim, _ in lost:
            held = self.claim(tree)
            if claim == held or authority.wins(claim, held):
                continue
            mine_to_say = self.owner(tree) in (self.me.name, None) or authority.outdated(claim, held)
            if mine_to_say and time - self._answered.get(tree, _LONG_AGO) >= ANSWER_PERIOD:
                self._answered[tree] = time
                self._say(tree, held)

    # ------------------------------------------------------------ send

    def send(
        self,
        now: float,
        robot: RobotUpdate,
        *,
        touched: Iterable[int] = (),
        moving: Iterable[int] = (),
        read: Callable[[int], tuple[np.ndarray, np.ndarray]],
        grabbed: Iterable[int] = (),
    ) -> list[TreeUpdate]:
        """Say what must be said this tick; returns the rest records that left, exactly as all copies hold them.

        ``robot`` is my pose (its ``time`` is replaced by ``now``; a spectator passes its viewpoint, without joints).
        ``touched``: trees I am in contact with now; ``moving``: trees I own that still move by themselves (others are
        ignored); ``grabbed``: trees of which I grabbed, picked or cut something this tick. ``read(tree)`` gives
        (joint_q [n, 4], joint_qd [n, 3] rad/s) and is called only for trees that somebody near may have to hear of.
        """
        time = self._last_sent = max(now + self.clock.offset, self._last_sent + 1e-6)
        self._position = np.asarray(robot.base_q[:3], float)
        self._send_pose(robot, now, time)

        touched = {int(tree) for tree in touched}
        for tree in sorted({int(tree) for tree in grabbed}):
            self._take(tree, authority.grabbed(self.claim(tree), self.me.name))
            touched.add(tree)
        for tree in sorted(touched):
            held = self.claim(tree)
            taken = authority.touched(
                held, self.me.name, self.owner(tree) is not None and self._touching.get(tree, False)
            )
            if taken is not held:
                self._take(tree, taken)
        self._follow(self._position)
        if not self._mine:
            return []
        active = tuple(sorted(self._mine & (touched | {int(tree) for tree in moving})))
        left = self._rest(self._mine.difference(active), read, time)
        if active:
            self._send_trees(active, touched, read, time)
        return left

    def _take(self, tree: int, claim: Claim) -> None:
        """Own a tree from now on."""
        if tree not in self._mine or tree in self._announced:
            self._before[tree] = self.claim(tree)
        self._claims[tree] = claim
        self._touching[tree] = True
        self._announced.discard(tree)
        self._silent.discard(tree)
        self._mine.add(tree)
        self._said_to[tree] = 0

    def _follow(self, position: np.ndarray) -> None:
        """Move the window of cells and the circle of actors heard at the full rate."""
        window = interest.moved(self._window, position)
        owned = {self._cells[tree] for tree in self._mine}
        if window != self._window or not owned <= self._heard_cells.keys() or len(self._heard_cells) > 9:
            self._window = window
            wanted = interest.window(window) | owned
            for cell in sorted(self._heard_cells.keys() - wanted):
                for thing in (*self._heard_cells.pop(cell), *self._spoken_cells.pop(cell)):
                    thing.close()
            for cell in sorted(wanted - self._heard_cells.keys()):
                self._heard_cells[cell] = (
                    self.bus.subscribe(f"c/{cell[0]}/{cell[1]}/*", RECENT),
                    self.bus.subscribe(f"own/{cell[0]}/{cell[1]}/*", EVERY),
                )
                self._spoken_cells[cell] = (
                    self.bus.publisher(f"c/{cell[0]}/{cell[1]}/{self.me.name}"),
                    self.bus.publisher(f"own/{cell[0]}/{cell[1]}/{self.me.name}", reliable=True),
                )
        for name, actor in self._actors.items():
            if actor.update is None:
                continue
            away = float(np.hypot(*(actor.update.base_q[:2] - position[:2])))
            if interest.full_rate(away, actor.near is not None):
                actor.near = actor.near or self.bus.subscribe(f"a/{name}", NEWEST)
            elif actor.near is not None:
                actor.near.close()
                actor.near = None

    def _send_pose(self, robot: RobotUpdate, now: float, time: float) -> None:
        """60 Hz to those who are near, 5 Hz to everybody; encoded once, and only if somebody listens."""
        payload = b""
        for publisher, period in ((self._pose, ACTOR_PERIOD), (self._far_pose, FAR_PERIOD)):
            due = self._pose_due.get(publisher, now)
            if now < due - 1e-9:
                continue
            self._pose_due[publisher] = max(due, now - period) + period
            if publisher.matching:
                payload = payload or messages.encode_robot(dataclasses.replace(robot, actor=self.me.name, time=time))
                self._put(publisher, payload, self.counters.actor)

    def _near_me(self, trees: np.ndarray) -> np.ndarray:
        """Which trees [k] are near enough for me to see them moved [k] bool; hysteresis as for cells."""
        if self._window is None:
            return np.zeros(len(trees), bool)
        away = self._middle[trees, :2] - self._position[:2]
        return np.einsum("ij,ij->i", away, away) <= (self.near + interest.HYSTERESIS) ** 2

    def _audience(self, trees: tuple[int, ...]) -> np.ndarray:
        """How many other actors are near each tree [k]."""
        where = [actor.update.base_q[:3] for actor in self._actors.values() if actor.update is not None]
        return interest.listeners(self._middle[list(trees)], np.array(where).reshape(-1, 3), self.near)

    def _send_trees(self, active: tuple[int, ...], touched: set[int], read: Callable, time: float) -> None:
        """One batch per cell of what copies would otherwise have wrong."""
        audience = self._audience(active)
        if not audience.any():
            self._said_to[list(active)] = 0
            for tree in active:
                self._touching[tree] = tree in touched
            return
        if self._plan is None or self._plan[0] != active:
            sizes = self.model.tree_size[list(active)].astype(np.int64)
            order = np.concatenate([np.arange(b.start, b.stop) for b in (self._bodies[tree] for tree in active)])
            self._plan = (active, sizes, np.cumsum(sizes) - sizes, order)
        _, sizes, starts, bodies = self._plan
        ids = np.array(active)
        state = [read(tree) for tree in active]
        q = np.concatenate([joint_q for joint_q, _ in state]).astype(np.float64)
        qd = np.concatenate([joint_qd for _, joint_qd in state]).astype(np.float64)

        silence = time - self._said_at[ids]
        dt = np.repeat(smooth.horizon(silence), sizes)[:, None]
        wrong = smooth.angle_between(q, smooth.ahead(self._said_q[bodies], self._said_rate[bodies], dt))
        due = smooth.due(
            np.add.reduceat(wrong * self._reach[bodies], starts), np.maximum.reduceat(wrong, starts), silence
        )
        # somebody came near, or the claim or the contact changed: copies must know at once
        due |= audience > self._said_to[ids]
        for row, tree in enumerate(active):
            if self._touching[tree] != (tree in touched):
                self._touching[tree] = tree in touched
                due[row] = True
        self._said_to[ids] = np.minimum(self._said_to[ids], audience)
        due &= audience > 0
        if not due.any():
            return

        by_cell: dict[Cell, list[int]] = {}
        for row in np.flatnonzero(due).tolist():
            by_cell.setdefault(self._cells[active[row]], []).append(row)
        for cell, rows in sorted(by_cell.items()):
            stream, events = self._spoken_cells[cell]
            if not stream.matching:
                continue
            here = [active[row] for row in rows]
            fresh = [(tree, self._claims[tree], self._touching[tree]) for tree in here if tree not in self._announced]
            if fresh:
                self._put(events, messages.encode_claims(fresh), self.counters.event)
            part: slice | np.ndarray = slice(None)
            if len(rows) < len(active):
                part = np.concatenate([np.arange(starts[row], starts[row] + sizes[row]) for row in rows])
            payloads, heard = messages.encode_trees(self._batch(here, sizes[rows], q[part], qd[part], time))
            for payload in payloads:
                self._put(stream, payload, self.counters.environment)
            self._announced.update(here)
            self._said_at[here], self._said_to[here] = time, audience[rows]
            self._said_q[bodies[part]] = heard.joint_q
            self._said_rate[bodies[part]] = smooth.spin(heard.joint_q, heard.joint_qd)

    def _batch(self, ids: list[int], sizes: np.ndarray, q: np.ndarray, qd: np.ndarray, time: float) -> Trees:
        claims = [self._claims[tree] for tree in ids]
        flags = [messages.TOUCHED * self._touching[tree] for tree in ids]
        ownership, seq = [claim.ownership for claim in claims], [claim.authority for claim in claims]
        return Trees(time, np.array(ids), np.array(ownership), np.array(seq), np.array(flags), sizes, q, qd)

    def _rest(self, resting: set[int], read: Callable, time: float) -> list[TreeUpdate]:
        """What I moved lies still: one reliable record to those who are near, and silence."""
        left: list[TreeUpdate] = []
        for tree in sorted(resting):
            self._mine.discard(tree)
            held = self._claims[tree]
            self._claims[tree] = authority.rested(held)
            self._touching[tree] = False
            _, events = self._spoken_cells.get(self._cells[tree], (None, None))
            if self._audience((tree,))[0] and events is not None and events.matching:
                q, qd = read(tree)
                batch = Trees(
                    time, np.array([tree]), np.array([held.ownership]), np.array([held.authority]),
                    np.array([messages.RESTING]), np.array([len(q)]), np.asarray(q, float), np.zeros_like(qd, float),
                )  # fmt: skip
                (payload,), heard = messages.encode_trees(batch)
                if self._put(events, payload, self.counters.event):
                    self._announced.add(tree)
                    self._said_at[tree] = time
                    left += heard.updates(self.me.name)
            elif tree not in self._announced:
                # nobody ever heard of this claim: as if it had not been, so that sequences only count what was said
                before = self._before[tree]
                self._claims[tree] = authority.rested(before) if before.owner == self.me.name else before
                self._silent.add(tree)
        return left

    def _say(self, tree: int, claim: Claim) -> None:
        """A correction, to all who listen to the tree's cell."""
        cell = self._cells[tree]
        if cell in self._spoken_cells:
            payload = messages.encode_claims([(tree, claim, self._touching.get(tree, False))])
            self._put(self._spoken_cells[cell][1], payload, self.counters.event)

    def _put(self, publisher: Publisher, payload: bytes, traffic: Traffic) -> bool:
        if not publisher.put(payload):
            return False
        traffic.messages_out += 1
        traffic.bytes_out += len(payload)
        return True


def _middles(model: Model) -> np.ndarray:
    """Where each tree is [tree, 3] m: the mean of its settled bodies."""
    origins = model.forward(model.joint_settled)[:, :3]
    middles = np.zeros((len(model.tree_first), 3))
    np.add.at(middles, model.body_tree, origins)
    return middles / np.maximum(model.tree_size, 1)[:, None]


def _reaches(model: Model) -> np.ndarray:
    """How far from each body's joint the wood it carries ends, along the longest way [body] m."""
    reach = model.body_length.astype(float).copy()
    for body in range(len(reach) - 1, -1, -1):
        parent = model.body_parent[body]
        if parent >= 0:
            reach[parent] = max(reach[parent], float(np.linalg.norm(model.body_offset[body])) + reach[body])
    return reach
