"""Friction and stiffness by pair of materials: the shipped file, and files that cannot be used."""

from __future__ import annotations

import pathlib

import numpy as np
import pytest

from vinesim.core.toml_loader import DataError
from vinesim.rigid.urdf import collision_materials
from vinesim.robot.description.loader import load_description
from vinesim.scene.ids import Organ
from vinesim.scene.materials import Material, materials_of_organs, pair_numbers, pair_table

NUMBER = 'unit = "{unit}", grade = "GUESSED", source = "a file of this test" }}'


def written(folder: pathlib.Path, line: str, unit: str = "1") -> str:
    file = folder / "contact.toml"
    file.write_text("[friction]\n" + line + NUMBER.format(unit=unit) + "\n")
    return str(file)


@pytest.mark.parametrize(("quantity", "default"), [("friction", 0.8), ("stiffness", 2e4)])
def test_a_table_is_symmetric_and_has_the_default_where_the_file_says_nothing(quantity: str, default: float) -> None:
    table = pair_table(quantity, default)
    assert table.shape == (len(Material), len(Material))
    assert (table == table.T).all()
    assert (table > 0.0).all()
    assert (table[Material.UNKNOWN] == default).all()
    assert (table[Material.BERRY] == default).all()  # no measured coefficient of grapes is known
    assert np.count_nonzero(np.triu(table != default)) == len(pair_numbers()[quantity])


def test_a_file_of_a_user_counts_in_either_order(tmp_path: pathlib.Path) -> None:
    table = pair_table("friction", 0.8, written(tmp_path, "rubber-berry = { value = 0.65, "))
    assert table[Material.BERRY, Material.RUBBER] == table[Material.RUBBER, Material.BERRY] == 0.65


@pytest.mark.parametrize(
    ("line", "unit", "said"),
    [
        ("bark-glass = { value = 0.5, ", "1", "friction.bark-glass is no pair of materials; give two of bark, "),
        ("bark = { value = 0.5, ", "1", "friction.bark is no pair"),
        ("bark-steel = { value = 0, ", "1", "friction.bark-steel.value is 0.0; give a number above 0"),
        ("bark-steel = { value = 0.5, ", "N", "friction.bark-steel.unit is 'N'; give the value in '1'"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_in_one_line(
    line: str, unit: str, said: str, tmp_path: pathlib.Path
) -> None:
    with pytest.raises(DataError, match=said) as caught:
        pair_table("friction", 0.8, written(tmp_path, line, unit))
    assert "\n" not in str(caught.value)


def test_a_pair_given_in_both_orders_is_refused(tmp_path: pathlib.Path) -> None:
    twice = "bark-steel = { value = 0.5, " + NUMBER.format(unit="1") + "\nsteel-bark = { value = 0.5, "
    with pytest.raises(DataError, match="steel-bark is given twice"):
        pair_table("friction", 0.8, written(tmp_path, twice))


def test_plants_and_trellis_are_of_the_materials_of_their_organs() -> None:
    organs = np.array([Organ.CANE, Organ.PEDUNCLE, Organ.BUNCH, Organ.WIRE, Organ.POLE])
    assert materials_of_organs(organs).tolist() == [
        Material.BARK,
        Material.SHOOT,
        Material.BERRY,
        Material.STEEL,
        Material.UNKNOWN,
    ]


def test_collision_shapes_are_of_what_is_seen_at_their_place() -> None:
    """The fingers of vinebot: two pads of rubber each, with a back of steel."""
    materials = collision_materials(load_description("vinebot").urdf)
    for link in ("gripper_left_left_finger_link", "gripper_right_right_finger_link"):
        assert materials[link] == (Material.RUBBER, Material.RUBBER, Material.STEEL)
    assert set(materials["arm_left_1_link"]) <= {Material.UNKNOWN}  # painted
