"""Admission control: actors of a world have the same scene and protocol version, and unique names. No I/O.

The scene of a world is that of the first actor that is admitted. A world keeps its scene while it has actors. Once
records about its objects are retained, it keeps the scene for good (:meth:`AdmissionControl.pin_scene`), because the
cuts of a vineyard mean nothing in another one.
"""

from __future__ import annotations

import dataclasses
import ipaddress
import math
from typing import NamedTuple

from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.net.codec.control import Hello, Welcome, decode_hello
from vinesim.net.codec.header import PROTOCOL, MessageError, WrongVersion, is_valid_name

PROVISIONAL_TIMEOUT = 5.0
"""Time for which the name of an admitted actor is reserved until its liveliness token arrives [s]."""

GRACE_TIME = 10.0
"""Time after the start of a server in which liveliness tokens reserve names [s], because the actors that were there
before join again. Afterwards only a join reserves a name."""

SEVERAL = "several"
"""Returned instead of a session if several sessions claim a name."""

MAX_DEPARTED = 4096
"""Largest number of actors that have left and whose last records are still accepted. All actors behind a linked server
leave at once when the link is lost."""

MAX_TOKENS = 20_000
"""Largest number of liveliness tokens that the server notes."""

JOIN_BURST_TIME = 20.0
"""Time for which joins that were not used may be used at once [s]."""


@dataclasses.dataclass(frozen=True)
class JoinLimits:
    """Limits for joins. An *address* is the network address of sessions that connect to this server itself; clients
    behind linked servers have none, and of this machine (loopback) any number of actors may join."""

    actors: int | None = None
    """Largest number of actors in all worlds together; None: no limit."""
    actors_per_address: int = 256
    """Largest number of actors of one address."""
    waiting_per_address: int = 64
    """Largest number of actors of one address that were admitted and whose liveliness token has not arrived."""
    worlds: int = 1024
    """Largest number of worlds with actors or records."""
    worlds_per_address: int = 128
    """Largest number of worlds that one address has opened, of those that are still there."""
    joins_per_session: float = 1.0
    """Sustained rate of join queries of one session [1/s]."""
    joins_per_address: float = 50.0
    """Sustained rate of join queries of one address [1/s], without limit for this machine itself."""


class _Admitted(NamedTuple):
    """An admitted actor."""

    session: str
    since: float
    address: str


class SceneId(NamedTuple):
    """Identity of a scene: its name and the digest of its vineyard."""

    scene: str = ""
    """Name of the scene."""
    digest: str = ""
    """``Model.digest()`` of the scene's vineyard; empty: unknown."""


