"""Files as other programs and people write them: each seeded variant is read with equal values, or refused in a line.

A variant is a file of known content in another encoding, with other line ends, separators, decimals, orders of columns
or properties, and in a third of the cases cut off at a random byte. Of a cut text file the reader may return the rows
before the cut, and a wrong last number only with the warning about it.
"""

from __future__ import annotations

import dataclasses
import pathlib
import random
import struct
from collections.abc import Callable

import numpy as np
import pytest

from tests.test_bag_files import messages, write_mcap, write_metadata, write_sqlite
from vinesim.cli.render import _read_path
from vinesim.core.bag_files import BagError, open_bag
from vinesim.core.errors import UsageError
from vinesim.core.text_files import CUT
from vinesim.scene.plant_import.mtg import read_mtg
from vinesim.scene.plant_import.ply import read_ply, read_points
from vinesim.scene.plant_import.skeleton import PlantFileError, Skeleton
from vinesim.tune.trajectory import TrajectoryError, read_trajectory

ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "latin-1")
ENDS = ("\n", "\r\n", "\r")


@dataclasses.dataclass
class Variant:
    """Choices of one file."""

    rng: random.Random
    is_cut: bool = False

    def encode(self, lines: list[str]) -> bytes:
        """Returns lines as a file."""
        end = self.rng.choice(ENDS)
        text = end.join(lines) + end * self.rng.choice((1, 1, 1, 0, 2))
        encoding = self.rng.choice(ENCODINGS)
        mark = "\ufeff" if encoding in ("utf-16-le", "utf-16-be") and self.rng.random() < 0.5 else ""
        return self.cut((mark + text).encode(encoding, "replace"))

    def cut(self, data: bytes) -> bytes:
        """Returns the file, in a third of the cases cut off."""
        self.is_cut = self.rng.random() < 1.0 / 3.0
        return data[: self.rng.randrange(len(data))] if self.is_cut else data

    def number(self, value: float, comma: bool = False) -> str:
        """Returns a number as a program may write it."""
        text = self.rng.choice((f"{value:.6f}", f"{value!r}", f"{value:.9e}", f"{value:+.7f}"))
        return text.replace(".", ",") if comma else text


def assert_refused_well(variant: Variant, path: pathlib.Path, bad: Exception) -> None:
    """Only a file that was cut off, in one line with the file, the reason and, behind a semicolon, the remedy."""
    text = str(bad)
    assert variant.is_cut, text
    assert "\n" not in text
    assert path.name in text
    assert ";" in text
    assert len(text) < 500


# ------------------------------------------------------------------------------------------------ plants


def plant(rng: random.Random) -> tuple[list[tuple[float, float, float]], list[int], list[float]]:
    """Returns unlike points, their parents and their diameters (0: not measured) of a plant; numbers that float32
    holds."""
    points = [(0.0, 0.0, 0.0)]
    parents = [-1]
    for number in range(1, rng.randrange(3, 14)):
        parents.append(rng.randrange(number))
        x, _, z = points[parents[-1]]
        points.append((x + rng.randrange(-8, 9) / 64, number / 64, z + rng.randrange(1, 9) / 64))
    return points, parents, [rng.choice((0.0, 1 / 32, 1 / 16, 3 / 32)) for _ in points]


def rows_of(skeleton: Skeleton) -> dict[tuple[float, ...], tuple[tuple[float, ...] | None, float]]:
    """Returns, by its position, the position of the parent and the diameter (0: unknown) of each point."""
    place = [tuple(one) for one in skeleton.position.round(9).tolist()]
    return {
        place[i]: (place[p] if p >= 0 else None, float(np.nan_to_num(d)))
        for i, (p, d) in enumerate(zip(skeleton.parent.tolist(), skeleton.diameter.tolist(), strict=True))
    }


