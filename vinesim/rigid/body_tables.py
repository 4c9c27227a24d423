"""Tables of a compiled MuJoCo world: what sensors draw, and which actor owns which body."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from vinesim.rigid.free_bunch import FreeBunch
from vinesim.rigid.human_body import HumanBody
from vinesim.rigid.human_posture import VISUAL_PARTS
from vinesim.rigid.human_shapes import BODY_PARTS, SIDES
from vinesim.rigid.recompile import WorldNames
from vinesim.rigid.robot_body import RobotBody
from vinesim.scene import appearance
from vinesim.scene.ids import Organ
from vinesim.scene.values import RigidBox, RigidVisual


def list_visuals(
    boxes: Mapping[int, RigidBox],
    names: WorldNames,
    robots: Mapping[str, RobotBody],
    humans: Mapping[str, HumanBody],
    bunches: Mapping[int, tuple[FreeBunch, int]],
) -> tuple[tuple[RigidVisual, ...], np.ndarray]:
    """All rigid bodies that have a shape and their MuJoCo bodies [visual]; 0 for parts that are placed by posture.

    ``bunches`` gives the shapes and the MuJoCo body of every free bunch.
    """
    visuals = []
    bodies = []
    for number, box in boxes.items():
        length, width, height = map(float, box.size)
        shapes = appearance.crate_shapes((length, width, height), number)
        visuals.append(RigidVisual(f"box/{number}", Organ.BOX, number, shapes))
        bodies.append(names.body[f"box/{number}"])
    for name, robot in robots.items():
        for link, shapes in robot.shown_shapes.items():
            if shapes:
                visuals.append(RigidVisual(f"{name}/{link}", Organ.ROBOT, robot.spec.index, shapes))
                bodies.append(robot.bodies[link])
    shears = {f"{side}_{part}": shapes for side in SIDES for part, shapes in appearance.load_shears().parts.items()}
    for name, human in humans.items():
        shapes_of_part = human.looks.parts | shears
        simulated = [(part, human.bodies[part]) for part in (*BODY_PARTS, *(hand.link for hand in human.hands))]
        for part, body in (*simulated, *((part, 0) for part in (*VISUAL_PARTS, *human.shears_parts))):
            visuals.append(RigidVisual(f"{name}/{part}", Organ.HUMAN, human.spec.index, shapes_of_part[part]))
            bodies.append(body)
    for bunch, (free_bunch, body) in bunches.items():
        visuals.append(RigidVisual(f"bunch/{bunch}", Organ.BUNCH, bunch, free_bunch.shapes))
        bodies.append(body)
    return tuple(visuals), np.array(bodies, int)


def list_owners(
    boxes: Collection[int],
    names: WorldNames,
    robots: Mapping[str, RobotBody],
    humans: Mapping[str, HumanBody],
    bunch_body: Mapping[int, int],
) -> dict[int, tuple[str, str]]:
    """By MuJoCo body: actor and link of everything that can be added, removed or moved."""
    owners = {names.body[f"box/{i}"]: (f"box/{i}", "box") for i in boxes}
    actors: dict[str, RobotBody | HumanBody] = {**robots, **humans}
    for name, actor in actors.items():
        owners.update({body: (name, link) for link, body in actor.bodies.items()})
    owners.update({body: (f"bunch/{i}", "bunch") for i, body in bunch_body.items()})
    return owners
