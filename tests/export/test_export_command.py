"""``vinesim export``: what it prints, and its one-line errors."""

from __future__ import annotations

import subprocess
import sys

import pytest

import vinesim
from vinesim.export import usd


def run(*arguments: str, cwd=None) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-m", "vinesim", *arguments], capture_output=True, text=True, cwd=cwd)


def test_a_scene_is_written(tmp_path):
    done = run("export", "demo", "--seed", "3", "--out", "demo.xml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "bodies of plants" in done.stdout
    assert (tmp_path / "demo.xml").read_text().startswith("<?xml")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("export", "demo", "--out", "demo.sdf"), ("demo.sdf", ".xml, .urdf, .usda")),
        (("export", "demo", "--out", "nowhere/demo.xml"), ("nowhere/demo.xml", "make it first")),
        (("export", "nosuch", "--out", "demo.xml"), ("nosuch", "demo, harvest")),
    ],
)
def test_bad_input_is_one_line_with_a_remedy(arguments, words, tmp_path):
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    for word in words:
        assert word in done.stderr


def test_a_missing_package_is_named_with_its_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    with pytest.raises(usd.UsdMissing, match=r"vinesim\[export\]"):
        vinesim.export_vineyard(vinesim.CaneBuilder(), tmp_path / "cane.usda")
