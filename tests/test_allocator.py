"""The C allocator: what a process frees goes back to the system."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

MEASURE = """
import sys
import numpy as np
from vinesim import allocator
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
