"""The camera rasteriser in Taichi: for all cores of a CPU, and for GPUs that Warp cannot use (Vulkan, Metal).

It reads the arrays of :mod:`vinesim.kernels.raster.primitives` and finds the same primitive in every pixel as Warp's
rasteriser. Some of these GPUs lack 64-bit atomics, so on a GPU depth and index of the nearest primitive are found in
two passes.

Only this module and :mod:`vinesim.sensors.raster.taichi_primitives` import Taichi. They must not import ``annotations``
from ``__future__``, because Taichi evaluates annotations.
"""

import contextlib
import ctypes
import functools
import io
from collections.abc import Iterator

import numpy as np
import taichi as ti
import warp as wp
from taichi.math import clamp, vec2, vec3, vec4

from vinesim.kernels.raster import pinhole
from vinesim.sensors.raster.primitive_arrays import PosedPrimitives
from vinesim.sensors.raster.taichi_primitives import KERNEL_FUNCTIONS, Lens, mat3

EMPTY_KEY = int(pinhole.EMPTY_KEY)
SMOOTH_SIZE = float(pinhole.SMOOTH_SIZE)
_NO_PRIMITIVE = 2**31 - 1
_INEXACT = 2**30
"""Number added to the index of a primitive that the second pass found a micrometre deeper than the first pass, because
the compiler may round differently in the two passes."""
_CORES = (64, 1)
_GPU = (24, 32)
"""Numbers of GPU threads that share the primitives of a cluster, and that share the rows of a primitive.

``_CORES`` has these numbers for a CPU, where Taichi assigns 512 iterations at a time to a core, including iterations
without work. So a core gets 8 clusters, few enough that no core gets all near ones."""
KEY, DEPTH, NUMBER = range(3)
"""Codes of a pass's result: keys (depth and index together); depths alone; the index of the primitive at known depth.
"""

Table = ti.types.ndarray(dtype=vec4, ndim=1)


@ti.func
def lens_of(view: ti.template()):
    """Returns the camera's struct from one array, because passing a struct of vectors costs Taichi a millisecond a
    launch."""
    return Lens(
        eye=vec3(view[0], view[1], view[2]),
        rotation=mat3(view[3], view[4], view[5], view[6], view[7], view[8], view[9], view[10], view[11]),
        focal=vec2(view[12], view[13]),
        centre=vec2(view[14], view[15]),
        size=vec2(view[16], view[17]),
        max_depth=view[18],
        near_radius=view[19],
    )


