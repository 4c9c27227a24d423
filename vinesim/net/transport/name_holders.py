"""Names of actors and the sessions that hold them: a message under a name counts only from the session that holds it.

A session holds a name from its liveliness token ``live/<name>/<session>`` on. If a second session declares a token of
the same name, members that saw the first token keep to it. Members that see both tokens at first believe neither until
one is left. Messages of a session that arrive after it has left still count, because the last records of an actor may
be under way.

Without TLS a session states its own identity. This keeps programs apart that use vinesim or Zenoh as they are, but not
a program that was written to deceive (``docs/network.md``).
"""

from __future__ import annotations

import threading

from vinesim.net.codec.messages import FAMILIES, sender_of

MAX_FORMER_SESSIONS = 8
"""Largest number of sessions of one name that have left and are still remembered."""

BOUND_FAMILIES = frozenset(name for name, family in FAMILIES.items() if family.is_published) | {"hello"}
"""First chunks of the keys that belong to one actor."""


def bound_name(key: str) -> str:
    """Name of the actor that a key, without its world, belongs to; empty for a key of no actor."""
    return sender_of(key) if key.partition("/")[0] in BOUND_FAMILIES else ""


class NameHolders:
    """Sessions of each name, in the order in which they declared it. May be used from several threads."""

    def __init__(self, own: frozenset[str] = frozenset()) -> None:
        """``own``: names that are live whatever tokens arrive."""
        self._own = own
        self._sessions: dict[str, dict[str, bool]] = {}
        """Whether a session is live, by name and session."""
        self._holder: dict[str, str] = {}
        self._disputed: set[str] = set()
        """Names that several sessions held before this session joined."""
        self._lock = threading.Lock()
        self.live = own
        """Names that have a live session."""

    def start(self, tokens: list[tuple[str, str]]) -> None:
        """Take the name and session of all tokens that existed before this session joined."""
        for name, session in tokens:
            self.update(name, session, True)
        with self._lock:
            for name in {name for name, _ in tokens}:
                if sum(self._sessions[name].values()) > 1:
                    self._disputed.add(name)
                    self._choose(name)

    def update(self, name: str, session: str, is_live: bool) -> None:
        """Note that a session has declared (``is_live``) or withdrawn the token of a name."""
        with self._lock:
            sessions = self._sessions.setdefault(name, {})
            if not is_live and session not in sessions:
                return
            if is_live and not sessions.get(session, True):
                del sessions[session]  # one that comes back is the last again
            sessions[session] = is_live
            former = [one for one, live in sessions.items() if not live]
            for one in former[: len(former) - MAX_FORMER_SESSIONS]:
                del sessions[one]
            self._choose(name)
            there = (name for name, sessions in self._sessions.items() if any(sessions.values()))
            self.live = self._own.union(there)

    def holder(self, name: str) -> str:
        """The session that holds a name, or held it last. Empty if there is none."""
        return self._holder.get(name, "")

    def _choose(self, name: str) -> None:
        live = [session for session, is_live in self._sessions[name].items() if is_live]
        if len(live) < 2:
            self._disputed.discard(name)
        if name in self._disputed:
            self._holder.pop(name, None)
        elif live:
            self._holder[name] = live[0]
