"""``vinesim bench`` where load generators are not installed."""

from __future__ import annotations

import sys

import pytest

from vinesim.cli.bench import NoSuchBench, run


def test_a_bench_that_needs_a_checkout_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "vinesim.bench.support", None)
    for module in ("vinesim.bench.message_fuzz", "vinesim.bench.fuzz"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(NoSuchBench, match="in a checkout"):
        run(["fuzz"], as_json=True)
