"""Names that ROS allows."""

from __future__ import annotations

import re


def ros_name(actor: str) -> str:
    """An actor's name as part of a topic or as the name of a node. All characters but ASCII letters, digits and
    underscores are replaced by underscores. A digit at the start gets an underscore before it."""
    return re.sub(r"^(?=\d|$)", "_", re.sub(r"\W", "_", actor, flags=re.ASCII))
