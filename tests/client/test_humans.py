"""People of one client among the robots and people of others: seen as they are, felt as they push."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.support import sensor_scenes
from tests.support.contact_scenes import cane
from vinesim import frames
from vinesim.avatar.leg_estimator import LegEstimator
from vinesim.avatar.scripted_human import ScriptedHuman
from vinesim.cli.human_client import standing_place
from vinesim.client.client import Client, label_index
from vinesim.client.tasks.start_poses import bunch_centres, find_reachable_bunch, start_pose
from vinesim.net.codec import human as poses
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.physics.rigid.human_posture import standing_pose
from vinesim.physics.rigid.human_shapes import BODY_PARTS
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.scene.builder import assemble
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ, label
from vinesim.scene.spec import load_scene as load_scene
from vinesim.scene.values import HumanPose
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.scene.primitives import Primitives

DT = 0.01
FOREARM = np.array([0.2, 0.36, 0.885])
"""A point of the vinebot's left forearm, when it stands at the origin with its arms at home."""
SIDE = frames.pose(np.array([0.2, 1.2, 0.0]), frames.from_yaw(-0.5 * np.pi))
"""Beside that arm, facing it."""


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


class World:
    """Clients on a bus in memory, in step."""

    def __init__(self, delay: float = 0.02) -> None:
        self.now = 100.0
        self.hub = MemoryHub(delay=delay)
        self.scene, self.model = load_scene("demo"), assemble([cane((0.0, 30.0, 2.0), bunch=0.5)])
        self.clients: list[Client] = []

    def join(self, name: str, description: RobotDescription | None, pose: np.ndarray, source=None, **options) -> Client:
        client = Client(
            self.scene, self.model, description, self.hub.bus(name), name=name, pose=pose, source=source,
            clock=lambda: self.now, **options,
        )  # fmt: skip
        self.clients.append(client)
        return client

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / DT)):
            for client in self.clients:
                client.tick()
            self.hub.advance(DT)
            self.now += DT


def parts_of(client: Client, name: str) -> np.ndarray:
    """[part, 7] as sensors see them."""
    links = [link.name for link in client.physics.rigid.visuals()]
    return client.physics.rigid.visual_q()[[links.index(f"{name}/{part}") for part in BODY_PARTS]]


# ---------------------------------------------------------------------- seen


def test_people_and_robots_meet_and_part(vinebot):
    """F90, F52: two people and a robot, each on a client of its own; all see all, with height and limbs."""
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


def test_who_stands_still_is_the_same_everywhere_to_the_bit():
    """F89: what copies hold is what crossed the network, and nothing makes it up anew."""
    world = World()
    pose = poses.quantise_pose(standing_pose(SIDE, 1.8))
    world.join("eva", None, SIDE, lambda _: pose, height=1.8)
    ida = world.join("ida", None, frames.pose(np.array([4.0, 0.0, 0.0])))
    world.run(4.0)
    seen, here = parts_of(ida, "eva"), parts_of(world.clients[0], "eva")
    np.testing.assert_allclose(seen, here, atol=1e-12)
    turned = ida.physics.rigid.human("eva").hand("left")
    np.testing.assert_allclose(ida.physics.hand("eva", turned.side).pose, pose.left, atol=1e-9)


def test_a_walker_is_seen_walking():
    """F89: hips, feet and hands at 1.1 m/s, over a network of 50 ms: the trunk is 2 cm wrong at most; a foot that lands
    is wrong for the 50 ms in which it was believed to go on."""
    world = World(delay=0.05)
    walker = ScriptedHuman(frames.pose(np.zeros(3)))
    eva = world.join("eva", None, walker.root, walker)
    ida = world.join("ida", None, frames.pose(np.array([2.0, 3.0, 0.0])))
    world.run(1.0)
    walker.do(walker.walk((4.0, 0.0)))
    wrong = []
    for _ in range(300):
        world.run(DT)
        wrong.append(np.linalg.norm(parts_of(ida, "eva")[:, :3] - parts_of(eva, "eva")[:, :3], axis=1))
    wrong = np.array(wrong)
    assert walker.pose.head[0] > 3.0
    trunk = [BODY_PARTS.index(part) for part in ("head", "chest", "hips")]
    assert wrong[50:, trunk].max() < 0.02
    assert np.median(wrong[50:]) < 0.01
    assert wrong[50:].max() < 0.2


