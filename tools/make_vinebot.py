"""Write ``data/robots/vinebot.urdf``: python tools/make_vinebot.py

The robot is symmetric and its inertias follow from its shapes, so both are said once, here. All link frames are
parallel when every joint is zero: x forward, y left, z up, both arms hanging. Dimensions and masses are those of a
tracked dual-arm carrier of the CANOPIES class (D6.4 figure 8: mobile base, lifting torso, head, two 7-DoF arms); they
are a design of our own, not measured on a machine.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
from xml.etree import ElementTree

import numpy as np

TARGET = pathlib.Path(__file__).resolve().parent.parent / "data" / "robots" / "vinebot.urdf"

COLOURS = {
    "white": (0.93, 0.93, 0.91),
    "dark": (0.13, 0.14, 0.15),
    "grey": (0.45, 0.46, 0.48),
    "red": (0.72, 0.08, 0.10),
    "steel": (0.70, 0.72, 0.74),
    "glass": (0.03, 0.04, 0.06),
    "rubber": (0.05, 0.05, 0.05),
    "yellow": (0.93, 0.72, 0.05),
    "amber": (0.80, 0.42, 0.05),
    "lamp_white": (1.00, 0.97, 0.88),
    "lamp_green": (0.10, 1.00, 0.30),
    "lamp_red": (0.70, 0.03, 0.03),
    "indicator_lamp_green": (0.10, 1.00, 0.30),
    "indicator_amber": (0.80, 0.42, 0.05),
    "indicator_red": (0.72, 0.08, 0.10),
}
"""Lamps shine, rubber, steel and glass look like it, all else is painted: sensors go by these words. The indicator
lights change their colour by command."""

ROUNDING_ERROR = 1e-12
"""Largest size of a value [m, rad, kg m2] that is taken for rounding, which differs between processors."""


@dataclasses.dataclass(frozen=True)
class Piece:
    """One primitive of a link: ``box`` (edges), ``cylinder`` (radius, length along z) or ``sphere`` (radius)."""

    kind: str
    size: tuple[float, ...]
    xyz: tuple[float, float, float]
    rpy: tuple[float, float, float]
    colour: str
    solid: bool
    """Whether it can be touched and has mass; False for paint and lenses."""

    @property
    def volume(self) -> float:
        if self.kind == "box":
            return math.prod(self.size)
        if self.kind == "cylinder":
            return math.pi * self.size[0] ** 2 * self.size[1]
        return 4.0 / 3.0 * math.pi * self.size[0] ** 3

    def inertia(self, mass: float) -> np.ndarray:
        """Inertia [3, 3] kg m2 about the piece's own centre, in link axes."""
        if self.kind == "box":
            x, y, z = self.size
            own = mass / 12.0 * np.diag([y * y + z * z, x * x + z * z, x * x + y * y])
        elif self.kind == "cylinder":
            r, h = self.size
            across = mass * (3.0 * r * r + h * h) / 12.0
            own = np.diag([across, across, 0.5 * mass * r * r])
        else:
            own = 0.4 * mass * self.size[0] ** 2 * np.eye(3)
        turn = rotation(self.rpy)
        return turn @ own @ turn.T


