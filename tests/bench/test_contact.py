"""What ``vinesim bench tick`` reports: the tick of one robot and of ten, and whose share it is."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.bench import client_tick
from vinesim.bench import contact as bench
from vinesim.cli.bench import BENCHES


def test_every_tick_is_shared_out_to_mujoco_us_and_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "SCENE", "demo")
    monkeypatch.setattr(bench, "MEASURED_STEPS", 20)
    monkeypatch.setattr(bench, "WARM_UP_STEPS", 2)
    monkeypatch.setattr(bench, "_compare_with_mujoco", lambda *_: iter(()))
    monkeypatch.setattr(client_tick, "CASES", ())
    found = list(BENCHES["tick"]())
    assert {m.unit for m in found} == {"ms/tick"}
    for robots in ("1 robot,", "10 robots,"):
        of = {m.case.split(": ")[1]: m.value for m in found if m.case.startswith(robots)}
        assert len(of) == 8
        for name in ("tick", "MuJoCo's share", "ours", "the rest"):
            assert 0.0 < of[f"{name}, p50"] <= of[f"{name}, p99"]
        parts = [of[f"{name}, p50"] for name in ("MuJoCo's share", "ours", "the rest")]
        assert max(parts) < of["tick, p99"]
        assert np.sum(parts) < 1.5 * of["tick, p99"]
    assert all("20 trees awake" in m.case for m in found)
