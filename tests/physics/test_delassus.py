"""The plants' part of the Delassus matrix, by groups of sides of contacts, against dense responses of the bodies."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.contact_scenes import cane
from vinesim.bench import scenes
from vinesim.contact.row_response import RowResponse
from vinesim.core import frames
from vinesim.kernels.contact import structs
from vinesim.kernels.contact.islands import MOST_SIDES
from vinesim.kernels.graph import KernelGraph
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.device_buffers import DeviceBuffers
from vinesim.scene.builder import RodMaterial, assemble
from vinesim.scene.state import State
from vinesim.world import Physics


def assembled(physics: Physics) -> np.ndarray:
    """[row, row] 1/kg: the matrices of all blocks of the last solve, by contacts."""
    solver = physics.contact_solver.impulses
    count = physics.contact_solver.count
    islands = solver.islands
    matrix = np.zeros((3 * count, 3 * count))
    for block in range(physics.contact_solver.detection.counters[structs.BLOCKS]):
        contacts = islands.contact[islands.block_start[block] : islands.block_start[block + 1]]
        pitch = islands.row_start[block + 1] - islands.row_start[block]
        rows = (3 * contacts[:, None] + np.arange(3)).ravel()
        entries = solver.rows.delassus[islands.matrix_start[block] :][: len(rows) * pitch].reshape(-1, pitch)
        matrix[np.ix_(rows, rows)] = entries[:, : len(rows)]
        assert (entries[:, len(rows) :] == 0.0).all()
    return matrix


def dense(physics: Physics, response: np.ndarray) -> np.ndarray:
    """The same J Y J^T from the ``response`` Y [n, 6, n, 6] of the bodies in contact."""
    solver = physics.contact_solver.impulses
    count = physics.contact_solver.count
    jacobian = np.zeros((3 * count, len(solver.bodies), 6))
    rows = solver.rows.plant_jacobian[: 3 * count]
    for contact in range(count):
        at = slice(3 * contact, 3 * contact + 3)
        for side, slots in enumerate((solver.contacts.body_slot, solver.contacts.other_slot)):
            if slots[contact] >= 0:
                jacobian[at, slots[contact]] += rows[at, 6 * side : 6 * side + 6]
    return np.einsum("rui,uitj,stj->rs", jacobian, response, jacobian)


def check(physics: Physics) -> int:
    """Compare both in one step; returns the largest number of sides on one tree."""
    response = np.zeros(0)
    for name, stage in physics.stages:
        stage()
        if name.endswith("solve all together"):
            response = physics.plants.impulse_response(physics.contact_solver.impulses.bodies)
    expected = dense(physics, response)
    found = assembled(physics)
    np.testing.assert_allclose(found, expected, atol=2e-6 * np.abs(expected).max())
    solver = physics.contact_solver
    count = physics.contact_solver.count
    sides = np.diff(solver.impulses.response.groups.start[: solver.detection.counters[structs.GROUPS] + 1])
    assert sides.max() <= MOST_SIDES
    return int(np.bincount(physics.model.body_tree[solver.impulses.contacts.body[:count]]).max())


def test_entries_are_those_of_dense_responses() -> None:
    """Canes between many bars: more rows on a tree than one group has."""
    physics = Physics(scenes.cane_row(3))
    physics.add_robot(scenes.combs("combs", 14, 3))
    for tick in range(40):
        physics.rigid.command("combs", np.full(2, min(0.0005 * tick, 0.005)))
        physics.step()
    assert check(physics) > MOST_SIDES


def test_entries_of_plants_on_plants_have_two_sides() -> None:
    """A cane that lies across two others: contacts with a side on either tree, all in one block."""
    lower = [cane((0.0, side, 1.0), radius=0.005) for side in (0.0, 0.3)]
    upper = cane((0.5, -0.9, 1.02), radius=0.004, heading=0.5 * np.pi)
    physics = Physics(assemble([*lower, upper]))
    physics.add_robot(scenes.bar("far", 40, 1))
    physics.plants.body_load[physics.model.bodies_of(2), 2] = -0.2
    scenes.keep_awake(physics, np.arange(3))
    while physics.contact_solver.count < 2:
        physics.step()
    check(physics)
    assert (physics.contact_solver.impulses.contacts.other_slot[: physics.contact_solver.count] >= 0).all()


@pytest.mark.parametrize("interleave", [0, 3])
def test_responses_are_those_of_bodies_wherever_kernels_find_them(interleave: int) -> None:
    """Random rows on three bodies of each of five trees, three of them forked, in any place of the buffers."""
    rng = np.random.default_rng(2)
    trees = [cane((0.0, float(i), 1.0), pieces=4 + i) for i in range(5)]
    for tree in trees[::2]:
        tree.add_rod(1, 0.3, (0.003, 0.002), RodMaterial(5e9, 800.0, 0.01), 3)
    model = assemble(trees)
    state = State.at_rest(model)
    state.joint_q[:] = frames.exp(0.2 * rng.normal(size=(len(model.body_mass), 3)))
    plants = ArticulationSolver(model, state, buffers=DeviceBuffers("cpu", interleave))
    plants.wake(np.arange(5))
    plants.predict()
    bodies = np.sort(
        np.concatenate([rng.choice(np.flatnonzero(model.body_tree == tree), 3, replace=False) for tree in range(5)])
    )
    counters = np.zeros(structs.COUNTERS, np.int32)
    counters[structs.GROUPS] = 5
    response = RowResponse(plants, len(bodies), counters)
    sides = np.arange(len(bodies))
    response.body[: len(bodies)], response.body_slot[:], response.other_slot[:] = bodies, sides, -1
    response.tree_end[: len(bodies)] = 3 * (sides // 3) + 3
    response.jacobian[:, :6] = rng.normal(size=(3 * len(bodies), 6))
    response.groups.side[: len(bodies)] = 2 * sides
    response.groups.start[:6] = 3 * np.arange(6)
    response.groups.tree[:5] = 3 * np.arange(5)
    width = 16
    response.groups.response[:5] = 3 * 6 * width * np.arange(5)
    KernelGraph(response.launch)()
    found = response.numbers[: 5 * 3 * 6 * width].reshape(5, 3, 6, width)
    expected = plants.impulse_response(bodies)
    for tree in range(5):
        of_tree = slice(3 * tree, 3 * tree + 3)
        rows = response.jacobian[9 * tree : 9 * tree + 9, :6].reshape(3, 3, 6)
        velocity = np.einsum("uitj,trj->uitr", expected[of_tree, :, of_tree], rows).reshape(3, 6, 9)
        np.testing.assert_allclose(found[tree, ..., :9], velocity, atol=2e-6 * np.abs(velocity).max())
        assert (found[tree, ..., 9:] == 0.0).all()
