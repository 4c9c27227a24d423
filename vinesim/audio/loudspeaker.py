"""A robot's loudspeaker: plays queued sound frame by frame in real time."""

from __future__ import annotations

import collections
import threading
from collections.abc import Iterator

from vinesim.audio.frame import FRAME, FRAME_SAMPLES

MAX_QUEUED = 30.0
"""[s] Longest sound that can be queued; more is refused."""

PREPARATION = 0.06
"""[s] Playing begins when the queue holds this much sound or this time has passed, so that messages join without
gaps."""

_FRAME_BYTES = 2 * FRAME_SAMPLES


class Loudspeaker:
    """Splits PCM16 of any length into frames; the last frame is padded with silence. Safe for several threads."""

    def __init__(self) -> None:
        self.refused = 0
        """Number of bytes refused because the queue was full."""
        self._waiting: collections.deque[bytes] = collections.deque()
        self._rest = b""
        self._due: float | None = None
        """[s] Time at which the next frame begins; None while nothing is played."""
        self._waits_since: float | None = None
        """[s] Time at which :meth:`frames` first saw the queued sound; None while nothing waits to begin."""
        self._lock = threading.Lock()

    def play(self, pcm: bytes) -> None:
        """Append PCM16 to the queue. Sound that does not fit is refused and counted."""
        with self._lock:
            room = round(MAX_QUEUED / FRAME) * _FRAME_BYTES - len(self._waiting) * _FRAME_BYTES - len(self._rest)
            self.refused += max(len(pcm) - max(room, 0), 0)
            data = self._rest + pcm[: max(room, 0)]
            whole = len(data) - len(data) % _FRAME_BYTES
            self._waiting.extend(data[at : at + _FRAME_BYTES] for at in range(0, whole, _FRAME_BYTES))
            self._rest = data[whole:]

    def frames(self, now: float) -> Iterator[tuple[float, bytes]]:
        """Yields the frames played until ``now`` [s], each with the time [s] at which it began.

        The first frame of a sound begins one frame before ``now``.
        """
        with self._lock:
            if self._due is None and (self._waiting or self._rest):
                self._waits_since = now if self._waits_since is None else self._waits_since
                enough = len(self._waiting) * FRAME >= PREPARATION
                if not enough and 0.0 <= now - self._waits_since < PREPARATION:
                    return
                self._due = now - FRAME
                self._waits_since = None
            while self._due is not None and self._due + FRAME <= now + 1e-9:
                if self._waiting:
                    data = self._waiting.popleft()
                elif self._rest:
                    data = self._rest.ljust(_FRAME_BYTES, b"\0")
                    self._rest = b""
                else:
                    self._due = None
                    return
                began = self._due
                self._due = self._due + FRAME
                yield began, data