class AdmissionControl:
    """Decides which actors may join which worlds, and knows which actors are live.

    The Zenoh session id ``session`` distinguishes programs that use the same name.
    """

    def __init__(
        self,
        scene: SceneId | None = None,
        max_actors: int | None = None,
        spectators_speak_to: SpectatorsSpeakTo = SpectatorsSpeakTo.PEOPLE,
        limits: JoinLimits = JoinLimits(),
    ) -> None:
        """``scene``: the only scene that is allowed; None: any. ``max_actors``: replaces :attr:`JoinLimits.actors`.
        ``spectators_speak_to``: who hears spectators."""
        self._required_scene = scene
        self.limits = limits if max_actors is None else dataclasses.replace(limits, actors=max_actors)
        self.reserved_until = -math.inf
        """Time of the monotonic clock until which liveliness tokens reserve names [s]: see :data:`GRACE_TIME`."""
        self._joins: dict[tuple[str, str], tuple[float, float]] = {}
        """Number of joins that a session or an address may use at once, and when that number was valid [s]."""
        self._opened_by: dict[str, str] = {}
        """Address that opened each world of :attr:`_scenes`."""
        self._tokens = 0
        self._spectators_speak_to = spectators_speak_to
        self._scenes: dict[str, SceneId] = {}
        self._pinned: set[str] = set()
        self._alive: dict[tuple[str, str], set[str]] = {}
        self._admitted: dict[tuple[str, str], _Admitted] = {}
        self._departed: dict[tuple[str, str], str] = {}
        """Session of each actor that was admitted, was no spectator and has left, in the order in which they left."""
        self._spectators: set[tuple[str, str]] = set()
        """World and name of each admitted spectator. Spectators may not publish records."""
        self.joined = 0
        """Number of times that an actor has become live since the start."""
        self.refused = 0
        """Number of hellos that were rejected."""

    @property
    def actors(self) -> list[str]:
        """Returns the actors that are live now, as ``world/name``, sorted."""
        return sorted(f"{world}/{name}" for (world, name), sessions in self._alive.items() if sessions)

    def is_admitted(self, world: str, name: str) -> bool:
        """Whether an actor was admitted and has not left."""
        return (world, name) in self._admitted

    def may_slow(self, world: str, name: str) -> bool:
        """Whether an actor may slow the time of its world: it was admitted, is live, and is no spectator."""
        actor = (world, name)
        return actor in self._admitted and actor not in self._spectators and self.is_live(world, name)

    def has_actors(self, world: str) -> bool:
        """Whether any actor is live in a world."""
        return any(there == world for there, _ in self._alive) or any(there == world for there, _ in self._admitted)

    def reserved_by(self, world: str, name: str, now: float) -> str:
        """Returns the session that holds a name: the admitted one, else, until :attr:`reserved_until`, the live one
        (:data:`SEVERAL` if there are several); empty if there is none. ``now`` [s]: time of the monotonic clock."""
        live = self._alive.get((world, name), set()) if now < self.reserved_until else set()
        return self.holder(world, name) or (SEVERAL if len(live) > 1 else "".join(live))

    def holder(self, world: str, name: str) -> str:
        """Returns the session that was admitted with a name; empty if there is none."""
        admitted = self._admitted.get((world, name))
        return "" if admitted is None else admitted.session

    def address(self, world: str, name: str) -> str:
        """Returns the address of an admitted actor; empty if it is unknown."""
        admitted = self._admitted.get((world, name))
        return "" if admitted is None else admitted.address

    def is_live(self, world: str, name: str) -> bool:
        """Whether any session holds a liveliness token of this name."""
        return bool(self._alive.get((world, name)))

    def scene_of(self, world: str) -> SceneId:
        """Returns the present scene of a world; with empty fields if any scene may join."""
        return self._required_scene or self._scenes.get(world, SceneId())

    def pin_scene(self, world: str, scene: SceneId) -> None:
        """Fix the scene of a world for good, because records about its objects are retained."""
        self._scenes[world] = scene
        self._pinned.add(world)

    def on_join(self, world: str, name: str, session: str) -> None:
        """Note that a session has declared the liveliness token of a name."""
        if self._tokens >= MAX_TOKENS and self.holder(world, name) != session:
            return
        sessions = self._alive.setdefault((world, name), set())
        self.joined += not sessions
        self._tokens += session not in sessions
        sessions.add(session)

    def on_leave(self, world: str, name: str, session: str) -> None:
        """Note that the liveliness token of a name and session is gone."""
        actor = (world, name)
        sessions = self._alive.get(actor, set())
        self._tokens -= session in sessions
        sessions.discard(session)
        if not sessions:
            self._alive.pop(actor, None)
        if self.holder(world, name) == session:
            self._note_departure(actor, session)
            self._dismiss(actor)
        else:
            self._forget(world)

    def end_session(self, session: str) -> list[tuple[str, str]]:
        """Note that a session has ended. Returns world and name of the actors that it held."""
        gone = [actor for actor, admitted in self._admitted.items() if admitted.session == session]
        for actor in gone:
            self._note_departure(actor, session)
            self._dismiss(actor)
        return gone

    def _note_departure(self, actor: tuple[str, str], session: str) -> None:
        """Note that an admitted actor has left. The oldest of :data:`MAX_DEPARTED` is forgotten."""
        self._departed.pop(actor, None)
        if actor not in self._spectators:
            self._departed[actor] = session
        if len(self._departed) > MAX_DEPARTED:
            del self._departed[next(iter(self._departed))]

    def expire(self, now: float) -> list[tuple[str, str]]:
        """Dismiss actors that were admitted and did not come within :data:`PROVISIONAL_TIMEOUT`. Returns them. ``now``
        [s]: time of the monotonic clock. Also forgets joins that count no more."""
        gone = [
            actor
            for actor, admitted in self._admitted.items()
            if now - admitted.since > PROVISIONAL_TIMEOUT and admitted.session not in self._alive.get(actor, ())
        ]
        for actor in gone:
            self._dismiss(actor)
        self._joins = {key: kept for key, kept in self._joins.items() if now - kept[1] < JOIN_BURST_TIME}
        return gone

    def _dismiss(self, actor: tuple[str, str]) -> None:
        del self._admitted[actor]
        self._spectators.discard(actor)
        self._forget(actor[0])

    def forget_actors(self) -> list[tuple[str, str]]:
        """Forget all actors, because the router was closed. They join again when it is open. Returns them."""
        gone = list(self._admitted)
        self._alive.clear()
        self._tokens = 0
        self._admitted.clear()
        self._spectators.clear()
        for world in list(self._scenes):
            self._forget(world)
        return gone

    def publisher(self, world: str, name: str) -> str:
        """Returns the session that may publish records under a name: it was admitted with this name, and not as a
        spectator. Empty: none may.

        A server that was restarted has not admitted the actor yet. Until then the only live session with the name may
        publish. A session that has left may, too, until another one has the name, because its last records may still be
        on their way.
        """
        actor = (world, name)
        if actor in self._admitted:
            return "" if actor in self._spectators else self._admitted[actor].session
        alive = self._alive.get(actor, set())
        if len(alive) == 1:
            return "".join(alive)
        return "" if alive else self._departed.get(actor, "")

    def refuse(self, reason: str) -> Welcome:
        """Count a join that is refused for a ``reason`` that this object does not know of, and return the reply."""
        self.refused += 1
        return Welcome(reason)

    def decide(self, world: str, name: str, session: str, greeting: bytes, now: float, address: str = "") -> Welcome:
        """Admit or reject an actor that sends the encoded hello ``greeting``, and return the reply to it.

        ``name``: name in the key of the query. ``now`` [s]: time of a monotonic clock. ``address``: from which the
        session connects; empty: unknown. A session may ask repeatedly.
        """
        if reason := self._key_objection(world, name, session, now, address):
            self.refused += 1
            return Welcome(reason)
        try:
            hello = decode_hello(greeting)
            reason = self._find_objection(world, name, session, hello, now, address)
        except WrongVersion as error:
            reason = (
                f"{name!r} speaks protocol version {error.theirs}, the server version {PROTOCOL}: "
                f"use the same release of vinesim"
            )
        except MessageError as error:
            reason = f"the greeting of {name!r} cannot be read: {error}"
        else:
            if not reason:
                self._admitted[world, name] = _Admitted(session, now, address)
                if world not in self._scenes:
                    self._opened_by[world] = address
                (self._spectators.add if hello.kind == "spectator" else self._spectators.discard)((world, name))
                self._scenes.setdefault(world, SceneId(hello.scene, hello.digest))
        self.refused += bool(reason)
        return Welcome(reason, *self.scene_of(world), self._spectators_speak_to)

    def _key_objection(self, world: str, name: str, session: str, now: float, address: str) -> str:
        """Returns the reason why a query to join is refused before its greeting is read; empty if it is read."""
        for what, text in (("actor name", name), ("world", world), ("session", session)):
            if not is_valid_name(text):
                return f"{what} {text[:60]!r}: use 1 to 48 letters, digits, '_', '-' or '.'"
        self.expire(now)
        limits = self.limits
        for key, rate in (
            (("session", session), limits.joins_per_session),
            (("address", address), limits.joins_per_address),
        ):
            left, since = self._joins.get(key, (JOIN_BURST_TIME * rate, now))
            left = min(left + (now - since) * rate, JOIN_BURST_TIME * rate) - 1.0
            if key[1] and not is_loopback(key[1]) and left < 0.0:
                return f"this {key[0]} asked to join more than {rate:g} times a second: try again later"
            self._joins[key] = left, now
        return ""

    def _find_objection(self, world: str, name: str, session: str, hello: Hello, now: float, address: str) -> str:
        """Returns the reason why an actor cannot be admitted, and the remedy; empty if it can."""
        if hello.name != name:
            return f"{name!r} introduces itself as {hello.name!r}"
        holder = self.holder(world, name) or session
        is_reserved = now < self.reserved_until and self._alive.get((world, name), {session}) - {session}
        if holder != session or is_reserved:
            return f"an actor named {name!r} is already live in world {world!r}: choose another name or stop that one"
        scene = self.scene_of(world)
        if scene.digest and scene.digest != hello.digest:
            if self._required_scene is not None:
                whose = "the server was started for"
                remedy = "start the client with the server's scene and seed"
            elif world in self._pinned:
                whose = f"the facts kept of world {world!r} belong to"
                remedy = "use that scene and seed, or start the server with another --state-dir"
            else:
                whose = f"world {world!r} has"
                remedy = "start all with the same scene, seed and release of vinesim"
            return (
                f"{name!r} has scene {hello.scene!r} with digest {hello.digest!r}, "
                f"{whose} {scene.scene!r} with {scene.digest!r}: {remedy}"
            )
        return self._find_excess(world, name, session, address)

    def _find_excess(self, world: str, name: str, session: str, address: str) -> str:
        """Returns which of :class:`JoinLimits` an actor would exceed; empty if none.

        If all places are taken, an actor that is live gets the place of one that was admitted and has not come.
        """
        limits = self.limits
        others = {actor: admitted for actor, admitted in self._admitted.items() if actor != (world, name)}
        waiting = [actor for actor, other in others.items() if other.session not in self._alive.get(actor, ())]
        is_live = session in self._alive.get((world, name), ())
        if held := [actor for actor, other in others.items() if other.session == session]:
            return f"this session has joined as {held[0][1]!r}, and each session joins with one name"
        if address:
            beside = [actor for actor, other in others.items() if other.address == address]
            if not is_loopback(address) and len(beside) >= limits.actors_per_address:
                return f"the server admits {limits.actors_per_address} actors of one address: try again later"
            if not is_live and sum(actor in beside for actor in waiting) >= limits.waiting_per_address:
                return f"{limits.waiting_per_address} actors of this address were admitted and did not come: wait"
        if world not in self._scenes:
            opened = sum(other == address for other in self._opened_by.values()) if address else 0
            if len(self._scenes) >= limits.worlds or opened >= limits.worlds_per_address:
                return (
                    f"the server keeps {len(self._scenes)} worlds, at most {limits.worlds}, and "
                    f"{limits.worlds_per_address} of one address: join one of them, or remove worlds from --state-dir"
                )
        if limits.actors is not None and len(others) >= limits.actors:
            if not is_live or not waiting:
                return f"the server admits {limits.actors} actors and {len(others)} are in it: try again later"
            self._dismiss(min(waiting, key=lambda actor: others[actor].since))
        return ""

    def _forget(self, world: str) -> None:
        """Forget the scene of a world that has no actors and no retained records."""
        if world not in self._pinned and not any(there == world for there, _ in self._admitted):
            self._scenes.pop(world, None)
            self._opened_by.pop(world, None)


def is_loopback(address: str) -> bool:
    """Whether an address is that of this machine itself."""
    try:
        return ipaddress.ip_address(address.strip("[]")).is_loopback
    except ValueError:
        return address == "localhost"
