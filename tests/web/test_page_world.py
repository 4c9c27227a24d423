"""What pages are told: the cameras' primitives once, then the poses of what has moved, and of nothing else."""

import numpy as np
import pytest

from vinesim.avatar.scripted_human import ScriptedHuman
from vinesim.avatar.tracked_human import TrackedHuman
from vinesim.client.client import Client
from vinesim.client.page.page_world import ELSE_LOADED, LOADED, PageWorld
from vinesim.client.remote.remote_human import RemoteHuman
from vinesim.client.spectator import Spectator, standing_view
from vinesim.client.tasks.start_poses import bunch_centres
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.robot.description.loader import load_description
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.spec import load_scene
from vinesim.scene.state import State
from vinesim.scene.values import INTENTIONS, HumanSpec, LightPattern
from vinesim.web.array_message import decode
from vinesim.web.page_input import PageInput, PlantWork, TrackedHand, TrackedPerson
from vinesim.wires.wire_segments import wire_segments


class OnePage:
    """Stands for the server: one page looks all the time."""

    has_viewers = True

    def notify(self):
        pass


@pytest.fixture
def shown():
    with MemoryHub().bus("viewer") as bus:
        client = Spectator(
            load_scene("demo"),
            generate(load_scene("demo")),
            None,
            bus,
            name="viewer",
            pose=standing_view(1.0, 2.0, 0.5),
        )
        world = PageWorld(client)
        client.post_step.append(lambda _: world.collect(OnePage()))
        yield client, world


@pytest.fixture
def anna():
    """A client whose person, at x = -2 m, moves as a page says, and the world of that page."""
    with MemoryHub().bus("anna") as bus:
        scene = load_scene("demo")
        start = frames.pose(np.array([-2.0, 0.0, 0.0]))
        person = TrackedHuman(start)
        client = Client(scene, generate(scene), None, bus, name="anna", pose=start, source=person)
        world = PageWorld(client, person)
        client.post_step.append(lambda _: world.collect(OnePage()))
        yield client, world


def swing(client, tree):
    """Let one tree move."""
    client.physics.plants.wake(np.array([tree]))
    client.physics.state.joint_qd[client.model.bodies_of(tree)] = 0.3


def test_nothing_is_laid_out_before_a_page_asks(shown):
    client, world = shown
    client.tick()
    assert world.state(-1) is None
    assert world._primitives is None


def test_the_scene_holds_what_cameras_see(shown):
    client, world = shown
    header, arrays = decode(world.scene())
    model = client.model
    wires = wire_segments(model)
    assert header["bodies"] == len(model.body_mass) + len(wires)
    np.testing.assert_allclose(arrays["start"], client.pose, atol=1e-6)
    rest = np.concatenate([client.physics.snapshot().body_q, wires.rest_q])
    np.testing.assert_allclose(arrays["poses"], rest, atol=1e-6)
    kinds = np.repeat(arrays["kind"], arrays["size"])
    assert len(kinds) == len(arrays["material"]) == len(arrays["shape"]) == len(arrays["carrier"])
    assert (kinds == 1).sum() == model.bunch_berries.sum()
    blades = (kinds == 2) & (arrays["material"] == 0) & (arrays["carrier"] < header["bodies"])
    assert len(model.leaf_body) <= blades.sum() < 2 * len(model.leaf_body), "each leaf, and small ones in axils"
    assert arrays["first"][0] == 0
    np.testing.assert_array_equal(arrays["first"][1:], np.cumsum(arrays["size"])[:-1])


