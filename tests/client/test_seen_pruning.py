"""Pruning by sight: what the robot remembers, and the cuts that it plans from it."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.seen_pruning import seen_measurements
from vinesim.client.tasks.pruning import ABOVE_BUD, REMOVED_AT, PruningRule
from vinesim.client.tasks.registry import validate_sight
from vinesim.client.tasks.seen_pruning import CaneMemory, plan_cuts, spurs
from vinesim.core.errors import UsageError
from vinesim.robot.tasks.sight import SeenCane

RULE = PruningRule()


def seen(x: float, z: float, lean: float = 0.0, shift: float = 0.0) -> SeenCane:
    """Returns the sight of a straight cane with nodes 4, 10 and 16 cm above its base."""
    way = np.array([np.sin(lean), 0.0, np.cos(lean)])
    points = np.array([x, 2.6 + shift, z]) + np.linspace(0.0, 0.25, 40)[:, None] * way
    return SeenCane(points, 0.009, np.array([0.04, 0.10, 0.16]), 1.0, False)


def remembered(*pictures: tuple[SeenCane, ...]) -> CaneMemory:
    memory = CaneMemory()
    for picture in pictures:
        memory.add(picture)
    return memory


def test_a_cane_that_is_seen_twice_is_remembered_once_and_one_seen_once_does_not_count():
    memory = remembered((seen(3.0, 0.9), seen(3.3, 0.9)), (seen(3.0, 0.9, shift=0.008),))
    assert [len(one.sights) for one in memory.sure()] == [2]
    assert len(memory.canes) == 2


def test_the_lower_cane_of_a_spur_stays_and_is_cut_above_its_second_bud():
    pictures = [(seen(3.0, 0.900, -0.3), seen(3.005, 0.928, 0.1), seen(3.2, 0.91)) for _ in range(2)]
    canes = remembered(*pictures).sure()
    assert sorted(len(group) for group in spurs(canes)) == [1, 2]
    plan = {cut.cane: cut for cuts in plan_cuts(canes, RULE, 0.0) for cut in cuts}
    assert [plan[number].is_kept for number in (0, 1, 2)] == [True, False, True]
    lower, upper = (canes[number].seen for number in (0, 1))
    np.testing.assert_allclose(plan[0].place, lower.at(0.10 + ABOVE_BUD), atol=1e-9)
    np.testing.assert_allclose(plan[1].place, upper.at(REMOVED_AT * 0.04), atol=1e-9)


def test_seeing_with_another_job_is_one_clear_line():
    for job in ("pick", "prune"):
        validate_sight(job, True)
    validate_sight("meet", False)
    with pytest.raises(
        UsageError, match=r"^--see with --job meet: only pick and prune go by the camera; leave out --see$"
    ):
        validate_sight("meet", True)
    with pytest.raises(UsageError, match=r"^--see with no --job"):
        validate_sight(None, True)


def test_figures_are_counted_over_the_canes_of_the_spurs_that_were_worked_on():
    kept = {"cane": 1, "spur": 0, "found": True, "stays": True, "wanted": 0.10, "at": 0.104, "buds": 2}
    gone = {"cane": 2, "spur": 0, "found": True, "stays": False, "wanted": 0.02, "at": 0.05, "buds": 1}
    lost = {"cane": 3, "spur": 4, "found": True, "stays": True, "wanted": 0.11, "at": 0.01, "buds": 0}
    line = {"seed": 1, "canes": [kept, gone, lost], "vine_canes": 4, "vine_found": 3, "false_canes": 0}
    line |= {"others_cut": 0, "planned": 3, "made": 3, "reasons": [], "seconds": 20.0}
    values = {one.case: one.value for one in seen_measurements([line])}
    assert values["of 4 canes of these vines, found"] == 75.0
    assert values["of 3 canes of these spurs, cut within 10 mm of the place"] == pytest.approx(100.0 / 3.0)
    assert values["of 2 canes that stay, cut below two buds"] == 1.0
    assert values["spurs with 3 buds left"] == values["spurs with 0 buds left"] == 1.0
