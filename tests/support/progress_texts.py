"""The progress texts of a test, whatever other tests of the process have done with the logger."""

from __future__ import annotations

import logging

import pytest

from vinesim.core import progress


def collect_progress(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Log every progress text at once, and return the list to which the texts are added."""
    texts: list[str] = []
    handler = logging.Handler()
    monkeypatch.setattr(handler, "emit", lambda record: texts.append(record.getMessage()))
    monkeypatch.setattr(progress, "PERIOD", 0.0)
    monkeypatch.setattr(progress.log, "handlers", [handler])
    monkeypatch.setattr(progress.log, "propagate", False)
    progress.log.setLevel(logging.INFO)  # as every program does
    return texts
