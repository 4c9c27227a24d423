"""`vinesim demo`: a touch across real processes, with real Zenoh and ROS 2."""

import json
import os
import signal
import subprocess
import sys
import threading

import cv2
import numpy as np
import pytest

from tests.support.waiting import deadline

pytestmark = pytest.mark.slow

DEMO = [sys.executable, "-m", "vinesim", "demo", "--headless"]


def children_of(marker):
    """Processes whose command line holds ``marker``."""
    found = []
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{pid}/cmdline", "rb") as file:
                line = file.read().decode(errors="replace")
        except OSError:
            continue
        if marker in line and int(pid) != os.getpid():
            found.append(line.replace("\0", " "))
    return found


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    done = subprocess.run(
        [*DEMO, "--seconds", "20", "--out", str(out)], capture_output=True, text=True, timeout=deadline(900.0)
    )
    assert done.returncode == 0, done.stderr
    return out, json.loads((out / "summary.json").read_text())


@pytest.mark.ros
class TestDemo:
    def test_the_bunch_moves_within_one_tick_of_the_touch(self, run):
        _, summary = run
        assert summary["touch_to_motion_ticks"] <= 1
        assert 1.0 < summary["force_peak_n"] < 200.0

    def test_no_environment_byte_is_sent_without_a_peer_nearby(self, run):
        _, summary = run
        assert summary["ticks_touching_when_far"] > 0
        assert summary["environment_bytes_when_far"] == 0
        assert summary["environment_bytes_out"] > 0

    def test_the_copy_follows(self, run):
        _, summary = run
        error = summary["remote_displacement_error_mm"]
        assert error["peak_displacement"] > 10.0
        assert error["p50"] < 2.0, "mm; 0.3 to 0.7 on idle and busy machines"

    def test_time_slows_down_instead_of_tearing(self, run):
        """However slow or busy this machine is."""
        _, summary = run
        assert 0.0 < summary["real_time_factor"] < 1.02
        assert summary["steps_skipped"] == 0
        assert summary["lost"] == 0
        assert summary["pictures_per_simulated_second"] >= 5.0
        assert summary["scans_per_simulated_second"] >= 5.0

    def test_a_stock_node_receives_every_topic(self, run):
        """In 20 s: at least 10 Hz what every step publishes, several frames of each sensor; the rest at least once."""
        _, summary = run
        received = summary["ros_received"]
        camera = "/head_front_camera"
        minimum = {
            **dict.fromkeys(("/clock", "/joint_states", "/tf", "/visitor/joint_states"), 200),
            **dict.fromkeys(("/tf_environment", "/diagnostics"), 10),
            **dict.fromkeys(("/lidar/points", f"{camera}/rgb/image_raw", f"{camera}/rgb/camera_info"), 2),
            **dict.fromkeys((f"{camera}/depth/image_raw", f"{camera}/depth/camera_info"), 2),
        }
        latched = ("/tf_static", "/robot_description", "/tf_environment_static")
        once = (
            f"{camera}/depth/points",
            f"{camera}/labels",
            f"/visitor{camera}/rgb/image_raw",
            "/visitor/lidar/points",
        )
        assert [topic for topic in (*minimum, *latched, *once) if topic not in summary["start_s"]] == []
        assert {
            topic: received.get(topic, 0) for topic, count in minimum.items() if received.get(topic, 0) < count
        } == {}
        stamped = {topic: entry["stamps_rise"] for topic, entry in summary["ros_detail"].items() if entry["count"]}
        stamped.pop("/diagnostics", None)  # both clients publish it, each at its own moment
        assert [topic for topic, rise in stamped.items() if rise is False] == []

    def test_the_seconds_count_from_when_all_was_ready(self, run):
        """Clients, and every topic that is listened to, came before the seconds that were measured."""
        _, summary = run
        starts = summary["start_s"]
        assert starts.keys() >= {"picker", "visitor", *summary["ros_received"]} - {"/vine/contacts"}
        assert max(starts.values()) <= starts["ready"] + 1e-3
        for loop in summary["loops"].values():
            assert loop["tick_hz"] > 10.0

    def test_pictures_and_plot_are_there(self, run):
        out, _ = run
        rgb = cv2.imread(str(out / "rgb.png"))
        assert rgb.shape == (480, 640, 3)
        assert rgb.std() > 10.0
        depth = cv2.imread(str(out / "depth_mm.png"), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16
        measured = depth[depth > 0]
        assert measured.size > 0.5 * depth.size
        assert measured.min() >= 158  # what a D435 can measure
        assert measured.max() <= 10_000
        assert np.percentile(measured, 90) > 1000  # the vineyard fills the view behind any arm
        for name in ("labels.png", "depth.png", "touch.png"):
            assert cv2.imread(str(out / name)) is not None

    def test_no_process_remains(self, run):
        out, _ = run
        assert children_of(str(out)) == []


@pytest.mark.long
@pytest.mark.parametrize("job", ["push", "pick"])
def test_ctrl_c_ends_all_processes_of_a_background_demo(tmp_path, job):
    """The summary of a task tells how far it came; a push that was not measured to its end has none."""
    out = tmp_path / "interrupted"
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell does for "vinesim demo &"; children inherit it
    try:
        options = ["--job", job, "--seconds", "60", "--out", str(out)]
        demo = subprocess.Popen([*DEMO, *options], stderr=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, before)
    try:
        watchdog = threading.Timer(600.0, demo.kill)
        watchdog.start()
        for line in demo.stderr:
            if " Hz " in line:
                break
        watchdog.cancel()
        assert children_of(str(out))
        demo.send_signal(signal.SIGINT)
        _, rest = demo.communicate(timeout=deadline())
    finally:
        demo.kill()
    assert demo.returncode == 130
    assert "Traceback" not in rest
    assert children_of(str(out)) == []
    assert (out / "summary.json").exists() == (job == "pick")
    if job == "pick":
        summary = json.loads((out / "summary.json").read_text())
        assert summary["picked"] is False
        assert summary["reason"].startswith("stopped at ")
        assert summary["detail"]["attempts"] == 0
