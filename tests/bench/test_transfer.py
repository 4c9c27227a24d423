"""``python -m benchmarks transfer``: reading pictures, dividing them, and scores; training needs PyTorch."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from PIL import Image

from benchmarks import transfer
from benchmarks.__main__ import main
from benchmarks.support import bunch_pictures
from benchmarks.support.bunch_pictures import BunchPicture, Collection, mask_boxes
from benchmarks.support.detection_scores import LEVELS, average_precision, f1_curve, score_picture, total_scores
from vinesim.core.errors import UsageError
from vinesim.scene.ids import Organ, label
from vinesim.sensors.export.annotations import encode_labels


def made_picture(name: str, bunches: np.ndarray) -> BunchPicture:
    rgb = np.where(bunches[..., None] > 0, (60, 180, 60), (120, 90, 60)).astype(np.uint8)
    return BunchPicture(name, rgb, bunches.astype(np.uint16), mask_boxes(bunches))


def two_bunches() -> np.ndarray:
    bunches = np.zeros((60, 80), np.uint16)
    bunches[10:30, 10:30] = 1
    bunches[35:55, 40:60] = 2
    return bunches


# ---- photographs and data sets ---------------------------------------------------------------------------------------


def test_masks_are_read_as_numbers_as_two_values_and_as_layers(tmp_path):
    bunches = two_bunches()
    layers = np.stack([bunches == 1, bunches == 2], -1)
    for stem in ("a_CDY", "b_SYH", "c_SYH", "d_CDY"):
        Image.new("RGB", (80, 60)).save(tmp_path / f"{stem}.jpg")
    Image.fromarray(bunches.astype(np.uint8)).save(tmp_path / "a_CDY.png")
    Image.fromarray(np.where(bunches, 255, 0).astype(np.uint8)).save(tmp_path / "b_SYH.png")
    np.savez(tmp_path / "c_SYH.npz", layers)
    (tmp_path / "d_CDY.txt").write_text("0 0.25 0.5 0.1 0.2\n")
    *masked, boxed = bunch_pictures.read_photographs(tmp_path)
    for picture in masked:
        np.testing.assert_array_equal(picture.bunches, bunches)
        np.testing.assert_array_equal(picture.boxes, [(10, 10, 30, 30), (40, 35, 60, 55)])
    assert boxed.bunches is None
    np.testing.assert_allclose(boxed.boxes, [(16, 24, 24, 36)])


def test_large_photographs_are_reduced_with_their_masks_and_boxes(tmp_path):
    bunches = np.zeros((1000, 1536), np.uint8)
    bunches[200:400, 300:500] = 1
    Image.new("RGB", (1536, 1000)).save(tmp_path / "a.jpg")
    Image.fromarray(bunches).save(tmp_path / "a.png")
    (tmp_path / "a.txt").write_text("0 0.5 0.5 0.5 0.5\n")
    (picture,) = bunch_pictures.read_photographs(tmp_path)
    assert picture.rgb.shape == (500, 768, 3)
    assert (picture.bunches > 0).sum() == 100 * 100
    np.testing.assert_allclose(picture.boxes, [(192, 125, 576, 375)])


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "holds no photograph"),
        ({"a.jpg": b"no picture"}, "a.jpg cannot be read"),
        ({"a.npz": b"no arrays"}, "a.npz is no file of masks"),
        ({"a.txt": b"0 0.5 half"}, "a.txt, line 1 is '0 0.5 half'"),
    ],
)
def test_what_cannot_be_read_is_one_clear_line(tmp_path, files, message):
    if files and "a.jpg" not in files:
        Image.new("RGB", (80, 60)).save(tmp_path / "a.jpg")
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(UsageError, match=message) as caught:
        bunch_pictures.read_photographs(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_mask_of_another_size_is_refused(tmp_path):
    Image.new("RGB", (80, 60)).save(tmp_path / "a.jpg")
    Image.new("L", (40, 30)).save(tmp_path / "a.png")
    with pytest.raises(UsageError, match=r"a.png has 40x30 px, but its picture 80x60; give a mask of the same size"):
        bunch_pictures.read_photographs(tmp_path)


def write_dataset(folder, count: int) -> None:
    labels = np.full((60, 80), label(Organ.LEAF, 7), np.int32)
    labels[10:30, 10:30] = label(Organ.BUNCH, 300)
    labels[35:55, 40:60] = label(Organ.BUNCH, 70000)
    for name in ("images", "ids"):
        (folder / name).mkdir(parents=True)
    for number in range(count):
        Image.new("RGB", (80, 60), (number, 0, 0)).save(folder / f"images/{number:06d}.png")
        Image.fromarray(encode_labels(labels)).save(folder / f"ids/{number:06d}.png")


def test_the_bunches_of_a_data_set_are_those_of_its_labels(tmp_path):
    write_dataset(tmp_path, 3)
    pictures = bunch_pictures.read_dataset(tmp_path, 2)
    assert [p.name for p in pictures] == ["000000", "000001"]
    np.testing.assert_array_equal(pictures[1].bunches, two_bunches())
    assert [p.name for p in bunch_pictures.read_dataset(tmp_path, 5, skip=1)] == ["000001", "000002"]
    with pytest.raises(UsageError, match=r"--skip is 3, but .* holds 3 pictures; skip fewer"):
        bunch_pictures.read_dataset(tmp_path, skip=3)
    (tmp_path / "ids/000001.png").unlink()
    with pytest.raises(UsageError, match="run `vinesim dataset` again"):
        bunch_pictures.read_dataset(tmp_path)


def test_a_pack_contains_all_pictures(tmp_path):
    """Masks and boxes are the same; colours of a smooth picture differ by what JPEG loses."""
    pictures = Collection({"real": [made_picture("a", two_bunches())]}, {"ours": [made_picture("b", two_bunches())]})
    without = BunchPicture("c", np.zeros((20, 30, 3), np.uint8), None, np.array([(1.0, 2.0, 3.0, 4.5)]))
    pictures.photographs["real"].append(without)
    file = tmp_path / "pack.zip"
    bunch_pictures.write_pack(pictures, file, 95)
    found = bunch_pictures.read_packs([file])
    assert [p.name for p in found.photographs["real"]] == ["a", "c"]
    assert found.photographs["real"][1].bunches is None
    np.testing.assert_array_equal(found.photographs["real"][1].boxes, without.boxes)
    (ours,) = found.synthetic["ours"]
    np.testing.assert_array_equal(ours.bunches, two_bunches())
    assert np.abs(ours.rgb.astype(int) - pictures.synthetic["ours"][0].rgb).mean() < 4.0
    assert len(bunch_pictures.read_packs([file, file]).synthetic["ours"]) == 2


def test_other_files_are_no_packs(tmp_path):
    (tmp_path / "a.zip").write_bytes(b"no pack")
    with pytest.raises(UsageError, match=r"--packed .*a.zip is no pack"):
        bunch_pictures.read_packs([tmp_path / "a.zip"])


# ---- which pictures are learnt from and tested on --------------------------------------------------------------------


def photographs(counts: dict[str, int]) -> list[BunchPicture]:
    return [made_picture(f"{k:02d}_{group}", two_bunches()) for group, n in counts.items() for k in range(n)]


def test_photographs_are_divided_with_equal_shares_of_all_varieties():
    pictures = Collection({"wgisd": photographs({"CDY": 9, "SYH": 6, "SVB": 3}), "other": photographs({"X": 2})})
    learnt, tests = transfer.divide(pictures)
    groups = [p.group for p in learnt]
    assert {g: groups.count(g) for g in set(groups)} == {"CDY": 3, "SYH": 2, "SVB": 1}
    assert {p.name for p in learnt}.isdisjoint(p.name for p in tests["wgisd"])
    assert len(learnt) + len(tests["wgisd"]) == 18
    assert len(tests["other"]) == 2
    assert [p.name for p in transfer.divide(pictures)[0]] == [p.name for p in learnt]


def test_photographs_without_masks_or_boxes_are_left_out():
    bare = BunchPicture("bare", np.zeros((8, 8, 3), np.uint8), None, np.zeros((0, 4)))
    _, tests = transfer.divide(Collection({"a": [*photographs({"CDY": 3}), bare]}))
    assert [p.name for p in tests["a"]].count("bare") == 0
    with pytest.raises(UsageError, match="none of its 1 photographs has masks"):
        transfer.divide(Collection({"a": [bare]}))
    with pytest.raises(UsageError, match="--photos b: no photograph has masks or boxes"):
        transfer.divide(Collection({"a": photographs({"CDY": 3}), "b": [bare]}))
    with pytest.raises(UsageError, match="give 1 to 2, so that"):
        transfer.divide(Collection({"a": photographs({"CDY": 3})}), learn=3)


def test_a_training_set_is_named_by_its_parts():
    synthetic = {"vsp": photographs({"V": 4}), "demo": photographs({"D": 3})}
    learnt = photographs({"CDY": 3, "SYH": 3})
    mixed = transfer.training_set("vsp:2+real:2", synthetic, learnt)
    assert [p.name for p in mixed.parts[0]] == ["00_V", "01_V"]
    assert sorted(p.group for p in mixed.parts[1]) == ["CDY", "SYH"]
    assert mixed.size == 4
    assert transfer.training_set("synthetic", synthetic, learnt).size == 7
    assert transfer.default_sets(Collection({}, synthetic), learnt) == [
        "vsp",
        "demo",
        "synthetic",
        "real",
        "synthetic+real:5",
    ]
    with pytest.raises(UsageError, match="there is no 'x'; there are: vsp, demo, synthetic, real"):
        transfer.training_set("x", synthetic, learnt)
    with pytest.raises(UsageError, match="'9' is no number of pictures; give 1 to 4"):
        transfer.training_set("vsp:9", synthetic, learnt)
    for folders in ({"real": learnt}, {"synthetic": learnt, "vsp": learnt}):
        with pytest.raises(UsageError, match="which stands for other pictures; rename it"):
            transfer.training_set("vsp", folders, learnt)
    with pytest.raises(UsageError, match="no pictures of 'synthetic'"):
        transfer.training_set("synthetic", {}, learnt)


# ---- scores ----------------------------------------------------------------------------------------------------------


def test_a_perfect_answer_has_perfect_scores():
    picture = made_picture("a", two_bunches())
    found = total_scores([score_picture(picture, (picture.bunches > 0).astype(np.float32))])
    assert (found.f1, found.f1_low, found.f1_high, found.iou, found.average_precision) == (1.0,) * 5
    assert (found.boxes, found.hits, found.false_blobs, found.false_specks) == (2, 2, 0, 0)


def test_scores_of_pixels_are_those_of_their_definitions():
    rng = np.random.default_rng(2)
    bunches = rng.random((60, 80)) < 0.3
    level = np.clip(rng.normal(np.where(bunches, 600, 400), 200).astype(int), 0, LEVELS - 1)
    picture = made_picture("a", bunches)
    found = total_scores([score_picture(picture, (level + 0.5) / LEVELS)])
    taken = level >= LEVELS // 2
    right = (taken & bunches).sum()
    assert found.f1 == pytest.approx(2 * right / (taken.sum() + bunches.sum()))
    assert found.iou == pytest.approx(right / (taken | bunches).sum())
    assert found.f1_low <= found.f1 <= found.f1_high
    precision = 0.0
    for threshold in np.unique(level):
        above = level >= threshold
        precision += (above & bunches).sum() / above.sum() * ((level == threshold) & bunches).sum() / bunches.sum()
    assert found.average_precision == pytest.approx(precision)
    best = max(2 * ((level >= t) & bunches).sum() / ((level >= t).sum() + bunches.sum()) for t in range(LEVELS))
    assert found.best_f1 == pytest.approx(best)


def test_without_bunches_nothing_is_divided_by_zero():
    none = np.zeros(LEVELS)
    assert np.isnan(average_precision(none, none + 1.0))
    assert (f1_curve(none, none) == 0.0).all()


@pytest.mark.parametrize(("columns", "hits"), [(5, 1), (4, 0)])
def test_a_box_is_hit_if_a_quarter_of_it_is_covered(columns, hits):
    bunches = np.zeros((60, 80), np.uint16)
    bunches[10:30, 10:30] = 1
    answer = np.zeros((60, 80))
    answer[10:30, 10 : 10 + columns] = 0.9
    assert score_picture(made_picture("a", bunches), answer).hits == hits


def test_blobs_are_false_outside_of_all_boxes_and_counted_by_size():
    answer = np.zeros((600, 800))
    bunches = np.zeros((600, 800), np.uint16)
    bunches[100:200, 100:200] = 1
    answer[150:300, 150:160] = 0.9  # reaches into the box
    answer[400:420, 400:420] = 0.9  # false
    answer[420:440, 420:440] = 0.9  # touches it at a corner: the same blob
    answer[500:502, 500:502] = 0.9  # a speck: 4 of 480,000 pixels
    found = score_picture(made_picture("a", bunches), answer)
    assert (found.false_blobs, found.false_specks) == (1, 1)


def test_photographs_with_boxes_alone_count_for_blobs_alone():
    boxed = BunchPicture("b", np.zeros((60, 80, 3), np.uint8), None, np.array([(10.0, 10.0, 30.0, 30.0)]))
    answer = np.zeros((60, 80))
    answer[12:30, 12:30] = 1.0
    found = total_scores([score_picture(boxed, answer)])
    assert np.isnan(found.f1)
    assert (found.photographs, found.masks, found.boxes, found.hits) == (1, 0, 1, 1)


def test_the_table_names_machine_protocol_and_scores():
    picture = made_picture("a", two_bunches())
    scores = total_scores([score_picture(picture, (picture.bunches > 0).astype(np.float32))])
    machine = {"date": "2026-01-02", "device": "card", "driver": "1.2", "torch": "2", "vinesim": "0"}
    protocol = {"steps": 800, "batch": 16, "crop": 384, "threshold": 0.5, "hit_share": 0.25, "min_blob_share": 1e-4}
    text = transfer.table([transfer.Row("vsp", 60, 1, "wgisd", 25.0, scores)], machine, protocol)
    assert text.startswith("2026-01-02, card, driver 1.2, PyTorch 2")
    assert "| vsp | 60 | 1 | wgisd, 1 | 1.000 (1.000 to 1.000) | 1.000 | 1.000 |" in text
    assert "| 2 / 2 | 0 (0) | 0.0 | 25 |" in text


def test_found_pixels_and_boxes_are_drawn():
    picture = made_picture("a", two_bunches())
    sheet = transfer.contact_sheet([picture], [(picture.bunches > 0).astype(np.float32)])
    pixels = np.asarray(sheet).astype(int)
    assert sheet.size == (5 * 384, 384 * 60 // 80)
    assert pixels[96, 96, 2] > pixels[2, 2, 2] + 60  # magenta in the first bunch


# ---- the command -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "give --photos and --synthetic, or --packed"),
        (["--photos", "nowhere"], "there is no such folder"),
        (["--photos", ".", "--packed", "x"], "give --photos and --synthetic, or --packed"),
        (["--packed", "nowhere.zip"], "--packed nowhere.zip is no pack"),
        (["--photos", ".", "--steps", "0"], "--steps is 0: give 1 or more"),
        (["--photos", ".", "--crop", "100"], "--crop is 100: give a multiple of 32"),
        (["--photos", ".", "--pack", "nowhere/pack.zip"], "there is no folder nowhere"),
    ],
)
def test_wrong_options_are_one_clear_line(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    assert main(["transfer", *words]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("reading ")]
    assert len(lines) == 1
    assert message in lines[0]


def test_folders_are_packed_and_without_pytorch_the_remedy_is_named(tmp_path, monkeypatch, capsys):
    photos, ours, pack = tmp_path / "photos", tmp_path / "ours", tmp_path / "pack.zip"
    photos.mkdir()
    write_dataset(ours, 2)
    for stem in ("a", "b", "c"):
        Image.new("RGB", (80, 60)).save(photos / f"{stem}.jpg")
        Image.fromarray(two_bunches().astype(np.uint8)).save(photos / f"{stem}.png")
    assert main(["transfer", "--photos", str(photos), "--synthetic", str(ours), "--pack", str(pack)]) == 0
    capsys.readouterr()
    monkeypatch.setitem(sys.modules, "torch", None)
    assert main(["transfer", "--packed", str(pack)]) == 3
    assert "transfer needs the package torch, which is not installed: pip install torch" in capsys.readouterr().err
    assert transfer.main(["--packed", str(pack)]) == 3
