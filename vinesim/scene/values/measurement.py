"""One line of a benchmark."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True, slots=True)
class Measurement:
    """One line of ``vinesim bench``: a number measured for vinesim, and the same number for a *peer*: another program
    that runs in the same process on the same scene, for comparison."""

    bench: str
    case: str
    value: float
    unit: str
    peer: str = ""
    peer_value: float | None = None
    ratio: float | None = None
    """Ratio by which vinesim is better than the peer: above 1 is better, whatever the unit."""
