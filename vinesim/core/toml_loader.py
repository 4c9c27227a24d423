"""Loads TOML files into frozen structs. An error is one line: the file, the field, what is wrong with it, and how to
correct it."""

from __future__ import annotations

import difflib
import functools
import math
import pathlib
import re
import tomllib
from typing import Any, TypeVar

import msgspec

from vinesim.core.errors import one_line

T = TypeVar("T", bound=msgspec.Struct)

_KINDS = {
    "int": "a whole number",
    "float": "a number",
    "str": 'text in "quotes"',
    "array": "a list [...]",
    "object": "a table",
}


MAX_SIZE = 4 << 20
"""Largest size of a TOML file [B]. The largest imported plant has 1 MB."""
MAX_DEPTH = 50
"""Largest depth of nested tables and lists."""
_DEEP_KEY = re.compile(
    rf"""(?<![\w-])(?:(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){{{MAX_DEPTH},}}"""  # tomllib takes minutes for one
)
_MAX_SHOWN = 200
"""Largest number of characters of a value or of an error that a message repeats."""


class DataError(ValueError):
    """Raised for a data file that cannot be used. The message is one line."""

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


def load_toml(path: pathlib.Path, kind: type[T], error: type[DataError] = DataError) -> T:
    """Returns the content of the TOML file at ``path`` as an object of the class ``kind``. Raises ``error`` if the file
    cannot be read or does not fit ``kind``."""
    return to_struct(read_toml(path, error), kind, str(path), error)


def read_toml(path: pathlib.Path, error: type[DataError] = DataError) -> dict[str, Any]:
    """Returns the tables of the TOML file at ``path``. Raises ``error`` if the file cannot be read or has a number that
    is not finite."""
    try:
        with path.open("rb") as file:
            content = file.read(MAX_SIZE + 1)
        if len(content) > MAX_SIZE:
            raise error(f"{path}: has more than {MAX_SIZE >> 20} MiB; give a smaller file")
        text = content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except (OSError, UnicodeDecodeError) as bad:
        raise error(f"{path}: cannot be read: {_one_line(bad)}; give a readable UTF-8 file") from None
    try:
        if _DEEP_KEY.search(text):
            raise RecursionError
        data = tomllib.loads(text)
        leaves = _leaves(data)
    except RecursionError:
        raise error(f"{path}: nests tables or lists more than {MAX_DEPTH} deep; nest fewer") from None
    except ValueError as bad:  # tomllib.TOMLDecodeError, and a number with more digits than Python reads
        raise error(f"{path}: not valid TOML: {_one_line(bad)}; correct the syntax there") from None
    for place, value in leaves:
        if isinstance(value, float) and not math.isfinite(value):
            raise error(f"{path}: {_shown(place)} is {value}; give a finite number")
        if isinstance(value, int) and not -(1 << 63) <= value < 1 << 63:
            raise error(f"{path}: {_shown(place)} has more than 64 bits; give a smaller number")
    return data


def to_struct(data: dict[str, Any], kind: type[T], source: str, error: type[DataError] = DataError) -> T:
    """Returns the table ``data`` as an object of the class ``kind``. Raises ``error`` if it does not fit; the message
    begins with ``source``."""
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as bad:
        try:
            told = _explain(str(bad), data, kind)
        except (LookupError, StopIteration, TypeError, AttributeError, ValueError):  # a key has marks of msgspec's text
            told = _shown(str(bad))
        raise error(f"{source}: {_one_line(told)}") from None


@functools.cache
def field_type(kind: Any, path: str) -> msgspec.inspect.Type:
    """Returns the type of the field at a dotted ``path`` such as ``season.yellow`` in the struct ``kind``. Raises
    :class:`DataError` if there is no such field."""
    at = _present(msgspec.inspect.type_info(kind))
    for word in path.split("."):
        known = {f.encode_name: f.type for f in at.fields} if isinstance(at, msgspec.inspect.StructType) else {}
        if word not in known:
            raise DataError(f"{path}: {word} is not a field; {_remedy(word, list(known))}")
        at = _present(known[word])
    return at


