"""``vinesim render``: one viewpoint or many, and every way in which they can be wrong."""

from __future__ import annotations

import errno
import os
import pathlib

import cv2
import msgspec
import numpy as np
import pytest

from tests.support.long_rows import long
from vinesim.cli.render import _Stage, run
from vinesim.core.errors import UsageError, WriteError

HEADER = "x,y,z,look_x,look_y,look_z\n"


def render(out: pathlib.Path, **options: object) -> int:
    defaults = {"at": None, "look": None, "camera": "pinhole", "size": "160x120", "seed": None, "out": out}
    return run("demo", **defaults | options)  # type: ignore[arg-type]


def files(folder: pathlib.Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


@pytest.mark.parametrize("kind", ["json", *long("csv")])
def test_each_viewpoint_of_a_path_gives_the_picture_that_it_gives_alone(kind: str, tmp_path: pathlib.Path) -> None:
    points = [(0.4, 1.2, 1.3, 3.0, 1.0, 1.7), (1.0, 1.3, 1.2, 3.0, 1.0, 1.7), (0.4, 1.2, 1.3, 3.0, 1.0, 1.7)]
    path = tmp_path / f"tour.{kind}"
    if kind == "csv":
        path.write_text(HEADER + "".join(",".join(map(str, p)) + "\n" for p in points))
    else:
        names = HEADER.strip().split(",")
        path.write_bytes(msgspec.json.encode([dict(zip(names, p, strict=True)) for p in points]))
    assert render(tmp_path / "tour", path=path) == 0
    assert sorted(f.name for f in (tmp_path / "tour").iterdir()) == ["0000", "0001", "0002", "tour.json"]
    for number, point in enumerate(points[:2]):
        at, look = (",".join(map(str, part)) for part in (point[:3], point[3:]))
        render(tmp_path / "alone", at=at, look=look)
        assert files(tmp_path / "tour" / f"{number:04d}") == files(tmp_path / "alone")
    assert files(tmp_path / "tour" / "0000") == files(tmp_path / "tour" / "0002")
    assert files(tmp_path / "tour" / "0000") != files(tmp_path / "tour" / "0001")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEADER, "no viewpoint"),
        ("x,y,z\n1,2,3\n", "tour.csv:1: 0 columns are named 'look_x'; give the columns x, y, z"),
        (HEADER + "1,2,three,4,5,6\n", "three"),
        (HEADER + "1,2\n", "tour.csv:2: 2 cells, the header has 6"),
        (HEADER + "1,2,1.5,1,2,1.5\n", "viewpoint 0 looks at the position of the camera"),
        (HEADER + "0,0.5,1,2,2,1\n1,2,-1.5,1,2,1.5\n", "viewpoint 1 is below the ground"),
        (HEADER + "nan,2,1,1,2,1.5\n", "tour.csv:2: column 'x' is 'nan'; give a number"),
    ],
)
def test_a_wrong_path_is_named_before_anything_is_rendered(text: str, words: str, tmp_path: pathlib.Path) -> None:
    path = tmp_path / "tour.csv"
    path.write_text(text)
    with pytest.raises(UsageError) as caught:
        render(tmp_path / "out", path=path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_an_interrupted_tour_is_continued_and_no_other_is_mixed_with_it(tmp_path, monkeypatch, capsys) -> None:
    """The interruption comes with the second picture."""
    path = tmp_path / "tour.csv"
    path.write_text(HEADER + "0.4,1.2,1.3,3,1,1.7\n1,1.3,1.2,3,1,1.7\n")
    whole = tmp_path / "whole"
    tour = tmp_path / "tour"
    small = {"path": path, "size": "64x48"}
    render(whole, **small)
    rendered = []
    once = _Stage.render

    def interrupted(stage, viewpoint):
        rendered.append(viewpoint)
        if len(rendered) == 2:
            raise KeyboardInterrupt
        return once(stage, viewpoint)

    monkeypatch.setattr(_Stage, "render", interrupted)
    assert render(tour, **small) == 130
    assert f"stopped with 1 of 2 pictures in {tour}; run the same command to continue" in capsys.readouterr().out
    assert sorted(f.name for f in tour.iterdir()) == ["0000", "tour.json"]
    assert render(tour, **small) == 0
    assert len(rendered) == 3
    for name in ("0000", "0001"):
        assert files(tour / name) == files(whole / name)

    for options, words in (({"seed": 5}, r"a tour with seed \d+, not 5; give"), ({"time": 1.0}, "time 0.0, not 1.0")):
        with pytest.raises(UsageError, match=words):
            render(tour, **small, **options)
    path.write_text(HEADER + "0.4,1.2,1.3,3,1,1.7\n")
    with pytest.raises(UsageError, match="a tour with another path"):
        render(tour, **small)
    with pytest.raises(UsageError, match="pictures that are not of this tour"):
        render(tour / "0000", **small)
    rendered[:] = rendered[:1]
    assert render(tmp_path / "none", at="0.4,1.2,1.3", look="3,1,1.7", size="64x48") == 130
    assert not (tmp_path / "none").exists()


def test_a_sensor_looks_as_well_and_leaves_the_picture_as_it_is(tmp_path: pathlib.Path) -> None:
    view = {"at": "0.4,1.2,1.3", "look": "3,1,1.7"}
    render(tmp_path / "alone", **view)
    render(tmp_path / "both", **view, sensors=["multispectral:rededge_mx"])
    alone = files(tmp_path / "alone")
    both = files(tmp_path / "both")
    assert {name: both[name] for name in alone} == alone
    bands = ["blue", "green", "ndvi", "nir", "red", "red_edge"]
    assert sorted(both.keys() - alone.keys()) == ["rededge_mx.json", *(f"rededge_mx_{band}.png" for band in bands)]
    nir = cv2.imdecode(np.frombuffer(both["rededge_mx_nir.png"], np.uint8), cv2.IMREAD_UNCHANGED)
    assert (nir.shape, nir.dtype) == ((120, 160), np.uint16)
    record = msgspec.json.decode(both["rededge_mx.json"])
    assert [band["name"] for band in record["bands"]] == ["blue", "green", "red", "red_edge", "nir"]


@pytest.mark.parametrize(
    ("sensors", "words"),
    [
        (["radar:x"], "--sensor is 'radar:x'; give KIND:FILE, of the kind multispectral"),
        (["multispectral"], "give KIND:FILE"),
        (["camera:d435"], "of the kind multispectral"),
        (["multispectral:rededge_mx"] * 2, "two of the name 'rededge_mx'"),
    ],
)
def test_wrong_sensors_are_one_line(tmp_path: pathlib.Path, sensors: list[str], words: str) -> None:
    with pytest.raises(UsageError) as caught:
        render(tmp_path / "out", at="0.4,1.2,1.3", look="3,1,1.7", sensors=sensors)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_viewpoint_is_needed_and_only_once(tmp_path: pathlib.Path) -> None:
    with pytest.raises(UsageError, match="no viewpoint; give --at"):
        render(tmp_path, at="1,1,1")
    with pytest.raises(UsageError, match="leave out --at and --look"):
        render(tmp_path, at="1,1,1", path=tmp_path / "tour.csv")
    with pytest.raises(UsageError, match=r"tour\.json cannot be read: No such file"):
        render(tmp_path, path=tmp_path / "tour.json")
    (tmp_path / "tour.json").write_text('{"x": 1}')
    with pytest.raises(UsageError, match=r"tour\.json: is no list of objects"):
        render(tmp_path, path=tmp_path / "tour.json")


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: pathlib.Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(
        WriteError, match=r"--out .* cannot be written: Not a directory; free some space .* render again"
    ):
        render(tmp_path / "file" / "out", at="0.4,1.2,1.3", look="3,1,1.7")


def test_a_full_disk_leaves_the_picture_that_was_there(tmp_path: pathlib.Path) -> None:
    """All files of a picture are replaced, or none."""
    render(tmp_path, at="0.4,1.2,1.3", look="3,1,1.7")
    before = files(tmp_path)
    real = pathlib.Path.open

    def full(path: pathlib.Path, mode: str = "r", *rest, **options):
        if "w" in mode and "truth" in path.name:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(path, mode, *rest, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pathlib.Path, "open", full)
        with pytest.raises(WriteError, match="No space left on device") as said:
            render(tmp_path, at="0.4,1.2,1.4", look="3,1,1.7")
    assert said.value.exit_code == 5
    assert files(tmp_path) == before
    render(tmp_path, at="0.4,1.2,1.4", look="3,1,1.7")
    assert files(tmp_path).keys() == before.keys()
    assert files(tmp_path)["rgb.png"] != before["rgb.png"]
