"""Boxes and bunches over the network (D6.4, section 5.1): whole clients with cart robots on a bus in memory."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.support.shared_vineyard import (
    BOX,
    BUNCH,
    DT,
    World,
    bytes_received,
    bytes_sent,
    pose_of,
    position_difference,
    put,
    vineyard,
)
from vinesim.client.client import Client
from vinesim.core import frames
from vinesim.rigid.human_posture import standing_pose
from vinesim.scene.ids import ObjectKind, Organ, parse_object_name
from vinesim.scene.values import HumanPose

pytestmark = pytest.mark.slow


def drive(client: Client, speed: float) -> None:
    client.pre_step[:] = [lambda time: client.robot.command_base(speed, 0.0, time)]


def command_hand(client: Client, lift: float, fingers: float) -> None:
    client.robot.command_position(np.array([lift, fingers, fingers]))


def two_clients(*others: tuple[float, float]) -> tuple[World, Client, Client]:
    world = World()
    ada = world.join("ada", *(others[0] if others else (0.25, 0.0)))
    bob = world.join("bob", *(others[1] if len(others) > 1 else (1.0, -2.0)))
    world.until(lambda: "ada" in bob.remote_actors and "bob" in ada.remote_actors, 1.0)
    return world, ada, bob


def at_rest(world: World) -> bool:
    return not any(client.objects.moving or client.replicator.owned for client in world.clients.values())


def fill_box(client: Client, box: int = 0) -> None:
    """Pick two bunches and place them side by side in a box."""
    for bunch in range(2):
        there = frames.compose(pose_of(client, BOX(box)), frames.pose([-0.1, 0.12 * bunch - 0.06, 0.06]))
        client.physics.pick(bunch)
        client.physics.rigid.place_bunch(bunch, there, np.zeros(6))


def test_a_free_bunch_is_sent_until_it_rests_and_again_when_gripped():
    """F76, F77."""
    world, ada, bob = two_clients()
    ada.physics.pick(0)
    world.run(0.1)
    assert not bob.physics.state.bunch_attached[0], "the bunch is detached on every client"
    worst = 0.0
    while not at_rest(world):
        world.run(0.05)
        assert bob.replicator.owner(BUNCH(0)) in ("ada", None)
        worst = max(worst, position_difference(ada, bob, BUNCH(0)))
        assert world.now < 110.0
    # it falls at 4 m/s and arrives 25 ms late
    assert worst < 0.10
    world.run(0.2)
    assert position_difference(ada, bob, BUNCH(0)) < 1e-3
    assert ada.physics.support_tracker.pose_on_support(BUNCH(0))[0] == ""
    before = bytes_sent(ada), bytes_sent(bob)
    world.run(1.0)
    assert (bytes_sent(ada), bytes_sent(bob)) == before
    # lower the hand, close it, raise it
    ground_height = pose_of(ada, BUNCH(0))[2]
    down = ground_height - 0.09 - 1.0
    for lift, fingers, seconds in ((down, 0.0, 0.8), (down, 0.07, 0.5), (down + 0.2, 0.07, 0.3)):
        command_hand(ada, lift, fingers)
        world.run(seconds)
    assert (bytes_sent(ada), bytes_sent(bob)) > before
    assert ada.replicator.owner(BUNCH(0)) == bob.replicator.owner(BUNCH(0)) == "ada"
    world.run(0.6)
    assert pose_of(bob, BUNCH(0))[2] > ground_height + 0.15
    assert position_difference(ada, bob, BUNCH(0)) < 0.01
    # held still, it is at rest in the hand
    world.until(lambda: at_rest(world), 3.0)
    parent, _ = ada.physics.support_tracker.pose_on_support(BUNCH(0))
    assert parent in ("ada/left", "ada/right")
    assert bob.physics.support_tracker.pose_on_support(BUNCH(0))[0] == parent
    # put down, it stays on the ground when the hand rises, although a record named the hand as its support
    for lift, fingers, seconds in ((down, 0.07, 0.8), (down, 0.0, 0.5), (down + 0.5, 0.0, 0.5)):
        command_hand(ada, lift, fingers)
        world.run(seconds)
    world.until(lambda: at_rest(world), 5.0)
    world.run(0.1)
    assert (
        ada.physics.support_tracker.pose_on_support(BUNCH(0))[0]
        == bob.physics.support_tracker.pose_on_support(BUNCH(0))[0]
        == ""
    )
    assert pose_of(ada, BUNCH(0))[2] < ground_height + 0.05
    assert position_difference(ada, bob, BUNCH(0)) < 1e-3


def test_a_pushed_box_with_bunches_is_one_stream():
    """F78, F79."""
    world, ada, bob = two_clients((-2.75, 0.0), (-2.0, -2.0))
    fill_box(ada)
    world.until(lambda: at_rest(world), 5.0)
    world.run(0.2)
    for bunch in range(2):
        assert bob.physics.support_tracker.pose_on_support(BUNCH(bunch))[0] == "box/0"
        assert position_difference(ada, bob, BUNCH(bunch)) < 1e-3
    before = bytes_sent(ada)
    world.run(0.5)
    assert bytes_sent(ada) == before
    start = pose_of(ada, BOX(0))[0]
    owners_seen = []
    drive(ada, 0.12)
    before_pushing = ada.replicator.counters.environment.bytes_out, ada.replicator.counters.environment.messages_out
    while pose_of(ada, BOX(0))[0] < start + 0.15:
        world.run(0.05)
        owners_seen.append([bob.replicator.owner(number) for number in (BOX(0), BUNCH(0), BUNCH(1))])
        assert position_difference(ada, bob, BOX(0)) < 0.015
        assert max(position_difference(ada, bob, BUNCH(bunch)) for bunch in range(2)) < 0.06
    assert {owner for owner, *_ in owners_seen} == {"ada", None}
    assert {owner for _, *owners in owners_seen for owner in owners} == {None}
    counters = ada.replicator.counters.environment
    size = counters.bytes_out - before_pushing[0]
    messages = counters.messages_out - before_pushing[1]
    assert size == messages * (14 + 26), "one record a message: the box"
    drive(ada, -0.2)
    world.until(lambda: at_rest(world), 4.0)
    world.run(0.2)
    for number in (BOX(0), BUNCH(0), BUNCH(1)):
        assert position_difference(ada, bob, number) < 1e-3


@pytest.mark.parametrize("height", [0.6, 0.8, 1.0])
def test_a_bunch_dropped_into_a_box_that_nobody_has_moved_lies_in_it_on_all_clients(height):
    """The copy of the bunch hits the box before the other client hears that the bunch has stopped. It must not throw
    the box, because nobody would send the box's pose."""
    world, ada, bob = two_clients((-2.75, 1.0), (-2.0, -2.0))
    world.until(lambda: at_rest(world), 3.0)
    box = pose_of(bob, BOX(0))
    upright = frames.exp(np.array([0.0, 0.5 * np.pi, 0.0]))
    ada.physics.pick(0)
    ada.physics.rigid.place_bunch(0, frames.compose(box, frames.pose([0.02, 0.01, height], upright)), np.zeros(6))
    world.run(0.1)
    moved = 0.0
    while not at_rest(world):
        world.run(DT)
        moved = max(moved, float(np.linalg.norm((pose_of(bob, BOX(0)) - box)[:3])))
        assert world.now < 110.0
    assert moved < 0.002
    assert bob.physics.support_tracker.pose_on_support(BUNCH(0))[0] == "box/0"
    for number in (BOX(0), BUNCH(0)):
        assert position_difference(ada, bob, number) < 1e-3


