"""docs/features.md names existing tests and benches, and every claim once."""

import ast
import functools
import pathlib
import re

from benchmarks.__main__ import BENCHMARKS
from vinesim.cli.bench import BENCHES

ROOT = pathlib.Path(__file__).parents[2]
CLAIMS = [f"F{i:02}" for i in range(1, 99)]


def rows():
    """Claim -> (section, claim, evidence)."""
    lines = (ROOT / "docs/features.md").read_text().splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| F")]
    assert [len(row) for row in cells] == [4] * len(cells)
    assert [row[0] for row in cells] == CLAIMS
    return {row[0]: row[1:] for row in cells}


@functools.cache
def names_in(path):
    """Tests of a file that ``make test`` runs: those that are not marked ``long``, alone or with their file."""
    tree = ast.parse((ROOT / path).read_text())
    marks = [node.value for node in tree.body if isinstance(node, ast.Assign) and "pytestmark" in ast.unparse(node)]
    if any(is_long(mark) for mark in marks):
        return set()
    tests = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
    return {test.name for test in tests if not any(is_long(mark) for mark in test.decorator_list)}


def is_long(mark):
    return any(isinstance(node, ast.Attribute) and node.attr == "long" for node in ast.walk(mark))


def faults(section, text, evidence):
    """What is wrong with a row of the table."""
    if not re.fullmatch(r"[2-5](\.\d){0,2}", section):
        yield f"'{section}' is no section"
    if not text:
        yield "no claim"
    spans = re.findall(r"`((?:tests/|vinesim bench |python -m benchmarks )[^`]*)`", evidence)
    for span in spans:
        path, _, name = span.partition("::")
        if span.startswith("vinesim"):
            if span.removeprefix("vinesim bench ") not in BENCHES:
                yield f"there is no `{span}`"
        elif span.startswith("python"):
            if span.removeprefix("python -m benchmarks ") not in BENCHMARKS:
                yield f"there is no `{span}`"
        elif name not in names_in(path):
            yield f"make test runs no {span}"
    if evidence.startswith("partly: "):
        words = re.findall(r"[a-z]{2,}", re.sub(r"`tests/[^`]*`", "", evidence.removeprefix("partly: ")))
        if len(words) < 2:
            yield f"say what is missing: {evidence}"
    if evidence.startswith(("`tests/", "partly: ", "measured: ")):
        if not spans:
            yield "names neither test nor bench"
    elif not evidence.startswith(("not yet", "cannot be tested")):
        yield f"begins with none of the known words: {evidence}"


def test_the_evidence_of_every_claim_exists_and_make_test_runs_it():
    found = [f"{claim}: {fault}" for claim, row in rows().items() for fault in faults(*row)]
    assert not found, "\n".join(found)


def test_a_claim_without_evidence_is_found():
    assert list(faults("2.1", "It bends", "`tests/structure/test_features.py::test_none`")) == [
        "make test runs no tests/structure/test_features.py::test_none"
    ]
    assert list(faults("x", "It bends", "perhaps")) == [
        "'x' is no section",
        "begins with none of the known words: perhaps",
    ]
    for marked in ("pytest.mark.long", "[pytest.mark.ros, pytest.mark.long]", "pytest.mark.long()"):
        assert is_long(ast.parse(marked))
    assert not is_long(ast.parse("pytest.mark.slow"))
