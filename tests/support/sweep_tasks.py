"""Functions that processes of a sweep import by their names."""

from __future__ import annotations

import os
import pathlib
import signal


def square(number: int) -> int:
    return number * number


def fail_at_three(number: int) -> int:
    if number == 3:
        raise ValueError("three is not taken")
    return number


def die_once(task: tuple[str, int]) -> int:
    """Kills its process the first time that the third task runs; notes every run in a folder."""
    folder, number = pathlib.Path(task[0]), task[1]
    runs = len(list(folder.glob(f"{number}-*")))
    (folder / f"{number}-{runs}").touch()
    if number == 3 and runs == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def die_at_three(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number