def rotation(rpy: tuple[float, float, float]) -> np.ndarray:
    """Rotation matrix of URDF's fixed-axis roll, pitch, yaw."""
    (sr, sp, sy) = np.sin(rpy)
    (cr, cp, cy) = np.cos(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def box(size, xyz=(0, 0, 0), rpy=(0, 0, 0), colour="white", solid=True) -> Piece:
    return Piece("box", tuple(size), xyz, rpy, colour, solid)


def cylinder(radius, length, xyz=(0, 0, 0), rpy=(0, 0, 0), colour="white", solid=True) -> Piece:
    return Piece("cylinder", (radius, length), xyz, rpy, colour, solid)


def sphere(radius, xyz=(0, 0, 0), colour="white", solid=True) -> Piece:
    return Piece("sphere", (radius,), xyz, (0, 0, 0), colour, solid)


ACROSS = (math.pi / 2, 0, 0)
"""Turns a cylinder's axis from z to y."""
ALONG = (0, math.pi / 2, 0)
"""Turns a cylinder's axis from z to x."""


def beacon(x: float, y: float, z: float) -> tuple[Piece, ...]:
    """A signal tower on ``z``: green is lit, amber and red are not."""
    tiers = ("indicator_lamp_green", "indicator_amber", "indicator_red")
    return (
        cylinder(0.012, 0.10, (x, y, z + 0.05), colour="steel", solid=False),
        *(cylinder(0.026, 0.032, (x, y, z + 0.116 + 0.036 * k), colour=c, solid=False) for k, c in enumerate(tiers)),
        *(cylinder(0.027, 0.005, (x, y, z + 0.098 + 0.036 * k), colour="dark", solid=False) for k in range(4)),
    )


def lugs(y: float, z: float, half: float, radius: float, width: float) -> list[Piece]:
    """Bars across a rubber track whose wheels of this radius stand ``half`` before and behind the middle."""
    bars = []
    step = 0.055
    count = round(2.0 * half / step)
    for side in (1.0, -1.0):
        for k in range(count + 1):
            at = (2.0 * half * k / count - half, y, z + side * (radius + 0.004))
            bars.append(box((0.022, width, 0.012), at, colour="rubber", solid=False))
        bend = round(math.pi * radius / step)
        for k in range(1, bend):
            angle = math.pi * k / bend
            at = (side * (half + (radius + 0.004) * math.sin(angle)), y, z + (radius + 0.004) * math.cos(angle))
            bars.append(box((0.022, width, 0.012), at, (0, side * angle, 0), colour="rubber", solid=False))
    return bars


class Urdf:
    """The text under construction: links and joints in the order they are named."""

    def __init__(self, name: str) -> None:
        self.root = ElementTree.Element("robot", name=name)
        for colour, rgb in COLOURS.items():
            material = ElementTree.SubElement(self.root, "material", name=colour)
            ElementTree.SubElement(material, "color", rgba=numbers(*rgb, 1))

    def link(self, name: str, pieces: tuple[Piece, ...] = (), mass: float = 0.0) -> None:
        """A link whose mass is spread over its solid pieces in proportion to their volumes."""
        link = ElementTree.SubElement(self.root, "link", name=name)
        if mass:
            solids = [piece for piece in pieces if piece.solid]
            masses = mass * np.array([piece.volume for piece in solids]) / sum(piece.volume for piece in solids)
            centres = np.array([piece.xyz for piece in solids], float)
            centre = masses @ centres / mass
            inertia = np.zeros((3, 3))
            for piece, share, arm in zip(solids, masses, centres - centre, strict=True):
                inertia += piece.inertia(share) + share * (arm @ arm * np.eye(3) - np.outer(arm, arm))
            inertial = ElementTree.SubElement(link, "inertial")
            ElementTree.SubElement(inertial, "origin", xyz=numbers(*centre), rpy="0 0 0")
            ElementTree.SubElement(inertial, "mass", value=numbers(mass))
            (ixx, ixy, ixz), (_, iyy, iyz), (_, _, izz) = inertia
            values = {"ixx": ixx, "ixy": ixy, "ixz": ixz, "iyy": iyy, "iyz": iyz, "izz": izz}
            ElementTree.SubElement(inertial, "inertia", {key: numbers(value) for key, value in values.items()})
        for piece in pieces:
            visual = self._shape(link, "visual", piece)
            ElementTree.SubElement(visual, "material", name=piece.colour)
        for piece in pieces:
            if piece.solid:
                self._shape(link, "collision", piece)

    def _shape(self, link: ElementTree.Element, tag: str, piece: Piece) -> ElementTree.Element:
        shape = ElementTree.SubElement(link, tag)
        ElementTree.SubElement(shape, "origin", xyz=numbers(*piece.xyz), rpy=numbers(*piece.rpy))
        geometry = ElementTree.SubElement(shape, "geometry")
        if piece.kind == "box":
            ElementTree.SubElement(geometry, "box", size=numbers(*piece.size))
        elif piece.kind == "cylinder":
            ElementTree.SubElement(geometry, "cylinder", radius=numbers(piece.size[0]), length=numbers(piece.size[1]))
        else:
            ElementTree.SubElement(geometry, "sphere", radius=numbers(piece.size[0]))
        return shape

    def fix(self, child: str, parent: str, xyz=(0, 0, 0), rpy=(0, 0, 0)) -> None:
        self._joint(child.removesuffix("_link") + "_joint", "fixed", parent, child, xyz, rpy)

    def move(self, name, kind, parent, child, xyz, axis, lower, upper, effort, velocity, damping) -> None:
        joint = self._joint(name, kind, parent, child, xyz, (0, 0, 0))
        ElementTree.SubElement(joint, "axis", xyz=numbers(*axis))
        limits = {"lower": lower, "upper": upper, "effort": effort, "velocity": velocity}
        ElementTree.SubElement(joint, "limit", {key: numbers(value) for key, value in limits.items()})
        ElementTree.SubElement(joint, "dynamics", damping=numbers(damping), friction="0")

    def _joint(self, name, kind, parent, child, xyz, rpy) -> ElementTree.Element:
        joint = ElementTree.SubElement(self.root, "joint", name=name, type=kind)
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=child)
        ElementTree.SubElement(joint, "origin", xyz=numbers(*xyz), rpy=numbers(*rpy))
        return joint

    def text(self) -> str:
        ElementTree.indent(self.root)
        note = "<!-- Written by tools/make_vinebot.py: change it there. SI units, REP-103 axes. -->"
        body = ElementTree.tostring(self.root, encoding="unicode")
        return f'<?xml version="1.0"?>\n{note}\n{body}\n'