def test_legs_that_each_client_makes_up_differ():
    """F89: from head and hands alone another client, who came a little later, makes up other legs; told, they agree."""
    world = World()
    walker = ScriptedHuman(frames.pose(np.zeros(3)))
    eva = world.join("eva", None, walker.root, walker)
    ida = world.join("ida", None, frames.pose(np.array([2.0, 3.0, 0.0])))
    world.run(0.5)
    walker.do(walker.walk((2.0, 0.0)))
    world.run(0.4)
    seen = ida.physics.rigid.human("eva").part_poses
    guess = LegEstimator(standing_pose(frames.pose(np.array([seen[0, 0] - 0.09, seen[0, 1], 0.0]))))
    feet = [BODY_PARTS.index("left_foot"), BODY_PARTS.index("right_foot")]
    guessed = []
    for _ in range(250):
        world.run(DT)
        head = ida.physics.rigid.human("eva").part_poses[BODY_PARTS.index("head")]
        guessed.append(guess.update(head)[1:, :3] - parts_of(eva, "eva")[feet, :3])
    apart = np.linalg.norm(guessed, axis=-1)
    assert apart.max() > 0.2, "in mid-stride"
    assert apart[-1].max() > 0.05, "and they stop in other places"
    told = parts_of(ida, "eva")[feet, :3] - parts_of(eva, "eva")[feet, :3]
    assert np.linalg.norm(told, axis=-1).max() < 5e-4


def test_fingers_are_seen():
    """F47, as far as the network goes."""
    world = World()
    pose = dataclasses.replace(standing_pose(SIDE), right_fingers=(0.2, 0.0, 1.0, 1.0, 1.0))
    world.join("eva", None, SIDE, lambda _: pose)
    ida = world.join("ida", None, frames.pose(np.array([4.0, 0.0, 0.0])))
    world.run(0.5)
    heard = ida.replicator.receive(world.now).people["eva"].pose
    assert heard.right_fingers == pytest.approx((0.2, 0.0, 1.0, 1.0, 1.0), abs=1 / 255)


def test_who_is_set_down_elsewhere_is_there_at_once():
    world = World()
    here, there = standing_pose(SIDE), standing_pose(frames.pose(np.array([6.0, 1.2, 0.0])))
    place = [here]
    world.join("eva", None, SIDE, lambda _: place[0])
    ida = world.join("ida", None, frames.pose(np.array([4.0, 0.0, 0.0])))
    world.run(0.5)
    place[0] = there
    for _ in range(12):
        world.run(DT)
        x = parts_of(ida, "eva")[BODY_PARTS.index("hips"), 0]
        assert abs(x - here.hips[0]) < 1e-3 or abs(x - there.hips[0]) < 1e-3, "never in between"
    assert x == pytest.approx(there.hips[0], abs=1e-3)


