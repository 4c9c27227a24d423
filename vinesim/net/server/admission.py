"""Who may be in a world: one scene, one protocol, one bearer of each name, not more than there is room for; pure.

A world takes its scene from the first actor that is let in. It keeps it while anybody is there, and for good once facts
about its things are kept (:meth:`Agreement.keep`): a vineyard with cut trees cannot become another one.
"""

from __future__ import annotations

from typing import NamedTuple

from vinesim.net.codec import messages
from vinesim.net.codec.messages import PROTOCOL, Hello, MessageError, Welcome, WrongVersion

PROVISIONAL_TIMEOUT = 5.0
"""How long the place of an actor is held that was let in and has not been seen alive yet [s]."""


class SceneId(NamedTuple):
    """A scene as far as a server knows it."""

    scene: str = ""
    """Name of the scene."""
    digest: str = ""
    """``Model.digest()`` of its vineyard; empty: not known."""


class AdmissionControl:
    """Decides about greetings. ``session`` is whatever tells two programs with one name apart."""

    def __init__(self, plan: SceneId | None = None, most: int | None = None) -> None:
        """Only ``plan`` is allowed, in every world; at most ``most`` actors over all worlds. None: no such bound."""
        self._plan, self._most = plan, most
        self._plans: dict[str, SceneId] = {}
        self._kept: set[str] = set()
        self._alive: dict[tuple[str, str], set[str]] = {}
        self._admitted: dict[tuple[str, str], tuple[str, float]] = {}
        self.joined = 0
        """How many actors ever came."""
        self.refused = 0
        """How many greetings were not."""

    @property
    def actors(self) -> list[str]:
        """Who is alive now, as ``world/name``, sorted."""
        return sorted(f"{world}/{name}" for (world, name), sessions in self._alive.items() if sessions)

    def scene_of(self, world: str) -> SceneId:
        """The scene that a world has now."""
        return self._plan or self._plans.get(world, SceneId())

    def pin_scene(self, world: str, plan: SceneId) -> None:
        """Facts are kept of this world: its scene stays what it is, even when nobody is there."""
        self._plans[world] = plan
        self._kept.add(world)

    def on_join(self, world: str, name: str, session: str) -> None:
        """A program with this name is alive."""
        sessions = self._alive.setdefault((world, name), set())
        self.joined += not sessions
        sessions.add(session)

    def on_leave(self, world: str, name: str, session: str) -> None:
        """It is alive no more."""
        actor = (world, name)
        sessions = self._alive.get(actor, set())
        sessions.discard(session)
        if not sessions:
            self._alive.pop(actor, None)
        if self._admitted.get(actor, ("", 0.0))[0] == session:
            del self._admitted[actor]
        self._forget(world)

    def answer(self, world: str, name: str, session: str, greeting: bytes, now: float) -> Welcome:
        """Decide about a greeting that came under this name at ``now`` [s]; to ask twice is no harm."""
        for actor, (other, since) in list(self._admitted.items()):
            if now - since > PROVISIONAL_TIMEOUT and other not in self._alive.get(actor, ()):
                del self._admitted[actor]
                self._forget(actor[0])
        try:
            hello = messages.decode_hello(greeting)
            why = self._objection(world, name, session, hello)
        except WrongVersion as error:
            why = (
                f"{name!r} speaks protocol version {error.theirs}, the server version {PROTOCOL}: "
                f"use the same release of vinesim"
            )
        except MessageError as error:
            why = f"the greeting of {name!r} cannot be read: {error}"
        else:
            if not why:
                self._admitted[world, name] = (session, now)
                self._plans.setdefault(world, SceneId(hello.scene, hello.digest))
        self.refused += bool(why)
        return Welcome(why, *self.scene_of(world))

    def _objection(self, world: str, name: str, session: str, hello: Hello) -> str:
        if hello.name != name:
            return f"{name!r} introduces itself as {hello.name!r}"
        admitted = self._admitted.get((world, name), (session, 0.0))[0]
        if admitted != session or self._alive.get((world, name), {session}) - {session}:
            return f"an actor named {name!r} is already live in world {world!r}: choose another name or stop that one"
        plan = self.scene_of(world)
        if plan.digest and plan.digest != hello.digest:
            if self._plan is not None:
                whose = "the server was started for"
                remedy = "start the client with the server's scene and seed"
            elif world in self._kept:
                whose = f"the facts kept of world {world!r} belong to"
                remedy = "use that scene and seed, or start the server with another --state-dir"
            else:
                whose = f"world {world!r} has"
                remedy = "start all with the same scene, seed and release of vinesim"
            return (
                f"{name!r} has scene {hello.scene!r} with digest {hello.digest!r}, "
                f"{whose} {plan.scene!r} with {plan.digest!r}: {remedy}"
            )
        others = self._admitted.keys() - {(world, name)}
        if self._most is not None and len(others) >= self._most:
            return f"the server has room for {self._most} actors and {len(others)} are there: come back later"
        return ""

    def _forget(self, world: str) -> None:
        if world not in self._kept and not any(there == world for there, _ in self._admitted):
            self._plans.pop(world, None)
