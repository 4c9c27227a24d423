"""Shared memory of Fast DDS that killed processes left is removed; that of living ones, or of others, is not."""

from __future__ import annotations

import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from tests.support.waiting import wait
from vinesim.ros import middleware
from vinesim.ros.dead_segments import FOLDER, SMALLEST, YOUNGEST, remove_dead_segments

HOLD = "import fcntl,sys,time; f=open(sys.argv[1]); fcntl.flock(f, fcntl.LOCK_EX); print(flush=True); time.sleep(600)"
PUBLISH = """
import sys, time
from vinesim.ros import middleware
middleware.configure()
import rclpy
rclpy.init()
node = rclpy.create_node("owner")
print(flush=True)
time.sleep(600)
"""


def segment(folder: pathlib.Path, name: str, size: int = SMALLEST, age: float = 2 * YOUNGEST) -> pathlib.Path:
    path = folder / f"fastrtps_{name}"
    for one, length in ((path, size), (folder / f"{path.name}_el", 0)):
        with one.open("wb") as file:
            file.truncate(length)
        os.utime(one, (time.time() - age, time.time() - age))
    return path


def test_only_large_old_segments_that_are_not_locked_are_removed(tmp_path):
    dead = segment(tmp_path, "dead")
    held = segment(tmp_path, "held")
    small = segment(tmp_path, "small", size=549_408)
    young = segment(tmp_path, "young", age=0.0)
    unlockable = segment(tmp_path, "port7410")
    unlockable.with_name("fastrtps_port7410_el").unlink()
    other = tmp_path / "psm_01234567"
    other.write_bytes(b"x" * SMALLEST)
    owner = subprocess.Popen([sys.executable, "-c", HOLD, f"{held}_el"], stdout=subprocess.PIPE)
    try:
        assert owner.stdout is not None
        owner.stdout.readline()
        assert remove_dead_segments(tmp_path) == 1
        assert not dead.exists()
        assert not dead.with_name("fastrtps_dead_el").exists()
        assert all(path.exists() for path in (held, small, young, unlockable, other))
    finally:
        owner.kill()
        owner.communicate()
    assert remove_dead_segments(tmp_path) == 1
    assert not held.exists()


@pytest.mark.ros
@pytest.mark.skipif(middleware.unavailable_reason() is not None, reason=str(middleware.unavailable_reason()))
def test_the_segment_of_a_real_node_is_held_while_it_lives_and_removed_after_a_kill(monkeypatch):
    """The names and locks are those of the Fast DDS that is installed."""
    monkeypatch.setattr("vinesim.ros.dead_segments.YOUNGEST", 0.0)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    owner = subprocess.Popen([sys.executable, "-c", PUBLISH], stdout=subprocess.PIPE)
    try:
        assert owner.stdout is not None
        owner.stdout.readline()
        # the node also maps the segments of its peers, but opens the lock files of its own only
        opened = [os.readlink(file) for file in pathlib.Path(f"/proc/{owner.pid}/fd").iterdir()]
        locked = [pathlib.Path(name[:-3]) for name in opened if name.startswith(str(FOLDER)) and name.endswith("_el")]
        mine = [path for path in locked if path.exists() and path.stat().st_size >= SMALLEST]
        assert mine
        remove_dead_segments()
        assert all(path.exists() for path in mine)
    finally:
        owner.send_signal(signal.SIGKILL)
        owner.communicate()
    wait(lambda: (remove_dead_segments(), not any(path.exists() for path in mine))[1], "the segments to be removed")
