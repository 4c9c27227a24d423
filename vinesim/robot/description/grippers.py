"""Kinds of grippers: how a robot's TOML file names a gripper, and which controller serves it.

A kind is a subclass of :class:`Gripper`, a member of :data:`AnyGripper`, and a controller in
:data:`vinesim.robot.control.gripper_controllers.CONTROLLERS`. In ROS all kinds look the same: each is an action
control_msgs/GripperCommand. The controller defines the meaning of goal and result.
"""

from __future__ import annotations

import pathlib
from collections.abc import Collection, Container, Iterable, Mapping
from typing import ClassVar, Literal, get_args

import msgspec

from vinesim.robot.description.urdf import MOVABLE_JOINT_TYPES, Joint, description_error


class Gripper(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """A gripper of a robot, which holds or cuts: an entry of ``grippers`` in the TOML file."""

    group: str
    """Name of the joint group that the gripper consists of or belongs to. Commands refer to the gripper by this
    name."""

    moves_joints: ClassVar[bool] = False
    """Whether the gripper's controller moves the joints of the group, so that they get no trajectory controller."""

    @property
    def kind(self) -> str:
        """Name of the kind of gripper in TOML files and in :class:`vinesim.scene.values.ControllerSpec`."""
        return str(self.__struct_config__.tag)

    @property
    def controller(self) -> str:
        """Name of the gripper's controller, unless the TOML file lists controllers."""
        return f"{self.group}_controller"

    def check(self, groups: Container[str], links: Container[str], file: pathlib.Path) -> None:
        """Raise :class:`DescriptionError` unless the gripper refers only to existing ``groups`` and ``links`` and
        all its values are valid."""
        if self.group not in groups:
            raise description_error(file, f"a {self.kind} belongs to {self.group!r}", "name a group")


class Fingers(Gripper, frozen=True, tag="fingers"):
    """A gripper whose fingers are the joints of a group. They close on an object and hold it by friction."""

    moves_joints: ClassVar[bool] = True


class Cutter(Gripper, frozen=True, tag="cutter"):
    """A gripper with two blades, described by the box-shaped space between the blades in which wood is cut.

    The x axis of the box is along the blades, y points from one blade to the other, and z is perpendicular to the plane
    of the blades.
    """

    frame: str
    """Link that carries the cutter."""
    half: tuple[float, float, float]
    """Half edges of the space [m]. The second one is the distance to either side within which wood is cut."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of the space in ``frame`` [m]."""
    force: float | None = None
    """Largest cutting force [N]. None: everything between the blades is cut."""
    speed: float = 0.2
    """Speed with which the edges of the blades approach each other [m/s]. GUESSED: electric shears that close 40 mm in
    0.2 s."""
    blade: Literal["bypass", "anvil", "saw"] = "bypass"
    """How the blades cut; see :data:`~vinesim.interaction.cutting_force.BLADE_FACTORS`."""

    @property
    def controller(self) -> str:
        """Name of the cutter's controller. It differs from the controller of fingers in the same group."""
        stem = self.group.replace("gripper", "cutter") if "gripper" in self.group else f"{self.group}_cutter"
        return f"{stem}_controller"

    def check(self, groups: Container[str], links: Container[str], file: pathlib.Path) -> None:
        """Raise :class:`DescriptionError` unless the cutter refers only to existing ``groups`` and ``links`` and all
        its values are valid."""
        super().check(groups, links, file)
        if self.frame not in links:
            raise description_error(
                file, f"the cutter of {self.group!r} is mounted on {self.frame!r}", "name a link of the URDF"
            )
        if self.force is not None and not self.force > 0.0:
            raise description_error(file, f"the cutter of {self.group!r} has {self.force} N", "give more than 0")
        if not self.speed > 0.0:
            raise description_error(
                file, f"the cutter of {self.group!r} closes with {self.speed} m/s", "give more than 0"
            )
        if min(self.half) <= 0.0:
            raise description_error(
                file, f"the cutter of {self.group!r} has the half edges {self.half}", "give lengths above 0"
            )


AnyGripper = Fingers | Cutter
"""Union of the classes of all kinds of grippers."""

GRIPPER_KINDS: dict[str, type[Gripper]] = {str(kind.__struct_config__.tag): kind for kind in get_args(AnyGripper)}
"""Classes of grippers, by name of the kind."""


def guess_fingers(groups: Iterable[str], cutters: Collection[Cutter]) -> tuple[Fingers, ...]:
    """Returns the fingers of a robot whose TOML file does not list its grippers: each group with ``gripper`` or
    ``hand`` in its name, and each group with a cutter."""
    cut = {cutter.group for cutter in cutters}
    return tuple(Fingers(name) for name in groups if "gripper" in name or "hand" in name or name in cut)


def warn_of_unlisted_fingers(
    groups: Mapping[str, Collection[str]], fingers: Collection[Fingers], joints: Collection[Joint], assumed: list[str]
) -> None:
    """Add a warning to ``assumed`` for each group whose joints look like fingers but that is not among ``fingers``.

    Joints look like fingers if several of them, including joints that mimic them, start at the same link. ``groups``:
    names of the driven joints of each group.
    """
    named = {gripper.group for gripper in fingers}
    moving = [joint for joint in joints if joint.type in MOVABLE_JOINT_TYPES]
    for group, driven in groups.items():
        parents = [
            joint.parent
            for joint in moving
            if joint.name in driven or (joint.mimic is not None and joint.mimic.joint in driven)
        ]
        if group not in named and len(set(parents)) < len(parents):
            assumed.append(
                f"group {group!r} is no gripper, though several of its joints start at one link (write in the TOML "
                f'file: [[grippers]] kind = "fingers", group = "{group}"; or grippers = [], for none)'
            )
