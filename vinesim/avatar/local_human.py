"""A person whom this client controls: pose from a source, shears, messages for other clients, haptic feedback."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Container

import numpy as np

from vinesim.core import frames
from vinesim.rigid.human_posture import SIDES
from vinesim.scene import appearance
from vinesim.scene.values import INTENTIONS, POINT_NAMES, Haptic, HumanPose, HumanSpec, HumanUpdate
from vinesim.world import Physics

_HEAD = POINT_NAMES.index("head")
_HANDS = [POINT_NAMES.index(side) for side in SIDES]


class LocalHuman:
    """A person in the physics whose head and hands follow a pose source in every step."""

    def __init__(self, physics: Physics, spec: HumanSpec, source: Callable[[float], HumanPose]) -> None:
        """``source(time)`` returns the pose at the end of the step that begins at simulation ``time`` [s]."""
        self.physics = physics
        self.name = spec.name
        self.height = spec.height
        """Height of the person [m]."""
        self.source = source
        physics.add_human(spec)
        self.pose = spec.pose
        self.intention = ""
        """The current intention; see :meth:`indicate`."""
        self.haptics: tuple[Haptic, ...] = ()
        """Vibrations of the person's controllers after the last step."""
        self.closures: tuple[Closure, ...] = ()
        """Results of shears that closed in the last step."""
        self._feedback = HapticFeedback(physics, spec.name)
        self._shears = tuple(Shears(physics, spec.name, side) for side in SIDES)
        self._sent_points = spec.pose.points
        self._busy_steps = physics.parameters.steps(physics.parameters.hand_contact_duration)
        """Number of steps for which a hand counts as busy after it pushed a robot or held something."""
        self._steps_since_busy = [self._busy_steps] * len(SIDES)
        self._hand_wrenches: dict[str, dict[str, np.ndarray]] = {}

    def indicate(self, intention: str) -> None:
        """Indicate what the person is about to do: one of :data:`INTENTIONS`, empty when it is done."""
        if intention not in INTENTIONS:
            raise ValueError(f"no intention {intention!r}; give one of {', '.join(INTENTIONS[1:])}, or nothing")
        self.intention = intention

    def control(self, time: float) -> None:
        """Before a step: move the person to the pose from the source."""
        self.pose = self.source(time)
        self.physics.move_human(self.name, self.pose)
        for shears in self._shears:
            shears.control(self.pose)

    def update(self, now: float) -> HumanUpdate:
        """After a step: return the person's pose and velocity for other clients.

        Busy hands are sent at their simulated poses, free hands at the poses of their controllers.
        """
        self.closures = tuple(closure for shears in self._shears if (closure := shears.closure()) is not None)
        self.haptics = (*self._feedback.update(), *(closure.haptic(self.name) for closure in self.closures))
        self._hand_wrenches, pushing = self.physics.rigid.hand_wrenches(self.name)
        points = self.pose.points
        before = self._sent_points
        for i, side in enumerate(SIDES):
            hand = self.physics.hand(self.name, side)
            was_busy = self._is_busy(i)
            self._steps_since_busy[i] = 0 if pushing[i] or hand.held is not None else self._steps_since_busy[i] + 1
            if self._is_busy(i):
                points[_HANDS[i]] = hand.pose
            if was_busy != self._is_busy(i):
                # switching between controller and simulated hand must not count as motion
                before[_HANDS[i]] = points[_HANDS[i]]
        way = points[:, :3] - before[:, :3]
        turn = frames.log(frames.multiply(points[:, 3:], frames.conjugate(before[:, 3:])))
        velocity = np.concatenate([way, turn], 1) / self.physics.dt
        if np.linalg.norm(way[_HEAD]) > self.physics.parameters.teleport_distance:
            velocity[:] = 0.0
        self._sent_points = points
        pose = dataclasses.replace(
            self.pose.with_points(points), left_busy=self._is_busy(0), right_busy=self._is_busy(1)
        )
        return HumanUpdate(self.name, now, pose, velocity, self.intention)

    def work(self, what: str, side: str = "right") -> str:
        """Work on the plant next to a hand, between steps: ``what`` is one of
        :data:`vinesim.interaction.handwork.PLANT_WORK`. Returns what was done, or why nothing was, as a sentence."""
        palm = self.physics.hand(self.name, side).pose[:3]
        try:
            return f"The {side} hand {self.physics.handwork.work_at(what, palm, self.name)}."
        except ValueError as error:
            return f"The {side} hand does nothing: {error}."

    def between_blades(self) -> tuple[str, ...]:
        """Returns what the shears in the left and in the right hand would cut now, see :meth:`Shears.between`; "" for a
        hand without shears."""
        return tuple(
            shears.between() if getattr(self.pose, f"{side}_shears") else ""
            for shears, side in zip(self._shears, SIDES, strict=True)
        )

    def hand_wrenches_on(self, robots: Container[str]) -> dict[str, dict[str, np.ndarray]]:
        """Returns the wrenches [6] of the hands on ``robots`` in the last step, by robot and link. Call it after
        :meth:`update`."""
        return {robot: links for robot, links in self._hand_wrenches.items() if robot in robots}

    def _is_busy(self, hand: int) -> bool:
        return self._steps_since_busy[hand] < self._busy_steps


