"""Haptic feedback: vibrations for a person's controllers from the forces of the hands."""

from __future__ import annotations

import numpy as np

from vinesim.scene.values import Haptic
from vinesim.world import Physics


class HapticFeedback:
    """Vibrations of one person's controllers: a pulse when a contact begins, then as strong as the force."""

    def __init__(self, physics: Physics, name: str) -> None:
        """``name`` of a person in ``physics``."""
        self.physics = physics
        self.name = name
        self._period = physics.parameters.steps(physics.parameters.haptic_period)
        self._contact_steps: dict[str, int] = {}
        """By side: steps since the contact began."""

    def update(self) -> tuple[Haptic, ...]:
        """The vibrations of the last step, left hand first; call it once after each step."""
        p = self.physics.parameters
        found = []
        for hand in self.physics.rigid.human(self.name).hands:
            if hand.steps_since_contact > 0:
                if hand.steps_since_contact >= self._period:
                    self._contact_steps.pop(hand.side, None)
                continue
            since = self._contact_steps[hand.side] = self._contact_steps.get(hand.side, -1) + 1
            amplitude = min(1.0, float(np.linalg.norm(hand.force)) / hand.max_force)
            duration = self._period * self.physics.dt
            if since == 0:
                onset = max(p.haptic_onset_amplitude, amplitude)
                found.append(Haptic(self.name, hand.side, True, onset, duration))
            elif since % self._period == 0 and amplitude > p.haptic_min_amplitude:
                found.append(Haptic(self.name, hand.side, False, amplitude, duration))
        return tuple(found)
