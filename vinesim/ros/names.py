"""Conversion of names of actors to names that ROS allows."""

from __future__ import annotations

import re


def ros_name(actor: str) -> str:
    """Convert an actor's name to a name that ROS allows in topics and for nodes. All characters but ASCII letters,
    digits and underscores become underscores. A name that is empty or starts with a digit gets an underscore in
    front."""
    return re.sub(r"^(?=\d|$)", "_", re.sub(r"\W", "_", actor, flags=re.ASCII))
