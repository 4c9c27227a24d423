"""All modules of the benchmarks can be imported: most of them run rarely, on other machines."""

import importlib
import pathlib

import pytest

import benchmarks

ROOT = pathlib.Path(benchmarks.__file__).parent
MODULES = sorted(".".join(("benchmarks", *file.relative_to(ROOT).with_suffix("").parts)) for file in ROOT.rglob("*.py"))


@pytest.mark.parametrize("name", [one for one in MODULES if not one.endswith(("__init__", "__main__"))])
def test_a_module_of_the_benchmarks_can_be_imported(name: str) -> None:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
