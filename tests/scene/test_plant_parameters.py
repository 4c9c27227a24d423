"""Plant parameters: every number has a unit, a grade and a source; a wrong unit is caught."""

import pytest

from vinesim.scene import plant_parameters
from vinesim.scene.data_files import find_data_file
from vinesim.scene.toml_loader import DataError


def numbers(part):
    for name in part.__struct_fields__:
        value = getattr(part, name)
        yield from (
            numbers(value) if isinstance(value, plant_parameters._Part) else [value] if hasattr(value, "grade") else []
        )


def test_every_number_has_a_source():
    found = [
        *numbers(plant_parameters.load_plant("vine")),
        *(n for v in plant_parameters.load_varieties() for n in numbers(v)),
    ]
    assert len(found) > 40
    assert all(len(n.source) > 4 for n in found)
    assert {n.grade for n in found} == {"READ", "DERIVED", "GUESSED"}


def test_a_wrong_unit_is_told(tmp_path):
    file = tmp_path / "oak.toml"
    text = find_data_file("plants", "vine", ".toml").read_text()
    assert text.count('unit = "Pa"') >= 3
    file.write_text(text.replace('unit = "Pa"', 'unit = "GPa"', 1))
    with pytest.raises(DataError, match=r"oak\.toml: cane\.woody_modulus\.unit is 'GPa'; give the value in 'Pa'"):
        plant_parameters.load_plant(str(file))


def test_a_range_is_walked_from_end_to_end():
    length = plant_parameters.load_plant("vine").cane.length
    assert (length.at(0.0), length.at(1.0)) == length.value
