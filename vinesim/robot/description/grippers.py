"""Kinds of grippers: how the TOML file of a robot names one, and which controller serves it.

A kind is a subclass of :class:`Gripper`, a member of :data:`AnyGripper`, and a controller in
:data:`vinesim.robot.control.gripper_controllers.CONTROLLERS`. ROS sees all kinds alike: each is an action
control_msgs/GripperCommand, whose goal and result the controller explains.
"""

from __future__ import annotations

import pathlib
from collections.abc import Collection, Container, Iterable, Mapping
from typing import ClassVar, get_args

import msgspec

from vinesim.robot.description.urdf import MOVABLE_JOINT_TYPES, Joint, description_error


class Gripper(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """A gripper, which holds or cuts at one place of a robot: an entry of ``grippers`` with its ``kind``."""

    group: str
    """The joint group that the gripper is or belongs to. Commands name the gripper by its group."""

    moves_joints: ClassVar[bool] = False
    """Whether its controller moves the joints of the group, so that no trajectory controller gets them."""

    @property
    def kind(self) -> str:
        """Name of the kind in TOML files and in :class:`vinesim.scene.values.ControllerSpec`."""
        return str(self.__struct_config__.tag)

    @property
    def controller(self) -> str:
        """Name of its controller, unless the TOML file names the controllers itself."""
        return f"{self.group}_controller"

    def check(self, groups: Container[str], links: Container[str], file: pathlib.Path) -> None:
        """Raise :class:`DescriptionError` unless the names are ``groups`` or ``links`` and all values are fit."""
        if self.group not in groups:
            raise description_error(file, f"a {self.kind} belongs to {self.group!r}", "name a group")


class Fingers(Gripper, frozen=True, tag="fingers"):
    """The joints of a group as fingers, which close on an object between them and hold it by friction."""

    moves_joints: ClassVar[bool] = True


class Cutter(Gripper, frozen=True, tag="cutter"):
    """The space between two blades: x along the blades, y from one to the other, z across their plane."""

    frame: str
    """The link that carries it."""
    half: tuple[float, float, float]
    """Half edges of the space [m]. The second one is the distance to either side within which wood is caught."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Its centre in ``frame`` [m]."""
    force: float | None = None
    """Largest force with which it cuts [N]. None: it cuts whatever is in its mouth."""

    @property
    def controller(self) -> str:
        """Name of the cutter's controller. It differs from the name for fingers of the same group."""
        stem = self.group.replace("gripper", "cutter") if "gripper" in self.group else f"{self.group}_cutter"
        return f"{stem}_controller"

    def check(self, groups: Container[str], links: Container[str], file: pathlib.Path) -> None:
        """See :class:`Gripper`."""
        super().check(groups, links, file)
        if self.frame not in links:
            raise description_error(
                file, f"the cutter of {self.group!r} sits in {self.frame!r}", "name a link of the URDF"
            )
        if self.force is not None and not self.force > 0.0:
            raise description_error(file, f"the cutter of {self.group!r} has {self.force} N", "give more than 0")
        if min(self.half) <= 0.0:
            raise description_error(
                file, f"the cutter of {self.group!r} has a mouth of {self.half}", "give half edges above 0"
            )


AnyGripper = Fingers | Cutter
"""Union of all kinds of grippers."""

GRIPPER_KINDS: dict[str, type[Gripper]] = {str(kind.__struct_config__.tag): kind for kind in get_args(AnyGripper)}
"""Classes of grippers: name of the kind -> class."""


def guess_fingers(groups: Iterable[str], cutters: Collection[Cutter]) -> tuple[Fingers, ...]:
    """Fingers of a robot whose file does not list its grippers: groups with gripper or hand in their name, or with a
    cutter."""
    cut = {cutter.group for cutter in cutters}
    return tuple(Fingers(name) for name in groups if "gripper" in name or "hand" in name or name in cut)


def warn_of_unlisted_fingers(
    groups: Mapping[str, Collection[str]], fingers: Collection[Fingers], joints: Collection[Joint], assumed: list[str]
) -> None:
    """Add to ``assumed`` the groups whose joints look like fingers, but whose names do not.

    Fingers are joints of a group that start at the same link, including joints that mimic one. ``groups``: names of the
    driven joints of each group.
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
                f"group {group!r} is no gripper, though joints of it start at one link, as fingers do (say in the TOML "
                f'file: [[grippers]] kind = "fingers", group = "{group}"; or grippers = [], for none)'
            )
