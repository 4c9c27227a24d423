"""Reads PLY files (Turk 1994): skeletons of plants, and points.

The files are ASCII or binary PLY with any line ends. The element ``vertex`` has x, y, z and optionally radius or
diameter, parent and bunch. Unless vertices name their parents, there is an element ``edge`` (vertex1, vertex2). The
base is the lowest vertex, or the vertex whose parent is negative. Elements and properties may stand in any order.

The reader is our own: trimesh, which the package uses for meshes, reads cells that are no numbers without an error and
binary lists of several lengths not at all, and plyfile has the GPL.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import pathlib
import re

import numpy as np

from vinesim.core.text_files import CUT, NumberReader, TextError, decode_text, is_cut
from vinesim.scene.plant_import.skeleton import PlantFileError, Skeleton, read_plant, sort_nodes

log = logging.getLogger(__name__)

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
"""NumPy's names of the types, without the byte order."""
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_NEEDED = ("vertex", "edge")


@dataclasses.dataclass
class _Property:
    name: str
    kind: str
    """NumPy's name of the type."""
    count: str = ""
    """Of a list, NumPy's name of the type of its length."""


@dataclasses.dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = dataclasses.field(default_factory=list)


@dataclasses.dataclass
class _Content:
    elements: dict[str, dict[str, np.ndarray]]
    """Elements that are needed, with the numbers [row] of each property that is no list."""
    is_cut: bool
    """Whether the last number that was read may be cut off."""


def read_ply(path: pathlib.Path, unit: float, diameter_unit: float) -> Skeleton:
    """Returns the skeleton in a PLY file; ``unit`` and ``diameter_unit`` [m] as for
    :func:`~vinesim.scene.plant_import.mtg.read_mtg`."""
    content = _read(path)
    vertex, position = _vertices(path, content)
    edge = content.elements.get("edge", {})
    if "parent" in vertex:
        parent = _whole(path, "parent", vertex["parent"])
    elif {"vertex1", "vertex2"} <= edge.keys():
        parent = _parents(
            path, position, np.stack([_whole(path, name, edge[name]) for name in ("vertex1", "vertex2")], -1)
        )
    else:
        raise PlantFileError(
            f"{path}: tells no topology; give vertices a property 'parent', or an element 'edge' with vertex1, vertex2 "
            "(a point cloud or a mesh must be made a skeleton first)"
        )
    diameter = np.full(len(position), np.nan)
    for name, scale in (("radius", 2.0), ("diameter", 1.0)):
        if name in vertex:
            diameter = scale * diameter_unit * vertex[name]
    bunch = vertex.get("bunch", np.zeros(len(position)))
    notes = (CUT,) if content.is_cut else ()
    return sort_nodes(path, unit * position, np.maximum(parent, -1), diameter, bunch, "PLY skeleton", notes)


def _whole(path: pathlib.Path, name: str, values: np.ndarray) -> np.ndarray:
    """Returns numbers of vertices as int. Raises :class:`PlantFileError` if one is not whole."""
    if (bad := ~((np.abs(values) < 1 << 31) & (values == np.floor(values)))).any():
        raise PlantFileError(f"{path}: {name} is {values[np.argmax(bad)]:g}; give the number of a vertex, from 0")
    return values.astype(int)


def read_points(path: pathlib.Path) -> np.ndarray:
    """Returns the vertices [n, 3] of a PLY file, or the points of a text file with x, y and z in each line.

    Raises :class:`PlantFileError` if the file cannot be read.
    """
    if not path.is_file():
        raise PlantFileError(f"{path}: no such file; give points as PLY, or as text with x, y and z in a line")
    if path.suffix.lower() == ".ply":
        content = _read(path)
        if content.is_cut:
            log.warning("%s: %s", path, CUT)
        return _vertices(path, content)[1]
    text = read_plant(path)
    lines = [
        (number, line) for number, line in enumerate(text.split("\n"), 1) if line.strip() and line.strip()[0] != "#"
    ]
    if lines and re.match(r"\W*x\b", lines[0][1], re.IGNORECASE):
        lines = lines[1:]
    numbers = NumberReader()
    rows = []
    for number, line in lines:
        cells = _cells(line)[:3]
        try:
            rows.append([numbers.read(cell) for cell in cells])
        except TextError as bad:
            remedy = "give x, y and z as numbers" if " other " not in str(bad) else str(bad)
            raise PlantFileError(f"{path}:{number}: is {line.strip()[:40]!r}; {remedy}") from None
        if len(cells) < 3:
            raise PlantFileError(f"{path}:{number}: is {line.strip()[:40]!r}; give x, y and z as numbers")
    if rows and "." not in text and all("," in line and len(_cells(line)) > 3 for _, line in lines):
        raise PlantFileError(
            f"{path}: has more than 3 cells in a line and no decimal point; separate cells by semicolons"
        )
    if is_cut(text):
        log.warning("%s: %s", path, CUT)
    return np.array(rows).reshape(-1, 3)


