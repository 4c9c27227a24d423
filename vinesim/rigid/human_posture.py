"""Collision shapes, proportions and inverse kinematics of people. A body part has one shape, a hand has three."""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.rigid import human_kinematics as kernels
from vinesim.scene import appearance
from vinesim.scene.appearance import PHALANGES
from vinesim.scene.values import POINT_NAMES, HumanPose, Shape

SIDES = ("left", "right")
BODY_PARTS = (
    "head",
    "chest",
    "hips",
    "left_thigh",
    "left_shank",
    "left_foot",
    "right_thigh",
    "right_shank",
    "right_foot",
)
"""Names of a person's kinematic bodies, in the order of the poses from :meth:`PostureSolver.body_parts`."""

# lengths as fractions of a person's height; READ: Winter 2009, after Drillis and Contini
THIGH_LENGTH = 0.245
SHANK_LENGTH = 0.246
ANKLE_HEIGHT = 0.039
HIP_HALF_WIDTH = 0.095
TRUNK_LENGTH = 0.288

EYES_TO_HEAD_BACK = 0.09
"""Backward distance [m] from the point between the eyes to the middle of the head. GUESSED."""
EYES_TO_HEAD_DOWN = 0.02
"""Downward distance [m] from the point between the eyes to the middle of the head. GUESSED."""
HAND_HALF_THICKNESS = 0.012
"""Half of the thickness of a palm [m]. GUESSED."""
PALM_TO_FINGERTIP = 0.13
"""Distance [m] from the middle of the palm to the fingertips. GUESSED."""
GRASP_POINTS = np.array([[0.0, 0.0, 0.0], [0.085, 0.0, 0.0]])
"""Points [2, 3] m of a hand from which grasps are searched: middle of the palm and of the fingers, in the palm's frame.
"""
SKIN_COLOR = (0.85, 0.62, 0.5, 1.0)
CLOTH_COLOR = (0.98, 0.47, 0.16, 1.0)
_Z_TO_X = frames.exp(np.array([0.0, 0.5 * np.pi, 0.0]))


@functools.cache
def body_shapes(height: float) -> tuple[Shape, ...]:
    """Returns one collision shape for each of :data:`BODY_PARTS` of a person of ``height`` [m], in the part's frame.

    The x axis runs along a limb; the origin is at the beginning of the limb.
    """

    def limb(share: float, radius: float) -> Shape:
        half = 0.5 * share * height
        return Shape("capsule", (radius, half), frames.pose(np.array([half, 0.0, 0.0]), _Z_TO_X), CLOTH_COLOR)

    sole = 0.5 * ANKLE_HEIGHT * height
    legs = (
        limb(THIGH_LENGTH, 0.07),
        limb(SHANK_LENGTH, 0.05),
        Shape(
            "box", (0.13, 0.045, sole), frames.pose(np.array([0.06, 0.0, -0.5 * ANKLE_HEIGHT * height])), CLOTH_COLOR
        ),
    )
    half = 0.5 * TRUNK_LENGTH * height
    head = frames.pose(np.array([-EYES_TO_HEAD_BACK, 0.0, -EYES_TO_HEAD_DOWN]))
    return (
        Shape("ellipsoid", (0.1, 0.078, 0.115), head, SKIN_COLOR),
        Shape("ellipsoid", (0.12, 0.17, half + 0.03), frames.pose(np.array([0.0, 0.0, half])), CLOTH_COLOR),
        Shape("ellipsoid", (0.12, 0.16, 0.12), frames.pose(np.zeros(3)), CLOTH_COLOR),
        *legs,
        *legs,
    )


@functools.cache
def hand_shapes(side: str) -> tuple[Shape, ...]:
    """Returns the shapes of palm, fingers and thumb in the frame of the palm."""
    thumb = np.array([0.02, 0.05 if side == "right" else -0.05, -0.006])
    # boxes, because two parallel capsules touch in only one point in MuJoCo and would rock
    return (
        Shape("box", (0.05, 0.04, HAND_HALF_THICKNESS), frames.pose(np.zeros(3)), SKIN_COLOR),
        Shape("box", (0.04, 0.036, HAND_HALF_THICKNESS - 0.003), frames.pose(GRASP_POINTS[1]), SKIN_COLOR),
        Shape("capsule", (0.01, 0.025), frames.pose(thumb, _Z_TO_X), SKIN_COLOR),
    )


# Inverse kinematics of people: poses of body parts, arms and fingers from the tracked points.


VISUAL_PARTS = (
    "neck",
    "left_upper_arm",
    "left_forearm",
    "right_upper_arm",
    "right_forearm",
    *(f"{side}_{finger}_{k + 1}" for side in SIDES for finger in appearance.FINGERS for k in range(PHALANGES)),
)
"""Names of a person's visible parts without collisions: neck and arms, which connect head, chest and hands; fingers."""
EYE_HEIGHT = 0.939
"""Height of the eyes of a standing person, as a fraction of the person's height. READ: Winter 2009."""
HIP_HEIGHT = 0.53
"""Height of the hips of a standing person, as a fraction of the person's height. READ: Winter 2009."""
NECK_BELOW_EYES = -0.2
"""Height of the neck relative to the eyes [m]. GUESSED."""


