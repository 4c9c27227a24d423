"""Pictures and data sets as files: formats as their readers read them, bitwise repeatable, whole after any end."""

import contextlib
import errno
import json
import os
import pathlib
import resource
import shutil
import signal
import subprocess
import sys
import time
import types

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from tests.support import programs
from tests.support.progress_texts import collect_progress
from tests.support.waiting import deadline
from vinesim.cli.dataset import _progress
from vinesim.cli.dataset import run as run_dataset
from vinesim.cli.render import run as render
from vinesim.client.composition.domain_randomizer import SceneRandomizer
from vinesim.client.composition.scene_composer import PlacementError
from vinesim.core.data_files import DataFileNotFound
from vinesim.core.errors import UsageError, WriteError
from vinesim.core.version import __version__
from vinesim.robot.description.urdf import DescriptionError
from vinesim.scene.ids import Organ, label
from vinesim.scene.values import MultispectralMount
from vinesim.sensors.export import annotations, dataset, views
from vinesim.sensors.export.dataset import DatasetError, DatasetPlan
from vinesim.sensors.export.mix import LoadedMix, load_mix
from vinesim.sensors.spec_file import SensorError

pytestmark = pytest.mark.slow

IMAGES = 6  # of two vineyards
LIFE = SceneRandomizer(0.5)
SCENE = """
name = "one vine"
seed = 1
training = "tendone"
layout = { rows = 1, vines = 1, row_spacing = 2.5, vine_spacing = 2.5, height = 2.0 }
fruit = { bunches = [6, 8], varieties = ["italia"] }
"""


def _mix(scene: str | pathlib.Path) -> LoadedMix:
    """The mix of a data set of one scene."""
    return load_mix("around", str(scene), "d435")


