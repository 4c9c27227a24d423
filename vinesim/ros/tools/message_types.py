"""Message classes by the names of their types."""

from __future__ import annotations

import contextlib
import importlib


def message_class(type_name: str) -> type | None:
    """The class of ``package/msg/Name``, or None if its package is not installed."""
    package, kind, name = type_name.split("/")
    with contextlib.suppress(ImportError, AttributeError):
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    return None
