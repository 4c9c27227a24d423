"""Checks of installed software and stored files: Python, packages, ROS 2, the page, certificates, caches."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import pathlib
import platform
import sys
import tempfile
from collections.abc import Iterable

from vinesim.cli.doctor.finding import ERROR, OK, WARNING, Finding, amount, size_of
from vinesim.core import disk_cache
from vinesim.core.version import __version__

FREE_SPACE = 1 << 30
"""[B] Disk space needed by compiled kernels and tables."""
EXTRAS = {
    "ros": "ROS 2",
    "web": "the page in a browser",
    "tls": "certificates",
    "tune": "fits",
    "tiago": "the robot tiago_pro",
    "perception": "point clouds from depth",
    "export": "export to OpenUSD",
    "voice": "voices",
}
"""Extras of the package that users may install, with their purpose."""


def python(version: tuple[int, ...] = sys.version_info[:3]) -> Finding:
    """Check the version of the interpreter against the package's requirement."""
    found = f"{'.'.join(map(str, version))} ({sys.executable})"
    try:
        from packaging.specifiers import SpecifierSet

        wanted = importlib.metadata.metadata("vinesim")["Requires-Python"]
    except (importlib.metadata.PackageNotFoundError, ImportError):
        return Finding(
            "python", ERROR, f"{found}; the package vinesim is found, but not installed", "pip install --editable ."
        )
    if ".".join(map(str, version)) not in SpecifierSet(wanted):
        return Finding("python", ERROR, found, f"vinesim needs {wanted}: make a venv with another Python")
    return Finding("python", OK, f"{found}, vinesim {__version__}, {platform.system()} {platform.release()}")


def packages(requirements: Iterable[str] | None = None) -> Finding:
    """Check the versions of all required packages, and which extras are complete."""
    from packaging.requirements import Requirement

    given = importlib.metadata.requires("vinesim") if requirements is None else requirements
    wanted = [Requirement(text) for text in given or ()]
    needed = [one for one in wanted if one.marker is None or one.marker.evaluate({"extra": ""})]
    faults = [fault for one in needed if (fault := _fault(one))]
    if faults:
        return Finding("packages", ERROR, ", ".join(faults), "pip install vinesim, in this environment")
    states = []
    for extra, purpose in EXTRAS.items():
        parts = [one for one in wanted if one.marker is not None and one.marker.evaluate({"extra": extra})]
        parts = [one for one in parts if one not in needed]
        if extra == "ros" and importlib.util.find_spec("rclpy") is not None:
            continue  # of another distribution, or sourced: the check of ROS tells which
        if any(_fault(one) for one in parts):
            states.append(f"{extra} ({purpose})")
    found = f"all {len(needed)} that are needed" + (f"; not complete: {', '.join(states)}" if states else "")
    return Finding("packages", OK, found, f"if wanted: pip install 'vinesim[{states[0].split()[0]}]'" if states else "")


def _fault(wanted) -> str:  # the type is packaging.requirements.Requirement
    """Returns the reason why an installed package does not fulfil a requirement; empty if it does."""
    try:
        version = importlib.metadata.version(wanted.name)
    except importlib.metadata.PackageNotFoundError:
        return f"{wanted.name} is missing"
    return (
        ""
        if wanted.specifier.contains(version, prereleases=True)
        else f"{wanted.name} {version} is not {wanted.specifier}"
    )


def ros() -> Finding:
    """Check whether this process can use ROS 2, and with which message packages."""
    from vinesim.ros import installation, middleware

    if (reason := middleware.unavailable_reason()) is not None:
        reason, _, remedy = reason.rpartition("; ")
        return Finding("ros", WARNING, reason, f"{remedy}; robots run without topics until then")
    from vinesim.ros.messages import message_packages as messages

    missing = messages.unbuilt_packages()
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    kind = "wheels" if installation.is_of_wheels() else "installation"
    found = f"{installation.distribution()}, {kind} in {installation.place()}, {middleware.name()}, domain {domain}"
    if not missing:
        return Finding("ros", OK, f"{found}, all message packages")
    return Finding(
        "ros",
        WARNING,
        f"{found}, without messages of {', '.join(missing)}",
        "vinesim ros build-interfaces (needs g++); a client does so at its first start",
    )


def page() -> Finding:
    """Check whether the page for people and spectators can be served."""
    from vinesim.web import page_files

    if (text := page_files.missing()) is not None:
        found, _, remedy = text.partition(": ")
        return Finding("page", WARNING, found, f"{remedy}; people and spectators have no page until then")
    return Finding("page", OK, f"aiohttp {importlib.metadata.version('aiohttp')} and three.js are there")


def certificates(folders: Iterable[pathlib.Path] | None = None) -> Finding:
    """Check whether the certificates of the page and in ``certs/`` are readable, and until when they are valid."""
    from vinesim.net.transport import certificates as certs
    from vinesim.net.transport.access_control import CertificateError

    if importlib.util.find_spec("cryptography") is None:
        return Finding(
            "certificates", WARNING, "cryptography is missing", "pip install 'vinesim[tls]', for --tls and --page-lan"
        )
    places = (disk_cache.folder() / "page-certificate", pathlib.Path("certs")) if folders is None else folders
    read = []
    for folder in filter(pathlib.Path.is_dir, places):
        try:
            if soon := certs.expiring(folder):
                return Finding("certificates", WARNING, *soon[0].split(", and refused afterwards: "))
            for name in certs.roles(folder):
                if (folder / f"{name}.key").exists():
                    certs.check(folder, name)
        except (CertificateError, OSError) as error:
            found, _, remedy = str(error).partition(": ")
            return Finding("certificates", WARNING, found, remedy or "remove that folder")
        read.append(str(folder))
    if not read:
        return Finding("certificates", OK, "none yet; --page-lan and 'vinesim certs new' make them")
    return Finding("certificates", OK, f"valid for more than {certs.WARNING_DAYS} days: {', '.join(read)}")


def caches() -> Finding:
    """Check the folders of compiled kernels and of tables: size, write permission, free space."""
    tables = disk_cache.folder()
    kernels = kernel_folder()
    sizes = [f"kernels {amount(size_of(kernels))} in {kernels}", f"tables {amount(size_of(tables))} in {tables}"]
    found = ", ".join(sizes)
    for folder, variable in ((kernels, "WARP_CACHE_PATH"), (tables, "VINESIM_CACHE")):
        if (fault := _write_fault(folder)) is not None:
            return Finding(
                "caches",
                WARNING,
                f"{folder}: {fault}",
                f"set {variable} to a writable folder; until then every start computes everything again",
            )
    return Finding("caches", OK, found)


def kernel_folder() -> pathlib.Path:
    """Returns the folder in which Warp stores compiled kernels of all its versions. The folder is not created."""
    chosen = os.environ.get("WARP_CACHE_PATH")
    return pathlib.Path(chosen) if chosen else disk_cache.user_folder() / "warp"


def _write_fault(folder: pathlib.Path) -> str | None:
    """Returns the reason why no file can be written in a folder, which need not exist yet; None if files can be
    written."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"x")
        room = os.statvfs(folder) if hasattr(os, "statvfs") else None
    except OSError as error:
        return error.strerror or str(error)
    if room is not None and room.f_bavail * room.f_frsize < FREE_SPACE:
        return f"only {amount(room.f_bavail * room.f_frsize)} free"
    return None
