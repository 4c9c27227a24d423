"""Labels of dormant vines: every pixel of a cane, a spur, a node or a bud shows this cane, spur, node or bud."""

import json
import pathlib

import cv2
import numpy as np
import pytest

from vinesim.core import frames
from vinesim.scene import spec as scenes
from vinesim.scene.camera_geometry import pixel_rays
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import LABEL_STRIDE, Organ
from vinesim.scene.model import Model
from vinesim.scene.values import CameraInfo
from vinesim.sensors import ground_truth
from vinesim.sensors.export import annotations, dataset
from vinesim.sensors.export.dataset import DatasetPlan
from vinesim.sensors.export.images import look_at
from vinesim.sensors.export.mix import load_mix
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot

pytestmark = pytest.mark.slow

INFO = CameraInfo(320, 240, 300.0, 300.0, 159.5, 119.5, "near")


@pytest.fixture(scope="module", params=["winter_spur", "winter_cane"])
def seen(request: pytest.FixtureRequest) -> tuple[Model, ground_truth.PixelBuffers, np.ndarray, np.ndarray]:
    """A model, what a camera sees of it, the poses of bodies, and the seen points in the world [height, width, 3]."""
    model = generate(scenes.load_scene(request.param))
    snapshot = rest_snapshot(model)
    primitives = Primitives(model, grass=0.0)
    primitives.update(snapshot)
    canes = model.canes
    near = model.nodes.positions(snapshot.body_q)[canes.node[np.flatnonzero(canes.year == 1)[4]]]
    pose = look_at(near + np.array([0.05, -0.5, 0.12]), near + np.array([0.02, 0.0, 0.06]))
    view = ground_truth.render_buffers(primitives, INFO, pose)
    across, down = np.broadcast_arrays(*pixel_rays(INFO))
    rays = np.stack([across, down, np.ones_like(across)], -1)
    points = pose[:3] + frames.rotate(pose[3:], rays * np.where(np.isfinite(view.depth), view.depth, 0.0)[..., None])
    return model, view, snapshot.body_q.astype(float), points


def test_buds_and_nodes_are_where_their_ids_say(
    seen: tuple[Model, ground_truth.PixelBuffers, np.ndarray, np.ndarray],
) -> None:
    model, view, q, points = seen
    organ, index = view.labels // LABEL_STRIDE, view.labels % LABEL_STRIDE
    nodes = model.nodes
    for kind, place, radius in (
        (Organ.BUD, nodes.bud_poses(q)[:, :3], nodes.bud_length.max() + nodes.bud_radius.max()),
        (Organ.NODE, nodes.positions(q), 2.0 * model.body_radius.max()),
    ):
        here = organ == int(kind)
        assert here.sum() > 40
        assert len(np.unique(index[here])) >= 4
        assert (np.linalg.norm(points[here] - place[index[here]], axis=1) <= radius).all()


def test_canes_and_two_year_wood_have_the_ids_of_canes(
    seen: tuple[Model, ground_truth.PixelBuffers, np.ndarray, np.ndarray],
) -> None:
    model, view, q, points = seen
    organ, index = view.labels // LABEL_STRIDE, view.labels % LABEL_STRIDE
    canes = model.canes
    for kind, year in ((Organ.CANE, 1), (Organ.SPUR, 2)):
        here = np.argwhere(organ == int(kind))
        assert len(here) > 20
        assert (canes.year[index[tuple(here.T)]] == year).all()
        for row, column in here[:: max(len(here) // 150, 1)]:
            cane = int(index[row, column])
            bodies = np.arange(canes.body[cane], canes.body[cane] + canes.size[cane])
            start = q[bodies, :3]
            way = frames.rotate(q[bodies, 3:], model.body_length[bodies, None] * np.array([1.0, 0.0, 0.0]))
            share = np.clip(((points[row, column] - start) * way).sum(1) / (way * way).sum(1), 0.0, 1.0)
            gap = np.linalg.norm(points[row, column] - start - share[:, None] * way, axis=1)
            surface = model.body_radius[bodies, 0] * (1.0 - share) + model.body_radius[bodies, 1] * share
            assert np.abs(gap - surface).min() < 1.5e-3


def test_semantic_images_have_the_classes_of_dormant_wood(
    seen: tuple[Model, ground_truth.PixelBuffers, np.ndarray, np.ndarray],
) -> None:
    view = seen[1]
    classes = annotations.encode_classes(view)
    organ = view.labels // LABEL_STRIDE
    for name, kind in (("cane", Organ.CANE), ("spur", Organ.SPUR), ("node", Organ.NODE), ("bud", Organ.BUD)):
        shown = classes == annotations.SEMANTIC_CLASSES.index(name)
        assert shown.any()
        assert np.array_equal(shown, organ == int(kind))


def test_a_data_set_of_dormant_vines_has_their_nodes(tmp_path: pathlib.Path) -> None:
    plan = DatasetPlan(load_mix("around", "winter_spur", "pinhole"), 3, (160, 120), None, semantic=True)
    dataset.prepare_folder(plan, tmp_path, 1)
    renderer = dataset.VineyardRenderer(plan, 0)
    assert list(renderer.write_images([0], tmp_path)) == [0]
    record = json.loads(next((tmp_path / "records").glob("*.json")).read_text())
    labels = cv2.imread(str(tmp_path / "ids" / "000000.png"))[..., ::-1].astype(int) @ [1, 256, 65536]
    organ, index = labels // LABEL_STRIDE, labels % LABEL_STRIDE
    nodes = renderer.model.nodes
    listed = {one["node"]: one for one in record["nodes"]}
    assert record["view"]["node"] in listed
    assert record["bunches"] == []
    shown = set(np.unique(index[organ == Organ.NODE]).tolist())
    budded = np.flatnonzero(nodes.bud >= 0)
    shown |= {int(budded[bud]) for bud in np.unique(index[organ == Organ.BUD])}
    assert shown == set(listed)
    for node, one in listed.items():
        assert one["node_pixels"] == ((organ == Organ.NODE) & (index == node)).sum()
        assert (one["bud"], one["cane"], one["rank"]) == (nodes.bud[node], nodes.cane[node], nodes.rank[node])
        if one["node_pixels"] > 3:
            rows, columns = np.nonzero((organ == Organ.NODE) & (index == node))
            apart = np.hypot(rows - one["pixel"][1], columns - one["pixel"][0])
            assert apart.min() < 4.0
