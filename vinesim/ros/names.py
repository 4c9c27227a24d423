"""Names that ROS allows."""

from __future__ import annotations

import re


def ros_name(actor: str) -> str:
    """An actor's name as part of a topic or as the name of a node: all but ASCII letters, digits and underscores is
    replaced by an underscore, which also comes before a digit at the start."""
    return re.sub(r"^(?=\d|$)", "_", re.sub(r"\W", "_", actor, flags=re.ASCII))
