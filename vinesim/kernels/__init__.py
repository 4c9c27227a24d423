"""Warp kernels: plain arrays in, plain arrays out; one thread does one thing, and its docstring says what."""

import os
import tempfile

import warp as wp


def _start_warp() -> None:
    """Start Warp without its greeting (standard output belongs to the command) and without its words about a missing
    GPU, which is no reason to warn. Whatever else it writes to standard error is passed on.
    """
    level, wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING), wp.LOG_ERROR
    with tempfile.TemporaryFile() as words:
        standard_error = os.dup(2)
        os.dup2(words.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(standard_error, 2)
            os.close(standard_error)
            wp.config.log_level = level
        words.seek(0)
        for line in words:
            if b"Could not find or load the NVIDIA CUDA driver" not in line:
                os.write(2, line)


_start_warp()
