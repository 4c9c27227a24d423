"""Admission control: actors of a world have the same scene and protocol version, and unique names. No I/O.

The scene of a world is that of the first actor that is admitted. A world keeps its scene while it has actors. Once
records about its objects are retained, it keeps the scene for good (:meth:`AdmissionControl.pin_scene`), because the
cuts of a vineyard mean nothing in another one.
"""

from __future__ import annotations

from typing import NamedTuple

from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.net.codec.control import Hello, Welcome, decode_hello
from vinesim.net.codec.header import PROTOCOL, MessageError, WrongVersion

PROVISIONAL_TIMEOUT = 5.0
"""Time for which the name of an admitted actor is reserved until its liveliness token arrives [s]."""


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
    ) -> None:
        """``scene``: the only scene that is allowed; None: any. ``max_actors``: largest number of actors in all worlds
        together; None: no limit. ``spectators_speak_to``: who hears spectators."""
        self._required_scene = scene
        self._max_actors = max_actors
        self._spectators_speak_to = spectators_speak_to
        self._scenes: dict[str, SceneId] = {}
        self._pinned: set[str] = set()
        self._alive: dict[tuple[str, str], set[str]] = {}
        self._admitted: dict[tuple[str, str], tuple[str, float]] = {}
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
        return any(there == world for there, _ in self._alive)

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
        sessions = self._alive.setdefault((world, name), set())
        self.joined += not sessions
        sessions.add(session)

    def on_leave(self, world: str, name: str, session: str) -> None:
        """Note that the liveliness token of a name and session is gone."""
        actor = (world, name)
        sessions = self._alive.get(actor, set())
        sessions.discard(session)
        if not sessions:
            self._alive.pop(actor, None)
        if self._admitted.get(actor, ("", 0.0))[0] == session:
            del self._admitted[actor]
        self._forget(world)

    def forget_actors(self) -> None:
        """Forget all actors, because the router was closed. They join again when it is open."""
        self._alive.clear()
        self._admitted.clear()
        self._spectators.clear()
        for world in list(self._scenes):
            self._forget(world)

    def may_publish(self, world: str, name: str, session: str) -> bool:
        """Whether a session may publish records under a name: it was admitted with this name, and not as a spectator.

        A server that was restarted has not admitted the actor yet. Until then the only live session with the name may
        publish.
        """
        actor = (world, name)
        if actor in self._admitted:
            return self._admitted[actor][0] == session and actor not in self._spectators
        return self._alive.get(actor) == {session}

    def decide(self, world: str, name: str, session: str, greeting: bytes, now: float) -> Welcome:
        """Admit or reject an actor that sends the encoded hello ``greeting``, and return the reply to it.

        ``name``: name in the key of the query. ``now`` [s]: time of a monotonic clock. A session may ask repeatedly.
        """
        for actor, (admitted_session, since) in list(self._admitted.items()):
            if now - since > PROVISIONAL_TIMEOUT and admitted_session not in self._alive.get(actor, ()):
                del self._admitted[actor]
                self._forget(actor[0])
        try:
            hello = decode_hello(greeting)
            reason = self._find_objection(world, name, session, hello)
        except WrongVersion as error:
            reason = (
                f"{name!r} speaks protocol version {error.theirs}, the server version {PROTOCOL}: "
                f"use the same release of vinesim"
            )
        except MessageError as error:
            reason = f"the greeting of {name!r} cannot be read: {error}"
        else:
            if not reason:
                self._admitted[world, name] = (session, now)
                (self._spectators.add if hello.kind == "spectator" else self._spectators.discard)((world, name))
                self._scenes.setdefault(world, SceneId(hello.scene, hello.digest))
        self.refused += bool(reason)
        return Welcome(reason, *self.scene_of(world), self._spectators_speak_to)

    def _find_objection(self, world: str, name: str, session: str, hello: Hello) -> str:
        """Returns the reason why an actor cannot be admitted, and the remedy; empty if it can."""
        if hello.name != name:
            return f"{name!r} introduces itself as {hello.name!r}"
        admitted = self._admitted.get((world, name), (session, 0.0))[0]
        if admitted != session or self._alive.get((world, name), {session}) - {session}:
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
        others = self._admitted.keys() - {(world, name)}
        if self._max_actors is not None and len(others) >= self._max_actors:
            return f"the server admits {self._max_actors} actors and {len(others)} are in it: try again later"
        return ""

    def _forget(self, world: str) -> None:
        """Forget the scene of a world that has no actors and no retained records."""
        if world not in self._pinned and not any(there == world for there, _ in self._admitted):
            self._scenes.pop(world, None)
