"""Message packages built from definitions equal the official ones."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys

import pytest

from tests.support.progress_texts import collect_progress
from tests.support.waiting import deadline
from vinesim.core import disk_cache
from vinesim.ros import middleware
from vinesim.ros.messages import message_packages

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(middleware.unavailable_reason() is not None, reason=str(middleware.unavailable_reason())),
]

# As `ros2 topic info --verbose /tf` prints it on ROS 2 Jazzy.
OFFICIAL = {
    "tf2_msgs/msg/TFMessage": "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "tf2_msgs/msg/TF2Error": "RIHS01_db2485e7d6a0ec75bf087e058ee45df682acc3a621ca7780503d10aac141809a",
}

ASK_HASHES = """
import rclpy
from rclpy.context import Context
from vinesim.ros.messages import message_packages
message_packages.ensure_importable(["tf2_msgs"])
from tf2_msgs.msg import TF2Error, TFMessage
context = Context()
context.init([])
node = rclpy.create_node("ask", context=context, start_parameter_services=False)
for message in (TFMessage, TF2Error):
    node.create_publisher(message, message.__name__, 1)
    for info in node.get_publishers_info_by_topic("/" + message.__name__):
        print(info.topic_type, info.topic_type_hash)
node.destroy_node()
context.shutdown()
"""

BUILD = """
import sys
from vinesim.ros.messages import message_packages
sys.stdout.write(str(message_packages.build(['tf2_msgs'])['tf2_msgs']))
"""


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> str:
    return str(tmp_path_factory.mktemp("cache"))


@pytest.fixture
def own_cache(cache, monkeypatch) -> str:
    monkeypatch.setenv("XDG_CACHE_HOME", cache)
    return cache


@pytest.mark.long
def test_two_processes_build_at_once_and_agree(cache):
    surroundings = os.environ | {"XDG_CACHE_HOME": cache}
    builds = [
        subprocess.Popen([sys.executable, "-c", BUILD], env=surroundings, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    places = [build.communicate(timeout=deadline(600.0))[0] for build in builds]
    assert [build.returncode for build in builds] == [0, 0]
    assert places[0] == places[1]
    built = sorted(os.listdir(os.path.join(cache, "vinesim", "interfaces")))
    assert built == [os.path.basename(places[0])]  # no scratch left behind


def test_type_hashes_are_the_official_ones(own_cache):
    surroundings = os.environ | {"ROS_DOMAIN_ID": str(1 + os.getpid() % 100)}
    asked = subprocess.run(
        [sys.executable, "-c", ASK_HASHES],
        env=surroundings,
        capture_output=True,
        text=True,
        timeout=deadline(300.0),
        check=True,
    )
    assert dict(line.split() for line in asked.stdout.splitlines()) == OFFICIAL


def test_what_can_be_imported_is_not_built(own_cache, monkeypatch):
    def refuse(package: str):
        raise AssertionError(f"built {package}")

    monkeypatch.setattr(message_packages, "_build", refuse)
    message_packages.ensure_importable(["std_msgs", "sensor_msgs"])


def test_unknown_package_names_the_folder():
    with pytest.raises(
        message_packages.InterfacesError, match=r"'no_such_msgs'.*add its \.msg files to .*msgs/no_such_msgs"
    ):
        message_packages.build(["no_such_msgs"])


def test_missing_compiler_names_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    which = shutil.which
    monkeypatch.setattr(shutil, "which", lambda name: None if name == "g++" else which(name))
    with pytest.raises(message_packages.InterfacesError, match=r"g\+\+ is missing; apt install g\+\+"):
        message_packages.build(["tf2_msgs"])


def test_missing_generators_name_the_extra(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "rosidl_generator_py" else find(name))
    with pytest.raises(message_packages.InterfacesError, match=r"vinesim\[ros\]"):
        message_packages.build(["tf2_msgs"])


def test_a_changed_definition_changes_the_key(tmp_path, monkeypatch):
    before = message_packages.key("tf2_msgs")
    monkeypatch.setattr(message_packages, "DEFINITIONS", tmp_path)
    folder = tmp_path / "tf2_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "TFMessage.msg").write_text("geometry_msgs/TransformStamped[] transforms\nuint8 more\n")
    assert message_packages.key("tf2_msgs") != before


def test_a_build_shows_how_many_packages_are_done(tmp_path, monkeypatch):
    names = message_packages.available_packages()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    texts = collect_progress(monkeypatch)
    monkeypatch.setattr(message_packages, "_build", lambda _: tmp_path)
    message_packages.build(names)
    count = len(names)
    assert f"building ROS message packages, only once: {count} of {count} done" in texts


@pytest.mark.long
def test_a_client_shows_the_build_and_starts_its_processes_afterwards(tmp_path):
    kernels = str(disk_cache.user_folder() / "warp")
    usual_caches = {"WARP_CACHE_PATH": kernels, "VINESIM_CACHE": str(disk_cache.folder())}
    ran = subprocess.run(
        [sys.executable, "-m", "vinesim", "client", "--role", "robot", "--seconds", "1"],
        env=usual_caches | os.environ | {"XDG_CACHE_HOME": str(tmp_path), "ROS_DOMAIN_ID": str(1 + os.getpid() % 100)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=deadline(600.0),
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert "vinesim: building ROS message packages, only once: " in ran.stderr
    built = {place.name.rsplit("-", 1)[0] for place in (tmp_path / "vinesim" / "interfaces").iterdir()}
    assert built == set(message_packages.available_packages())
