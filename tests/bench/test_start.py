"""What ``vinesim bench start`` reports: every budget has its row, and budgets are compared the right way round."""

from __future__ import annotations

import json

import pytest

from vinesim.bench import start


def test_every_budget_has_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(*arguments: str) -> tuple[float, str]:
        parts = {"generate": 0.1, "primitives": 0.2}
        return 4.0 if "client" in arguments else 1.0, json.dumps(parts)

    monkeypatch.setattr(start, "_run", run)
    rows = {row.case: row for row in start.start_measurements()}
    assert set(start.BUDGETS) <= set(rows)
    client = rows["vinesim client: start, first picture, one step, end"]
    assert (client.value, client.peer, client.peer_value) == (4.0, "budget", 3.0)
    assert client.ratio == pytest.approx(0.75)
    assert rows["demo: primitives"].peer == ""
