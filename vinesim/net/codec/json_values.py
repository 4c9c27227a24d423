"""JSON values and JSON schemas. Codecs compose from them the description of a message in a recording.

The text of the schemas is part of the file format. Poses have the fields of ``foxglove.PoseInFrame``, so that Foxglove
can draw them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vinesim.scene.ids import ObjectKind, split_object_id


def stamp(seconds: float) -> dict[str, int]:
    """Returns a time [s] as a JSON object of whole seconds and nanoseconds."""
    nanoseconds = round(seconds * 1e9)
    return {"sec": nanoseconds // 1_000_000_000, "nsec": nanoseconds % 1_000_000_000}


def pose_value(pose: np.ndarray) -> dict[str, dict[str, float]]:
    """Returns a pose [7] (position in m, quaternion xyzw) as a JSON object."""
    x, y, z, qx, qy, qz, qw = pose.tolist()
    return {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": qx, "y": qy, "z": qz, "w": qw}}


def named(object_id: int) -> dict[str, Any]:
    """Returns the kind and the index of an object as JSON fields."""
    kind, index = split_object_id(object_id)
    return {"kind": kind.name.lower(), "index": index}


def object_of(title: str, description: str, **properties: Any) -> dict[str, Any]:
    """Returns the JSON schema of an object with these properties, given as schemas by name."""
    return {"type": "object", "title": title, "description": description, "properties": properties}


def list_of(items: Any, description: str = "") -> dict[str, Any]:
    """Returns the JSON schema of a list. ``items``: schema of each item."""
    return {"type": "array", "items": items} | ({"description": description} if description else {})


NUMBER, COUNT, TEXT, YES = ({"type": kind} for kind in ("number", "integer", "string", "boolean"))

TIME = object_of("time", "network time", sec=COUNT, nsec=COUNT)

CLAIM = {"ownership": COUNT, "authority": COUNT}

THING = {"kind": {"type": "string", "enum": [kind.name.lower() for kind in ObjectKind]}, "index": COUNT, **CLAIM}

_XYZ = object_of("position", "m, world axes", x=NUMBER, y=NUMBER, z=NUMBER)

_XYZW = object_of("orientation", "unit quaternion", x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)

POSE = object_of("pose", "in the world, of a fact in its parent's frame", position=_XYZ, orientation=_XYZW)
"""JSON schema of what :func:`pose_value` returns."""
