"""The TOML file beside a URDF: base limits, joint groups with gains, sensors, grippers, controllers.

The attributes are the keys of the file, except ``armature``, ``series_stiffness`` and ``series_damping`` of a group,
which the file calls ``rotor``, ``elastic`` and ``elastic_damping``.
"""

from __future__ import annotations

import pathlib
from collections.abc import Container, Iterable, Sequence
from typing import cast

import msgspec
import numpy as np

from vinesim.robot.description.grippers import AnyGripper, Cutter
from vinesim.robot.description.urdf import description_error
from vinesim.scene.values import SENSOR_KINDS, RenderedMount, SensorMode, SensorMount, SensorPacing


class BaseLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits for the motion of the base."""

    linear: float = 0.5
    """Largest speed [m/s]."""
    angular: float = 0.8
    """Largest rate of turn [rad/s]."""
    linear_acceleration: float = 1.0
    """Largest linear acceleration [m/s2]."""
    angular_acceleration: float = 2.0
    """Largest angular acceleration [rad/s2]."""
    effort: tuple[float, float] = (800.0, 400.0)
    """Largest force [N] and moment [N m]."""
    timeout: float = 0.5
    """Time without a command after which the base stops [s]."""
    slip: tuple[float, float] = (0.0, 0.0)
    """Shares of the tracks' travel that are lost by slip, ahead and in turns. Odometry measures the whole travel."""


