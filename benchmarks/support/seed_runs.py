"""Runs a benchmark seed by seed, in several processes if asked, and appends the result of each seed to a file as soon
as it is known, so that a long run can be continued."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import pathlib
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from vinesim.api.sweep import sweep
from vinesim.core.errors import UsageError
from vinesim.kernels.compilation import PHYSICS_PACKAGES, SENSOR_PACKAGES, compile_kernels

Line = dict[str, Any]
"""Result of one seed as plain values; a line of the file."""
_interrupted = threading.Event()
"""Set in a process that Ctrl-C has reached: its pool still gives it the seeds that wait in its queue."""


@dataclasses.dataclass(frozen=True)
class SeedRuns:
    """How the seeds of one benchmark are run and recorded."""

    work: Callable[[int], Line]
    """Returns the result of a seed. With several processes it must be possible to pickle it."""
    case: Line
    """Options of the benchmark that each line names: a line with other values is of another run."""
    summary: Callable[[Line], str]
    """Returns the text that announces a line when its seed has ended."""
    announce: Callable[[str], None]
    record: pathlib.Path | None = None
    """File of the lines. Seeds that it has are not run again."""

    def lines(self, seeds: Sequence[int], jobs: int = 1) -> list[Line]:
        """Returns a line of each seed, in the order of ``seeds``. ``jobs``: number of processes."""
        known = self._read()
        missing = [seed for seed in seeds if seed not in known]
        if jobs > 1 and len(missing) > 1:
            compile_kernels((*PHYSICS_PACKAGES, *SENSOR_PACKAGES))  # once, instead of in each process
            found = sweep(self, missing, workers=jobs)
        else:
            found = [self(seed) for seed in missing]
        known |= {line["seed"]: line for line in found}
        return [known[seed] for seed in seeds]

    def __call__(self, seed: int) -> Line:
        """Run one seed, record its line and return it. ``cpu_seconds`` is the time of the processor that it took."""
        if _interrupted.is_set():
            raise KeyboardInterrupt
        start = time.process_time()
        try:
            line = self.case | {"seed": seed} | self.work(seed)
        except KeyboardInterrupt:
            if multiprocessing.parent_process() is not None:
                _interrupted.set()
            raise
        line["cpu_seconds"] = round(time.process_time() - start, 1)
        if self.record is not None:
            # one write of a whole line at the end of the file: processes do not mix their lines
            with self.record.open("ab", buffering=0) as file:
                file.write((json.dumps(line) + "\n").encode())
        self.announce(f"seed {seed}: {self.summary(line)}, {line['cpu_seconds']:.0f} s of the processor")
        return line

    def _read(self) -> dict[int, Line]:
        """Returns the lines of this run that the file has, by seed."""
        if self.record is None or not self.record.exists():
            return {}
        found = {}
        for number, text in enumerate(self.record.read_text().splitlines(), 1):
            try:
                line = json.loads(text)
            except json.JSONDecodeError as error:
                raise UsageError(f"{self.record}, line {number}: no JSON ({error}); remove this line") from None
            if all(line.get(name) == value for name, value in self.case.items()):
                found[line["seed"]] = line
        return found
