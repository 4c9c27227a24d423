"""Built message packages as wheels, so that any node of an environment can import them and pip can remove them."""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import os
import pathlib
import platform
import subprocess
import sys
import tempfile
import zipfile

from vinesim.ros.messages import message_packages
from vinesim.ros.messages.message_packages import InterfacesError


def distribution(package: str) -> str:
    """The name under which pip knows vinesim's build of ``package``."""
    return f"vinesim-{package.replace('_', '-')}"


def write(package: str, folder: pathlib.Path) -> pathlib.Path:
    """Write the wheel of ``package`` (built if need be) into ``folder``; returns its path."""
    place = message_packages.build([package])[package]
    name = distribution(package).replace("-", "_")
    version = f"1.0+{message_packages.key(package)}"
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
        raise InterfacesError(f"could not write {wheel}: {bad.strerror}; name another folder by --wheel") from None
    return wheel


def install(packages: list[str]) -> None:
    """Install vinesim's builds of ``packages`` into the running environment, over older ones."""
    if not packages:
        return
    message_packages.build(packages)  # side by side
    if importlib.util.find_spec("pip") is None:
        raise InterfacesError(
            f"pip is missing in {sys.prefix}; write wheels by vinesim ros build-interfaces --wheel DIR and install "
            "them by the tool that made the environment"
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
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
