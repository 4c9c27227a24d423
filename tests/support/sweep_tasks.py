"""Functions that processes of a sweep import by their names."""

from __future__ import annotations

import os
import pathlib
import signal

import vinesim


def square(number: int) -> int:
    return number * number


def fail_at_three(number: int) -> int:
    if number == 3:
        raise ValueError("three is not taken")
    return number


def die_once(task: tuple[str, int]) -> int:
    """Kills its process the first time that the third task runs; notes every run in a folder."""
    folder = pathlib.Path(task[0])
    number = task[1]
    runs = len(list(folder.glob(f"{number}-*")))
    (folder / f"{number}-{runs}").touch()
    if number == 3 and runs == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def swing(task: tuple[str, int]) -> bytes:
    """The state of a cane after 100 steps, whose tip mass is the task's number. The first process that runs the third
    task dies half-way. Every run notes its process in a folder."""
    folder = pathlib.Path(task[0])
    number = task[1]
    runs = len(list(folder.glob(f"{number}-*")))
    (folder / f"{number}-{runs}").write_text(str(os.getpid()))
    simulation = vinesim.Simulation(vinesim.CaneBuilder(tip_mass=0.01 * (1 + number), damping_ratio=0.1))
    simulation.step(50)
    if number == 3 and runs == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    simulation.step(50)
    state = simulation.state
    return b"".join(getattr(state, name).tobytes() for name in state.array_fields())


def die_at_three(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number
