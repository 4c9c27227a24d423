"""Servos of a robot: set-points that respect limits of position, velocity and effort, and MuJoCo's controls."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

VELOCITY = wp.constant(1)
EFFORT = wp.constant(2)
"""Code of the effort interface of a joint, as in ``CommandInterface``. ``VELOCITY`` is the code of the velocity
interface. A joint with any other code follows a position.
"""
MIN_INERTIA = wp.constant(wp.float64(1e-9))
"""Least inertia [kg m^2 or kg] by which the code divides."""


@wp.struct
class ServoLimits:
    """Limits of a robot's joint servos; each array is [joint]."""

    lower: wp.array(dtype=wp.float64)
    """Lowest position [rad or m]."""
    upper: wp.array(dtype=wp.float64)
    """Highest position [rad or m]."""
    velocity: wp.array(dtype=wp.float64)
    """Largest speed [rad/s or m/s]."""
    tracking_error: wp.array(dtype=wp.float64)
    """Largest distance of a set-point from the joint's position [rad or m]; there the servo's effort saturates."""
    impulse: wp.array(dtype=wp.float64)
    """Largest impulse [N m s or N s] that the drive may use to accelerate the joint in one step."""


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
    """One thread advances the set-point of one joint by a step of ``dt`` [s], within the joint's limits.

    All arrays are [joint], in rad or m, rad/s or m/s. interface: command interface; command: commanded position or
    velocity; position, velocity: state of the joint; middle: position from which the tracking error is measured;
    inertia: kg m^2 or kg; setpoint, rate: set-point and the rate at which it moves; target_velocity: velocity for the
    servo.
    """
    i = wp.tid()
    zero = wp.float64(0.0)
    fastest = limits.velocity[i]
    kind = int(interface[i])
    # more error does not increase the effort of a saturated servo, but would make it overshoot: bound the error
    reach = limits.tracking_error[i]
    start = wp.min(wp.max(setpoint_out[i], middle[i] - reach), middle[i] + reach)
    wanted = (command[i] - start) / dt
    if kind == VELOCITY:
        wanted = command[i]
    # the set-point must not accelerate faster than the drive can: a saturated servo would exceed the velocity limit
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
    """Gains, targets and MuJoCo indices of a robot's joint servos; each array is [joint]."""

    stiffness: wp.array(dtype=wp.float64)
    damping_at_start: wp.array(dtype=wp.float64)
    """Explicit damping [N m s/rad or N s/m], which acts on the velocity at the start of the step."""
    damping_at_end: wp.array(dtype=wp.float64)
    """Implicit damping [N m s/rad or N s/m], which MuJoCo applies to the velocity at the end of the step."""
    target: wp.array(dtype=wp.float64)
    target_velocity: wp.array(dtype=wp.float64)
    feedforward: wp.array(dtype=wp.float64)
    """Effort that is added to the servo's [N m or N]."""
    v: wp.array(dtype=wp.int64)
    """Index of the joint in MuJoCo's ``qvel``."""
    actuator: wp.array(dtype=wp.int64)
    """Index of the servo in MuJoCo's ``ctrl``."""


@wp.struct
class BaseDrive:
    """Servos of a robot's planar base; each array is [3] for x, y and yaw, unless stated otherwise. A free base has no
    servos: ``q`` and ``actuator`` are empty."""

    stiffness: wp.array(dtype=wp.float64)
    damping: wp.array(dtype=wp.float64)
    velocity: wp.array(dtype=wp.float64)
    """Commanded velocity [m/s, m/s, rad/s] in the axes of the base."""
    slip: wp.array(dtype=wp.float64)
    """[1] Largest distance of the target from the base [m or rad]."""
    q: wp.array(dtype=wp.int64)
    """Index of the coordinate in MuJoCo's ``qpos``."""
    actuator: wp.array(dtype=wp.int64)


@wp.func
def joint_control(
    stiffness: Any, damping_at_start: Any, damping_at_end: Any, target: Any, target_velocity: Any, velocity: Any
):
    """Returns MuJoCo's control [N m or N] of a joint's servo, whose effort is the control minus K q minus D v.

    Gains as in :class:`JointDrives`; target: position and velocity; velocity: of the joint at the start of the step.
    """
    damping = damping_at_end + damping_at_start
    pull = stiffness * target + damping * target_velocity
    return pull - damping_at_start * velocity


@wp.func
def base_control(
    axis: int,
    dt: Any,
    stiffness: Any,
    damping: Any,
    slip: Any,
    yaw: Any,
    commanded: Any,
    position: Any,
    target: Any,
):
    """Returns the new target [m or rad] of one coordinate of a planar base (``axis``: 0 x, 1 y, 2 yaw), and MuJoCo's
    control of its servo [N or N m].

    commanded: velocity [m/s, m/s, rad/s] in the axes of the base. If the base is held back by more than ``slip``, its
    wheels slip: the target stays near the base.
    """
    c = wp.cos(yaw)
    s = wp.sin(yaw)
    velocity = commanded[2]
    if axis == 0:
        velocity = c * commanded[0] - s * commanded[1]
    if axis == 1:
        velocity = s * commanded[0] + c * commanded[1]
    moved = wp.clamp(target + dt * velocity, position - slip, position + slip)
    return moved, stiffness * moved + damping * velocity


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
    """The only thread converts the targets of a robot to MuJoCo's controls and advances the target of its base by
    ``dt``.

    qpos, qvel, ctrl: MuJoCo's arrays; control: [joint] copy of the joints' controls; base_target: [3] x, y, yaw [m, m,
    rad].
    """
    for i in range(drives.target.shape[0]):
        control = drives.feedforward[i] + joint_control(
            drives.stiffness[i],
            drives.damping_at_start[i],
            drives.damping_at_end[i],
            drives.target[i],
            drives.target_velocity[i],
            qvel[drives.v[i]],
        )
        control_out[i] = control
        actuator = drives.actuator[i]
        ctrl_out[actuator] = control
    if base.actuator.shape[0] == 0:
        return
    commanded = wp.vec3d(base.velocity[0], base.velocity[1], base.velocity[2])
    for i in range(3):
        target, control = base_control(
            i,
            dt,
            base.stiffness[i],
            base.damping[i],
            base.slip[0],
            qpos[base.q[2]],
            commanded,
            qpos[base.q[i]],
            base_target_out[i],
        )
        base_target_out[i] = target
        actuator = base.actuator[i]
        ctrl_out[actuator] = control
