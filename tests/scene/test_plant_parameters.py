"""Plant parameters: every number has a unit, a grade and a source; a wrong unit is refused."""

import collections
import pathlib
import re
import tomllib

import pytest

from vinesim.core.data_files import data_dir, find_data_file
from vinesim.core.toml_loader import DataError
from vinesim.scene import plant_parameters


def numbers(part):
    for name in part.__struct_fields__:
        value = getattr(part, name)
        yield from (
            numbers(value) if isinstance(value, plant_parameters._Part) else [value] if hasattr(value, "grade") else []
        )


def all_numbers():
    """Every number of the plant files and of the varieties, once: those that a file takes from another count there."""
    vine = plant_parameters.load_plant("vine")
    yield from numbers(vine)
    usual = set(numbers(vine))
    yield from (number for number in numbers(plant_parameters.load_plant("wine_vine")) if number not in usual)
    for variety in plant_parameters.load_varieties():
        yield from numbers(variety)


def test_every_number_is_graded_and_explained():
    """A READ number names a publication (a year, or a table of a journal); a DERIVED one the numbers it follows
    from."""
    found = list(all_numbers())
    assert len(found) > 50
    for number in found:
        assert len(number.source.split()) >= 2, number
        if number.grade == "READ":
            assert re.search(r"\b(19|20)\d\d\b|\btable \d", number.source), number
        elif number.grade == "DERIVED":
            assert re.search(r"\d", number.source), number


def grades_of(table) -> list[str]:
    """Grades of all numbers of a table of TOML, and of those in it."""
    if isinstance(table, list):
        return [grade for entry in table for grade in grades_of(entry)]
    if not isinstance(table, dict):
        return []
    return [table["grade"]] if "grade" in table else [grade for entry in table.values() for grade in grades_of(entry)]


@pytest.mark.parametrize("page", ["docs/limits.md", "docs/validation.md"])
def test_the_pages_state_the_number_of_guesses(page):
    """Of all files in data/plants/, wherever the page counts them."""
    files = [tomllib.loads(path.read_text()) for path in (data_dir() / "plants").glob("*.toml")]
    grades = collections.Counter(grades_of(files))
    assert sum(grades.values()) == len(list(all_numbers())), "a file of data/plants/ is not loaded"
    text = (pathlib.Path(__file__).parents[2] / page).read_text()
    counted = re.findall(r"(\d+) of (\d+) plant parameters are guesses", text)
    assert counted, f"{page} counts no guesses"
    assert {tuple(map(int, each)) for each in counted} == {(grades["GUESSED"], sum(grades.values()))}
    if page == "docs/validation.md":
        others = re.search(r"plant parameters are guesses\*\* \((\d+) read in publications, (\d+) derived\)", text)
        assert others, f"{page} does not count the others"
        assert tuple(map(int, others.groups())) == (grades["READ"], grades["DERIVED"])


def test_a_wrong_unit_is_refused(tmp_path):
    file = tmp_path / "oak.toml"
    text = find_data_file("plants", "vine", ".toml").read_text()
    assert text.count('unit = "Pa"') >= 3
    file.write_text(text.replace('unit = "Pa"', 'unit = "GPa"', 1))
    with pytest.raises(DataError, match=r"oak\.toml: cane\.woody_modulus\.unit is 'GPa'; give the value in 'Pa'"):
        plant_parameters.load_plant(str(file))


def test_a_range_is_interpolated_from_end_to_end():
    length = plant_parameters.load_plant("vine").cane.length
    assert (length.at(0.0), length.at(1.0)) == length.value
