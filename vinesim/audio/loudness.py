"""How loud a sound is at a distance: the free field's 1/d, nothing beyond hearing reach."""

from __future__ import annotations

REFERENCE = 1.0
"""[m] Up to here a sound is as loud as it was recorded."""

REACH = 25.0
"""[m] Beyond it nothing is heard, and no voice crosses the network. GUESSED."""

FADE = 5.0
"""[m] Before :data:`REACH`: here loudness falls to nothing, so that nothing begins at once. GUESSED."""


def gain(distance: float) -> float:
    """Amplitude of a sound at a ``distance`` [m], relative to that within :data:`REFERENCE`: 1/d, and 0 from
    :data:`REACH` on."""
    if not distance < REACH:
        return 0.0
    return REFERENCE / max(distance, REFERENCE) * min(1.0, (REACH - distance) / FADE)
