"""Servos of the robots of a batch: MuJoCo's controls from targets, as :mod:`vinesim.kernels.rigid.joint_servos` computes
them for one robot."""

import warp as wp

from vinesim.kernels.rigid.joint_servos import base_control, joint_control

wp.set_module_options({"enable_backward": False})


@wp.kernel
def apply_controls(
    # model
    dt: float,
    stiffness: wp.array(dtype=float),
    damping_at_start: wp.array(dtype=float),
    damping_at_end: wp.array(dtype=float),
    v: wp.array(dtype=wp.int32),
    actuator: wp.array(dtype=wp.int32),
    base_stiffness: wp.array(dtype=float),
    base_damping: wp.array(dtype=float),
    base_slip: wp.array(dtype=float),
    base_q: wp.array(dtype=wp.int32),
    base_actuator: wp.array(dtype=wp.int32),
    # in
    targets: wp.array2d(dtype=float),
    base_velocity: wp.array2d(dtype=float),
    qpos: wp.array2d(dtype=float),
    qvel: wp.array2d(dtype=float),
    # out
    base_targets_out: wp.array2d(dtype=float),
    ctrl_out: wp.array2d(dtype=float),
):
    """One thread per world. Convert the targets of its robots to MuJoCo's controls, and advance the targets of their
    bases by ``dt`` [s].

    v, base_q: indices in MuJoCo's qvel and qpos; actuator, base_actuator: indices in MuJoCo's ctrl.
    """
    world = wp.tid()
    for i in range(actuator.shape[0]):
        servo = actuator[i]
        ctrl_out[world, servo] = joint_control(
            stiffness[i],
            damping_at_start[i],
            damping_at_end[i],
            targets[world, i],
            float(0.0),
            qvel[world, v[i]],
        )
    for i in range(base_actuator.shape[0]):
        first = i // 3 * 3
        position = qpos[world, base_q[i]]
        target, control = base_control(
            i % 3,
            dt,
            base_stiffness[i],
            base_damping[i],
            base_slip[i],
            qpos[world, base_q[first + 2]],
            wp.vec3(base_velocity[world, first], base_velocity[world, first + 1], base_velocity[world, first + 2]),
            position,
            base_targets_out[world, i],
        )
        base_targets_out[world, i] = target
        servo = base_actuator[i]
        ctrl_out[world, servo] = control
