"""Reads text files and tables as programs and spreadsheets write them: any encoding, line end, separator, decimal."""

from __future__ import annotations

import codecs
import csv
import pathlib
import re
from typing import NamedTuple

_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
"""Byte order marks and their encodings. A mark that begins with another one is before it."""
_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?")
CUT = "the last line has no line end; if the file was cut off there, the last number of that line may be wrong"
"""Warning about a text whose last line does not end with a line end."""


class TextError(ValueError):
    """A file that is no text, or a table that contradicts itself. The message has the reason and the remedy."""

    def __init__(self, reason: str, line: int | None = None) -> None:
        """``line``: number of the line in the file, from 1; None: the whole file."""
        super().__init__(reason)
        self.line = line

    def at(self, path: pathlib.Path) -> str:
        """Returns the message with the file and the line."""
        return f"{path}: {self}" if self.line is None else f"{path}:{self.line}: {self}"


def read_text(path: pathlib.Path) -> str:
    r"""Returns the content of a text file, with ``\n`` as line end.

    The encoding is that of the byte order mark; without a mark, UTF-16 if every other byte is 0, else UTF-8, else
    Windows-1252, which contains Latin-1. Raises :class:`OSError`, and :class:`TextError` for a file that is no text.
    """
    return decode_text(path.read_bytes())


def decode_text(data: bytes) -> str:
    """Returns the text in the content of a file; see :func:`read_text`."""
    mark, encoding = next((row for row in _MARKS if data.startswith(row[0])), (b"", "utf-8"))
    if not mark and b"\0" in data[:64]:
        encoding = "utf-16-be" if data[:1] == b"\0" else "utf-16-le"
    try:
        text = data[len(mark) :].decode(encoding)
    except UnicodeDecodeError:
        if mark or encoding != "utf-8":
            raise TextError(f"is cut off or damaged, by its first bytes it is {encoding}; save it as UTF-8") from None
        text = data.decode("cp1252", "replace")
    if "\0" in text:
        raise TextError("has zero bytes, so it is no text; save it as text in UTF-8")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def is_cut(text: str) -> bool:
    """Whether the last line has no line end, as in a file that was cut off."""
    return bool(text) and not text.endswith("\n")


class NumberReader:
    """Reads the numbers of one file, which has either decimal points or decimal commas."""

    def __init__(self) -> None:
        self._mark = ""

    def read(self, text: str) -> float:
        """Returns the number in a text. Raises :class:`TextError`, whose message begins with the text, if it is none,
        or if its decimal mark differs from that of earlier numbers."""
        plain = text.strip().replace("\N{MINUS SIGN}", "-")
        if not _NUMBER.fullmatch(plain):
            raise TextError(f"{plain[:40]!r}; give a number")
        mark = next((mark for mark in ".," if mark in plain), "")
        if mark and self._mark and mark != self._mark:
            raise TextError(f"{plain!r}, and other numbers have a decimal {self._mark!r}; give all decimals as points")
        self._mark = self._mark or mark
        return float(plain.replace(",", "."))


class Row(NamedTuple):
    """One line of a table."""

    line: int
    """Number of the line in the file, from 1."""
    cells: list[str]
    """Content of the cells, without blanks around it."""


class Table(NamedTuple):
    """A table in a text file, with a head."""

    head: Row
    rows: list[Row]
    is_cut: bool
    """Whether the last line has no line end; :data:`CUT`."""


def read_table(path: pathlib.Path) -> Table | None:
    """Returns the table in a CSV file with commas, semicolons or tabs between its columns; None if the file is empty.

    The separator is that of the head. Lines that begin with ``#``, empty lines, and empty columns behind the last one
    are left out. Raises :class:`OSError`, and :class:`TextError` if a quotation mark is not closed or a line has
    another number of cells than the head.
    """
    text = read_text(path)
    lines = [(number, line) for number, line in enumerate(text.split("\n"), 1) if line.strip() and line[0] != "#"]
    separator = ""
    if lines and (said := re.fullmatch(r"sep=(.)", lines[0][1].strip("\"' "))):  # spreadsheets begin with this line
        separator = said[1]
        lines = lines[1:]
    if not lines:
        return None
    separator = separator or next((mark for mark in "\t;" if mark in lines[0][1]), ",")
    rows = []
    for number, line in lines:
        try:
            cells = next(csv.reader([line], delimiter=separator, strict=True))
        except csv.Error:
            raise TextError("has a quotation mark that is not closed; close it", number) from None
        rows.append(Row(number, [cell.strip() for cell in cells]))
    head = rows[0]
    width = len(head.cells)
    while width and not head.cells[width - 1]:
        width -= 1
    table = []
    for line, cells in rows[1:]:
        if not any(cells):
            continue
        if len(cells) < width or any(cells[width:]):
            remedy = "complete the line"
            if separator == "," and len(cells) > width:
                remedy = "where decimals have commas, separate the columns by semicolons"
            raise TextError(f"{len(cells)} cells, the header has {width}; {remedy}", line)
        table.append(Row(line, cells[:width]))
    return Table(Row(head.line, head.cells[:width]), table, is_cut(text))
