"""Meshes of robots as plants touch them: by their convex hull."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.spatial

from tests.support.contact_scenes import bar, cane
from vinesim.scene.builder import assemble
from vinesim.scene.values import RobotSpec
from vinesim.world import Physics

CYLINDER = '<cylinder radius="0.03" length="0.6"/>'


def as_mesh(robot: RobotSpec, corners: np.ndarray) -> RobotSpec:
    """The bar with the hull of ``corners`` instead of its cylinder, as a mesh."""
    hull = scipy.spatial.ConvexHull(corners)
    triangles = corners[hull.simplices].astype(np.float32)
    urdf = robot.urdf.replace(CYLINDER, '<mesh filename="hull.stl"/>')
    return dataclasses.replace(robot, urdf=urdf, meshes={"hull.stl": triangles})


def sweep(robot: RobotSpec, seconds: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """Tip of a level cane [step, 3] m that the bar is driven against at 0.3 m/s, and in which steps it was touched."""
    physics = Physics(assemble([cane((0.0, 0.0, 1.0), pieces=8)]))
    physics.add_robot(robot)
    tips = []
    touched = []
    for step in range(round(seconds / physics.dt)):
        physics.rigid.command(robot.name, np.array([0.3 * step * physics.dt]), np.array([0.3]))
        physics.step()
        tips.append(physics.state.body_q[-1, :3].copy())
        touched.append(bool(physics.contacts))
    return np.array(tips), np.array(touched)


def driven_bar(at: tuple[float, float, float]) -> RobotSpec:
    return bar(at, stiffness=5000.0, damping=300.0)


def test_a_mesh_of_a_box_pushes_as_the_box_does() -> None:
    robot = driven_bar((0.7, -0.08, 0.95))
    box = dataclasses.replace(robot, urdf=robot.urdf.replace(CYLINDER, '<box size="0.06 0.06 0.6"/>'))
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    expected, touched = sweep(box)
    found, touched_by_mesh = sweep(as_mesh(robot, signs * [0.03, 0.03, 0.3]))
    assert touched.sum() > 20
    np.testing.assert_array_equal(touched_by_mesh, touched)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_a_wedge_touches_with_its_slope_and_not_with_its_box() -> None:
    """The cane lies within the box of the wedge from the start, 0.11 m before its slope along the way."""
    profile = ((-0.15, -0.1), (0.15, -0.1), (-0.15, 0.25))
    wedge = np.array([[x, y, z] for y, z in profile for x in (-0.1, 0.1)])
    _, touched = sweep(as_mesh(driven_bar((0.7, -0.05, 0.84)), wedge))
    assert touched.any()
    assert 0.3 * 0.01 * np.argmax(touched) == pytest.approx(0.11, abs=0.02)
