"""The pinned versions suit every Python that the README names."""

from __future__ import annotations

import importlib.metadata
import pathlib

from packaging.specifiers import SpecifierSet

ROOT = pathlib.Path(__file__).parents[2]
OLDEST = "3.11.2"
"""Python of Debian 12."""


def test_pinned_packages_install_on_the_python_of_debian_12() -> None:
    """A package that needs 3.11.5 is installed by those who have it, and stops `make test` for those who have not."""
    refused = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        name, _, version = line.partition("==")
        if not version:
            continue
        try:
            package = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue  # of an extra that is not installed, or of another Python
        needs = (package.metadata.get_all("Requires-Python") or [""])[0]  # [] raises with some readers of metadata
        if needs and not SpecifierSet(needs).contains(OLDEST):
            refused[name] = needs
    assert not refused