# Haptic feedback: vibrations for a person's controllers from the forces of the hands.


class HapticFeedback:
    """Vibrations of one person's controllers: a pulse when a contact begins, then vibration in proportion to force."""

    def __init__(self, physics: Physics, name: str) -> None:
        """``name``: name of a person in ``physics``."""
        self.physics = physics
        self.name = name
        self._period = physics.parameters.steps(physics.parameters.haptic_period)
        self._contact_steps: dict[str, int] = {}
        """Number of steps since the contact of each hand began, by side."""

    def update(self) -> tuple[Haptic, ...]:
        """Returns the vibrations of the last step, left hand first; call it once after each step."""
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


# Shears in a person's hand: when the hand closes, the blades close and cut the wood between them.


CUT_PULSE = (1.0, 0.1)
MISS_PULSE = (0.3, 0.03)
"""Amplitude [1] and duration [s] of the vibration when shears have cut nothing; ``CUT_PULSE`` is for a cut. GUESSED."""


@dataclasses.dataclass(frozen=True)
class Closure:
    """Result of one closing of shears."""

    side: str
    """Side of the hand that holds the shears."""
    bunches: int
    canes: int
    resistance: float
    """[N] Force needed to cut the strongest wood between the blades, whether it was cut or not; 0 without wood."""
    force: float
    """[N] Largest force that the blades can apply."""
    outcome: str = ""
    """What came of it, as :attr:`vinesim.interaction.blades.Blade.outcome`."""
    is_blocked: bool = False
    """Whether something between the blades cannot be cut: a wire, a post, old wood, or wood thicker than the mouth."""

    @property
    def has_cut(self) -> bool:
        """Whether anything was cut."""
        return self.bunches + self.canes > 0

    @property
    def sentence(self) -> str:
        """Message for the user."""
        shears = f"The shears in the {self.side} hand"
        if self.has_cut:
            pieces = (("bunch", "bunches", self.bunches), ("cane", "canes", self.canes))
            cut = [f"{count} {one if count == 1 else several}" for one, several, count in pieces if count]
            return f"{shears} cut {' and '.join(cut)}."
        if self.is_blocked:
            return f"{shears}: the blade {self.outcome}."
        if self.resistance > self.force:
            takes = f"{self.resistance:,.0f} N"
            gives = f"{self.force:,.0f} N"
            depth = self.outcome.partition("they cut ")[2]
            cut = f" They cut {depth}." if depth else ""
            return f"{shears} are too weak: this wood takes {takes}, they close with {gives}.{cut}"
        if self.resistance > 0.0:
            return f"{shears} cut nothing: the bunch of this peduncle was picked before."
        return f"{shears} missed: there was no wood between the blades."

    def haptic(self, actor: str) -> Haptic:
        """Returns the vibration that tells the person about the closing."""
        return Haptic(actor, self.side, True, *(CUT_PULSE if self.has_cut else MISS_PULSE))


class Shears:
    """Shears that one hand can hold: a blade in the physics that closes only while the hand holds the shears."""

    def __init__(self, physics: Physics, name: str, side: str) -> None:
        """``name``: name of a person in ``physics``; ``side``: side of the hand."""
        model = appearance.load_shears()
        self.side = side
        self._monitor = physics.detachment_monitor
        self._force = model.force
        self._blade = physics.add_blade(
            name,
            f"{side}_hand",
            model.mouth,
            model.mouth_half,
            force=model.force,
            speed=model.speed,
            kind=model.blade,
        )
        self._closures = 0
        self._was_closed = False

    def control(self, pose: HumanPose) -> None:
        """Before a step: close the blades if the hand is closed in ``pose`` and was open before, and open them with the
        hand."""
        is_closed = bool(getattr(pose, f"{self.side}_closed"))
        has_shears = bool(getattr(pose, f"{self.side}_shears"))
        if is_closed and not self._was_closed and has_shears:
            self._blade.close()
        elif not (is_closed and has_shears):
            self._blade.open()
        self._was_closed = is_closed

    def between(self) -> str:
        """After a step: return what the blades would cut if they closed now, "bunch" or "cane".

        "strong wood" if all wood between the blades is too strong for them; "" if nothing is between them.
        """
        wood = self._monitor.wood_in_mouth(self._blade)
        weak = [bunch for body, bunch in wood if self._monitor.cutting_force(body) <= self._force]
        if not weak:
            return "strong wood" if wood else ""
        return "bunch" if max(weak) >= 0 else "cane"

    def closure(self) -> Closure | None:
        """After a step: return the result if a closing of the blades ended in this step, otherwise None."""
        blade = self._blade
        if blade.closures == self._closures:
            return None
        self._closures = blade.closures
        bunches = sum(one.bunch >= 0 for one in blade.detachments)
        return Closure(
            self.side,
            bunches,
            len(blade.detachments) - bunches,
            blade.resistance,
            self._force,
            blade.outcome,
            blade.outcome.startswith("is blocked"),
        )
