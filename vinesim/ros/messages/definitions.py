"""Definitions of message types as text, together with the types that they refer to, as recordings embed them
(encoding ``ros2msg``)."""

from __future__ import annotations

import functools
import re

from vinesim.ros import installation
from vinesim.ros.messages.message_packages import DEFINITIONS

_SEPARATOR = "=" * 80
_FIELD = re.compile(r"^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]", re.MULTILINE)
_PRIMITIVES = {"bool", "byte", "char", "string", "wstring"}


class UnknownTypeError(LookupError):
    """A message type whose definition is not installed. The message names the type."""


def message_definition(type_name: str) -> str:
    """Returns the definition of ``package/msg/Name``, followed by the definitions of all types that it contains.
    Raises :class:`UnknownTypeError`."""
    package, _, name = type_name.split("/")
    parts = [_text(package, name)]
    known = {(package, name)}
    open_types = [(package, name)]
    while open_types:
        inside, of = open_types.pop(0)
        for reference in _references(_text(inside, of), inside):
            if reference not in known:
                known.add(reference)
                open_types.append(reference)
                parts.append(f"{_SEPARATOR}\nMSG: {'/'.join(reference)}\n{_text(*reference)}")
    return "\n".join(parts)


def _references(text: str, package: str) -> list[tuple[str, str]]:
    """Returns (package, name) of the message types that a definition refers to, in order. ``package``: package of
    the definition."""
    found = []
    for kind in _FIELD.findall(re.sub(r"#.*", "", text)):
        *path, name = kind.split("/")
        if path or not (kind in _PRIMITIVES or re.fullmatch(r"u?int\d+|float\d+", kind)):
            found.append((path[0] if path else package, name))
    return found


@functools.cache
def _text(package: str, name: str) -> str:
    """Returns the definition of one message type, without the types that it refers to."""
    for file in (installation.find(f"share/{package}/msg/{name}.msg"), DEFINITIONS / package / "msg" / f"{name}.msg"):
        if file is not None and file.is_file():
            return file.read_text()
    raise UnknownTypeError(f"no definition of {package}/msg/{name} is installed")
