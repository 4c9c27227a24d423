"""Jobs told as generators: phases, durations, the end, and the reason if it fails."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from vinesim.physics.rigid.rigid_world import RigidWorld
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.task import Task, TaskFailed
from vinesim.scene.builder import assemble


class Story(Task):
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


def tell(story: Story) -> Story:
    tick = 0
    while not story.is_done:
        story.control(3.0 + 0.01 * tick)
        tick += 1
        assert tick < 1000
    return story


def test_phases_follow_and_their_times_are_told(robot: Robot):
    story = tell(Story(robot, timeout=5.0))
    assert story.succeeded
    report = story.report()
    assert list(report["phases_s"]) == ["one", "two"]
    assert report["phases_s"]["one"] == pytest.approx(0.5, abs=0.011)
    assert report["phases_s"]["two"] == pytest.approx(0.25, abs=0.011)
    assert report["reason"] == ""


def test_a_failure_says_where_and_why(robot: Robot, caplog: pytest.LogCaptureFixture):
    story = Story(robot, timeout=5.0)
    story.fails = True
    assert not tell(story).succeeded
    assert story.reason == "two: the end is missing"
    assert "anna: two: the end is missing" in caplog.text
    story.control(100.0)  # and that is its end
    assert story.phase == "two"


def test_patience_ends(robot: Robot):
    story = tell(Story(robot, timeout=0.3))
    assert story.reason == "one: not done after 0.3 s"