def test_a_state_holds_the_trees_that_have_moved_since_the_last_one(shown):
    client, world = shown
    world.scene()
    client.tick()
    tick, first = world.state(-1)
    assert len(decode(first)[1]["body"]) == 0, "a page knows the vineyard at rest"
    assert world.state(tick) is None, "nothing is new"
    swing(client, 3)
    client.tick()
    tick, message = world.state(tick)
    bodies = client.model.bodies_of(3)
    arrays = decode(message)[1]
    assert set(range(bodies.start, bodies.stop)) <= set(arrays["body"].tolist())
    assert len(arrays["body"]) < 100, "it and what it has touched"
    pose = client.physics.state.body_q[arrays["body"]]
    np.testing.assert_allclose(arrays["place"].reshape(-1, 3), pose[:, :3], atol=1e-6)
    np.testing.assert_allclose(arrays["turn"].reshape(-1, 4) / 32767.0, pose[:, 3:], atol=2e-5)


def test_a_state_holds_the_segments_of_wires_that_have_moved(shown):
    """A shoot that swings takes its wire along; at rest again, the wire is told once more and then no longer."""
    client, world = shown
    world.scene()
    client.tick()
    model = client.model
    bodies = len(client.model.body_mass)
    tree = int(model.body_tree[model.tie_body[model.tie_wire >= 0]][0])
    swing(client, tree)
    seen = -1
    before = set()
    while not before:
        client.tick()
        seen, message = world.state(-1)
        arrays = decode(message)[1]
        wires = client.physics.snapshot().wires
        before = set(wires.segment.tolist())
    told = arrays["body"] - np.uint32(bodies)
    rows = np.flatnonzero(np.isin(told, wires.segment))
    np.testing.assert_array_equal(told[rows], wires.segment)
    np.testing.assert_allclose(arrays["place"].reshape(-1, 3)[rows], wires.q[:, :3], atol=1e-6)
    client.physics.apply_remote_rest([tree], [State.at_rest(model).joint_q[model.bodies_of(tree)]])
    for other in client.physics.plants.awake.copy():
        client.physics.apply_remote_rest([int(other)], [State.at_rest(model).joint_q[model.bodies_of(int(other))]])
    client.tick()
    seen, message = world.state(seen)
    arrays = decode(message)[1]
    rows = np.flatnonzero(np.isin(arrays["body"], bodies + np.array(sorted(before))))
    rest = wire_segments(model).rest_q[arrays["body"][rows] - bodies]
    assert len(rows)
    np.testing.assert_allclose(arrays["place"].reshape(-1, 3)[rows], rest[:, :3], atol=2e-4)
    client.tick()
    assert not set((decode(world.state(seen)[1])[1]["body"].astype(int) - bodies).tolist()) & before


def test_a_page_that_skips_states_still_gets_every_tree(shown):
    client, world = shown
    world.scene()
    client.tick()
    seen, _ = world.state(-1)
    for tree in (2, 5):
        swing(client, tree)
        client.tick()
    bodies = set(decode(world.state(seen)[1])[1]["body"].tolist())
    for tree in (2, 5):
        own = client.model.bodies_of(tree)
        assert set(range(own.start, own.stop)) <= bodies


def test_a_picked_bunch_becomes_a_rigid_body_of_the_page(shown):
    client, world = shown
    world.scene()
    client.tick()
    tick, before = world.state(-1)
    client.physics.pick(4)
    client.tick()
    header, arrays = decode(world.state(tick)[1])
    assert arrays["picked"].tolist() == [4]
    assert header["rigid"] == decode(before)[0]["rigid"] + 1
    rigid, shapes = decode(world.rigid())
    assert len(rigid["names"]) * 4 == len(arrays["rigid_turn"].ravel())
    row = next(i for i, name in enumerate(rigid["names"]) if "bunch" in name or Organ.BUNCH.name.lower() in name)
    carriers = shapes["carrier"]
    bodies = decode(world.scene())[0]["bodies"]
    assert (carriers == bodies + 1 + row).sum() >= client.model.bunch_berries[4]


