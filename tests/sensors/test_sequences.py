"""Sequences: frames of a camera that drives along a row in wind, tracks, and optical flow that lands on the truth."""

import itertools
import json
import pathlib

import cv2
import numpy as np
import pytest

from vinesim.client.composition.domain_randomizer import SceneRandomizer
from vinesim.core import frames
from vinesim.scene.ids import LABEL_STRIDE, Organ
from vinesim.sensors.export import annotations, dataset
from vinesim.sensors.export.dataset import DatasetPlan, VineyardRenderer
from vinesim.sensors.export.mix import load_mix

pytestmark = pytest.mark.slow

FRAMES = 4
IMAGES = 6  # a whole sequence and half of another
SIZE = (160, 120)


def _plan() -> DatasetPlan:
    mix = load_mix("default", "demo", "pinhole")
    return DatasetPlan(mix, 2, SIZE, SceneRandomizer(0.0), sequence=FRAMES)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    out = tmp_path_factory.mktemp("drive") / "set"
    dataset.prepare_folder(_plan(), out, IMAGES)
    assert list(dataset.render_images(_plan(), out, range(IMAGES))) == list(range(IMAGES))
    dataset.finish(out, IMAGES)
    return out


def _ids(folder: pathlib.Path, image: int) -> np.ndarray:
    blue, green, red = np.moveaxis(cv2.imread(str(folder / f"ids/{image:06d}.png")).astype(np.int32), -1, 0)
    return red + 256 * green + 65536 * blue


def _record(folder: pathlib.Path, image: int) -> dict:
    return json.loads((folder / f"records/{image:06d}.json").read_text())


def _flow(folder: pathlib.Path, image: int) -> tuple[np.ndarray, np.ndarray]:
    """Flow [height, width, 2] px by OpenCV's reader, and whether the next frame shows the same surface."""
    shown = cv2.imread(str(folder / f"flow_seen/{image:06d}.png"), cv2.IMREAD_UNCHANGED)
    return cv2.readOpticalFlow(str(folder / f"flow/{image:06d}.flo")), shown > 0


def _points(record: dict, depth: np.ndarray) -> np.ndarray:
    """Points [height, width, 3] m of the world that the pixels show."""
    camera = record["camera"]
    fx, _, cx, _, fy, cy = camera["k"][:6]
    rows, columns = np.indices(depth.shape)
    local = np.stack([(columns - cx) / fx * depth, (rows - cy) / fy * depth, depth], -1)
    return frames.rotate(np.array(camera["quaternion_xyzw"]), local) + camera["position"]


def _project(record: dict, points: np.ndarray) -> np.ndarray:
    camera = record["camera"]
    fx, _, cx, _, fy, cy = camera["k"][:6]
    turn = frames.conjugate(np.array(camera["quaternion_xyzw"]))
    local = frames.rotate(turn, points - camera["position"])
    return local[..., :2] / local[..., 2:] * [fx, fy] + [cx, cy]


def test_labels_warped_by_the_flow_are_those_of_the_next_frame(drive: pathlib.Path) -> None:
    for image in range(FRAMES - 1):
        flow, shown = _flow(drive, image)
        before, after = _ids(drive, image), _ids(drive, image + 1)
        assert np.array_equal(np.abs(flow[..., 0]) > 1e9, before == 0)  # unknown in the sky alone
        rows, columns = np.nonzero(shown)
        assert len(rows) > 0.4 * shown.size
        there = np.round(np.stack([columns, rows], 1) + flow[rows, columns].astype(float)).astype(int)
        assert np.array_equal(before[rows, columns], after[there[:, 1], there[:, 0]])


