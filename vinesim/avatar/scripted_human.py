"""A person without a headset: walks, reaches and grasps by a script. For tests and demonstrations.

human = ScriptedHuman(root)
human.do(human.walk((2.0, 1.0)), human.reach("right", bunch), human.wait(1.0), human.withdraw("right"))
Client(..., description=None, source=human)
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from vinesim.avatar.gestures import finger_bend
from vinesim.avatar.leg_estimator import LegEstimator
from vinesim.core import frames
from vinesim.rigid.human_posture import standing_pose
from vinesim.scene.terrain import Terrain, ground_height
from vinesim.scene.values import HumanPose

WALK_SPEED = 1.1
"""[m/s] Speed of walking forwards. GUESSED."""
BACK_SPEED = 0.5
"""[m/s] Speed of walking backwards. GUESSED."""
TURN_RATE = 2.5
"""[rad/s] Rate of turning on the spot. GUESSED."""
REACH_SPEED = 0.5
"""[m/s] Speed of a hand that reaches for something. GUESSED."""


class ScriptedHuman:
    """A pose source for :class:`vinesim.avatar.local_human.LocalHuman` that follows a script of actions.

    It is called once a step and returns the pose at the end of the step.
    """

    def __init__(
        self, root: np.ndarray, height: float = 1.75, dt: float = 0.01, terrain: Terrain | None = None
    ) -> None:
        """``root`` [7]: pose at which the person stands; ``height``: of the person [m]; ``dt`` [s]: duration of a step;
        ``terrain``: uneven ground, on which the person walks."""
        self.dt = dt
        self._terrain = terrain
        self.root = np.asarray(root, float)
        self.pose = standing_pose(self.root, height)
        self.closed = {"left": False, "right": False}
        self._heading = frames.to_yaw(self.root[3:])
        self._place = self.root[:2].copy()
        self._above = float(self.root[2]) - float(ground_height(terrain, *self._place))
        """Height [m] of the body's origin above the ground."""
        here = frames.inverse(self._standing_frame())
        self._head = frames.compose(here, self.pose.head)
        self._rest = {"left": frames.compose(here, self.pose.left), "right": frames.compose(here, self.pose.right)}
        self._hands = {side: pose.copy() for side, pose in self._rest.items()}
        self._legs = LegEstimator(self.pose, dt, terrain)
        self._actions: deque[Iterator[None]] = deque()

    def do(self, *actions: Iterator[None]) -> ScriptedHuman:
        """Append actions to the script; they are done one after the other."""
        self._actions.extend(actions)
        return self

    def __call__(self, time: float) -> HumanPose:
        """Advance by one step; returns the pose at its end."""
        while self._actions and next(self._actions[0], self) is self:
            self._actions.popleft()
        stand = self._standing_frame()
        head = frames.compose(stand, self._head)
        hips, left_foot, right_foot = self._legs.update(head)
        left, right = (frames.compose(stand, self._hands[side]) for side in ("left", "right"))
        if self._terrain is not None:
            self.root = stand
        self.pose = HumanPose(
            self.root,
            head,
            left,
            right,
            hips,
            left_foot,
            right_foot,
            self.closed["left"],
            self.closed["right"],
            left_fingers=finger_bend(closed=self.closed["left"]),
            right_fingers=finger_bend(closed=self.closed["right"]),
        )
        return self.pose

    # ------------------------------------------------------------------ actions

    def walk(self, to: tuple[float, float]) -> Iterator[None]:
        """Turn to a point (x, y) [m] and walk there."""
        yield from self.face(to)
        while (left := float(np.linalg.norm(way := np.asarray(to, float) - self._place))) > 1e-6:
            self._place += way * min(1.0, WALK_SPEED * self.dt / left)
            yield

    def back(self, until: Callable[[], bool], most: float = 1.5) -> Iterator[None]:
        """Walk backwards until ``until()`` is true or the distance ``most`` [m] is covered."""
        for _ in range(round(most / (BACK_SPEED * self.dt))):
            if until():
                return
            ahead = np.array([np.cos(self._heading), np.sin(self._heading)])
            self._place -= BACK_SPEED * self.dt * ahead
            yield

    def face(self, to: tuple[float, float]) -> Iterator[None]:
        """Turn towards a point (x, y) [m]."""
        way = np.asarray(to, float)[:2] - self._place
        goal = float(np.arctan2(way[1], way[0])) if np.linalg.norm(way) > 1e-6 else self._heading
        while abs(off := (goal - self._heading + np.pi) % (2.0 * np.pi) - np.pi) > 1e-9:
            self._heading += float(np.clip(off, -TURN_RATE * self.dt, TURN_RATE * self.dt))
            yield

    def reach(self, side: str, point: Callable[[], np.ndarray], *, close: bool = True) -> Iterator[None]:
        """Move a palm to the world position ``point()`` [3] m, which is read in every step; then close the hand if
        ``close``."""
        while True:
            goal = np.asarray(point(), float)
            here = frames.compose(self._standing_frame(), self._hands[side])
            way = goal - here[:3]
            left = float(np.linalg.norm(way))
            at = here[:3] + way * min(1.0, REACH_SPEED * self.dt / max(left, 1e-9))
            shoulder = frames.compose(
                self._standing_frame(), frames.pose(np.array([0.0, 0.2 if side == "left" else -0.2, 1.4]))
            )
            turn = frames.from_x_axis(goal - shoulder[:3])
            self._hands[side] = frames.compose(frames.inverse(self._standing_frame()), frames.pose(at, turn))
            if left <= REACH_SPEED * self.dt:
                break
            yield
        self.closed[side] = close
        yield

    def withdraw(self, side: str, way: float = 1.0) -> Iterator[None]:
        """Move a hand back towards the pose in which it hangs down, by the share ``way`` of the distance (1: all the
        way)."""
        start = self._hands[side].copy()
        goal = self._rest[side]
        for tick in range(
            count := max(1, round(way * float(np.linalg.norm(goal[:3] - start[:3])) / (REACH_SPEED * self.dt)))
        ):
            share = way * (tick + 1) / count
            self._hands[side][:3] = start[:3] + share * (goal[:3] - start[:3])
            yield

    def release(self, side: str) -> Iterator[None]:
        """Open a hand."""
        self.closed[side] = False
        yield

    def wait(self, seconds: float) -> Iterator[None]:
        """Stand still for ``seconds`` [s]."""
        for _ in range(round(seconds / self.dt)):
            yield

    # ------------------------------------------------------------------ inside

    @property
    def place(self) -> np.ndarray:
        """Position (x, y) [2] m of the person."""
        return self._place.copy()

    def _standing_frame(self) -> np.ndarray:
        """Pose [7] of the body: on the ground, below the hips."""
        height = float(self.root[2])
        if self._terrain is not None:
            height = self._above + float(self._terrain.height(*self._place))
        return frames.pose(np.array([*self._place, height]), frames.from_yaw(self._heading))
