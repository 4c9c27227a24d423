"""Laser shots: the rays of their beams as the head turns, and what comes back of them."""

import warp as wp

from vinesim.kernels.shapes import Shapes, normal_at

wp.set_module_options({"enable_backward": False, "fast_math": True})

Beam = wp.types.vector(length=8, dtype=wp.float32)
"""One number for each ray of a shot; an echo is (signal, range, brightness, which ray shows most of it)."""
RING = wp.constant(0.677)
"""Of a Gaussian beam's 1/e^2 radius: outside its inner fifth of energy, half of the rest lies within this."""


@wp.struct
class Head:
    """How a lidar's head fires (:class:`vinesim.sensors.lidar.LidarSpec`)."""

    elevation: wp.array(dtype=wp.float32)
    """[laser] rad"""
    azimuth: wp.array(dtype=wp.float32)
    """[shot] rad, counter-clockwise from ahead."""
    rays: int
    """Of one shot: its middle, the others on a ring."""
    aperture: wp.vec2
    """Radii of the beam where it leaves, across and up [m]."""
    divergence: wp.vec2
    """How fast they grow [rad]."""


@wp.struct
class Receiver:
    """What a lidar makes of what comes back."""

    reflectance: wp.array(dtype=wp.float32)
    """[organ]"""
    nearest: float
    farthest: float
    merge: float
    separation: float
    returns: int
    """0 the strongest, 1 the last, 2 both."""
    noise: float
    weak_noise: float
    step: float
    weakest: float
    flicker: float


@wp.func
def aim(elevation: float, azimuth: float) -> wp.vec3:
    """Unit vector in the lidar's frame."""
    return wp.vec3(wp.cos(elevation) * wp.cos(azimuth), wp.cos(elevation) * wp.sin(azimuth), wp.sin(elevation))


@wp.kernel
def fire(
    # model
    head: Head,
    # in
    first: int,
    poses: wp.array(dtype=wp.transform),
    # out
    origin_out: wp.array(dtype=wp.vec3),
    direction_out: wp.array(dtype=wp.vec3),
):
    """One thread lets one ray of one shot go, from where its firing finds the lidar; shots count from ``first``."""
    ray = wp.tid()
    lasers = head.elevation.shape[0]
    shot = ray // head.rays
    k = ray % head.rays
    pose = poses[shot // lasers]
    e = head.elevation[(first + shot) % lasers]
    a = head.azimuth[first + shot]
    across = wp.vec3(-wp.sin(a), wp.cos(a), 0.0)
    up = wp.vec3(-wp.sin(e) * wp.cos(a), -wp.sin(e) * wp.sin(a), wp.cos(e))
    turn = wp.float32(0.0)
    out = wp.float32(0.0)
    if k > 0:
        turn = (float(k) - 0.5) * 2.0 * wp.pi / float(head.rays - 1)
        out = RING
    u = out * wp.cos(turn)
    v = out * wp.sin(turn)
    start = across * (u * head.aperture[0]) + up * (v * head.aperture[1])
    d = wp.normalize(aim(e, a) + across * (u * head.divergence[0]) + up * (v * head.divergence[1]))
    origin_out[ray] = wp.transform_point(pose, start)
    direction_out[ray] = wp.transform_vector(pose, d)


@wp.func
def measured(r: Receiver, echo: wp.vec4, luck: float) -> float:
    """Range of an echo [m]: noise grows as the signal comes near the weakest that is noticed."""
    sigma = r.noise
    if r.weakest > 0.0:
        sigma = wp.max(sigma, r.weak_noise * wp.sqrt(r.weakest / echo[0]))
    range = echo[1] + sigma * luck
    if r.step > 0.0:
        range = wp.round(range / r.step) * r.step
    return range


@wp.func
def name_of(primitive: int, label: wp.array(dtype=wp.int32), ground_label: int) -> int:
    """Label of what a ray has met."""
    if primitive < 0:
        return ground_label
    return label[primitive]


@wp.kernel
def receive(
    # model
    shapes: Shapes,
    label: wp.array(dtype=wp.int32),
    organ: wp.array(dtype=wp.int32),
    head: Head,
    receiver: Receiver,
    # in
    first: int,
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=wp.float32),
    primitive: wp.array(dtype=wp.int32),
    ground_label: int,
    ground_organ: int,
    luck: wp.array2d(dtype=wp.float32),
    # out
    xyz_out: wp.array2d(dtype=wp.vec3),
    intensity_out: wp.array2d(dtype=wp.float32),
    label_out: wp.array2d(dtype=wp.int32),
):
    """One thread makes one or two returns of one shot's rays; label -1 where there is none."""
    i = wp.tid()
    shot = first + i
    rays = head.rays
    t = Beam()
    bright = Beam()
    name = Beam()  # which ray, sorted with the others
    count = wp.int32(0)
    for k in range(rays):
        ray = i * rays + k
        it = primitive[ray]
        r = distance[ray]
        if it != -1 and r >= receiver.nearest and r <= receiver.farthest:
            n = wp.vec3(0.0, 0.0, 1.0)
            matter = ground_organ
            if it >= 0:
                n = normal_at(shapes, it, origin[ray] + direction[ray] * r)
                matter = organ[it]
            light = receiver.reflectance[matter] * wp.abs(wp.dot(n, direction[ray])) / float(rays)
            # insert by range
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
    # echoes: what lies closer together along the beam than the pulse is long comes back as one
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
        if signal > 0.0 and signal * wp.exp(receiver.flicker * luck[shot, 2]) > receiver.weakest:
            last = wp.vec4(signal, moment / signal, sum_light, shown)
            if signal > strongest[0]:
                second = strongest
                strongest = last
            elif signal > second[0]:
                second = last
    d = aim(head.elevation[shot % head.elevation.shape[0]], head.azimuth[shot])
    echo = strongest
    if receiver.returns == 1:
        echo = last
    label_out[shot, 0] = -1
    if echo[0] > 0.0:
        label_out[shot, 0] = name_of(primitive[int(echo[3])], label, ground_label)
        xyz_out[shot, 0] = d * measured(receiver, echo, luck[shot, 0])
        intensity_out[shot, 0] = wp.clamp(100.0 * echo[2], 0.0, 255.0)
    if receiver.returns == 2:
        if last[1] == strongest[1]:
            last = second
        label_out[shot, 1] = -1
        if last[0] > 0.0 and wp.abs(last[1] - strongest[1]) >= receiver.separation:
            label_out[shot, 1] = name_of(primitive[int(last[3])], label, ground_label)
            xyz_out[shot, 1] = d * measured(receiver, last, luck[shot, 1])
            intensity_out[shot, 1] = wp.clamp(100.0 * last[2], 0.0, 255.0)