def numbers(*values: float) -> str:
    """Numbers as URDF writes them, to twelve digits; what is left of a sum that should be zero is written as 0."""
    return " ".join(f"{value:.12g}" if abs(value) > ROUNDING_ERROR else "0" for value in values)


def vinebot() -> str:
    """The whole URDF as text."""
    urdf = Urdf("vinebot")
    base(urdf)
    torso(urdf)
    head(urdf)
    for side, mirror in (("left", 1.0), ("right", -1.0)):
        arm(urdf, side, mirror)
        gripper(urdf, side, mirror)
    hardware(urdf)
    return urdf.text()


def base(urdf: Urdf) -> None:
    """Two rubber tracks, 0.80 m long and 0.70 m apart over all, and the body between them."""
    urdf.link("base_footprint")
    tracks = []
    for y in (0.28, -0.28):
        tracks.append(box((0.56, 0.14, 0.24), (0, y, 0.02), colour="rubber"))
        for x in (0.28, -0.28):
            tracks.append(cylinder(0.12, 0.14, (x, y, 0.02), ACROSS, colour="rubber"))
            tracks.append(cylinder(0.07, 0.146, (x, y, 0.02), ACROSS, colour="steel", solid=False))
        for x in (-0.11, 0.0, 0.11):
            tracks.append(cylinder(0.045, 0.146, (x, y, -0.03), ACROSS, colour="grey", solid=False))
        tracks.append(box((0.62, 0.15, 0.014), (0, y, 0.158), colour="white", solid=False))
        tracks.append(box((0.44, 0.144, 0.03), (0, y, 0.055), colour="dark", solid=False))
        tracks += lugs(y, 0.02, 0.28, 0.12, 0.136)
        for x in (0.28, -0.28):
            tracks.append(cylinder(0.025, 0.152, (x, y, 0.02), ACROSS, colour="dark", solid=False))
    body = (
        box((0.64, 0.42, 0.24), (0, 0, 0.12), colour="white"),
        cylinder(0.12, 0.42, (0.32, 0, 0.12), ACROSS, colour="white"),
        cylinder(0.12, 0.42, (-0.32, 0, 0.12), ACROSS, colour="white"),
        box((0.60, 0.43, 0.03), (0, 0, 0.155), colour="red", solid=False),
        box((0.02, 0.30, 0.05), (0.435, 0, 0.12), colour="glass", solid=False),
        cylinder(0.035, 0.014, (-0.36, 0.15, 0.247), colour="yellow", solid=False),
        cylinder(0.020, 0.03, (-0.36, 0.15, 0.262), colour="red", solid=False),
        *beacon(-0.40, -0.15, 0.24),
        *(cylinder(0.022, 0.012, (0.436, y, 0.165), ALONG, colour="lamp_white", solid=False) for y in (0.17, -0.17)),
        *(box((0.010, 0.05, 0.02), (-0.437, y, 0.14), colour="lamp_red", solid=False) for y in (0.16, -0.16)),
        box((0.012, 0.36, 0.03), (0.424, 0, 0.055), colour="rubber", solid=False),
        box((0.012, 0.36, 0.03), (-0.424, 0, 0.055), colour="rubber", solid=False),
        # seams, vents and bolts on the deck
        *(box((0.004, 0.40, 0.002), (x, 0, 0.2405), colour="dark", solid=False) for x in (0.29, -0.06)),
        *(box((0.05, 0.006, 0.002), (0.20, 0.11 + 0.016 * k, 0.2405), colour="dark", solid=False) for k in range(5)),
        *(
            cylinder(0.006, 0.004, (x, y, 0.241), colour="steel", solid=False)
            for x in (0.27, -0.04)
            for y in (0.19, -0.19)
        ),
    )
    urdf.link("base_link", (*body, *tracks), mass=140.0)
    urdf.fix("base_link", "base_footprint", (0, 0, 0.12))

    urdf.link("base_imu_link")
    urdf.fix("base_imu_link", "base_link", (0, 0, 0.10))

    lidar = (
        cylinder(0.02, 0.08, (0, 0, -0.075), colour="dark"),
        cylinder(0.05, 0.07, colour="dark"),
        cylinder(0.051, 0.036, (0, 0, 0.003), colour="glass", solid=False),
        cylinder(0.0515, 0.004, (0, 0, -0.026), colour="steel", solid=False),
    )
    urdf.link("base_lidar_link", lidar, mass=0.9)
    urdf.fix("base_lidar_link", "base_link", (0.33, 0, 0.355))

    tray = (
        box((0.34, 0.50, 0.012), (0, 0, 0), colour="grey"),
        box((0.012, 0.50, 0.05), (-0.17, 0, 0.02), colour="grey"),
    )
    urdf.link("base_tray_link", tray, mass=3.5)
    urdf.fix("base_tray_link", "base_link", (-0.28, 0, 0.25))


