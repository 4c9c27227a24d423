"""Records for tests what an actor of a client hears. It runs in the client's own process and works like a robot's
microphone."""

from __future__ import annotations

import numpy as np

from vinesim.audio.microphone import Block, Microphone
from vinesim.client.client import Client
from vinesim.client.sound.exchange import SoundStep
from vinesim.client.sound.microphone_step import at_place


class SoundRecorder:
    """Listens to sounds for an actor of a client."""

    is_open = True

    def __init__(self, client: Client, name: str, *, decodes_opus: bool = True) -> None:
        self._client = client
        self._name = name
        self.decodes_opus = decodes_opus
        self.microphone = Microphone()
        self.blocks: list[Block] = []
        """Blocks recorded since the last :meth:`take`."""
        client.sound.listen(name, self)

    def hear(self, step: SoundStep) -> None:
        """Mix the sounds of one step into the recording."""
        here = at_place(step, self._client.sound.place_of(self._name))
        for frame in here.frames:
            self.microphone.hear(frame)
        for tone in here.tones:
            self.microphone.sound(*tone, here.now)
        self.blocks += self.microphone.blocks(here.now)

    def take(self) -> np.ndarray:
        """Returns the samples [n] recorded since the last call."""
        blocks = self.blocks
        self.blocks = []
        return np.concatenate([block.samples for block in blocks])