def assert_same_plant(
    variant: Variant, skeleton: Skeleton, points: list, parents: list[int], sizes: list[float], earlier: list[float]
) -> None:
    """``earlier``: diameters at an earlier date, which count if the file was cut off before the later ones."""
    wanted = {
        points[i]: (points[p] if p >= 0 else None, size) for i, (p, size) in enumerate(zip(parents, sizes, strict=True))
    }
    found = rows_of(skeleton)
    before = {point: (wanted[point][0], size) for point, size in zip(points, earlier, strict=True)}
    wrong = [
        place
        for place, row in found.items()
        if row != wanted.get(place) and not (variant.is_cut and row == before.get(place))
    ]
    if not variant.is_cut:
        assert not wrong
        assert len(found) == len(wanted)
    assert len(wrong) <= (CUT in skeleton.notes)


def write_mtg(variant: Variant) -> tuple[bytes, tuple]:
    rng = variant.rng
    points, parents, sizes = plant(rng)
    earlier = [rng.choice((size, 1 / 32)) if size else 0.0 for size in sizes]
    comma = rng.random() < 0.3
    names = ["XX", "YY", "ZZ", rng.choice(("diameter", "diam", "TopDia", "topdia")), "Date", "Remark"]
    order = rng.sample(range(6), 6)
    children: dict[int, list[int]] = {}
    for node, parent in enumerate(parents):
        children.setdefault(parent, []).append(node)
    lines = [
        "# Rebe am Weg, gemessen von Zo\u00eb",
        "CODE:\tFORM-A",
        "",
        "CLASSES:",
        "SYMBOL\tSCALE",
        "FEATURES:",
        "NAME\tTYPE",
    ]
    lines += [f"{names[i]}\t{'DD/MM/YY' if i == 4 else 'REAL'}" for i in rng.sample(range(6), 6)]
    depth = 1 + len(points)
    lines += ["MTG:", "ENTITY-CODE" + "\t" * depth + "\t".join(names[i] for i in order)]

    def cells(node: int, size: float, day: int) -> str:
        x, y, z = points[node]
        unknown = rng.choice(("0", "", "NA")) if size == 0.0 else variant.number(size, comma)
        values = [
            *(variant.number(v, comma) for v in (x, y, z)),
            unknown,
            f"0{day}/05/24",
            rng.choice(("", "d\u00fcrr")),
        ]
        return "\t".join(values[i] for i in order)

    def write(node: int, column: int, code: str) -> None:
        before = "\t" * column + code + "\t" * (depth - column)
        lines.append(before + cells(node, earlier[node], 1))
        if earlier[node] != sizes[node] or rng.random() < 0.2:
            lines.append("\t" * column + "*" + "\t" * (depth - column) + cells(node, sizes[node], 2))
        heirs = children.get(node, [])
        for child in heirs[1:]:  # branches first, further right
            write(child, column + 1, f"+B{child}")
        if heirs:
            write(heirs[0], column, f"^<E{heirs[0]}")

    write(0, 0, "/P1/E0")
    return variant.encode(lines), (points, parents, sizes, earlier)


