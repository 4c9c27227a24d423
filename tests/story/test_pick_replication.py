"""The picking task replicated to a second client: the bunch is in the same box there, with its weight."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from tests.support.contact_forces import pressed_on_ground
from vinesim.client.client import Client
from vinesim.client.tasks import planning, start_poses
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.robot.tasks.pick import PickBunch
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.spec import load_scene as load_scene
from vinesim.scene.spec import with_seed

pytestmark = pytest.mark.slow

DT = 0.01
GRAVITY = 9.81


@pytest.mark.long
def test_a_picked_bunch_is_in_the_box_with_its_weight_on_the_other_client():
    now = [100.0]
    scene = with_seed(load_scene("harvest"), 7)
    model = generate(scene)
    vinebot = load_description("vinebot")
    hub = MemoryHub(delay=0.02, jitter=0.005, seed=2)
    task = next(planning.plan_picks(model, start_poses.spawn_pose(scene, 0)[:2]))
    box = object_id(ObjectKind.BOX, task.box)
    visitor_xy = model.box_pose[task.box, :2] + [0.0, 1.6]
    worker, visitor = (
        Client(scene, model, vinebot, hub.bus(name), name=name, pose=pose, clock=lambda: now[0])
        for name, pose in (("worker", task.base_pose), ("visitor", frames.pose([*visitor_xy, 0.0])))
    )
    # without sleep, so that MuJoCo computes the forces of resting bodies, too
    visitor.physics.rigid.mj_model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)

    def run(ticks: int = 1) -> None:
        for _ in range(ticks):
            worker.tick()
            visitor.tick()
            hub.advance(DT)
            now[0] += DT

    run(100)
    empty = float(model.box_mass[task.box]) * GRAVITY
    pick = PickBunch(worker.physics, worker.robot, task)
    worker.pre_step.append(pick.control)
    bunch = object_id(ObjectKind.BUNCH, task.bunch)
    position_errors = []
    while not pick.is_done:
        run()
        cut = not worker.physics.state.bunch_attached[task.bunch]
        if cut and visitor.replicator.owner(bunch) == "worker":
            here, there = (client.physics.support_tracker.object_state(bunch)[0] for client in (worker, visitor))
            position_errors.append(float(np.linalg.norm(here[:3] - there[:3])))
    assert pick.picked, pick.reason
    run(300)
    assert not visitor.physics.state.bunch_attached[task.bunch]
    assert visitor.physics.state.bunch_attached.sum() == len(model.bunch_body) - 1
    here, there = (
        frames.compose(frames.inverse(tracker.object_state(box)[0]), tracker.object_state(bunch)[0])
        for tracker in (worker.physics.support_tracker, visitor.physics.support_tracker)
    )
    assert np.linalg.norm(here[:3] - there[:3]) < 5e-3
    assert visitor.physics.support_tracker.pose_on_support(bunch)[0] == f"box/{task.box}"
    world = visitor.physics.rigid.mj_model
    world.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    visitor.physics.support_tracker.set_state(
        bunch, visitor.physics.support_tracker.object_state(bunch)[0], np.zeros(6)
    )
    run(100)
    weight = np.mean([(run(), pressed_on_ground(visitor.physics, task.box))[1] for _ in range(50)]) - empty
    assert weight == pytest.approx(float(model.body_mass[model.bunch_body[task.bunch]]) * GRAVITY, rel=0.03)
    counters = worker.replicator.counters
    families = counters.environment, counters.event, counters.retained
    assert sum(family.bytes_out for family in families) < 100e3
    assert max(position_errors) < 0.03
    for _ in range(20):  # until the vine that was let go hangs still
        if len(worker.physics.plants.awake) == 0:
            break
        run(100)
    sent = [family.bytes_out for family in families]
    run(200)
    assert [family.bytes_out for family in families] == sent
