"""What sensors see of a cut cane: the stump ends at the cut, wood and leaves beyond it fall, and labels are true."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.core import frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.primitive_arrays import CONE, LEAF
from vinesim.world import Physics


@pytest.fixture(scope="module")
def model() -> Model:
    return generate(load_scene("demo"))


def leafy_segment(model: Model) -> tuple[int, float]:
    """Returns a segment in the middle of a shoot with at least two leaves and no tie beyond, and a place between the
    leaves [m]."""
    for body in np.flatnonzero(np.bincount(model.leaf_body, minlength=len(model.body_mass)) >= 2).tolist():
        base = np.sort(model.leaf_base[model.leaf_body == body, 0])
        number = body - model.tree_first[model.body_tree[body]]
        tied = np.isin(model.body_tree[body], model.body_tree[model.tie_body[model.tie_body >= body]])
        if base[1] - base[0] > 0.01 and number > 2 and not tied:
            return body, round(float(base[:2].mean()), 4)
    raise AssertionError("no segment has two leaves apart")


def wood(primitives: Primitives, bodies: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Starts and ends [k, 4] (m, radius) of the visible wood of some bodies, without nodes."""
    columns = primitives.local_columns(slice(0, primitives.plant_count))
    rows = np.flatnonzero(
        np.isin(columns["carrier"], bodies)
        & (primitives.shapes.kind.numpy()[: primitives.plant_count] == CONE)
        & (primitives.organ[: primitives.plant_count] == int(Organ.CANE))
        & (columns["b"][:, 1:3] == 0.0).all(1)
        & (columns["a"][:, 3] > 1e-5)
    )
    long = np.abs(columns["b"][rows, 0] - columns["a"][rows, 0]) > 0.006
    return primitives.shapes.a.numpy()[rows[long]], primitives.shapes.b.numpy()[rows[long]]


def test_a_cut_cane_is_drawn_in_two_parts_with_their_leaves(model):
    segment, at = leafy_segment(model)
    physics = Physics(model)
    primitives = Primitives(model, grass=0.0)
    primitives.update(physics.snapshot())
    every = slice(0, primitives.plant_count)
    columns = {name: values.copy() for name, values in primitives.local_columns(every).items()}
    physics.cut(segment, at)
    stump = int(np.flatnonzero(physics.state.stump_of == segment)[0])
    snapshot = physics.snapshot()
    primitives.update(snapshot)
    start, end = wood(primitives, (segment, stump))
    pose = snapshot.body_q[segment].astype(float)
    cut = pose[:3] + frames.rotate(pose[3:], np.array([at, 0.0, 0.0]))
    assert len(start) == 2
    assert np.linalg.norm(end[:, :3] - cut, axis=1).min() < 1e-5
    assert np.linalg.norm(start[:, :3] - cut, axis=1).min() < 1e-5
    length = np.linalg.norm(end[:, :3] - start[:, :3], axis=1).sum()
    assert length == pytest.approx(float(model.body_length[segment]), abs=1e-5)
    now = primitives.local_columns(every)
    blades = np.flatnonzero(primitives.shapes.kind.numpy()[every] == LEAF)
    grows = model.leaf_body == segment
    for body, expected in ((stump, model.leaf_base[grows, 0] < at), (segment, model.leaf_base[grows, 0] >= at)):
        shown = now["a"][blades[now["carrier"][blades] == body], :3]
        there = model.leaf_pose[grows, :3]
        away = np.linalg.norm(shown[:, None] - there[None], axis=-1)
        assert set(away.argmin(1)) == set(np.flatnonzero(expected)), (
            "small leaves go with the leaf in whose axil they stand"
        )
        assert (away.min(0)[expected] < 1e-6).all()
    rows = np.flatnonzero(now["carrier"] == stump)
    names = {label(Organ.CANE, 0) + model.body_tree[segment], label(Organ.LEAF, 0) + model.body_tree[segment]}
    assert set(now["label"][rows].tolist()) == names
    for _ in range(40):
        physics.step()
    primitives.update(physics.snapshot())
    fallen_start, _ = wood(primitives, (segment,))
    stump_start, _ = wood(primitives, (stump,))
    assert fallen_start[0, 2] < cut[2] - 0.2
    assert abs(stump_start[0, 2] - cut[2]) < 0.1
    # a world that was set back has its cane again
    primitives.update(Physics(model).snapshot())
    for name, values in primitives.local_columns(every).items():
        np.testing.assert_array_equal(values, columns[name], err_msg=name)
