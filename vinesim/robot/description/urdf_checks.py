"""Checks of a parsed URDF: one kinematic tree, joints with limits, bodies with mass and inertia."""

from __future__ import annotations

import math
import pathlib

import numpy as np

from vinesim.robot.description.errors import description_error
from vinesim.robot.description.kinematics import joint_limits
from vinesim.robot.description.urdf_model import Joint, Robot
from vinesim.robot.description.urdf_reader import MOVABLE_JOINT_TYPES


def check_tree(robot: Robot, file: pathlib.Path) -> tuple[str, list[Joint]]:
    """The root link, and the joints from it outwards; :class:`DescriptionError` if they are not one tree."""
    links = {link.name for link in robot.links}
    for kind, elements in (("link", robot.links), ("joint", robot.joints)):
        names = [element.name for element in elements]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise description_error(file, f"{kind} {twice[0]!r} is there twice", "rename one")
    if "world" in links:
        raise description_error(
            file,
            "a link called 'world' is not the root",
            "rename it, or make it the root to bolt the robot down",
        )
    if not robot.links:
        raise description_error(file, "no links", "give a robot with at least one link")
    parent_of: dict[str, Joint] = {}
    children: dict[str, list[Joint]] = {}
    for joint in robot.joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise description_error(
                    file, f"joint {joint.name!r} names a link {link!r} that is not there", "add it or rename"
                )
        if joint.child in parent_of:
            other = parent_of[joint.child].name
            raise description_error(
                file,
                f"link {joint.child!r} has two parents (joints {other!r} and {joint.name!r})",
                "URDF is a tree: open the loop by removing one joint",
            )
        parent_of[joint.child] = joint
        children.setdefault(joint.parent, []).append(joint)
    roots = [link.name for link in robot.links if link.name not in parent_of]
    if len(roots) > 1:
        raise description_error(
            file, f"links {roots[0]!r} and {roots[1]!r} both have no parent", "join them with a fixed joint"
        )
    order: list[Joint] = []
    waiting = list(children.get(roots[0], [])) if roots else []
    while waiting:
        joint = waiting.pop(0)
        order.append(joint)
        waiting.extend(children.get(joint.child, []))
    if not roots or len(order) < len(robot.joints):
        reached = {joint.name for joint in order}
        lost = next(joint.name for joint in robot.joints if joint.name not in reached)
        raise description_error(
            file, f"joint {lost!r} is part of a kinematic loop", "URDF is a tree: remove one joint of the loop"
        )
    return roots[0], order


def check_joints(robot: Robot, file: pathlib.Path) -> None:
    """Raise :class:`DescriptionError` unless types, axes, limits and mimics of all joints can be simulated."""
    names = {joint.name: joint for joint in robot.joints}
    for joint in robot.joints:
        where = f"joint {joint.name!r}"
        if joint.type not in (*MOVABLE_JOINT_TYPES, "fixed"):
            raise description_error(
                file, f"{where} has the type {joint.type!r}", f"use one of fixed, {', '.join(MOVABLE_JOINT_TYPES)}"
            )
        if joint.type == "fixed":
            continue
        if not np.linalg.norm(joint.axis) > 1e-9:
            raise description_error(file, f"{where} has a zero axis", "give a direction")
        if joint.mimic is not None:
            source = names.get(joint.mimic.joint)
            if source is None or source.type not in MOVABLE_JOINT_TYPES or source.mimic is not None:
                raise description_error(
                    file, f"{where} mimics {joint.mimic.joint!r}", "let it mimic a joint that is driven itself"
                )
            continue
        limit = joint.limit
        needed = ("effort", "velocity") + (() if joint.type == "continuous" else ("lower", "upper"))
        missing = [key for key in needed if limit is None or getattr(limit, key) is None]
        if missing:
            raise description_error(file, f"{where} moves without limits", f"give <limit> with {', '.join(missing)}")
        limits = joint_limits(joint)
        if limits.effort <= 0.0 or limits.velocity <= 0.0:
            raise description_error(
                file, f"{where} has effort {limits.effort:g} and velocity {limits.velocity:g}", "give both above 0"
            )
        if joint.type != "continuous" and not limits.lower < limits.upper:
            raise description_error(
                file, f"{where} has limits {limits.lower:g} to {limits.upper:g}", "give lower below upper"
            )


def check_masses(robot: Robot, file: pathlib.Path, notes: list[str]) -> None:
    """Raise :class:`DescriptionError` unless masses are not negative and every inertia is positive definite.

    Inertias that violate the triangle inequality are added to ``notes``.
    """
    lopsided = []
    for link in robot.links:
        inertial = link.inertial
        if inertial is None or inertial.mass is None:
            continue
        mass = inertial.mass
        inertia = inertial.inertia
        if mass < 0.0 or not math.isfinite(mass):
            raise description_error(file, f"link {link.name!r} has a mass of {mass:g} kg", "give it its mass")
        if inertia is not None and mass > 0.0:
            moments = np.linalg.eigvalsh(inertia)
            if moments[0] <= 0.0 and moments[2] > 0.0:
                raise description_error(
                    file,
                    f"link {link.name!r} has principal moments {', '.join(f'{m:.2g}' for m in moments)} kg m2",
                    "give an inertia that is positive definite",
                )
            if moments[0] + moments[1] < moments[2] * (1.0 - 1e-6):
                lopsided.append(link.name)
    if lopsided:
        notes.append(f"{len(lopsided)} inertias no real body has (triangle inequality), first {lopsided[0]!r}")
