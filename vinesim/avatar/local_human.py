"""A person whom this client moves: pose from a source, shears, update for other clients, haptic feedback."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Container

import numpy as np

from vinesim.avatar.haptics import HapticFeedback
from vinesim.avatar.shears import Closure, Shears
from vinesim.core import frames
from vinesim.rigid.human_shapes import SIDES
from vinesim.scene.values import INTENTIONS, POINT_NAMES, Haptic, HumanPose, HumanSpec, HumanUpdate
from vinesim.world import Physics

_HEAD = POINT_NAMES.index("head")
_HANDS = [POINT_NAMES.index(side) for side in SIDES]


class LocalHuman:
    """A person in the physics whose tracked points a source gives in every step."""

    def __init__(self, physics: Physics, spec: HumanSpec, source: Callable[[float], HumanPose]) -> None:
        """``source(time)`` gives the pose at the end of the coming step, which begins at simulation ``time`` [s]."""
        self.physics = physics
        self.name = spec.name
        self.source = source
        physics.add_human(spec)
        self.pose = spec.pose
        self.intention = ""
        """What the person indicates to do; see :meth:`indicate`."""
        self.haptics: tuple[Haptic, ...] = ()
        """Vibrations of the person's controllers after the last step."""
        self.closures: tuple[Closure, ...] = ()
        """How shears in the hands closed in the last step."""
        self._feedback = HapticFeedback(physics, spec.name)
        self._shears = tuple(Shears(physics, spec.name, side) for side in SIDES)
        self._sent_points = spec.pose.points
        self._busy_steps = physics.parameters.steps(physics.parameters.hand_contact_duration)
        """For how many steps a hand counts as busy after it pushed a robot or held something."""
        self._steps_since_busy = [self._busy_steps] * len(SIDES)
        self._hand_wrenches: dict[str, dict[str, np.ndarray]] = {}

    def indicate(self, intention: str) -> None:
        """Indicate what the person is about to do: one of :data:`INTENTIONS`, empty when it is done."""
        if intention not in INTENTIONS:
            raise ValueError(f"no intention {intention!r}; give one of {', '.join(INTENTIONS[1:])}, or nothing")
        self.intention = intention

    def control(self, time: float) -> None:
        """Before a step: move to where the source says."""
        self.pose = self.source(time)
        self.physics.move_human(self.name, self.pose)
        for shears in self._shears:
            shears.control(self.pose)

    def update(self, now: float) -> HumanUpdate:
        """After a step: pose and velocity for other clients; busy hands are where they are, not at their
        controllers."""
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
                before[_HANDS[i]] = points[_HANDS[i]]  # from the controller to the palm or back: no velocity
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

    def between_blades(self) -> tuple[str, ...]:
        """What the shears in the left and the right hand would cut now, in words: see :meth:`Shears.between`."""
        return tuple(
            shears.between() if getattr(self.pose, f"{side}_shears") else ""
            for shears, side in zip(self._shears, SIDES, strict=True)
        )

    def hand_wrenches_on(self, robots: Container[str]) -> dict[str, dict[str, np.ndarray]]:
        """Wrenches [6] of the hands on some ``robots`` in the last step, by robot and link; after :meth:`update`."""
        return {robot: links for robot, links in self._hand_wrenches.items() if robot in robots}

    def _is_busy(self, hand: int) -> bool:
        return self._steps_since_busy[hand] < self._busy_steps
