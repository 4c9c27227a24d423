"""Picks a bunch that the robot has only seen: no pose of a plant is read from the simulation.

The robot knows its own joints and base, the forces in its fingers and blades, the place of the crate, and what its
camera shows. If the blades miss the stalk, the hand tries a little higher and lower.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.pick import OPENING_MARGIN, STALK_FORCE, PickBunch, PickPlan
from vinesim.robot.tasks.sight import Eyes, SeenBunch
from vinesim.robot.tasks.task import Task, TaskFailed
from vinesim.scene.values import CameraMount
from vinesim.world import Physics

OFFSETS = ((0.014, 0.004), (0.036, 0.016), (0.014, -0.008), (0.036, 0.032))
"""[m] Places of the hand that are tried one after the other: ahead of the estimated axis of the bunch, and above the
usual place. The hand goes a little too far, since it pushes the bunch away. TUNED on seed 0 of scene demo"""
HELD_FORCE = 1.0
"""[N] Contact force on each finger below which the hand has lost what it held. GUESSED"""
LOST_STEPS = 20
"""Number of steps with less than :data:`HELD_FORCE` after which the bunch counts as lost."""
SAME_BUNCH = 0.10
"""[m] Horizontal distance between two sights of the same bunch."""
HELD_POINTS = 30
"""Number of coarse points of fruit in the hand from which on the camera shows that the hand holds a bunch. TUNED"""
POINTED = 0.06
"""[rad] Angle within which the camera points at what it is to look at. GUESSED"""
LIFT_MARGIN = 0.02
"""[m] Distance of the lift from its upper end while the robot looks."""
HELD_REACH = 0.09
"""[m] Horizontal distance from the hand within which points count as in it."""
LOOK_TIME = 3.0
"""[s] Time in which the head turns to what it is to look at."""
GRASP_FORCE = 25.0
"""[N] Force of each finger. By sight the fingers are some millimetres off the middle of a bunch: with 15 N, which
suffices where the middle is known, every third bunch slipped out of them."""


def look(task: Task, *, use_lift: bool = True) -> Iterator[str]:
    """Wait until the head camera points at the focus of a task, at most :data:`LOOK_TIME`. Yields the phase ``"look"``,
    once per step. The head is turned by :class:`vinesim.client.tasks.motions.LookAt`.

    ``use_lift``: raise the lift, as bunches hang high.
    """
    robot = task.robot
    torso = robot.description.groups.get("torso")
    lifts = robot.joint_indices(torso.joints) if torso is not None and use_lift else np.zeros(0, int)
    robot.command_position(robot.upper_limit[lifts] - LIFT_MARGIN, lifts)
    frame = robot.description.sensors_of(CameraMount.kind)[0].frame
    start = task.time
    while task.time - start < LOOK_TIME:
        yield "look"
        pose = robot.frame_pose(frame)
        axis = frames.rotate(pose[3:], np.array([0.0, 0.0, 1.0]))
        below = robot.setpoint[lifts] - robot.rigid.joint_state(robot.name)[0][lifts]
        if np.abs(below).max(initial=0.0) < 0.01 and axis @ frames.normalize(task.focus() - pose[:3]) > np.cos(POINTED):
            return


class PickSeenBunch(PickBunch):
    """Moves a bunch that was seen into a box. ``seen`` is the newest estimate."""

    grasp_force = GRASP_FORCE

    def __init__(
        self, physics: Physics, robot: Robot, plan: PickPlan, seen: SeenBunch, eyes: Eyes, *, timeout: float = 110.0
    ) -> None:
        """``plan``: its bunch is the number that the robot gave to the bunch. ``eyes``: called when the head looks at
        the bunch."""
        self.seen = seen
        self._eyes = eyes
        self._offset = np.zeros(3)
        self._cut_force = 0.0
        self._steps_without_force = 0
        self._gaze: np.ndarray | None = None
        self.points_in_hand = 0
        """Number of coarse points of fruit in the hand after the cut."""
        self.was_in_hand = False
        """Whether the camera has shown the bunch in the hand after the cut."""
        super().__init__(physics, robot, plan, timeout=timeout)

    def _size(self) -> tuple[float, float]:
        return self.seen.length, self.seen.radius

    @property
    def mass(self) -> float:
        """Mass of the bunch [kg]; not known."""
        return float("nan")

    @property
    def is_cut(self) -> bool:
        """Whether the blades have cut something."""
        return self._cut_force > 0.0

    @property
    def bunch_pose(self) -> np.ndarray:
        """Pose [7] of the bunch as it was seen, or as it hangs in the hand once it is cut."""
        down = frames.from_x_axis(np.array([0.0, 0.0, -1.0]))
        if self.is_cut:
            return frames.pose(self.arm.tip_position + np.array([0.0, 0.0, self._grasp_depth]), down)
        return frames.pose(self.seen.top + self._offset, down)

    @property
    def in_box(self) -> bool:
        """Whether the camera showed the bunch in the hand before, and the fingers held it until the release."""
        return self.was_in_hand

    def focus(self) -> np.ndarray:
        """Returns the point [3] m in the world at which the head camera is to look."""
        return self.seen.centre if self._gaze is None else self._gaze

    def report(self) -> dict[str, Any]:
        """As :meth:`PickBunch.report`; the place of the bunch as it was seen, instead of its mass."""
        return super().report() | {"bunch_kg": None, "seen_at": [round(float(x), 3) for x in self.seen.top]}

    # ------------------------------------------------------------------ the task

    def run(self) -> Iterator[str]:
        """The task: look, reach, grasp and cut, look whether the bunch is in the hand, and put it into the box."""
        ahead = frames.rotate(self._base_pose()[3:], np.array([1.0, 0.0, 0.0]))
        yield from self._look_closely()
        self.arm.reset()
        yield from self._reach_and_cut(ahead)
        yield from self._draw_back(ahead)
        yield from self._see_hand()
        yield from self._carry()

    def _look_closely(self) -> Iterator[str]:
        """Look at the bunch from the place of the pick, and correct where it is. If leaves hide it from there, the
        place where it was seen before remains."""
        self.robot.command_gripper(self.arm.gripper, 2.0 * (self._radius + OPENING_MARGIN))
        yield from look(self)
        near = [
            one
            for one in self._eyes().bunches
            if np.linalg.norm((one.top - self.seen.top)[:2]) < SAME_BUNCH
            and abs(one.centre[2] - self.seen.centre[2]) < SAME_BUNCH
        ]
        if near:
            self.seen = min(near, key=lambda one: float(np.linalg.norm((one.top - self.seen.top)[:2])))
            self._measure()

    def _reach_and_cut(self, ahead: np.ndarray) -> Iterator[str]:
        """As in :class:`PickBunch`, at several places of the hand until the blades meet a stalk."""
        reason = ""
        for number, (further, higher) in enumerate(OFFSETS):
            self._offset = further * ahead + np.array([0.0, 0.0, higher])
            try:
                if number == 0:
                    yield from super()._reach_and_cut(ahead)
                else:
                    self.robot.command_gripper(self.arm.gripper, 2.0 * (self._radius + OPENING_MARGIN))
                    for _ in self.wait(0.6, "open"):
                        self.arm.hold_position()
                        yield "open"
                    yield from self._advance_and_cut(ahead)
            except TaskFailed as failure:
                if self.phase not in ("close", "cut"):
                    raise
                reason = str(failure)
            if self.is_cut:
                return
        raise TaskFailed(reason or "the blades met no stalk")

    def _cut(self) -> Iterator[str]:
        """Close the cutter once. The resistance of the blades tells whether it cut a stalk."""
        blades = self.robot.cutter_blades(self.arm.gripper)
        closed = [blade.closures for blade in blades]
        self.robot.command_cutter(self.arm.gripper, STALK_FORCE)
        while any(blade.closures == before for blade, before in zip(blades, closed, strict=True)):
            yield "cut"
        self._cut_force = max(
            (blade.resistance for blade in blades if 0.0 < blade.resistance <= blade.force), default=0.0
        )
        yield "cut"

    def _see_hand(self) -> Iterator[str]:
        """Look at the hand, and raise :class:`TaskFailed` if no fruit is in it."""
        self._gaze = self.arm.tip_position
        for phase in look(self, use_lift=False):
            self.arm.hold_position()
            yield phase
        fruit = self._eyes().fruit
        off = fruit - self.arm.tip_position
        inside = (np.linalg.norm(off[:, :2], axis=1) < HELD_REACH) & (
            np.abs(off[:, 2] + 0.5 * self._length - self._grasp_depth) < 0.5 * self._length
        )
        self._gaze = None
        self.points_in_hand = int(np.count_nonzero(inside))
        if self.points_in_hand < HELD_POINTS:
            raise TaskFailed("the camera shows no bunch in the hand")
        self.was_in_hand = True

    def _check_grasp(self) -> None:
        """Raise :class:`TaskFailed` if the fingers feel that they have lost the bunch."""
        if not self.is_cut or self._is_empty or self.phase in ("cut", "let go", "rise"):
            return
        contact = self.robot.rigid.joint_measurements(self.robot.name)[3]
        lost = bool((np.abs(contact[self._fingers]) < HELD_FORCE).any())
        self._steps_without_force = self._steps_without_force + 1 if lost else 0
        if self._steps_without_force > LOST_STEPS:
            raise TaskFailed("the fingers feel nothing: the bunch slipped out of them")
