"""Set-points of a robot's joint servos: ramps within the limits of position, velocity and effort."""

import warp as wp

wp.set_module_options({"enable_backward": False})

VELOCITY, EFFORT = wp.constant(1), wp.constant(2)
"""Command interfaces in which a set-point does not follow a position; see ``CommandInterface``."""
MIN_INERTIA = wp.constant(wp.float64(1e-9))
"""[kg m^2 or kg] Inertia is taken to be at least this where it divides."""


@wp.struct
class ServoLimits:
    """Limits of each joint [joint]."""

    lower: wp.array(dtype=wp.float64)
    """[rad or m]"""
    upper: wp.array(dtype=wp.float64)
    """[rad or m]"""
    velocity: wp.array(dtype=wp.float64)
    """[rad/s or m/s]"""
    tracking_error: wp.array(dtype=wp.float64)
    """[rad or m] Largest distance of a set-point from the joint: beyond it the servo gives no more."""
    impulse: wp.array(dtype=wp.float64)
    """[N m s or N s] Most that the drive may spend on acceleration in one step."""


@wp.kernel
def advance_setpoints(
    # model
    dt: wp.float64,
    limits: ServoLimits,
    # in
    interface: wp.array(dtype=wp.int64),
    command: wp.array(dtype=wp.float64),
    position: wp.array(dtype=wp.float64),
    middle: wp.array(dtype=wp.float64),
    velocity: wp.array(dtype=wp.float64),
    inertia: wp.array(dtype=wp.float64),
    # out
    setpoint_out: wp.array(dtype=wp.float64),
    rate_out: wp.array(dtype=wp.float64),
    target_velocity_out: wp.array(dtype=wp.float64),
):
    """One thread advances the set-point of one joint by a step, and the rate at which it moves."""
    i = wp.tid()
    zero, fastest = wp.float64(0.0), limits.velocity[i]
    kind = int(interface[i])
    # a saturated servo gives no more when its error grows, but would overshoot when released: bound the error
    reach = limits.tracking_error[i]
    start = wp.min(wp.max(setpoint_out[i], middle[i] - reach), middle[i] + reach)
    wanted = (command[i] - start) / dt
    if kind == VELOCITY:
        wanted = command[i]
    # nor may the set-point accelerate faster than the drive can: a saturated servo would exceed the velocity
    gain = limits.impulse[i] / wp.max(inertia[i], MIN_INERTIA)
    least = wp.max(wp.min(rate_out[i], zero) - gain, -fastest)
    most = wp.min(wp.max(rate_out[i], zero) + gain, fastest)
    rate = wp.min(wp.max(wanted, least), most)
    if kind == EFFORT:
        start = position[i]
        rate = wp.float64(0.0)
    setpoint = wp.min(wp.max(start + dt * rate, limits.lower[i]), limits.upper[i])
    rate = (setpoint - start) / dt
    setpoint_out[i] = setpoint
    target_velocity_out[i] = rate
    if kind == EFFORT:
        rate = velocity[i]
    rate_out[i] = rate
