"""A policy in the physics of a client, compared with the same policy in a batch."""

import dataclasses
import json
import pathlib
import sys

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("mujoco_warp")
from tests.learn.arm_control import Reaching, towards
from tests.support import programs
from tests.support.waiting import deadline
from vinesim.core import frames
from vinesim.learn.arm import arm
from vinesim.learn.arm_env import BASE, HOME
from vinesim.learn.evaluate import UNSEEN, evaluate, evaluate_with_full_physics, unseen_plants, wanted_bunches
from vinesim.learn.pilot import ReachBunch, ReachPilot, arm_description
from vinesim.learn.policy import Policy, PolicyError
from vinesim.learn.reach import NUMBERS, ReachEnv, plants
from vinesim.learn.variation import Variation
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.world import Physics

pytestmark = pytest.mark.slow

TIMEOUT = deadline(300.0)
"""Limit for a command [s]; reached only by a failure."""


class Given:
    """A stand-in for a policy that returns :attr:`action`."""

    def check_numbers(self, inputs: int, outputs: int) -> None:
        assert (inputs, outputs) == (NUMBERS, 7)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        return self.action


def test_a_client_and_a_batch_observe_and_act_alike() -> None:
    """The hand goes to the bunch of another shoot and pushes it. Both sides have whole bunches, awake plants and no
    contacts between plants."""
    policy = Given()
    env = ReachEnv(1, vines_seed=UNSEEN)
    observation, _ = env.reset(seed=3)
    wanted = int(np.argmax(observation[0, -4:]))
    assert wanted_bunches(1, 3).tolist() == [wanted]
    parameters = PhysicsParameters(sleep=False, bunch_pool_size=0)
    physics = Physics(plants(np.random.default_rng([UNSEEN, 0]), Variation()), parameters=parameters, detachment=False)
    physics.contact_solver.plant_plant_contacts = False
    physics.add_robot(arm(BASE, HOME))
    physics.wake(np.arange(4))
    pilot = ReachPilot(physics, policy, wanted)
    np.testing.assert_allclose(pilot.observation, observation[0], atol=1e-5)
    forces = []
    for _ in range(60):
        action = towards(env, observation[:, 17:20])
        policy.action = action[0]
        targets = pilot.act()
        physics.rigid.command("arm", targets)
        observation, _, terminated, truncated, info = env.step(action)
        assert not (terminated | truncated).any()
        np.testing.assert_allclose(targets[:7], env.worlds.bodies.targets.numpy()[0, :7], atol=2e-3)
        for _ in range(4):
            physics.step()
        pilot.look()
        seen = observation[0]
        np.testing.assert_allclose(pilot.observation[:7], seen[:7], atol=2e-3)
        np.testing.assert_allclose(pilot.observation[14:26], seen[14:26], atol=2e-3)
        np.testing.assert_allclose(pilot.observation[26], seen[26], rtol=0.1, atol=0.3)
        np.testing.assert_array_equal(pilot.observation[27:], seen[27:])
        assert pilot.has_reached == info["success"][0]
        forces.append(seen[26])
    assert max(forces) > 1.0, "the arm has pressed on another shoot"


def test_a_policy_reaches_the_same_bunches_in_a_batch_and_with_full_physics() -> None:
    """Six worlds; a straight way to the bunch reaches most, and the physics must agree on all but one."""
    batch = evaluate(Reaching(), 6, seed=2)
    full = evaluate_with_full_physics(Reaching(), 6, seed=2)
    assert batch.successes >= 4
    assert abs(batch.successes - full.successes) <= 1
    assert batch.actions == pytest.approx(full.actions, abs=6.0)
    assert batch.faults == full.faults == 0
    assert batch.line() == f"reached {batch.successes} of 6 ({100 * batch.successes / 6:.1f} %)"


def test_an_evaluation_says_what_does_not_fit() -> None:
    wrong = Policy("reach", *(np.ones(3, np.float32),) * 2, (np.ones((7, 3), np.float32),), (np.ones(7, np.float32),))
    for run in (evaluate, evaluate_with_full_physics):
        with pytest.raises(PolicyError, match="maps 3 numbers to 7, task reach has 31 and 7; train it again"):
            run(wrong, 1)
    with pytest.raises(PolicyError, match="for task 'swim', which is none of reach, expose"):
        evaluate(dataclasses.replace(wrong, task="swim"), 1)
    with pytest.raises(ValueError, match="there is only reach"):
        evaluate_with_full_physics(dataclasses.replace(wrong, task="expose"), 1)
    with pytest.raises(ValueError, match="only batches have it"):
        evaluate_with_full_physics(wrong, 1, variation=Variation(delay=(0, 2)))


def test_the_arm_of_a_client_follows_a_policy_like_that_of_the_physics() -> None:
    """The client's robot has servos of its own, which follow the speed of their set-points."""
    policy = Reaching()
    wanted = int(wanted_bunches(1, 5)[0])
    plain, client = (Physics(unseen_plants(0, 5)) for _ in range(2))
    plain.add_robot(arm(BASE, HOME))
    pilot = ReachPilot(plain, policy, wanted)
    robot = Robot(client.rigid, arm_description(), "picker", 0, frames.pose(np.array(BASE)))
    robot.fit_cutters(client)
    task = ReachBunch(client, robot, policy, wanted)
    for step in range(400):
        task.control(client.time)
        if task.is_done:
            break
        if step % 4 == 0:
            pilot.look()
            plain.rigid.command("arm", pilot.act())
        robot.control(client.time)
        client.step()
        plain.step()
        places = [physics.rigid.joint_measurements(name)[0] for physics, name in ((plain, "arm"), (client, "picker"))]
        np.testing.assert_allclose(*places, atol=0.01)
    assert task.succeeded
    pilot.look()
    assert pilot.has_reached


def test_a_client_takes_a_policy_and_stops(tmp_path: pathlib.Path) -> None:
    """A policy that rests does not reach its bunch in 4 s."""
    file = tmp_path / "policy.npz"
    layer = np.zeros((7, NUMBERS), np.float32), np.zeros(7, np.float32)
    Policy("reach", np.zeros(NUMBERS, np.float32), np.ones(NUMBERS, np.float32), layer[:1], layer[1:]).save(file)
    command = [sys.executable, "-m", "vinesim", "client", "--role", "robot", "--policy", str(file), "--no-ros"]
    done = programs.run([*command, "--robot", "vinebot"], timeout=TIMEOUT)
    assert done.returncode == 2
    assert "--robot with --policy" in done.stderr
    done = programs.run([*command, "--out", str(tmp_path / "run")], timeout=TIMEOUT)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["time"] == pytest.approx(4.0, abs=0.1)
    assert report["job"]["reason"] == "reach: not done after 4 s"
    assert report["faults"] == {}
