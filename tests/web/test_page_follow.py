"""Eyes that follow an actor stand on that side of it where the fewest plants are between."""

import json

import numpy as np
import pytest

from tests.support.page_module import page_module

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("browser")]

EYES = "const eyes = new FlyingEyes({ addEventListener() {} }, [9, 9, 1.6, 0, 0, 0, 1]);"


def test_the_side_is_chosen_by_what_is_between_and_kept_until_the_actor_has_moved(page) -> None:
    """The actor looks along x. Something stands to its left, then, when it has moved, to its right."""
    script = f"""
        {EYES}
        const stand = (x, isHidden) => {{
            for (let k = 0; k < 200; ++k) eyes.follow([x, 2, 0], 0, (eye) => Number(isHidden(eye)));
            return eyes.place;
        }};
        const left = (eye) => eye[1] > 2, right = (eye) => eye[1] < 2, places = [];
        for (const [x, isHidden] of [[1, left], [1.5, right], [3, right], [3, () => false]])
            places.push([...stand(x, isHidden)]);
        return [places, eyes.yaw];
    """
    with page_module(page, "fly.js", "FlyingEyes") as run:
        places, yaw = run(script)
    for (x, y, z), (actor, side) in zip(places, [(1.0, -1), (1.5, -1), (3.0, 1), (3.0, 1)], strict=True):
        assert np.hypot(x - actor, y - 2.0) == pytest.approx(3.2, abs=0.01)
        assert x < actor, "from behind"
        assert (y > 2.0) == (side > 0)
        assert z == pytest.approx(1.6, abs=0.01)
    assert yaw == pytest.approx(np.arctan2(2.0 - places[-1][1], 3.0 - places[-1][0]), abs=1e-6)


def test_clusters_of_plants_near_a_line_of_sight_are_counted(page) -> None:
    """Beside the exact distance of spheres of half the radius to the first four fifths of the line."""
    rng = np.random.default_rng(4)
    eye = np.array([1.0, 2.0, 1.6])
    point = np.array([4.0, 1.0, 1.1])
    balls = np.column_stack([rng.uniform([0, 0, 0], [5, 3, 3], (500, 3)), rng.uniform(0.2, 0.6, 500)])
    samples = eye + np.linspace(0.0, 0.8, 4001)[:, None] * (point - eye)
    gap = np.linalg.norm(balls[:, None, :3] - samples, axis=2).min(1) - 0.5 * balls[:, 3]
    given = json.dumps([balls.ravel().tolist(), eye.tolist(), point.tolist()])
    script = f"""
        const [ball, eye, point] = {given}, world = {{ plantClusters: {{ first: Array(ball.length / 4), ball }} }};
        return World.prototype.countBetween.call(world, eye, point);
    """
    with page_module(page, "world.js", "World") as run:
        assert run(script) == (gap < 0.0).sum() > 5
