"""Names that ROS allows."""

from __future__ import annotations

import re


def ros_name(actor: str) -> str:
    """An actor's name as part of a topic or as the name of a node: all but letters, digits and underscores replaced."""
    return re.sub(r"\W", "_", actor)
