"""The vineyard as MJCF, for MuJoCo and programs that read its files."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

import numpy as np

from vinesim.core import frames
from vinesim.export.articulation import COLORS, HINGES, Capsule, Tie, Vineyard
from vinesim.export.xml_text import add, text
from vinesim.rigid.robot_mjcf import RobotDocument
from vinesim.scene.ids import Organ
from vinesim.scene.terrain import Terrain

TIE_REACH = 1.0
"""[m] Length of the tendons that replace ties. DERIVED: a tie that moves by d across a tendon lengthens it by d^2 / 2,
which is 5e-5 m for 1 cm."""

_Element = ElementTree.Element


def mjcf(vineyard: Vineyard, robots: Sequence[RobotDocument] = ()) -> _Element:
    """Returns the root of the MJCF document, with ``robots``.

    A ball joint becomes three hinges. A tie becomes three tendons, each an independent spring along one axis. Plants do
    not collide with each other. With robots there is a keyframe ``home``: the drawn shape, and the robots at rest.
    """
    root = _Element("mujoco", model=vineyard.name)
    add(root, "compiler", angle="radian", autolimits="true")
    add(
        root,
        "option",
        timestep=text(vineyard.timestep),
        gravity=text(0.0, 0.0, -vineyard.gravity),
        integrator="implicitfast",
        jacobian="sparse",
    )
    add(root, "size", memory=f"{64 + len(vineyard.links) // 8}M")
    _add_defaults(root, vineyard.friction)
    world = add(root, "worldbody")
    add(world, "light", pos="0 0 10", dir="0.3 0.2 -1", directional="true")
    if vineyard.terrain is None:
        add(world, "geom", name="ground", type="plane", size="0 0 1", class_="ground")
    else:
        _add_height_field(add(root, "asset"), world, vineyard.terrain)
    for piece in vineyard.fixed:
        add(world, "geom", name=piece.name, class_=piece.organ.name.lower(), **_shape(piece.capsule))
    _add_crates(world, vineyard)
    bodies = _add_links(world, vineyard)
    if vineyard.ties:
        tendons = add(root, "tendon")
        for tie in vineyard.ties:
            _add_tie(world, bodies[tie.link], tendons, tie)
    if robots:
        for robot in robots:
            robot.add_to(root)
        crates = [np.concatenate([one.pose[:3], frames.to_wxyz(one.pose[3:])]) for one in vineyard.crates]
        plants = np.zeros(len(HINGES) * len(vineyard.links))
        qpos = np.concatenate([*crates, plants, *(robot.qpos for robot in robots)])
        ctrl = np.concatenate([robot.ctrl for robot in robots])
        add(add(root, "keyframe"), "key", name="home", qpos=text(*qpos), ctrl=text(*ctrl))
    return root


def _add_height_field(assets: _Element, world: _Element, terrain: Terrain) -> None:
    """Add the uneven ground as a height field, whose cells MuJoCo divides into the same triangles as ``terrain``."""
    heights = terrain.nodes()
    low = float(heights.min())
    rise = max(float(heights.max()) - low, 1e-3)
    half = 0.5 * (np.array(terrain.end) - terrain.origin)
    add(
        assets,
        "hfield",
        name="ground",
        nrow=str(heights.shape[0]),
        ncol=str(heights.shape[1]),
        size=text(*half, rise, 1.0),
        # MJCF lists the rows from the highest y on
        elevation=text(*((heights[::-1] - low) / rise).ravel().tolist()),
    )
    middle = 0.5 * (np.array(terrain.end) + terrain.origin)
    add(world, "geom", name="ground", type="hfield", hfield="ground", pos=text(*middle, low), class_="ground")


def _add_defaults(root: _Element, friction: float) -> None:
    """Add the defaults of geoms: colours, and which geoms collide. MuJoCo lets geoms collide if ``contype`` of one and
    ``conaffinity`` of the other share a bit; its default is 1 for both, for robots that others add."""
    defaults = add(root, "default")
    add(defaults, "geom", friction=text(friction, 0.005, 0.0001))
    for organ, color in COLORS.items():
        one = add(defaults, "default", class_=organ.name.lower())
        options = {"rgba": text(*color)}
        if organ is Organ.LEAF:
            options |= {"type": "box", "contype": "0", "conaffinity": "0", "group": "1", "mass": "0"}
        elif organ not in (Organ.GROUND, Organ.BOX):
            options |= {"type": "capsule", "contype": "1", "conaffinity": "0", "mass": "0"}
        add(one, "geom", **options)
    one = add(defaults, "default", class_="tie")
    add(one, "site", size="0.001", group="4")
    add(one, "tendon", width="0.0005", group="4")


def _shape(capsule: Capsule) -> dict[str, str]:
    if capsule.is_sphere:
        return {"type": "sphere", "pos": text(*capsule.start), "size": text(capsule.radius)}
    return {"fromto": text(*capsule.start, *capsule.end), "size": text(capsule.radius)}


def _pose(pose: np.ndarray) -> dict[str, str]:
    return {"pos": text(*pose[:3]), "quat": text(*frames.to_wxyz(pose[3:]))}


def _add_crates(world: _Element, vineyard: Vineyard) -> None:
    for crate in vineyard.crates:
        body = add(world, "body", name=crate.name, **_pose(crate.pose))
        add(body, "freejoint", name=crate.name)
        for pose, half, mass in crate.walls:
            add(body, "geom", class_="box", type="box", **_pose(pose), size=text(*half), mass=text(mass))


def _add_links(world: _Element, vineyard: Vineyard) -> list[_Element]:
    """Add the plants. Returns the element of each link."""
    bodies: list[_Element] = []
    for link in vineyard.links:
        body = add(world if link.parent < 0 else bodies[link.parent], "body", name=link.name, **_pose(link.pose))
        bodies.append(body)
        products = link.inertia[[0, 0, 1], [1, 2, 2]]
        moments = np.diagonal(link.inertia)
        tensor = {"diaginertia": text(*moments)}
        if products.any():
            tensor = {"fullinertia": text(*moments, *products)}
        add(body, "inertial", pos=text(*link.com), mass=text(link.mass), **tensor)
        rows = zip(HINGES, link.axes, link.stiffness, link.damping, link.rest, strict=True)
        for hinge, axis, stiffness, damping, rest in rows:
            add(
                body,
                "joint",
                name=f"{link.name}_{hinge}",
                type="hinge",
                axis=text(*axis),
                stiffness=text(stiffness),
                damping=text(damping),
                springref=text(rest),
            )
        for capsule in link.capsules:
            add(body, "geom", class_=link.organ.name.lower(), **_shape(capsule))
        for leaf in link.leaves:
            add(body, "geom", class_="leaf", **_pose(leaf.pose), size=text(*leaf.size))
        for name, pose in link.buds:
            add(body, "site", name=name, **_pose(pose), size="0.003", group="4")
    return bodies


def _add_tie(world: _Element, body: _Element, tendons: _Element, tie: Tie) -> None:
    """Add a tie as three tendons of length :data:`TIE_REACH`. A tendon of length 0 would have no direction."""
    add(body, "site", name=tie.name, pos=text(*tie.point), class_="tie")
    for i in range(3):
        name = f"{tie.name}_{'xyz'[i]}"
        add(world, "site", name=name, pos=text(*(tie.anchor + TIE_REACH * tie.axes[i])), class_="tie")
        tendon = add(
            tendons,
            "spatial",
            name=name,
            class_="tie",
            springlength=text(TIE_REACH),
            stiffness=text(tie.stiffness[i]),
            damping=text(tie.damping[i]),
        )
        for site in (tie.name, name):
            add(tendon, "site", site=site)
