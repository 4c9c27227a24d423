"""Humans among robots and humans of other clients: displayed poses, and forces between clients."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.support import sensor_scenes
from tests.support.contact_scenes import cane
from tests.support.long_rows import long
from vinesim.avatar.leg_estimator import LegEstimator
from vinesim.avatar.scripted_human import ScriptedHuman
from vinesim.cli.human_client import standing_place
from vinesim.client.client import Client, label_index
from vinesim.client.remote.remote_human import human_spec
from vinesim.client.tasks.start_poses import bunch_centres, find_reachable_bunch, start_pose
from vinesim.core import frames
from vinesim.net.codec import human as poses
from vinesim.net.codec.control import Hello
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import BODY_PARTS, standing_pose
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.scene import appearance
from vinesim.scene.appearance import AppearanceError
from vinesim.scene.builder import assemble
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ, label, unlabel
from vinesim.scene.spec import load_scene as load_scene
from vinesim.scene.values import HumanPose, HumanUpdate
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.primitives.scene_primitives import Primitives

pytestmark = pytest.mark.slow

DT = 0.01
FOREARM = np.array([0.2, 0.36, 0.885])
"""A point of vinebot's left forearm, at the origin with its arms at home."""
SIDE = frames.pose(np.array([0.2, 1.2, 0.0]), frames.from_yaw(-0.5 * np.pi))
"""A pose beside that arm, facing it."""


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


class World:
    """Clients on a bus in memory, in step."""

    def __init__(self, delay: float = 0.02) -> None:
        self.now = 100.0
        self.hub = MemoryHub(delay=delay)
        self.scene = load_scene("demo")
        self.model = assemble([cane((0.0, 30.0, 2.0), bunch=0.5)])
        self.clients: list[Client] = []

    def join(self, name: str, description: RobotDescription | None, pose: np.ndarray, source=None, **options) -> Client:
        client = Client(
            self.scene,
            self.model,
            description,
            self.hub.bus(name),
            name=name,
            pose=pose,
            source=source,
            clock=lambda: self.now,
            **options,
        )
        self.clients.append(client)
        return client

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / DT)):
            for client in self.clients:
                client.tick()
            self.hub.advance(DT)
            self.now += DT


def parts_of(client: Client, name: str) -> np.ndarray:
    """Poses [part, 7] of the visuals of a human's body parts."""
    links = [link.name for link in client.physics.rigid.visuals()]
    return client.physics.rigid.visual_q()[[links.index(f"{name}/{part}") for part in BODY_PARTS]]


# ---------------------------------------------------------------------- poses of remote humans


def test_actors_have_labels_of_their_own():
    for pattern in ("robot_%d", "vinebot-%d", "p%d"):
        names = [pattern % number for number in range(1000)]
        assert len({label(Organ.ROBOT, label_index(name)) for name in names}) == len(names)
        assert all(unlabel(label(Organ.ROBOT, label_index(name)))[0] is Organ.ROBOT for name in names)


def test_humans_and_robots_join_and_leave(vinebot):
    """F90, F52: two humans and a robot of three clients; each client has all of them, with height and limbs."""
    world = World()
    anna = world.join("anna", vinebot, frames.pose(np.zeros(3)))
    eva = world.join("eva", None, frames.pose(np.array([3.0, 0.0, 0.0])), height=1.6)
    ida = world.join("ida", None, frames.pose(np.array([0.0, 3.0, 0.0])), height=1.9)
    world.run(0.8)
    assert set(anna.remote_actors) == {"eva", "ida"}
    assert set(eva.remote_actors) == {"anna", "ida"}
    assert set(ida.remote_actors) == {"anna", "eva"}
    for client in world.clients:
        assert len(client.physics.rigid.humans) == 2
        assert client.physics.rigid.human("eva").spec.height == pytest.approx(1.6)
        assert client.physics.rigid.human("ida").spec.height == pytest.approx(1.9)
    for name in ("eva", "ida"):
        np.testing.assert_allclose(parts_of(anna, name), parts_of(world.clients[1 + (name == "ida")], name), atol=2e-3)
    ida.replicator.bus.close()
    world.clients.remove(ida)
    world.run(0.2)
    assert set(anna.remote_actors) == {"eva"}
    assert anna.physics.rigid.humans == ("eva",)


