"""Messages of senders that have not been admitted yet: they wait within bounds, for records are published only once."""

from __future__ import annotations

from collections.abc import Callable

MAX_EARLY_MESSAGES = 100
"""Messages of one sender."""

MAX_EARLY_BYTES = 1 << 20
"""Payload bytes of one sender [B]: the largest message."""

MAX_EARLY_SENDERS = 64
"""Senders with messages."""

MAX_EARLY_TOTAL = 4 << 20
"""Payload bytes of all senders [B]."""


class EarlyMessages:
    """Messages (key, payload) by sender. Live senders displace those that are not live."""

    def __init__(self) -> None:
        self._messages: dict[str, list[tuple[str, bytes]]] = {}
        self._sizes: dict[str, int] = {}

    def __len__(self) -> int:
        """Number of senders."""
        return len(self._messages)

    @property
    def size(self) -> int:
        """Payload bytes of all messages [B]."""
        return sum(self._sizes.values())

    def put(self, sender: str, key: str, payload: bytes, is_live: Callable[[str], bool]) -> int:
        """Keep a message if there is room; the number of messages that were discarded: this one or others.

        ``is_live(sender)``: whether a sender may be admitted soon.
        """
        discarded = 0
        if self._has_no_room(sender, len(payload)) and is_live(sender):
            for other in [other for other in self._messages if other != sender and not is_live(other)]:
                discarded += len(self.take(other))
        if self._has_no_room(sender, len(payload)):
            return discarded + 1
        self._messages.setdefault(sender, []).append((key, payload))
        self._sizes[sender] = self._sizes.get(sender, 0) + len(payload)
        return discarded

    def take(self, sender: str) -> list[tuple[str, bytes]]:
        """Remove and return the messages of a sender, in order of arrival."""
        self._sizes.pop(sender, None)
        return self._messages.pop(sender, [])

    def _has_no_room(self, sender: str, size: int) -> bool:
        return (
            len(self._messages.get(sender, ())) >= MAX_EARLY_MESSAGES
            or self._sizes.get(sender, 0) + size > MAX_EARLY_BYTES
            or (sender not in self._messages and len(self._messages) >= MAX_EARLY_SENDERS)
            or self.size + size > MAX_EARLY_TOTAL
        )
