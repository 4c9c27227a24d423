"""The arm of the learning tasks: seven joints and two fingers, on a base that is bolted down, and its blades.

Lengths, masses and limits are those of no product. They are GUESSED in the range of arms that carry 3 kg.
"""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.interaction.blades import Blade
from vinesim.scene.values import Drive, RobotSpec

AXES = ("0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0", "1 0 0")
LINK = 0.15
"""[m] Distance from a joint to the next one."""
TOOL_LINK = "link_6"
"""Link that carries the fingers."""
TOOL = (0.2, 0.0, 0.0)
"""[m] Point between the tips of the fingers, in the axes of :data:`TOOL_LINK`."""
FINGER = (0.08, 0.012, 0.024)
"""[m] Edges of a finger: along the hand, across, and along the hand's vertical axis. Its tip is at :data:`TOOL`."""
FINGER_WAY = 0.03
"""[m] Largest distance of a finger from the middle of its way, where the fingers are 6 cm apart."""
GAP = 2.0 * FINGER_WAY - FINGER[1]
"""[m] Clear width between the fingers in the middle of their ways."""
CLOSED = 0.026
"""[m] Target of a finger that closes, as a distance from the middle of its way. The fingers touch at 24 mm."""
JOINT_LIMIT = 2.5
"""[rad] Largest angle of a joint in either direction."""


def _link(name: str, mass: float, shape: str = "", at: str = "0 0 0", rpy: str = "0 0 0") -> str:
    inertia = 0.004 * mass
    collision = f'<collision><origin xyz="{at}" rpy="{rpy}"/><geometry>{shape}</geometry></collision>' if shape else ""
    return (
        f'<link name="{name}"><inertial><origin xyz="{at}"/><mass value="{mass}"/><inertia ixx="{inertia}" '
        f'iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial>{collision}</link>'
    )


def _joint(name: str, kind: str, parent: str, child: str, at: str, axis: str, limit: float) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
        f'<axis xyz="{axis}"/><limit lower="{-limit}" upper="{limit}" effort="200" velocity="5"/>'
        '<dynamics damping="1"/></joint>'
    )


def arm(
    at: tuple[float, float, float], home: np.ndarray | None = None, *, finger_gains: tuple[float, float] = (500.0, 20.0)
) -> RobotSpec:
    """Returns the arm with its base ``at`` [m]. ``home`` [9]: first positions of the joints [rad] and fingers [m], by
    default 0. ``finger_gains``: stiffness [N/m] and damping [N s/m] of the servos of the fingers."""
    parts = [_link("base_footprint", 5.0)]
    drives = []
    parent = "base_footprint"
    for i, axis in enumerate(AXES):
        name = f"link_{i}"
        parts.append(_link(name, 1.5, '<cylinder radius="0.04" length="0.13"/>', "0.065 0 0", "0 1.5707963 0"))
        parts.append(_joint(f"joint_{i}", "revolute", parent, name, f"{LINK} 0 0", axis, JOINT_LIMIT))
        drives.append(Drive(f"joint_{i}", 300.0, 30.0, 200.0, 5.0, -JOINT_LIMIT, JOINT_LIMIT))
        parent = name
    for side, y in (("left", 0.03), ("right", -0.03)):
        parts.append(_link(side, 0.1, '<box size="{} {} {}"/>'.format(*FINGER)))
        parts.append(_joint(f"{side}_finger", "prismatic", parent, side, f"0.16 {y} 0", "0 1 0", FINGER_WAY))
        drives.append(Drive(f"{side}_finger", *finger_gains, 40.0, 1.0, -FINGER_WAY, FINGER_WAY))
    urdf = f'<robot name="arm">{"".join(parts)}</robot>'
    home = np.zeros(len(drives)) if home is None else np.asarray(home, float)
    return RobotSpec("arm", 0, urdf, "base_footprint", frames.pose(np.array(at)), tuple(drives), home)


def harvest_arm(at: tuple[float, float, float], home: np.ndarray | None = None) -> RobotSpec:
    """Returns the arm with fingers that hold a bunch by its stalk. Arguments as for :func:`arm`.

    Closed on a stalk of 4 mm, each finger presses with 16 N, GUESSED: friction then carries 2.6 kg. The damping is
    TUNED: with 20 N s/m, a finger that loses contact for a step of 10 ms moves by 3 mm, and through the stalk.
    """
    return arm(at, home, finger_gains=(4000.0, 200.0))


def harvest_blade() -> Blade:
    """Returns the blade of the harvest hand. It closes 2 cm above the middle of the fingers (along z of
    :data:`TOOL_LINK`) within a step, so that a bunch is held by its stalk when it comes off.

    End effectors of robots that harvest table grapes hold the stalk and cut above the hold. Force and mouth are
    GUESSED: 150 N cuts stalks of up to 6.3 mm; the mouth is as wide as the open fingers.
    """
    mouth = frames.pose(np.array([0.17, 0.0, 0.02]))
    return Blade("arm", TOOL_LINK, mouth, np.array([0.04, 0.024, 0.003]), 150.0)


def pruning_blade() -> Blade:
    """Returns the blade of pruning shears, whose bars the fingers are: it closes across their plane, between their
    tips, within a step.

    Force and mouth are GUESSED: 1,500 N cuts dormant canes of 10 mm, the mouth is as wide as the open fingers.
    """
    mouth = frames.pose(np.array([0.18, 0.0, 0.0]))
    return Blade("arm", TOOL_LINK, mouth, np.array([0.03, 0.024, 0.003]), 1500.0)
