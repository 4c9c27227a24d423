"""Values that packages exchange: small frozen dataclasses, so that sibling packages need not import each other.

Times are simulation seconds. Arrays are numpy, poses and velocities as in :mod:`vinesim.core.frames`.
The arrays of a value that leaves the physics thread are never written afterwards.
"""

from vinesim.scene.values.human import POINT_NAMES, HandSample, Haptic, HumanPose, HumanSpec
from vinesim.scene.values.measurement import Measurement
from vinesim.scene.values.network import Coupling, HumanUpdate, ObjectUpdate, RobotUpdate, TreeUpdate
from vinesim.scene.values.rigid import Mesh, RigidBox, RigidVisual, Shape
from vinesim.scene.values.robot import (
    FORWARD_KINDS,
    ControllerKind,
    ControllerSpec,
    Drive,
    ElasticSample,
    GripperState,
    Imu,
    JointReference,
    JointSample,
    RobotSample,
    RobotSpec,
    Wrench,
)
from vinesim.scene.values.sensors import (
    MIN_BERRY_PIXELS,
    Box,
    BunchTruth,
    CameraFrame,
    CameraInfo,
    CameraOutput,
    LevelLaser,
    LidarScan,
    SensorMode,
    SensorPacing,
)
from vinesim.scene.values.signals import INTENTIONS, TONE_LEVEL, HandGestures, Intention, LightPattern, Lights
from vinesim.scene.values.status import ComponentStatus
from vinesim.scene.values.world import Contact, Detachment, SegmentPoses, Snapshot, WindState

__all__ = [
    "FORWARD_KINDS",
    "INTENTIONS",
    "MIN_BERRY_PIXELS",
    "POINT_NAMES",
    "TONE_LEVEL",
    "Box",
    "BunchTruth",
    "CameraFrame",
    "CameraInfo",
    "CameraOutput",
    "ComponentStatus",
    "Contact",
    "ControllerKind",
    "ControllerSpec",
    "Coupling",
    "Detachment",
    "Drive",
    "ElasticSample",
    "GripperState",
    "HandGestures",
    "HandSample",
    "Haptic",
    "HumanPose",
    "HumanSpec",
    "HumanUpdate",
    "Imu",
    "Intention",
    "JointReference",
    "JointSample",
    "LevelLaser",
    "LidarScan",
    "LightPattern",
    "Lights",
    "Measurement",
    "Mesh",
    "ObjectUpdate",
    "RigidBox",
    "RigidVisual",
    "RobotSample",
    "RobotSpec",
    "RobotUpdate",
    "SegmentPoses",
    "SensorMode",
    "SensorPacing",
    "Shape",
    "Snapshot",
    "TreeUpdate",
    "WindState",
    "Wrench",
]
