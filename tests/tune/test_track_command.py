"""``vinesim track``: from recorded pictures, ROS or a data set, to a CSV that ``vinesim tune`` fits; what is missing is
said in one line."""

from __future__ import annotations

import dataclasses
import json
import pathlib
from collections.abc import Callable

import cv2
import msgspec
import numpy as np
import pytest
from mcap.writer import Writer

from tests.support.long_rows import long
from tests.support.tuning import cane
from vinesim.cli.tune import run as run_tune
from vinesim.cli.tune import track as track_markers
from vinesim.core.errors import UsageError
from vinesim.scene.camera_geometry import project_points
from vinesim.scene.values import CameraInfo
from vinesim.sensors.recorded_pictures import LEVEL_POSE, RecordedPicturesError, read_pictures
from vinesim.tune import Experiment, Trajectory, TrajectoryError, measure, read_trajectory
from vinesim.tune.fit import specimen_toml

INFO = CameraInfo(320, 240, 300.0, 300.0, 159.5, 119.5, "optical")
# the balls are seen at whole mm
PINK = (224, 60, 130)
BLUE = (30, 60, 220)
RADIUS = 0.011 / 0.707
AWAY = 0.8
MARKERS = ["224,60,130", "middle=30,60,220"]
START = 1_732_415_000.25
"""[s] Stamp of the first picture: seconds since 1970, as ROS has them."""
_SUB = (np.arange(4) - 1.5) / 4.0


@pytest.fixture(scope="module")
def swing() -> Trajectory:
    """A cane of 5 GPa, 0.9 s before the middle of its pictures' left edge, without noise; two markers."""
    specimen = msgspec.structs.replace(cane(), segments=64, markers={"middle": 0.5})
    return measure(specimen, Experiment(duration=2.0, markers=("tip", "middle")), exact=True)


