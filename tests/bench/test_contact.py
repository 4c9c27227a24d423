"""``vinesim bench tick``: the tick of one robot and of ten, divided into MuJoCo, vinesim and the rest."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.bench import client_tick
from vinesim.bench import contact as bench
from vinesim.cli.bench import BENCHES


@pytest.mark.long
def test_every_tick_is_divided_into_mujoco_vinesim_and_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "SCENE", "demo")
    monkeypatch.setattr(bench, "MEASURED_STEPS", 20)
    monkeypatch.setattr(bench, "WARM_UP_STEPS", 2)
    monkeypatch.setattr(bench, "_compare_with_mujoco", lambda *_: iter(()))
    monkeypatch.setattr(client_tick, "CASES", ())
    found = list(BENCHES["tick"]())
    assert {m.unit for m in found} == {"ms/tick"}
    for robots in ("1 robot,", "10 robots,"):
        values = {m.case.split(": ")[1]: m.value for m in found if m.case.startswith(robots)}
        assert len(values) == 8
        for name in ("tick", "MuJoCo's share", "ours", "the rest"):
            assert 0.0 < values[f"{name}, p50"] <= values[f"{name}, p99"]
        parts = [values[f"{name}, p50"] for name in ("MuJoCo's share", "ours", "the rest")]
        assert max(parts) < values["tick, p99"]
        assert np.sum(parts) < 1.5 * values["tick, p99"]
    assert all("20 trees awake" in m.case for m in found)
