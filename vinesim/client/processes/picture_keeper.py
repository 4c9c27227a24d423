"""Keeps the best picture of a camera, which is written to the folder of a run."""

from __future__ import annotations

from vinesim.scene.values import CameraFrame

RENEWAL_PERIOD = 1.0
"""Simulated time after which a picture replaces an older picture with the same score [s]."""


class PictureKeeper:
    """Keeps the picture with the highest score, and requests a picture only if it would be kept.

    A picture costs the same with a subscriber and without, and only one of all pictures is written in the end
    (docs/decisions/sensor-process.md).
    """

    def __init__(self) -> None:
        self.frame: CameraFrame | None = None
        """The picture that is kept: colours, depth and labels."""
        self._score = 0.0

    def wants(self, time: float, score: float) -> bool:
        """Whether a picture of this simulated ``time`` [s] would be kept: its score is higher than that of the kept
        picture, or the same and it is at least :data:`RENEWAL_PERIOD` later."""
        if self.frame is None or score > self._score:
            return True
        return score == self._score and time >= self.frame.time + RENEWAL_PERIOD

    def keep(self, frame: CameraFrame, score: float) -> None:
        """Keep this ``frame`` and its score instead of the present one."""
        self.frame = frame
        self._score = score
