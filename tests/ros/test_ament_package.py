"""The folder ``ros/`` is an ament package: its manifest is valid, and what ``ros2 launch`` needs is installed."""

from __future__ import annotations

import importlib.util
import os
import pathlib
import re
import runpy
import shutil
import sys
import types

import pytest
from lxml import etree

from vinesim.core.version import __version__
from vinesim.ros import middleware
from vinesim.ros.messages import message_packages

ROOT = pathlib.Path(__file__).parents[2]
FOLDER = ROOT / "ros"
SCHEMAS = pathlib.Path(__file__).parent / "schemas"
"""XML schemas of package.xml as in REP 149 (ros-infrastructure/rep, folder xsd), unchanged."""
NAME = "vinesim_ros"


def schema() -> etree.XMLSchema:
    return etree.XMLSchema(etree.parse(SCHEMAS / "package_format3.xsd"))


def test_the_manifest_is_valid_by_the_schema_of_format_3() -> None:
    manifest = etree.parse(FOLDER / "package.xml")
    schema().assertValid(manifest)
    assert manifest.findtext("name") == NAME
    assert manifest.findtext("version") == __version__
    assert manifest.findtext("export/build_type") == "ament_python"


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("<version>0.1.0", "<version>0.1"),
        ("<name>vinesim_ros", "<name>Vinesim__ros"),
        ('format="3"', 'format="4"'),
        ("<license>Apache-2.0</license>", ""),
        ("exec_depend>", "run_depend>"),
        (' email="', ' mail="'),
    ],
)
def test_the_schema_refuses_what_the_format_forbids(right: str, wrong: str) -> None:
    text = (FOLDER / "package.xml").read_text()
    assert right in text
    assert not schema().validate(etree.fromstring(text.replace(right, wrong).encode()).getroottree())


def test_the_manifest_names_every_message_package_that_vinesim_imports() -> None:
    named = {one.text for one in etree.parse(FOLDER / "package.xml").findall("exec_depend")}
    imported = {
        package
        for path in (ROOT / "vinesim" / "ros").rglob("*.py")
        for package in re.findall(r"^\s*from (\w+_(?:msgs|interfaces))[. ]", path.read_text(), re.MULTILINE)
    }
    core = {"builtin_interfaces", "rcl_interfaces"}  # rclpy needs them
    assert imported - core <= named
    assert set(message_packages.available_packages()) <= named


def install(prefix: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    """Install the package as its setup.py says, without setuptools, which need not be there. Returns its share."""
    given: dict = {}
    stand_in = types.ModuleType("setuptools")
    stand_in.setup = given.update
    monkeypatch.setitem(sys.modules, "setuptools", stand_in)
    runpy.run_path(str(FOLDER / "setup.py"))
    assert (given["name"], given["version"]) == (NAME, __version__)
    for place, files in given["data_files"]:
        (prefix / place).mkdir(parents=True, exist_ok=True)
        for file in files:
            shutil.copy(FOLDER / file, prefix / place)
    return prefix / "share" / NAME


def test_an_installation_has_all_files_and_is_in_the_ament_index(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    share = install(tmp_path, monkeypatch)
    build = {"setup.py", "setup.cfg", "README.md", "resource", "install", "__pycache__"}
    assert {path.name for path in share.iterdir()} == {path.name for path in FOLDER.iterdir()} - build
    for folder in filter(pathlib.Path.is_dir, share.iterdir()):
        ours = {path.name for path in (FOLDER / folder.name).iterdir() if path.is_file()}
        assert {path.name for path in folder.iterdir()} == ours
    if middleware.unavailable_reason() is None:
        packages = pytest.importorskip("ament_index_python.packages")
        monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
        assert packages.get_package_share_directory(NAME) == str(share)


def test_the_installed_launch_file_starts_vinesim_with_installed_files(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """By the package launch where it is installed, with a program in the place of vinesim; no index of wheels has
    it."""
    share = install(tmp_path / "prefix", monkeypatch)
    programs = tmp_path / "programs"
    programs.mkdir()
    (programs / "vinesim").write_text('#!/bin/sh\necho "vinesim got: $*"\n')
    (programs / "vinesim").chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    text = (share / "vinebot.launch.py").read_text()
    assert "parameters.yaml" in text
    assert "vinebot.rviz" in text
    if importlib.util.find_spec("launch") is None:
        return
    from launch import LaunchDescription, LaunchService
    from launch.actions import IncludeLaunchDescription
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    service = LaunchService(noninteractive=True)
    source = PythonLaunchDescriptionSource(str(share / "vinebot.launch.py"))
    arguments = {"rviz": "false", "scene": "harvest"}.items()
    service.include_launch_description(
        LaunchDescription([IncludeLaunchDescription(source, launch_arguments=arguments)])
    )
    assert service.run() == 0
    said = capfd.readouterr()
    assert f"--scene harvest --robot vinebot --namespace  --params-file {share}/parameters.yaml" in said.out + said.err
