"""The description of a robot: joints, drives, frames, sensors, limits."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Mapping

import numpy as np

from vinesim.core import frames
from vinesim.robot.description.grippers import AnyGripper, Cutter
from vinesim.robot.description.kinematics import MovingJoints
from vinesim.robot.description.sidecar import BaseLimits, JointGroup
from vinesim.scene.values import ControllerSpec, Drive, ImuMount, RenderedMount, RobotSpec, SensorMount, SensorPacing


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RobotDescription:
    """A robot as loaded from its URDF and TOML file. It never changes."""

    name: str
    """The robot's name in the URDF."""
    file: pathlib.Path
    urdf: str
    """Text of the URDF for physics and other clients: repaired, with absolute paths of meshes."""
    base: str
    """Name of the root link: base_footprint, if the URDF has this link."""
    drives: tuple[Drive, ...]
    """Drives in the order of the URDF. Joints that mimic another joint have none."""
    home: np.ndarray
    """[joint] Home positions [rad or m]."""
    groups: dict[str, JointGroup]
    moving_joints: MovingJoints
    fixed_frames: tuple[tuple[str, str], ...]
    """(parent frame, child frame) of every fixed joint, for ``/tf_static``."""
    fixed_poses: np.ndarray
    """[fixed, 7] Pose of the child in the parent, for each of :attr:`fixed_frames`."""
    link_anchors: dict[str, tuple[str, np.ndarray]]
    """For every link, by name: the moving link (or the root link) to which it is fixed, and its pose [7] in the
    frame of that link."""
    sensors: tuple[RenderedMount, ...]
    """Cameras, lidars and other rendered sensors, in the order of :data:`vinesim.scene.values.SENSOR_KINDS`."""
    imus: tuple[ImuMount, ...]
    wrenches: tuple[SensorMount, ...]
    sensor_pacing: SensorPacing
    grippers: tuple[AnyGripper, ...]
    controllers: tuple[ControllerSpec, ...]
    """Controllers through which ROS may command the robot, sorted by name."""
    base_limits: BaseLimits
    mass: float
    """Total mass [kg]."""
    notes: tuple[str, ...]
    """Changes and derived values that were made during loading, one line each."""
    meshes: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Corners [face, 3, 3] m of meshes that were received over the network, by the file name in ``urdf``."""
    ros_urdf: str = ""
    """Text of the URDF for ``/robot_description``: the user's own, with the addresses of meshes at which other programs
    find them."""
    original_names: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Names of links and joints in the robot file, by the valid names that replace them."""
    is_remote: bool = False
    """Whether the description was received over the network, because another client simulates the robot."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the driven joints, in the order of all joint arrays."""
        return tuple(drive.joint for drive in self.drives)

    @property
    def cutters(self) -> tuple[Cutter, ...]:
        """The robot's grippers that cut."""
        return tuple(gripper for gripper in self.grippers if isinstance(gripper, Cutter))

    def sensors_of(self, kind: str) -> tuple[RenderedMount, ...]:
        """Returns the robot's sensors of ``kind``, one of :data:`vinesim.scene.values.SENSOR_KINDS`, in the order of
        its TOML file."""
        return tuple(mount for mount in self.sensors if mount.kind == kind)

    def joint_indices(self, group: str) -> np.ndarray:
        """Returns the indices of a group's joints in joint arrays. Raises KeyError for an unknown group."""
        order = {name: i for i, name in enumerate(self.joints)}
        return np.array([order[name] for name in self.groups[group].joints], int)

    def finger_travel(self, fingers: np.ndarray) -> tuple[float, float]:
        """Returns the opening of a gripper as a linear function of the common position of its driven fingers: the
        slope, and the opening at position 0 [m or rad].

        ``fingers`` [k]: indices of the driven fingers. Prismatic joints that mimic a driven finger count as fingers,
        too. Revolute joints that mimic one do not, because they are part of its linkage.
        """
        moving = self.moving_joints
        is_driven = np.isin(moving.names, self.joints)
        counts = np.isin(moving.drive_index, fingers) & (is_driven | (moving.half_angle[:, 0] == 0.0))
        sign = np.sign(moving.multiplier[counts])
        return float(np.abs(moving.multiplier[counts]).sum()), float((sign * moving.offset[counts]).sum())

    def link_poses(self, position: np.ndarray) -> dict[str, np.ndarray]:
        """Returns the pose [7] of every link in the root link's frame, by name. ``position`` [joint]: positions of
        the drives. This walks the tree and is too slow for the real-time loop."""
        parents = dict(
            zip([child for _, child in self.moving_joints.frames], range(len(self.moving_joints.frames)), strict=True)
        )
        local = self.moving_joints.poses(np.asarray(position, float))
        found = {self.base: frames.pose([0.0, 0.0, 0.0])}
        for link, (anchor, offset) in self.link_anchors.items():  # from the root outwards
            if anchor != link:
                found[link] = frames.compose(found[anchor], offset)
            elif link != self.base:
                joint = parents[link]
                found[link] = frames.compose(found[self.moving_joints.frames[joint][0]], local[joint])
        return found

    def to_spec(self, name: str, index: int = 0, pose: np.ndarray | None = None) -> RobotSpec:
        """Returns the specification with which physics adds the robot. ``name``: its name in the world. ``index``:
        number of its instance label. ``pose`` [7]: pose of its base (the origin unless given)."""
        pose = frames.pose([0.0, 0.0, 0.0]) if pose is None else np.asarray(pose, float)
        return RobotSpec(
            name,
            index,
            self.urdf,
            self.base,
            pose,
            self.drives,
            self.home.copy(),
            self.base_limits.effort,
            self.meshes,
            self.is_remote,
            self.base_limits.kind == "free",
        )
