"""Servos of a robot: set-points within the limits of position, velocity and effort, and MuJoCo's controls."""

import warp as wp

wp.set_module_options({"enable_backward": False})

VELOCITY = wp.constant(1)
EFFORT = wp.constant(2)
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
    zero = wp.float64(0.0)
    fastest = limits.velocity[i]
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


@wp.struct
class JointDrives:
    """Servos of the joints [joint]."""

    stiffness: wp.array(dtype=wp.float64)
    damping_at_start: wp.array(dtype=wp.float64)
    """[N m s/rad or N s/m] on the velocity at the start of the step."""
    damping_at_end: wp.array(dtype=wp.float64)
    """[N m s/rad or N s/m] on the velocity at its end, by MuJoCo."""
    target: wp.array(dtype=wp.float64)
    target_velocity: wp.array(dtype=wp.float64)
    feedforward: wp.array(dtype=wp.float64)
    """[N m or N]"""
    v: wp.array(dtype=wp.int64)
    """index in MuJoCo's ``qvel``."""
    actuator: wp.array(dtype=wp.int64)
    """index in MuJoCo's ``ctrl``."""


@wp.struct
class BaseDrive:
    """Servos of the planar base [3]: x, y, yaw."""

    stiffness: wp.array(dtype=wp.float64)
    damping: wp.array(dtype=wp.float64)
    velocity: wp.array(dtype=wp.float64)
    """[m/s, m/s, rad/s] wanted, in the axes of the base."""
    slip: wp.array(dtype=wp.float64)
    """[1] m or rad, farthest that the target goes ahead of the base."""
    q: wp.array(dtype=wp.int64)
    """index in MuJoCo's ``qpos``."""
    actuator: wp.array(dtype=wp.int64)


@wp.kernel
def apply_controls(
    # model
    dt: wp.float64,
    # in
    drives: JointDrives,
    base: BaseDrive,
    qpos: wp.array(dtype=wp.float64),
    qvel: wp.array(dtype=wp.float64),
    # out
    control_out: wp.array(dtype=wp.float64),
    base_target_out: wp.array(dtype=wp.float64),
    ctrl_out: wp.array(dtype=wp.float64),
):
    """One thread in all: turn the targets of a robot into MuJoCo's controls; the target of its base moves on.

    control_out: [joint] the controls of the joints once more.
    """
    for i in range(drives.target.shape[0]):
        damping = drives.damping_at_end[i] + drives.damping_at_start[i]
        pull = drives.stiffness[i] * drives.target[i] + damping * drives.target_velocity[i]
        control = pull - drives.damping_at_start[i] * qvel[drives.v[i]] + drives.feedforward[i]
        control_out[i] = control
        actuator = drives.actuator[i]
        ctrl_out[actuator] = control
    yaw = qpos[base.q[2]]
    c = wp.cos(yaw)
    s = wp.sin(yaw)
    slip = base.slip[0]
    for i in range(3):
        velocity = base.velocity[2]
        if i == 0:
            velocity = c * base.velocity[0] - s * base.velocity[1]
        if i == 1:
            velocity = s * base.velocity[0] + c * base.velocity[1]
        position = qpos[base.q[i]]  # held back too far, the base slips: its target comes along
        target = wp.clamp(base_target_out[i] + dt * velocity, position - slip, position + slip)
        base_target_out[i] = target
        actuator = base.actuator[i]
        ctrl_out[actuator] = base.stiffness[i] * target + base.damping[i] * velocity