def test_a_standing_human_is_equal_on_all_clients():
    """F89: a remote human has exactly the received pose."""
    world = World()
    pose = poses.quantise_pose(standing_pose(SIDE, 1.8))
    world.join("eva", None, SIDE, lambda _: pose, height=1.8)
    ida = world.join("ida", None, frames.pose(np.array([4.0, 0.0, 0.0])))
    world.run(4.0)
    remote_parts = parts_of(ida, "eva")
    here = parts_of(world.clients[0], "eva")
    np.testing.assert_allclose(remote_parts, here, atol=1e-12)
    turned = ida.physics.rigid.human("eva").hand("left")
    np.testing.assert_allclose(ida.physics.hand("eva", turned.side).pose, pose.left, atol=1e-9)


def test_a_walking_human_is_followed():
    """F89: hips, feet and hands at 1.1 m/s with 50 ms delay: the error of the trunk is at most 2 cm; a foot that lands
    is extrapolated for 50 ms."""
    world = World(delay=0.05)
    walker = ScriptedHuman(frames.pose(np.zeros(3)))
    eva = world.join("eva", None, walker.root, walker)
    ida = world.join("ida", None, frames.pose(np.array([2.0, 1.8, 0.0])))  # never farther than 3 m
    world.run(1.0)
    walker.do(walker.walk((4.0, 0.0)))
    errors = []
    for _ in range(300):
        world.run(DT)
        errors.append(np.linalg.norm(parts_of(ida, "eva")[:, :3] - parts_of(eva, "eva")[:, :3], axis=1))
    errors = np.array(errors)
    assert walker.pose.head[0] > 3.0
    trunk = [BODY_PARTS.index(part) for part in ("head", "chest", "hips")]
    assert errors[50:, trunk].max() < 0.02
    assert np.median(errors[50:]) < 0.01
    assert errors[50:].max() < 0.2


def test_legs_estimated_by_each_client_differ():
    """F89: legs estimated by another client from head and hands differ; received ones agree."""
    world = World()
    walker = ScriptedHuman(frames.pose(np.zeros(3)))
    eva = world.join("eva", None, walker.root, walker)
    ida = world.join("ida", None, frames.pose(np.array([2.0, 3.0, 0.0])))
    world.run(0.5)
    walker.do(walker.walk((2.0, 0.0)))
    world.run(0.4)
    remote_parts = ida.physics.rigid.human("eva").part_poses
    estimator = LegEstimator(standing_pose(frames.pose(np.array([remote_parts[0, 0] - 0.09, remote_parts[0, 1], 0.0]))))
    feet = [BODY_PARTS.index("left_foot"), BODY_PARTS.index("right_foot")]
    differences = []
    for _ in range(250):
        world.run(DT)
        head = ida.physics.rigid.human("eva").part_poses[BODY_PARTS.index("head")]
        differences.append(estimator.update(head)[1:, :3] - parts_of(eva, "eva")[feet, :3])
    distances = np.linalg.norm(differences, axis=-1)
    assert distances.max() > 0.2, "in mid-stride"
    assert distances[-1].max() > 0.05, "they stop in other places"
    received_error = parts_of(ida, "eva")[feet, :3] - parts_of(eva, "eva")[feet, :3]
    assert np.linalg.norm(received_error, axis=-1).max() < 5e-4


def test_fingers_are_replicated():
    """F47, over the network."""
    world = World()
    pose = dataclasses.replace(standing_pose(SIDE), right_fingers=(0.2, 0.0, 1.0, 1.0, 1.0))
    world.join("eva", None, SIDE, lambda _: pose)
    ida = world.join("ida", None, frames.pose(np.array([4.0, 0.0, 0.0])))
    world.run(0.5)
    received = ida.replicator.receive(world.now).people["eva"].pose
    assert received.right_fingers == pytest.approx((0.2, 0.0, 1.0, 1.0, 1.0), abs=1 / 255)