def torso(urdf: Urdf) -> None:
    """A column with a lift of 0.45 m, and the shoulders' yoke on it."""
    column = (
        box((0.20, 0.22, 0.46), (0, 0, 0.23), colour="dark"),
        cylinder(0.11, 0.46, (0.10, 0, 0.23), colour="dark"),
        box((0.012, 0.05, 0.34), (0.206, 0, 0.24), colour="red", solid=False),
        # the shell about the column, and the bellows out of which the lift comes
        cylinder(0.113, 0.020, (0.10, 0, 0.02), colour="grey", solid=False),
        cylinder(0.113, 0.016, (0.10, 0, 0.452), colour="grey", solid=False),
        *(cylinder(0.098, 0.007, (0.02, 0, 0.466 + 0.014 * k), colour="rubber", solid=False) for k in range(4)),
    )
    urdf.link("torso_fixed_link", column, mass=18.0)
    urdf.fix("torso_fixed_link", "base_link", (0, 0, 0.24))

    yoke = (
        cylinder(0.085, 0.50, (0, 0, -0.20), colour="white"),
        box((0.16, 0.20, 0.20), (0.02, 0, 0.05), colour="white"),
        cylinder(0.08, 0.32, (0.05, 0, 0.08), ACROSS, colour="white"),
        cylinder(0.045, 0.06, (0.02, 0, 0.18), colour="dark"),
        box((0.012, 0.16, 0.03), (0.126, 0, 0.075), colour="red", solid=False),
        box((0.010, 0.030, 0.012), (0.128, 0.0, 0.035), colour="lamp_green", solid=False),
        *(cylinder(0.083, 0.012, (0.05, y, 0.08), ACROSS, colour="grey", solid=False) for y in (0.155, -0.155)),
        box((0.05, 0.12, 0.12), (-0.07, 0, 0.06), colour="dark", solid=False),
    )
    urdf.link("torso_lift_link", yoke, mass=14.0)
    # A ball-screw column: its effort carries arms and yoke (45 kg) twice over, its speed is a linear actuator's.
    urdf.move(
        "torso_lift_joint",
        "prismatic",
        "torso_fixed_link",
        "torso_lift_link",
        xyz=(0.02, 0, 0.59),
        axis=(0, 0, 1),
        lower=0.0,
        upper=0.45,
        effort=1500.0,
        velocity=0.15,
        damping=50.0,
    )


