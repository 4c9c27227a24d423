"""A recording for pages: it plays, pauses and seeks on request of a page's timeline."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from vinesim.client.page.page_world import PageWorld
from vinesim.client.recording.replay import ReplayBus
from vinesim.client.spectator import Spectator
from vinesim.web.page_input import ReplayCommand
from vinesim.web.page_server import PageServer

LEAD = 1.0
"""Time before a requested position at which playback begins [s], so that actors and clocks are known at the
position."""
REPEAT = 50
"""Number of steps between two states that are sent while playback is paused, for pages that connect meanwhile."""


class PageReplay:
    """A recording that pages (browser tabs) play: a spectator in the recorded world. One loop calls :meth:`step`; pages
    call from the server's thread."""

    def __init__(
        self,
        make: Callable[[float, np.ndarray | None], tuple[Spectator, ReplayBus]],
        length: float,
        start: float = 0.0,
        speed: float = 1.0,
    ) -> None:
        """``make(start, eyes)`` returns a spectator at a time [s] of the recording, which is ``length`` [s] long.

        The spectator looks from ``eyes`` [7]; None: from its default start position.
        """
        self._make = make
        self._length = length
        self._lock = threading.Lock()
        self._command: ReplayCommand | None = None
        self._speed = speed
        self.is_paused = False
        self._jumps = self._idle_steps = 0
        self._has_begun = False
        self._spectator, self._bus = make(start, None)
        self.world = PageWorld(self._spectator, replay=self)

    @property
    def dt(self) -> float:
        """Length of a step [s]."""
        return self._spectator.physics.dt

    @property
    def position(self) -> float:
        """Time since the beginning of the recording [s]."""
        return self._bus.time - self._bus.start

    def status(self) -> dict[str, float | bool]:
        """Status that pages receive with every state."""
        return {
            "position": round(self.position, 3),
            "length": round(self._length, 3),
            "speed": self._speed,
            "paused": self.is_paused,
            "jumps": self._jumps,
        }

    def take(self, command: ReplayCommand) -> None:
        """Set the command of a page for the next step. It replaces commands since the last step. Safe from any
        thread."""
        with self._lock:
            before = None if self._command is None else self._command.seek
            seek = before if command.seek is None else command.seek
            self._command = ReplayCommand(command.paused, command.speed, seek)

    def step(self, server: PageServer) -> bool:
        """Execute the last command, and play one step if a page has connected. Returns whether the recording is
        playing."""
        self._has_begun |= server.has_viewers
        with self._lock:
            command = self._command
            self._command = None
        was_paused = self.is_paused
        if command is not None:
            self._obey(command)
        self.is_paused |= self._bus.ended
        if self._has_begun and not self.is_paused:
            self._play(self._speed)
            self.world.collect(server)
            return True
        self._idle_steps += 1
        if command is not None or not was_paused or self._idle_steps % REPEAT == 0:
            self.world.collect(server, again=True)
        return False

    def _obey(self, command: ReplayCommand) -> None:
        goal = command.seek
        if goal is None and self._bus.ended and not command.paused:
            goal = 0.0  # at the end of the recording: restart from the beginning
        self._speed = command.speed
        self.is_paused = command.paused
        if goal is None:
            return
        self._spectator, self._bus = self._make(max(min(goal, self._length) - LEAD, 0.0), self._spectator.pose)
        self._jumps += 1
        self._play(1.0)
        while self.position < goal and not self._bus.ended:
            self._play(1.0)
        self.world.show(self._spectator)

    def _play(self, speed: float) -> None:
        self._bus.play(self.dt * speed)
        self._spectator.tick()