def standing_pose(root: np.ndarray, height: float = 1.75) -> HumanPose:
    """Returns the tracked points of a person of ``height`` [m] who stands at ``root`` [7], with the hands in front of
    the hips and the palms down."""

    def at(x: float, y: float, z: float) -> np.ndarray:
        return frames.compose(root, frames.pose(np.array([x, y, z])))

    side = HIP_HALF_WIDTH * height
    hip = HIP_HEIGHT * height
    return HumanPose(
        root=np.asarray(root, float),
        head=at(EYES_TO_HEAD_BACK, 0.0, EYE_HEIGHT * height),
        hips=at(0.0, 0.0, hip),
        left=at(0.35, 0.2, hip + 0.1),
        right=at(0.35, -0.2, hip + 0.1),
        left_foot=at(0.0, side, ANKLE_HEIGHT * height),
        right_foot=at(0.0, -side, ANKLE_HEIGHT * height),
    )


def body_posture(height: float, pose: HumanPose) -> np.ndarray:
    """Returns the poses [part, 7] of :data:`BODY_PARTS` of a person of ``height`` [m]; see
    :meth:`PostureSolver.body_parts`."""
    return PostureSolver(height).body_parts(pose)


class PostureSolver:
    """Inverse kinematics of one person, computed by kernel graphs on arrays that are allocated once."""

    def __init__(self, height: float) -> None:
        """``height`` [m]: height of the person."""
        points = len(POINT_NAMES) - 3
        poses = len(BODY_PARTS) + 2 * len(SIDES)
        self._tracked = np.zeros((points, 7))
        self._parts = np.zeros((len(BODY_PARTS), 7))
        self._start = np.zeros((poses, 7))
        self._goal = np.zeros((poses, 7))
        self._difference = np.zeros((3, poses, 3))

        def shared(data: np.ndarray) -> wp.array:
            return wp.array(data, dtype=wp.float64, device="cpu", copy=False)

        neck = wp.vec3d(-EYES_TO_HEAD_BACK, 0.0, NECK_BELOW_EYES)
        pose_torso_and_legs = KernelLaunch(
            kernels.pose_torso_and_legs,
            [THIGH_LENGTH * height, SHANK_LENGTH * height, HIP_HALF_WIDTH * height, neck, shared(self._tracked)],
            [shared(self._parts)],
            threads=3,
        )
        self._pose_torso_and_legs = KernelGraph(pose_torso_and_legs)
        pose_difference = KernelLaunch(
            kernels.pose_difference,
            [shared(self._start), shared(self._goal)],
            [shared(rows) for rows in self._difference],
            threads=poses,
        )
        self._pose_difference = KernelGraph(pose_difference)
        looks = appearance.load_human_model(height)
        self._ends = np.zeros((4, 7))
        self._closed = np.zeros(2 * len(appearance.FINGERS))
        self._visual_parts = np.zeros((len(VISUAL_PARTS), 7))
        limbs = looks.limbs
        bones = [np.ascontiguousarray(table) for table in (looks.root, looks.length, looks.bent)]
        pose_arms_and_fingers = KernelLaunch(
            kernels.pose_arms_and_fingers,
            [
                limbs.upper_arm,
                limbs.forearm,
                *map(wp.vec3d, (limbs.shoulder, limbs.wrist, limbs.elbow)),
                limbs.neck,
                wp.vec3d(limbs.nape),
                *map(shared, bones),
                shared(self._ends),
                shared(self._closed),
            ],
            [shared(self._visual_parts)],
            threads=3 + len(self._closed),
        )
        self._pose_arms_and_fingers = KernelGraph(pose_arms_and_fingers)

    def body_parts(self, pose: HumanPose) -> np.ndarray:
        """Returns the poses [part, 7] of :data:`BODY_PARTS` for tracked points; knees bend forward to connect hips and
        ankles."""
        self._tracked[:] = pose.head, pose.hips, pose.left_foot, pose.right_foot
        self._pose_torso_and_legs()
        return self._parts.copy()

    def visual_parts(
        self, chest: np.ndarray, head: np.ndarray, hands: np.ndarray, closed: tuple[float, ...]
    ) -> np.ndarray:
        """Returns the poses [part, 7] of :data:`VISUAL_PARTS`.

        Args:
            chest: pose [7] of the chest.
            head: pose [7] of the head.
            hands: poses [2, 7] of the palms, left and right.
            closed: [10] bend of each finger from 0 to 1, left hand first.
        """
        self._ends[0], self._ends[1], self._ends[2:], self._closed[:] = chest, head, hands, closed
        self._pose_arms_and_fingers()
        return self._visual_parts.copy()

    def difference(self, start: tuple[np.ndarray, ...], goal: tuple[np.ndarray, ...]) -> np.ndarray:
        """Returns the motions [3, k, 3] from poses ``start`` to poses ``goal`` [k, 7].

        The first index selects translation [m], rotation vector [rad] in world axes, or rotation vector [rad] in the
        axes of ``start``. The arrays in each tuple are concatenated. The next call overwrites the result.
        """
        np.concatenate(start, out=self._start)
        np.concatenate(goal, out=self._goal)
        self._pose_difference()
        return self._difference
