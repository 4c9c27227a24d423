"""docs/features.md names existing tests and benches, and every claim once."""

import ast
import functools
import pathlib
import re

import pytest

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
    tree = ast.parse((ROOT / path).read_text())
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}


@pytest.mark.parametrize("claim", CLAIMS)
def test_the_evidence_of_a_claim_exists(claim):
    section, text, evidence = rows()[claim]
    assert re.fullmatch(r"[2-5](\.\d){0,2}", section)
    assert text
    spans = re.findall(r"`((?:tests/|vinesim bench )[^`]*)`", evidence)
    for span in spans:
        path, _, name = span.partition("::")
        if span.startswith("vinesim"):
            assert span.removeprefix("vinesim bench ") in BENCHES, span
        else:
            assert name in names_in(path), span
    if evidence.startswith("partly: "):
        words = re.findall(r"[a-z]{2,}", re.sub(r"`tests/[^`]*`", "", evidence.removeprefix("partly: ")))
        assert len(words) > 1, f"say what is missing: {evidence}"
    if evidence.startswith(("`tests/", "partly: ", "measured: ")):
        assert spans
    else:
        assert evidence.startswith(("not yet", "cannot be tested")), evidence
