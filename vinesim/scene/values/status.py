"""The state of one part of a client, for diagnostics."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal


@dataclasses.dataclass(frozen=True, slots=True)
class ComponentStatus:
    """State of one part of a client, for ROS diagnostics: name of the part (``simulation``, ``network``, ``sensors``,
    ...), level, message, and statistics by name."""

    name: str
    level: Literal["ok", "warning", "error"] = "ok"
    message: str = "well"
    values: Mapping[str, Any] = dataclasses.field(default_factory=dict)