def write_ply(variant: Variant) -> tuple[bytes, tuple]:
    rng = variant.rng
    points, parents, sizes = plant(rng)
    form = rng.choice(("ascii", "binary_little_endian", "binary_big_endian"))
    has_edges = rng.random() < 0.5
    kinds = {"float": "f", "double": "d", "int": "i", "uchar": "B", "short": "h"}
    real = rng.choice(("float", "double"))
    is_radius = rng.random() < 0.5
    columns = [(real, axis, [p[i] for p in points]) for i, axis in enumerate("xyz")]
    columns.append((real, "radius" if is_radius else "diameter", [0.5 * s if is_radius else s for s in sizes]))
    columns.append(("uchar", "red", [rng.randrange(256) for _ in points]))
    columns.append(("list uchar short", "near", [[rng.randrange(9)] * rng.randrange(4) for _ in points]))
    if not has_edges:
        columns.append((rng.choice(("int", "short")), "parent", parents))
    elements = [("vertex", rng.sample(columns, len(columns)), len(points))]
    pairs = [tuple(rng.sample((node, parent), 2)) for node, parent in enumerate(parents) if parent >= 0]
    if has_edges:  # the base is the lowest vertex
        elements.append(("edge", [("int", f"vertex{i + 1}", [pair[i] for pair in pairs]) for i in (0, 1)], len(pairs)))
    elements.append(("face", [("list uchar int", "vertex_indices", [[0] * rng.randrange(3, 6) for _ in range(3)])], 3))
    rng.shuffle(elements)
    head = ["ply", f"format {form} 1.0", "comment made by Zoe"]
    body: list[str] = []
    packed = b""
    order = ">" if "big" in form else "<"
    for name, its, count in elements:
        head += [f"element {name} {count}", *(f"property {kind} {label}" for kind, label, _ in its)]
        for row in range(count):
            cells = []
            for kind, _, values in its:
                value = values[row]
                if isinstance(value, list):
                    _, length, item = kind.split()
                    packed += struct.pack(order + kinds[length] + kinds[item] * len(value), len(value), *value)
                    cells += [str(len(value)), *map(str, value)]
                else:
                    packed += struct.pack(order + kinds[kind], value)
                    cells.append(variant.number(value) if kind == real else str(value))
            body.append(" ".join(cells))
    head.append("end_header")
    if form == "ascii":
        return variant.encode(head + body), (points, parents, sizes, sizes)
    end = rng.choice(ENDS)
    return variant.cut((end.join(head) + end).encode() + packed), (points, parents, sizes, sizes)


@pytest.fixture
def file(tmp_path: pathlib.Path) -> pathlib.Path:
    return tmp_path / "file"


def check_mtg(seed: int, file: pathlib.Path) -> None:
    variant = Variant(random.Random(seed))
    data, content = write_mtg(variant)
    file.write_bytes(data)
    try:
        skeleton = read_mtg(file, 1.0, 1.0)
    except PlantFileError as bad:
        assert_refused_well(variant, file, bad)
    else:
        assert_same_plant(variant, skeleton, *content)


def check_ply(seed: int, file: pathlib.Path) -> None:
    file = file.with_suffix(".ply")
    variant = Variant(random.Random(seed))
    data, content = write_ply(variant)
    file.write_bytes(data)
    try:
        skeleton = read_ply(file, 1.0, 1.0)
    except PlantFileError as bad:
        assert_refused_well(variant, file, bad)
    else:
        assert_same_plant(variant, skeleton, *content)
        if not variant.is_cut:
            np.testing.assert_allclose(read_points(file), content[0])


# ------------------------------------------------------------------------------------------------ tables


def write_table(variant: Variant, names: list[str], table: np.ndarray) -> bytes:
    """Write columns in any order, with a separator and decimals of a country."""
    rng = variant.rng
    separator = rng.choice(",,;\t")
    comma = separator != "," and rng.random() < 0.5
    order = rng.sample(range(len(names)), len(names))
    more = separator * rng.choice((0, 0, 1))  # spreadsheets write empty columns
    quote = rng.choice(("", "", '"'))
    lines = ["sep=" + separator] * (rng.random() < 0.2)
    lines.append(separator.join(quote + names[i] + quote for i in order) + more)
    for row in table.tolist():
        cells = ["" if np.isnan(row[i]) else quote + variant.number(row[i], comma) + quote for i in order]
        lines.append(separator.join(cells) + more)
        if rng.random() < 0.1:
            lines.append("# Bemerkung: tr\u00fcb")
    return variant.encode(lines)


def assert_same_table(variant: Variant, found: np.ndarray, wanted: np.ndarray, said: str) -> None:
    if not variant.is_cut:
        assert found.shape == wanted.shape
    same = np.isclose(found, wanted[: len(found)], rtol=1e-6, atol=1e-6, equal_nan=True)
    assert same[:-1].all()
    assert same.all() or (variant.is_cut and CUT in said and (~same[-1]).sum() <= 1)