def test_the_page_gets_the_stump_of_a_cut_peduncle(shown):
    client, world = shown
    world.scene()
    client.tick()
    world.state(-1)
    model = client.model
    segment = int(model.body_parent[model.bunch_body[3]])
    client.physics.cut(segment, 0.01)
    client.tick()
    world.state(-1)
    _, shapes = decode(world.rigid())
    assert shapes["stump_carrier"].tolist() == [segment]
    assert shapes["stump_shape"].reshape(-1, 16)[0, 4] == pytest.approx(0.01, abs=1e-6)


def test_the_eyes_of_a_spectator_follow_the_page(shown):
    client, world = shown
    here = (4.0, 5.0, 2.0, 0.0, 0.0, 1.0, 0.0)
    there = (1.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0)
    world.take(0, PageInput(1, here))
    world.take(1, PageInput(1, there))
    client.tick()
    assert tuple(client.pose) == here, "the first page leads"
    world.leave(0)
    world.take(1, PageInput(1, there))
    client.tick()
    assert tuple(client.pose) == there


def test_the_pages_of_a_spectator_move_its_eyes_and_nothing_else(shown):
    """A person in a message of a spectator's page is no person in the world, nor is what it indicates."""
    client, world = shown
    world.scene()
    away = (4.0, 5.0, 2.0, 0.0, 0.0, 1.0, 0.0)
    hand = TrackedHand(tuple(client.model.forward_kinematics(client.model.joint_settled)[40]), closed=True)
    world.take(0, PageInput(1, away, TrackedPerson(away, hand, hand, INTENTIONS[1])))
    for _ in range(5):
        client.tick()
    assert tuple(client.pose) == away
    assert not client.humans
    assert {visual.organ for visual in client.physics.snapshot().visuals} <= {Organ.BOX}
    assert len(client.physics.plants.awake) == 0
    assert client.physics.state.bunch_attached.all()


def test_only_the_first_page_moves_the_person(anna):
    client, world = anna
    mine, other = ((-2.0, y, 1.6, 0.0, 0.0, 0.0, 1.0) for y in (0.1, 0.5))
    world.take(0, PageInput(1, mine, TrackedPerson(mine)))
    world.take(1, PageInput(1, other, TrackedPerson(other, intention=INTENTIONS[1])))
    for _ in range(30):
        client.tick()
    np.testing.assert_allclose(client.humans["anna"].pose.head[:3], mine[:3], atol=1e-9)
    assert client.humans["anna"].intention == ""


def test_a_page_that_watches_never_takes_the_person_over_and_is_told_who_has_it(anna):
    client, world = anna
    mine = (-2.0, 0.1, 1.6, 0.0, 0.0, 0.0, 1.0)

    def control(page):
        client.tick()
        return decode(world.state(-1, page)[1])[0]["control"]

    header, arrays = decode(world.scene())
    assert not header["is_controlled"]
    np.testing.assert_allclose(arrays["start"], client.humans["anna"].pose.head, atol=1e-6)
    world.take(1, PageInput(1, mine))
    assert control(0) == control(1) == ""
    world.take(0, PageInput(1, mine, TrackedPerson(mine)))
    assert control(0) == "this"
    assert control(1) == "other"
    header, arrays = decode(world.scene())
    assert header["is_controlled"]
    apart = np.linalg.norm(arrays["start"][:2] - client.humans["anna"].pose.root[:2])
    assert apart > 1.0, "a page that watches begins behind the person"
    world.leave(0)
    world.take(1, PageInput(1, mine))
    assert control(1) == ""