@functools.cache
def _draw_kernel(kind: int, phase: int):
    """Returns the Taichi kernel that draws clusters of primitives of one ``kind``. ``phase``: the kernel's result, KEY,
    DEPTH or NUMBER.

    One thread draws every ``slices``-th row of every ``lanes``-th primitive of one cluster.
    """
    place, outline, hit = KERNEL_FUNCTIONS[kind]

    @ti.kernel
    def draw(
        a: Table,
        b: Table,
        c: Table,
        d: Table,
        outlines: ti.types.ndarray(ndim=3),
        hull: ti.types.ndarray(dtype=ti.f32, ndim=3),
        first: ti.types.ndarray(dtype=ti.i32, ndim=1),
        size: ti.types.ndarray(dtype=ti.i32, ndim=1),
        which: ti.types.ndarray(dtype=ti.i32, ndim=1),
        view: ti.types.ndarray(dtype=ti.f32, ndim=1),
        lanes: ti.i32,
        slices: ti.i32,
        keys: ti.types.ndarray(ndim=1),
        number: ti.types.ndarray(dtype=ti.i32, ndim=1),
    ):
        for k, lane, part in ti.ndrange(which.shape[0], lanes, slices):
            i = first[which[k]] + lane
            end = first[which[k]] + size[which[k]]
            while i < end:
                lens = lens_of(view)
                s = place(lens, a[i], b[i], c[i], d[i])
                o = outline(s, hull, lens)
                smooth = s.a[3] * lens.focal[0] > s.a[2] * SMOOTH_SIZE
                nearest = int(clamp(o.depth, 0.0, lens.max_depth) * 1.0e6)
                left = clamp(o.box[0] - 0.01, 0.0, lens.size[0])
                right = clamp(o.box[1] + 1.01, 0.0, lens.size[0])
                top = int(clamp(o.box[2] - 0.01, 0.0, lens.size[1]))
                bottom = int(clamp(o.box[3] + 1.01, 0.0, lens.size[1]))
                if left < right:
                    y = top + part
                    while y < bottom:
                        x0 = ti.max(left, o.rising[0] * y + o.rising[1] - 0.02, o.falling[0] * y + o.falling[1] - 0.02)
                        x1 = ti.min(right, o.rising[0] * y + o.rising[2] + 1.02, o.falling[0] * y + o.falling[2] + 1.02)
                        for x in range(int(x0), int(ti.max(x1, 0.0))):
                            at = y * int(lens.size[0]) + x
                            hidden = False
                            if ti.static(phase == KEY):
                                hidden = keys[at] <= ti.cast(nearest, ti.i64) << 32
                            else:
                                hidden = keys[at] < nearest
                            if not hidden:
                                ray = vec3((vec2(x, y) - lens.centre) / lens.focal, 1.0)
                                t = hit(s, outlines, ray, smooth)
                                if t < lens.max_depth:
                                    z = int(t * 1.0e6)
                                    if ti.static(phase == KEY):
                                        key = (ti.cast(z, ti.i64) << 32) | i
                                        if key < keys[at]:
                                            ti.atomic_min(keys[at], key)
                                    elif ti.static(phase == DEPTH):
                                        ti.atomic_min(keys[at], z)
                                    elif z <= keys[at] + 1:
                                        ti.atomic_min(number[at], i + ti.select(z == keys[at], 0, _INEXACT))
                        y += slices
                i += lanes

    return draw


class TaichiRasterizer:
    """Computes the keys of pictures like Warp's rasteriser, on all cores of the CPU, or on a Vulkan or Metal GPU."""

    def __init__(self, gpu: bool = False) -> None:
        """``gpu``: use a Vulkan or Metal GPU; RuntimeError if there is none. All Taichi rasterisers of a process must
        use the same kind of device, CPU or GPU."""
        _start(gpu)
        self._gpu = gpu
        self._of: tuple[object, int] = (None, -1)
        self._number = np.zeros(1, np.int32)
        self._tables: list = []
        self._pixels: list = []

    def rasterize(
        self, primitives: PosedPrimitives, lens: pinhole.Pinhole, clusters: np.ndarray | None, keys: wp.array
    ) -> None:
        """Write depth and index of the nearest primitive of every pixel to ``keys`` [pixel].

        ``clusters`` [k]: clusters (runs of primitives) to draw; None: all.
        """
        which = _visible_clusters(primitives, lens) if clusters is None else np.asarray(clusters, np.int32)
        kind = primitives.cluster_kind[which]
        mine = {number: which[kind == number] for number in KERNEL_FUNCTIONS}
        mine = {number: these for number, these in mine.items() if len(these)}
        if self._gpu:
            self._rasterize_on_gpu(primitives, lens, mine, keys.numpy())
            return
        s = primitives.shapes
        eye = _pinhole_values(lens)
        pixels = keys.numpy()
        tables = [t.numpy() for t in (s.a, s.b, s.c, s.d, s.outline, s.hull)]
        pixels.fill(EMPTY_KEY)
        for number, these in mine.items():
            clusters_of = primitives.cluster_first, primitives.cluster_size, these
            _draw_kernel(number, KEY)(*tables, *clusters_of, eye, *_CORES, pixels, self._number)

    def _rasterize_on_gpu(
        self, primitives: PosedPrimitives, lens: pinhole.Pinhole, mine: dict[int, np.ndarray], keys: np.ndarray
    ) -> None:
        """Draw clusters (runs of primitives) on a GPU in two passes: first depths, then indices of primitives.
        ``mine``: clusters to draw, by kind of primitive.

        Arrays of primitives are copied to the GPU only after motion.
        """
        if self._of != (primitives, primitives.pose_version):
            s = primitives.shapes
            self._of = (primitives, primitives.pose_version)
            vectors = [(ti.Vector.ndarray(4, ti.f32, len(t)), t.numpy()) for t in (s.a, s.b, s.c, s.d)]
            flat = [(ti.ndarray(ti.i32, s.outline.shape), s.outline.numpy().astype(np.int32))]
            hull = s.hull.numpy()
            flat += [(ti.ndarray(ti.f32, hull.shape), hull)]
            for place, values in vectors + flat:
                place.from_numpy(np.ascontiguousarray(values))
            self._tables = [place for place, _ in vectors + flat]
        if not self._pixels or self._pixels[0].shape != keys.shape:
            self._pixels = [ti.ndarray(ti.i32, keys.shape) for _ in range(2)]
        for array in self._pixels:
            array.fill(_NO_PRIMITIVE)
        eye = _pinhole_values(lens)
        for phase in (DEPTH, NUMBER):
            for number, these in mine.items():
                clusters_of = primitives.cluster_first, primitives.cluster_size, these
                _draw_kernel(number, phase)(*self._tables, *clusters_of, eye, *_GPU, *self._pixels)
        depth, number = (array.to_numpy().astype(np.int64) for array in self._pixels)
        keys[:] = np.where(number == _NO_PRIMITIVE, EMPTY_KEY, (depth << 32) | (number & (_INEXACT - 1)))


