"""Flags of Warp's CPU compiler for modules in which LLVM must vectorise loops over the lanes of SIMD vectors."""

import warp as wp

INLINE_ALL = (wp.config.cpu_compiler_flags or "").replace("-inline-threshold=9000", "-inline-threshold=100000")
"""Warp's compiler flags with a higher inlining limit: LLVM does not vectorise loops with calls, and calls copy structs.
"""
