"""What ``vinesim bench tick`` reports of whole clients: parts of a tick beside budgets, while a robot pushes."""

from __future__ import annotations

import contextlib

import pytest

from vinesim.bench import client_tick
from vinesim.robot.description.loader import load_description
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene


def test_a_tick_is_the_sum_of_its_parts_and_has_a_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_tick, "CASES", client_tick.CASES[:1])
    monkeypatch.setattr(client_tick, "WARM_UP_TICKS", 2)
    monkeypatch.setattr(client_tick, "MEASURED_TICKS", 1)
    rows = {row.case.split(": ")[1]: row for row in client_tick.client_measurements()}
    whole = rows["whole tick, p50"]
    assert whole.value == pytest.approx(sum(rows[f"{part}, p50"].value for part in client_tick.PARTS))
    assert (whole.peer, whole.peer_value) == ("budget", 1.2)
    assert whole.ratio == pytest.approx(1.2 / whole.value)


@pytest.mark.long
def test_the_measured_client_pushes_and_sends_updates() -> None:
    scene = load_scene("demo")
    with contextlib.ExitStack() as stack:
        pushing = client_tick.PushingClient(
            scene, generate(scene), load_description("vinebot"), stack, has_visitor=True
        )  # fmt: skip
        client = pushing.client
        for _ in range(600):
            pushing.tick()
            if client.trace is not None and client.trace.displacement > 0.02:
                break
        assert client.trace is not None
        assert client.trace.displacement > 0.02
        assert client.replicator.counters.environment.bytes_out > 0
