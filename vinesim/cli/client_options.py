"""Options of ``vinesim client`` as one value, and the checks that need no scene."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Collection

from vinesim.core.errors import UsageError
from vinesim.scene.values import SensorMode

ROLES = ("robot", "human", "spectator")

ROLES_OF_OPTION = {
    **dict.fromkeys(
        ("robot", "approach", "namespace", "params_file", "ros", "push", "job", "watch", "standby"), ("robot",)
    ),
    **dict.fromkeys(("walk", "reach", "into", "height", "gestures", "outfit"), ("human",)),
    "jitter_buffer": ("robot", "human"),
    "sensor_hz": ("robot", "spectator"),
    **dict.fromkeys(("sensors", "least_sensor_hz"), ("robot",)),
    "renderer": ("robot", "spectator"),
}
"""The roles that an option belongs to, by its name; all roles have the options that are not named here."""

DEFAULT_WORLD = "vineyard"

STATUS_FORMATS = ("text", "json", "none")


@dataclasses.dataclass(frozen=True)
class ClientOptions:
    """What stands on the command line of one client; each field has the name of its option."""

    role: str
    name: str | None
    """None: the role and the process id."""
    connect: str | None
    """Endpoint of the server; None: no network."""
    tls: pathlib.Path | None
    scene: str
    seed: int | None
    robot: list[str] | None
    """One robot for each; None: one vinebot."""
    spawn: int
    pose: tuple[float, float, float] | None
    """x, y [m] and yaw [rad] of the start, instead of the scene's."""
    approach: float
    """How far behind its start pose a robot begins [m]."""
    namespace: str
    params_file: pathlib.Path | None
    """ROS parameters of the nodes of robots."""
    ros: bool
    push: int | None
    """Bunch."""
    job: str | None
    walk: tuple[float, float] | None
    """x, y [m]."""
    reach: int | None
    """Bunch."""
    into: int | None
    """Box."""
    height: float
    """[m]"""
    watch: int | None
    """Bunch."""
    interest_radius: float
    """[m]"""
    jitter_buffer: float
    """[ms]"""
    device: str
    threads: int
    seconds: float | None
    """Simulated time after which the client stops [s]; None: until a signal."""
    out: pathlib.Path | None
    status: str
    sensor_hz: float | None
    renderer: str
    tick_log: pathlib.Path | None
    page: int | None = None
    """Port of the page; 0: any that is free; None: a free one if this client exists for its page, else no page."""
    page_lan: bool = False
    """Whether other machines of the network may open the page."""
    gestures: pathlib.Path | None = None
    """File of a person's own finger poses."""
    outfit: str | None = None
    """What a person wears, by name; None: what follows from its own name."""
    real_time_factor: float | None = None
    """Simulated time over real time of a client without a server, 1 at most; None: as the client can follow."""
    sensors: str | None = None
    """Whether simulated time waits for cameras and lidars, a :class:`vinesim.scene.values.SensorMode`; None: as the
    robot's file says."""
    least_sensor_hz: float | None = None
    """Least rate of live sensors in simulated time [Hz]; None: as the robot's file says."""
    world: str = DEFAULT_WORLD
    """Of the server's worlds; those in different ones do not meet."""
    standby: bool = False
    """Whether a process stands by for the one that renders the sensors."""

    @property
    def is_for_page(self) -> bool:
        """Whether it is a person without a script, or a spectator that writes no pictures: of use by its page only."""
        is_person = self.role == "human" and self.walk is None and self.reach is None
        return is_person or (self.role == "spectator" and self.out is None)


def check_role(role: str, given: Collection[str]) -> None:
    """:class:`UsageError` unless there is such a role and it has all the options ``given`` on the command line."""
    if role not in ROLES:
        raise UsageError(f"role {role!r} is none of {', '.join(ROLES)}; give one of them")
    for option in sorted(given):
        roles = ROLES_OF_OPTION.get(option, ROLES)
        if role not in roles:
            flag = "--no-ros" if option == "ros" else f"--{option.replace('_', '-')}"
            raise UsageError(f"{flag} is an option of --role {' or '.join(roles)}, not of {role}; leave it out")


def check_status(status: str) -> None:
    """:class:`UsageError` unless there is such a format of status lines."""
    if status not in STATUS_FORMATS:
        raise UsageError(f"--status {status!r}: give text, json or none")


def check_options(options: ClientOptions) -> None:
    """Refuse what can be refused before anything is built: :class:`UsageError`, or DeviceError for a missing device."""
    check_status(options.status)
    if options.sensors is not None and options.sensors not in tuple(SensorMode):
        raise UsageError(f"--sensors {options.sensors!r}: give {', '.join(SensorMode)}")
    if options.page_lan and options.page is None and not options.is_for_page:
        raise UsageError("--page-lan without a page: give --page PORT, too")
    if options.tls is not None and options.connect is None:
        raise UsageError(f"--tls {options.tls} without a server: give --connect tls/HOST:7447")
    if options.world != DEFAULT_WORLD and options.connect is None:
        raise UsageError(f"--world {options.world} without a server: give --connect tcp/HOST:7447")
    if options.world != DEFAULT_WORLD and options.tls is not None:
        raise UsageError(
            f"--world {options.world} --tls {options.tls}: a server with certificates has one world; leave --world out"
        )
    if options.real_time_factor is not None and options.connect is not None:
        raise UsageError(
            f"--real-time-factor {options.real_time_factor:g} with --connect: a world runs as fast as its server says; "
            "give it to vinesim server"
        )
    if options.params_file is not None and not options.params_file.is_file():
        raise UsageError(f"--params-file {options.params_file}: there is no such file; give a ROS 2 parameter file")
    from vinesim.plants.device_buffers import find_device
    from vinesim.scene import appearance
    from vinesim.sensors.raster import renderer_selection

    if options.outfit is not None and options.outfit not in appearance.outfit_names():
        known = ", ".join(appearance.outfit_names())
        raise UsageError(f"--outfit {options.outfit}: there is no such outfit; give one of {known}")
    find_device(options.device)
    renderer_selection.check_renderer(options.renderer, options.device)
    if options.threads > 1 and options.device != "cpu":
        raise UsageError(
            f"--threads {options.threads} --device {options.device}: threads are for the CPU; leave one of the two out"
        )
