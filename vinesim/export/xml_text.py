"""Elements and numbers of XML documents, the same on every machine."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree


def text(*numbers: float) -> str:
    """Returns numbers as text, separated by spaces, each with at most nine significant digits. Machines differ in the
    digits beyond, and masses keep a relative accuracy of 1e-9."""
    return " ".join(f"{float(number) + 0.0:.9g}" for number in numbers)


def add(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    """Append an element to ``parent`` and return it. An underscore ends attributes whose names are words of Python."""
    return ElementTree.SubElement(parent, tag, {key.rstrip("_"): value for key, value in attributes.items()})
