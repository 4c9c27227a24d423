"""Limits for the robot descriptions that clients send each other: the server and every client check them before they
parse a URDF.

The largest of 300 published robots that were counted has 214 links and 80 shapes (iCub), so the limits leave room.
"""

from __future__ import annotations

import collections
import re
from collections.abc import Mapping

MAX_LINKS = 512
"""Largest number of links of a robot, and of its joints, fixed ones included."""

MAX_JOINTS = 256
"""Largest number of driven joints of a robot: that many positions are in its poses."""

MAX_SHAPES = 1024
"""Largest number of shapes of a robot, visual and collision ones together."""

MAX_ELEMENTS = 30_000
"""Largest number of XML elements in the URDF of a robot."""

MAX_DEPTH = 100
"""Largest number of XML elements within each other."""

_TAG = re.compile(r"<(/?)(?:[\w.-]+:)?([\w.-]+)[^<>]*?(/?)>")


def urdf_objection(urdf: str) -> str:
    """Returns why a URDF that arrived over the network is refused unparsed; empty if it is within the limits.

    The text is searched once. A client sends a URDF without declarations, comments and entities, so a text with them is
    refused: they could hide elements.
    """
    if "<?" in urdf or "<!" in urdf:
        return "its URDF has an XML declaration, a comment or a document type, which no client sends"
    counts: collections.Counter[str] = collections.Counter()
    depth = 0
    for closes, tag, is_empty in _TAG.findall(urdf):
        depth += -1 if closes else not is_empty
        if depth > MAX_DEPTH:
            return f"its URDF has XML elements more than {MAX_DEPTH} deep"
        counts[tag] += not closes
    if sum(counts.values()) < urdf.count("<") - urdf.count("</"):
        return "its URDF is not well-formed XML"
    return counts_objection(counts)


def counts_objection(counts: Mapping[str, int]) -> str:
    """Returns why a robot is too large, from the number of XML elements of each tag; empty if it is not."""
    shapes = counts.get("visual", 0) + counts.get("collision", 0)
    for found, most, what in (
        (counts.get("link", 0), MAX_LINKS, "links"),
        (counts.get("joint", 0), 2 * MAX_LINKS, "joints and references to joints"),
        (shapes, MAX_SHAPES, "shapes"),
        (sum(counts.values()), MAX_ELEMENTS, "XML elements"),
    ):
        if found > most:
            return f"its URDF has {found} {what}, at most {most} are allowed"
    return ""
