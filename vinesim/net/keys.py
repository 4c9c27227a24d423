"""Layout of the keys of a world, relative to its prefix; what each family means is listed in ``docs/network.md``."""

from __future__ import annotations


def sender_of(key: str) -> str:
    """Name of the actor that published under a key; empty for the server."""
    chunks = key.split("/")
    return "" if chunks[0] == "snap" else chunks[1] if chunks[0] in ("a", "hello", "live") else chunks[-1]
