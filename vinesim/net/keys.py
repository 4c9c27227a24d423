"""Layout of the keys of a world, relative to its prefix; what each family means is listed in ``docs/network.md``."""

from __future__ import annotations


def sender_of(key: str) -> str:
    """Name of the actor that published under a key; empty for the server and for a key that names no actor."""
    family, *rest = key.split("/")
    if not rest or family == "snap":
        return ""
    return rest[0] if family in ("a", "hello", "live", "voice") else rest[-1]
