"""Actors come and go in mid-motion: nobody else feels it, not by a bit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.support.contact_scenes import bar, cane, grasp, gripper
from vinesim import frames
from vinesim.physics.step import Physics
from vinesim.scene.builder import assemble
from vinesim.scene.values import RobotSpec

TICKS = 260
BOXES = {
    "box_pose": [[3.0, 0.0, 0.0, 0, 0, 0, 1], [3.0, 0.0, 0.301, 0, 0, 0, 1], [5.0, 0.0, 1.8, 0.1, 0.2, 0.0, 0.97]],
    "box_size": [[0.6, 0.4, 0.3]] * 3,
    "box_mass": [[2.0]] * 3,
}
"""Two stacked, one that falls."""


def busy(*first: RobotSpec) -> Physics:
    """A hand grasps a bunch on its vine, a bar moves, four bunches fall into the upper of two boxes.

    ``first`` come before the others.
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


def numbers(physics: Physics) -> dict[str, bytes]:
    """Every number that the next tick starts from, by the name of what it belongs to."""
    world, data = physics.rigid.mj_model, physics.rigid.mj_data
    found = {"plants": physics.state.joint_q.tobytes() + physics.state.joint_qd.tobytes()}
    for i in range(world.njnt):
        joint = world.joint(i)
        first, last = world.jnt_dofadr[i], world.jnt_dofadr[i] + len(data.joint(i).qvel)
        q = data.joint(i)
        found[joint.name] = b"".join(
            np.ascontiguousarray(x).tobytes()
            for x in (q.qpos, q.qvel, data.qacc[first:last], data.qacc_warmstart[first:last])
        )
    warm_start = physics.contact_solver.impulses.warm_start
    n = int(warm_start.count[0])
    found["memory"] = warm_start.normal_impulse[:n].tobytes() + warm_start.anchor[:n].tobytes()
    found["contacts"] = b"".join(c.force.tobytes() for c in physics.contacts)
    parked = {f"free_bunch/{slot}" for slot in range(physics.rigid._pool_size)} - {
        f"free_bunch/{slot}" for slot in physics.rigid._bunch_slot.values()
    }
    return {k: v for k, v in found.items() if k not in parked and not k.startswith("newcomer")}


def story(events: dict[int, Callable[[Physics], None]]) -> list[dict[str, bytes]]:
    physics = busy()
    told = []
    for tick in range(TICKS):
        if tick in events:
            events[tick](physics)
            if told:
                assert numbers(physics) == told[-1], f"not the same right after tick {tick}"
        command(physics, tick)
        physics.step()
        told.append(numbers(physics))
    return told


def differences(one: list[dict[str, bytes]], other: list[dict[str, bytes]]) -> list[tuple[int, str]]:
    return [
        (tick, name) for tick, (a, b) in enumerate(zip(one, other, strict=True)) for name in a if a[name] != b[name]
    ]


@pytest.fixture(scope="module")
def undisturbed() -> list[dict[str, bytes]]:
    return story({})


def test_a_robot_that_comes_and_goes_changes_no_bit_of_anybody(undisturbed):
    """A grasp, bunches that settle in a box, a box that tumbles and the contacts' memory, tick by tick."""
    far = bar((30.0, 30.0, 1.0), "newcomer", 1000.0, 100.0)
    visited = story({120: lambda p: p.add_robot(far), 200: lambda p: p.remove_robot("newcomer")})
    assert differences(undisturbed, visited) == []


def test_who_came_first_leaves_and_the_others_numbers_move_up():
    """The sweeper is done and gone: what lies in MuJoCo's arrays behind it goes on as if it had stayed out of reach."""
    early = bar((30.0, 30.0, 1.0), "newcomer", 1000.0, 100.0)

    def story_of(leaves: int) -> list[dict[str, bytes]]:
        physics, told = busy(early), []
        for tick in range(TICKS):
            if tick == leaves:
                physics.remove_robot("newcomer")
            command(physics, tick)
            physics.step()
            told.append(numbers(physics))
        return told

    assert differences(story_of(-1), story_of(120)) == []
    assert differences(story_of(70), story_of(200)) == []


def test_what_sleeps_goes_on_sleeping_and_wakes_with_what_it_leans_on():
    """A newcomer wakes neither stacked boxes nor bunches; a bunch that is taken away wakes those that lay on it."""
    physics = busy()
    for _ in range(900):
        physics.step()
    rigid = physics.rigid
    lie = ["box/0", "box/1", *(f"free_bunch/{slot}" for slot in rigid._bunch_slot.values())]

    def sleeping() -> list[bool]:
        trees = [rigid.mj_model.body_treeid[rigid.mj_model.body(name).id] for name in lie]
        return (rigid.mj_data.tree_asleep[trees] >= 0).tolist()

    assert all(sleeping())
    before = [rigid.mj_data.joint(name).qpos.copy() for name in lie]
    physics.add_robot(bar((30.0, 30.0, 1.0), "newcomer", 1000.0, 100.0))
    assert all(sleeping())
    for _ in range(50):
        physics.step()
    assert all(sleeping())
    for name, pose in zip(lie, before, strict=True):
        np.testing.assert_array_equal(rigid.mj_data.joint(name).qpos, pose)
    deepest = min(rigid.free_bunches, key=lambda bunch: rigid.bunch_pose(bunch)[2])
    gone = lie.index(f"free_bunch/{rigid._bunch_slot[deepest]}")
    physics.rigid.remove_bunch(deepest)
    del lie[gone]
    assert not any(sleeping()), "all leaned on each other"
    physics.step()
    assert np.isfinite(rigid.mj_data.qpos).all()


def test_a_dozen_robots_join():
    """MuJoCo tries a step when it compiles, with all bases at the origin: that must not count as a pile-up."""
    physics = busy()
    for i in range(12):
        physics.add_robot(bar((20.0 + i, 30.0, 1.0), f"newcomer{i}", 1000.0, 100.0))
    physics.step()
    assert len(physics.rigid.robots) == 14
    assert physics.rigid.faults == 0
