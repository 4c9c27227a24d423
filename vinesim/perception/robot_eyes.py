"""The eyes of a robot in its own process: its head camera, rendered between two steps, and the detectors of bunches and
canes.

eyes = RobotEyes(physics, robot)
for seen in eyes().bunches:
    print(seen.top)
"""

from __future__ import annotations

import numpy as np

from vinesim.core.errors import UsageError
from vinesim.perception.bunch_detection import find_bunches
from vinesim.perception.cane_detection import find_canes
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.sight import CaneSight, RowMap, Sight
from vinesim.scene.values import CameraFrame, CameraMount, CameraOutput
from vinesim.sensors.camera import camera as rgbd
from vinesim.sensors.camera.sunlight import DEFAULT_SUN
from vinesim.sensors.export.dataset import resized_intrinsics
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.world import Physics


class RobotEyes:
    """Takes a picture with a robot's first camera and finds the bunches in it. A call takes about 0.3 s on a CPU."""

    def __init__(
        self,
        physics: Physics,
        robot: Robot,
        *,
        sun: tuple[float, float, float] = DEFAULT_SUN,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        """``sun`` [3]: direction to the sun. ``seed``: of the noise of colours and depth.

        Raises :class:`UsageError` if the robot has no camera.
        """
        mounts = [one for one in robot.description.sensors if isinstance(one, CameraMount)]
        if not mounts:
            raise UsageError(f"{robot.name} has no camera to see with; give another robot")
        mount = mounts[0]
        self.pictures = 0
        """Number of pictures taken so far."""
        self._physics = physics
        self._robot = robot
        self._frame = mount.frame
        spec = rgbd.CameraSpec.load(mount.type)
        self._camera = rgbd.Camera(
            spec,
            resized_intrinsics(spec, mount.size),
            mount.name,
            sun,
            "fast",
            seed=seed,
            shadow_period=0.0,
            device=device,
        )
        self._primitives: Primitives | None = None
        self._device = device

    def picture(self, pose: np.ndarray | None = None) -> CameraFrame:
        """Returns a picture of the present state, from ``pose`` [7] of the optical frame if given."""
        if self._primitives is None:
            self._primitives = Primitives(self._physics.model, device=self._device)
        self._physics.update_kinematics()
        self._primitives.update(self._physics.snapshot())
        self.pictures += 1
        if pose is None:
            pose = self._robot.frame_pose(self._frame)
        outputs = CameraOutput.RGB | CameraOutput.DEPTH
        return self._camera.render(self._primitives, pose, self._physics.time, outputs=outputs)

    def __call__(self, pose: np.ndarray | None = None) -> Sight:
        """Returns what the camera shows."""
        return find_bunches(self.picture(pose))

    def canes(self, row: RowMap) -> CaneSight:
        """Returns the canes that the camera shows."""
        return find_canes(self.picture(), row)
