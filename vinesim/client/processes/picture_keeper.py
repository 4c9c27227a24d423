"""Which of a camera's pictures is kept for the folder of a run."""

from __future__ import annotations

from vinesim.scene.values import CameraFrame

RENEWAL_PERIOD = 1.0
"""Simulated time after which a picture replaces one that shows as much [s]."""


class PictureKeeper:
    """Keeps the picture with the highest score, and asks for one only where it would be kept.

    A whole picture without a subscriber costs as much as one with, and one of all is written in the end
    (docs/decisions/sensor-process.md).
    """

    def __init__(self) -> None:
        self.frame: CameraFrame | None = None
        """The picture that is kept: colours, depth and labels."""
        self._score = 0.0

    def wants(self, time: float, score: float) -> bool:
        """Whether a picture of this simulated ``time`` [s] would be kept: it shows more than the present one, or as
        much and later."""
        if self.frame is None or score > self._score:
            return True
        return score == self._score and time >= self.frame.time + RENEWAL_PERIOD

    def keep(self, frame: CameraFrame, score: float) -> None:
        """Keep this one instead."""
        self.frame = frame
        self._score = score
