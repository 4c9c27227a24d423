"""What ``vinesim bench tick`` reports of whole clients: parts of a tick beside budgets, while a robot pushes."""

from __future__ import annotations

import contextlib

import pytest

from vinesim.bench import client_tick
from vinesim.robot.description.loader import load_description
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene


def test_the_parts_of_a_tick_make_up_the_whole_and_the_paced_one_has_a_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_tick, "CASES", client_tick.CASES[:2])
    monkeypatch.setattr(client_tick, "WARM_UP_TICKS", 2)
    monkeypatch.setattr(client_tick, "MEASURED_TICKS", 1)
    rows = {row.case: row for row in client_tick.client_measurements()}
    for case in client_tick.CASES:
        for pace in ("paced", "loop"):
            whole = rows[f"{case.text}: {pace}, CPU, whole tick, p50"]
            parts = sum(rows[f"{case.text}: {pace}, CPU, {part}, p50"].value for part in client_tick.PARTS)
            assert 0.0 < parts <= whole.value
            assert whole.value == rows[f"{case.text}: {pace}, CPU, whole tick, p99"].value  # one tick was measured
    budgeted = client_tick.CASES[1]
    whole = rows[f"{budgeted.text}: paced, CPU, whole tick, p50"]
    assert (whole.peer, whole.peer_value) == ("budget", budgeted.tick_budget)
    assert whole.ratio == pytest.approx(1.2 / whole.value)


def test_a_client_with_subscribers_passes_every_step_to_them() -> None:
    scene = load_scene("demo")
    with contextlib.ExitStack() as stack:
        pushing = client_tick.PushingClient(
            scene, generate(scene), load_description("vinebot"), stack, has_subscribers=True
        )
        times = pushing.measure(4, is_paced=False)
        assert times.cpu.shape == times.wall.shape == (4, len(client_tick.PARTS) + 1)
        assert pushing.taken_steps == 4


@pytest.mark.long
def test_the_measured_client_pushes_and_sends_updates() -> None:
    scene = load_scene("demo")
    with contextlib.ExitStack() as stack:
        pushing = client_tick.PushingClient(
            scene, generate(scene), load_description("vinebot"), stack, has_visitor=True
        )
        client = pushing.client
        for _ in range(600):
            pushing.tick()
            if client.trace is not None and client.trace.displacement > 0.02:
                break
        assert client.trace is not None
        assert client.trace.displacement > 0.02
        assert client.replicator.counters.environment.bytes_out > 0
