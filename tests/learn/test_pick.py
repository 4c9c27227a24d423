"""The task pick: a hand that grasps a stalk, cuts above its fingers and holds the bunch."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("mujoco_warp")
pytest.importorskip("vinesim.learn")
import gymnasium

from tests.learn.arm_control import Picking, towards
from vinesim.learn.arm import TOOL, TOOL_LINK
from vinesim.learn.arm_kinematics import ArmKinematics
from vinesim.learn.arm_task import HOME
from vinesim.learn.pick import IN_FRONT, Pick, PickEnv
from vinesim.learn.variation import Variation
from vinesim.scene.state import State

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("layout")]
OPENING = 14
STALK = slice(15, 18)
COMMANDED = 21
IN_HAND = slice(22, 25)
AXIS = slice(25, 28)
BLADE = 8


@pytest.fixture(scope="module")
def environment(layout: str) -> Any:
    return gymnasium.make_vec("vinesim/Pick-v0", num_envs=2)


def directions(env: Any, observation: np.ndarray) -> np.ndarray:
    """Returns the horizontal unit vectors [world, 3] from the arm's first joint to the stalks."""
    bodies = env.unwrapped.worlds.bodies
    body = bodies.rigid.robot("arm").bodies[TOOL_LINK]
    point = bodies.data.xpos.numpy()[:, body] + bodies.data.xmat.numpy()[:, body] @ np.array(TOOL)
    first = bodies.data.xpos.numpy()[:, bodies.rigid.robot("arm").bodies["link_0"]]
    ahead = (point + observation[:, STALK] - first) * [1.0, 1.0, 0.0]
    return ahead / np.linalg.norm(ahead, axis=1, keepdims=True)


def test_nothing_happens_to_a_bunch_if_nothing_is_done(environment: Any) -> None:
    observation, _ = environment.reset(seed=1)
    assert environment.observation_space.contains(observation)
    for _ in range(150):
        observation, reward, terminated, truncated, _ = environment.step(np.zeros((2, 9), np.float32))
        assert not is_off(environment).any()
        assert (reward < 0.0).all()
        assert not terminated.any()
    assert truncated.all()


def test_the_fingers_open_and_close_with_their_action(environment: Any) -> None:
    environment.reset(seed=1)
    for grip, opening in ((-1.0, 0.06), (0.1, 0.06), (1.0, -0.048), (-0.1, -0.048), (-0.3, 0.06)):
        action = np.zeros((2, 9), np.float32)
        action[:, 7] = grip
        for _ in range(20):
            observation = environment.step(action)[0]
        np.testing.assert_allclose(observation[:, OPENING], opening, atol=2e-3)


def is_off(env: Any) -> np.ndarray:
    """Returns whether the wanted bunch of each world [world] is off its vine."""
    task = env.unwrapped.task
    worlds = env.unwrapped.num_envs
    trees = task.wanted.numpy() * worlds + np.arange(worlds)
    return (task.arrays.places.slots.numpy() == trees[:, None]).any(1)


