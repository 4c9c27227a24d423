"""Admission control: one scene, one protocol version, unique names, and a limit of actors in a world; pure.

A world takes the scene of the first actor that is admitted. It keeps it while an actor is there, and for good once
records about its objects are retained (:meth:`AdmissionControl.pin_scene`): a vineyard with cut trees cannot become
another one.
"""

from __future__ import annotations

from typing import NamedTuple

from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.net.codec.control import Hello, Welcome, decode_hello
from vinesim.net.codec.header import PROTOCOL, MessageError, WrongVersion

PROVISIONAL_TIMEOUT = 5.0
"""Time for which the place of an admitted actor is reserved until its liveliness token is seen [s]."""


class SceneId(NamedTuple):
    """Identity of a scene."""

    scene: str = ""
    """Name of the scene."""
    digest: str = ""
    """``Model.digest()`` of its vineyard; empty: unknown."""


class AdmissionControl:
    """Decides about hellos. ``session`` distinguishes two programs with the same name."""

    def __init__(
        self,
        scene: SceneId | None = None,
        max_actors: int | None = None,
        spectators_speak_to: SpectatorsSpeakTo = SpectatorsSpeakTo.PEOPLE,
    ) -> None:
        """``scene``: the only scene allowed in every world. ``max_actors``: largest number of actors of all worlds
        together. None: no such limit."""
        self._required_scene = scene
        self._max_actors = max_actors
        self._spectators_speak_to = spectators_speak_to
        self._scenes: dict[str, SceneId] = {}
        self._pinned: set[str] = set()
        self._alive: dict[tuple[str, str], set[str]] = {}
        self._admitted: dict[tuple[str, str], tuple[str, float]] = {}
        self._spectators: set[tuple[str, str]] = set()
        """World and name of the admitted spectators, who publish no records."""
        self.joined = 0
        """Number of joins since the start."""
        self.refused = 0
        """Number of hellos that were rejected."""

    @property
    def actors(self) -> list[str]:
        """Actors that are live now, as ``world/name``, sorted."""
        return sorted(f"{world}/{name}" for (world, name), sessions in self._alive.items() if sessions)

    def is_admitted(self, world: str, name: str) -> bool:
        """Whether an actor has been admitted and has not left."""
        return (world, name) in self._admitted

    def may_slow(self, world: str, name: str) -> bool:
        """Whether the world waits for an actor: one that was admitted, is live, and simulates with a body."""
        actor = (world, name)
        return actor in self._admitted and actor not in self._spectators and self.is_live(world, name)

    def has_actors(self, world: str) -> bool:
        """Whether any session is live in a world."""
        return any(there == world for there, _ in self._alive)

    def is_live(self, world: str, name: str) -> bool:
        """Whether a session with this name is live."""
        return bool(self._alive.get((world, name)))

    def scene_of(self, world: str) -> SceneId:
        """The scene of a world now."""
        return self._required_scene or self._scenes.get(world, SceneId())

    def pin_scene(self, world: str, scene: SceneId) -> None:
        """Fix the scene of a world that has retained records, even while it has no actor."""
        self._scenes[world] = scene
        self._pinned.add(world)

    def on_join(self, world: str, name: str, session: str) -> None:
        """Note that a session with this name is live."""
        sessions = self._alive.setdefault((world, name), set())
        self.joined += not sessions
        sessions.add(session)

    def on_leave(self, world: str, name: str, session: str) -> None:
        """Note that a session is no longer live."""
        actor = (world, name)
        sessions = self._alive.get(actor, set())
        sessions.discard(session)
        if not sessions:
            self._alive.pop(actor, None)
        if self._admitted.get(actor, ("", 0.0))[0] == session:
            del self._admitted[actor]
        self._forget(world)

    def forget_actors(self) -> None:
        """Forget all actors, because no session is connected any more."""
        self._alive.clear()
        self._admitted.clear()
        self._spectators.clear()
        for world in list(self._scenes):
            self._forget(world)

    def may_publish(self, world: str, name: str, session: str) -> bool:
        """Whether records under this name come from the session that was admitted with it, and not as a spectator.

        Until an actor is admitted again by a server that was restarted: from the only session with this name.
        """
        actor = (world, name)
        if actor in self._admitted:
            return self._admitted[actor][0] == session and actor not in self._spectators
        return self._alive.get(actor) == {session}

    def decide(self, world: str, name: str, session: str, greeting: bytes, now: float) -> Welcome:
        """Decide about an encoded hello under this name at ``now`` [s]; repeated queries are allowed."""
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
        """Returns why an actor cannot be admitted, or "" if it can."""
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
        if world not in self._pinned and not any(there == world for there, _ in self._admitted):
            self._scenes.pop(world, None)
