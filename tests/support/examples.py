"""How many examples Hypothesis draws: few in ``make test``, more in ``make test-long``; see tests/conftest.py."""

from __future__ import annotations

from hypothesis import settings


def share(of_the_usual: float) -> int:
    """The number for a test whose examples cost more or less than usual, for ``settings(max_examples=...)``."""
    usual = settings().max_examples
    return max(1, round(of_the_usual * usual))
