"""The TOML file of a robot, next to its URDF: limits of the base, joint groups with gains, sensors, grippers,
controllers.

The attributes have the names of the keys in the file. Exceptions are ``armature``, ``series_stiffness`` and
``series_damping`` of a group: their keys are ``rotor``, ``elastic`` and ``elastic_damping``.
"""

from __future__ import annotations

import pathlib
from collections.abc import Container, Iterable, Sequence
from typing import Literal, cast

import msgspec
import numpy as np

from vinesim.core.toml_loader import DataError, read_toml
from vinesim.robot.description.grippers import AnyGripper, Cutter
from vinesim.robot.description.urdf import DescriptionError, description_error
from vinesim.scene.values import SENSOR_KINDS, ImuMount, RenderedMount, SensorMode, SensorMount, SensorPacing

BaseKind = Literal["auto", "planar", "free", "fixed"]
"""How the base of a robot moves, see :attr:`BaseLimits.kind`."""


class BaseLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of the motion of the base."""

    kind: BaseKind = "auto"
    """How the base moves. ``planar``: it is driven in the plane. ``free``: it moves freely, and the robot stands on its
    legs. ``fixed``: it is bolted down. ``auto``: as the robot file says."""
    linear: float = 0.5
    """Largest speed [m/s]."""
    angular: float = 0.8
    """Largest yaw rate [rad/s]."""
    linear_acceleration: float = 1.0
    """Largest linear acceleration [m/s2]."""
    angular_acceleration: float = 2.0
    """Largest angular acceleration [rad/s2]."""
    effort: tuple[float, float] = (800.0, 400.0)
    """Largest force [N] and moment [N m]."""
    timeout: float = 0.5
    """Time after the last command at which the base stops [s]."""
    slip: tuple[float, float] = (0.0, 0.0)
    """Shares of the tracks' travel that are lost by slip: of travel ahead, and of turns. Odometry measures the
    travel of the tracks."""


class JointGroup(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Joints that one controller moves. All arrays are in the order of ``joints``."""

    joints: tuple[str, ...]
    stiffness: tuple[float, ...] | None = None
    """Position gains [N m/rad or N/m]."""
    damping: tuple[float, ...] | None = None
    """Velocity gains [N m s/rad or N s/m]."""
    armature: tuple[float, ...] | None = msgspec.field(name="rotor", default=None)
    """Inertias of motor and gear, converted to the joint side [kg m2 or kg]."""
    series_stiffness: tuple[float, ...] | None = msgspec.field(name="elastic", default=None)
    """Stiffnesses of the springs between gear and joint [N m/rad or N/m]. None: the position gains are used instead."""
    series_damping: tuple[float, ...] | None = msgspec.field(name="elastic_damping", default=None)
    """Dampings of the springs between gear and joint [N m s/rad or N s/m]."""
    home: tuple[float, ...] | None = None
    """Home positions [rad or m]."""
    tool: str = ""
    """Frame of the tool, with the x axis pointing out of the hand, if the group is an arm; otherwise empty."""

    def arrays(self) -> dict[str, tuple[float, ...] | None]:
        """Returns the attributes that have one value for each joint, by their key in the file."""
        return {
            "stiffness": self.stiffness,
            "damping": self.damping,
            "rotor": self.armature,
            "elastic": self.series_stiffness,
            "elastic_damping": self.series_damping,
            "home": self.home,
        }


class SensorTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Table of a robot's TOML file that sets how simulated time waits for the robot's cameras and lidars.

    The fields are those of :class:`vinesim.scene.values.SensorPacing`.
    """

    mode: SensorMode = SensorMode.LIVE
    least_rate: float = SensorPacing().least_rate
    """Lowest rate of live sensors [Hz of simulated time]. Simulated time waits for a sensor that would be slower."""


class Controller(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A controller through which ROS commands the robot."""

    kind: str
    """A :class:`~vinesim.scene.values.ControllerKind`, or the kind of a gripper."""
    joints: tuple[str, ...] = ()
    """Names of the controller's joints. If empty, the joints of ``group``."""
    group: str = ""
    """Name of a joint group. It is required for a gripper."""
    commands: str | None = None
    states: str | None = None
    timeout: float | None = None
    """Topics of the kind ``topic_based``, and its timeout [s]: see :class:`~vinesim.scene.values.HardwareTopics`."""


