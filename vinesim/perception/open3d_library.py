"""Loads Open3D when it is first needed."""

from __future__ import annotations

import importlib
from typing import Any


class Open3DMissing(RuntimeError):
    """Open3D is not installed, or cannot be loaded. The message is one line with the remedy."""

    exit_code = 3


def load_open3d() -> Any:
    """Returns the module ``open3d``. Raises :class:`Open3DMissing` if it cannot be imported."""
    try:
        return importlib.import_module("open3d")
    except ImportError as bad:
        raise Open3DMissing(f"Open3D cannot be loaded ({bad}); run: pip install 'vinesim[perception]'") from None
    except OSError as bad:  # a system library that Open3D needs
        raise Open3DMissing(f"Open3D cannot be loaded ({bad}); install this library") from None
