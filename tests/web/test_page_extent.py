"""How far the page takes rigid bodies to extend: beside the exact support function of each kind of primitive."""

import json

import numpy as np
import pytest

from tests.support.page_module import page_module
from vinesim.core import frames

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("browser")]

TUBE = 0
SPHEROID = 1
BOX = 3
ELLIPSOID = 4
TRIANGLE = 6
A = np.array([0.1, -0.2, 0.3])
TURN = frames.exp(np.array([0.7, -0.4, 1.1]))
HALF = np.array([0.3, 0.1, 0.05])
AXIS = frames.rotate(TURN, np.array([1.0, 0.0, 0.0]))
PRIMITIVES = {
    TUBE: [*A, 0.08, *(A + 0.6 * AXIS), 0.08],
    SPHEROID: [*A, 0.12, *AXIS, 1.6],
    BOX: [*A, HALF[0], *TURN, HALF[1], HALF[2]],
    ELLIPSOID: [*A, HALF[0], *TURN, HALF[1], HALF[2]],
    TRIANGLE: [*A, 1.0, 0.4, 0.3, -0.2, 1.0, -0.1, 0.2, 0.5, 1.0],
}


def exact(kind: int, u: np.ndarray) -> np.ndarray:
    """How far a primitive reaches from the origin of its carrier in directions ``u`` [k, 3]."""
    local = frames.rotate(frames.conjugate(TURN), u)
    return {
        TUBE: u @ A + np.maximum(0.6 * u @ AXIS, 0.0) + 0.08,
        SPHEROID: u @ A + 0.12 * np.sqrt(1.0 + (1.6**2 - 1.0) * (u @ AXIS) ** 2),
        BOX: u @ A + np.abs(local) @ HALF,
        ELLIPSOID: u @ A + np.linalg.norm(local * HALF, axis=1),
        TRIANGLE: (u @ np.array(PRIMITIVES[TRIANGLE]).reshape(3, 4)[:, :3].T).max(1),
    }[kind]


@pytest.fixture(scope="module")
def extents(browser):
    """How far all primitives reach in directions [k, 3], and the boxes around them, by their kind."""
    shape = np.zeros((len(PRIMITIVES), 16))
    for row, values in zip(shape, PRIMITIVES.values(), strict=True):
        row[: len(values)] = values
    numbers = list(range(len(shape)))
    arrays = {"shape": shape.ravel().tolist(), "first": numbers, "size": [1] * len(shape), "carrier": numbers}
    arrays["kind"] = list(PRIMITIVES)
    with page_module(browser, "extent.js", "boxAround", "farthest", "outermost") as run:

        def reach(directions):
            found = run(f"""
                const hulls = outermost({json.dumps(arrays)}), u = {json.dumps(directions.tolist())};
                return [...hulls.values()].map((points) => {{
                  const {{ min, max }} = boxAround(points);
                  return [u.map(([x, y, z]) => farthest(points, {{ x, y, z }})), [...min, ...max]];
                }});""")
            return dict(zip(PRIMITIVES, found, strict=True))

        yield reach


def test_bodies_reach_as_far_as_their_primitives(extents):
    """Never further, and at most 5 % of the largest half side less, in 500 directions; boxes are exact."""
    u = np.random.default_rng(3).normal(size=(500, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    axes = np.concatenate([-np.eye(3), np.eye(3)])
    for kind, (reach, box) in extents(u).items():
        short = exact(kind, u) - reach
        assert short.min() > -1e-6, kind
        assert short.max() < 0.05 * HALF[0], kind
        np.testing.assert_allclose(box, exact(kind, axes) * np.repeat([-1.0, 1.0], 3), atol=1e-6, err_msg=str(kind))
