"""Collision shapes of people: one shape for each body part, three for each hand; and the proportions of a body."""

from __future__ import annotations

import functools

import numpy as np

from vinesim.core import frames
from vinesim.scene.values import Shape

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
"""Kinematic bodies of a person, in the order in which :mod:`vinesim.rigid.human_posture` poses them."""

THIGH_LENGTH = 0.245
SHANK_LENGTH = 0.246
ANKLE_HEIGHT = 0.039
HIP_HALF_WIDTH = 0.095
TRUNK_LENGTH = 0.288
"""[1] Shares of a person's height. READ: Winter 2009, after Drillis and Contini."""
EYES_TO_HEAD_BACK = 0.09
EYES_TO_HEAD_DOWN = 0.02
"""[m] From between the eyes to the middle of the head. GUESSED."""
HAND_HALF_THICKNESS = 0.012
"""[m] Half thickness of a palm. GUESSED."""
PALM_TO_FINGERTIP = 0.13
"""[m] From the middle of the palm to the tips of the fingers. GUESSED."""
GRASP_POINTS = np.array([[0.0, 0.0, 0.0], [0.085, 0.0, 0.0]])
"""[2, 3] m Middle of the palm and of the fingers, in the palm's frame."""
SKIN_COLOR = (0.85, 0.62, 0.5, 1.0)
CLOTH_COLOR = (0.98, 0.47, 0.16, 1.0)
_Z_TO_X = frames.exp(np.array([0.0, 0.5 * np.pi, 0.0]))


@functools.cache
def body_shapes(height: float) -> tuple[Shape, ...]:
    """One shape for each of :data:`BODY_PARTS` of a person of this ``height`` [m], in the part's frame.

    x runs along a limb; the origin is where the limb begins.
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
    """Palm, fingers and thumb in the frame of the palm."""
    thumb = np.array([0.02, 0.05 if side == "right" else -0.05, -0.006])
    # flat faces: MuJoCo lets a capsule that lies along another touch it in one point only, and it rocks
    return (
        Shape("box", (0.05, 0.04, HAND_HALF_THICKNESS), frames.pose(np.zeros(3)), SKIN_COLOR),
        Shape("box", (0.04, 0.036, HAND_HALF_THICKNESS - 0.003), frames.pose(GRASP_POINTS[1]), SKIN_COLOR),
        Shape("capsule", (0.01, 0.025), frames.pose(thumb, _Z_TO_X), SKIN_COLOR),
    )
