"""Prefetching: what a thread of a GPU will soon read comes nearer while it still computes.

A thread walks a tree body by body, and few threads share a multiprocessor: it would wait for memory at every body, since a
compiler loads nothing across a store or a branch. On a CPU nothing happens here.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

AHEAD = wp.constant(2)
"""Bodies ahead of the present one whose records are fetched, where little is computed for each."""

_PREFETCH = """
#if defined(__CUDA_ARCH__)
asm volatile("prefetch.global.L1 [%0];" :: "l"(a.data + i));
#endif
"""


@wp.func_native(_PREFETCH)
def prefetch_bool(a: wp.array(dtype=wp.bool), i: int): ...


@wp.func_native(_PREFETCH)
def prefetch_int(a: wp.array(dtype=wp.int32), i: int): ...


@wp.func_native(_PREFETCH)
def prefetch_vec2i(a: wp.array(dtype=wp.vec2i), i: int): ...


@wp.func_native(_PREFETCH)
def prefetch_float(a: wp.array(dtype=float), i: int): ...


@wp.func_native(_PREFETCH)
def prefetch_vec3(a: wp.array(dtype=wp.vec3), i: int): ...


@wp.func_native(_PREFETCH)
def prefetch_quat(a: wp.array(dtype=wp.quat), i: int): ...


@wp.func_native(_PREFETCH)
def prefetch_transform(a: wp.array(dtype=wp.transform), i: int): ...


@wp.func_native(_PREFETCH)
def prefetch_spatial(a: wp.array(dtype=wp.spatial_vector), i: int): ...


@wp.func_native(_PREFETCH)
def prefetch_mat33(a: wp.array(dtype=wp.mat33), i: int): ...
