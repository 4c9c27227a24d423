"""Numbers that no vine has are reported in one line each, with range and source, and are simulated nevertheless."""

from __future__ import annotations

import logging

import numpy as np
import pytest

import vinesim
from vinesim.core.data_files import find_data_file
from vinesim.scene import plausibility
from vinesim.scene.builder import RodMaterial, TreeBuilder
from vinesim.scene.cane import CaneBuilder
from vinesim.scene.plant_parameters import load_plant

POSE = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])


@pytest.fixture(autouse=True)
def _forget(monkeypatch, caplog):
    monkeypatch.setattr(plausibility, "_told", set())
    caplog.set_level(logging.WARNING, plausibility.log.name)


def lines(caplog) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name == plausibility.log.name]


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"radius": 0.5, "youngs_modulus": 5e7}, "cane: diameter is 1 m; plants have 0.001 to 0.11 m"),
        ({"radius": (0.2, 0.004), "segments": 80}, "cane: diameter at its base is 0.4 m"),
        ({"density": 2500.0}, "cane: density is 2.5e+03 kg/m^3; plants have 300 to 1300 kg/m^3"),
        ({"youngs_modulus": 70e9}, "cane: youngs_modulus is 7e+10 Pa; plants have 5e+07 to 2e+10 Pa"),
        ({"tip_mass": 20.0, "segments": 80}, "cane: tip_mass is 20 kg; plants have 0.001 to 3 kg"),
        ({"length": 0.1}, "cane: frequency of its first mode is 279 Hz; plants have 0.2 to 50 Hz"),
    ],
)
def test_a_cane_that_no_vine_has_is_reported_in_one_line(caplog, fields, words):
    CaneBuilder(**fields).build()
    (line,) = lines(caplog)
    assert line.startswith(words)
    assert ":" in line.partition("(")[2]  # the source


def test_metres_for_millimetres_are_simulated_and_reported_once(caplog):
    for _ in range(2):
        vinesim.Simulation(vinesim.CaneBuilder(length=1, radius=5)).step()
    said = lines(caplog)
    assert [line.split(" is ")[0] for line in said] == ["cane: diameter", "cane: frequency of its first mode"]


def test_a_tree_of_rods_and_a_bunch_are_checked(caplog):
    tree = TreeBuilder(POSE)
    last = tree.add_rod(-1, 1.0, (0.004, 0.004), RodMaterial(5.0, 800.0), 4)[-1]
    tree.add_bunch(last, 650.0)
    modulus, mass = lines(caplog)
    assert modulus.startswith("rod of cane on body -1: modulus is 5 Pa")
    assert mass.startswith("bunch on body 3: mass is 650 kg")


def test_numbers_of_a_scenes_plants_are_checked(caplog, tmp_path):
    text = find_data_file("plants", "vine", ".toml").read_text()
    changed = text.replace("value = 5.89e9", "value = 5.89").replace("value = [0.0040, 0.0050]", "value = [4.0, 5.0]")
    (tmp_path / "mine.toml").write_text(changed)
    load_plant(str(tmp_path / "mine.toml"))
    said = lines(caplog)
    assert len(said) == 3
    assert said[0].startswith(f"{tmp_path / 'mine.toml'}: cane: woody_modulus is 5.89 Pa")
    assert "peduncle: diameter is 4 m" in said[1]


def test_what_ships_with_vinesim_is_plausible(caplog):
    load_plant.__wrapped__("vine")
    vinesim.Simulation("demo")
    CaneBuilder().build()
    assert lines(caplog) == []
