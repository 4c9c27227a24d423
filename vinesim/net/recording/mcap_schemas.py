"""JSON schemas of recorded messages, by the first chunk of their key. Their text is part of the file format."""

from __future__ import annotations

from typing import Any

import msgspec

from vinesim.scene.ids import ObjectKind
from vinesim.scene.values import POINT_NAMES


def _object(title: str, description: str, **properties: Any) -> dict[str, Any]:
    return {"type": "object", "title": title, "description": description, "properties": properties}


def _list(items: Any) -> dict[str, Any]:
    return {"type": "array", "items": items}


_NUMBER, _COUNT, _TEXT, _YES = ({"type": kind} for kind in ("number", "integer", "string", "boolean"))

_TIME = _object("time", "network time", sec=_COUNT, nsec=_COUNT)

_CLAIM = {"ownership": _COUNT, "authority": _COUNT}

_THING = {"kind": {"type": "string", "enum": [kind.name.lower() for kind in ObjectKind]}, "index": _COUNT, **_CLAIM}

_XYZ = _object("position", "m, world axes", x=_NUMBER, y=_NUMBER, z=_NUMBER)

_XYZW = _object("orientation", "unit quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)

_COMMON = {
    "actor": {"type": "string", "description": "whose message it is"},
    "raw": {"type": "string", "contentEncoding": "base64", "description": "the message as it crossed the network"},
    "error": {"type": "string", "description": "why raw is no message"},
}

_POSE = _object("pose", "in the world, of a fact in its parent's frame", position=_XYZ, orientation=_XYZW)

_TREES = _list(_object("tree", "one record", tree=_COUNT, bodies=_COUNT, touched=_YES, resting=_YES, **_CLAIM))

_THINGS = _list(_object("thing", "a box or a loose bunch", touched=_YES, pose=_POSE, velocity=_list(_NUMBER), **_THING))

_LINKS = _list(
    _object(
        "link",
        "one that is pushed",
        link=_TEXT,
        wrench={**_list(_NUMBER), "description": "force [N], moment about its centre of mass [N m], world axes"},
    )
)

_COUPLINGS = _list(
    _object(
        "coupling",
        "a spring that holds a body of a tree",
        body=_COUNT,
        point={**_list(_NUMBER), "description": "in the body's frame [m]"},
        anchor={**_list(_NUMBER), "description": "where it is pulled to, in the world [m]"},
    )
)

_CLAIMS = _list(_object("claim", "who says to own a thing", owner=_TEXT, touched=_YES, **_THING))

_FACTS = _list(
    _object(
        "fact",
        "what stays true",
        author=_TEXT,
        parent=_TEXT,
        moving=_YES,
        pose=_POSE,
        cut=_list(_COUNT),
        **_THING,
    )
)

_SCHEMAS: dict[str, tuple[str, dict[str, Any]]] = {
    "a": (
        "foxglove.PoseInFrame",
        _object(
            "foxglove.PoseInFrame",
            "Where an actor is, and its joints.",
            timestamp=_TIME,
            frame_id=_TEXT,
            pose=_POSE,
            velocity={**_list(_NUMBER), "description": "of its base: m/s, rad/s, world axes"},
            joint_position={**_list(_NUMBER), "description": "rad or m"},
            joint_velocity={**_list(_NUMBER), "description": "rad/s or m/s"},
            points=_object("points", "of a person", **dict.fromkeys(POINT_NAMES, _POSE)),
            intention=_TEXT,
            lights=_object("lights", "of a robot, sRGB 0 to 255", pattern=_TEXT, color=_list(_COUNT)),
            **_COMMON,
        ),
    ),
    "c": (
        "vinesim.Moving",
        _object(
            "vinesim.Moving",
            "Boxes and bunches that an actor moves in a cell.",
            timestamp=_TIME,
            things=_THINGS,
            **_COMMON,
        ),
    ),
    **dict.fromkeys(
        ("tree", "near"),
        (
            "vinesim.Trees",
            _object("vinesim.Trees", "Trees that an actor moves.", timestamp=_TIME, trees=_TREES, **_COMMON),
        ),
    ),
    "own": (
        "vinesim.Event",
        _object(
            "vinesim.Event", "A claim, or what came to rest.", timestamp=_TIME, trees=_TREES, claims=_CLAIMS, **_COMMON
        ),
    ),
    "force": (
        "vinesim.Push",
        _object(
            "vinesim.Push",
            "What an actor does to a robot, or to a tree that another touches, too.",
            timestamp=_TIME,
            links=_LINKS,
            couplings=_COUPLINGS,
            **_COMMON,
        ),
    ),
    "fact": ("vinesim.Facts", _object("vinesim.Facts", "What stays true.", facts=_FACTS, **_COMMON)),
    "snap": ("vinesim.Facts", _object("vinesim.Facts", "What was true before.", facts=_FACTS, **_COMMON)),
    "hello": (
        "vinesim.Greeting",
        _object(
            "vinesim.Greeting",
            "How an actor introduced itself.",
            name=_TEXT,
            kind=_TEXT,
            robot=_TEXT,
            urdf=_TEXT,
            sidecar=_TEXT,
            scene=_TEXT,
            digest=_TEXT,
            seed=_COUNT,
            protocol=_COUNT,
            index=_COUNT,
            joints=_COUNT,
            height=_NUMBER,
            outfit=_TEXT,
            **_COMMON,
        ),
    ),
    "live": ("vinesim.Live", _object("vinesim.Live", "An actor came or went.", live=_YES, **_COMMON)),
}


def schema_of(key: str) -> tuple[str, bytes]:
    """Name and JSON schema of the messages under a key."""
    name, schema = _SCHEMAS.get(key.partition("/")[0], ("vinesim.Message", _object("vinesim.Message", "", **_COMMON)))
    return name, msgspec.json.encode(schema)