def head(urdf: Urdf) -> None:
    """Pan, tilt, and an RGB-D camera; frames named as a RealSense driver names them."""
    neck = (cylinder(0.05, 0.06, (0, 0, 0.03), colour="dark"), box((0.06, 0.10, 0.06), (0, 0, 0.08), colour="white"))
    urdf.link("head_1_link", neck, mass=1.2)
    urdf.move(
        "head_1_joint",
        "revolute",
        "torso_lift_link",
        "head_1_link",
        xyz=(0.02, 0, 0.21),
        axis=(0, 0, 1),
        lower=-1.3,
        upper=1.3,
        effort=8.0,
        velocity=2.0,
        damping=0.2,
    )
    face = (
        box((0.10, 0.16, 0.09), (0.02, 0, 0.05), colour="white"),
        cylinder(0.045, 0.16, (0.07, 0, 0.05), ACROSS, colour="white"),
        box((0.006, 0.15, 0.05), (0.113, 0, 0.05), colour="glass", solid=False),
        *(cylinder(0.017, 0.006, (0.117, y, 0.05), ALONG, colour="dark", solid=False) for y in (0.04, -0.04)),
        *(cylinder(0.010, 0.004, (0.121, y, 0.05), ALONG, colour="lamp_white", solid=False) for y in (0.04, -0.04)),
        *(cylinder(0.030, 0.012, (0.03, y, 0.05), ACROSS, colour="dark", solid=False) for y in (0.084, -0.084)),
        *(cylinder(0.022, 0.014, (0.03, y, 0.05), ACROSS, colour="grey", solid=False) for y in (0.084, -0.084)),
    )
    urdf.link("head_2_link", face, mass=1.6)
    urdf.move(
        "head_2_joint",
        "revolute",
        "head_1_link",
        "head_2_link",
        xyz=(0, 0, 0.11),
        axis=(0, -1, 0),
        lower=-1.05,
        upper=0.79,
        effort=8.0,
        velocity=2.0,
        damping=0.2,
    )

    camera = (
        box((0.025, 0.09, 0.025), (-0.0125, 0, 0), colour="grey"),
        box((0.002, 0.08, 0.018), (0.001, 0, 0), colour="glass", solid=False),
        *(
            cylinder(0.006, 0.003, (0.0015, y, 0), ALONG, colour="grey", solid=False)
            for y in (-0.030, -0.008, 0.012, 0.030)
        ),
        box((0.02, 0.02, 0.02), (-0.0125, 0, -0.02), colour="dark", solid=False),
    )
    urdf.link("head_front_camera_link", camera, mass=0.072)  # mass and size: Intel RealSense D435 data sheet
    urdf.fix("head_front_camera_link", "head_2_link", (0.10, 0, 0.115))
    optical = (-math.pi / 2, 0, -math.pi / 2)
    for eye in ("rgb", "depth"):
        urdf.link(f"head_front_camera_{eye}_frame")
        urdf.fix(f"head_front_camera_{eye}_frame", "head_front_camera_link", (0.003, 0, 0))  # just before the glass
        urdf.link(f"head_front_camera_{eye}_optical_frame")
        urdf.fix(f"head_front_camera_{eye}_optical_frame", f"head_front_camera_{eye}_frame", rpy=optical)


def limb(length: float, radius: float, start: float, colour: str) -> tuple[Piece, ...]:
    """A rounded tube hanging down from ``start`` below the joint, with a dark seam at either end."""
    top = (0, 0, -start)
    bottom = (0, 0, -start - length)
    middle = (0, 0, -start - 0.5 * length)
    seams = (cylinder(radius + 0.0015, 0.006, end, colour="dark", solid=False) for end in (top, bottom))
    tube = cylinder(radius, length, middle, colour=colour)
    return tube, sphere(radius, top, colour), sphere(radius, bottom, colour), *seams


