"""Write ``data/robots/logistic.urdf``: python tools/make_logistic.py

A tracked carrier for picking boxes, with a clamp on a lift at either end: it comes with an empty box, takes a full one
and leaves the other in its place. Dimensions and masses are a design of our own, for boxes of 0.6 m x 0.4 m.
"""

from __future__ import annotations

import math
import pathlib

from make_vinebot import ACROSS, ALONG, Urdf, beacon, box, cylinder, lugs

TARGET = pathlib.Path(__file__).resolve().parent.parent / "data" / "robots" / "logistic.urdf"

CLAMP = 0.65
"""From the middle of the base to the middle of a clamped box [m]."""
HALF = 0.28
"""Half of the gap between closed paddles [m]."""
GRASP = 0.13
"""Height of the paddles' middle with the lift down [m]: about half of a box."""


def logistic() -> str:
    """The whole URDF as text."""
    urdf = Urdf("logistic")
    urdf.link("base_footprint")
    tracks = []
    for y in (0.24, -0.24):
        tracks.append(box((0.52, 0.12, 0.20), (0, y, 0), colour="rubber"))
        for x in (0.26, -0.26):
            tracks.append(cylinder(0.10, 0.12, (x, y, 0), ACROSS, colour="rubber"))
            tracks.append(cylinder(0.06, 0.126, (x, y, 0), ACROSS, colour="steel", solid=False))
            tracks.append(cylinder(0.022, 0.132, (x, y, 0), ACROSS, colour="dark", solid=False))
        for x in (-0.11, 0.0, 0.11):
            tracks.append(cylinder(0.036, 0.126, (x, y, -0.045), ACROSS, colour="grey", solid=False))
        tracks.append(box((0.40, 0.124, 0.025), (0, y, 0.03), colour="dark", solid=False))
        tracks += lugs(y, 0.0, 0.26, 0.10, 0.116)
    body = (
        box((0.70, 0.36, 0.26), (0, 0, 0.06), colour="white"),
        box((0.64, 0.37, 0.03), (0, 0, 0.10), colour="red", solid=False),
        box((0.56, 0.30, 0.016), (0, 0, 0.196), colour="grey", solid=False),
        *(box((0.54, 0.010, 0.006), (0, 0.03 * k, 0.206), colour="dark", solid=False) for k in range(-4, 5)),
        *(cylinder(0.018, 0.010, (0.352, y, 0.02), ALONG, colour="lamp_white", solid=False) for y in (0.13, -0.13)),
        *(box((0.008, 0.05, 0.02), (-0.352, y, 0.02), colour="lamp_red", solid=False) for y in (0.13, -0.13)),
        cylinder(0.028, 0.012, (-0.29, 0.16, 0.194), colour="yellow", solid=False),
        cylinder(0.016, 0.026, (-0.29, 0.16, 0.208), colour="red", solid=False),
        *beacon(-0.30, -0.16, 0.19),
    )
    urdf.link("base_link", (*body, *tracks), mass=120.0)
    urdf.fix("base_link", "base_footprint", (0, 0, 0.10))
    urdf.link("base_imu_link")
    urdf.fix("base_imu_link", "base_link", (0, 0, 0.10))
    eye(urdf)
    for end, way in (("front", 1.0), ("rear", -1.0)):
        clamp(urdf, end, way)
    return urdf.text().replace("make_vinebot.py", "make_logistic.py")


def eye(urdf: Urdf) -> None:
    """A camera above the front lift, for what the clamp holds; frames named as a RealSense driver names them."""
    camera = (
        box((0.025, 0.09, 0.025), colour="grey"),
        box((0.002, 0.08, 0.018), (0.0125, 0, 0), colour="glass", solid=False),
        box((0.012, 0.012, 0.06), (-0.016, 0, -0.03), colour="dark", solid=False),
    )
    urdf.link("front_camera_link", camera, mass=0.072)  # RealSense D435 data sheet
    urdf.fix("front_camera_link", "base_link", (0.38, 0, 0.54), (0, 0.75, 0))
    urdf.link("front_camera_rgb_optical_frame")
    urdf.fix("front_camera_rgb_optical_frame", "front_camera_link", (0.014, 0, 0), (-math.pi / 2, 0, -math.pi / 2))


def clamp(urdf: Urdf, end: str, way: float) -> None:
    """A lift with a cross beam, and two paddles that slide along it and press a box between them."""
    mast = (
        box((0.04, 0.30, 0.50), (0, 0, 0.25), colour="dark"),
        *(box((0.046, 0.03, 0.50), (0, y, 0.25), colour="white", solid=False) for y in (0.136, -0.136)),
        *(cylinder(0.008, 0.48, (way * 0.024, y, 0.25), colour="steel", solid=False) for y in (0.09, -0.09)),
        box((0.044, 0.14, 0.05), (0, 0, 0.44), colour="red", solid=False),
    )
    urdf.link(f"mast_{end}_link", mast, mass=8.0)
    urdf.fix(f"mast_{end}_link", "base_link", (way * 0.37, 0, 0.0))
    beam = box((0.03, 0.70, 0.06), (0, 0, 0), colour="grey")
    urdf.link(f"lift_{end}_link", (beam,), mass=6.0)
    urdf.move(
        f"lift_{end}_joint",
        "prismatic",
        f"mast_{end}_link",
        f"lift_{end}_link",
        xyz=(way * 0.035, 0, GRASP - 0.10),
        axis=(0, 0, 1),
        lower=0.0,
        upper=0.30,
        effort=800.0,
        velocity=0.15,
        damping=50.0,
    )
    urdf.link(f"clamp_{end}_link")
    urdf.fix(f"clamp_{end}_link", f"lift_{end}_link", (way * (CLAMP - 0.405), 0, 0))
    for side, outward in (("left", 1.0), ("right", -1.0)):
        paddle = (
            box((0.36, 0.02, 0.06), (way * 0.20, outward * 0.015, 0), colour="steel"),
            box((0.24, 0.01, 0.12), (way * (CLAMP - 0.405), outward * 0.005, 0), colour="rubber"),
        )
        urdf.link(f"paddle_{end}_{side}_link", paddle, mass=1.5)
        urdf.move(
            f"paddle_{end}_{side}_joint",
            "prismatic",
            f"lift_{end}_link",
            f"paddle_{end}_{side}_link",
            xyz=(0, outward * HALF, 0),
            axis=(0, outward, 0),
            lower=0.0,
            upper=0.09,
            effort=300.0,
            velocity=0.10,
            damping=50.0,
        )


if __name__ == "__main__":
    TARGET.write_text(logistic())
