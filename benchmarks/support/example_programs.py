"""The ROS examples as programs of their users: in a folder and an environment in which vinesim cannot be imported."""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys
from typing import IO

from vinesim.ros.messages import message_packages

EXAMPLES = pathlib.Path(__file__).resolve().parents[2] / "examples" / "ros"
NAMES = tuple(sorted(path.name for path in EXAMPLES.glob("*.py")))
"""File names of all ROS examples."""
BLOCKER = 'raise ImportError("vinesim is hidden from the examples")\n'


def start_example(name: str, *arguments: str, folder: pathlib.Path, output: IO[str] | int) -> subprocess.Popen[str]:
    """Start an example whose output and errors go to ``output``. ``folder``: an own folder, in which it starts."""
    (folder / "vinesim.py").write_text(BLOCKER)
    message_packages.ensure_importable(["control_msgs", "tf2_msgs"])
    packages = [path for path in sys.path if "interfaces" in path]  # as if they were installed
    return subprocess.Popen(
        [sys.executable, str(EXAMPLES / name), *arguments],
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), *packages])},
    )


def handles_sigterm(process: int) -> bool:
    """Returns whether a process has set a handler of SIGTERM (Linux): an example does so before it opens ROS."""
    try:
        status = pathlib.Path(f"/proc/{process}/status").read_text()
    except OSError:
        return False
    caught = next((line for line in status.splitlines() if line.startswith("SigCgt:")), "SigCgt: 0")
    return bool(int(caught.split()[1], 16) >> 14 & 1)
