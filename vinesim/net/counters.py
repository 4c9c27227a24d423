"""What crossed the network, and what was not believed: figures for the status line and for tests."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(slots=True)
class Traffic:
    """Messages and payload bytes of one family, each way."""

    messages_in: int = 0
    bytes_in: int = 0
    messages_out: int = 0
    bytes_out: int = 0

    def count_in(self, payload: bytes) -> None:
        """One message came."""
        self.messages_in += 1
        self.bytes_in += len(payload)

    def count_out(self, payload: bytes) -> None:
        """One message left."""
        self.messages_out += 1
        self.bytes_out += len(payload)


@dataclasses.dataclass(slots=True)
class Counters:
    """What crossed the network and what was not believed."""

    actor: Traffic = dataclasses.field(default_factory=Traffic)
    """Poses of robots and humans."""
    environment: Traffic = dataclasses.field(default_factory=Traffic)
    """Moving trees, boxes and loose bunches."""
    event: Traffic = dataclasses.field(default_factory=Traffic)
    """Claims, corrections and rest."""
    retained: Traffic = dataclasses.field(default_factory=Traffic)
    """What was picked or cut and where things lie: these leave even if nobody is near, for the server keeps them."""
    force: Traffic = dataclasses.field(default_factory=Traffic)
    """What hands do to robots of other clients."""
    control: Traffic = dataclasses.field(default_factory=Traffic)
    """Greetings, clock and what the server keeps (received only)."""
    malformed: int = 0
    """Messages that could not be believed."""
    dropped: int = 0
    """Sound messages and records not used: overtaken, of a stranger, too far away, or of a lesser claim."""