def hub(radius: float, length: float) -> tuple[Piece, ...]:
    """A joint across the arm: a dark drum with a grey cap and a bolt circle on both sides."""
    cap = cylinder(0.78 * radius, length + 0.008, (0, 0, 0), ACROSS, colour="grey", solid=False)
    turns = [2.0 * math.pi * k / 6.0 for k in range(6)]
    bolts = (
        cylinder(
            0.004,
            length + 0.012,
            (0.6 * radius * math.cos(a), 0, 0.6 * radius * math.sin(a)),
            ACROSS,
            colour="dark",
            solid=False,
        )
        for a in turns
    )
    return cylinder(radius, length, (0, 0, 0), ACROSS, colour="dark"), cap, *bolts


def arm(urdf: Urdf, side: str, mirror: float) -> None:
    """Shoulder pitch, abduction, roll; elbow; forearm roll, wrist pitch, wrist yaw, as in a human arm.

    Positive angles raise the arm forwards, spread it outwards, and bend elbow and wrist forwards, on both sides alike.
    The universal joint at the wrist points the gripper without a singularity where it is straight.
    """
    name = f"arm_{side}_{{}}_link".format

    shoulder = (
        cylinder(0.07, 0.11, (0, mirror * 0.01, 0), ACROSS, colour="white"),
        cylinder(0.0715, 0.008, (0, mirror * 0.045, 0), ACROSS, colour="red", solid=False),
        cylinder(0.0715, 0.006, (0, mirror * -0.040, 0), ACROSS, colour="dark", solid=False),
    )
    urdf.link(name(1), shoulder, mass=3.2)
    urdf.link(name(2), (sphere(0.066, (0, 0, 0), "dark"), *limb(0.06, 0.055, 0.04, "white")), mass=3.4)
    urdf.link(name(3), limb(0.17, 0.050, 0.13, "white"), mass=2.8)
    urdf.link(name(4), (*hub(0.052, 0.115), *limb(0.09, 0.046, 0.05, "white")), mass=2.6)
    urdf.link(name(5), limb(0.13, 0.042, 0.17, "white"), mass=1.8)
    urdf.link(name(6), hub(0.040, 0.085), mass=1.0)
    wrist = (
        cylinder(0.036, 0.05, (0, 0, 0), ALONG, colour="grey"),
        cylinder(0.034, 0.03, (0, 0, -0.05), colour="grey"),
    )
    urdf.link(name(7), wrist, mass=0.8)

    # Efforts: each joint holds the outstretched arm with a 5 kg load with a factor of 1.5 to 2 to spare; speeds are
    # those of the joint modules of commercial arms of this size.
    rows = (
        # joint, axis, where, lower, upper, effort, velocity
        (1, (0, -1, 0), (0.06, mirror * 0.225, 0.10), -1.20, 2.90, 160.0, 1.9),
        (2, (mirror, 0, 0), (0, mirror * 0.085, 0), -0.15, 2.30, 160.0, 1.9),
        (3, (0, 0, mirror), (0, 0, 0), -2.00, 2.00, 90.0, 2.2),
        (4, (0, -1, 0), (0, 0, -0.36), -0.05, 2.45, 90.0, 2.2),
        (5, (0, 0, mirror), (0, 0, 0), -2.60, 2.60, 40.0, 2.8),
        (6, (0, -1, 0), (0, 0, -0.34), -1.50, 1.50, 40.0, 2.8),
        (7, (mirror, 0, 0), (0, 0, 0), -1.40, 1.40, 40.0, 2.8),
    )
    for number, axis, where, lower, upper, effort, velocity in rows:
        parent = name(number - 1) if number > 1 else "torso_lift_link"
        damping = 1.0 if number < 5 else 0.4
        urdf.move(
            f"arm_{side}_{number}_joint",
            "revolute",
            parent,
            name(number),
            where,
            axis,
            lower,
            upper,
            effort,
            velocity,
            damping,
        )


