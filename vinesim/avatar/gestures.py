"""Finger poses of a hand: how far thumb, index, middle, ring and little finger are bent, 0 straight to 1 all the
way."""

from __future__ import annotations

FingerBend = tuple[float, float, float, float, float]
"""[1] One number for each finger, from the thumb on; see :class:`vinesim.scene.values.HumanPose`."""

OPEN_HAND: FingerBend = (0.0, 0.0, 0.0, 0.0, 0.0)
FIST: FingerBend = (1.0, 1.0, 1.0, 1.0, 1.0)


def finger_bend(*, closed: bool) -> FingerBend:
    """The fingers of a hand that is closed or open."""
    return FIST if closed else OPEN_HAND
