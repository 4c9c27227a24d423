"""The law of contacts: its derivative, and the two solvers that call it, on the same contacts."""

from __future__ import annotations

import pathlib
import sys

import numpy as np
import pytest
import warp as wp

from tests.physics.test_batch_contacts import canes, moving
from tests.physics.test_delassus import assembled
from vinesim.core.warp_arrays import SharedArrays, share, zeros
from vinesim.kernels.contact.friction_law import (
    Steps,
    Surface,
    linearise_sliding,
    project_into_cone,
    steps_of,
)
from vinesim.kernels.worlds import contact_step
from vinesim.kernels.worlds.dense_solver import WorldSearch, WorldSystem, end_growth, solve_world, update_velocities
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.world import Physics

wp.set_module_options({"enable_backward": False})

TOLERANCE = 1e-10
"""[1] of both solvers."""
MOST_SWEEPS = wp.constant(400)
NEWTON_STEPS = wp.constant(6)


@wp.kernel
def solve_one_tree(count: int, tolerance: wp.float64, system: WorldSystem, search: WorldSearch):
    update_velocities(0, 1, 3 * count, system)
    _sweeps, _busy = solve_world(0, 0, 1, count, MOST_SWEEPS, NEWTON_STEPS, tolerance, system, search)


def solve_as_in_a_batch(matrix: np.ndarray, free: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """[row] N s, impulses of the contacts of one tree, from none.

    The matrix of an island is symmetric to the rounding of single precision; this solver reads columns where that one
    reads rows.
    """
    rows = len(free)
    assert (matrix.astype(np.float32) == matrix).all()
    system = SharedArrays.zeros(
        WorldSystem, rows, matrix=np.ascontiguousarray(matrix.T, np.float32), free=free, surface=surface
    )
    search = SharedArrays.zeros(WorldSearch, rows, factor=np.zeros((rows, rows + 1)))
    wp.launch(solve_one_tree, 1, [rows // 3, TOLERANCE, system.struct, search.struct], device="cpu")
    return system.impulse


def test_batches_and_islands_find_the_same_impulses() -> None:
    """Canes fall on bars: contacts that stick, slide and open, each tree an island of its own.

    A solver ends where a sweep changes nothing by more than 1e-10 of the largest impulse; they agree within 1e-8 of it.
    """
    model = canes(3)
    parameters = PhysicsParameters(sleep=False, solver_sweeps=int(MOST_SWEEPS), solver_tolerance=TOLERANCE)
    physics = Physics(model, parameters=parameters)
    physics.contact_solver.plant_plant_contacts = False
    physics.state.joint_qd[:] = moving(model).joint_qd
    physics.wake(np.arange(3))
    solver = physics.contact_solver.impulses
    open_ones = 0
    sliding = 0
    sticking = 0
    for _ in range(60):
        physics.step()
        count = physics.contact_solver.count
        if count == 0:
            continue
        matrix = assembled(physics)
        free = solver.rows.velocity_free[: 3 * count] + solver.rows.bias[: 3 * count]
        tree = model.body_tree[solver.contacts.body[:count]]
        for which in np.unique(tree):
            contacts = np.flatnonzero(tree == which)
            rows = (3 * contacts[:, None] + np.arange(3)).ravel()
            surface = solver.contacts.surface[contacts]
            theirs = solver.rows.impulse[rows]
            ours = solve_as_in_a_batch(matrix[np.ix_(rows, rows)], free[rows], surface)
            np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-8 * np.abs(theirs).max() + 1e-12)
            normal, *friction = theirs.reshape(-1, 3).T
            share = np.hypot(*friction)[normal > 0.0] / (surface["friction"] * normal)[normal > 0.0]
            open_ones += int((normal == 0.0).sum())
            sliding += int((share > 0.999).sum())
            sticking += int((share < 0.999).sum())
    assert min(open_ones, sliding, sticking) > 5


@wp.kernel
def stop_early(count: int, system: WorldSystem, search: WorldSearch):
    update_velocities(0, 1, 3 * count, system)
    _sweeps, busy = solve_world(0, 0, 1, count, 2, NEWTON_STEPS, wp.float64(TOLERANCE), system, search)
    if busy:
        end_growth(0, 1, 3 * count, system)


def test_impulses_of_a_batch_that_did_not_converge_add_no_energy() -> None:
    """The work of the impulses x with the velocities r that they leave, compliance included, is x . r <= 0, also from a
    first guess far from the solution, while impulses stay in their friction cones."""
    rng = np.random.default_rng(1)
    scaled = 0
    for _ in range(50):
        count = int(rng.integers(2, 6))
        rows = 3 * count
        responses = rng.normal(size=(rows, 4)) * rng.lognormal(0.0, 2.0, (rows, 1))
        matrix = (responses @ responses.T + 0.01 * np.eye(rows)).astype(np.float32).astype(float)
        free = rng.normal(size=rows)
        guess = np.abs(rng.normal(size=rows)) * (np.arange(rows) % 3 == 0)
        surface = zeros(Surface, (count,))
        surface["friction"] = 0.5
        surface["compliance"] = 1e-3
        system = SharedArrays.zeros(
            WorldSystem, rows, matrix=matrix.astype(np.float32), free=free, surface=surface, impulse=guess
        )
        search = SharedArrays.zeros(WorldSearch, rows, factor=np.zeros((rows, rows + 1)))
        wp.launch(stop_early, 1, [count, system.struct, search.struct], device="cpu")
        x = system.impulse
        residual = free + matrix @ x
        np.testing.assert_allclose(system.velocity, residual, atol=1e-9 * np.abs(matrix).max())
        work = x @ (residual + 1e-3 * x)
        size = np.abs(x) @ np.abs(residual)
        assert work <= 1e-9 * size
        normal, *friction = x.reshape(-1, 3).T
        assert (np.hypot(*friction) <= 0.5 * normal + 1e-12).all()
        scaled += int(abs(work) <= 1e-9 * size and size > 0.0)
    assert scaled > 5


@wp.kernel
def evaluate(
    own: wp.mat33d,
    surface: wp.array(dtype=Surface),
    x: wp.array(dtype=wp.vec3d),
    residual: wp.array(dtype=wp.vec3d),
    steps_out: wp.array(dtype=Steps),
    friction_out: wp.array(dtype=wp.vec3d),
    turned_out: wp.array(dtype=wp.mat22d),
    pulled_out: wp.array(dtype=wp.vec2d),
):
    i = wp.tid()
    steps = steps_of(own)
    steps_out[0] = steps
    f = x[i] - residual[i] * steps.tangential
    friction_out[i] = project_into_cone(wp.vec3d(x[i][0], f[1], f[2]), surface[0])
    turned, pulled = linearise_sliding(x[i], residual[i], steps, surface[0])
    turned_out[i] = turned
    pulled_out[i] = pulled


def test_sliding_is_linearised_by_the_derivative_of_the_projection() -> None:
    """Against differences of the projection by each of x_n, x_u, x_v, r_u and r_v; and the friction itself, which is
    homogeneous: x_t = K (x_t - step r_t) + g x_n."""
    own = np.diag([3.0, 2.0, 5.0]) + 0.5
    x = np.array([0.02, 0.03, -0.01])
    residual = np.array([0.0, -0.2, 0.1])
    step = 1e-6
    given = np.tile(np.concatenate([x, residual]), (6, 1))
    for row, column in enumerate((0, 1, 2, 4, 5)):
        given[1 + row, column] += step
    surface = zeros(Surface, (1,))
    surface["friction"] = 0.7
    steps = zeros(Steps, (1,))
    friction = np.zeros((6, 3))
    turned = np.zeros((6, 2, 2))
    pulled = np.zeros((6, 2))
    arrays = [
        share(np.ascontiguousarray(data), dtype) for data, dtype in ((given[:, :3], wp.vec3d), (given[:, 3:], wp.vec3d))
    ]
    out = [share(steps, Steps), share(friction, wp.vec3d), share(turned, wp.mat22d), share(pulled, wp.vec2d)]
    wp.launch(evaluate, 6, [wp.mat33d(own), share(surface, Surface), *arrays, *out], device="cpu")
    tangential = 1.0 / np.linalg.eigvalsh(own[1:, 1:]).max()
    assert steps["normal"][0] == 1.0 / own[0, 0]
    np.testing.assert_allclose(steps["tangential"][0], tangential, rtol=1e-12)
    K = turned[0]
    g = pulled[0]
    np.testing.assert_allclose(np.hypot(*friction[0, 1:]), 0.7 * x[0], rtol=1e-12)
    derivative = (friction[1:, 1:] - friction[0, 1:]).T / step
    expected = np.column_stack([g, K, -tangential * K])
    np.testing.assert_allclose(derivative, expected, atol=1e-4)
    np.testing.assert_allclose(friction[0, 1:], K @ (x[1:] - tangential * residual[1:]) + g * x[0], atol=1e-15)


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="needs the CUDA compiler in Warp's wheel for Linux")
def test_batches_compile_for_a_gpu(tmp_path: pathlib.Path) -> None:
    """Without a GPU nothing else compiles what a CPU leaves out: the exchange of numbers between threads of a warp."""
    wp.compile_aot_module(contact_step, device=None, arch=80, module_dir=tmp_path, use_ptx=True)
    (compiled,) = tmp_path.glob("*.ptx")
    assert "shfl.sync" in compiled.read_text()
