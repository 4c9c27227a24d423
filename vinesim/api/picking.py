"""Picking single bunches with vinebot: which a hand reaches, how much room it has there, and whether the pick succeeds.

    for grasp in reachable_grasps("demo"):
        print(grasp.bunch, grasp.clearance, attempt_pick("demo", grasp).picked)

Planned and controlled with poses read from the simulation: this is about arm, hand, blade and canopy, not perception.
"""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np

from vinesim.client.tasks import planning
from vinesim.client.tasks.start_poses import start_pose
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.pick import PickBunch, PickPlan
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene, load_scene
from vinesim.world import Physics

ROBOT = "vinebot"
"""Whose hand and arms grasps are planned for."""
_END_PHASE = "drive"
"""The task's first phase after the bunch has been cut and drawn back."""


@dataclasses.dataclass(frozen=True, eq=False)
class Grasp:
    """How one bunch can be taken: from the place where the hand has most room about it."""

    bunch: int
    side: str
    """Arm: left or right."""
    base: np.ndarray
    """[7] Pose of the robot's base in the world."""
    clearance: float
    """[m] Of the open hand to anything but its bunch; negative if it overlaps wood or fruit. Counted up to 30 mm."""


@dataclasses.dataclass(frozen=True)
class PickAttempt:
    """One bunch that was tried."""

    bunch: int
    clearance: float
    """[m] See :class:`Grasp`."""
    picked: bool
    """Cut, in the hand, and drawn back to the robot."""
    reason: str
    """Why not; empty if picked."""
    others: int
    """Bunches beside it that came off their vines."""


def reachable_grasps(scene: Scene | str | pathlib.Path, spawn: int = 0, reach: float = 3.0) -> list[Grasp]:
    """The bunches of a scene within ``reach`` [m] of its start place ``spawn`` that a hand reaches, freest bases first.

    The base may move. Also those are listed about which the hand has no room.
    """
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    found = planning.freest_bases(generate(scene), start_pose(scene, spawn)[:2], reach)
    return [Grasp(*one) for one in found]


def attempt_pick(scene: Scene | str | pathlib.Path | Model, grasp: Grasp) -> PickAttempt:
    """Pick one bunch in a vineyard of its own, at rest before: reach, grasp, cut, draw back. Some 2 s of one core."""
    if isinstance(scene, Model):
        model = scene
    else:
        model = generate(scene if isinstance(scene, Scene) else load_scene(scene))
    physics = Physics(model)
    picker = Robot(physics.rigid, load_description(ROBOT), "picker", pose=grasp.base)
    picker.fit_cutters(physics)
    # box and path of the plan are those of phases that are not reached
    plan = PickPlan(grasp.bunch, grasp.side, grasp.base, 0, grasp.base[None, :2], 0.0)
    task = PickBunch(physics, picker, plan)
    while not task.is_done and task.phase != _END_PHASE:
        task.control(physics.time)
        picker.control(physics.time)
        physics.step()
    cut = ~physics.state.bunch_attached
    others = int(cut.sum() - cut[grasp.bunch])
    return PickAttempt(grasp.bunch, grasp.clearance, not task.is_done, task.reason, others)
