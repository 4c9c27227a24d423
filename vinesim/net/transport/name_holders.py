"""Zenoh sessions that hold the names of actors. A message under an actor's name is accepted only from the session that
holds the name.

A session holds a name once it has declared the liveliness token ``live/<name>/<session>``. If a second session declares
a token of the same name, members that know the first token still accept the first session. A member that joins while
both tokens exist accepts neither session until one token is gone. If the server knows which session joined with the
name, that one holds it in both cases (:meth:`NameHolders.prefer`), so a token alone takes no name away. Messages that
arrive after their session has left are accepted, because the last records of an actor may still be on their way.

Without TLS a message proves its session by a signature (:mod:`vinesim.net.transport.signatures`).
"""

from __future__ import annotations

import threading

from vinesim.net.codec.messages import FAMILIES, sender_of

MAX_FORMER_SESSIONS = 8
"""Largest number of sessions that have left and are still stored, for one name."""

MAX_FORMER_NAMES = 4096
"""Largest number of names without a live session that are still stored. When a connection is lost, all names behind it
lose their sessions at once, and messages may come back before the tokens do: more than a world has actors."""

BOUND_FAMILIES = frozenset(name for name, family in FAMILIES.items() if family.is_published) | {"hello", "robot"}
"""Families of keys that contain the name of the actor that may send under them, by their first chunk."""


def bound_name(key: str) -> str:
    """Returns the name of the only actor that may send under a key; empty if the key belongs to no actor.

    ``key``: relative to the world.
    """
    return sender_of(key) if key.partition("/")[0] in BOUND_FAMILIES else ""


class NameHolders:
    """All names of a world and the sessions that declared them. May be used from several threads."""

    def __init__(self, own: frozenset[str] = frozenset()) -> None:
        """``own``: names that are always live."""
        self._own = own
        self._sessions: dict[str, dict[str, bool]] = {}
        """Whether a session is live, by name and session, in the order in which the sessions declared the name."""
        self._holder: dict[str, str] = {}
        self._preferred: dict[str, str] = {}
        """Session that the server admitted, by name, for names that several sessions declared."""
        self._departed: dict[str, None] = {}
        """Names without a live session, in the order in which they were left."""
        self._disputed: set[str] = set()
        """Names with several live sessions that all declared the name before this member joined."""
        self._lock = threading.Lock()
        self.live = own
        """Names that have a live session, and the own names."""
        self.returned = 0
        """Number of times that a name without a live session got one again: the connection to it was lost."""

    def start(self, tokens: list[tuple[str, str]]) -> None:
        """Store all tokens, as (name, session), that existed before this member joined."""
        for name, session in tokens:
            self.update(name, session, True)
        with self._lock:
            for name in {name for name, _ in tokens}:
                if sum(self._sessions[name].values()) > 1:
                    self._disputed.add(name)
                    self._choose(name)

    def update(self, name: str, session: str, is_live: bool) -> None:
        """Note that a session has declared the token of a name, or withdrawn it if not ``is_live``."""
        with self._lock:
            sessions = self._sessions.setdefault(name, {})
            if not is_live and session not in sessions:
                return
            if is_live and not sessions.get(session, True):
                del sessions[session]  # a session that comes back counts as the latest
            sessions[session] = is_live
            former = [one for one, live in sessions.items() if not live]
            for one in former[: len(former) - MAX_FORMER_SESSIONS]:
                del sessions[one]
            self._choose(name)
            if any(sessions.values()):
                if name in self._departed:
                    del self._departed[name]
                    self.returned += 1
                if name not in self.live:
                    self.live |= {name}
                return
            if name not in self._own:
                self.live -= {name}
            self._departed.pop(name, None)
            self._departed[name] = None
            while len(self._departed) > MAX_FORMER_NAMES:
                oldest = next(iter(self._departed))
                del self._departed[oldest], self._sessions[oldest]
                self._holder.pop(oldest, None)
                self._preferred.pop(oldest, None)

    def refresh(self, tokens: list[tuple[str, str]]) -> None:
        """Store all tokens that exist now, and that all others are gone."""
        with self._lock:
            known = [(name, session) for name, sessions in self._sessions.items() for session in sessions]
        for name, session in {*known} - {*tokens}:
            self.update(name, session, False)
        for name, session in tokens:
            self.update(name, session, True)

    def contested(self) -> list[str]:
        """Returns the names with several live sessions of which none is preferred."""
        with self._lock:
            return [
                name
                for name, sessions in self._sessions.items()
                if sum(sessions.values()) > 1 and not sessions.get(self._preferred.get(name, ""), False)
            ]

    def prefer(self, name: str, session: str) -> None:
        """Note that the server admitted a session with a name."""
        with self._lock:
            if name in self._sessions:
                self._preferred[name] = session
                self._choose(name)

    def holder(self, name: str) -> str:
        """Returns the session that holds a name or held it last; empty if there is none."""
        return self._holder.get(name, "")

    def _choose(self, name: str) -> None:
        """Set the session that holds a name, by the sessions that are live now."""
        live = [session for session, is_live in self._sessions[name].items() if is_live]
        if len(live) < 2:
            self._disputed.discard(name)
        if self._preferred.get(name, "") in live:
            self._holder[name] = self._preferred[name]
        elif name in self._disputed:
            self._holder.pop(name, None)
        elif live:
            self._holder[name] = live[0]
