"""Robot files as they are found: does each one load, stand, hold its pose, and is it visible with its colours?

``python -m benchmarks robot_files FOLDER...`` prints one JSON object a line for each robot file below the folders, then
the totals. No file is changed, and nothing is downloaded.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import pathlib
import time
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.scene.values import Measurement

STANDING = 5.0
"""[s] Simulated time for which a robot has to hold its pose."""
HELD = 0.01
"""[rad or m] Largest distance of a joint from its home position at which a robot counts as holding its pose."""
STILL = 1e-3
"""[m] Largest motion of the base of a robot that stands."""
SETTLING = 1.0
"""[s] Time in which a robot on legs comes to rest. The pose that it then has is the one that it has to hold."""
UPRIGHT = 0.1
"""[rad] Largest angle between a standing robot on legs and the vertical."""
TIME_LIMIT = 240.0
"""[s] Longest time for one robot file."""
PICTURE = (320, 240)
"""[px] Size of the picture in which a robot has to be visible."""
LEAST_PIXELS = 50
"""Number of pixels from which on a robot counts as visible."""


def robot_files(folders: Sequence[str]) -> Iterator[Measurement]:
    """Print a row for each robot file below ``folders``, and yield the totals."""
    files = sorted(file for folder in folders for file in find_robot_files(pathlib.Path(folder)))
    if not files:
        raise UsageError(f"{', '.join(folders)}: no robot files; give folders with URDF, xacro, SDF or MJCF files")
    rows = []
    for file in files:
        row = in_process(file)
        rows.append(row)
        print(json.dumps(row), flush=True)
    good = [row for row in rows if row["loads"]]
    for case, count in (
        ("files", len(rows)),
        ("load", len(good)),
        ("stand and hold their pose", sum(row["holds"] for row in good)),
        ("visible", sum(row["visible"] for row in good)),
        ("at most one warning", sum(row["warnings"] <= 1 for row in good)),
        ("refused in one line", sum(row["refused"] for row in rows if not row["loads"])),
    ):
        yield Measurement("robot_files", case, float(count), "robots")


def find_robot_files(place: pathlib.Path) -> list[pathlib.Path]:
    """Returns the robot files at a place: itself, or those below a folder. Files of MJCF and xacro that are parts of
    others are left out: those of MJCF without bodies or joints, and those of xacro whose name does not end with
    ``.urdf.xacro``."""
    if place.is_file():
        return [place]
    found = []
    for file in place.rglob("*"):
        suffix = file.suffix.lower()
        if not file.is_file() or suffix not in (".urdf", ".sdf", ".xacro", ".xml"):
            continue
        content = file.read_bytes()
        is_mjcf = b"<mujoco" in content and b"<mujocoinclude" not in content
        is_robot = is_mjcf and b"<worldbody" in content and b"<joint" in content
        if (
            suffix in (".urdf", ".sdf")
            or (suffix == ".xml" and is_robot)
            or (suffix == ".xacro" and b"<robot" in content and file.name.endswith(".urdf.xacro"))
        ):
            found.append(file)
    return found


def in_process(file: pathlib.Path) -> dict[str, Any]:
    """Returns the row of a robot file, measured in a process of its own, which may fail or take too long."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(False)
    process = context.Process(target=_measure_and_send, args=(file, sender))
    process.start()
    sender.close()
    row: dict[str, Any] = {"file": str(file), "loads": False, "refused": False, "error": "no answer in time"}
    if receiver.poll(TIME_LIMIT):
        try:
            row = receiver.recv()
        except EOFError:
            row["error"] = "the process ended"
    process.kill()
    process.join()
    return row


def _measure_and_send(file: pathlib.Path, sender: Connection) -> None:
    sender.send(measure(file))