class JointGroup(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Joints that one controller moves; arrays are in the order of ``joints``."""

    joints: tuple[str, ...]
    stiffness: tuple[float, ...] | None = None
    """Position gains [N m/rad or N/m]."""
    damping: tuple[float, ...] | None = None
    """Velocity gains [N m s/rad or N s/m]."""
    armature: tuple[float, ...] | None = msgspec.field(name="rotor", default=None)
    """Inertias of motor and gear seen from the joint [kg m2 or kg]."""
    series_stiffness: tuple[float, ...] | None = msgspec.field(name="elastic", default=None)
    """Stiffnesses of the springs between gear and joint [N m/rad or N/m]. None: the position gains are used."""
    series_damping: tuple[float, ...] | None = msgspec.field(name="elastic_damping", default=None)
    """Dampings of these springs [N m s/rad or N s/m]."""
    home: tuple[float, ...] | None = None
    """Home positions [rad or m]."""
    tool: str = ""
    """Frame whose x axis points out of the hand, if the group is an arm."""

    def arrays(self) -> dict[str, tuple[float, ...] | None]:
        """The attributes that have one value for each joint, by their keys in the file."""
        return {
            "stiffness": self.stiffness,
            "damping": self.damping,
            "rotor": self.armature,
            "elastic": self.series_stiffness,
            "elastic_damping": self.series_damping,
            "home": self.home,
        }


class SensorTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Whether simulated time waits for the robot's sensors: :class:`vinesim.scene.values.SensorPacing`."""

    mode: SensorMode = SensorMode.LIVE
    least_rate: float = SensorPacing().least_rate
    """Lowest rate of the sensors, see :class:`vinesim.scene.values.SensorPacing` [Hz]."""


class Controller(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A controller, as ROS sees it."""

    kind: str
    """A :class:`~vinesim.scene.values.ControllerKind`, or a kind of gripper."""
    joints: tuple[str, ...] = ()
    """Its joints; the joints of ``group`` unless given."""
    group: str = ""
    """A joint group; a gripper needs one."""


class Sidecar(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The file without the tables of :data:`~vinesim.scene.values.SENSOR_KINDS`, which :data:`SidecarFile` adds."""

    base: BaseLimits = BaseLimits()
    groups: dict[str, JointGroup] = {}
    sensors: SensorTable = SensorTable()
    imus: tuple[SensorMount, ...] = ()
    wrenches: tuple[SensorMount, ...] = ()
    grippers: tuple[AnyGripper, ...] | None = None
    """None: fingers are guessed from the names of groups, :func:`vinesim.robot.description.grippers.guess_fingers`."""
    cutters: tuple[Cutter, ...] = ()
    """Further ``grippers``, all cutters, so that ``kind`` may be left out."""
    friction: dict[str, float] = {}
    """Coulomb friction coefficient [1] of contacts with a link, by link. It replaces the URDF's ``mu1``."""
    controllers: dict[str, Controller] | None = None
    """Controllers by name. None: :mod:`vinesim.robot.description.controllers` derives them from the groups."""
    srdf: str = ""
    """SRDF file whose pairs of ``disable_collisions`` never touch, by its path from the TOML file; unless given, the
    file of the URDF's name that ends with ``.srdf``, if there is one."""

    @property
    def all_grippers(self) -> tuple[AnyGripper, ...]:
        """The entries of ``grippers`` and ``cutters``."""
        return (*(self.grippers or ()), *self.cutters)

    def mounts(self, kind: str) -> tuple[RenderedMount, ...] | None:
        """The sensors of a kind. None: the file does not have this kind, and the sensors are guessed from the URDF."""
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
"""Type of the whole file: :class:`Sidecar` with one table for each kind of sensor."""


def read_sidecar(file: pathlib.Path) -> Sidecar:
    """Returns the file's content, or defaults if there is no file. Raises :class:`DescriptionError` if it has unknown
    or unfit keys."""
    if not file.is_file():
        return Sidecar()
    try:
        return msgspec.toml.decode(file.read_bytes(), type=SidecarFile)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise description_error(file, str(error), "see data/robots/vinebot.toml for what may be said") from error


MAX_REMOTE_SIDECAR = 1 << 16
"""Longest sidecar that is accepted from another client [B]."""

MAX_REMOTE_NUMBER = 1e7
"""Largest gain, limit or position in a sidecar from another client: ten times the values of a robot that is bolted
down."""


def encode_sidecar(base: BaseLimits, groups: dict[str, JointGroup]) -> str:
    """Data for the copies of a robot on other clients, as JSON: limits of the base, joint groups with their gains.

    Sensors and grippers act where the robot is simulated, and are not part of it.
    """
    return msgspec.json.encode(Sidecar(base=base, groups=groups)).decode()


def decode_sidecar(text: str) -> Sidecar:
    """The sidecar of another client's robot, without sensors, so that no file is looked for.

    :class:`DescriptionError` if it is too long or malformed; ``check_sidecar`` checks its names and values.
    """
    origin = pathlib.Path("sidecar of another client")
    if len(text) > MAX_REMOTE_SIDECAR:
        raise description_error(origin, f"{len(text)} B", f"send at most {MAX_REMOTE_SIDECAR} B")
    try:
        found = msgspec.json.decode(text, type=SidecarFile) if text else Sidecar()
    except (msgspec.DecodeError, msgspec.ValidationError, RecursionError) as error:
        raise description_error(origin, str(error), "use the same release of vinesim") from error
    arrays = {name: values for group in found.groups.values() for name, values in group.arrays().items() if values}
    limits = msgspec.structs.asdict(found.base)
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
    """Raise :class:`DescriptionError` unless all names are ``driven`` joints or ``links`` and all values are fit."""
    for name, group in sidecar.groups.items():
        _check_group(name, group, driven, links, file)
    for gripper in sidecar.all_grippers:
        gripper.check(sidecar.groups, links, file)
    if not all(0.0 <= slip < 1.0 for slip in sidecar.base.slip):
        raise description_error(file, f"slip of {sidecar.base.slip}", "give shares from 0 to below 1")
    mounts: Iterable[SensorMount] = (*sensors, *sidecar.imus, *sidecar.wrenches)
    for mount in mounts:
        if mount.frame not in links:
            raise description_error(file, f"{mount.name!r} sits in {mount.frame!r}", "name a link of the URDF")
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
    for joint in group.joints:
        if joint not in driven:
            raise description_error(
                file, f"group {name!r} names {joint!r}, which no drive moves", "name driven joints only"
            )
    for key, values in group.arrays().items():
        if values is not None and len(values) != len(group.joints):
            raise description_error(
                file, f"group {name!r} has {len(values)} of {key} for {len(group.joints)} joints", "give one each"
            )
    if (group.series_stiffness is None) != (group.series_damping is None):
        raise description_error(
            file, f"group {name!r} gives only half of its springs", "give elastic and elastic_damping"
        )
    if min((*(group.series_stiffness or ()), *(group.series_damping or ()), 0.0)) < 0.0:
        raise description_error(file, f"group {name!r} has a spring below zero", "give 0 or more")
    if group.tool and group.tool not in links:
        raise description_error(file, f"group {name!r} has the tool {group.tool!r}", "name a link of the URDF")
