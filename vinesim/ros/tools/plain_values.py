"""Conversion between ROS messages and plain values (dicts, lists, numbers, text), for message types that are not known
in advance."""

from __future__ import annotations

import array
import difflib
import re
from typing import Any

import numpy as np

from vinesim.core.errors import UsageError
from vinesim.ros.tools.subscribing import message_class

LONGEST_LIST = 128
"""Number of elements of a list above which :func:`to_plain` shortens the list, as ``ros2 topic echo`` does."""
LONGEST_TEXT = 1000
"""Number of characters of a text above which :func:`to_plain` shortens the text."""


def to_plain(value: Any, *, full: bool = False) -> Any:
    """Returns a message, or a field of one, as dicts, lists, numbers and text.

    ``full``: False: lists and texts that are longer than :data:`LONGEST_LIST` and :data:`LONGEST_TEXT` are shortened,
    and end with the number of the missing elements.
    """
    if hasattr(value, "get_fields_and_field_types"):
        return {name: to_plain(getattr(value, name), full=full) for name in value.get_fields_and_field_types()}
    if isinstance(value, str):
        if full or len(value) <= LONGEST_TEXT:
            return value
        return f"{value[:LONGEST_TEXT]}... {len(value) - LONGEST_TEXT} more characters"
    if isinstance(value, bytes) and len(value) == 1:  # an octet
        return value[0]
    if isinstance(value, list | tuple | array.array | np.ndarray | bytes):
        shown = value if full or len(value) <= LONGEST_LIST else value[:LONGEST_LIST]
        found = [to_plain(one, full=full) for one in shown]
        return found if len(shown) == len(value) else [*found, f"... {len(value) - len(shown)} more"]
    return value.item() if isinstance(value, np.generic) else value


def field_of(message: Any, path: str) -> Any:
    """Returns the field of a message that ``path`` names, such as ``pose.position.x`` or ``position[2]``.

    Raises :class:`vinesim.core.errors.UsageError` if the message has no such field.
    """
    value: Any = message
    done = ""
    for name, index in re.findall(r"([^.\[\]]+)|\[(-?\d+)\]", path):
        place = f"in {done}" if done else f"of {_type_name(message)}"
        if name:
            known = value.get_fields_and_field_types() if hasattr(value, "get_fields_and_field_types") else {}
            if name not in known:
                what = f"fields: {', '.join(known)}" if known else "it is not a message"
                raise UsageError(f"--field {path}: no field {name} {place}; {what}")
            value = getattr(value, name)
            done = f"{done}.{name}".lstrip(".")
        else:
            if not isinstance(value, list | tuple | array.array | np.ndarray | bytes):
                raise UsageError(f"--field {path}: {done or 'the message'} is no list; leave out [{index}]")
            if not -len(value) <= int(index) < len(value):
                raise UsageError(f"--field {path}: {done} has {len(value)} elements; [{index}] does not exist")
            value = value[int(index)]
            done += f"[{index}]"
    return value


def from_plain(message_type: type, values: Any, place: str = "") -> Any:
    """Returns a message of a type with the fields in ``values``, a dict. Other fields keep their defaults.

    ``place``: path of the message in the outermost one, for error messages. Raises
    :class:`vinesim.core.errors.UsageError`, which names the field, if a field does not exist or has another type.
    """
    message: Any = message_type(check_fields=True)  # by default only the C code checks, by aborting
    if values is None:
        return message
    if not isinstance(values, dict):
        raise UsageError(f"{place or 'message'}: {values!r} is no {_type_name(message)}; give {{field: value}}")
    kinds = message.get_fields_and_field_types()
    for name, value in values.items():
        path = f"{place}.{name}".lstrip(".")
        if name not in kinds:
            close = difflib.get_close_matches(str(name), kinds, 1)
            remedy = f"do you mean {close[0]}?" if close else f"fields: {', '.join(kinds) or 'none'}"
            raise UsageError(f"{path}: {_type_name(message)} has no such field; {remedy}")
        try:
            setattr(message, name, _converted(kinds[name], value, path))
        except (AssertionError, TypeError, ValueError, OverflowError) as bad:
            if isinstance(bad, UsageError):
                raise
            raise UsageError(f"{path}: {value!r} is no {kinds[name]}; give a value of this type") from None
    return message


def _converted(kind: str, value: Any, path: str) -> Any:
    """Returns ``value`` as a field of the ROS type ``kind`` takes it."""
    if (items := re.fullmatch(r"sequence<(.*?)(?:, \d+)?>|(.*)\[\d+\]", kind)) is not None:
        if not isinstance(value, list):
            raise TypeError
        item = items[1] or items[2]
        return [_converted(item, one, f"{path}[{i}]") for i, one in enumerate(value)]
    if "/" in kind:
        nested = message_class(kind.replace("/", "/msg/"))
        if nested is None:
            raise UsageError(f"{path}: no package with {kind} is installed; leave the field out")
        return from_plain(nested, value, path)
    if kind in ("float", "double") and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind == "octet" and isinstance(value, int):
        return bytes([value])
    return value


def _type_name(message: Any) -> str:
    """Returns the name of a message's type as ``package/kind/Name``."""
    package, kind, *_ = type(message).__module__.split(".")
    return f"{package}/{kind}/{type(message).__name__}"
