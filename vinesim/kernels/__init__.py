"""Warp kernels. Their inputs and outputs are plain arrays; each docstring says what one thread does."""

import logging
import os
import tempfile

import warp as wp


def use_temporary_cache(reason: object) -> None:
    """Keep compiled kernels in a temporary folder, for this process and the processes that it starts.

    Logs one warning.
    """
    folder = tempfile.mkdtemp(prefix="vinesim-kernels-")
    logging.getLogger(__name__).warning(
        "compiled kernels are kept in %s for this time, as Warp's cache cannot be written (set WARP_CACHE_PATH): %s",
        folder,
        reason,
    )
    os.environ["WARP_CACHE_PATH"] = folder
    wp.config.kernel_cache_dir = os.path.join(folder, wp.config.version)
    os.makedirs(wp.config.kernel_cache_dir)


def _start_warp() -> None:
    """Start Warp without its greeting (standard output belongs to the command) and without its message about a missing
    GPU.

    A missing GPU is no reason to warn. Everything else that Warp writes to standard error is passed on.
    """
    level = max(wp.config.log_level, wp.LOG_WARNING)
    wp.config.log_level = wp.LOG_ERROR
    with tempfile.TemporaryFile() as words:
        standard_error = os.dup(2)
        os.dup2(words.fileno(), 2)
        try:
            try:
                wp.init()
            except OSError as error:  # Warp's cache folder cannot be created
                use_temporary_cache(error)
                wp.config.kernel_cache_dir = None  # as the environment has it, in all processes alike
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