def test_a_box_on_a_driving_robot_costs_a_record_every_3_m_and_follows_it():
    """F80."""
    world, ada, bob = two_clients((-1.0, -1.0), (1.0, -3.0))
    deck = frames.compose(ada.physics.rigid.base_state("ada")[0], frames.pose([0.0, 0.0, 0.253]))
    put(ada, BOX(1), deck)
    world.until(lambda: ada.physics.support_tracker.moving, 1.0)
    world.until(lambda: at_rest(world), 3.0)
    world.run(0.2)
    assert (
        bob.physics.support_tracker.pose_on_support(BOX(1))[0]
        == ada.physics.support_tracker.pose_on_support(BOX(1))[0]
        == "ada/base_footprint"
    )
    before = bytes_sent(ada), bytes_sent(bob)
    records = ada.replicator.counters.retained.bytes_out, ada.replicator.counters.retained.messages_out
    start = pose_of(ada, BOX(1))[0]
    drive(ada, 1.0)
    while pose_of(ada, BOX(1))[0] < start + 10.0:
        world.run(0.25)
        # the copy of the robot lags by its speed times the delay, as does the box on it
        assert position_difference(ada, bob, BOX(1)) < 0.12
        assert world.now < 120.0
    drive(ada, 0.0)
    world.run(1.0)
    assert position_difference(ada, bob, BOX(1)) < 0.02
    assert bytes_sent(bob) == before[1]
    assert bytes_sent(ada) - before[0] == ada.replicator.counters.retained.bytes_out - records[0], "no states"
    assert ada.replicator.counters.retained.messages_out - records[1] == 3
    assert ada.replicator.counters.retained.bytes_out - records[0] < 3 * 200
    # a box taken off the robot is at its new pose, not on its recorded support; ada is the author of that record
    beside = frames.compose(ada.physics.rigid.base_state("ada")[0], frames.pose([0.0, 1.0, 0.001]))
    ada.physics.support_tracker.set_state(BOX(1), beside, np.zeros(6))
    world.run(0.1)
    world.until(lambda: at_rest(world), 3.0)
    world.run(0.2)
    np.testing.assert_allclose(pose_of(ada, BOX(1))[:3], beside[:3], atol=0.01)
    assert world.server.records.get(BOX(1)).author == "ada"
    assert position_difference(ada, bob, BOX(1)) < 1e-3


