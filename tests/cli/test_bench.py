"""``vinesim bench`` where load generators are not installed."""

from __future__ import annotations

import sys

import pytest

from vinesim.cli.bench import NoSuchBench, run


def test_a_bench_that_needs_a_checkout_is_refused_without_one(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = [name for name in sys.modules if name.startswith("vinesim.bench.support")]
    for module in ("vinesim.bench.support", *loaded):
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "vinesim.bench.message_fuzz", raising=False)
    with pytest.raises(NoSuchBench, match="in a checkout"):
        run(["fuzz"], as_json=True)


def test_rows_are_of_the_bench_live_and_have_names() -> None:
    with pytest.raises(NoSuchBench, match="no row 'picture'; there are: demo"):
        run(["live"], as_json=True, rows=["picture"])
    with pytest.raises(NoSuchBench, match="leave it out"):
        run(["plants"], as_json=True, rows=["demo"])


def test_minutes_are_of_the_bench_soak() -> None:
    with pytest.raises(NoSuchBench, match="--minutes is how long the bench soak runs"):
        run(["plants"], as_json=True, minutes=2.0)
