"""Data files: a path wins over a name, and an unknown name lists the known ones."""

import pytest

from vinesim.core.data_files import DataFileNotFound, data_dir, find_data_file


def test_a_name_finds_a_shipped_file():
    assert (
        find_data_file("scenes", "demo", ".toml")
        == find_data_file("scenes", "demo.toml", ".toml")
        == data_dir() / "scenes" / "demo.toml"
    )


def test_a_path_wins_over_a_name(tmp_path, monkeypatch):
    (tmp_path / "demo").write_text("mine")
    monkeypatch.chdir(tmp_path)
    assert find_data_file("scenes", "demo", ".toml").read_text() == "mine"


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(
        DataFileNotFound, match=r"no file 'moon'.*data/scenes.*cordon, demo, harvest, slope, tendone, vsp"
    ):
        find_data_file("scenes", "moon", ".toml")


def test_an_unknown_kind_has_no_files():
    with pytest.raises(DataFileNotFound, match="one of: none"):
        find_data_file("ships", "moon", ".toml")