def gripper(urdf: Urdf, side: str, mirror: float) -> None:
    """Force-torque sensor, palm, two parallel fingers and a cutter above them; the tool's x axis points forwards."""
    prefix = f"gripper_{side}"
    urdf.link(f"wrist_{side}_ft_link", (cylinder(0.036, 0.028, (0, 0, -0.014), colour="steel"),), mass=0.25)
    urdf.fix(f"wrist_{side}_ft_link", f"arm_{side}_7_link", (0, 0, -0.065))
    # x forwards out of the palm, y from the right to the left finger, z up when the gripper is level
    urdf.link(
        f"{prefix}_base_link",
        (
            box((0.05, 0.15, 0.06), (0.035, 0, 0), colour="dark"),
            cylinder(0.04, 0.02, (0.008, 0, 0), ALONG, colour="dark"),
            box((0.04, 0.152, 0.012), (0.035, 0, 0.015), colour="red", solid=False),
            cylinder(0.006, 0.152, (0.052, 0, 0.024), ACROSS, colour="steel", solid=False),
            cylinder(0.006, 0.152, (0.052, 0, -0.024), ACROSS, colour="steel", solid=False),
            box((0.004, 0.02, 0.008), (0.061, 0, 0.0), colour="glass", solid=False),
        ),
        mass=0.75,
    )
    urdf.fix(f"{prefix}_base_link", f"wrist_{side}_ft_link", (0, 0, -0.028), (0, math.pi / 2, 0))
    for finger, outward in (("left", 1.0), ("right", -1.0)):
        # two faces that slope towards each other: a round thing comes to rest between them and cannot slide out ahead;
        # they reach down to where a bunch that is held below its upper end is thickest
        slope = math.radians(20.0)
        face = 0.0287
        deep = 0.008
        back = 0.5 * (face * math.sin(slope) + deep * math.cos(slope))
        aside = 0.5 * deep * math.sin(slope)
        pad = (
            box((face, deep, 0.06), (0.0515 - aside, outward * back, -0.015), (0, 0, outward * slope), colour="rubber"),
            box(
                (face, deep, 0.06), (0.0785 + aside, outward * back, -0.015), (0, 0, -outward * slope), colour="rubber"
            ),
            box((0.092, 0.008, 0.02), (0.046, outward * 0.020, 0), colour="steel"),
            box((0.01, 0.02, 0.02), (0.01, outward * 0.014, 0), colour="steel", solid=False),
        )
        urdf.link(f"{prefix}_{finger}_finger_link", pad, mass=0.12)
        urdf.move(
            f"{prefix}_{finger}_finger_joint",
            "prismatic",
            f"{prefix}_base_link",
            f"{prefix}_{finger}_finger_link",
            xyz=(0.06, 0, 0),
            axis=(0, outward, 0),
            lower=0.0,
            upper=0.075,
            effort=60.0,
            velocity=0.10,
            damping=5.0,
        )
    urdf.link(f"{prefix}_grasping_link")
    urdf.fix(f"{prefix}_grasping_link", f"{prefix}_base_link", (0.125, 0, 0))
    # Two prongs above the fingers, between which the stalk comes to stand while they hold the bunch by its thickest
    # part; the link's origin is the middle of the mouth.
    reach = (box((0.114, 0.006, 0.006), (-0.032, side * 0.023, 0), colour="red") for side in (1.0, -1.0))
    cutter = (box((0.03, 0.06, 0.046), (-0.09, 0, -0.02), colour="dark"), *reach)
    urdf.link(f"{prefix}_cutter_link", cutter, mass=0.15)
    urdf.fix(f"{prefix}_cutter_link", f"{prefix}_base_link", (0.125, 0, 0.072))


def hardware(urdf: Urdf) -> None:
    """The robot as hardware of ros2_control: all interfaces of all joints, by the topics of vinesim."""
    system = ElementTree.SubElement(urdf.root, "ros2_control", name="vinebot", type="system")
    given = ElementTree.SubElement(system, "hardware")
    ElementTree.SubElement(given, "plugin").text = "joint_state_topic_hardware_interface/JointStateTopicSystem"
    parameters = {
        "joint_commands_topic": "/robot_joint_commands",
        "joint_states_topic": "/robot_joint_states",
        "trigger_joint_command_threshold": "-1",  # a command in every cycle, also one that is reached
    }
    for name, value in parameters.items():
        ElementTree.SubElement(given, "param", name=name).text = value
    for joint in urdf.root.findall("joint"):
        if joint.get("type") != "fixed":
            commanded = ElementTree.SubElement(system, "joint", name=joint.get("name", ""))
            for kind in ("command", "state"):
                for quantity in ("position", "velocity", "effort"):
                    ElementTree.SubElement(commanded, f"{kind}_interface", name=quantity)


if __name__ == "__main__":
    TARGET.write_text(vinebot())
