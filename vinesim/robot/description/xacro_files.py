"""Expands xacro files by the package xacro, or by the program ``xacro`` of an installed ROS 2."""

from __future__ import annotations

import contextlib
import importlib
import io
import pathlib
import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.robot.description.packages import find_package
from vinesim.robot.description.urdf import DescriptionError, description_error, is_of_xacro, parse_xml

TIME_LIMIT = 60.0
"""Longest time that the program ``xacro`` may take [s]."""


def is_xacro(root: etree._Element) -> bool:
    """Returns whether an XML text has something for xacro to expand: elements of xacro, or ``${...}`` or ``$(...)``."""
    for element in root.iter(etree.Element):
        namespace = etree.QName(element).namespace
        if namespace and is_of_xacro(namespace):
            return True
        if any("${" in value or "$(" in value for value in element.attrib.values()):
            return True
    return False


def parse_arguments(words: Sequence[str]) -> dict[str, str]:
    """Returns the arguments ``name:=value`` of a command line as a dictionary. Raises :class:`DescriptionError` for a
    word of another form."""
    found = {}
    for word in (one for words_of_one in words for one in words_of_one.split()):
        match = re.fullmatch(r"([^:=\s]+):?=(.*)", word)
        if match is None:
            raise DescriptionError(f"--xacro-args has {word!r}; give NAME:=VALUE")
        found[match.group(1)] = match.group(2)
    return found


def expand_xacro(content: bytes, file: pathlib.Path, arguments: Mapping[str, str]) -> etree._Element:
    """Returns the root of the XML that a xacro ``file`` with ``content`` expands to. Raises :class:`DescriptionError`
    if xacro is not installed or refuses the file."""
    try:
        xacro = importlib.import_module("xacro")
    except ImportError:
        return _by_program(content, file, arguments)

    missing: list[str] = []

    def find(name: str) -> str:
        folder = find_package(name, file)
        if folder is None:
            missing.append(name)
        return str(folder)

    substitutions = importlib.import_module("xacro.substitution_args")
    vars(substitutions)["_eval_find"] = find
    for table in vars(substitutions).values():  # the functions that $(eval ...) may call
        if isinstance(table, dict) and "find" in table:
            table["find"] = find
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            xacro.init_stacks(str(file))
            document = xacro.parse(io.BytesIO(content))
            xacro.process_doc(document, mappings=_defaults(content, file) | dict(arguments))
            text = document.toxml()
    except Exception as error:  # its own, and those of Python expressions in the file
        if missing:
            raise _no_package(missing[0], file) from error
        reason = " ".join(str(error).split()) or type(error).__name__
        if "undefined substitution argument" in reason.lower() or "not defined" in reason.lower():
            raise description_error(file, f"xacro: {reason}", "give it by --xacro-args NAME:=VALUE") from error
        raise description_error(file, f"xacro: {reason}", "correct the file") from error
    if missing:
        raise _no_package(missing[0], file)
    return parse_xml(text.encode(), file)


def _no_package(name: str, file: pathlib.Path) -> DescriptionError:
    return description_error(
        file, f"xacro does not find the package {name!r}", "source its workspace, or put it above the file"
    )


def _defaults(content: bytes, file: pathlib.Path) -> dict[str, str]:
    """Returns the default values of a file's own arguments. xacro itself knows them only after the ``<robot>`` element,
    whose name is often an argument."""
    found = {}
    for element in parse_xml(content, file):
        name = etree.QName(element)
        default = element.get("default")
        if name.localname == "arg" and name.namespace and default is not None and "$" not in default:
            found[element.get("name", "")] = default
    return found


def _by_program(content: bytes, file: pathlib.Path, arguments: Mapping[str, str]) -> etree._Element:
    """Returns what the program ``xacro`` prints for a file."""
    program = shutil.which("xacro")
    if program is None or not file.is_file():
        raise description_error(file, "it is a xacro file", "type: pip install 'vinesim[xacro]'")
    words = [f"{name}:={value}" for name, value in arguments.items()]
    try:
        done = subprocess.run([program, str(file), *words], capture_output=True, timeout=TIME_LIMIT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise description_error(file, f"{program} failed: {error}", "type: pip install 'vinesim[xacro]'") from error
    if done.returncode != 0:
        said = done.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
        raise description_error(file, f"xacro: {said[0]}", "correct the file")
    return parse_xml(done.stdout, file)