def pick(env: Any, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Let a controller pick a bunch in each world. Returns the actions [world] with which the bunches
    came off, and those with which the worlds succeeded; -1: none."""
    policy = Picking()
    observation, _ = env.reset(seed=seed)
    worlds = len(observation)
    cut_at, succeeded_at = np.full((2, worlds), -1)
    running = np.ones(worlds, bool)
    for k in range(150):
        action = policy(observation)
        observation, reward, terminated, _, info = env.step(action)
        seen = info.get("final_obs", observation)
        for world in np.flatnonzero(running & is_off(env) & (cut_at < 0)):
            cut_at[world] = k
            assert action[world, BLADE] > 0.0
        for world in np.flatnonzero(running & info["success"]):
            succeeded_at[world] = k
            assert reward[world] > 9.0
            assert terminated[world]
            assert np.linalg.norm(seen[world, STALK]) < 0.05
            assert not is_off(env)[world], "the next episode begins with a bunch that hangs"
        running &= ~terminated
        if not running.any():
            break
    assert not env.unwrapped.worlds.faults.numpy().any()
    return cut_at, succeeded_at


def potential(env: Any, seen: np.ndarray) -> np.ndarray:
    """Returns the potential [world] of observations [world, k] of the present states, with fingers at equal distances
    from their middle."""
    place = seen[:, IN_HAND]
    width = 0.048 + seen[:, OPENING]
    along = (place[:, 0] < 0.0) & (place[:, 0] > -0.08) & (np.abs(place[:, 2]) < 0.024)
    grasp = np.where(along & (np.abs(place[:, 1]) < 0.5 * width + 0.003), 1.0 - width / 0.108, 0.0)
    distance = np.linalg.norm(place - [-0.02, 0.0, 0.01], axis=1)
    return (
        (3.0 + 2.0 * np.where(is_off(env), 1.0, seen[:, COMMANDED])) * grasp
        - 10.0 * distance
        - 2.0 * (1.0 + seen[:, AXIS][:, 2])
    )


def test_the_reward_is_the_gain_of_the_potential_of_what_is_seen(environment: Any) -> None:
    """With a hand that goes to the stalk, closes, cuts, and holds until a world succeeds."""
    policy = Picking()
    observation, _ = environment.reset(seed=1)
    cut = False
    for _ in range(150):
        action = policy(observation)
        before = potential(environment, observation)
        observation, reward, terminated, _, _ = environment.step(action)
        if terminated.any():
            break
        costs = 0.02 + 0.02 * observation[:, -3] + 0.001 * (action**2).sum(1)
        np.testing.assert_allclose(reward, potential(environment, observation) - before - costs, atol=0.01)
        cut = cut or bool(is_off(environment).any())
    assert cut


def test_what_is_seen_in_the_hand_is_what_is_seen_in_the_world(environment: Any) -> None:
    observation, _ = environment.reset(seed=1)
    for _ in range(30):
        observation = environment.step(Picking()(observation))[0]
    bodies = environment.unwrapped.worlds.bodies
    axes = bodies.data.xmat.numpy()[:, bodies.rigid.robot("arm").bodies[TOOL_LINK]]
    np.testing.assert_allclose(np.einsum("wij,wj->wi", axes, observation[:, IN_HAND]), observation[:, STALK], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(observation[:, AXIS], axis=1), 1.0, atol=1e-5)
    below = observation[:, 18:21] - observation[:, STALK]
    along = np.einsum("wij,wj->wi", axes, observation[:, AXIS])
    assert (np.einsum("wi,wi->w", along, below) > 0.9 * np.linalg.norm(below, axis=1)).all(), "towards the bunch"


def test_episodes_of_a_training_begin_on_the_way_to_the_stalks() -> None:
    """Half of those of 64 worlds; the others, and all of an evaluation, begin with the arm's first positions."""
    home = HOME[:7]
    env = PickEnv(64, vines=4, on_way=0.5)
    observation, _ = env.reset(seed=1)
    wanted = observation[:, -2:].argmax(1)
    models = [Pick.plants(np.random.default_rng([0, number]), Variation()) for number in range(4)]
    goals = np.array([Pick.goals(models[world % 4])[wanted[world]] for world in range(64)])
    way = goals - home
    shares = ((observation[:, :7] - home) * way).sum(1) / np.maximum((way * way).sum(1), 1e-9)
    np.testing.assert_allclose(observation[:, :7], home + shares[:, None] * way, atol=1e-5)
    np.testing.assert_allclose(env.worlds.bodies.targets.numpy()[:, :7], observation[:, :7], atol=1e-6)
    began = shares[shares > 1e-6]
    assert 20 < len(began) < 44
    assert began.min() < 0.2
    assert 0.8 < began.max() <= 1.0
    assert (PickEnv(4).reset(seed=1)[0][:, :7] == home.astype(np.float32)).all()


def test_at_a_goal_the_upright_hand_is_in_front_of_the_stalk() -> None:
    """The poses of plants at rest are those of an episode that begins. A stalk out of reach has no goal."""
    model = Pick.plants(np.random.default_rng([0, 0]), Variation())
    arm = ArmKinematics(model, Pick.robot())
    poses = model.forward_kinematics(State.at_rest(model).joint_q)
    goals = Pick.goals(model)
    for goal, stalk in zip(goals, poses[model.body_parent[model.bunch_body], :3], strict=True):
        away = stalk - arm.point(goal)
        np.testing.assert_allclose(away, IN_FRONT * arm.ahead(goal, stalk), atol=0.01)
    assert arm.solve(HOME[:7], np.array([5.0, 0.0, 1.0])) is None


def test_the_blade_closes_after_five_commands_in_a_row(environment: Any) -> None:
    environment.reset(seed=1)
    closing = environment.unwrapped.task.arrays.closing
    needed = environment.unwrapped.worlds.pool.needed
    needed.fill_(-1.0)  # a closing writes the force that it took
    for k, command in enumerate([1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0]):
        action = np.zeros((2, 9), np.float32)
        action[0, BLADE] = command
        observation = environment.step(action)[0]
        assert (needed.numpy()[0] >= 0.0) == (k == 9)
        assert needed.numpy()[1] == -1.0
        expected = 0.0 if k in (4, 9) else 0.2 * (k + 1 if k < 4 else k - 4)
        np.testing.assert_allclose(observation[:, COMMANDED], [expected, 0.0], atol=1e-6)
    assert not closing.numpy().any()


def test_a_hand_that_knows_the_stalks_picks_both_bunches(environment: Any) -> None:
    cut_at, succeeded_at = pick(environment, seed=1)
    assert (cut_at >= 0).all()
    assert (succeeded_at >= cut_at + 4).all()


def test_it_picks_most_bunches_of_twelve_worlds() -> None:
    """The other bunches are out of the reach of a hand that is upright, or their canes are in the blade's mouth."""
    env = gymnasium.make_vec("vinesim/Pick-v0", num_envs=12)
    picked = [int((pick(env, seed)[1] >= 0).sum()) for seed in (1, 2)]
    assert min(picked) >= 9


def test_a_bunch_that_is_cut_but_not_held_is_no_success(environment: Any) -> None:
    """The hand waits open around the stalk and cuts: the bunch falls, and its stalk goes away from the fingers."""
    observation, _ = environment.reset(seed=1)
    ahead = directions(environment, observation)
    over = np.zeros(2, bool)
    for _ in range(110):
        ways = observation[:, STALK] + 0.01 * ahead
        hangs = ~is_off(environment)
        action = np.zeros((2, 9), np.float32)
        action[:, :7] = np.where(hangs[:, None], towards(environment, ways, 8.0, ahead), 0.0)
        action[:, 7] = -0.5
        action[:, 8] = np.linalg.norm(ways, axis=1) < 0.015
        observation, reward, terminated, _, info = environment.step(action)
        assert not info["success"].any()
        for world in np.flatnonzero(terminated & ~over):
            last = info["final_obs"][world]
            assert np.linalg.norm(last[STALK]) > 0.2
            assert reward[world] < -2.0
            over[world] = True
        if over.all():
            break
    assert over.all()


def test_equal_seeds_and_actions_give_equal_episodes_to_the_bit(environment: Any) -> None:
    def episode() -> list[np.ndarray]:
        rng = np.random.default_rng(3)
        seen = [environment.reset(seed=7)[0]]
        for _ in range(10):
            seen += environment.step(rng.uniform(-1.0, 1.0, (2, 9)).astype(np.float32))[:2]
        return seen

    for one, other in zip(episode(), episode(), strict=True):
        np.testing.assert_array_equal(one, other)