def check_track(seed: int, file: pathlib.Path, caplog: pytest.LogCaptureFixture) -> None:
    rng = random.Random(seed)
    variant = Variant(rng)
    count = rng.randrange(8, 30)
    table = np.array([[0.01 * i, *(round(rng.uniform(-2.0, 2.0), 5) for _ in range(3)), 3.5 + i] for i in range(count)])
    table[rng.randrange(count), rng.randrange(1, 4)] = np.nan
    names = ["time [s]", "x [m]", "mitte z [m]", "y (m)", "force [N]"]
    file.write_bytes(write_table(variant, names, table))
    caplog.clear()
    try:
        track = read_trajectory(file)
    except TrajectoryError as bad:
        assert_refused_well(variant, file, bad)
        return
    tip, middle = (track.position[:, track.markers.index(name)] for name in ("tip", "mitte"))
    assert track.force is not None
    found = np.stack([track.time, tip[:, 0], middle[:, 2], tip[:, 1], track.force], -1)
    assert_same_table(variant, found, table, caplog.text)


def check_tour(seed: int, file: pathlib.Path, caplog: pytest.LogCaptureFixture) -> None:
    rng = random.Random(seed)
    variant = Variant(rng)
    table = np.array(
        [[round(rng.uniform(0.5, 2.0) + 3 * (i > 2), 4) for i in range(6)] for _ in range(rng.randrange(1, 9))]
    )
    names = [rng.choice((name, name.upper())) for name in ("x", "y", "z", "look_x", "look_y", "look_z")]
    file.write_bytes(write_table(variant, names, table))
    caplog.clear()
    try:
        found = np.array([[*one.eye, *one.target] for one in _read_path(file)])
    except UsageError as bad:
        assert_refused_well(variant, file, bad)
    else:
        assert_same_table(variant, found, table, caplog.text)


# ------------------------------------------------------------------------------------------------ recordings


def check_bag(seed: int, file: pathlib.Path) -> None:
    rng = random.Random(seed)
    variant = Variant(rng)
    folder = file.with_name(f"bag{seed}")
    folder.mkdir()
    count = rng.randrange(1, 4)
    rows = [messages(20, 20 * i) for i in range(count)]
    is_mcap = rng.random() < 0.7
    names = [f"run_{i}.{'mcap' if is_mcap else 'db3'}" for i in range(count)]
    for name, its in zip(names, rows, strict=True):
        if is_mcap:
            write_mcap(folder / name, its, rng.choice((0, 300, 5000)))
        else:
            write_sqlite(folder / name, its)
    if rng.random() < 0.7:
        write_metadata(folder, names)
    last = folder / names[-1]
    last.write_bytes(variant.cut(last.read_bytes()))
    wanted = [row for its in rows for row in its]
    try:
        bag = open_bag(folder)
        found = list(bag.messages())
    except BagError as bad:
        assert_refused_well(variant, last, bad)
        return
    assert found == wanted[: len(found)]
    assert len(found) >= len(wanted) - 20
    if variant.is_cut:
        assert f"is cut off after message {len(found) - len(wanted) + 20}" in bag.damage
        assert "\n" not in bag.damage
    else:
        assert (found, bag.damage) == (wanted, "")


CHECKS: tuple[Callable[..., None], ...] = (check_mtg, check_ply, check_track, check_tour, check_bag)


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.parametrize("check", CHECKS)
def test_a_variant_is_read_rightly_or_refused_in_one_line(check, seed, file, caplog):
    check(seed, file, *([caplog] if "caplog" in check.__annotations__ else []))


@pytest.mark.long
@pytest.mark.parametrize("check", CHECKS)
def test_more_variants_are_read_rightly_or_refused_in_one_line(check, file, caplog):
    for seed in range(40, 1000):
        check(seed, file, *([caplog] if "caplog" in check.__annotations__ else []))
