"""A policy in the physics of a client, compared with the same policy in a batch."""

import asyncio
import dataclasses
import json
import pathlib
import re
import sys
from collections.abc import Callable
from typing import Any

import aiohttp
import msgspec
import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("mujoco_warp")
from tests.learn.arm_control import Controller, Picking, Pruning, Reaching, towards
from tests.support import programs
from tests.support.waiting import deadline
from vinesim.core import frames
from vinesim.learn import TASKS
from vinesim.learn.arm_env import ArmEnv
from vinesim.learn.arm_task import BASE, ArmTask
from vinesim.learn.evaluate import (
    UNSEEN,
    environment,
    evaluate,
    evaluate_with_full_physics,
    task_of,
    task_physics,
    unseen_plants,
    wanted_bunches,
)
from vinesim.learn.expose import Expose
from vinesim.learn.pick import Pick
from vinesim.learn.pilot import Pilot, PolicyTask, task_description
from vinesim.learn.policy import Policy, PolicyError
from vinesim.learn.prune import Prune
from vinesim.learn.reach import Reach
from vinesim.learn.variation import Variation
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.world import Physics

pytestmark = pytest.mark.slow

TIMEOUT = deadline(300.0)
"""Limit for a command [s]; reached only by a failure."""


class Given:
    """A stand-in for a policy that keeps what it sees and returns :attr:`action`."""

    def check_numbers(self, inputs: int, outputs: int) -> None:
        self.seen = np.zeros(inputs)
        self.action = np.zeros(outputs)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        self.seen = observation.copy()
        return self.action


def push(env: ArmEnv, observation: np.ndarray) -> np.ndarray:
    """Returns the action that moves the hand to the second bunch that is observed."""
    return towards(env, observation[:, 17:20])


def pick(env: ArmEnv, observation: np.ndarray) -> np.ndarray:
    """Returns the action of a hand that picks the wanted bunch."""
    return Picking()(observation)


def prune(env: ArmEnv, observation: np.ndarray) -> np.ndarray:
    """Returns the action of shears that cut the wanted cane."""
    return Pruning()(observation)


@pytest.mark.parametrize(
    ("task", "control", "force", "rough"),
    [(Reach, push, 26, []), (Expose, push, 21, [20]), (Pick, pick, 31, []), (Prune, prune, 23, [])],
)
def test_a_client_and_a_batch_observe_and_act_alike(
    task: type[ArmTask], control: Callable[[ArmEnv, np.ndarray], np.ndarray], force: int, rough: list[int]
) -> None:
    """The hand presses on a plant, or cuts its bunch off and holds it, or cuts a cane, until the end.

    Both sides have whole bunches, awake plants and no contacts between plants. ``force``, ``rough``: places of the
    force, and of shares that are multiples of a ninth.
    """
    policy = Given()
    env = environment(task.name)(1, vines_seed=UNSEEN + 1)
    observation, _ = env.reset(seed=1)
    (wanted,) = wanted_bunches(task, 1, 1).tolist()
    parameters = msgspec.structs.replace(task.parameters, sleep=False)
    physics = task_physics(task, unseen_plants(task, 0, 1), parameters=parameters, detachment=False)
    physics.contact_solver.plant_plant_contacts = False
    physics.wake(np.arange(len(physics.model.tree_first)))
    pilot = Pilot(physics, policy, task, wanted)
    exact = np.setdiff1d(np.arange(task.numbers), [*range(7, 14), force, *rough])
    forces = []
    targets = pilot.targets()
    success = False
    for _ in range(90):
        action = control(env, observation)
        policy.action = action[0]
        for _ in range(4):
            physics.rigid.command("arm", next(targets))
            physics.step()
        seen = observation[0]
        np.testing.assert_allclose(policy.seen[exact], seen[exact], atol=3e-3)
        np.testing.assert_allclose(policy.seen[rough], seen[rough], atol=0.12)
        np.testing.assert_allclose(policy.seen[force], seen[force], rtol=0.1, atol=0.3)
        forces.append(seen[force])
        observation, _, terminated, _, info = env.step(action)
        if terminated[0]:
            success = info["success"][0]
            break
    assert next(targets, None) is None or not success
    assert pilot.succeeded == success
    assert success or max(forces) > 1.0, "the arm has done what shows a difference"


@pytest.mark.parametrize(("controller", "worlds", "least"), [(Reaching, 6, 4), (Picking, 12, 7), (Pruning, 12, 11)])
def test_a_policy_does_as_well_in_a_batch_and_with_full_physics(
    controller: type[Controller], worlds: int, least: int
) -> None:
    """A straight way to the bunch reaches most. Most stalks that are not cut are out of reach of an upright hand, or a
    cane is in the blade's mouth. The physics must agree on all worlds but one."""
    batch = evaluate(controller(), worlds, seed=2)
    full = evaluate_with_full_physics(controller(), worlds, seed=2)
    assert batch.successes >= least
    assert abs(batch.successes - full.successes) <= 1
    assert batch.actions == pytest.approx(full.actions, abs=6.0)
    assert batch.faults == full.faults == 0
    assert batch.line().startswith(f"{TASKS[batch.task]} {batch.successes} of {worlds} (")