def _cells(line: str) -> list[str]:
    """Returns the cells of a line with semicolons, tabs, blanks or commas between them."""
    line = line.strip()
    for mark in ";\t":
        if mark in line:
            return [cell.strip() for cell in line.split(mark) if cell.strip()]
    words = line.split()
    if len(words) > 1 and not any(word.endswith(",") or word.startswith(",") for word in words):
        return words  # with blanks between them, cells may have decimal commas
    return [cell.strip() for cell in line.split(",") if cell.strip()]


def _vertices(path: pathlib.Path, content: _Content) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Returns the properties of the vertices, and their positions [vertex, 3] in the file's unit."""
    vertex = content.elements.get("vertex", {})
    if not {"x", "y", "z"} <= vertex.keys():
        raise PlantFileError(f"{path}: has no element 'vertex' with x, y and z; give them")
    return vertex, np.stack([vertex[axis] for axis in "xyz"], -1)


def _parents(path: pathlib.Path, position: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Returns the parents [vertex] in the tree that the edges ``pairs`` [k, 2] form. Its root is the lowest vertex."""
    count = len(position)
    if len(pairs) != count - 1 or pairs.min(initial=0) < 0 or pairs.max(initial=0) >= count:
        raise PlantFileError(
            f"{path}: has {len(pairs)} edges between {count} vertices; give {count - 1} that join all of them to a tree"
        )
    parent = np.full(count, -2)
    parent[int(np.argmin(position[:, 2]))] = -1
    open_pairs = pairs
    while len(open_pairs):
        known = parent[open_pairs] > -2
        ready = known.any(1)
        if not ready.any():
            raise PlantFileError(f"{path}: vertex {open_pairs[0, 0]} is not joined to the base; give edges of one tree")
        for (a, b), (has, _) in zip(open_pairs[ready].tolist(), known[ready].tolist(), strict=True):
            if parent[a] > -2 and parent[b] > -2:
                raise PlantFileError(f"{path}: the edge from {a} to {b} closes a loop; remove it")
            parent[b if has else a] = a if has else b
        open_pairs = open_pairs[~ready]
    return parent


def _read(path: pathlib.Path) -> _Content:
    """Reads the elements ``vertex`` and ``edge`` of a PLY file."""
    data = path.read_bytes()
    text = b""
    if not data.startswith(b"ply"):  # an editor may have written a byte order mark, or UTF-16
        try:
            text = decode_text(data).encode()
        except TextError:
            text = b""
        if not text.startswith(b"ply"):
            raise PlantFileError(f"{path}: is no PLY file; its first line is 'ply'")
        data = text
    end = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    mark = end[1] if end else b"\n"
    found = re.search(rb"[\r\n]end_header[ \t]*" + mark, data)
    if not end or not found:
        raise PlantFileError(
            f"{path}: has no line 'end_header', which ends the head of a PLY file; the file was cut off"
        )
    form, elements = _head(path, data[: found.start()].decode("ascii", "replace"))
    body = data[found.end() :]
    if form == "ascii":
        return _read_ascii(path, body, elements, 1 + data.count(mark, 0, found.end()))
    return _Content(_read_binary(path, body, elements, _ORDERS[form]), is_cut=False)


def _head(path: pathlib.Path, head: str) -> tuple[str, list[_Element]]:
    """Returns the format and the elements in the head of a PLY file."""
    form = ""
    elements: list[_Element] = []
    for number, line in enumerate(re.split("\r\n|\r|\n", head), 1):
        words = line.split()
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in _ORDERS:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and re.fullmatch("[0-9]{1,9}", words[2]):
            elements.append(_Element(words[1].lower(), int(words[2])))
        elif words[0] == "property" and elements and len(words) == 3 and words[1] in _TYPES:
            elements[-1].properties.append(_Property(_name(words[2]), _TYPES[words[1]]))
        elif words[0] == "property" and elements and len(words) == 5 and {words[2], words[3]} <= _TYPES.keys():
            elements[-1].properties.append(_Property(_name(words[4]), _TYPES[words[3]], _TYPES[words[2]]))
        else:
            raise PlantFileError(
                f"{path}: line {number}: is {line[:60]!r}; give a format, an element or a property of PLY"
            )
    if not form:
        raise PlantFileError(f"{path}: its head has no format; give 'format ascii 1.0', or a binary one")
    for element in elements:
        names = [each.name for each in element.properties]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise PlantFileError(f"{path}: element {element.name!r} has two properties {twice!r}; remove one")
    return form, elements


def _name(text: str) -> str:
    """Returns the name of a property in lower case, without the mark of CloudCompare's scalar fields."""
    return text.lower().removeprefix("scalar_")


def _read_ascii(path: pathlib.Path, body: bytes, elements: list[_Element], line: int) -> _Content:
    """``line``: number of the first line of the body."""
    try:
        text = decode_text(body)
    except TextError as bad:
        raise PlantFileError(f"{path}: its rows: {bad}") from None
    lines = [(number, row.split()) for number, row in enumerate(text.split("\n"), line) if row.strip()]
    is_plain = re.fullmatch(r"[0-9eE.+\-\s]*", text) is not None
    numbers = NumberReader()
    tables: dict[str, dict[str, np.ndarray]] = {}
    at = 0
    for element in elements:
        rows = lines[at : at + element.count]
        at += element.count
        if len(rows) < element.count:
            raise _short(path, element)
        if element.name not in _NEEDED:
            continue
        columns: dict[str, list[float]] = {each.name: [] for each in element.properties if not each.count}
        if is_plain and len(columns) == len(element.properties):
            with contextlib.suppress(ValueError):  # the loop below finds the place of the error
                table = np.array([cells for _, cells in rows], float).reshape(element.count, len(columns))
                tables[element.name] = dict(zip(columns, table.T, strict=True))
                continue
        for number, cells in rows:
            try:
                _read_row(element, [numbers.read(cell) for cell in cells], columns)
            except TextError as bad:
                raise PlantFileError(f"{path}: line {number}: {bad}") from None
        tables[element.name] = {name: np.array(values, float) for name, values in columns.items()}
    if at < len(lines):
        raise PlantFileError(
            f"{path}: line {lines[at][0]}: follows the last row that the head counts; correct the counts"
        )
    return _Content(tables, is_cut(text))


def _read_row(element: _Element, values: list[float], columns: dict[str, list[float]]) -> None:
    """Append the numbers of one row to the columns, lists left out. Raises :class:`TextError` if their number is
    wrong."""
    at = 0
    for each in element.properties:
        if each.count:
            at += 1 + max(0, int(values[at])) if at < len(values) else 1
        else:
            if at < len(values):
                columns[each.name].append(values[at])
            at += 1
    if at != len(values):
        raise TextError(f"a row of element {element.name!r} has {len(values)} numbers, not {at}; mend it")


def _read_binary(
    path: pathlib.Path, body: bytes, elements: list[_Element], order: str
) -> dict[str, dict[str, np.ndarray]]:
    tables: dict[str, dict[str, np.ndarray]] = {}
    at = 0
    needed = {element.name for element in elements} & set(_NEEDED)
    for element in elements:
        if needed <= tables.keys():
            break
        if not element.properties:
            continue
        single = [each for each in element.properties if not each.count]
        if len(single) == len(element.properties):
            kind = np.dtype([(each.name, order + each.kind) for each in single])
            if at + element.count * kind.itemsize > len(body):
                raise _short(path, element)
            table = np.frombuffer(body, kind, element.count, at)
            with np.errstate(invalid="ignore"):  # some bits are signalling NaNs
                tables[element.name] = {each.name: table[each.name].astype(float) for each in single}
            at += element.count * kind.itemsize
            continue
        columns: dict[str, list[float]] = {each.name: [] for each in single}
        try:
            for _ in range(element.count):
                for each in element.properties:
                    kind = np.dtype(order + (each.count or each.kind))
                    value = np.frombuffer(body, kind, 1, at)[0]
                    at += kind.itemsize
                    if each.count:
                        if value < 0:
                            raise ValueError
                        at += int(value) * np.dtype(each.kind).itemsize
                    else:
                        columns[each.name].append(float(value))
                if at > len(body):
                    raise ValueError
        except ValueError:  # the body ends before the row
            raise _short(path, element) from None
        tables[element.name] = {name: np.array(values, float) for name, values in columns.items()}
    return tables


def _short(path: pathlib.Path, element: _Element) -> PlantFileError:
    return PlantFileError(
        f"{path}: element {element.name!r} has fewer than {element.count} rows of numbers; the file was cut off"
    )
