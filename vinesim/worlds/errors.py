"""Errors of batches of worlds."""

from __future__ import annotations


class MissingExtra(ImportError):
    """Raised if a package of the extra ``learn`` is not installed. The message says how to install it."""

    exit_code = 3
