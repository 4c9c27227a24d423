"""A policy that controls the arm of a client's physics."""

from __future__ import annotations

import pathlib
import tempfile
from collections.abc import Iterator

import numpy as np
import warp as wp

from vinesim.interaction.blades import Blade
from vinesim.kernels.graph import KernelGraph
from vinesim.learn.arm_arrays import ClientArm
from vinesim.learn.arm_task import ArmTask
from vinesim.learn.policy import Policy
from vinesim.learn.task_env import STEPS
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.grippers import Cutter
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.sidecar import BaseLimits, JointGroup, Sidecar
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.task import Task, TaskFailed
from vinesim.world import Physics


class Pilot:
    """Lets a policy do a task in the physics of a client. The kernels of the batch compute what it observes, its
    targets and its success.

    Args:
        physics: a world with the plants of the task, the task's robot, and the robot's blade if it has one.
        policy: a policy for the task.
        task: the task.
        wanted: number of the tree whose bunch is wanted.
        robot: name of the robot.
    """

    def __init__(self, physics: Physics, policy: Policy, task: type[ArmTask], wanted: int, robot: str = "arm") -> None:
        policy.check_numbers(task.numbers, task.actions)
        self._physics = physics
        self._policy = policy
        self._client = ClientArm(physics, robot)
        arrays = self._client.arrays
        self._wanted = wanted
        self.name = task.name
        """Name of the task."""
        self.failure = task.failure
        """What has happened if :attr:`failed`."""
        self._task = task(arrays)
        self._task.wanted.fill_(wanted)
        observation, action = (wp.zeros((1, size), dtype=float, device="cpu") for size in (task.numbers, task.actions))
        reward = wp.zeros(1, dtype=float, device="cpu")
        success = wp.zeros(1, dtype=wp.bool, device="cpu")
        judge = [*self._task.counts(), self._task.observe(action, observation, reward, success)]
        self._judge = KernelGraph(*judge, device="cpu")
        self._move = KernelGraph(*self._task.moves(action, physics.dt), device="cpu")
        self.observation = observation.numpy()[0]
        """[:attr:`ArmTask.numbers`] The last observation."""
        self.action = action.numpy()[0]
        """[:attr:`ArmTask.actions`] The last action."""
        self.actions = 0
        """Number of actions so far."""
        self._targets = arrays.targets.numpy()[0]
        self._closing = arrays.closing.numpy()
        self._success = success.numpy()
        self._failed = self._task.failed.numpy()

    @property
    def succeeded(self) -> bool:
        """Whether the task was done after the last action."""
        return bool(self._success[0])

    @property
    def failed(self) -> bool:
        """Whether success was no longer possible after the last action."""
        return bool(self._failed[0])

    def focus(self) -> np.ndarray:
        """Returns where the wanted bunch or internode is [3] m."""
        rigid = self._physics.rigid
        if self._wanted in rigid.free_bunches:
            return rigid.bunch_pose(self._wanted)[:3]
        return self._physics.state.body_q[self._task.wanted_body(self._physics.model, self._wanted), :3]

    def targets(self) -> Iterator[np.ndarray]:
        """Yields, before each step of the physics, the targets [joint] rad or m of the servos, and closes the blade.

        It looks and acts every 40 ms, until the task is done, has failed, or an episode is over.
        """
        self._look()
        while not (self.succeeded or self.failed) and self.actions < self._task.max_steps:
            self.action[:] = self._policy(self.observation)
            self.actions += 1
            self._move()
            for step in range(STEPS):
                if step == STEPS - 1 and self._closing[0]:
                    assert self._client.blade is not None, "the robot of this task has a blade"
                    self._client.blade.close()
                    self._closing[0] = False
                yield self._targets.astype(np.float64)
            self._look()

    def _look(self) -> None:
        """Observe the state after the last step."""
        self._client.read()
        self._judge()


class PolicyTask(Task):
    """Task of a client's robot: do what a policy says. It fails after as long as an episode.

    A servo of a client's robot damps the speed of its joint minus that of its set-point. A servo of a batch damps the
    speed of its joint. Both exert equal efforts if the set-point follows the target with the time constant damping /
    stiffness.

    Args:
        physics: a world with the plants of the task.
        robot: the robot of :func:`task_description`, at :data:`~vinesim.learn.arm_task.BASE`, with its cutters.
        policy: a policy for the task.
        task: the task.
        wanted: number of the tree whose bunch is wanted.
    """

    def __init__(self, physics: Physics, robot: Robot, policy: Policy, task: type[ArmTask], wanted: int) -> None:
        self.key_phases = frozenset({task.name})
        self._pilot = Pilot(physics, policy, task, wanted, robot.name)
        drives = robot.description.drives
        self._lag = np.array([drive.damping / (drive.stiffness * physics.dt) for drive in drives])
        super().__init__(robot, timeout=task.max_steps * STEPS * physics.dt)

    def focus(self) -> np.ndarray:
        """Returns where the wanted bunch or internode is [3] m."""
        return self._pilot.focus()

    def run(self) -> Iterator[str]:
        """Let the policy act until the task is done."""
        setpoint = self.robot.setpoint.copy()
        for targets in self._pilot.targets():
            setpoint = (targets + self._lag * setpoint) / (1.0 + self._lag)
            self.robot.command_position(setpoint)
            yield self._pilot.name
        if self._pilot.failed:
            raise TaskFailed(self._pilot.failure)
        if not self._pilot.succeeded:
            raise TaskFailed(f"not done after {self.timeout:g} s")


def task_description(task: type[ArmTask]) -> RobotDescription:
    """Returns the robot of a task as one of a client, which is bolted down."""
    spec = task.robot()
    blade = task.blade()
    group = JointGroup(
        joints=tuple(drive.joint for drive in spec.drives),
        stiffness=tuple(drive.stiffness for drive in spec.drives),
        damping=tuple(drive.damping for drive in spec.drives),
        armature=tuple(drive.armature for drive in spec.drives),
        home=tuple(spec.home.tolist()),
    )
    cutters = () if blade is None else (_cutter(blade),)
    sidecar = Sidecar(base=BaseLimits(kind="fixed"), groups={"arm": group}, grippers=(), cutters=cutters)
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "arm.urdf"
        file.write_text(spec.urdf)
        return load_description(file, sidecar=sidecar)


def _cutter(blade: Blade) -> Cutter:
    """Returns a blade as the cutter of a robot. It has no rotation against its link."""
    x, y, z = blade.pose[:3].tolist()
    a, b, c = blade.half.tolist()
    return Cutter(group="arm", frame=blade.link, half=(a, b, c), origin=(x, y, z), force=blade.limit, speed=blade.speed)