@pytest.mark.parametrize("is_near", [True, False])
def test_motion_of_a_hanging_bunch_is_replicated_only_nearby(is_near):
    """F73, F74, F75."""
    world, ada, bob = two_clients((0.25, 0.0), (1.0, -2.0) if is_near else (1.0, -20.0))
    before = [bob.physics.state.body_q[bob.model.bodies_of(tree)].tobytes() for tree in range(2)]
    body = ada.model.bunch_body[0]
    for fingers in (0.0, 0.07):  # raised first: a hand that closes on its way up would toss the bunch
        command_hand(ada, 0.2, fingers)
        world.run(0.4)
    drive(ada, 0.1)
    world.run(0.8)
    for client in (ada, bob):
        client.physics.update_kinematics()
    here, there, rest = (
        frames.compose(q[body].astype(float), frames.pose([0.1, 0.0, 0.0]))[:3]
        for q in (
            ada.physics.state.body_q,
            bob.physics.state.body_q,
            ada.model.forward_kinematics(ada.model.joint_settled),
        )
    )
    assert np.linalg.norm(here - rest) > 0.05
    if is_near:
        assert np.linalg.norm(here - there) < 0.006
        assert bytes_received(bob) > 0
    else:
        assert bytes_received(bob) == bytes_sent(ada) == 0
        assert bob.physics.state.body_q[bob.model.bodies_of(0)].tobytes() == before[0]
    # an untouched tree is bitwise unchanged
    assert bob.physics.state.body_q[bob.model.bodies_of(1)].tobytes() == before[1]
    assert bob.physics.state.bunch_attached.all()


@pytest.mark.long
def test_a_bunch_cut_by_two_in_one_tick_has_one_owner():
    world, ada, bob = two_clients()
    for client in (ada, bob):
        client.physics.pick(0)
    world.run(0.1)
    assert ada.replicator.owner(BUNCH(0)) == bob.replicator.owner(BUNCH(0)) == "ada"
    world.until(lambda: at_rest(world), 5.0)
    world.run(0.2)
    assert position_difference(ada, bob, BUNCH(0)) < 1e-3
    assert [client.physics.rigid.free_bunches for client in (ada, bob)] == [(0,), (0,)]
    assert len([record for _, record in world.server.records if record.object == BUNCH(0)]) == 1


@pytest.mark.long
def test_a_cut_cane_falls_on_every_client_nearby_to_the_same_pose():
    world, ada, bob = two_clients()
    body = int(ada.model.tree_first[1]) + 8
    ada.physics.cut(body)
    world.run(0.3)
    assert bob.physics.state.body_cut[body]
    for client in (ada, bob):
        client.physics.update_kinematics()
    falling = ada.physics.state.body_q[body, 2]
    assert falling < 1.2
    assert abs(bob.physics.state.body_q[body, 2] - falling) < 0.12
    world.until(lambda: ada.replicator.owner(1) is None and bob.replicator.owner(1) is None, 12.0)
    for client in (ada, bob):
        client.physics.update_kinematics()
    here = ada.model.bodies_of(1)
    assert np.abs(ada.physics.state.body_q[here] - bob.physics.state.body_q[here])[:, :3].max() < 5e-3
    record = world.server.records.get(1)
    assert record is not None
    assert record.cut == (body,)

    def is_kept_at_rest() -> bool:  # the server may be told a little later
        kept = world.server.records.get(1)
        return kept is not None and not kept.moving

    world.until(is_kept_at_rest, 1.0)


