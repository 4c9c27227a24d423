"""Warp kernels: plain arrays in, plain arrays out; one thread does one thing, and its docstring says what."""

import warp as wp

# Standard output belongs to the command that runs; Warp would greet there.
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
