"""Reads skeletons in PLY files: vertices with a radius, joined by edges or by the number of their parent.

The files are ASCII or little-endian PLY (Turk 1994). The element ``vertex`` has x, y, z and optionally radius or
diameter, parent and bunch. Unless vertices name their parents, there is an element ``edge`` (vertex1, vertex2). The
base is the lowest vertex, or the vertex whose parent is negative.
"""

from __future__ import annotations

import pathlib

import numpy as np

from vinesim.scene.plant_import.skeleton import PlantFileError, Skeleton, sort_nodes

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "<i2",
    "int16": "<i2",
    "ushort": "<u2",
    "uint16": "<u2",
    "int": "<i4",
    "int32": "<i4",
    "uint": "<u4",
    "uint32": "<u4",
    "float": "<f4",
    "float32": "<f4",
    "double": "<f8",
    "float64": "<f8",
}


def read_ply(path: pathlib.Path, unit: float, diameter_unit: float) -> Skeleton:
    """Returns the skeleton in a PLY file; ``unit`` and ``diameter_unit`` [m] as for
    :func:`~vinesim.scene.plant_import.mtg.read_mtg`."""
    elements = _read(path)
    vertex, position = _vertices(path, elements)
    names = set(vertex.dtype.names or ())
    if "parent" in names:
        parent = vertex["parent"].astype(int)
    elif "edge" in elements and {"vertex1", "vertex2"} <= set(elements["edge"].dtype.names or ()):
        pairs = np.stack([elements["edge"][name].astype(int) for name in ("vertex1", "vertex2")], -1)
        parent = _parents(path, position, pairs)
    else:
        raise PlantFileError(
            f"{path}: tells no topology; give vertices a property 'parent', or an element 'edge' with vertex1, vertex2 "
            "(a point cloud or a mesh must be made a skeleton first)"
        )
    diameter = np.full(len(position), np.nan)
    for name, scale in (("radius", 2.0), ("diameter", 1.0)):
        if name in names:
            diameter = scale * diameter_unit * vertex[name].astype(float)
    bunch = vertex["bunch"].astype(float) if "bunch" in names else np.zeros(len(position))
    return sort_nodes(path, unit * position, parent, diameter, bunch, "PLY skeleton")


def read_points(path: pathlib.Path) -> np.ndarray:
    """Returns the vertices [n, 3] of a PLY file, or the points of a text file with x, y and z in each line.

    Raises :class:`PlantFileError` if the file cannot be read.
    """
    if not path.is_file():
        raise PlantFileError(f"{path}: no such file; give points as PLY, or as text with x, y and z in a line")
    if path.suffix.lower() == ".ply":
        return _vertices(path, _read(path))[1]
    rows = []
    for number, line in enumerate(path.read_text("utf-8", "replace").splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#") or (not rows and words[0].strip('"').lower() == "x"):
            continue
        try:
            rows.append([float(word) for word in words[:3]])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != 3:
            raise PlantFileError(f"{path}:{number}: is {line.strip()[:40]!r}; give x, y and z as numbers")
    return np.array(rows).reshape(-1, 3)


def _vertices(path: pathlib.Path, elements: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the table of vertices, and their positions [vertex, 3] in the file's unit."""
    vertex = elements.get("vertex")
    if vertex is None or not {"x", "y", "z"} <= set(vertex.dtype.names or ()):
        raise PlantFileError(f"{path}: has no element 'vertex' with x, y and z; give them")
    return vertex, np.stack([vertex[axis].astype(float) for axis in "xyz"], -1)


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


def _read(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Returns the elements of a PLY file as tables, up to the first element with lists."""
    data = path.read_bytes()
    head, found, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not found or not lines or lines[0] != ["ply"]:
        raise PlantFileError(f"{path}: is no PLY file; its first line is 'ply' and its head ends with 'end_header'")
    format = next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), "")
    if format not in ("ascii", "binary_little_endian"):
        raise PlantFileError(f"{path}: format is {format!r}; give ascii or binary_little_endian")
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in lines:
        if line[:1] == ["element"] and len(line) == 3 and line[2].isdecimal():
            elements.append((line[1], int(line[2]), []))
        elif line[:1] == ["property"] and elements and len(line) >= 3:
            elements[-1][2].append((line[-1], _TYPES.get(line[1], "")))
    tables = {}
    words = body.split() if format == "ascii" else []
    at = 0
    row = 0
    for name, count, properties in elements:
        if not properties or any(not kind for _, kind in properties):
            break  # lists have no fixed size, and all needed elements come before them
        kind = np.dtype(properties)
        try:
            if format == "ascii":
                cells = words[row : row + count * len(properties)]
                rows = np.array(cells, float).reshape(count, len(properties))
                tables[name] = np.array([tuple(one) for one in rows], kind)
                row += len(cells)
            else:
                tables[name] = np.frombuffer(body, kind, count, at)
                at += count * kind.itemsize
        except ValueError:
            raise PlantFileError(f"{path}: element {name!r} has fewer than {count} rows of numbers; mend it") from None
    return tables
