"""Where data lies: a path wins over a name, and an unknown name tells what there is."""

import pytest

from vinesim.scene.data_files import NotFoundInData, data_dir, find


def test_a_name_finds_what_ships():
    assert (
        find("scenes", "demo", ".toml") == find("scenes", "demo.toml", ".toml") == data_dir() / "scenes" / "demo.toml"
    )


def test_a_path_wins_over_a_name(tmp_path, monkeypatch):
    (tmp_path / "demo").write_text("mine")
    monkeypatch.chdir(tmp_path)
    assert find("scenes", "demo", ".toml").read_text() == "mine"


def test_an_unknown_name_lists_the_known():
    with pytest.raises(NotFoundInData, match=r"no file 'moon'.*data/scenes.*demo, harvest, tendone, vsp"):
        find("scenes", "moon", ".toml")


def test_an_unknown_kind_has_none():
    with pytest.raises(NotFoundInData, match="one of: none"):
        find("ships", "moon", ".toml")
