"""Echoes of laser shots, each sampled by several rays, and the returns that a lidar reports for these echoes."""

import warp as wp

from vinesim.kernels.raster.ground import Ground, ground_gradient, is_uneven
from vinesim.kernels.raster.primitives import Shapes, normal_at

wp.set_module_options({"enable_backward": False, "fast_math": True})

RayValues = wp.types.vector(length=8, dtype=wp.float32)
"""Vector with one number for each ray of a laser shot, at most eight."""


@wp.struct
class Receiver:
    """Properties of a lidar's receiver: range, pulse length, detection threshold and noise."""

    rays: int
    """Number of rays that sample one laser shot; the first ray is along the middle of the beam."""
    used: int
    """Number of rays of a shot that are evaluated, from the first ray on."""
    reflectance: wp.array(dtype=wp.float32)
    """[organ] Reflectance at the laser's wavelength, 0 to 1."""
    nearest: float
    farthest: float
    merge: float
    separation: float
    returns: int
    """Which echoes of a shot are reported: 0 the strongest, 1 the last, 2 both."""
    noise: float
    weak_noise: float
    step: float
    weakest: float
    flicker: float


@wp.func
def measured_range(r: Receiver, echo: wp.vec4, noise: float) -> float:
    """Returns the measured range [m] of an ``echo`` (signal, range [m], brightness, ray), with noise and quantisation.

    ``noise`` is a standard normal number. Its scale grows as the signal approaches the weakest detectable one.
    """
    sigma = r.noise
    if r.weakest > 0.0:
        sigma = wp.max(sigma, r.weak_noise * wp.sqrt(r.weakest / echo[0]))
    range = echo[1] + sigma * noise
    if r.step > 0.0:
        range = wp.round(range / r.step) * r.step
    return range


@wp.func
def label_of(primitive: int, label: wp.array(dtype=wp.int32), ground_label: int) -> int:
    """Returns the label of ``primitive``, or ``ground_label`` if ``primitive`` is negative; label: [primitive]."""
    if primitive < 0:
        return ground_label
    return label[primitive]


@wp.struct
class SortedRays:
    """The rays of one laser shot that hit a surface within the lidar's range, sorted from near to far."""

    range: RayValues
    """Range of each hit [m]."""
    brightness: RayValues
    """Reflectance times cosine of the angle of incidence, divided by the number of evaluated rays."""
    ray: RayValues
    """Index of the ray among all rays of the scan."""
    count: int


@wp.func
def sorted_rays(
    shapes: Shapes,
    organ: wp.array(dtype=wp.int32),
    receiver: Receiver,
    shot: int,
    pose: wp.transform,
    direction: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=wp.float32),
    primitive: wp.array(dtype=wp.int32),
    ground_organ: int,
    ground: Ground,
) -> SortedRays:
    """Returns the hits of the rays of laser shot ``shot``, sorted by range (insertion sort).

    organ: [primitive]; pose: of the lidar in the world; direction: [ray] unit vectors in the lidar's frame; distance:
    [ray] m; primitive: [ray] -1 no hit, -2 the ground.
    """
    rays = receiver.rays
    t = RayValues()
    bright = RayValues()
    name = RayValues()  # index of the ray, sorted with the ranges
    count = wp.int32(0)
    for k in range(receiver.used):
        ray = shot * rays + k
        it = primitive[ray]
        r = distance[ray]
        if it != -1 and r >= receiver.nearest and r <= receiver.farthest:
            n = wp.vec3(0.0, 0.0, 1.0)
            matter = ground_organ
            if it < 0 and is_uneven(ground):
                p = wp.transform_point(pose, direction[ray] * r)
                rise = ground_gradient(ground, p[0], p[1])
                n = wp.normalize(wp.vec3(-rise[0], -rise[1], 1.0))
            if it >= 0:
                n = normal_at(shapes, it, wp.transform_point(pose, direction[ray] * r))
                matter = organ[it]
            slant = wp.abs(wp.dot(n, wp.transform_vector(pose, direction[ray])))
            light = receiver.reflectance[matter] * slant / float(receiver.used)
            # insert the hit at its place by range
            j = count
            while j > 0 and t[j - 1] > r:
                t[j] = t[j - 1]
                bright[j] = bright[j - 1]
                name[j] = name[j - 1]
                j -= 1
            t[j] = r
            bright[j] = light
            name[j] = float(ray)
            count += 1
    o = SortedRays()
    o.range = t
    o.brightness = bright
    o.ray = name
    o.count = count
    return o