def test_an_evaluation_says_what_does_not_fit() -> None:
    wrong = Policy("reach", *(np.ones(3, np.float32),) * 2, (np.ones((7, 3), np.float32),), (np.ones(7, np.float32),))
    for run in (evaluate, evaluate_with_full_physics):
        with pytest.raises(PolicyError, match="maps 3 numbers to 7, task reach has 31 and 7; train it again"):
            run(wrong, 1)
    with pytest.raises(PolicyError, match="for task 'swim', which is none of reach, expose"):
        evaluate(dataclasses.replace(wrong, task="swim"), 1)
    with pytest.raises(ValueError, match="only batches have it"):
        evaluate_with_full_physics(wrong, 1, variation=Variation(delay=(0, 2)))


@pytest.mark.parametrize("controller", [Reaching, Picking, Pruning])
def test_the_arm_of_a_client_follows_a_policy_like_that_of_the_physics(controller: type[Controller]) -> None:
    """The client's robot has servos of its own, which follow the speed of their set-points."""
    policy = controller()
    task = task_of(policy)
    (wanted,) = wanted_bunches(task, 1, 5).tolist()
    plants = unseen_plants(task, 0, 5)
    plain = task_physics(task, plants)
    client = Physics(plants)
    targets = Pilot(plain, policy, task, wanted).targets()
    robot = Robot(client.rigid, task_description(task), "picker", 0, frames.pose(np.array(BASE)))
    robot.fit_cutters(client)
    doing = PolicyTask(client, robot, policy, task, wanted)
    for _ in range(4 * task.max_steps):
        doing.control(client.time)
        if doing.is_done:
            break
        plain.rigid.command("arm", next(targets))
        robot.control(client.time)
        client.step()
        plain.step()
        places = [physics.rigid.joint_measurements(name)[0] for physics, name in ((plain, "arm"), (client, "picker"))]
        np.testing.assert_allclose(*places, atol=0.01)
    assert doing.succeeded
    assert next(targets, None) is None


def test_a_client_takes_a_policy_and_stops(tmp_path: pathlib.Path) -> None:
    """A policy that rests does not reach its bunch in 4 s."""
    file = tmp_path / "policy.npz"
    layer = np.zeros((7, 31), np.float32), np.zeros(7, np.float32)
    Policy("reach", np.zeros(31, np.float32), np.ones(31, np.float32), layer[:1], layer[1:]).save(file)
    command = [sys.executable, "-m", "vinesim", "client", "--role", "robot", "--policy", str(file), "--no-ros"]
    done = programs.run([*command, "--robot", "vinebot"], timeout=TIMEOUT)
    assert done.returncode == 2
    assert "--robot with --policy" in done.stderr
    done = programs.run([*command, "--out", str(tmp_path / "run")], timeout=TIMEOUT)
    assert done.returncode == 1, done.stderr
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["time"] == pytest.approx(4.0, abs=0.1)
    assert report["job"]["reason"] == "reach: not done after 4 s"
    assert report["faults"] == {}
    done = programs.run([*command[:-2], "reach", "--no-ros", "--seed", "3"], timeout=TIMEOUT)
    assert done.returncode == 0, done.stderr
    assert re.search(r"robot: reach done after [0-3]\.\d s$", done.stderr, re.MULTILINE), "the policy that ships"


@pytest.mark.slow
def test_with_a_page_the_task_begins_when_it_is_opened_and_the_client_ends_when_it_is_closed() -> None:
    command = [sys.executable, "-m", "vinesim", "client", "--role", "robot", "--policy", "reach", "--no-ros"]
    with programs.Popen([*command, "--page", "0", "--status", "json"], stdout=-1, stderr=-1) as client:
        assert client.stderr is not None
        assert client.stdout is not None
        (address,) = re.findall(r"in a browser: (\S+)", next(line for line in client.stderr if "browser: " in line))
        assert "begins when a browser has opened the page" in client.stderr.readline()

        async def page() -> float:
            """Stays open until the world is a second older than an episode of Reach can be."""
            async with aiohttp.ClientSession() as session, session.ws_connect(address + "state"):
                while (time := await asyncio.to_thread(_next_time, client.stdout)) < Reach.max_steps * 0.04 + 1.0:
                    assert client.poll() is None
                return time

        asyncio.run(asyncio.wait_for(page(), TIMEOUT))
        assert client.wait(TIMEOUT) == 0
        assert "reach done after" in client.stderr.read()


def _next_time(lines: Any) -> float:
    """Returns the simulated time [s] of the next status of a client."""
    return float(json.loads(lines.readline())["time"])
