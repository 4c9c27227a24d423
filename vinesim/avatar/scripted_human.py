"""A person without a headset: walks, reaches and grabs as a script says. For tests, and to show what people can do.

    walker = Walker(root)
    walker.do(walker.walk((2.0, 1.0)), walker.reach("right", bunch), walker.wait(1.0), walker.withdraw("right"))
    Client(..., description=None, source=walker)

A headset and two controllers say nothing of hips and feet either: :class:`Legs` makes them up.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from vinesim import frames
from vinesim.physics.rigid.human_body import standing_pose
from vinesim.scene.values import HumanPose

WALK = 1.1
"""[m/s]"""
TURN = 2.5
"""[rad/s]"""
REACH = 0.5
"""[m/s] of a hand that reaches for something."""
STEP = 0.28
"""[m] A foot that is so far from its place under the hips steps there."""
SWING = 0.35
"""[s] that a step takes."""
LIFT = 0.08
"""[m] how high a foot is lifted."""


class Legs:
    """Hips and feet that nobody tracks: the hips are below the head, and a foot steps when it is left behind.

    Where the feet are depends on where they were: two who watch the same head do not make up the same legs.
    """

    def __init__(self, pose: HumanPose, dt: float = 0.01) -> None:
        self.dt = dt
        self._below = frames.compose(
            frames.inverse(_upright(pose.head)), np.stack([pose.hips, pose.left_foot, pose.right_foot])
        )
        self._feet = np.stack([pose.left_foot, pose.right_foot]).astype(float)
        self._start = self._feet.copy()
        self._swing = [1.0, 1.0]
        """[foot] share of its step that is done."""
        self._head = np.asarray(pose.head[:3], float).copy()

    def under(self, head: np.ndarray) -> np.ndarray:
        """Hips and both feet [3, 7] a tick later, with the head at ``head`` [7]."""
        there = frames.compose(_upright(head), self._below)
        ahead = (head[:3] - self._head) / self.dt * SWING
        self._head = np.asarray(head[:3], float).copy()
        ahead[2] = 0.0
        ahead *= min(1.0, 1.5 * STEP / max(float(np.linalg.norm(ahead)), 1e-9))
        far = [float(np.linalg.norm(self._feet[foot, :2] - there[1 + foot, :2])) for foot in (0, 1)]
        foot = int(far[1] > far[0])
        if min(self._swing) >= 1.0 and far[foot] > STEP:
            self._start[foot], self._swing[foot] = self._feet[foot], 0.0
        for foot in (0, 1):
            if self._swing[foot] < 1.0:
                share = self._swing[foot] = min(1.0, self._swing[foot] + self.dt / SWING)
                goal = there[1 + foot, :3] + (1.5 - share) * ahead
                gone = share * share * (3.0 - 2.0 * share)  # off the ground and onto it without a jolt
                self._feet[foot, :3] = self._start[foot, :3] + gone * (goal - self._start[foot, :3])
                self._feet[foot, 2] = there[1 + foot, 2] + LIFT * np.sin(np.pi * share)
                self._feet[foot, 3:] = there[1 + foot, 3:]
        return np.stack([there[0], *self._feet])


class ScriptedHuman:
    """Called once a tick, it says where the tracked points are at the tick's end: a source for a client's person."""

    def __init__(self, root: np.ndarray, height: float = 1.75, dt: float = 0.01) -> None:
        self.dt = dt
        self.root = np.asarray(root, float)
        self.pose = standing_pose(self.root, height)
        self.closed = {"left": False, "right": False}
        self._heading = frames.to_yaw(self.root[3:])
        self._place = self.root[:2].copy()
        here = frames.inverse(self._stand())
        self._head = frames.compose(here, self.pose.head)
        self._rest = {"left": frames.compose(here, self.pose.left), "right": frames.compose(here, self.pose.right)}
        self._hands = {side: pose.copy() for side, pose in self._rest.items()}
        self._legs = Legs(self.pose, dt)
        self._acts: deque[Iterator[None]] = deque()

    def do(self, *acts: Iterator[None]) -> ScriptedHuman:
        """Do some acts, one after the other, after whatever is being done."""
        self._acts.extend(acts)
        return self

    def __call__(self, time: float) -> HumanPose:
        """The pose a tick later."""
        while self._acts and next(self._acts[0], self) is self:
            self._acts.popleft()
        stand = self._stand()
        head = frames.compose(stand, self._head)
        hips, left_foot, right_foot = self._legs.under(head)
        left, right = (frames.compose(stand, self._hands[side]) for side in ("left", "right"))
        fists = {f"{side}_fingers": (float(self.closed[side]),) * 5 for side in self.closed}
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
            **fists,
        )
        return self.pose

    # ------------------------------------------------------------------ acts

    def walk(self, to: tuple[float, float]) -> Iterator[None]:
        """Turn to a place and walk there."""
        yield from self.face(to)
        while (left := float(np.linalg.norm(way := np.asarray(to, float) - self._place))) > 1e-6:
            self._place += way * min(1.0, WALK * self.dt / left)
            yield

    def face(self, to: tuple[float, float]) -> Iterator[None]:
        """Turn to a place."""
        way = np.asarray(to, float)[:2] - self._place
        goal = float(np.arctan2(way[1], way[0])) if np.linalg.norm(way) > 1e-6 else self._heading
        while abs(off := (goal - self._heading + np.pi) % (2.0 * np.pi) - np.pi) > 1e-9:
            self._heading += float(np.clip(off, -TURN * self.dt, TURN * self.dt))
            yield

    def reach(self, side: str, point: Callable[[], np.ndarray], *, close: bool = True) -> Iterator[None]:
        """Put a palm to a point [3] in the world, wherever it goes meanwhile, and close the hand there."""
        while True:
            goal = np.asarray(point(), float)
            here = frames.compose(self._stand(), self._hands[side])
            way = goal - here[:3]
            left = float(np.linalg.norm(way))
            at = here[:3] + way * min(1.0, REACH * self.dt / max(left, 1e-9))
            shoulder = frames.compose(self._stand(), frames.pose(np.array([0.0, 0.2 if side == "left" else -0.2, 1.4])))
            turn = frames.from_x_axis(goal - shoulder[:3])
            self._hands[side] = frames.compose(frames.inverse(self._stand()), frames.pose(at, turn))
            if left <= REACH * self.dt:
                break
            yield
        self.closed[side] = close
        yield

    def withdraw(self, side: str, way: float = 1.0) -> Iterator[None]:
        """Move a hand back to where it rests, or a share of the ``way`` there."""
        start, goal = self._hands[side].copy(), self._rest[side]
        for tick in range(
            count := max(1, round(way * float(np.linalg.norm(goal[:3] - start[:3])) / (REACH * self.dt)))
        ):
            share = way * (tick + 1) / count
            self._hands[side][:3] = start[:3] + share * (goal[:3] - start[:3])
            yield

    def release(self, side: str) -> Iterator[None]:
        """Open a hand."""
        self.closed[side] = False
        yield

    def wait(self, seconds: float) -> Iterator[None]:
        """Stand."""
        for _ in range(round(seconds / self.dt)):
            yield

    # ------------------------------------------------------------------ inside

    def _stand(self) -> np.ndarray:
        """Where the body is [7]: on the floor, below the hips."""
        return frames.pose(np.array([*self._place, self.root[2]]), frames.from_yaw(self._heading))


def _upright(head: np.ndarray) -> np.ndarray:
    """A head [7] that looks ahead and not up or down."""
    return frames.pose(head[:3], frames.from_yaw(frames.to_yaw(head[3:])))
