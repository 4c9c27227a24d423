"""Counters of network traffic and of rejected messages, for status lines and tests."""

from __future__ import annotations

import dataclasses
from typing import Any


@dataclasses.dataclass(slots=True)
class Traffic:
    """Messages and payload bytes of one family of keys, each way."""

    messages_in: int = 0
    bytes_in: int = 0
    messages_out: int = 0
    bytes_out: int = 0

    def count_in(self, payload: bytes) -> None:
        """Count a received message."""
        self.messages_in += 1
        self.bytes_in += len(payload)

    def count_out(self, payload: bytes) -> None:
        """Count a sent message."""
        self.messages_out += 1
        self.bytes_out += len(payload)


@dataclasses.dataclass(slots=True)
class Counters:
    """Traffic by family, and rejected messages."""

    actor: Traffic = dataclasses.field(default_factory=Traffic)
    """Poses of robots and humans."""
    environment: Traffic = dataclasses.field(default_factory=Traffic)
    """States of moving trees, boxes and free bunches."""
    event: Traffic = dataclasses.field(default_factory=Traffic)
    """Claims, corrections and states at rest."""
    retained: Traffic = dataclasses.field(default_factory=Traffic)
    """Retained records: these leave even if no peer is near, because the server keeps them."""
    force: Traffic = dataclasses.field(default_factory=Traffic)
    """Wrenches of hands on robots of other clients, and couplings of two actors to one tree."""
    voice: Traffic = dataclasses.field(default_factory=Traffic)
    """Frames of sound."""
    control: Traffic = dataclasses.field(default_factory=Traffic)
    """Hellos, clock replies and snapshots (received only)."""
    malformed: int = 0
    """Messages that could not be decoded."""
    dropped: int = 0
    """Valid messages and states that were not used: outdated, of an unknown peer, too far away, or of a lesser claim.
    """
    wrenches_refused: int = 0
    """Wrenches of peers on links that their hands do not reach, or that there are not."""
    wrenches_limited: int = 0
    """Messages and steps whose wrenches were reduced to what hands can do."""

    couplings_refused: int = 0
    """Couplings of peers to trees that neither side owns, or that their arms do not reach."""

    foreign: int = 0
    """Messages and answers that the bus dropped: of a session that does not hold the name they came under."""
    lost: int = 0
    """Received samples that the bus discarded: its store was full, or the sample too large."""
    network_failures: int = 0
    """Puts, declarations and queries of the bus that the network refused."""

    def to_report(self) -> dict[str, Any]:
        """All counters under the keys of ``report.json``, where retained records are called ``fact``."""
        return {"fact" if name == "retained" else name: value for name, value in dataclasses.asdict(self).items()}