def _files(folder: pathlib.Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A scene file: one vine, soon grown."""
    file = tmp_path_factory.mktemp("scene") / "vine.toml"
    file.write_text(SCENE)
    return file


def _command(scene: pathlib.Path, out: pathlib.Path, workers: int) -> list[str]:
    options = {"images": IMAGES, "size": "160x120", "seed": 5, "scene": scene, "out": out, "workers": workers}
    options["actors"] = LIFE.share
    given = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    return [sys.executable, "-m", "vinesim", "dataset", *given]


@pytest.fixture(scope="module")
def whole(scene: pathlib.Path, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A data set made in this process, in one go."""
    out = tmp_path_factory.mktemp("whole") / "set"
    plan = DatasetPlan(_mix(scene), 5, (160, 120), LIFE)
    dataset.prepare_folder(plan, out, IMAGES)
    assert list(dataset.render_images(plan, out, dataset.missing_images(out, IMAGES))) == list(range(IMAGES))
    dataset.finish(out, IMAGES)
    return out


def _until(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + deadline(seconds)
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def _records(out: pathlib.Path) -> dict[str, int]:
    return {p.name: p.stat().st_mtime_ns for p in (out / "records").glob("*.json")}


def test_stopped_killed_and_gone_on_with_it_is_the_same_data_set(
    scene: pathlib.Path, whole: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    out = tmp_path / "set"
    command = _command(scene, out, 1)
    for end, images in ((signal.SIGINT, 0), (signal.SIGKILL, 1)):  # Ctrl-C while vines grow, a kill after an image
        with programs.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
            _until(lambda: (out / "dataset.json").exists() and len(_records(out)) >= images)  # noqa: B023
            run.send_signal(end)
            said = run.communicate(timeout=deadline())[0]
        assert run.returncode == (130 if end == signal.SIGINT else -signal.SIGKILL)
        if end == signal.SIGINT:
            assert f"0 of {IMAGES} images" in said
            assert list(_files(out)) == ["dataset.json"]
    done = _records(out)
    assert 0 < len(done) < IMAGES
    assert not (out / "annotations.json").exists()
    (out / "images" / ".000001.png.1.part").write_bytes(b"half")  # as a kill may leave it
    last = programs.run(_command(scene, out, 2), timeout=deadline())
    assert last.returncode == 0, last.stderr
    assert {name: _records(out)[name] for name in done} == done
    assert _files(out) == _files(whole)


def test_progress_in_a_log_file_is_a_line_every_few_seconds(monkeypatch, capsys) -> None:
    texts = collect_progress(monkeypatch)
    with _progress(20, 5) as advance:
        advance(1)
        advance(2)
    assert texts == ["6 of 20 images are there", "8 of 20 images are there", ""]
    assert capsys.readouterr().out == ""


@pytest.mark.long
def test_a_killed_worker_is_one_line_and_the_same_command_goes_on(
    scene: pathlib.Path, whole: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    out = tmp_path / "set"
    with programs.Popen(_command(scene, out, 1), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        _until(lambda: _records(out))
        (worker,) = _spawned_by(run.pid)
        os.kill(worker, signal.SIGKILL)
        errors = run.communicate(timeout=deadline())[1]
    assert run.returncode == 5
    assert [line for line in errors.splitlines() if line.strip() and "images are there" not in line] == [
        "vinesim: a worker was killed by SIGKILL; finished images are kept; run the same command to continue"
    ]
    last = programs.run(_command(scene, out, 1), timeout=deadline())
    assert last.returncode == 0, last.stderr
    assert _files(out) == _files(whole)


def _spawned_by(parent: int) -> list[int]:
    """Workers of a process; multiprocessing's resource tracker is none."""
    children = pathlib.Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    return [int(pid) for pid in children if b"spawn_main" in pathlib.Path(f"/proc/{pid}/cmdline").read_bytes()]


def test_pycocotools_reads_it(whole: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    read = COCO(str(whole / "annotations.json"))
    capsys.readouterr()
    assert read.getImgIds() == list(range(IMAGES))
    assert [c["name"] for c in read.loadCats(read.getCatIds())] == ["bunch"]
    assert read.getCatIds() == [1]  # ids begin with 1 by convention
    assert len(read.anns) > IMAGES
    for one in read.loadAnns(read.getAnnIds()):
        image = read.loadImgs(one["image_id"])[0]
        ids = _ids(whole / "ids" / pathlib.Path(image["file_name"]).name)
        mask = read.annToMask(one).astype(bool)
        assert np.array_equal(mask, ids == label(Organ.BUNCH, one["bunch"]))
        assert one["area"] == mask.sum() >= annotations.MIN_ANNOTATED_PIXELS
        assert one["bbox"] == coco_mask.toBbox(read.annToRLE(one)).tolist()
        amodal = coco_mask.decode(one["amodal_segmentation"]).astype(bool)
        assert not (mask & ~amodal).any()
        assert one["occlusion"] == pytest.approx(1.0 - mask.sum() / amodal.sum())
        assert one["amodal_bbox"] == coco_mask.toBbox(one["amodal_segmentation"]).tolist()
        assert len(one["keypoints"]) == 3 * len(read.cats[one["category_id"]]["keypoints"])


def test_coco_evaluation_of_the_truth_itself_finds_all(whole: pathlib.Path) -> None:
    truth = COCO(str(whole / "annotations.json"))
    names = ("image_id", "category_id", "bbox", "segmentation")
    found = truth.loadRes([{name: one[name] for name in names} | {"score": 0.9} for one in truth.anns.values()])
    for kind in ("bbox", "segm"):
        judge = COCOeval(truth, found, kind)
        judge.evaluate()
        judge.accumulate()
        judge.summarize()
        assert judge.stats[0] == pytest.approx(1.0)


@pytest.fixture
def copy(whole: pathlib.Path, tmp_path: pathlib.Path) -> pathlib.Path:
    """A copy of the data set, to be changed."""
    shutil.copytree(whole, tmp_path / "copy")
    return tmp_path / "copy"


@pytest.mark.parametrize("form", annotations.SEGMENTATIONS)
def test_masks_in_every_form_are_those_of_the_ids(copy: pathlib.Path, form: str) -> None:
    """By the calls of torchvision's references and of DETR, which do not take compressed run lengths."""
    dataset.finish(copy, IMAGES, form)
    said = json.loads((copy / "annotations.json").read_text())
    shapes = {one["id"]: (one["height"], one["width"]) for one in said["images"]}
    for one in said["annotations"]:
        mask = one["segmentation"]
        if form != "compressed":
            mask = coco_mask.frPyObjects(mask, *shapes[one["image_id"]])
        pixels = coco_mask.decode(mask)
        pixels = pixels.any(axis=2) if pixels.ndim == 3 else pixels.astype(bool)
        ids = _ids(copy / "ids" / f"{one['image_id']:06d}.png")
        assert np.array_equal(pixels, ids == label(Organ.BUNCH, one["bunch"]))


def test_coco_file_names_version_seed_and_licence_but_no_date(whole: pathlib.Path, copy: pathlib.Path) -> None:
    said = json.loads((copy / "annotations.json").read_text())
    assert said["info"]["version"] == __version__
    assert said["info"]["seed"] == 5
    assert not {"year", "date_created"} & said["info"].keys()
    assert {one["license"] for one in said["images"]} == {one["id"] for one in said["licenses"]}
    assert all(one["supercategory"] for one in said["categories"])
    dataset.finish(copy, IMAGES)
    assert _files(copy) == _files(whole)


def test_yolo_segments_are_the_masks(copy: pathlib.Path) -> None:
    dataset.finish(copy, IMAGES, yolo="segment")
    for record in (json.loads(p.read_text()) for p in sorted((copy / "records").glob("*.json"))):
        ids = _ids(copy / "ids" / f"{record['image']:06d}.png")
        lines = (copy / "labels" / f"{record['image']:06d}.txt").read_text().splitlines()
        large = [b for b in record["bunches"] if b["pixels"] >= annotations.MIN_ANNOTATED_PIXELS]
        for line, one in zip(lines, large, strict=True):
            words = line.split()
            assert words[0] == "0"
            shares = np.array(words[1:], float)
            assert len(shares) % 2 == 0
            assert len(shares) >= 6
            assert ((shares >= 0.0) & (shares <= 1.0)).all()
            polygon = shares.reshape(-1, 2) * [160, 120]
            assert np.abs(polygon - polygon.round()) == pytest.approx(0.05, abs=1e-3)  # inside of the pixels' corners
            pixels = coco_mask.decode(coco_mask.frPyObjects([polygon.ravel().tolist()], 120, 160))[..., 0]
            assert np.array_equal(pixels.astype(bool), ids == one["label"])
            low, high = polygon.min(0), polygon.max(0)  # Ultralytics makes the box of a segment so
            assert [*low.round(), *(high.round() - low.round())] == one["box"]


def test_yolo_poses_are_boxes_and_cut_points(whole: pathlib.Path, copy: pathlib.Path) -> None:
    dataset.finish(copy, IMAGES, yolo="pose")
    settings = (copy / "data.yaml").read_text()
    assert "kpt_shape: [1, 3]\n" in settings
    assert "flip_idx: [0]\n" in settings
    shown = set()
    annotated = json.loads((copy / "annotations.json").read_text())["annotations"]
    for image in range(IMAGES):
        lines = (copy / "labels" / f"{image:06d}.txt").read_text().splitlines()
        boxes = (whole / "labels" / f"{image:06d}.txt").read_text().splitlines()
        points = [one["keypoints"] for one in annotated if one["image_id"] == image]
        for line, box, (column, row, seen) in zip(lines, boxes, points, strict=True):
            words = line.split()
            assert words[:5] == box.split()
            assert len(words) == 8
            values = np.array(words[1:7], float)
            assert ((values >= 0.0) & (values <= 1.0)).all()
            assert int(words[7]) == seen
            if seen:  # a middle of a pixel is at half a pixel in shares
                assert values[4:] * [160, 120] == pytest.approx([column + 0.5, row + 0.5], abs=1e-3)
            else:
                assert not values[4:].any()
            shown.add(seen)
    assert len(shown) > 1


def test_a_share_of_the_images_shows_no_bunch_and_the_others_stay(
    scene: pathlib.Path, whole: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    plan = DatasetPlan(_mix(scene), 5, (160, 120), LIFE, negatives=0.5)
    assert np.mean([plan.is_negative(image) for image in range(4000)]) == pytest.approx(0.5, abs=0.03)
    dataset.prepare_folder(plan, tmp_path, IMAGES)
    list(dataset.render_images(plan, tmp_path, range(IMAGES)))
    dataset.finish(tmp_path, IMAGES)
    negatives = [image for image in range(IMAGES) if plan.is_negative(image)]
    assert 0 < len(negatives) < IMAGES
    annotated = json.loads((tmp_path / "annotations.json").read_text())
    assert len(annotated["images"]) == IMAGES
    assert {one["image_id"] for one in annotated["annotations"]} == set(range(IMAGES)) - set(negatives)
    files, others = _files(tmp_path), _files(whole)
    for image in range(IMAGES):
        organs = _ids(tmp_path / "ids" / f"{image:06d}.png") >> 20
        assert (organs == Organ.BUNCH).any() == (image not in negatives)
        if image in negatives:
            assert files[f"labels/{image:06d}.txt"] == b""
            assert np.isin(organs, [Organ.TRUNK, Organ.ARM, Organ.CANE, Organ.LEAF]).mean() >= views.MIN_PLANT_SHARE
        else:
            assert all(data == others[name] for name, data in files.items() if f"{image:06d}" in name)
    with pytest.raises(DatasetError, match=r"begun with negatives 0.5, not 0.0"):
        dataset.prepare_folder(DatasetPlan(_mix(scene), 5, (160, 120), LIFE), tmp_path, IMAGES)


def test_semantic_images_have_the_classes_of_the_ids(
    scene: pathlib.Path, whole: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    plan = DatasetPlan(_mix(scene), 5, (160, 120), LIFE, semantic=True)
    dataset.prepare_folder(plan, tmp_path, IMAGES)
    list(dataset.render_images(plan, tmp_path, range(IMAGES)))
    assert dataset.missing_images(tmp_path, IMAGES) == []
    names = json.loads((tmp_path / "dataset.json").read_text())["classes"]
    organs_of = {
        "sky": Organ.NOTHING,
        "soil": Organ.GROUND,
        "grass": Organ.GROUND,
        "post": Organ.POLE,
        "berry": Organ.BUNCH,
        "person": Organ.HUMAN,
    }
    shown = set()
    for image in range(IMAGES):
        classes = cv2.imread(str(tmp_path / "semantic" / f"{image:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert classes.dtype == np.uint8
        organs = _ids(tmp_path / "ids" / f"{image:06d}.png") >> 20
        assert classes.shape == organs.shape
        for value in np.unique(classes):
            name = names[str(value)]
            organ = organs_of[name] if name in organs_of else Organ[name.upper()]
            assert (organs[classes == value] == organ).all()
            shown.add(name)
        berry = cv2.imread(str(tmp_path / "berries" / f"{image:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(classes == annotations.SEMANTIC_CLASSES.index("berry"), berry > 0)
    assert {"sky", "soil", "grass", "leaf", "cane", "bunch", "berry"} <= shown
    files = {name: data for name, data in _files(whole).items() if name.endswith(".png")}
    assert {name: _files(tmp_path)[name] for name in files} == files
    (tmp_path / "semantic" / "000002.png").unlink()
    assert dataset.missing_images(tmp_path, IMAGES) == [2]
    with pytest.raises(DatasetError, match="begun with semantic True, not False"):
        dataset.prepare_folder(DatasetPlan(_mix(scene), 5, (160, 120), LIFE), tmp_path, IMAGES)


def test_unknown_forms_are_refused_in_one_line(scene: pathlib.Path, tmp_path: pathlib.Path) -> None:
    given = {"images": 1, "out": tmp_path / "set", "scene": str(scene), "seed": 5, "camera": "d435", "size": None}
    given |= {"workers": 1, "actors": 0.0, "device": "cpu"}
    for option, words in (("segmentation", "polygons, rle or compressed"), ("yolo", "detect, segment or pose")):
        with pytest.raises(UsageError, match=f"--{option} is 'coco': give {words}"):
            run_dataset(**given, **{option: "coco"})
    with pytest.raises(UsageError, match=r"--negatives is 1.5: give a share of the images, 0 to 1"):
        run_dataset(**given, negatives=1.5)
    assert not (tmp_path / "set").exists()


def _ids(file: pathlib.Path) -> np.ndarray:
    blue, green, red = np.moveaxis(cv2.imread(str(file)).astype(np.int32), -1, 0)
    return red + 256 * green + 65536 * blue


def test_every_image_has_its_yolo_boxes_depth_berries_and_pose(whole: pathlib.Path) -> None:
    records = [json.loads(p.read_text()) for p in sorted((whole / "records").glob("*.json"))]
    assert len(records) == IMAGES
    assert len({r["scene"]["digest"] for r in records}) == 2
    assert len({r["sun"]["hour"] for r in records}) == IMAGES
    for record in records:
        stem = f"{record['image']:06d}"
        rgb = cv2.imread(str(whole / record["file"]))
        depth = cv2.imread(str(whole / "depth" / f"{stem}.png"), cv2.IMREAD_UNCHANGED)
        berry = cv2.imread(str(whole / "berries" / f"{stem}.png"), cv2.IMREAD_UNCHANGED)
        ids = _ids(whole / "ids" / f"{stem}.png")
        assert rgb.shape == (120, 160, 3)
        assert depth.shape == berry.shape == ids.shape == (120, 160)
        assert depth.dtype == berry.dtype == np.uint16
        assert ((ids[berry > 0] >> 20) == int(Organ.BUNCH)).all()
        lines = np.array([line.split() for line in (whole / "labels" / f"{stem}.txt").read_text().splitlines()], float)
        large = [b for b in record["bunches"] if b["pixels"] >= annotations.MIN_ANNOTATED_PIXELS]
        assert len(lines) == len(large) >= 1
        for line, one in zip(lines, large, strict=True):
            rows, columns = np.nonzero(ids == one["label"])
            box = (line[1:] * [160, 120, 160, 120]).round(3)
            low = box[:2] - 0.5 * box[2:]
            size = box[2:]
            assert low == pytest.approx([columns.min(), rows.min()], abs=1e-3)
            assert size == pytest.approx([np.ptp(columns) + 1, np.ptp(rows) + 1], abs=1e-3)
            seen = np.unique(berry[ids == one["label"]])
            assert one["berries_seen"] <= (seen > 0).sum() <= one["berries"]
        # the pose puts the depth of the largest bunch where truth has its box
        one = max(large, key=lambda b: b["pixels"])
        camera = record["camera"]
        box = one["box_3d"]
        fx, _, cx, _, fy, cy = camera["k"][:6]
        rows, columns = np.nonzero((ids == one["label"]) & (depth > 0))
        z = depth[rows, columns] * 1e-3
        points = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], 1)
        points = _turned(camera["quaternion_xyzw"], points) + camera["position"]
        local = _turned(np.array(box["quaternion_xyzw"]) * [-1, -1, -1, 1], points - box["position"])
        assert (np.abs(local) <= 0.5 * np.array(box["size"]) + 1e-3).all()


def test_life_is_in_a_share_of_the_images_and_all_bunches_have_their_ripeness(whole: pathlib.Path) -> None:
    records = [json.loads(p.read_text()) for p in sorted((whole / "records").glob("*.json"))]
    lively = [record for record in records if record["actors"]]
    assert 0 < len(lively) < IMAGES
    for record in lively:
        ids = _ids(whole / "ids" / f"{record['image']:06d}.png")
        assert [one["pixels"] for one in record["actors"]] == [(ids == one["label"]).sum() for one in record["actors"]]
        assert {one["kind"] for one in record["actors"]} <= {"robot", "human", "box"}
    still = _ids(whole / "ids" / f"{next(r['image'] for r in records if not r['actors']):06d}.png")
    assert (still < label(Organ.BOX, 0)).all()
    ripeness = {}
    for one in json.loads((whole / "annotations.json").read_text())["annotations"]:
        vineyard = records[one["image_id"]]["scene"]["seed"]
        assert ripeness.setdefault((vineyard, one["bunch"]), one["ripeness"]) == one["ripeness"]
    assert len(set(ripeness.values())) > 3
    assert all(0.0 <= value <= 1.0 for value in ripeness.values())


def test_an_image_is_the_same_whatever_was_drawn_before(
    scene: pathlib.Path, whole: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    """The last image of a vineyard, alone: wind, actors and picked bunches of the others leave no trace."""
    plan = DatasetPlan(_mix(scene), 5, (160, 120), LIFE)
    dataset.prepare_folder(plan, tmp_path, IMAGES)
    last = dataset.IMAGES_PER_VINEYARD - 1
    list(dataset.render_images(plan, tmp_path, [last]))
    alone = {name: data for name, data in _files(tmp_path).items() if f"{last:06d}" in name}
    assert len(alone) == 6
    assert alone == {name: _files(whole)[name] for name in alone}


def _turned(q, v: np.ndarray) -> np.ndarray:
    u = np.asarray(q[:3], float)
    w = float(q[3])
    return v + 2.0 * np.cross(u, np.cross(u, v) + w * v)


def test_another_plan_is_not_mixed_in(scene: pathlib.Path, whole: pathlib.Path, tmp_path: pathlib.Path) -> None:
    plan = DatasetPlan(_mix(scene), 5, (160, 120), LIFE)
    before = _files(whole)
    dataset.prepare_folder(plan, whole, IMAGES)
    assert _files(whole) == before
    for other, words in (
        (DatasetPlan(_mix(scene), 6, (160, 120), LIFE), "seed 5, not 6"),
        (DatasetPlan(_mix("vsp"), 5, (160, 120), LIFE), "mix another one, not this one"),
        (DatasetPlan(_mix(scene), 5, (320, 240), LIFE), "size"),
        (DatasetPlan(_mix(scene), 5, (160, 120)), "life"),
    ):
        with pytest.raises(DatasetError, match=words):
            dataset.prepare_folder(other, whole, IMAGES)
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(DatasetError, match="other things"):
        dataset.prepare_folder(plan, tmp_path, IMAGES)
    with pytest.raises(DatasetError, match="cannot be used"):
        dataset.prepare_folder(plan, tmp_path / "mine.txt", IMAGES)


def test_a_full_disk_leaves_nothing_half(scene: pathlib.Path, tmp_path: pathlib.Path) -> None:
    """No file may grow beyond 20 kB: to a program that is a full disk, at the first picture."""
    plan = DatasetPlan(_mix(scene), 5, (160, 120))
    dataset.prepare_folder(plan, tmp_path, IMAGES)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        with pytest.raises(WriteError, match=r"image 0 cannot be written .* make room"):
            list(dataset.render_images(plan, tmp_path, [0]))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(_files(tmp_path)) == ["dataset.json"]


def _full_disk(monkeypatch: pytest.MonkeyPatch, name: str, error: int) -> None:
    """Any write to a file whose name contains ``name`` fails half-way."""
    real = pathlib.Path.open

    def opened(path: pathlib.Path, mode: str = "r", *rest, **options):
        file = real(path, mode, *rest, **options)
        if "w" in mode and name in path.name:

            def stop(pieces) -> None:
                file.write(next(iter(pieces))[:3])
                raise OSError(error, os.strerror(error))

            return contextlib.closing(types.SimpleNamespace(writelines=stop, close=file.close))
        return file

    monkeypatch.setattr(pathlib.Path, "open", opened)


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EROFS])
def test_a_failing_disk_leaves_the_image_before_whole_and_the_same_command_goes_on(
    whole: pathlib.Path, scene: pathlib.Path, tmp_path: pathlib.Path, error: int
) -> None:
    """Whichever file of an image fails, none of that image is new."""
    out = tmp_path / "set"
    shutil.copytree(whole, out)
    plan = DatasetPlan(_mix(scene), 5, (160, 120), LIFE)
    (out / "images" / "000001.png").unlink()
    before = _files(out)
    with pytest.MonkeyPatch.context() as patch:
        _full_disk(patch, "000001.json", error)
        with pytest.raises(WriteError, match=f"image 1 .*{os.strerror(error)}; make room .* goes on") as said:
            list(dataset.render_images(plan, out, dataset.missing_images(out, IMAGES)))
    assert "\n" not in str(said.value)
    assert said.value.exit_code == 5
    assert _files(out) == before
    for name in ("annotations.json", "000001.txt", "val.txt", "data.yaml"):
        with pytest.MonkeyPatch.context() as patch:
            _full_disk(patch, name, error)
            with pytest.raises(WriteError, match=r"annotations\.json, the labels and the lists"):
                dataset.finish(out, IMAGES)
        assert _files(out) == before
    assert list(dataset.render_images(plan, out, dataset.missing_images(out, IMAGES))) == [1]
    dataset.finish(out, IMAGES)
    assert _files(out) == _files(whole)


def test_a_folder_that_cannot_be_written_is_refused_in_one_line(
    scene: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _full_disk(monkeypatch, "dataset.json", errno.EROFS)
    with pytest.raises(DatasetError, match="cannot be used: Read-only file system; give a folder that can be written"):
        dataset.prepare_folder(DatasetPlan(_mix(scene), 5), tmp_path, 1)
    assert not _files(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[]", '"vinesim"', "\udcff"])
def test_a_damaged_dataset_json_is_one_line(scene: pathlib.Path, tmp_path: pathlib.Path, text: str) -> None:
    (tmp_path / "dataset.json").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(DatasetError, match=r"dataset\.json is not what a data set was begun with") as said:
        dataset.prepare_folder(DatasetPlan(_mix(scene), 5), tmp_path, 1)
    assert "\n" not in str(said.value)


def _truncate(file: pathlib.Path) -> None:
    file.write_bytes(file.read_bytes()[:-2])


def _empty(file: pathlib.Path) -> None:
    file.write_bytes(b"")


@pytest.mark.parametrize("damage", [_truncate, _empty, pathlib.Path.unlink])
@pytest.mark.parametrize("kind", ["images", "depth", "measured", "ids", "berries", "records"])
def test_a_damaged_file_makes_its_image_missing(whole: pathlib.Path, tmp_path: pathlib.Path, kind: str, damage) -> None:
    out = tmp_path / "set"
    shutil.copytree(whole, out)
    assert dataset.missing_images(out, IMAGES) == []
    damage(next((out / kind).glob("000003.*")))
    assert dataset.missing_images(out, IMAGES) == [3]


def test_a_sensor_adds_its_images_and_a_damaged_one_is_missing(scene: pathlib.Path, tmp_path: pathlib.Path) -> None:
    out = tmp_path / "set"
    sensors = (MultispectralMount("bands", "optical", "rededge_mx", size=(64, 48)),)
    plan = DatasetPlan(_mix(scene), 5, (64, 48), sensors=sensors)
    dataset.prepare_folder(plan, out, 1)
    assert list(dataset.render_images(plan, out, [0])) == [0]
    assert dataset.missing_images(out, 1) == []
    record = json.loads((out / "records" / "000000.json").read_text())
    assert record["sensors"]["bands"]["full_scale"] == 32768
    nir = cv2.imread(str(out / "bands" / "nir" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert (nir.shape, nir.dtype) == ((48, 64), np.uint16)
    before = nir.copy()
    (out / "bands" / "nir" / "000000.png").unlink()
    assert dataset.missing_images(out, 1) == [0]
    list(dataset.render_images(plan, out, [0]))
    after = cv2.imread(str(out / "bands" / "nir" / "000000.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(after, before)
    with pytest.raises(DatasetError, match="was begun with sensors"):
        dataset.prepare_folder(DatasetPlan(_mix(scene), 5, (64, 48)), out, 1)


@pytest.mark.long
def test_the_same_command_renders_damaged_images_again(
    scene: pathlib.Path, whole: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    out = tmp_path / "set"
    shutil.copytree(whole, out)
    _truncate(out / "images" / "000002.png")
    (out / "depth" / "000005.png").unlink()
    done = programs.run(_command(scene, out, 1), timeout=deadline())
    assert done.returncode == 0, done.stderr
    assert f"{IMAGES} images (5 train, 1 val, 0 test), 2 of them new" in done.stdout
    assert _files(out) == _files(whole)


def test_fewer_images_than_there_are_are_refused(
    scene: pathlib.Path, whole: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    """Lists and folders would tell of different data sets."""
    plan = DatasetPlan(_mix(scene), 5, (160, 120), LIFE)
    before = _files(whole)
    with pytest.raises(DatasetError, match=r"holds image 000005, .*3 images.* give --images 6 or more") as said:
        dataset.prepare_folder(plan, whole, 3)
    assert "\n" not in str(said.value)
    dataset.prepare_folder(plan, whole, IMAGES + 1)
    assert _files(whole) == before


def test_all_images_of_a_vineyard_are_in_one_split_that_never_changes(whole: pathlib.Path) -> None:
    splits = [dataset.split_of(image) for image in range(1000)]
    for vineyard in range(200):
        first = vineyard * dataset.IMAGES_PER_VINEYARD
        assert len(set(splits[first : first + dataset.IMAGES_PER_VINEYARD])) == 1
    assert [splits.count(split) for split in dataset.SPLITS] == [800, 100, 100]
    assert set(splits[:11]) == set(dataset.SPLITS)  # a small data set has all three
    images = json.loads((whole / "annotations.json").read_text())["images"]
    records = [json.loads(p.read_text()) for p in sorted((whole / "records").glob("*.json"))]
    assert [one["split"] for one in images] == [one["split"] for one in records] == splits[:IMAGES]
    vineyards = {(one["scene"]["digest"], one["split"]) for one in records}
    assert len(vineyards) == len({digest for digest, _ in vineyards}) == 2


def test_yolo_finds_every_image_and_its_labels_from_any_folder(
    whole: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the rules of Ultralytics: ``path``, unless given, is the folder of data.yaml; a list's ``./`` is its folder;
    the last ``images`` of a path becomes ``labels``."""
    monkeypatch.chdir(tmp_path)
    lines = dict(line.split(": ") for line in (whole / "data.yaml").read_text().splitlines() if line != "names:")
    assert lines.pop("  0") == "bunch"
    assert list(lines) == ["train", "val"]  # no `path`: it would be relative to the working folder
    assert not (whole / "test.txt").exists()  # it would be empty
    found = {}
    for split, name in lines.items():
        listed = (whole / name).read_text().splitlines()
        assert all(one.startswith("./") for one in listed)
        found[split] = [whole / one for one in listed]
        for image in found[split]:
            assert image.is_file()
            assert (whole / "labels" / f"{image.stem}.txt").is_file()
    assert sorted(image for images in found.values() for image in images) == sorted((whole / "images").glob("*.png"))
    assert [len(found[split]) for split in lines] == [5, 1]
    assert [dataset.split_needs(split) for split in dataset.SPLITS] == [1, 6, 11]


def test_what_stops_a_worker_is_one_line(scene: pathlib.Path, tmp_path: pathlib.Path) -> None:
    bare = tmp_path / "bare.toml"
    bare.write_text(scene.read_text().replace("[6, 8]", "[0, 0]"))
    done = programs.run(_command(bare, tmp_path / "set", 1), timeout=deadline(300.0))
    assert done.returncode == 2
    assert [line for line in done.stderr.splitlines() if line.strip()] == [
        "vinesim: scene 'one vine' bears no bunch to look at; raise fruit.bunches"
    ]
    assert list(_files(tmp_path / "set")) == ["dataset.json"]


# ---- one picture -----------------------------------------------------------------------------------------------------


def _render(out: pathlib.Path, **changed) -> int:
    given = {"camera": "d435", "at": "0.4,1.2,1.3", "look": "3,1,1.7", "size": "160x120", "seed": None, "out": out}
    return render(changed.pop("scene", "demo"), **{**given, **changed})


def test_a_picture_and_its_truth(tmp_path: pathlib.Path) -> None:
    assert _render(tmp_path / "shot") == 0
    names = {"rgb.png", "depth.png", "measured.png", "labels.png", "overlay.png", "camera.json", "truth.json"}
    assert {p.name for p in (tmp_path / "shot").iterdir()} == names
    camera = json.loads((tmp_path / "shot/camera.json").read_text())
    assert camera["k"][0] == camera["k"][4] == pytest.approx(617.0 / 4)
    assert camera["position"] == [0.4, 1.2, 1.3]
    assert _turned(camera["quaternion_xyzw"], np.array([[0.0, 0.0, 1.0]]))[0] @ [2.6, -0.2, 0.4] > 0.99 * 2.63
    ids = _ids(tmp_path / "shot/labels.png")
    said = json.loads((tmp_path / "shot/truth.json").read_text())
    for one in said["bunches"]:
        assert one["pixels"] == (ids == one["label"]).sum() == coco_mask.area(one["mask"])
    assert sum(one["pixels"] > 0 for one in said["bunches"]) > 5


@pytest.mark.parametrize(
    ("changed", "error", "words"),
    [
        ({"camera": "kinect"}, DataFileNotFound, "d435, dslr, phone, pinhole, raspberry_pi"),
        ({"size": "99999x4"}, SensorError, "16x16 to 4096x4096"),
        ({"size": "640*480"}, UsageError, "WxH"),
        ({"at": "1,2"}, UsageError, "X,Y,Z"),
        ({"at": "1,2,nan"}, UsageError, "X,Y,Z"),
        ({"look": "0.4,1.2,1.3"}, UsageError, "the position of the camera"),
        ({"at": "1,2,-0.1"}, UsageError, "below the ground"),
        ({"at": "0,0,1"}, UsageError, "inside"),
        ({"robots": ["vinebot"]}, UsageError, "give NAME@X,Y,YAW"),
        ({"robots": ["vinebot@1"]}, UsageError, "--robot is at '1'; give X,Y,YAW"),
        ({"robots": ["dalek@1,2"]}, DescriptionError, "dalek.* give a path or one of: logistic, vinebot"),
        ({"robots": ["vinebot@0.1,0.1"]}, PlacementError, r"robot_0 stands \d+ cm deep in (trunk|pole)"),
        ({"people": ["1,1,0,dance"]}, UsageError, "posture 'dance' is none of stand, pick"),
        ({"people": ["1,1.2", "1.1,1.2"]}, PlacementError, "person_. stands .* deep in person_.; move one"),
        ({"crates": ["1,1,0,1.5"]}, UsageError, "the fill is 1.5; give 0"),
        ({"crates": ["1,inf"]}, UsageError, "--crate is at '1,inf'; give X,Y,YAW,FILL"),
    ],
)
def test_what_cannot_be_drawn_is_said(tmp_path: pathlib.Path, changed: dict, error: type, words: str) -> None:
    with pytest.raises(error, match=words) as said:
        _render(tmp_path / "shot", **changed)
    assert "\n" not in str(said.value)
    assert not (tmp_path / "shot").exists()


def test_a_picture_with_actors(tmp_path: pathlib.Path) -> None:
    """Whoever is asked for is there, where asked, with a label that truth tells; the vineyard is the same one."""
    things = {"robots": ["vinebot@3,1.3,-2.5"], "people": ["2.2,0.9,2.4,pick"], "crates": ["1.6,1.4,0.2,0.25"]}
    assert _render(tmp_path / "shot", look="2.2,1.2,0.6", **things) == 0
    assert _render(tmp_path / "bare", look="2.2,1.2,0.6") == 0
    said, bare = (json.loads((tmp_path / name / "truth.json").read_text()) for name in ("shot", "bare"))
    ids = _ids(tmp_path / "shot/labels.png")
    depth = cv2.imread(str(tmp_path / "shot/depth.png"), cv2.IMREAD_UNCHANGED) * 1e-3
    assert said["digest"] == bare["digest"]
    assert [one["kind"] for one in said["actors"]] == ["robot", "human", "box"]
    camera = json.loads((tmp_path / "shot/camera.json").read_text())
    fx, _, cx, _, fy, cy = camera["k"][:6]
    for one in said["actors"][:2]:
        rows, columns = np.nonzero((ids == one["label"]) & (depth > 0))
        assert one["pixels"] == (ids == one["label"]).sum() > 50
        z = depth[rows, columns]
        points = _turned(camera["quaternion_xyzw"], np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], 1))
        away = np.hypot(*(points + camera["position"] - [one["x"], one["y"], 0.0])[:, :2].T)
        assert np.quantile(away, 0.95) < 0.8
    loose = [one for one in said["bunches"] if not one["attached"]]
    assert loose
    assert all(one["cut"] is None for one in loose)


def test_a_camera_of_absurd_resolution_is_refused(tmp_path: pathlib.Path) -> None:
    text = (pathlib.Path(dataset.__file__).parents[3] / "data/cameras/d435.toml").read_text()
    (tmp_path / "huge.toml").write_text(text.replace("width = { value = 640", "width = { value = 640000"))
    with pytest.raises(SensorError, match="width is 640000 px; give 1 to 8192 px"):
        _render(tmp_path / "shot", camera=str(tmp_path / "huge.toml"), size=None)


def test_a_camera_without_range_is_refused(tmp_path: pathlib.Path) -> None:
    text = (pathlib.Path(dataset.__file__).parents[3] / "data/cameras/d435.toml").read_text()
    (tmp_path / "blind.toml").write_text(text.replace("nearest = { value = 0.158", "nearest = { value = 10.0"))
    with pytest.raises(SensorError, match="an empty range"):
        _render(tmp_path / "shot", camera=str(tmp_path / "blind.toml"))