def colours(client: Client, name: str) -> dict[str, list]:
    """Colours of all shapes of a person that this client draws, by link."""
    visuals = client.physics.snapshot().visuals
    return {one.name: [shape.rgba for shape in one.shapes] for one in visuals if one.name.startswith(f"{name}/")}


def test_people_wear_outfits_that_are_alike_on_all_clients():
    """By their own choice or by their names; cameras, lidars and pages draw these shapes."""
    world = World()
    outfits = {"anna": "", "eva": "green", "viewer": ""}
    for number, (name, outfit) in enumerate(outfits.items()):
        world.join(name, None, frames.pose(np.array([2.0 * number, 0.0, 0.0])), outfit=outfit)
    world.run(0.8)
    worn = {}
    for name, outfit in outfits.items():
        seen = [colours(client, name) for client in world.clients]
        assert seen[0] == seen[1] == seen[2]
        parts = appearance.load_human_model(1.75, outfit=outfit or appearance.outfit_of(name)).parts
        assert seen[0][f"{name}/chest"] == [shape.rgba for shape in parts["chest"]]
        worn[name] = {link.partition("/")[2]: rgba for link, rgba in seen[0].items()}
    assert worn["anna"] != worn["eva"] != worn["viewer"] != worn["anna"]
    tints = []
    for client in world.clients:
        primitives = Primitives(world.model)
        primitives.update(client.physics.snapshot())
        rows = slice(primitives.plant_count, primitives.count)
        tints.append({tuple(tint) for tint in np.round(primitives.local_columns(rows)["tint"], 4).tolist()})
    assert tints[0] == tints[1] == tints[2]


def test_a_person_in_an_outfit_that_is_unknown_here_gets_that_of_its_name():
    update = HumanUpdate("eva", 0.0, standing_pose(SIDE), np.zeros((7, 6)))
    assert human_spec(Hello("eva", kind="human", outfit="no-such-outfit"), update).outfit == ""
    assert human_spec(Hello("eva", kind="human", outfit="red"), update).outfit == "red"
    with pytest.raises(AppearanceError, match="'pink' is unknown; give one of: orange"):
        World().join("eva", None, SIDE, outfit="pink")


def test_a_bunch_that_a_person_cuts_with_shears_is_cut_on_all_clients():
    """The other client sees the shears come into the hand, cut, and go."""
    world = World()
    stalk = world.model.forward_kinematics(world.model.joint_settled)[world.model.bunch_body[0] - 1, :3].astype(float)
    ahead = frames.from_yaw(0.5 * np.pi)
    palm = stalk - [0.0, 0.0, 0.02] - frames.rotate(ahead, appearance.load_shears().mouth[:3])
    root = frames.pose(np.array([stalk[0] + 0.2, stalk[1] - 0.6, 0.0]), ahead)
    standing = standing_pose(root)
    places = np.stack([standing.right[:3], palm - [0.0, 0.3, 0.0], palm])  # first up, then ahead
    state = {"right_shears": True}

    def source(time: float) -> HumanPose:
        place = np.array([np.interp(time, [0.0, 1.0, 1.4], places[:, axis]) for axis in range(3)])
        return dataclasses.replace(standing, right=frames.pose(place, ahead), **state)

    eva = world.join("eva", None, root, source)
    ida = world.join("ida", None, frames.pose(np.array([stalk[0], stalk[1] + 1.5, 0.0])))
    parts = {"eva/right_shears_blade", "eva/right_shears_hook"}
    world.run(1.6)
    for client in (eva, ida):
        assert parts <= {one.name for one in client.physics.snapshot().visuals}
        assert client.physics.state.bunch_attached.all()
    state["right_closed"] = True
    world.run(0.5)
    for client in (eva, ida):
        assert not client.physics.state.bunch_attached.any()
        place = client.physics.rigid.visual_q()[[one.name for one in client.physics.rigid.visuals()].index("bunch/0")]
        assert place[2] < stalk[2] - 0.5, "it falls"
    state.clear()
    world.run(0.2)
    for client in (eva, ida):
        assert not parts & {one.name for one in client.physics.snapshot().visuals}
    world.run(1.0)
    falls = [client.physics.fruit_monitor.history(0) for client in (eva, ida)]
    assert [one.drops for one in falls] == [1, 0], "only the client that simulates the fall records it"
    assert falls[0].drop_height == pytest.approx(stalk[2], abs=0.3)
    assert falls[1].damage == 0.0


