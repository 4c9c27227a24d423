"""Programs of a shared vineyard that are killed at random moments: a short run of ``vinesim bench kill``."""

from __future__ import annotations

import pytest

from vinesim.bench.kill import kill


@pytest.mark.slow
def test_all_go_on_after_a_server_a_client_and_a_sensor_process_were_killed():
    said: list[str] = []
    kinds = ("server", "client", "sensors")
    rows = {row.case: row for row in kill(3, 2, said.append, ros=False, kinds=kinds)}
    for kind in kinds:
        assert rows[f"{kind}: kills after which all went on"].ratio == 1.0, said
    assert len(said) == 3