def _remedy(name: str, known: list[str], hint: str = "") -> str:
    """Returns what to do about the unknown field ``name``: the ``hint``, or the known name that is most like it."""
    near = difflib.get_close_matches(name, known, 1, 0.5)
    hint = hint or (f"did you mean {near[0]!r}?" if near else "remove it")
    return f"{hint} (known: {', '.join(known)})"


def _one_line(bad: object) -> str:
    return " ".join(str(bad).split())


def _shown(text: str) -> str:
    """Returns the beginning of a text, which may be as long as a file."""
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."


def _leaves(data: Any, place: str = "", depth: int = 0) -> list[tuple[str, Any]]:
    """Returns every value in nested tables and lists, with its path, for example ``spawns[0].x``. Raises
    :class:`RecursionError` beyond :data:`MAX_DEPTH`."""
    if depth > MAX_DEPTH:
        raise RecursionError
    if isinstance(data, dict):
        return [
            leaf
            for key, value in data.items()
            for leaf in _leaves(value, f"{place}.{key}" if place else key, depth + 1)
        ]
    if isinstance(data, list):
        return [leaf for i, value in enumerate(data) for leaf in _leaves(value, f"{place}[{i}]", depth + 1)]
    return [(place, data)]


def _explain(message: str, data: Any, kind: Any) -> str:
    """Returns the path, the error and its correction in words, from msgspec's ``message``, which ends in ``- at
    `$.a[0].b```."""
    what, _, where = message.partition(" - at `$")
    place = where.rstrip("`").lstrip(".")
    if "[...]" in place:  # msgspec writes [...] for a key that the file chose
        return f"{place}: {what}; correct it there"
    steps = [int(s) if s.isdigit() else s for s in re.findall(r"[^.\[\]]+", place)]
    found: Any = data
    for step in steps:
        found = found[step]
    named = f"{place}." if place else ""
    quoted = re.findall(r"`([^`]*)`", what)
    if "unknown field" in what:
        is_above = bool(steps) and quoted[0] in _fields(kind, [])
        hint = "it belongs to no table: write it above the first [...] of the file" if is_above else ""
        return f"{named}{quoted[0]} is not a field; {_remedy(quoted[0], _fields(kind, steps), hint)}"
    if "missing required field" in what:
        return f"{named}{quoted[0]} is missing; add it: {quoted[0]} = ..."
    if place and what.startswith(f"{place}."):  # the message comes from the struct's own check and names the field
        return what
    place = place or "the file"
    if what.startswith("Invalid enum value"):
        return f"{place} is {_shown(repr(found))}; give one of: {', '.join(_choices(kind, steps))}"
    if what.startswith("Expected") and quoted:
        types = [_KINDS.get(t.strip(), t.strip()) for t in re.split(r"\|", quoted[0])]
        bound = what.split("`", 2)[2].partition(", got")[0].strip()
        return f"{place} is {_shown(repr(found))}; give {' or '.join(types)}{' ' + bound if bound else ''}"
    return f"{place} is {_shown(repr(found))}; {what}"


def _step_in(kind: Any, steps: list[Any]) -> Any:
    """Returns the msgspec type at the path ``steps`` inside ``kind``."""
    at: Any = _present(msgspec.inspect.type_info(kind))
    for step in steps:
        if isinstance(at, msgspec.inspect.StructType):
            at = next(f.type for f in at.fields if f.encode_name == step)
        elif isinstance(at, msgspec.inspect.DictType):
            at = at.value_type
        elif isinstance(at, msgspec.inspect.TupleType):
            at = at.item_types[step]
        else:
            at = at.item_type
        at = _present(at)
    return at


def _present(kind: Any) -> Any:
    """Returns what an optional msgspec type has if it is there, and any other type itself."""
    if not isinstance(kind, msgspec.inspect.UnionType):
        return kind
    return next(one for one in kind.types if not isinstance(one, msgspec.inspect.NoneType))


def _fields(kind: Any, steps: list[Any]) -> list[str]:
    return [f.encode_name for f in _step_in(kind, steps).fields]


def _choices(kind: Any, steps: list[Any]) -> list[str]:
    return [str(v) for v in _step_in(kind, steps).values]
