"""A process that compiles kernel modules for the CPU. It reads module names from standard input and answers each one.

Several processes are used, because Warp compiles under locks, so that threads of one process would mostly compile one
module at a time. The process exits when its input ends, even while it compiles, so it never outlives its parent.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import queue
import shutil
import sys
import tempfile
import threading


def main() -> None:
    """Compile the module named by each line of standard input, and print a line of JSON with ``folder`` or
    ``failure``."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # all other output goes to standard error
    # a folder of its own, so that the compiler's files are deleted however the process ends
    tempfile.tempdir = tempfile.mkdtemp(prefix="vinesim-compiler-")
    names: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(names,), daemon=True).start()
    while True:
        name = names.get()
        try:
            answer = {"folder": _compile(name)}
        except Exception as error:
            answer = {"failure": f"{type(error).__name__}: {' '.join(str(error).split())}"}
        with contextlib.suppress(BrokenPipeError):  # the parent has ended; the end of the input ends this process
            print(json.dumps(answer), file=answers, flush=True)


def _read(names: queue.SimpleQueue[str]) -> None:
    """Put the lines of standard input into the queue ``names``; exit the process when the input ends."""
    for line in sys.stdin:
        names.put(line.strip())
    shutil.rmtree(tempfile.gettempdir(), ignore_errors=True)
    os._exit(0)


def _compile(name: str) -> str:
    """Compile module ``name`` unless it is compiled already. Returns the module's folder in Warp's cache."""
    import warp as wp

    module = wp.get_module(importlib.import_module(name).__name__)
    wp.force_load("cpu", [module], max_workers=0)
    return module.get_module_identifier(1)


if __name__ == "__main__":
    main()
