"""Picks single bunches with vinebot: finds reachable bunches and the room for the hand, and simulates the pick.

    for grasp in reachable_grasps("demo"):
        print(grasp.bunch, grasp.clearance, attempt_pick("demo", grasp).picked)

Planning and control use poses from the simulation, so this tests arm, hand, blade and canopy, but not perception.
"""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np

from vinesim.client.tasks import planning
from vinesim.client.tasks.start_poses import start_pose
from vinesim.client.vine_events import fruit_report
from vinesim.core.errors import UsageError
from vinesim.core.numbers import checked_number, is_whole
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.pick import PickBunch, PickPlan
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene, load_scene
from vinesim.world import Physics

ROBOT = "vinebot"
"""Robot for which grasps are planned."""
_END_PHASE = "drive"
"""First phase of the task after the bunch has been cut and drawn back."""


@dataclasses.dataclass(frozen=True, eq=False)
class Grasp:
    """A possible grasp of one bunch: the arm, and the pose of the robot's base at which the open hand of this arm has
    the most room around it."""

    bunch: int
    side: str
    """Arm, left or right."""
    base: np.ndarray
    """[7] Pose of the robot's base in the world."""
    clearance: float
    """[m] Distance of the open hand to everything but its bunch, up to 30 mm; negative if it overlaps wood or fruit."""


@dataclasses.dataclass(frozen=True)
class PickAttempt:
    """Result of an attempt to pick one bunch."""

    bunch: int
    clearance: float
    """[m] Clearance of the hand, see :class:`Grasp`."""
    picked: bool
    """Whether the bunch was cut, is in the hand, and was drawn back to the robot."""
    reason: str
    """Reason why the pick failed; empty if it succeeded."""
    others: int
    """Number of other bunches that came off their vines."""
    seconds: float = 0.0
    """Simulated time from the first motion of the hand to the end [s]."""
    berries_burst: float = 0.0
    """Expected number of berries, of any bunch, whose skins burst."""
    berries_lost: float = 0.0
    """Expected number of berries, of any bunch, that fell off."""
    damage: float | None = None
    """Share of the berries of the bunch in the hand which burst or fell off; None unless one was picked."""


def reachable_grasps(scene: Scene | str | pathlib.Path, spawn: int = 0, reach: float = 3.0) -> list[Grasp]:
    """Returns a grasp of each bunch that hangs within ``reach`` [m], measured on the ground, of a start place of the
    scene and that a hand can reach from any pose of the base. The grasp with the most room for the hand comes first.

    ``spawn``: index of the start place. Bunches that a hand can reach are listed even if the hand has no room around
    them.
    """
    checked_number("reach", reach, "m", positive=True, error=UsageError)
    if not is_whole(spawn):
        raise UsageError(f"spawn is {spawn}; give a whole number, the index of a start place")
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    found = planning.freest_bases(generate(scene), start_pose(scene, spawn)[:2], reach)
    return [Grasp(*one) for one in found]


def attempt_pick(scene: Scene | str | pathlib.Path | Model, grasp: Grasp) -> PickAttempt:
    """Pick one bunch in a separate vineyard at rest: reach, grasp, cut, draw back. It takes about 2 s on one core."""
    if isinstance(scene, Model):
        model = scene
    else:
        model = generate(scene if isinstance(scene, Scene) else load_scene(scene))
    physics = Physics(model)
    picker = Robot(physics.rigid, load_description(ROBOT), "picker", pose=grasp.base)
    picker.fit_cutters(physics)
    # dummy values: the phases that use the box and the path of the plan are not reached
    plan = PickPlan(grasp.bunch, grasp.side, grasp.base, 0, grasp.base[None, :2], 0.0)
    task = PickBunch(physics, picker, plan)
    while not task.is_done and task.phase != _END_PHASE:
        task.control(physics.time)
        picker.control(physics.time)
        physics.step()
    cut = ~physics.state.bunch_attached
    others = int(cut.sum() - cut[grasp.bunch])
    picked = not task.is_done
    fruit = fruit_report(physics)
    return PickAttempt(
        grasp.bunch,
        grasp.clearance,
        picked,
        task.reason,
        others,
        physics.time,
        fruit["berries_burst"],
        fruit["berries_lost"],
        physics.fruit_monitor.history(grasp.bunch).damage if picked else None,
    )
