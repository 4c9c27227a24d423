"""``vinesim certs``."""

from __future__ import annotations

import pathlib

from vinesim.core.errors import UsageError
from vinesim.net.transport.access_control import SERVER, Role
from vinesim.net.transport.certificates import create as new_certificate


def new(actor: str, folder: pathlib.Path, role: str, hosts: list[str], authority: pathlib.Path | None) -> int:
    """Make certificates and print the names of their files. Returns the exit code."""
    possible = [each.value for each in Role if each != Role.SERVER]
    if role not in possible:
        raise UsageError(f"--role {role!r}: give {', '.join(possible)}")
    kind = Role.SERVER if actor == SERVER else Role(role)
    for path in new_certificate(folder, actor, kind, hosts, authority=authority):
        print(path)
    return 0