@functools.cache
def _start(gpu: bool) -> None:
    """Start Taichi, once in a process, without its greeting on standard output, which is for the command's results."""
    with contextlib.redirect_stdout(io.StringIO()), _floating_point_kept():
        if gpu:
            ti.init(arch=[ti.metal, ti.vulkan], enable_fallback=False, log_level=ti.ERROR)
        else:
            ti.init(arch=ti.cpu, log_level=ti.ERROR)
        ti.sync()


@contextlib.contextmanager
def _floating_point_kept() -> Iterator[None]:
    """Context manager that restores the floating-point environment of this thread.

    Taichi disables denormal numbers for all later computations of the thread, so that physics in the same process would
    differ in some bits from physics without a camera.
    """
    # fenv_t: 32 bytes on x86-64, 8 on AArch64
    libm = ctypes.CDLL(None)
    environment = ctypes.create_string_buffer(64)
    libm.fegetenv(environment)
    try:
        yield
    finally:
        libm.fesetenv(environment)


def _pinhole_values(lens: pinhole.Pinhole) -> np.ndarray:
    """Returns the camera as an array of numbers, for :func:`lens_of`."""
    others = lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height, lens.max_depth, lens.near_radius
    return np.concatenate([np.array(lens.eye), np.array(lens.rotation).ravel(), others]).astype(np.float32)


def _visible_clusters(primitives: PosedPrimitives, lens: pinhole.Pinhole) -> np.ndarray:
    """Returns the clusters [k] (runs of primitives) that may be in the camera's view, sorted from near to far."""
    ball = primitives.ball.numpy()
    r = ball[:, 3]
    p = (ball[:, :3] - np.array(lens.eye)) @ np.array(lens.rotation).reshape(3, 3).T
    seen = (r > 0.0) & (p[:, 2] > -r) & (p[:, 2] - r < lens.max_depth)
    for x, low, high in (
        (p[:, 0], -lens.cx / lens.fx, (lens.width - lens.cx) / lens.fx),
        (p[:, 1], -lens.cy / lens.fy, (lens.height - lens.cy) / lens.fy),
    ):
        seen &= x - high * p[:, 2] < r * np.hypot(1.0, high)
        seen &= x - low * p[:, 2] > -r * np.hypot(1.0, low)
    which = np.flatnonzero(seen)
    distance = np.linalg.norm(p[which], axis=1) - r[which]
    return which[np.argsort(distance, kind="stable")].astype(np.int32)