def measure(file: pathlib.Path) -> dict[str, Any]:
    """Returns the row of a robot file."""
    from vinesim.robot.description.loader import load_description
    from vinesim.robot.description.urdf import DescriptionError

    warnings: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: warnings.append(record.getMessage())
    logging.getLogger().addHandler(handler)
    row: dict[str, Any] = {"file": str(file), "loads": False, "refused": False}
    began = time.perf_counter()
    try:
        description = load_description(str(file))
        row["load_s"] = round(time.perf_counter() - began, 2)
        row |= {"joints": len(description.joints), "links": len(description.link_anchors)}
        row |= {"sensors": len(description.sensors) + len(description.imus)}
        row |= _stand(description)
        row |= {"loads": True, "warnings": len(warnings)}
    except DescriptionError as error:
        row |= {"refused": "\n" not in str(error), "error": str(error)}
    except Exception as error:  # a defect, which the table shows
        row["error"] = f"{type(error).__name__}: {' '.join(str(error).split())}"
    if warnings:
        row["warning"] = warnings[0]
    return row


def _stand(description: Any) -> dict[str, Any]:
    """Returns how far a robot moves in :data:`STANDING` seconds, and how much of it is visible."""
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

    from vinesim.rigid.rigid_world import RigidWorld
    from vinesim.robot.description.extent import bounds, link_boxes
    from vinesim.robot.drives.controlled_robot import Robot
    from vinesim.scene.builder import assemble

    model = assemble([])
    rigid = RigidWorld(model)
    robot = Robot(rigid, description, "robot")
    kind = description.base_limits.kind
    start = rigid.base_state("robot")[0].copy()
    home = description.home
    drift = 0.0
    now = 0.0
    for step in range(round(STANDING / rigid.dt)):
        if kind == "free" and step == round(SETTLING / rigid.dt):
            start = rigid.base_state("robot")[0].copy()
            home = rigid.joint_state("robot")[0].copy()
            drift = 0.0
        robot.control(now)
        rigid.predict()
        rigid.integrate()
        now += rigid.dt
        position = rigid.joint_measurements("robot")[0]
        drift = max(drift, float(np.abs(position - home).max(initial=0.0)))
    end = rigid.base_state("robot")[0]
    moved = float(np.linalg.norm(end[:3] - start[:3]))
    tilt = float(np.arccos(np.clip(frames.to_matrix(end[3:])[2, 2], -1.0, 1.0)))
    holds = bool(np.isfinite([drift, moved, tilt]).all() and drift < HELD and moved < STILL and tilt < UPRIGHT)
    shapes = [shape for visual in rigid.visuals() for shape in visual.shapes]
    seen = {
        "base": kind,
        "tilt": float(f"{tilt:.2g}"),
        "drift": float(f"{drift:.2g}"),
        "moved_m": float(f"{moved:.2g}"),
        "holds": holds,
        "shapes": len(shapes),
        "colours": len({tuple(np.round(shape.rgba[:3], 2)) for shape in shapes}),
    }
    if not shapes:
        return seen | {"pixels": 0, "visible": False}
    box = bounds(link_boxes(description, etree.fromstring(description.urdf.encode())))
    assert box is not None, "a robot with shapes has bounds"
    pixels = _pixels(model, rigid, box)
    return seen | {"pixels": pixels, "visible": pixels >= LEAST_PIXELS}


def _pixels(model: Any, rigid: Any, box: np.ndarray) -> int:
    """Returns the number of pixels that show the robot, in a picture in which its ``box`` [2, 3] m fits."""
    from vinesim.scene.ids import LABEL_STRIDE, Organ
    from vinesim.scene.values import CameraInfo, CameraOutput
    from vinesim.sensors.camera.camera import Camera, CameraSpec
    from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot

    primitives = Primitives(model, grass=0.0)
    primitives.update(rest_snapshot(model, rigid.visuals(), rigid.visual_q()))
    middle = box.mean(axis=0)
    distance = 1.2 * float(np.linalg.norm(box[1] - box[0]))
    ahead = np.array([-1.0, -0.6, -0.4]) / np.linalg.norm([1.0, 0.6, 0.4])
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    turn = frames.from_matrix(np.stack([right, np.cross(ahead, right), ahead], axis=1))
    width, height = PICTURE
    info = CameraInfo(width, height, width / 1.2, width / 1.2, 0.5 * (width - 1), 0.5 * (height - 1), "view")
    camera = Camera(CameraSpec.load("pinhole"), info)
    pose = frames.pose(middle - distance * ahead, turn)
    frame = camera.render(primitives, pose, outputs=CameraOutput.LABELS)
    return int((frame.labels // LABEL_STRIDE == int(Organ.ROBOT)).sum())