class Sidecar(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a robot's TOML file, without the tables for the kinds of rendered sensors, which
    :data:`SidecarFile` adds."""

    base: BaseLimits = BaseLimits()
    groups: dict[str, JointGroup] = {}
    sensors: SensorTable = SensorTable()
    imus: tuple[ImuMount, ...] | None = None
    """None: the IMUs are those of the robot file, or guessed from its links."""
    wrenches: tuple[SensorMount, ...] = ()
    grippers: tuple[AnyGripper, ...] | None = None
    """Grippers of the robot. None: fingers are guessed by :func:`vinesim.robot.description.grippers.guess_fingers`."""
    cutters: tuple[Cutter, ...] = ()
    """Further grippers, all of them cutters, so that ``kind`` is not needed."""
    friction: dict[str, float] = {}
    """Coulomb friction coefficient [1] of a link in contacts, by link. It replaces ``mu1`` of the URDF."""
    controllers: dict[str, Controller] | None = None
    """Controllers by name. None: :mod:`vinesim.robot.description.controllers` derives them from the groups."""
    srdf: str = ""
    """Path of an SRDF file, relative to the TOML file. Pairs of links in its ``disable_collisions`` never collide.
    If empty, the file with the URDF's name and the ending ``.srdf`` is used, if it exists."""

    @property
    def all_grippers(self) -> tuple[AnyGripper, ...]:
        """All grippers: the entries of ``grippers`` and ``cutters``."""
        return (*(self.grippers or ()), *self.cutters)

    def mounts(self, kind: str) -> tuple[RenderedMount, ...] | None:
        """Returns the sensors of a kind. None: the file has no table for this kind, so the sensors are guessed from
        the URDF."""
        return getattr(self, SENSOR_KINDS[kind].table, None)


SidecarFile = cast(
    "type[Sidecar]",
    msgspec.defstruct(
        "SidecarFile",
        [(kind.table, tuple[kind.mount, ...] | None, None) for kind in SENSOR_KINDS.values()],
        bases=(Sidecar,),
        frozen=True,
        forbid_unknown_fields=True,
    ),
)
"""Type of a robot's whole TOML file: :class:`Sidecar` with one table for each of
:data:`~vinesim.scene.values.SENSOR_KINDS`."""


def read_sidecar(file: pathlib.Path) -> Sidecar:
    """Returns the content of a robot's TOML file, or the default values if there is no file. Raises
    :class:`DescriptionError` for unknown keys or invalid values."""
    if not file.is_file():
        return Sidecar()
    try:
        return msgspec.convert(read_toml(file), SidecarFile)
    except DataError as error:
        raise DescriptionError(str(error)) from None
    except msgspec.ValidationError as error:
        raise description_error(file, str(error), "see data/robots/vinebot.toml for all keys") from error


MAX_REMOTE_SIDECAR = 1 << 16
"""Largest size of a sidecar that is accepted from another client [B]."""

MAX_REMOTE_NUMBER = 1e7
"""Largest gain, limit or position in a sidecar from another client: ten times that of a robot that is bolted down."""


def encode_sidecar(base: BaseLimits, groups: dict[str, JointGroup]) -> str:
    """Returns, as JSON, the data that other clients need for their copies of a robot: limits of the base, and joint
    groups with gains.

    Sensors and grippers are left out, because they act only where the robot is simulated.
    """
    return msgspec.json.encode(Sidecar(base=base, groups=groups)).decode()


def decode_sidecar(text: str) -> Sidecar:
    """Returns the sidecar of another client's robot, without sensors and grippers. The copy of the robot needs no TOML
    file.

    Raises :class:`DescriptionError` if it is too long or malformed. :func:`check_sidecar` checks names and values.
    """
    origin = pathlib.Path("sidecar of another client")
    if len(text) > MAX_REMOTE_SIDECAR:
        raise description_error(origin, f"{len(text)} B", f"send at most {MAX_REMOTE_SIDECAR} B")
    try:
        found = msgspec.json.decode(text, type=SidecarFile) if text else Sidecar()
    except (msgspec.DecodeError, msgspec.ValidationError, RecursionError) as error:
        raise description_error(origin, str(error), "use the same release of vinesim") from error
    arrays = {name: values for group in found.groups.values() for name, values in group.arrays().items() if values}
    limits = {key: value for key, value in msgspec.structs.asdict(found.base).items() if key != "kind"}
    for name, values in (*arrays.items(), *((key, np.atleast_1d(value)) for key, value in limits.items())):
        least = -MAX_REMOTE_NUMBER if name == "home" else 0.0
        if not all(least <= number <= MAX_REMOTE_NUMBER for number in values):
            raise description_error(origin, f"{name} of {values}", f"give {least:g} to {MAX_REMOTE_NUMBER:g}")
    return Sidecar(base=found.base, groups=found.groups)


def check_sidecar(
    sidecar: Sidecar,
    sensors: Sequence[RenderedMount],
    driven: Container[str],
    links: Container[str],
    file: pathlib.Path,
) -> None:
    """Raise :class:`DescriptionError` unless the sidecar refers only to ``driven`` joints and existing ``links`` and
    all its values are valid."""
    for name, group in sidecar.groups.items():
        _check_group(name, group, driven, links, file)
    for gripper in sidecar.all_grippers:
        gripper.check(sidecar.groups, links, file)
    if not all(0.0 <= slip < 1.0 for slip in sidecar.base.slip):
        raise description_error(file, f"slip of {sidecar.base.slip}", "give shares from 0 to below 1")
    mounts: Iterable[SensorMount] = (*sensors, *(sidecar.imus or ()), *sidecar.wrenches)
    for mount in mounts:
        if mount.frame not in links:
            raise description_error(file, f"{mount.name!r} is mounted on {mount.frame!r}", "name a link of the URDF")
    if not 0.01 <= sidecar.sensors.least_rate <= 1000.0:
        found = f"sensors have the least_rate {sidecar.sensors.least_rate}"
        raise description_error(file, found, "give 0.01 to 1000 Hz")
    for sensor in sensors:
        if (fault := sensor.fault()) is not None:
            found, remedy = fault
            raise description_error(file, f"{sensor.name!r} has {found}", remedy)


def _check_group(
    name: str, group: JointGroup, driven: Container[str], links: Container[str], file: pathlib.Path
) -> None:
    """Raise :class:`DescriptionError` unless a joint group refers only to ``driven`` joints and existing ``links``
    and all its values are valid."""
    for joint in group.joints:
        if joint not in driven:
            raise description_error(
                file, f"group {name!r} names {joint!r}, which is no driven joint", "name driven joints only"
            )
    for key, values in group.arrays().items():
        if values is not None and len(values) != len(group.joints):
            raise description_error(
                file, f"group {name!r} has {len(values)} of {key} for {len(group.joints)} joints", "give one each"
            )
    if (group.series_stiffness is None) != (group.series_damping is None):
        raise description_error(file, f"group {name!r} gives only one of elastic and elastic_damping", "give both")
    if min((*(group.series_stiffness or ()), *(group.series_damping or ()), 0.0)) < 0.0:
        raise description_error(file, f"group {name!r} has a spring below zero", "give 0 or more")
    if group.tool and group.tool not in links:
        raise description_error(file, f"group {name!r} has the tool {group.tool!r}", "name a link of the URDF")
