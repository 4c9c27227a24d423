"""A replayed world as ROS topics: publishes the state of a spectator after every step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vinesim.client.client import Client
from vinesim.client.processes.ros_process import TRUTH_ORGANS
from vinesim.client.processes.ros_worker import truth_frame
from vinesim.core import frames
from vinesim.robot.description.shown import shown_urdf
from vinesim.robot.drives.robot_instance import RemoteRobot
from vinesim.ros.world_node import WorldNode
from vinesim.scene.ids import Organ

ENVIRONMENT_PERIOD = 0.1
"""Simulated time between two messages with the true poses of boxes, bunches and people [s]."""


class RosReplay:
    """Publishes the state of a client after each of its steps; ``time()`` returns the time of the recording [s]."""

    def __init__(self, client: Client, node: WorldNode, time: Callable[[], float]) -> None:
        self._node = node
        self._time = time
        self._period = max(round(ENVIRONMENT_PERIOD / client.physics.dt), 1)
        self._named: tuple[tuple[str, ...], bytes] | None = None
        self._names: tuple[str, ...] = ()
        poles = np.flatnonzero(client.model.fixed_organ == Organ.POLE)
        names = tuple(f"pole_{i:04d}" for i in range(len(poles)))
        node.publish_environment_static(names, frames.pose(client.model.fixed_start[poles]))
        client.post_step.append(self._after_step)

    def _after_step(self, client: Client) -> None:
        time = self._time()
        self._node.publish_clock(time)
        for name, robot in client.remote_actors.items():
            if isinstance(robot, RemoteRobot):
                one = robot.description
                fixed = [(p, c, q) for (p, c), q in zip(one.fixed_frames, one.fixed_poses, strict=True)]
                self._node.publish_robot(name, shown_urdf(one), one.base, fixed, robot.sample(time))
        if client.physics.tick % self._period == 0:
            self._publish_environment(client, time)

    def _publish_environment(self, client: Client, time: float) -> None:
        physics = client.physics
        physics.update_kinematics()
        visuals = physics.visuals()
        rows = [i for i, one in enumerate(visuals) if one.organ in TRUTH_ORGANS]
        attached = np.flatnonzero(physics.state.bunch_attached)
        rigid = tuple(truth_frame(visuals[i]) for i in rows)
        if (named := (rigid, attached.tobytes())) != self._named:
            self._named = named
            self._names = (*rigid, *(f"bunch_{i:05d}" for i in attached))
        bunches = physics.state.body_q[client.model.bunch_body[attached]]
        self._node.publish_environment(time, self._names, np.concatenate([physics.visual_q()[rows], bunches]))