def test_lidar_and_camera_see_people_and_robots_of_other_clients(vinebot):
    """F59, F62: points with the label of each lie where it is on its own client."""
    world = World()
    anna = world.join("anna", vinebot, frames.pose(np.zeros(3)))
    eva = world.join("eva", None, frames.pose(np.array([3.0, 0.5, 0.0]), frames.from_yaw(2.0)))
    bert = world.join("bert", vinebot, frames.pose(np.array([3.5, -1.5, 0.0]), frames.from_yaw(1.0)))
    world.run(0.8)
    view = anna.physics.snapshot()
    primitives = Primitives(world.model, grass=0.0)
    primitives.update(view)
    eye = np.array([0.0, 0.0, 1.3])
    scan = Lidar(LidarSpec.load("vlp16")).scan(primitives, frames.pose(eye))
    gaze = look_at(eye, np.array([3.0, -0.4, 1.0]))
    frame = Camera(sensor_scenes.IDEAL, sensor_scenes.SMALL, sun=(0.4, 0.5, 0.77)).render(primitives, gaze)
    d435 = CameraSpec.load("d435")
    clear = look_at(np.array([1.0, 0.0, 1.3]), np.array([3.0, -0.4, 1.0]))  # both its imagers, of her own robot
    measured = Camera(d435, d435.info("optical", 0.5)).render(primitives, clear)
    seen, rows, columns = frame.labels, *np.indices(frame.labels.shape)
    for organ, name, at in (
        (Organ.HUMAN, "eva", eva.physics.rigid.actor_position("eva")),
        (Organ.ROBOT, "bert", bert.physics.rigid.actor_position("bert")),
    ):
        mine = label(organ, label_index(name))
        points = eye + scan.xyz[scan.labels == mine].astype(float)
        assert len(points) > 30, name
        assert np.linalg.norm(points[:, :2] - at[:2], axis=1).max() < 0.8
        here = seen == mine
        assert here.sum() > 30, name
        info, depth = frame.info, frame.depth[here].astype(float)
        rays = np.stack([(columns[here] - info.cx) / info.fx, (rows[here] - info.cy) / info.fy, np.ones(len(depth))], 1)
        found = gaze[:3] + frames.rotate(gaze[3:], rays * depth[:, None])
        assert np.linalg.norm(found[:, :2] - at[:2], axis=1).max() < 0.8
        assert found[:, 2].min() > -0.01
        assert found[:, 2].max() < 2.2
        mine = measured.labels == mine
        off = np.abs(measured.depth[mine] - measured.exact_depth[mine])
        assert np.isfinite(off).mean() > 0.6, name
        assert np.nanmedian(off) < 0.1, "three metres away, a D435 errs by 36 mm"


# ---------------------------------------------------------------------- felt


class Shove:
    """A person beside a robot's arm who puts the right hand where a test says."""

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
        """Move the hand in y; [tick, 2] force [N] along y that the person's and the robot's client knew of."""
        rows = []
        for end in np.linspace(self.at[1], y, round(seconds / DT) + 1)[1:]:
            self.at[1] = end
            self.world.run(DT)
            rows.append((self.given()[1], self.felt()[1]))
        return np.array(rows)

    def given(self) -> np.ndarray:
        return self.human.physics.hand("eva", "right").force

    def felt(self) -> np.ndarray:
        borne = self.robot.physics.rigid.robot("anna").remote_wrenches.values()
        return sum((wrench[:3] for wrench in borne), np.zeros(3))

    def forces_said(self) -> int:
        return self.human.replicator.counters.force.bytes_out


@pytest.mark.parametrize("delay", [0.0, 0.02, 0.05, 0.1])
def test_a_push_on_the_copy_is_felt_by_the_robot(vinebot, delay):
    """F05, F92, F93: the touch is computed by the person's client, at once; the robot's client applies its force, a
    latency later, and the joints' efforts tell. At rest both know of the same force, whatever the latency."""
    shove = Shove(vinebot, delay)
    assert shove.forces_said() == 0
    pushing = shove.move(0.25, 1.5)
    first = [int(np.flatnonzero(np.abs(pushing[:, side]) > 0.5)[0]) for side in (0, 1)]
    assert 0 <= first[1] - first[0] <= round(delay / DT) + 3
    still = shove.move(0.25, 1.5)[-20:]
    assert still[:, 0].mean() < -20.0
    np.testing.assert_allclose(still[:, 1].mean(), still[:, 0].mean(), rtol=0.01)

    # the efforts of the real robot hold against the wrench; nothing of it is counted twice
    rigid = shove.robot.physics.rigid
    _, _, effort, contact = rigid.joint_measurements("anna")
    expected = np.zeros(len(contact))
    for link, wrench in rigid.robot("anna").remote_wrenches.items():
        at = rigid.mj_data.xipos[rigid.mj_model.body(f"anna/{link}").id]
        expected += rigid.jacobian("anna", link, at).T @ wrench
    np.testing.assert_allclose(contact, expected, atol=1e-3)
    assert np.abs(expected).max() > 3.0
    change = (effort - shove.rest)[shove.arm]
    np.testing.assert_allclose(change, -expected[shove.arm], atol=0.1 * np.abs(expected).max())

    # the hand goes: the force ends, and so do the messages
    shove.move(0.75, 0.5)
    shove.world.run(0.3 + delay)
    assert (shove.felt() == 0.0).all()
    said = shove.forces_said()
    shove.world.run(0.5)
    assert shove.forces_said() == said
    np.testing.assert_allclose(rigid.joint_measurements("anna")[2], shove.rest, atol=0.1)


