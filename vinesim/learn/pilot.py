"""A policy that controls the arm of a client's physics."""

from __future__ import annotations

import pathlib
import tempfile
from collections.abc import Iterator

import numpy as np
import warp as wp

from vinesim.kernels.graph import KernelGraph
from vinesim.learn.arm import AXES, arm
from vinesim.learn.arm_arrays import ClientArm
from vinesim.learn.arm_env import BASE, HOME, MAX_EPISODE_STEPS
from vinesim.learn.policy import Policy
from vinesim.learn.reach import NUMBERS, observe
from vinesim.learn.task_env import STEPS
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.sidecar import BaseLimits, JointGroup, Sidecar
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.task import Task
from vinesim.world import Physics


class ReachPilot:
    """Lets a policy reach for a bunch, with the observation and the servo targets of
    :class:`~vinesim.learn.reach.ReachEnv`, by its kernels. Call :meth:`look` and :meth:`act`, command the targets, and
    take :data:`~vinesim.learn.task_env.STEPS` steps of the physics.

    Args:
        physics: a world with the task's four shoots.
        policy: a policy for the task.
        wanted: number of the tree whose bunch is wanted.
        robot: name of the arm.
    """

    def __init__(self, physics: Physics, policy: Policy, wanted: int, robot: str = "arm") -> None:
        policy.check_numbers(NUMBERS, len(AXES))
        self._policy = policy
        self._client = ClientArm(physics, robot)
        joints = len(AXES)
        observation, action = (wp.zeros((1, size), dtype=float, device="cpu") for size in (NUMBERS, joints))
        reward = wp.zeros(1, dtype=float, device="cpu")
        success = wp.zeros(1, dtype=wp.bool, device="cpu")
        target = wp.array([wanted], dtype=wp.int32, device="cpu")
        arrays = self._client.arrays
        self._observe = KernelGraph(observe(arrays, target, action, [observation, reward, success]), device="cpu")
        self._move = KernelGraph(arrays.move(action, physics.dt), device="cpu")
        self.observation = observation.numpy()[0]
        """[:data:`~vinesim.learn.reach.NUMBERS`] The last observation."""
        self.action = action.numpy()[0]
        """[joint] The last action."""
        self._targets = arrays.targets.numpy()[0]
        self._success = success.numpy()
        self.look()

    @property
    def has_reached(self) -> bool:
        """Whether the bunch was reached when :meth:`look` was called last."""
        return bool(self._success[0])

    def look(self) -> None:
        """Observe the state after the last step."""
        self._client.read()
        self._observe()

    def act(self) -> np.ndarray:
        """Returns the targets [joint] rad of the servos that follow from the last observation; those of the fingers [m]
        do not change."""
        self.action[:] = self._policy(self.observation)
        self._move()
        return self._targets.astype(np.float64)


class ReachBunch(Task):
    """Task of a client's robot: bring the fingers to a bunch as a policy says. It fails after as long as an episode.

    The servos of a client's robot damp the speed relative to that of their set-points, those of a batch the speed
    itself. Both exert equal efforts if the set-point follows the target with the time constant damping / stiffness.

    Args:
        physics: a world with the task's four shoots.
        robot: the arm of :func:`arm_description`, at :data:`~vinesim.learn.arm_env.BASE`.
        policy: a policy for the task reach.
        wanted: number of the tree whose bunch is wanted.
    """

    key_phases = frozenset({"reach"})

    def __init__(self, physics: Physics, robot: Robot, policy: Policy, wanted: int) -> None:
        self._physics = physics
        self._body = int(physics.model.bunch_body[wanted])
        self._pilot = ReachPilot(physics, policy, wanted, robot.name)
        drives = robot.description.drives
        self._lag = np.array([drive.damping / (drive.stiffness * physics.dt) for drive in drives])
        super().__init__(robot, timeout=MAX_EPISODE_STEPS * STEPS * physics.dt)

    def focus(self) -> np.ndarray:
        """Returns where the bunch hangs [3] m."""
        return self._physics.state.body_q[self._body, :3]

    def run(self) -> Iterator[str]:
        """Look and act every 40 ms, until the bunch is reached."""
        setpoint = self.robot.setpoint.copy()
        while True:
            self._pilot.look()
            if self._pilot.has_reached:
                return
            targets = self._pilot.act()
            for _ in range(STEPS):
                setpoint = (targets + self._lag * setpoint) / (1.0 + self._lag)
                self.robot.command_position(setpoint)
                yield "reach"


def arm_description() -> RobotDescription:
    """Returns the arm of the learning tasks as a robot of a client, which is bolted down."""
    spec = arm(BASE, HOME)
    group = JointGroup(
        joints=tuple(drive.joint for drive in spec.drives),
        stiffness=tuple(drive.stiffness for drive in spec.drives),
        damping=tuple(drive.damping for drive in spec.drives),
        armature=tuple(drive.armature for drive in spec.drives),
        home=tuple(spec.home.tolist()),
    )
    sidecar = Sidecar(base=BaseLimits(kind="fixed"), groups={"arm": group}, grippers=())
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "arm.urdf"
        file.write_text(spec.urdf)
        return load_description(file, sidecar=sidecar)
