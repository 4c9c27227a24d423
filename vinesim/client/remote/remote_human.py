"""The copy of a person whom another client moves."""

from __future__ import annotations

from vinesim.net.codec.control import Hello
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene import appearance
from vinesim.scene.values import HumanPose, HumanSpec, HumanUpdate


class RemoteHuman:
    """A copy whose pose equals the received one to the bit; its hands push objects, but no robots."""

    def __init__(self, rigid: RigidWorld, name: str) -> None:
        """``name`` of a person who was added to ``rigid`` already; see :func:`human_spec`."""
        self.rigid = rigid
        self.name = name
        self.intention = ""
        """What the person indicates to do."""
        self.pose: HumanPose | None = None
        """As last received; its fingers tell the gesture."""

    def follow(self, update: HumanUpdate) -> None:
        """Be where ``update`` says at the end of the coming step."""
        self.rigid.move_human(self.name, update.pose)
        self.intention = update.intention
        self.pose = update.pose

    def remove(self) -> None:
        """Remove the copy."""
        self.rigid.remove_human(self.name)


def human_spec(hello: Hello, update: HumanUpdate) -> HumanSpec:
    """A person as physics needs one, from what another client sent; one in an outfit that is unknown here gets that of
    its name."""
    outfit = hello.outfit if hello.outfit in appearance.outfit_names() else ""
    return HumanSpec(hello.name, hello.index, update.pose, hello.height, outfit=outfit)