def test_a_teleported_human_is_placed_at_once():
    world = World()
    here = standing_pose(SIDE)
    there = standing_pose(frames.pose(np.array([6.0, 1.2, 0.0])))
    place = [here]
    world.join("eva", None, SIDE, lambda _: place[0])
    ida = world.join("ida", None, frames.pose(np.array([4.0, 0.0, 0.0])))
    world.run(0.5)
    place[0] = there
    for _ in range(12):
        world.run(DT)
        x = parts_of(ida, "eva")[BODY_PARTS.index("hips"), 0]
        assert abs(x - here.hips[0]) < 1e-3 or abs(x - there.hips[0]) < 1e-3, "an intermediate position"
    assert x == pytest.approx(there.hips[0], abs=1e-3)


def test_lidar_and_camera_render_humans_and_robots_of_other_clients(vinebot):
    """F59, F62: points with the label of an actor are where it is on its own client."""
    world = World()
    anna = world.join("anna", vinebot, frames.pose(np.zeros(3)))
    eva = world.join("eva", None, frames.pose(np.array([3.0, 0.5, 0.0]), frames.from_yaw(2.0)))
    bert = world.join("bert", vinebot, frames.pose(np.array([3.5, -1.5, 0.0]), frames.from_yaw(1.0)))
    world.run(0.8)
    snapshot = anna.physics.snapshot()
    primitives = Primitives(world.model, grass=0.0)
    primitives.update(snapshot)
    sensor_position = np.array([0.0, 0.0, 1.3])
    scan = Lidar(LidarSpec.load("vlp16")).scan(primitives, frames.pose(sensor_position))
    camera_pose = look_at(sensor_position, np.array([3.0, -0.4, 1.0]))
    frame = Camera(sensor_scenes.IDEAL, sensor_scenes.SMALL, sun=(0.4, 0.5, 0.77)).render(primitives, camera_pose)
    d435 = CameraSpec.load("d435")
    clear = look_at(np.array([1.0, 0.0, 1.3]), np.array([3.0, -0.4, 1.0]))  # both imagers clear of the own robot
    measured = Camera(d435, d435.info("optical", 0.5)).render(primitives, clear)
    remote_parts, rows, columns = frame.labels, *np.indices(frame.labels.shape)
    for organ, name, at in (
        (Organ.HUMAN, "eva", eva.physics.rigid.actor_position("eva")),
        (Organ.ROBOT, "bert", bert.physics.rigid.actor_position("bert")),
    ):
        actor_label = label(organ, label_index(name))
        points = sensor_position + scan.xyz[scan.labels == actor_label].astype(float)
        assert len(points) > 30, name
        assert np.linalg.norm(points[:, :2] - at[:2], axis=1).max() < 0.8
        here = remote_parts == actor_label
        assert here.sum() > 30, name
        info = frame.info
        depth = frame.depth[here].astype(float)
        rays = np.stack([(columns[here] - info.cx) / info.fx, (rows[here] - info.cy) / info.fy, np.ones(len(depth))], 1)
        found = camera_pose[:3] + frames.rotate(camera_pose[3:], rays * depth[:, None])
        assert np.linalg.norm(found[:, :2] - at[:2], axis=1).max() < 0.8
        assert found[:, 2].min() > -0.01
        assert found[:, 2].max() < 2.2
        actor_label = measured.labels == actor_label
        depth_error = np.abs(measured.depth[actor_label] - measured.exact_depth[actor_label])
        assert np.isfinite(depth_error).mean() > 0.6, name
        assert np.nanmedian(depth_error) < 0.1, "at 3 m the error of a D435 is 36 mm"


# ---------------------------------------------------------------------- forces