@pytest.mark.parametrize("begins_behind_actor", [True, False])
def test_a_spectator_begins_behind_the_nearest_actor_until_its_page_has_moved(shown, begins_behind_actor):
    client, world = shown
    client.begins_behind_actor = begins_behind_actor
    before = client.pose.copy()
    near, far = (frames.pose(before[:3] * [1.0, 1.0, 0.0] + [away, 0.0, 0.0]) for away in (0.1, 4.0))
    for name, root in (("near", near), ("far", far)):
        pose = standing_pose(root)
        client.physics.add_human(HumanSpec(name, 1, pose), is_remote=True)
        client.remote_actors[name] = human = RemoteHuman(client.physics.rigid, name)
        human.pose = pose
    start = decode(world.scene())[1]["start"]
    if not begins_behind_actor:
        np.testing.assert_allclose(start, before, atol=1e-6)
        return
    way = near[:2] - start[:2]
    assert 1.0 < np.linalg.norm(way) < 3.0
    ahead = frames.rotate(start[3:].astype(float), np.array([1.0, 0.0, 0.0]))[:2]
    assert ahead @ way > 0.95 * np.linalg.norm(way), "it looks at the actor"
    here = (4.0, 5.0, 2.0, 0.0, 0.0, 1.0, 0.0)
    world.take(0, PageInput(1, here))
    client.tick()
    np.testing.assert_allclose(decode(world.scene())[1]["start"], here, atol=1e-6)


def test_a_page_is_told_of_the_shears_in_its_persons_hand_and_of_what_they_cut(anna):
    client, world = anna
    world.scene()
    head = (-2.0, 0.0, 1.6, 0.0, 0.0, 0.0, 1.0)
    palm = (-1.5, -0.2, 1.2, 0.0, 0.0, 0.0, 1.0)

    def shown(*, shears, closed, left=False):
        """What a page is told after some steps, with the names of what it draws."""
        hand = TrackedHand(palm, closed)
        other = TrackedHand((-1.5, 0.2, *palm[2:]), closed) if left else None
        world.take(0, PageInput(1, head, TrackedPerson(head, other, hand, shears=(left, shears))))
        for _ in range(17):  # the blades need 16 steps
            client.tick()
        told, arrays = decode(world.state(-1)[1])
        names = decode(world.rigid())[0]["names"]
        return told, names, arrays["rigid_place"].reshape(-1, 3)

    parts = ["anna/right_shears_blade", "anna/right_shears_hook"]
    told, names, _ = shown(shears=False, closed=False)
    assert told["shears"] == {"closures": 0, "said": [], "between": ["", ""]}
    assert not set(parts) & set(names)
    told, names, places = shown(shears=True, closed=False)
    assert set(parts) <= set(names)
    assert len(names) == len(places)
    away = places[[names.index(part) for part in parts]] - places[names.index("anna/right_hand")]
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), np.hypot(0.1, 0.026), atol=1e-3)
    told, _, _ = shown(shears=True, closed=True)
    assert told["shears"]["closures"] == 1
    (said,) = told["shears"]["said"]
    assert "right hand missed" in said
    assert "right" in told["haptics"]
    shown(shears=True, closed=False, left=True)
    told, _, _ = shown(shears=True, closed=True, left=True)
    assert told["shears"]["closures"] == 3
    assert [said.split()[4] for said in told["shears"]["said"]] == ["right", "left", "right"], "both at once: both told"
    told, names, _ = shown(shears=False, closed=False)
    assert told["shears"]["closures"] == 3
    assert not set(parts) & set(names)


def test_a_person_takes_leaves_off_ties_and_unties_what_is_at_the_right_hand_once_for_each_wish(anna):
    client, world = anna
    world.scene()
    model = client.model
    leafy = int(np.bincount(model.leaf_body[model.body_organ[model.leaf_body] == int(Organ.CANE)]).argmax())
    half = frames.pose(np.array([0.5 * model.body_length[leafy], 0.0, 0.0]))
    place = frames.compose(client.physics.state.body_q[leafy].astype(float), half)[:3]
    turn = (0.0, 0.0, 0.0, 1.0)

    def told(palm, *work):
        """Sends each wish in two messages; returns the answers about work in the next state for the page."""
        x, y, z = palm
        head = (x - 0.4, y, 1.6, *turn)
        for wish in work or (None,):
            for _ in range(2):
                hand = TrackedHand((x, y, z, *turn))
                world.take(0, PageInput(1, head, TrackedPerson(head, None, hand, work=wish)))
                for _ in range(10):
                    client.tick()
        return decode(world.state(-1)[1])[0]["work"]

    assert told(place) == {"count": 0, "said": []}
    before = client.physics.state.leaf_off.sum()
    answer = told(place, PlantWork("take_leaves", 1))
    taken = client.physics.state.leaf_off.sum() - before
    assert taken > 0
    assert answer["count"] == 1
    assert answer["said"][0].startswith(f"The right hand takes {taken} leaves off body")
    answer = told(place, PlantWork("tie", 2), PlantWork("untie", 3))
    assert answer["count"] == 3
    assert "The right hand ties body" in answer["said"][1]
    assert "The right hand opens " in answer["said"][2]
    answer = told((-2.0, 0.0, 1.2), PlantWork("tie", 4))
    assert answer["said"][-1].startswith("The right hand does nothing: no cane within 100 mm")


