"""A stand-in for a sourced ROS 2: a folder laid out as ``/opt/ros/<distribution>``, with links to the files of the
wheels, and a Python environment without wheels of ROS."""

from __future__ import annotations

import importlib.metadata
import os
import pathlib
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Iterable

from tests.support.installation import OF_THE_TESTS
from tests.support.page_blocks import ROOT

DISTRIBUTION = "imaginary"
"""Name of the distribution, which no program can know."""
BOOTSTRAPPER = "ros_wheels_bootstrapper"


def _tops_of_ros() -> tuple[set[str], set[str]]:
    """Returns the names in site-packages that belong to the wheels of ROS, and those of packages that vinesim built."""
    wheels: set[str] = set()
    built: set[str] = set()
    for each in importlib.metadata.distributions(path=[sysconfig.get_path("purelib")]):
        name = (each.metadata["Name"] or "").lower()
        if name.startswith(("ros-", "vinesim")):
            tops = {file.parts[0] for file in each.files or ()} - {".."}
            (wheels if name.startswith("ros-") else built).update(tops)
    return wheels, built


def _link(files: Iterable[pathlib.Path], into: pathlib.Path) -> None:
    into.mkdir(parents=True, exist_ok=True)
    for file in files:
        (into / file.name).symlink_to(file)


class SourcedRos:
    """The stand-in in ``folder``, and the environment variables of a shell in which it is sourced."""

    def __init__(self, folder: pathlib.Path) -> None:
        packages = pathlib.Path(sysconfig.get_path("purelib"))
        root = packages.parents[2]
        wheels, built = _tops_of_ros()
        self.prefix = folder / "opt" / "ros" / DISTRIBUTION
        self.packages = self.prefix / packages.relative_to(root)
        _link((packages / top for top in wheels if BOOTSTRAPPER not in top), self.packages)
        _link((root / "lib").glob("*.so*"), self.prefix / "lib")
        _link((root / "share", root / "include"), self.prefix)

        environment = folder / "environment"
        venv.create(environment, with_pip=False, symlinks=True)
        (own,) = environment.glob("lib/python*/site-packages")
        others = [each for each in packages.iterdir() if each.name not in wheels | built | {"__pycache__"}]
        _link((each for each in others if not (own / each.name).exists()), own)
        self.python = environment / "bin" / "python"
        self.libraries = [self.prefix / "lib", *self.packages.glob("ros_*.libs")]

    def environment(self, **more: str) -> dict[str, str]:
        """Environment variables as a sourced ``setup.bash`` sets them, and ``more``."""
        given = {name: value for name, value in os.environ.items() if name not in OF_THE_TESTS}
        return {
            **given,
            "AMENT_PREFIX_PATH": str(self.prefix),
            "ROS_DISTRO": DISTRIBUTION,
            "PYTHONPATH": os.pathsep.join(map(str, (ROOT, self.packages))),
            "LD_LIBRARY_PATH": os.pathsep.join(map(str, self.libraries)),
            **more,
        }

    def start(self, *arguments: str, **environment: str) -> subprocess.Popen[str]:
        """Start Python with ``arguments``; its output is piped."""
        return subprocess.Popen(
            [str(self.python), *arguments],
            env=self.environment(**environment),
            cwd=self.prefix,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, *arguments: str, timeout: float, **environment: str) -> subprocess.CompletedProcess[str]:
        """Run Python with ``arguments``. Returns its exit code and output."""
        return subprocess.run(
            [str(self.python), *arguments],
            env=self.environment(**environment),
            cwd=self.prefix,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )


if __name__ == "__main__":  # python -m tests.support.sourced_ros FOLDER: to try a stand-in by hand
    made = SourcedRos(pathlib.Path(sys.argv[1]).resolve())
    names = ("AMENT_PREFIX_PATH", "ROS_DISTRO", "PYTHONPATH", "LD_LIBRARY_PATH")
    print("\n".join(f"export {name}={made.environment()[name]}" for name in names))
    print(f"# {made.python}")
