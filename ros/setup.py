"""Installs the files of this folder as the ament package that package.xml describes."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import setup

PACKAGE = ElementTree.parse(Path(__file__).parent / "package.xml").getroot()
NAME = PACKAGE.findtext("name", "")

FOLDERS = ("control", "moveit", "nav2")
"""Folders with configuration of other packages."""


def files_of(folder: str) -> list[str]:
    """Paths of the files in a folder, relative to this one."""
    return [f"{folder}/{file.name}" for file in sorted((Path(__file__).parent / folder).iterdir()) if file.is_file()]


setup(
    name=NAME,
    version=PACKAGE.findtext("version"),
    description=PACKAGE.findtext("description"),
    license=PACKAGE.findtext("license"),
    maintainer=PACKAGE.findtext("maintainer"),
    maintainer_email=PACKAGE.find("maintainer").get("email"),
    packages=[],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (
            f"share/{NAME}",
            ["package.xml", "vinebot.launch.py", "vinebot.rviz", "parameters.yaml", "foxglove.json"],
        ),
        *((f"share/{NAME}/{folder}", files_of(folder)) for folder in FOLDERS),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
)