def test_flow_of_what_stands_still_is_the_motion_of_the_camera(drive: pathlib.Path) -> None:
    """Ground, posts, wires and old wood: the flow is that of depth and the two poses, within 0.1 px."""
    checked = 0
    for image in range(FRAMES - 1):
        flow, _ = _flow(drive, image)
        millimetres = cv2.imread(str(drive / f"depth/{image:06d}.png"), cv2.IMREAD_UNCHANGED)
        still = np.isin(_ids(drive, image) // LABEL_STRIDE, [Organ.GROUND, Organ.POLE, Organ.TRUNK]) & (millimetres > 0)
        there = _project(_record(drive, image + 1), _points(_record(drive, image), 1e-3 * millimetres))
        rows, columns = np.indices(still.shape)
        error = np.abs(there - np.stack([columns, rows], -1) - flow)[still]
        checked += len(error)
        assert error.max() < 0.1  # depth is rounded to millimetres
    assert checked > 1000


def test_flow_carries_points_of_moving_bodies(drive: pathlib.Path) -> None:
    """Points fixed in the bodies of plants, projected in both frames, within 0.1 px; the wind moves them."""
    shots = list(VineyardRenderer(_plan(), 0)._frames())
    moved = 0.0
    for image in range(FRAMES - 1):
        one, two = (shot.seen for shot in shots[image : image + 2])
        flow, _ = _flow(drive, image)
        rows, columns = np.nonzero(np.isin(one.labels // LABEL_STRIDE, [Organ.LEAF, Organ.BUNCH, Organ.CANE]))
        before, after = (seen.carrier_poses[one.primitive[rows, columns]] for seen in (one, two))
        points = _points(_record(drive, image), one.depth.astype(float))[rows, columns]
        fixed = frames.rotate(frames.conjugate(before[:, 3:]), points - before[:, :3])
        there = _project(_record(drive, image + 1), after[:, :3] + frames.rotate(after[:, 3:], fixed))
        assert np.abs(there - np.stack([columns, rows], 1) - flow[rows, columns]).max() < 0.1
        moved = max(moved, float(np.linalg.norm(after[:, :3] - before[:, :3], axis=1).max()))
    assert moved > 1e-4


def test_the_camera_drives_along_the_row(drive: pathlib.Path) -> None:
    records = [_record(drive, image) for image in range(IMAGES)]
    assert [one["sequence"]["number"] for one in records] == [0] * FRAMES + [1] * (IMAGES - FRAMES)
    assert [one["sequence"]["frame"] for one in records] == [0, 1, 2, 3, 0, 1]
    table = load_mix("default").table.sequence
    for one, two in itertools.pairwise(records[:FRAMES]):
        motion = np.subtract(two["camera"]["position"], one["camera"]["position"])
        told = one["sequence"]
        assert (
            two["sequence"]["time"] - told["time"] == pytest.approx(told["period"]) == pytest.approx(1.0 / table.rate)
        )
        assert motion[0] == pytest.approx(told["speed"] * told["period"])
        assert abs(motion[1]) < 1e-9
        assert abs(motion[2]) <= 4.0 * table.heave
        assert one["scene"]["digest"] == two["scene"]["digest"]
        assert one["split"] == two["split"]
    assert len({one["scene"]["digest"] for one in records}) == 2
    assert [one["split"] for one in records] == ["train"] * FRAMES + ["val"] * 2
    assert not (drive / f"flow/{FRAMES - 1:06d}.flo").exists()  # the last frame has no next one
    assert (drive / f"flow/{IMAGES - 1:06d}.flo").exists()  # this one has, though it is not wanted


def test_coco_names_videos_and_tracks(drive: pathlib.Path) -> None:
    read = json.loads((drive / "annotations.json").read_text())
    assert [one["id"] for one in read["videos"]] == [0, 1]
    images = {one["id"]: one for one in read["images"]}
    assert [(one["video_id"], one["frame_id"]) for one in read["images"]] == [(n // FRAMES, n % FRAMES) for n in images]
    bunches: dict[int, set] = {}
    for one in read["annotations"]:
        assert one["video_id"] == images[one["image_id"]]["video_id"]
        bunches.setdefault(one["track_id"], set()).add((one["video_id"], one["bunch"]))
    assert all(len(found) == 1 for found in bunches.values())
    assert len(set.union(*bunches.values())) == len(bunches)
    assert len(bunches) < len(read["annotations"])


@pytest.mark.parametrize("lost", [[2], [0, 3, 5]])
def test_lost_frames_are_made_again_with_the_same_bits(drive: pathlib.Path, tmp_path: pathlib.Path, lost: list) -> None:
    dataset.prepare_folder(_plan(), tmp_path, IMAGES)
    list(dataset.render_images(_plan(), tmp_path, lost))
    found = {path.relative_to(tmp_path) for path in tmp_path.rglob("*0*.*")}
    assert found == {
        path.relative_to(drive) for n in lost for path in drive.rglob(f"{n:06d}.*") if path.suffix != ".txt"
    }
    assert all((tmp_path / name).read_bytes() == (drive / name).read_bytes() for name in found)


def test_hugging_face_metadata_has_the_boxes_of_coco(drive: pathlib.Path) -> None:
    """As the folder-based builders of ``datasets`` read it: a line for each file beside it, named relative to it."""
    lines = [json.loads(line) for line in (drive / "images/metadata.jsonl").read_text().splitlines()]
    assert [drive / "images" / one["file_name"] for one in lines] == sorted((drive / "images").glob("*.png"))
    read = json.loads((drive / "annotations.json").read_text())
    for one in lines:
        boxes = [found["bbox"] for found in read["annotations"] if found["image_id"] == one["image_id"]]
        assert one["objects"]["bbox"] == boxes
        assert {len(values) for values in one["objects"].values()} == {len(boxes)}
        assert set(one["objects"]["categories"]) <= {0}


def test_unknown_flow_is_marked_as_middlebury_does(tmp_path: pathlib.Path) -> None:
    flow = np.arange(24, dtype=float).reshape(3, 4, 2) / 7.0
    flow[1, 2] = np.nan
    (tmp_path / "a.flo").write_bytes(annotations.encode_flow(flow))
    read = cv2.readOpticalFlow(str(tmp_path / "a.flo"))
    assert np.array_equal(read[~np.isnan(flow)], flow[~np.isnan(flow)].astype(np.float32))
    assert (read[1, 2] > 1e9).all()