class PushingHuman:
    """A human beside a robot's arm whose right hand is controlled by the test."""

    def __init__(self, vinebot: RobotDescription, delay: float) -> None:
        self.world = World(delay)
        self.stand = standing_pose(SIDE)
        self.at = np.array([0.2, 0.75, 0.885])
        self.closed = False
        self.robot = self.world.join("anna", vinebot, frames.pose(np.zeros(3)))
        self.human = self.world.join("eva", None, SIDE, self.pose)
        self.arm = [i for i, joint in enumerate(vinebot.joints) if joint.startswith("arm_left")]
        self.world.run(0.6 + 6 * delay)
        self.rest = self.robot.physics.rigid.joint_measurements("anna")[2].copy()

    def pose(self, time: float) -> HumanPose:
        right = np.concatenate([self.at, self.stand.right[3:]])
        return dataclasses.replace(self.stand, right=right, right_closed=self.closed)

    def move(self, y: float, seconds: float) -> np.ndarray:
        """Move the hand in y; force along y on the human's and on the robot's client [tick, 2] N."""
        rows = []
        for end in np.linspace(self.at[1], y, round(seconds / DT) + 1)[1:]:
            self.at[1] = end
            self.world.run(DT)
            rows.append((self.applied_force()[1], self.received_force()[1]))
        return np.array(rows)

    def applied_force(self) -> np.ndarray:
        return self.human.physics.hand("eva", "right").force

    def received_force(self) -> np.ndarray:
        wrenches = self.robot.physics.rigid.robot("anna").remote_wrenches.values()
        return sum((wrench[:3] for wrench in wrenches), np.zeros(3))

    def force_bytes(self) -> int:
        return self.human.replicator.counters.force.bytes_out


@pytest.mark.parametrize("delay", [0.05, *long(0.0, 0.02, 0.1)])
def test_a_push_on_the_copy_acts_on_the_robot(vinebot, delay):
    """F05, F92, F93: the human's client computes the contact at once; the robot's client applies its force a latency
    later, and joint efforts balance it. At rest both have the same force at any latency."""
    setup = PushingHuman(vinebot, delay)
    assert setup.force_bytes() == 0
    pushing = setup.move(0.25, 1.5)
    first = [int(np.flatnonzero(np.abs(pushing[:, side]) > 0.5)[0]) for side in (0, 1)]
    assert 0 <= first[1] - first[0] <= round(delay / DT) + 3
    at_rest = setup.move(0.25, 1.5)[-20:]
    assert at_rest[:, 0].mean() < -20.0
    np.testing.assert_allclose(at_rest[:, 1].mean(), at_rest[:, 0].mean(), rtol=0.01)

    # the efforts of the controlled robot balance the wrench, which is counted once
    rigid = setup.robot.physics.rigid
    _, _, effort, contact = rigid.joint_measurements("anna")
    expected = np.zeros(len(contact))
    for link, wrench in rigid.robot("anna").remote_wrenches.items():
        at = rigid.mj_data.xipos[rigid.mj_model.body(f"anna/{link}").id]
        expected += rigid.jacobian("anna", link, at).T @ wrench
    np.testing.assert_allclose(contact, expected, atol=1e-3)
    assert np.abs(expected).max() > 3.0
    change = (effort - setup.rest)[setup.arm]
    np.testing.assert_allclose(change, -expected[setup.arm], atol=0.1 * np.abs(expected).max())

    # the hand leaves: the force ends, and so do the messages
    setup.move(0.75, 0.5)
    setup.world.run(0.3 + delay)
    assert (setup.received_force() == 0.0).all()
    bytes_before = setup.force_bytes()
    setup.world.run(0.5)
    assert setup.force_bytes() == bytes_before
    np.testing.assert_allclose(rigid.joint_measurements("anna")[2], setup.rest, atol=0.1)


