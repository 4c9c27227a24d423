"""What ``python -m benchmarks kill`` makes of its rounds, without programs."""

from __future__ import annotations

from benchmarks.kill import RESTART_BOUND, Round, _rows

KINDS = ("server", "sensors")


def rows(rounds: list[Round]) -> dict[str, tuple[float, float | None]]:
    """Value and figure of comparison by what was measured."""
    return {row.case: (row.value, row.peer_value) for row in _rows(rounds, KINDS, picked=len(rounds))}


def test_a_round_after_which_something_is_missing_counts_for_no_kind():
    """One of three rounds has a program that does not go on: its time, which is the timeout, is no recovery either."""
    found = rows([Round(KINDS, 4.0, []), Round(KINDS, 180.0, ["client of anna"]), Round(KINDS, 6.0, [])])
    for kind in KINDS:
        assert found[f"{kind}: kills after which all went on"] == (2, 3)
    assert found["from the last kill of a round until all went on, at most"][0] == 6.0
    assert found["from the last kill of a round until all went on, p50"][0] == 5.0


def test_no_recovery_time_is_given_when_no_round_recovered():
    """All rounds missed something: the counts are 0 and no time is stated."""
    found = rows([Round(KINDS, 180.0, ["server"])])
    assert found["server: kills after which all went on"] == (0, 1)
    assert not any("until all went on" in what for what in found)


def test_the_slowest_sensor_restart_is_held_against_its_bound():
    """Rounds without a restart of sensors are left out of it."""
    found = rows([Round(KINDS, 4.0, [], 1.0), Round(KINDS, 5.0, []), Round(KINDS, 5.0, [], 2.0)])
    assert found["sensors: from the new start to ready, at most"] == (2.0, RESTART_BOUND)
    assert found["sensors: from the new start to ready, p50"][0] == 1.5