def test_a_flash_of_a_light_reloads_no_body_of_a_page():
    """What a page knows after flashes, from states alone, is what one that loads everything now is told."""
    with MemoryHub().bus("bot") as bus:
        scene = load_scene("demo")
        client = Client(
            scene, generate(scene), load_description("vinebot"), bus, name="bot", pose=frames.pose(np.zeros(3))
        )
        world = PageWorld(client)
        client.post_step.append(lambda _: world.collect(OnePage()))
        world.scene()
        client.tick()
        header, _ = decode(world.state(-1)[1])
        loaded = {name: values.copy() for name, values in decode(world.rigid())[1].items()}
        client.robot.command_lights(LightPattern.ALARM)
        seen = set()
        for _ in range(60):
            client.tick()
            after, arrays = decode(world.state(-1)[1])
            assert after["rigid"] == header["rigid"]
            loaded["surface"].reshape(-1, 4)[arrays["lamp"]] = arrays["lamp_surface"].reshape(-1, 4)
            loaded["material"][arrays["lamp"]] = arrays["lamp_material"]
            seen.add(arrays["lamp_surface"].tobytes())
        assert len(seen) >= 2, "it has flashed"
        assert 0 < arrays["lamp"].size < 20, "a small change"
        later = PageWorld(client)
        client.post_step.append(lambda _: later.collect(OnePage()))
        later.scene()
        client.tick()
        later.state(-1)
        _, newest = decode(world.state(-1)[1])
        loaded["surface"].reshape(-1, 4)[newest["lamp"]] = newest["lamp_surface"].reshape(-1, 4)
        loaded["material"][newest["lamp"]] = newest["lamp_material"]
        for name, values in decode(later.rigid())[1].items():
            if name != "ball":  # around clusters where they were then
                np.testing.assert_array_equal(loaded[name], values, err_msg=name)


def test_contacts_and_owners_are_told_to_pages_that_show_them():
    with MemoryHub().bus("anna") as bus:
        scene = load_scene("demo")
        model = generate(scene)
        hangs = bunch_centres(model)[10]
        human = ScriptedHuman(frames.pose(np.array([hangs[0] - 0.55, hangs[1], 0.0])))
        client = Client(scene, model, None, bus, name="anna", pose=human.root, source=human)
        world = PageWorld(client)
        client.post_step.append(lambda _: world.collect(OnePage()))
        world.scene()
        human.do(human.reach("right", lambda: hangs))
        eyes = (0.0, 0.0, 1.6, 0.0, 0.0, 0.0, 1.0)
        for _ in range(400):
            client.tick()
            if client.physics.hand("anna", "right").held is not None:
                break
        header, arrays = decode(world.state(-1)[1])
        assert "owners" not in header
        assert arrays["contact_force"].size == 0, "nothing shows them"
        world.take(0, PageInput(1, eyes, overlays=True))
        client.tick()
        header, arrays = decode(world.state(-1)[1])
        tree = int(model.body_tree[model.bunch_body[10]])
        assert header["owners"][f"tree/{tree}"] == "anna"
        own = [contact for contact in client.physics.contacts if contact.actor == "anna"]
        np.testing.assert_allclose(
            arrays["contact_force"].reshape(-1, 3).sum(0),
            -np.sum([c.force for c in client.physics.contacts], 0),
            atol=1e-3,
        )
        palm = client.physics.hand("anna", "right").pose[:3]
        assert own
        assert np.linalg.norm(arrays["contact_place"].reshape(-1, 3) - palm, axis=1).min() < 0.15
        world.leave(0)
        client.tick()
        assert "owners" not in decode(world.state(-1)[1])[0]


