"""A rigid body that is driven along a path with a limited force: the plainest way to push plants.

pusher = simulation.add_pusher(shape="sphere", size=(0.03,), position=(0.8, -0.2, 1.0), force=20.0)
pusher.follow((0.8, 0.2, 1.0), speed=0.1)
while not pusher.is_done:
    simulation.step()
    print(pusher.position, pusher.force)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.core.numbers import as_numbers, checked_number, checked_vector
from vinesim.rigid.urdf_writer import roll_pitch_yaw
from vinesim.scene.values import Drive, RobotSpec
from vinesim.world import Physics

SHAPES = {"sphere": 1, "capsule": 2, "box": 3}
"""Shapes of a pusher, with the number of their sizes."""
BODY = "body"
"""Name of the link of a pusher, for example for blades."""
_STIFFNESS = 0.5
"""[kg/kg] Stiffness of the drive * dt^2 / mass. A drive that reaches its limit within the distance that the limit moves
the mass in a step would oscillate; this is half of that stiffness."""
_CARRIAGE = 1e-3
"""[1] Mass of each of the two parts between the base and the body, as a share of the body's mass."""
_BASE_MASS = 1e3
_TRAVEL = 1e3
"""[m] Limit of the drives."""


class Pusher:
    """A sphere, capsule or box that three drives move along the world's axes. It does not turn, and its weight is
    carried. :meth:`vinesim.api.simulation.Simulation.add_pusher` makes one."""

    def __init__(
        self,
        physics: Physics,
        name: str,
        index: int,
        shape: Literal["sphere", "capsule", "box"],
        size: Sequence[float],
        pose: np.ndarray,
        mass: float,
        force: float,
    ) -> None:
        self.name = name
        self.mass = mass
        """[kg]"""
        self.force_limit = force
        """[N] Largest force of the drive along each axis of the world."""
        self._physics = physics
        self._start = pose[:3].copy()
        self._points = pose[None, :3].copy()
        """[k, 3] m, points of the path, from the target at the call of :meth:`follow`."""
        self._times = np.zeros(1)
        """[k] s, when the target passes each point."""
        stiffness = _STIFFNESS * mass / physics.dt**2
        damping = 2.0 * np.sqrt(stiffness * mass)
        weight = mass * (1.0 + 2.0 * _CARRIAGE) * physics.parameters.gravity
        drives = tuple(
            Drive(axis, stiffness, damping, force + (weight if axis == "z" else 0.0), _TRAVEL, -_TRAVEL, _TRAVEL)
            for axis in "xyz"
        )
        bolted = 100.0 * (force + weight)
        physics.add_robot(
            RobotSpec(
                name,
                index,
                _urdf(name, shape, size, pose, mass),
                "base",
                frames.pose(np.array([pose[0], pose[1], 0.0])),
                drives,
                np.zeros(3),
                base_effort=(bolted, bolted),
            )
        )

    @property
    def position(self) -> np.ndarray:
        """[3] m, centre of the body."""
        state = self._physics.rigid.joint_measurements(self.name)[0]
        return self._start + state

    @property
    def target(self) -> np.ndarray:
        """[3] m, where the drive pulls the body now."""
        return self._target(self._physics.time)

    @property
    def force(self) -> np.ndarray:
        """[3] N, sum of the forces of plants on the body in the last step, world axes."""
        forces = [contact.force for contact in self._physics.contacts if contact.actor == self.name]
        return np.sum(forces, 0) if forces else np.zeros(3)

    @property
    def contact_force(self) -> np.ndarray:
        """[3] N, sum of the forces of all contacts on the body in the last step, world axes: of plants, wires, crates
        and everything else."""
        return self._physics.rigid.joint_measurements(self.name)[3].copy()

    @property
    def is_done(self) -> bool:
        """Whether the target has reached the end of its path. A body that is held back by plants stays behind it."""
        return self._physics.time >= self._times[-1] - 1e-9

    def follow(self, path: Sequence[float] | Sequence[Sequence[float]] | np.ndarray, speed: float) -> None:
        """Move the target from where it is along ``path`` at ``speed`` [m/s], and hold it at the end.

        ``path``: a point [3] m or points [k, 3] m. With less than the force limit the body lags behind the target by at
        most 2 ``force_limit`` dt^2 / ``mass``.
        """
        points = np.atleast_2d(as_numbers(path))
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise UsageError(f"path is {path}; give a point [3] or points [k, 3] of finite numbers [m]")
        checked_number("speed", speed, "m/s", positive=True, error=UsageError)
        now = self._physics.time
        self._points = np.concatenate([self._target(now)[None], points])
        lengths = np.linalg.norm(np.diff(self._points, axis=0), axis=1)
        self._times = now + np.concatenate([[0.0], np.cumsum(lengths) / speed])

    def control(self) -> None:
        """Pass the target at the end of the next step to the drive."""
        dt = self._physics.dt
        now = self._physics.time
        ahead = self._target(now + dt)
        self._physics.rigid.command(self.name, ahead - self._start, (ahead - self._target(now)) / dt)

    def _target(self, time: float) -> np.ndarray:
        return np.array([np.interp(time, self._times, self._points[:, axis]) for axis in range(3)])


