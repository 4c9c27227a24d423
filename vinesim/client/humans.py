"""People in a client's world: one whom this client moves, and the copies of those whom other clients move."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Container

import numpy as np

from vinesim import frames
from vinesim.net.codec.messages import Hello
from vinesim.physics.rigid.human_body import JUMP, LINGER, SIDES
from vinesim.physics.rigid.rigid_world import RigidWorld
from vinesim.physics.step import Physics
from vinesim.scene.values import POINT_NAMES, HumanPose, HumanSpec, HumanUpdate

_HEAD, _HANDS = POINT_NAMES.index("head"), [POINT_NAMES.index(side) for side in SIDES]


class LocalHuman:
    """A person whom this client moves: somebody tells every tick where the tracked points are."""

    def __init__(self, physics: Physics, spec: HumanSpec, source: Callable[[float], HumanPose]) -> None:
        """``source(time)`` gives the pose at the end of the coming tick, which begins at simulation ``time`` [s]."""
        self.physics, self.name, self.source = physics, spec.name, source
        physics.add_human(spec)
        self.pose = spec.pose
        self._told = spec.pose.points
        self._free = [LINGER] * len(SIDES)
        """[hand, tick] since it pushed a robot or held something."""
        self._given: dict[str, dict[str, np.ndarray]] = {}

    def control(self, time: float) -> None:
        """Go where the source says."""
        self.pose = self.source(time)
        self.physics.move_human(self.name, self.pose)

    def update(self, now: float) -> HumanUpdate:
        """What other clients are told: where everything is, hands that are held back included, and how fast."""
        self._given, giving = self.physics.rigid.hand_wrenches(self.name)
        points, before = self.pose.points, self._told
        for i, side in enumerate(SIDES):
            hand = self.physics.hand(self.name, side)
            was = self._free[i] < LINGER
            self._free[i] = 0 if giving[i] or hand.held is not None else self._free[i] + 1
            if self._free[i] < LINGER:
                points[_HANDS[i]] = hand.pose
            if was != (self._free[i] < LINGER):
                before[_HANDS[i]] = points[_HANDS[i]]  # from the controller to the palm or back: no speed
        way = points[:, :3] - before[:, :3]
        turn = frames.log(frames.multiply(points[:, 3:], frames.conjugate(before[:, 3:])))
        velocity = np.concatenate([way, turn], 1) / self.physics.dt
        if np.linalg.norm(way[_HEAD]) > JUMP:  # set down elsewhere
            velocity[:] = 0.0
        self._told = points
        left, right = (free < LINGER for free in self._free)
        pose = dataclasses.replace(self.pose.with_points(points), left_busy=left, right_busy=right)
        return HumanUpdate(self.name, now, pose, velocity)

    def pushed(self, robots: Container[str]) -> dict[str, dict[str, np.ndarray]]:
        """What the hands did to some ``robots`` in the last tick: robot, link, wrench [6]; after :meth:`update`."""
        return {robot: links for robot, links in self._given.items() if robot in robots}


class RemoteHuman:
    """The copy of a person whom another client moves: bit for bit where that client says; the hands push what lies."""

    def __init__(self, rigid: RigidWorld, name: str) -> None:
        """``name`` is here already; see :func:`spec_of`."""
        self.rigid, self.name = rigid, name

    def follow(self, update: HumanUpdate) -> None:
        """Be where ``update`` says at the end of the coming tick."""
        self.rigid.move_human(self.name, update.pose)

    def remove(self) -> None:
        """Go."""
        self.rigid.remove_human(self.name)


def spec_of(hello: Hello, update: HumanUpdate) -> HumanSpec:
    """A person as physics needs one, from what another client tells."""
    return HumanSpec(hello.name, hello.index, update.pose, hello.height)
