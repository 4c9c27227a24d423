"""The C allocator: what a process frees goes back to the system."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.support.waiting import deadline

MEASURE = """
import sys
import numpy as np
from vinesim.core import allocator
if sys.argv[1] == "apart":
    allocator.keep_large_blocks_apart()
def resident():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmRSS")) / 1024.0
del_me = np.ones(31 << 17)  # 31 MiB: freed, it raises glibc's own threshold
del del_me
before = resident()
blocks = []
for _ in range(20):  # tables of 20 MiB, behind each a small one that stays
    blocks.append([np.ones(20 << 17), [bytes(1000) for _ in range(100)]])
for block in blocks:
    block[0] = None
print(resident() - before)
"""


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs /proc of Linux")
def test_freed_tables_leave_no_gaps_in_the_heap() -> None:
    """400 MiB of tables that are freed are gone, though small blocks were made between them and stay."""
    left = subprocess.run([sys.executable, "-c", MEASURE, "apart"], capture_output=True, text=True, check=True)
    assert float(left.stdout) < 20.0


GAPS = """
import time
import numpy as np
from vinesim.core import allocator
allocator.trim_regularly(0.2)
def resident():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmRSS")) / 1024.0
before = resident()
blocks = [np.ones(1 << 14) for _ in range(800)]  # 128 KiB each, one behind the other in the heap
del blocks[::2], blocks[:-1:2]  # what stays keeps the end of the heap where it is
while resident() - before > 40.0:
    time.sleep(0.05)
print(len(blocks))
"""


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs /proc of Linux")
def test_gaps_in_the_heap_are_given_back_in_time() -> None:
    """Of 100 MiB of small blocks one in four stays; the gaps are gone without a call."""
    done = subprocess.run(
        [sys.executable, "-c", GAPS], capture_output=True, text=True, check=True, timeout=deadline(60.0)
    )
    assert int(done.stdout) == 200