def test_a_hand_that_pulls_an_arm_acts_on_the_robot(vinebot):
    """F14 between clients: grasped on one client, pulled on the other."""
    setup = PushingHuman(vinebot, 0.02)
    setup.move(0.55, 0.5)
    setup.closed = True
    setup.move(0.55, 0.2)
    assert setup.human.physics.hand("eva", "right").held[0] == "anna"
    setup.move(0.85, 1.0)
    rows = setup.move(0.85, 1.0)[-20:]
    assert rows[:, 0].mean() > 20.0, "towards the human"
    np.testing.assert_allclose(rows[:, 1].mean(), rows[:, 0].mean(), rtol=0.01)
    palm = setup.human.physics.hand("eva", "right").pose
    np.testing.assert_allclose(setup.robot.physics.hand("eva", "right").pose[:3], palm[:3], atol=2e-3)
    assert np.linalg.norm(palm[:3] - setup.at) > 0.15, "the hand is at its controller"
    setup.closed = False
    setup.world.run(0.5)
    assert (setup.received_force() == 0.0).all()


def test_a_crashed_client_stops_pushing(vinebot):
    setup = PushingHuman(vinebot, 0.02)
    setup.move(0.25, 1.0)
    assert setup.received_force()[1] < -10.0
    setup.world.clients.remove(setup.human)
    setup.world.run(0.16)
    assert (setup.received_force() == 0.0).all()


def test_an_arm_that_moves_into_a_hand_gets_its_force(vinebot):
    """F22 between clients: the human's client computes the contact of its copy of the arm with the hand."""
    setup = PushingHuman(vinebot, 0.02)
    setup.at[:] = 0.15, 0.62, 0.92
    setup.world.run(0.8)
    robot = setup.robot.robot
    joint = robot.joint_indices(["arm_left_2_joint"])
    home = float(robot.description.home[joint][0])
    for swing in np.linspace(0.0, 0.8, 150):
        robot.command_position([home + swing], joint)
        setup.world.run(DT)
    setup.world.run(1.0)
    efforts = setup.robot.physics.rigid.joint_measurements("anna")[3][setup.arm]
    assert setup.received_force()[1] < -3.0, "no reaction of the hand"
    np.testing.assert_allclose(
        setup.received_force(), setup.applied_force(), atol=0.05 * np.abs(setup.applied_force()).max()
    )
    assert np.abs(efforts).max() > 1.0


# ---------------------------------------------------------------------- plants


def test_a_bunch_pulled_by_a_human_moves_on_the_robots_client(vinebot):
    """F74 with a human: held on one client, it moves on the other, whose copy of the hand holds nothing."""
    world = World()
    world.scene = load_scene("demo")
    world.model = generate(world.scene)
    standing = start_pose(world.scene, 0)
    bunch = find_reachable_bunch(world.model, standing)
    body = int(world.model.bunch_body[bunch])
    centre = bunch_centres(world.model)[bunch]
    walker = ScriptedHuman(frames.pose(np.array([*standing_place(centre, standing), 0.0]), standing[3:]))
    eva = world.join("eva", None, walker.root, walker)
    aside = frames.compose(standing, frames.pose(np.array([-1.5, 1.0, 0.0])))
    anna = world.join("anna", vinebot, aside)
    world.run(0.6)
    middle = np.array([0.5 * float(world.model.bunch_length[bunch]), 0.0, 0.0])
    walker.do(
        walker.face(tuple(centre[:2])),
        walker.reach("right", lambda: centre),
        walker.wait(0.3),
        walker.withdraw("right", 0.4),
        walker.wait(0.5),
    )
    for _ in range(400):
        world.run(DT)
        if eva.physics.hand("eva", "right").held is not None:
            break
    assert eva.physics.hand("eva", "right").held == ("plants", f"body/{body}")
    world.run(1.6)
    for client in world.clients:
        client.physics.update_kinematics()
    poses_now = [client.physics.state.body_q[body].astype(float) for client in world.clients]
    here, there = (pose[:3] + frames.rotate(pose[3:], middle) for pose in poses_now)
    assert np.linalg.norm(here - centre) > 0.05
    assert np.linalg.norm(there - here) < 0.02
    assert anna.replicator.owner(int(world.model.body_tree[body])) == "eva"
    assert anna.physics.hand("eva", "right").held is None
    np.testing.assert_allclose(
        anna.physics.hand("eva", "right").pose[:3], eva.physics.hand("eva", "right").pose[:3], atol=0.01
    )
