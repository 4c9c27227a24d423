"""The copy of a person whom another client controls."""

from __future__ import annotations

from vinesim.net.codec.control import Hello
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene import appearance
from vinesim.scene.values import HumanPose, HumanSpec, HumanUpdate


class RemoteHuman:
    """A copy whose pose equals the received pose to the bit. Its hands push objects, but not robots."""

    def __init__(self, rigid: RigidWorld, name: str) -> None:
        """``name``: name of a person who was already added to ``rigid``; see :func:`human_spec`."""
        self.rigid = rigid
        self.name = name
        self.intention = ""
        """Intention that the person indicates."""
        self.pose: HumanPose | None = None
        """Last received pose; its fingers show the gesture."""

    def follow(self, update: HumanUpdate) -> None:
        """Move to the pose in ``update`` at the end of the coming step."""
        self.rigid.move_human(self.name, update.pose)
        self.intention = update.intention
        self.pose = update.pose

    def remove(self) -> None:
        """Remove the copy."""
        self.rigid.remove_human(self.name)


def human_spec(hello: Hello, update: HumanUpdate) -> HumanSpec:
    """Returns the description of a person for the physics, from messages of another client.

    An outfit that is unknown on this client is replaced by the outfit that follows from the person's name.
    """
    outfit = hello.outfit if hello.outfit in appearance.outfit_names() else ""
    return HumanSpec(hello.name, hello.index, update.pose, hello.height, outfit=outfit)