@wp.struct
class Echoes:
    """Echoes of one laser shot, each as (signal, range [m], brightness, index of the ray that contributes most). An
    echo with signal 0 does not exist.
    """

    strongest: wp.vec4
    second: wp.vec4
    last: wp.vec4


@wp.func
def find_echoes(receiver: Receiver, rays: SortedRays, flicker: float) -> Echoes:
    """Returns the echoes of one laser shot: hits closer together in range than ``receiver.merge`` [m] form one echo.

    The range of an echo is the mean range of its hits. ``flicker``: standard normal number that varies the signal.
    """
    t = rays.range
    bright = rays.brightness
    name = rays.ray
    count = rays.count
    strongest = wp.vec4(0.0, 0.0, 0.0, 0.0)
    second = wp.vec4(0.0, 0.0, 0.0, 0.0)
    last = wp.vec4(0.0, 0.0, 0.0, 0.0)
    k = wp.int32(0)
    while k < count:
        signal = wp.float32(0.0)
        moment = wp.float32(0.0)
        sum_light = wp.float32(0.0)
        most = wp.float32(-1.0)
        shown = wp.float32(0.0)
        end = t[k]
        while k < count and t[k] <= end + receiver.merge:
            part = bright[k] / (t[k] * t[k])
            signal += part
            moment += part * t[k]
            sum_light += bright[k]
            if part > most:
                most = part
                shown = name[k]
            end = t[k]
            k += 1
        if signal > 0.0 and signal * wp.exp(receiver.flicker * flicker) > receiver.weakest:
            last = wp.vec4(signal, moment / signal, sum_light, shown)
            if signal > strongest[0]:
                second = strongest
                strongest = last
            elif signal > second[0]:
                second = last
    o = Echoes()
    o.strongest = strongest
    o.second = second
    o.last = last
    return o


@wp.kernel
def detect_returns(
    # model
    shapes: Shapes,
    label: wp.array(dtype=wp.int32),
    organ: wp.array(dtype=wp.int32),
    receiver: Receiver,
    ground: Ground,
    # in
    first: int,
    pose: wp.transform,
    direction: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=wp.float32),
    primitive: wp.array(dtype=wp.int32),
    ground_label: int,
    ground_organ: int,
    noise: wp.array2d(dtype=wp.float32),
    # out
    xyz_out: wp.array2d(dtype=wp.vec3),
    intensity_out: wp.array2d(dtype=wp.float32),
    label_out: wp.array2d(dtype=wp.int32),
):
    """One thread computes the one or two returns of one laser shot; the label is -1 where a return is missing.

    first: shot of thread 0; pose: of the lidar in the world; direction: [ray] unit vectors in the lidar's frame;
    distance: [ray] m; primitive: [ray] -2 the ground, -1 no hit; noise: [shot, 3] standard normal numbers for
    the two ranges and the signal; xyz: [shot, return] m in the lidar's frame; intensity: [shot, return] 0 to 255.
    """
    shot = first + wp.tid()
    rays = receiver.rays
    met = sorted_rays(shapes, organ, receiver, shot, pose, direction, distance, primitive, ground_organ, ground)
    echoes = find_echoes(receiver, met, noise[shot, 2])
    strongest = echoes.strongest
    last = echoes.last
    d = direction[shot * rays]
    echo = strongest
    if receiver.returns == 1:
        echo = last
    label_out[shot, 0] = -1
    if echo[0] > 0.0:
        label_out[shot, 0] = label_of(primitive[int(echo[3])], label, ground_label)
        xyz_out[shot, 0] = d * measured_range(receiver, echo, noise[shot, 0])
        intensity_out[shot, 0] = wp.clamp(100.0 * echo[2], 0.0, 255.0)
    if receiver.returns == 2:
        if last[1] == strongest[1]:
            last = echoes.second
        label_out[shot, 1] = -1
        if last[0] > 0.0 and wp.abs(last[1] - strongest[1]) >= receiver.separation:
            label_out[shot, 1] = label_of(primitive[int(last[3])], label, ground_label)
            xyz_out[shot, 1] = d * measured_range(receiver, last, noise[shot, 1])
            intensity_out[shot, 1] = wp.clamp(100.0 * last[2], 0.0, 255.0)
