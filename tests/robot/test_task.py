"""Tasks written as generators: phases, durations, timeout, and the reason of a failure."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.task import Task, TaskFailed
from vinesim.scene.builder import assemble


class TwoPhases(Task):
    fails = False

    def focus(self) -> np.ndarray:
        return np.zeros(3)

    def run(self) -> Iterator[str]:
        yield from self.wait(0.5, "one")
        yield from self.wait(0.25, "two")
        if self.fails:
            raise TaskFailed("the end is missing")


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot(RigidWorld(assemble([])), load_description("vinebot"), "anna")


def run_to_the_end(task: TwoPhases) -> TwoPhases:
    tick = 0
    while not task.is_done:
        task.control(3.0 + 0.01 * tick)
        tick += 1
        assert tick < 1000
    return task


def test_phases_follow_and_their_durations_are_reported(robot: Robot):
    task = run_to_the_end(TwoPhases(robot, timeout=5.0))
    assert task.succeeded
    report = task.report()
    assert list(report["phases_s"]) == ["one", "two"]
    assert report["phases_s"]["one"] == pytest.approx(0.5, abs=0.011)
    assert report["phases_s"]["two"] == pytest.approx(0.25, abs=0.011)
    assert report["reason"] == ""


def test_a_failure_is_reported_with_phase_and_reason(robot: Robot, caplog: pytest.LogCaptureFixture):
    task = TwoPhases(robot, timeout=5.0)
    task.fails = True
    assert not run_to_the_end(task).succeeded
    assert task.reason == "two: the end is missing"
    assert "anna: two: the end is missing" in caplog.text
    task.control(100.0)  # a finished task does nothing
    assert task.phase == "two"


def test_a_task_fails_after_its_timeout(robot: Robot):
    task = run_to_the_end(TwoPhases(robot, timeout=0.3))
    assert task.reason == "one: not done after 0.3 s"