def picture(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours and depth [m] of balls at [2, 3] m, before a grey wall; a place that is NaN is not shown."""
    rgb = np.full((240, 320, 3), 120.0)
    depth = np.full((240, 320), 1.5, np.float32)
    for place, colour in zip(places, (PINK, BLUE), strict=True):
        if np.isnan(place).any():
            continue
        # the camera looks along y at the middle of tip and middle marker
        local = np.array([place[0] - 0.75, -place[2] - 0.1, AWAY])
        column, row = project_points(local, INFO)
        size = RADIUS / AWAY * INFO.fx
        x, y = (np.add.outer(np.arange(n), _SUB) for n in (320, 240))
        inside = ((x[None, :, None, :] - column) ** 2 + (y[:, None, :, None] - row) ** 2 < size**2).mean((2, 3))
        rgb += inside[..., None] * (np.array(colour) - rgb)
        depth[inside > 0.5] = AWAY - 0.707 * RADIUS
    return rgb.round().astype(np.uint8), depth


@pytest.fixture(scope="module")
def pictures(swing: Trajectory) -> list[tuple[np.ndarray, np.ndarray]]:
    position = swing.position.copy()
    position[30:33, 0] = np.nan  # the tip is hidden
    return [picture(places) for places in position]


Pictures = list[tuple[np.ndarray, np.ndarray]]


def write_bag(
    path: pathlib.Path,
    time: np.ndarray,
    pictures: Pictures,
    *,
    encoding: str = "rgb8",
    millimetres: bool = False,
    without: tuple[str, ...] = (),
    late: float = 0.0,
    size: tuple[int, int] | None = None,
    camera: CameraInfo = INFO,
) -> pathlib.Path:
    """An MCAP file as rosbag2 writes it, by the stock messages' own serialisation; depth ``late`` [s]. ``size``: width
    and height in the camera_info if these differ from the pictures'."""
    pytest.importorskip("rclpy")
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import CameraInfo as Info
    from sensor_msgs.msg import Image

    def stamp(message, t: float) -> None:
        message.header.frame_id = "odd"  # so that what follows is not aligned by chance
        message.header.stamp.sec = int(t)
        message.header.stamp.nanosec = round((t - int(t)) * 1e9)

    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        channels = {}
        for topic, kind in (("color/image_raw", Image), ("depth/image_raw", Image), ("color/camera_info", Info)):
            name = f"sensor_msgs/msg/{kind.__name__}"
            schema = writer.register_schema(name, "ros2msg", b"")
            if topic not in without:
                channels[topic] = writer.register_channel(f"/camera/{topic}", "cdr", schema)

        def put(topic: str, message, t: float) -> None:
            if topic in channels:
                now = round(t * 1e9)
                writer.add_message(channels[topic], now, serialize_message(message), now)

        for t, (rgb, depth) in zip(START + time, pictures, strict=True):
            height, width = depth.shape
            told = size or (width, height)
            info = Info(height=told[1], width=told[0], distortion_model="plumb_bob", d=[0.0] * 5)
            info.k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
            colours = rgb if encoding == "rgb8" else rgb[..., ::-1]
            image = Image(height=height, width=width, encoding=encoding, step=3 * width, data=colours.tobytes())
            far = Image(height=height, width=width, encoding="32FC1", step=4 * width, data=depth.tobytes())
            if millimetres:
                data = np.round(1e3 * depth).astype("<u2").tobytes()
                far = Image(height=height, width=width, encoding="16UC1", step=2 * width, data=data)
            for message, when in ((info, t), (image, t), (far, t + late)):
                stamp(message, when)
            put("color/camera_info", info, t)
            put("color/image_raw", image, t)
            put("depth/image_raw", far, t + 0.05)  # it arrives after the next colours
        writer.finish()
    return path


def write_dataset(folder: pathlib.Path, time: np.ndarray | None, pictures: Pictures) -> pathlib.Path:
    """A folder in the layout of ``vinesim dataset``."""
    for name in ("images", "measured", "records"):
        (folder / name).mkdir(parents=True)
    for i, (rgb, depth) in enumerate(pictures):
        cv2.imwrite(str(folder / "images" / f"{i:06d}.png"), rgb[..., ::-1])
        cv2.imwrite(str(folder / "measured" / f"{i:06d}.png"), np.round(1e3 * depth).astype(np.uint16))
        k = [INFO.fx, 0.0, INFO.cx, 0.0, INFO.fy, INFO.cy, 0.0, 0.0, 1.0]
        camera = {"width": 320, "height": 240, "k": k, "d": [0.0] * 5}
        camera |= {"position": LEVEL_POSE[:3].tolist(), "quaternion_xyzw": LEVEL_POSE[3:].tolist()}
        record = {"image": i, "camera": camera} | ({} if time is None else {"time": float(time[i])})
        (folder / "records" / f"{i:06d}.json").write_text(json.dumps(record))
    return folder


def run_track(recording: pathlib.Path, out: pathlib.Path, markers: list[str] = MARKERS, **options) -> Trajectory:
    options = {"image": None, "depth": None, "pose": None, "rate": None} | options
    assert track_markers(recording, markers, RADIUS, out, **options) == 0
    return read_trajectory(out)


@pytest.mark.parametrize(
    "kind", ["rgb8, metres", *long("data set with a rate", "bgr8, millimetres, a folder", "data set")]
)
def test_from_recorded_pictures_to_a_plant_file_by_commands_alone(
    kind: str, swing: Trajectory, pictures: Pictures, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture
) -> None:
    if kind == "rgb8, metres":
        recording = write_bag(tmp_path / "pull.mcap", swing.time, pictures)
    elif kind.startswith("bgr8"):
        recording = tmp_path / "pull"
        recording.mkdir()
        write_bag(recording / "pull_0.mcap", swing.time[:40], pictures[:40], encoding="bgr8", millimetres=True)
        write_bag(recording / "pull_1.mcap", swing.time[40:], pictures[40:], encoding="bgr8", millimetres=True)
    else:
        recording = write_dataset(tmp_path / "pull", swing.time if kind == "data set" else None, pictures)
    track = run_track(recording, tmp_path / "pull.csv", rate=30.0 if "rate" in kind else None)
    assert track.markers == ("tip", "middle")
    np.testing.assert_allclose(track.time, swing.time, atol=2e-6)
    assert np.flatnonzero(np.isnan(track.position[:, 0]).any(-1)).tolist() == [30, 31, 32]
    off = track.position - swing.position
    assert np.nanstd(off[..., [0, 2]], axis=0).max() < 3e-4  # a tenth of a pixel
    assert f"tip      found in {len(swing.time) - 3}" in capsys.readouterr().out
    model = tmp_path / "cane.toml"
    model.write_text(specimen_toml(msgspec.structs.replace(cane(3e9), markers={"middle": 0.5})))
    done = run_tune(
        tmp_path / "pull.csv", model, "modulus,damping", tmp_path / "fitted.toml", True, None, None, False, 0, 0, "cpu"
    )
    assert done == 0
    fit = json.loads(capsys.readouterr().out)
    assert fit["estimates"][0]["value"] == pytest.approx(5e9, rel=5e-3)
    assert 'grade = "FITTED"' in (tmp_path / "fitted.toml").read_text()


REFUSALS: dict[str, tuple[Callable[..., object], str]] = {
    "no such topic": (lambda bag, run: run(bag(), image="/camera/left"), "no topic /camera/left of images; there"),
    "no depth": (lambda bag, run: run(bag(without=("depth/image_raw",))), r"no topic of images with depth .* --depth"),
    "no camera_info": (lambda bag, run: run(bag(without=("color/camera_info",))), "no topic /camera/color/camera"),
    "depth of other times": (lambda bag, run: run(bag(late=0.016)), r"found in \d+ of \d+ .* none has depth there"),
    "other size": (lambda bag, run: run(bag(size=(640, 480))), r"camera_info \(480, 640\); record depth"),
    "no marker": (lambda bag, run: run(bag(), markers=["20,220,40"]), r"'tip' of colour 20,220,40 was found in none"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_what_is_missing_is_said_in_one_line(
    case: str, swing: Trajectory, pictures: Pictures, tmp_path: pathlib.Path
) -> None:
    attempt, words = REFUSALS[case]

    def bag(**options) -> pathlib.Path:
        return write_bag(tmp_path / "pull.mcap", swing.time[:12], pictures[:12], **options)

    with pytest.raises((RecordedPicturesError, TrajectoryError), match=words) as refused:
        attempt(bag, lambda recording, **options: run_track(recording, tmp_path / "out.csv", **options))
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "out.csv").exists()


def test_files_that_are_no_recording_are_refused(tmp_path: pathlib.Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "pull_0.db3").write_bytes(b"SQLite")
    (tmp_path / "text.mcap").write_text("time,x\n")
    (tmp_path / "empty" / "records").mkdir(parents=True)
    for name, words in (
        ("nothing", "is not there"),
        ("old", "is no MCAP or SQLite file"),
        ("text.mcap", "is no MCAP or SQLite file"),
        ("empty", "is empty"),
    ):
        with pytest.raises(RecordedPicturesError, match=words):
            list(read_pictures(tmp_path / name))


def test_a_dataset_without_times_asks_for_the_rate(pictures: Pictures, tmp_path: pathlib.Path) -> None:
    folder = write_dataset(tmp_path / "pull", None, pictures[:3])
    with pytest.raises(RecordedPicturesError, match="--rate"):
        list(read_pictures(folder))
    (folder / "measured" / "000001.png").unlink()
    with pytest.raises(RecordedPicturesError, match="no picture"):
        list(read_pictures(folder, rate=30.0))


def test_options_that_cannot_be_are_refused(tmp_path: pathlib.Path) -> None:
    for markers, words in ((["pink"], "R,G,B"), (["120,118,121"], "nearly grey"), (["300,0,0"], "R,G,B")):
        with pytest.raises(UsageError, match=words):
            run_track(tmp_path, tmp_path / "out.csv", markers)
    with pytest.raises(UsageError, match="quaternion of length 0"):
        run_track(tmp_path, tmp_path / "out.csv", pose=(0.0,) * 7)


def test_times_since_1970_keep_their_microseconds(swing: Trajectory, tmp_path: pathlib.Path) -> None:
    late = dataclasses.replace(swing, time=START + swing.time)
    late.write(tmp_path / "late.csv")
    np.testing.assert_allclose(read_trajectory(tmp_path / "late.csv").time - START, swing.time, atol=2e-6)


def test_balls_and_a_bare_cane_exclude_each_other(tmp_path) -> None:
    rest = (tmp_path / "track.csv", None, None, None, None)
    with pytest.raises(
        UsageError, match="give --marker and --radius of coloured balls, or --cane or --bunch and --base"
    ):
        track_markers(tmp_path, [], None, *rest)
    with pytest.raises(UsageError, match=r"is followed without balls; give --base X Y Z, and no --marker"):
        track_markers(tmp_path, MARKERS, RADIUS, *rest, tmp_path / "cane.toml", (0.0, 0.9, 0.0))
