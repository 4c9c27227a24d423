"""Shears in a hand of a person: when the hand closes, their blades close and cut the wood between them."""

from __future__ import annotations

import dataclasses

from vinesim.scene import appearance
from vinesim.scene.values import Haptic, HumanPose
from vinesim.world import Physics

CUT_PULSE = (1.0, 0.1)
MISS_PULSE = (0.3, 0.03)
"""Amplitude [1] and duration [s] of the vibration when shears have cut something, and when they have not. GUESSED."""


@dataclasses.dataclass(frozen=True)
class Closure:
    """How shears closed: what they cut."""

    side: str
    """Of the hand that holds them."""
    bunches: int
    canes: int
    resistance: float
    """[N] Cutting force of the strongest wood between the blades, cut or not; 0 if there was none."""
    force: float
    """[N] Largest force of the blades."""

    @property
    def has_cut(self) -> bool:
        """Whether anything was cut."""
        return self.bunches + self.canes > 0

    @property
    def sentence(self) -> str:
        """What a user is told."""
        shears = f"The shears in the {self.side} hand"
        if self.has_cut:
            pieces = (("bunch", "bunches", self.bunches), ("cane", "canes", self.canes))
            cut = [f"{count} {one if count == 1 else several}" for one, several, count in pieces if count]
            return f"{shears} cut {' and '.join(cut)}."
        if self.resistance > self.force:
            takes = f"{self.resistance:,.0f} N"
            gives = f"{self.force:,.0f} N"
            return f"{shears} are too weak: this wood takes {takes}, they close with {gives}."
        if self.resistance > 0.0:
            return f"{shears} cut nothing: the bunch of this peduncle was picked before."
        return f"{shears} missed: there was no wood between the blades."

    def haptic(self, actor: str) -> Haptic:
        """The vibration by which the person feels it."""
        return Haptic(actor, self.side, True, *(CUT_PULSE if self.has_cut else MISS_PULSE))


class Shears:
    """The shears that one hand can take: a blade in the physics, which closes only while the hand has them."""

    def __init__(self, physics: Physics, name: str, side: str) -> None:
        """``name`` of a person in ``physics``, ``side`` of the hand."""
        model = appearance.load_shears()
        self.side = side
        self._monitor = physics.detachment_monitor
        self._force = model.force
        self._blade = physics.add_blade(name, f"{side}_hand", model.mouth, model.mouth_half)
        self._closures = 0
        self._was_closed = False

    def control(self, pose: HumanPose) -> None:
        """Before a step: close the blades if the hand closes in this ``pose``, and did not before."""
        is_closed = bool(getattr(pose, f"{self.side}_closed"))
        if is_closed and not self._was_closed and getattr(pose, f"{self.side}_shears"):
            self._blade.close(self._force)
        self._was_closed = is_closed

    def between(self) -> str:
        """After a step: what the blades would cut if they closed now, "bunch" or "cane"; "strong wood" if all that is
        there is too strong for them; "" if nothing is there."""
        wood = self._monitor.wood_in_mouth(self._blade)
        weak = [bunch for body, bunch in wood if self._monitor.cutting_force(body) <= self._force]
        if not weak:
            return "strong wood" if wood else ""
        return "bunch" if max(weak) >= 0 else "cane"

    def closure(self) -> Closure | None:
        """After a step: how the blades closed in it; None if they did not."""
        blade = self._blade
        if blade.closures == self._closures:
            return None
        self._closures = blade.closures
        bunches = sum(one.bunch >= 0 for one in blade.detachments)
        return Closure(self.side, bunches, len(blade.detachments) - bunches, blade.resistance, self._force)
