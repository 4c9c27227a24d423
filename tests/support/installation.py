"""An environment as a user has it: vinesim from its wheel, the other packages from the environment of the tests."""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys
import sysconfig
import venv

from tests.support.page_blocks import ROOT


def build(folder: pathlib.Path, *targets: str) -> list[pathlib.Path]:
    """Build "wheel" or "sdist" of the checkout into ``folder``, without a network. Returns their paths."""
    command = [sys.executable, "-m", "hatchling", "build", "--directory", str(folder)]
    for target in targets:
        command += ["--target", target]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return sorted(folder.iterdir())


OF_THE_TESTS = {"PYTHONPATH", "VIRTUAL_ENV", "LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
"""Environment variables that belong to the environment of the tests; the wheels of ROS set the last two."""


class Installation:
    """A virtual environment in ``folder`` into which a wheel is installed."""

    def __init__(self, folder: pathlib.Path, wheel: pathlib.Path) -> None:
        venv.create(folder, with_pip=False, symlinks=True)
        self.bin = folder / "bin"
        python = str(self.bin / "python")
        (packages,) = folder.glob("lib/python*/site-packages")
        # the wheel's package comes first; addsitedir also runs the start-up files of the wheels of ROS
        theirs = pathlib.Path(sysconfig.get_path("purelib"))
        (packages / "others.pth").write_text(f"import site; site.addsitedir({str(theirs)!r})\n")
        # the wheels of ROS look for their libraries below sys.prefix, and a build of message packages for headers
        prefix = theirs.parents[2]
        needed = [*theirs.glob("ros_*.libs"), *theirs.parents[1].glob("*.so*"), prefix / "share"]
        for part in (*needed, *prefix.glob("include/*")):
            place = packages if part.parent == theirs else folder / part.parent.relative_to(prefix)
            if not (place / part.name).exists():
                (place / part.name).symlink_to(part)
        options = ["--quiet", "--disable-pip-version-check", "--no-deps", "--no-index", "--ignore-installed"]
        command = [python, "-m", "pip", "install", *options, str(wheel)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=self.environment())
        assert done.returncode == 0, done.stdout + done.stderr

    def environment(self) -> dict[str, str]:
        """Environment variables of a shell in which the environment is active, and the checkout is not on the path."""
        given = {name: value for name, value in os.environ.items() if name not in OF_THE_TESTS}
        return given | {"PATH": f"{self.bin}{os.pathsep}{os.environ['PATH']}", "MPLBACKEND": "Agg"}
