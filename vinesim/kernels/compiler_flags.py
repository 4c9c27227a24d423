"""Flags of Warp's CPU compiler for modules whose loops over lanes must be vectorised."""

import warp as wp

INLINE_ALL = (wp.config.cpu_compiler_flags or "").replace("-inline-threshold=9000", "-inline-threshold=100000")
"""Warp's own, but functions of any size are inlined: a loop with a call is not vectorised, and a call copies all structs."""
