"""Actors that join and leave in mid-motion change no bit of the others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.support.contact_scenes import bar, cane, grasp, gripper
from vinesim.core import frames
from vinesim.scene.builder import assemble
from vinesim.scene.values import RobotSpec
from vinesim.world import Physics

pytestmark = pytest.mark.slow

TICKS = 260
BOXES = {
    "box_pose": [[3.0, 0.0, 0.0, 0, 0, 0, 1], [3.0, 0.0, 0.301, 0, 0, 0, 1], [5.0, 0.0, 1.8, 0.1, 0.2, 0.0, 0.97]],
    "box_size": [[0.6, 0.4, 0.3]] * 3,
    "box_mass": [[2.0]] * 3,
}
"""Two stacked boxes and one that falls."""


def busy_scene(*first: RobotSpec) -> Physics:
    """A gripper grasps a hanging bunch, a bar moves, four bunches fall into the upper of two boxes.

    Robots in ``first`` are added before the others.
    """
    trees = [cane((0.0, 0.0, 2.0), bunch=0.5), *(cane((0.0, 5.0 + i, 2.0), bunch=0.4) for i in range(4))]
    model = assemble(trees, **BOXES)
    physics = Physics(model, detachment=False)
    pose = model.forward_kinematics(model.joint_settled)[model.bunch_body[0]]
    for spec in first:
        physics.add_robot(spec)
    physics.add_robot(gripper(pose[:3] + frames.rotate(pose[3:], np.array([0.085, 0.0, 0.0]))))
    physics.add_robot(bar((2.0, -0.6, 0.2), "sweeper", 4000.0, 300.0))
    rng = np.random.default_rng(2)
    for bunch in range(1, 5):
        physics.pick(bunch)
        turn = frames.normalize(rng.normal(size=4))
        at = np.array([2.7 + 0.1 * bunch, 0.0, 0.8 + 0.25 * bunch])
        physics.rigid.place_bunch(bunch, frames.pose(at, turn), np.zeros(6))
    return physics


def command(physics: Physics, tick: int) -> None:
    physics.rigid.command("grip", grasp(0.01 * tick)[0])
    physics.rigid.command("sweeper", np.array([0.004 * tick]), np.array([0.4]))


def state_of(physics: Physics) -> dict[str, bytes]:
    """The state from which the next step starts, by the name of joint or array."""
    world = physics.rigid.mj_model
    data = physics.rigid.mj_data
    found = {"plants": physics.state.joint_q.tobytes() + physics.state.joint_qd.tobytes()}
    for i in range(world.njnt):
        joint = world.joint(i)
        first = world.jnt_dofadr[i]
        last = world.jnt_dofadr[i] + len(data.joint(i).qvel)
        q = data.joint(i)
        found[joint.name] = b"".join(
            np.ascontiguousarray(x).tobytes()
            for x in (q.qpos, q.qvel, data.qacc[first:last], data.qacc_warmstart[first:last])
        )
    warm_start = physics.contact_solver.impulses.warm_start
    n = int(warm_start.count[0])
    found["warm start"] = warm_start.normal_impulse[:n].tobytes() + warm_start.anchor[:n].tobytes()
    found["contacts"] = b"".join(c.force.tobytes() for c in physics.contacts)
    parked = {f"free_bunch/{slot}" for slot in range(physics.rigid._pool_size)} - {
        f"free_bunch/{slot}" for slot in physics.rigid._bunch_slot.values()
    }
    return {k: v for k, v in found.items() if k not in parked and not k.startswith("newcomer")}


def run_with_events(events: dict[int, Callable[[Physics], None]]) -> list[dict[str, bytes]]:
    physics = busy_scene()
    states = []
    for tick in range(TICKS):
        if tick in events:
            events[tick](physics)
            if states:
                assert state_of(physics) == states[-1], f"the state changed right after tick {tick}"
        command(physics, tick)
        physics.step()
        states.append(state_of(physics))
    return states


def differences(one: list[dict[str, bytes]], other: list[dict[str, bytes]]) -> list[tuple[int, str]]:
    return [
        (tick, name) for tick, (a, b) in enumerate(zip(one, other, strict=True)) for name in a if a[name] != b[name]
    ]


@pytest.fixture(scope="module")
def undisturbed() -> list[dict[str, bytes]]:
    return run_with_events({})


def test_a_robot_that_joins_and_leaves_changes_no_bit_of_the_others(undisturbed):
    """A grasp, bunches that settle in a box, a box that tumbles and the contacts' warm start, tick by tick."""
    distant = bar((30.0, 30.0, 1.0), "newcomer", 1000.0, 100.0)
    disturbed = run_with_events({120: lambda p: p.add_robot(distant), 200: lambda p: p.remove_robot("newcomer")})
    assert differences(undisturbed, disturbed) == []


@pytest.mark.long
def test_removing_the_first_robot_changes_no_bit_of_the_others():
    """Bodies behind a removed robot in MuJoCo's arrays continue as if it had stayed, far away."""
    distant = bar((30.0, 30.0, 1.0), "newcomer", 1000.0, 100.0)

    def run_until(leaves: int) -> list[dict[str, bytes]]:
        physics = busy_scene(distant)
        states = []
        for tick in range(TICKS):
            if tick == leaves:
                physics.remove_robot("newcomer")
            command(physics, tick)
            physics.step()
            states.append(state_of(physics))
        return states

    assert differences(run_until(-1), run_until(120)) == []
    assert differences(run_until(70), run_until(200)) == []


def test_sleeping_bodies_sleep_until_a_body_in_contact_is_removed():
    """A new robot wakes neither stacked boxes nor bunches; removing a bunch wakes those in contact with it."""
    physics = busy_scene()
    for _ in range(900):
        physics.step()
    rigid = physics.rigid
    names = ["box/0", "box/1", *(f"free_bunch/{slot}" for slot in rigid._bunch_slot.values())]

    def sleeping() -> list[bool]:
        trees = [rigid.mj_model.body_treeid[rigid.mj_model.body(name).id] for name in names]
        return (rigid.mj_data.tree_asleep[trees] >= 0).tolist()

    assert all(sleeping())
    before = [rigid.mj_data.joint(name).qpos.copy() for name in names]
    physics.add_robot(bar((30.0, 30.0, 1.0), "newcomer", 1000.0, 100.0))
    assert all(sleeping())
    for _ in range(50):
        physics.step()
    assert all(sleeping())
    for name, pose in zip(names, before, strict=True):
        np.testing.assert_array_equal(rigid.mj_data.joint(name).qpos, pose)
    lowest = min(rigid.free_bunches, key=lambda bunch: rigid.bunch_pose(bunch)[2])
    index = names.index(f"free_bunch/{rigid._bunch_slot[lowest]}")
    physics.rigid.remove_bunch(lowest)
    del names[index]
    assert not any(sleeping()), "all bodies were in contact"
    physics.step()
    assert np.isfinite(rigid.mj_data.qpos).all()


def test_twelve_robots_join():
    """MuJoCo steps once when it compiles, with all bases at the origin: this must not count as a fault."""
    physics = busy_scene()
    for i in range(12):
        physics.add_robot(bar((20.0 + i, 30.0, 1.0), f"newcomer{i}", 1000.0, 100.0))
    physics.step()
    assert len(physics.rigid.robots) == 14
    assert physics.rigid.faults == 0