def checked_shape(
    shape: str, size: Sequence[float], position: Sequence[float] | np.ndarray, mass: float, force: float
) -> np.ndarray:
    """Returns the pose [7] of a pusher. Raises :class:`UsageError` for a value that no pusher can have."""
    if shape not in SHAPES:
        raise UsageError(f"shape is {shape!r}; give one of: {', '.join(SHAPES)}")
    numbers = as_numbers(size)
    if numbers.shape != (SHAPES[shape],) or not (np.isfinite(numbers) & (numbers > 0.0)).all():
        meaning = {"sphere": "(radius,)", "capsule": "(radius, length of its axis)", "box": "three edges"}[shape]
        raise UsageError(f"size is {size}; a {shape} has {meaning}: give finite numbers above 0 [m]")
    checked_number("mass", mass, "kg", positive=True, error=UsageError)
    checked_number("force", force, "N", positive=True, error=UsageError)
    if as_numbers(position).shape == (7,):
        return frames.checked_pose("position", position, UsageError)
    return frames.pose(checked_vector("position", position, "m", UsageError))


def _urdf(name: str, shape: str, size: Sequence[float], pose: np.ndarray, mass: float) -> str:
    """Returns the URDF of a pusher: a base, and joints along x, y and z to the body."""
    if shape == "sphere":
        form = f'<sphere radius="{size[0]:.9g}"/>'
    elif shape == "capsule":
        form = f'<capsule radius="{size[0]:.9g}" length="{size[1]:.9g}"/>'
    else:
        form = f'<box size="{size[0]:.9g} {size[1]:.9g} {size[2]:.9g}"/>'
    turn = " ".join(f"{angle:.9g}" for angle in roll_pitch_yaw(pose[3:]))
    geometry = f'<origin xyz="0 0 0" rpy="{turn}"/><geometry>{form}</geometry>'
    links = [_link("base", _BASE_MASS), _link("along_x", _CARRIAGE * mass), _link("along_y", _CARRIAGE * mass)]
    links.append(_link(BODY, mass, f"<visual>{geometry}</visual><collision>{geometry}</collision>"))
    names = ("base", "along_x", "along_y", BODY)
    joints = [
        f'<joint name="{axis}" type="prismatic"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 {pose[2] if axis == "x" else 0.0:.9g}"/><axis xyz="{direction}"/>'
        f'<limit lower="{-_TRAVEL}" upper="{_TRAVEL}" effort="1e6" velocity="{_TRAVEL}"/></joint>'
        for axis, parent, child, direction in zip("xyz", names, names[1:], ("1 0 0", "0 1 0", "0 0 1"), strict=False)
    ]
    return f'<robot name="{name}">{"".join(links + joints)}</robot>'


def _link(name: str, mass: float, shapes: str = "") -> str:
    inertia = 0.004 * mass  # the links do not turn
    return (
        f'<link name="{name}"><inertial><mass value="{mass:.9g}"/><inertia ixx="{inertia:.9g}" iyy="{inertia:.9g}" '
        f'izz="{inertia:.9g}" ixy="0" ixz="0" iyz="0"/></inertial>{shapes}</link>'
    )