def test_the_page_of_a_robot_far_away_shows_it_and_the_vines():
    with MemoryHub().bus("visitor") as bus:
        scene = load_scene("demo")
        model = generate(scene)
        start = frames.pose(np.array([-12.0, 3.0, 0.0]), frames.from_yaw(2.5))
        client = Client(scene, model, load_description("vinebot"), bus, name="visitor", pose=start)
        view = decode(PageWorld(client).scene())[1]["start"]
    local = frames.rotate(frames.conjugate(view[3:]), np.vstack([model.tree_pose[:, :3], start[:3]]) - view[:3])
    angles = np.arctan2(local[:, 1], local[:, 0])
    assert angles[:-1].min() < 0.0 < angles[:-1].max(), "vines on both sides of the middle"
    assert abs(angles[-1]) < 0.6, "the robot is in the picture"


def test_of_a_large_vineyard_a_page_loads_what_is_nearest(shown):
    """At first to where it looks from, later to where it has come."""
    client, _ = shown
    whole = decode(PageWorld(client).scene())[1]
    world = PageWorld(client, most=5000)
    first = decode(world.scene())
    later = decode(world.plants(np.array([3.0, -1.0, 1.0])))
    assert first[0]["room"] == 5000
    assert later[0]["place"] == [3.0, -1.0, 1.0]
    for (header, part), place in ((first, client.pose[:3]), (later, [3.0, -1.0, 1.0])):
        assert 4900 < len(part["material"]) <= 5000
        np.testing.assert_array_equal(part["first"], np.cumsum(part["size"]) - part["size"])

        def away(arrays, place=place):
            material = arrays["material"][arrays["first"]]
            share = [LOADED.get(int(one), ELSE_LOADED) for one in material]
            return np.linalg.norm(arrays["ball"].reshape(-1, 4)[:, :3] - place, axis=1) / share

        left_out = np.sort(away(whole))[len(part["size"])]
        assert away(part).max() <= left_out + 1e-6
        assert header["reach"] == pytest.approx(left_out, abs=1e-5)
        cluster = len(part["size"]) // 2
        same = np.flatnonzero((whole["ball"].reshape(-1, 4) == part["ball"].reshape(-1, 4)[cluster]).all(1))[0]
        rows = [
            slice(int(a["first"][k]), int(a["first"][k] + a["size"][k])) for a, k in ((part, cluster), (whole, same))
        ]
        np.testing.assert_array_equal(part["shape"].reshape(-1, 16)[rows[0]], whole["shape"].reshape(-1, 16)[rows[1]])
    assert decode(PageWorld(client).scene())[0]["reach"] is None


def test_after_a_reset_a_page_is_told_of_all_trees_that_had_moved(shown):
    client, world = shown
    world.scene()
    swing(client, 3)
    client.physics.pick(4)
    client.tick()
    tick, _ = world.state(-1)
    client.reset()
    client.tick()
    arrays = decode(world.state(tick)[1])[1]
    bodies = client.model.bodies_of(3)
    assert set(range(bodies.start, bodies.stop)) <= set(arrays["body"].tolist())
    np.testing.assert_allclose(arrays["place"], client.physics.state.body_q[arrays["body"], :3], atol=1e-6)
    assert arrays["picked"].tolist() == []