def test_every_kind_of_moving_object_is_replicated():
    """F67: every visual that moves belongs to an actor or has an object id for replication."""
    world, ada, bob = two_clients()
    ada.physics.pick(1)
    world.run(0.2)
    snapshot = ada.physics.snapshot()
    object_ids = {link.organ: parse_object_name(link.name) for link in snapshot.visuals}
    assert {organ for organ, number in object_ids.items() if number is not None} == {Organ.BOX, Organ.BUNCH}
    assert {organ for organ, number in object_ids.items() if number is None} <= {Organ.ROBOT, Organ.HUMAN}
    assert {link.name.partition("/")[0] for link in snapshot.visuals if parse_object_name(link.name) is None} == {
        "ada",
        "bob",
    }
    assert bob.replicator.peers.keys() == {"ada"}
    assert {ObjectKind(number >> 24) for number in ada.replicator.owned} == {ObjectKind.BUNCH, ObjectKind.TREE}
    assert set(ObjectKind) == {ObjectKind.TREE, ObjectKind.BUNCH, ObjectKind.BOX}


@pytest.mark.long
def test_two_runs_are_bitwise_equal():
    def scenario() -> bytes:
        world, ada, bob = two_clients()
        ada.physics.pick(0)
        world.run(0.8)
        bob.physics.cut(int(ada.model.tree_first[1]) + 8)
        world.run(0.4)
        return b"".join(client.physics.rigid.mj_data.qpos.tobytes() for client in (ada, bob))

    assert scenario() == scenario()


# ---------------------------------------------------------------- late joiners, restarts and leaving


def test_a_late_joiner_receives_the_state_left_by_others():
    """F09: bunches picked into a box that is pushed, a cane cut; then all clients leave and one joins."""
    world, ada, bob = two_clients((-2.75, 0.0), (-2.0, -2.0))
    fill_box(ada)
    bob.physics.cut(int(ada.model.tree_first[1]) + 8)
    world.until(lambda: at_rest(world), 12.0)
    drive(ada, 0.3)
    world.run(0.6)
    drive(ada, -0.3)
    world.until(lambda: at_rest(world), 4.0)
    world.run(0.3)
    for name in ("ada", "bob"):
        world.leave(name)
    cy = world.join("cy", -2.0, 1.5)
    world.until(lambda: not cy.physics.state.bunch_attached.any(), 0.2)
    assert len(cy.physics.dormant_bunches) == 2, "no rigid body is created at once"
    world.run(0.5)
    assert sorted(cy.physics.rigid.free_bunches) == [0, 1], "a bunch near the actor gets one"
    np.testing.assert_allclose(pose_of(cy, BOX(0)), pose_of(ada, BOX(0)), atol=1e-3)
    for bunch in range(2):
        np.testing.assert_allclose(pose_of(cy, BUNCH(bunch)), pose_of(ada, BUNCH(bunch)), atol=5e-3)
        assert cy.physics.support_tracker.pose_on_support(BUNCH(bunch))[0] == "box/0"
    assert cy.physics.state.body_cut.tolist() == ada.physics.state.body_cut.tolist()
    ada.physics.update_kinematics()
    cy.physics.update_kinematics()
    difference = cy.physics.state.body_q[:, :3] - ada.physics.state.body_q[:, :3]
    assert np.linalg.norm(difference, axis=1).max() < 0.01
    assert bytes_sent(cy) == 0, "the late joiner sends nothing"


def test_records_are_sent_again_to_a_restarted_server():
    world, ada, bob = two_clients()
    ada.physics.pick(0)
    world.until(lambda: at_rest(world), 5.0)
    world.run(0.2)
    records = list(world.server.records)
    assert [record.object for _, record in records] == [0, BUNCH(0)]
    world.hub.down = True
    world.run(0.3)
    world.server.records = type(world.server.records)()
    world.hub.down = False
    world.run(0.3)
    assert list(world.server.records) == records
    assert not bob.physics.state.bunch_attached[0]
    before = bytes_sent(ada), bytes_sent(bob)
    world.run(1.0)
    assert (bytes_sent(ada), bytes_sent(bob)) == before


