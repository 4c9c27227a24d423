"""``vinesim examples``: everything that ships for users, never over a file of theirs."""

from __future__ import annotations

import pathlib

import pytest

from tests.docs.test_release import SHIPPED, tracked
from tests.support.page_blocks import ROOT
from vinesim.cli.examples import copy
from vinesim.core.errors import UsageError, WriteError


def test_it_copies_what_the_checkout_has(tmp_path, capsys):
    assert copy(tmp_path / "new", force=False) == 0
    written = {str(path.relative_to(tmp_path / "new")) for path in (tmp_path / "new").rglob("*") if path.is_file()}
    expected = {name for folder in SHIPPED for name in tracked(folder)}
    assert expected <= written
    for name in expected:
        assert (tmp_path / "new" / name).read_bytes() == (ROOT / name).read_bytes(), name
    said = capsys.readouterr().out
    assert said.splitlines()[-1] == f"begin with: python {tmp_path / 'new/examples/first_cane.py'}"
    assert "no change" not in said


def test_a_second_time_it_changes_nothing_and_a_lost_file_comes_back(tmp_path, capsys):
    copy(tmp_path, force=False)
    (tmp_path / "examples/cane.toml").unlink()
    capsys.readouterr()
    copy(tmp_path, force=False)
    said = capsys.readouterr().out
    assert said.count("no change") == 3
    assert "1 file in" in said
    assert (tmp_path / "examples/cane.toml").is_file()


def test_a_changed_file_is_kept_unless_force_is_given(tmp_path):
    mine = tmp_path / "examples/cane.toml"
    mine.parent.mkdir()
    mine.write_text("mine")
    with pytest.raises(UsageError, match=r"cane\.toml differs from the file of vinesim; --force replaces"):
        copy(tmp_path, force=False)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [mine], "nothing was written"
    assert mine.read_text() == "mine"
    copy(tmp_path, force=True)
    assert mine.read_bytes() == (ROOT / "examples/cane.toml").read_bytes()


def test_a_file_instead_of_a_folder_and_a_place_that_cannot_be_written_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="is a file; name a folder"):
        copy(tmp_path / "file", force=False)
    with pytest.raises(WriteError, match="cannot be written"):
        copy(pathlib.Path("/proc/examples-of-vinesim"), force=False)
