"""Warp kernels. Inputs and outputs are plain arrays; the docstring of each kernel states what one thread does."""

import logging
import os
import tempfile

import warp as wp


def use_temporary_cache(reason: object) -> None:
    """Store compiled kernels in a temporary folder, for this process and its child processes, and log a warning.

    ``reason``: why Warp's cache cannot be written, for the log.
    """
    folder = tempfile.mkdtemp(prefix="vinesim-kernels-")
    logging.getLogger(__name__).warning(
        "compiled kernels are stored in %s for this run only, because Warp's cache cannot be written "
        "(set WARP_CACHE_PATH to a writable folder): %s",
        folder,
        reason,
    )
    os.environ["WARP_CACHE_PATH"] = folder
    wp.config.kernel_cache_dir = os.path.join(folder, wp.config.version)
    os.makedirs(wp.config.kernel_cache_dir)


def _start_warp() -> None:
    """Initialise Warp without its greeting on standard output and without its warning about a missing GPU.

    Standard output is reserved for the results of commands, and vinesim also runs without a GPU. All other text that
    Warp writes to standard error is passed on.
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
                wp.config.kernel_cache_dir = None  # then WARP_CACHE_PATH decides, which child processes inherit
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