def test_clients_continue_without_the_server_and_agree_afterwards():
    world, ada, bob = two_clients()
    world.hub.down = True
    world.run(0.1)
    ada.physics.pick(0)
    bob.physics.pick(0)
    bob.physics.pick(1)
    world.run(0.3)
    assert ada.physics.state.bunch_attached.tolist() == [False, True]
    world.hub.down = False
    world.run(0.5)
    assert not ada.physics.state.bunch_attached.any()
    world.until(lambda: at_rest(world), 6.0)
    world.run(0.3)
    for number in (BUNCH(0), BUNCH(1)):
        assert position_difference(ada, bob, number) < 5e-3
        assert ada.replicator.record(number) == bob.replicator.record(number) == world.server.records.get(number)


def test_a_box_stays_when_the_robot_that_carries_it_leaves():
    world, ada, bob = two_clients((-1.0, -1.0), (1.0, -2.0))
    deck = frames.compose(ada.physics.rigid.base_state("ada")[0], frames.pose([0.0, 0.0, 0.253]))
    put(ada, BOX(1), deck)
    world.run(0.2)
    world.until(lambda: at_rest(world), 3.0)
    world.run(0.2)
    assert world.server.records.get(BOX(1)).parent == "ada/base_footprint"
    ada.leave()
    world.leave("ada")
    world.until(lambda: "ada" not in bob.remote_actors, 0.2)
    world.until(lambda: bob.replicator.owner(BOX(1)) == "bob", 1.0)
    world.until(lambda: at_rest(world), 3.0)
    world.run(0.1)
    record = world.server.records.get(BOX(1))
    assert (record.author, record.parent, record.moving) == ("bob", "", False)
    assert record.pose[2] < 0.05
    np.testing.assert_allclose(record.pose[:2], deck[:2], atol=0.1)


@pytest.mark.long
def test_a_bunch_pulled_off_carried_and_dropped_by_a_human_is_replicated():
    """F74, F76 by hand: pulled off, replicated while it is carried, falls when a still hand opens."""
    weak = vineyard.__wrapped__()
    weak.bunch_pull[:] = 20.0
    world = World(weak)
    ada = world.join("ada", 1.0, -2.5)
    bob = world.join("bob", -1.0, -2.5)
    hang = weak.forward_kinematics(weak.joint_settled)[weak.bunch_body[0], :3] - [0.0, 0.0, 0.08]
    standing = frames.pose([1.65, 0.0, 0.0], frames.from_yaw(np.pi))
    facing = frames.from_yaw(np.pi)

    def source(time: float) -> HumanPose:
        approach = np.clip((time - 0.5) / 0.5, 0.0, 1.0)
        carry = np.clip((time - 1.4) / 1.2, 0.0, 1.0)
        at = hang + np.array([0.075 + 0.25 * (1.0 - approach) + 0.1 * carry, -0.8 * carry, -0.2 * carry])
        return dataclasses.replace(
            standing_pose(standing), right=frames.pose(at, facing), right_closed=1.1 < time < 5.0
        )

    eva = Client(
        world.scene, weak, None, world.hub.bus("eva"), name="eva", pose=standing, source=source, clock=lambda: world.now
    )
    eva.physics.wind = None
    world.clients["eva"] = eva
    world.run(1.3)
    assert eva.physics.hand("eva", "right").held[0] == "plants"
    world.until(lambda: not eva.physics.state.bunch_attached[0], 1.5)
    world.run(0.1)
    for client in (ada, bob):
        assert not client.physics.state.bunch_attached[0]
        assert client.replicator.owner(BUNCH(0)) == "eva"
        assert position_difference(eva, client, BUNCH(0)) < 0.06
    world.run(4.8 - eva.physics.time)  # held still for longer than an object takes to count as at rest
    assert not at_rest(world)
    world.until(lambda: eva.physics.hand("eva", "right").held is None, 2.0)
    world.until(lambda: at_rest(world), 8.0)
    world.run(0.1)
    assert pose_of(eva, BUNCH(0))[2] < 0.3
    for client in (ada, bob):
        assert client.physics.support_tracker.pose_on_support(BUNCH(0))[0] == ""
        assert position_difference(eva, client, BUNCH(0)) < 5e-3