def test_a_hand_that_pulls_at_an_arm_is_seen_there_and_felt(vinebot):
    """F14 between clients: grabbed on one client, pulled on the other."""
    shove = Shove(vinebot, 0.02)
    shove.move(0.55, 0.5)
    shove.closed = True
    shove.move(0.55, 0.2)
    assert shove.human.physics.hand("eva", "right").held[0] == "anna"
    shove.move(0.85, 1.0)
    rows = shove.move(0.85, 1.0)[-20:]
    assert rows[:, 0].mean() > 20.0, "towards the person"
    np.testing.assert_allclose(rows[:, 1].mean(), rows[:, 0].mean(), rtol=0.01)
    palm = shove.human.physics.hand("eva", "right").pose
    np.testing.assert_allclose(shove.robot.physics.hand("eva", "right").pose[:3], palm[:3], atol=2e-3)
    assert np.linalg.norm(palm[:3] - shove.at) > 0.15, "not where the controller is"
    shove.closed = False
    shove.world.run(0.5)
    assert (shove.felt() == 0.0).all()


def test_who_pushes_and_crashes_pushes_no_more(vinebot):
    shove = Shove(vinebot, 0.02)
    shove.move(0.25, 1.0)
    assert shove.felt()[1] < -10.0
    shove.world.clients.remove(shove.human)
    shove.world.run(0.16)
    assert (shove.felt() == 0.0).all()


def test_an_arm_that_comes_to_a_hand_feels_it(vinebot):
    """F22 between clients: the person's client finds its copy of the arm pressing on the hand, and says so."""
    shove = Shove(vinebot, 0.02)
    shove.at[:] = 0.15, 0.62, 0.92
    shove.world.run(0.8)
    robot = shove.robot.robot
    joint = robot.joint_indices(["arm_left_2_joint"])
    home = float(robot.description.home[joint][0])
    for swing in np.linspace(0.0, 0.8, 150):
        robot.command_position([home + swing], joint)
        shove.world.run(DT)
    shove.world.run(1.0)
    efforts = shove.robot.physics.rigid.joint_measurements("anna")[3][shove.arm]
    assert shove.felt()[1] < -3.0, "the hand pushes back"
    np.testing.assert_allclose(shove.felt(), shove.given(), atol=0.05 * np.abs(shove.given()).max())
    assert np.abs(efforts).max() > 1.0


# ---------------------------------------------------------------------- plants and what grows on them


def test_a_bunch_that_a_person_pulls_at_is_seen_to_move_by_a_robot(vinebot):
    """F74 with a human: held by the hand on one client, it moves on the other, whose copy of the hand holds nothing."""
    world = World()
    world.scene = load_scene("demo")
    world.model = generate(world.scene)
    stand = start_pose(world.scene, 0)
    bunch = find_reachable_bunch(world.model, stand)
    body = int(world.model.bunch_body[bunch])
    centre = bunch_centres(world.model)[bunch]
    walker = ScriptedHuman(frames.pose(np.array([*standing_place(centre, stand), 0.0]), stand[3:]))
    eva = world.join("eva", None, walker.root, walker)
    aside = frames.compose(stand, frames.pose(np.array([-1.5, 1.0, 0.0])))
    anna = world.join("anna", vinebot, aside)
    world.run(0.6)
    middle = np.array([0.5 * float(world.model.bunch_length[bunch]), 0.0, 0.0])
    walker.do(
        walker.face(tuple(centre[:2])), walker.reach("right", lambda: centre), walker.wait(0.3),
        walker.withdraw("right", 0.4), walker.wait(0.5),
    )  # fmt: skip
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
