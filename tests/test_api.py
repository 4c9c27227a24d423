"""The public interface: lazy loading, and energies, momenta, tips and damping against independent
formulas."""

import ast
import inspect
import pathlib
import re
import subprocess
import sys
import urllib.error
import urllib.request
import warnings

import numpy as np
import pytest

import vinesim
from tests.support.contact_scenes import bunch_scene
from tests.support.waiting import deadline
from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.net.codec.control import Hello, encode_hello
from vinesim.net.recording.mcap_writer import RecordingWriter

G = 9.81
EI = 5e9 * np.pi / 4.0 * 0.004**4
"""[N m^2] of the default cane."""


# ---------------------------------------------------------------- names


def test_import_loads_nothing_else():
    script = (
        "import sys, vinesim; "
        "heavy = {'numpy', 'warp', 'mujoco', 'zenoh', 'cv2', 'msgspec'} & set(sys.modules); "
        "assert not heavy, heavy; assert 'Simulation' in dir(vinesim)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=pathlib.Path(vinesim.__file__).parents[1])


def test_every_public_name_loads_and_is_documented():
    assert set(vinesim.__all__) == {*vinesim._MODULES, "__version__"}
    for name in vinesim._MODULES:
        assert inspect.getdoc(getattr(vinesim, name)), name


def test_type_checkers_find_the_same_names():
    tree = ast.parse(pathlib.Path(vinesim.__file__).read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    samples = {}
    for line in block.body:
        assert isinstance(line, ast.ImportFrom)
        for alias in line.names:
            assert alias.asname == alias.name  # a re-export
            module = f"{line.module}.frames" if alias.name == "frames" else line.module
            samples[alias.name] = module.removeprefix("vinesim.")
    assert samples == vinesim._MODULES


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(AttributeError, match=r"no attribute 'Simulator'; it offers .*Simulation"):
        vinesim.Simulator  # noqa: B018


# ---------------------------------------------------------------- canes


def test_a_new_straight_cane_sags():
    """A straight cane is not in equilibrium: it starts awake, sags and falls asleep in another shape."""
    simulation = vinesim.Simulation(vinesim.CaneBuilder(tip_mass=0.05, damping_ratio=0.5))
    assert simulation.awake.tolist() == [0]
    start = simulation.tip()
    np.testing.assert_allclose(start, [1.0, 0.0, 1.0], atol=1e-6)
    simulation.step(600)
    assert simulation.awake.tolist() == []
    assert start[2] - simulation.tip()[2] > 0.1


def test_a_cane_in_equilibrium_stays_asleep():
    drawn = vinesim.CaneBuilder(tip_mass=0.05, shape="equilibrium")
    moving = vinesim.CaneBuilder(tip_mass=0.05)
    assert vinesim.Simulation([drawn, moving]).awake.tolist() == [1]
    simulation = vinesim.Simulation("demo")
    assert len(simulation.awake) == 0
    assert len(vinesim.Simulation(drawn, sleep=False).awake) == 0


def test_the_tip_of_a_loaded_cane_is_on_the_elastica():
    """Tip load P L^2 / EI = 1, light cane: the tip is at x 0.94357 L, 0.30172 L below (Bisshopp and Drucker, 1945)."""
    light = vinesim.CaneBuilder(segments=48, density=1.0, tip_mass=EI / G, damping_ratio=1.0)
    simulation = vinesim.Simulation(light, sleep=False)
    simulation.step(1500)
    x, _, z = simulation.tip()
    assert x == pytest.approx(0.94357, abs=1e-3)
    assert 1.0 - z == pytest.approx(0.30172, abs=1e-3)


@pytest.mark.parametrize("ratio", [0.02, 0.1])
def test_the_damping_ratio_is_that_of_the_decrement(ratio):
    """Pulled sideways and released: the logarithm of successive peaks falls by 2 pi ratio / sqrt(1 - ratio^2)."""
    cane = vinesim.CaneBuilder(length=0.5, tip_mass=0.05, damping_ratio=ratio, shape="equilibrium")
    simulation = vinesim.Simulation(cane, sleep=False)
    simulation.apply_wrench(simulation.tip_body(), (0.0, 1.0, 0.0), at=simulation.tip())
    simulation.step(1)
    way = []
    for _ in range(200):
        simulation.step()
        way.append(simulation.tip()[1])
    way = np.array(way)
    inner = np.flatnonzero((np.abs(way[1:-1]) > np.abs(way[:-2])) & (np.abs(way[1:-1]) >= np.abs(way[2:]))) + 1
    left = np.abs(way[inner - 1])
    top = np.abs(way[inner])
    right = np.abs(way[inner + 1])
    peaks = (top + (left - right) ** 2 / (8.0 * (2.0 * top - left - right)))[:7]  # of the parabola through three
    decrement = -np.polyfit(0.5 * np.arange(len(peaks)), np.log(peaks), 1)[0]  # two peaks a period
    assert decrement / np.hypot(2.0 * np.pi, decrement) == pytest.approx(ratio, rel=0.03)
    period = 2.0 * np.mean(np.diff(inner[:7])) * simulation.dt
    assert 2.0 * np.pi / period == pytest.approx(cane.first_mode() * np.sqrt(1.0 - ratio**2), rel=0.03)


def test_the_first_mode_is_that_of_the_beam():
    """Euler-Bernoulli: 1.8751^2 sqrt(EI / m L^4) without, and about sqrt(3 EI / (M + 0.2357 m) L^3) with a tip mass."""
    per_length = 800.0 * np.pi * 0.004**2
    bare = vinesim.CaneBuilder(segments=64).first_mode()
    assert bare == pytest.approx(1.87510**2 * np.sqrt(EI / per_length), rel=1e-3)
    laden = vinesim.CaneBuilder(segments=64, tip_mass=0.4).first_mode()
    assert laden == pytest.approx(np.sqrt(3.0 * EI / (0.4 + 0.2357 * per_length)), rel=2e-3)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"length": -1.0}, r"cane: length is -1.0; give a finite number above 0"),
        ({"radius": (0.01, 0.0)}, r"cane: radius\[1\] is 0.0; give a finite number above 0"),
        ({"radius": "thin"}, r"cane: radius\[0\] is thin; give a finite number above 0"),
        ({"length": None}, r"cane: length is None; give a finite number above 0"),
        ({"tip_mass": float("nan")}, r"cane: tip_mass is nan; give a finite number of 0 or more"),
        ({"beta": "1"}, r"cane: beta is 1; give a finite number of 0 or more"),
        ({"segments": 0}, r"cane: segments is 0; give a whole number, 1 or more"),
        ({"segments": 2.5}, r"cane: segments is 2.5; give a whole number, 1 or more"),
        ({"damping_ratio": 0.1, "beta": 0.01}, r"damping_ratio 0.1 and beta 0.01 are given; give one"),
        ({"damping_ratio": 0.1, "base": "pinned"}, r"'pinned', so it has no bending mode"),
        ({"shape": "equilibrium", "base": "pinned"}, r"'pinned' carries no moment"),
        ({"bends": np.zeros((3, 3))}, r"bends has the shape \(3, 3\); give \[16, 3\]"),
        ({"pose": (0.0, 0.0, 1.0)}, r"pose is \[0.0, 0.0, 1.0\]; give position \[m\] and unit quaternion"),
        ({"pose": (0.0,) * 7}, r"pose is .*; give position \[m\] and unit quaternion"),
    ],
)
def test_an_invalid_cane_is_refused_in_one_line(field, message):
    with pytest.raises(ValueError, match=message) as error:
        vinesim.cane(**field)
    assert "\n" not in str(error.value)


def test_numbers_of_numpy_build_the_same_cane():
    plain = vinesim.cane(length=1, radius=0.25, tip_mass=2, segments=4)
    same = vinesim.cane(length=np.int64(1), radius=np.float32(0.25), tip_mass=np.float32(2.0), segments=np.int64(4))
    assert plain.digest() == same.digest()
    assert vinesim.cane(radius=np.array([0.5, 0.25])).digest() == vinesim.cane(radius=(0.5, 0.25)).digest()


def test_a_drawn_bend_is_the_unloaded_shape():
    """A quarter circle of 1 m, drawn with equal bends; without weight it keeps its shape."""
    bends = np.zeros((32, 3))
    bends[1:, 2] = 0.5 * np.pi / 32
    simulation = vinesim.Simulation(vinesim.CaneBuilder(segments=32, bends=bends, shape="equilibrium"))
    radius = 2.0 / np.pi
    np.testing.assert_allclose(simulation.tip(), [radius, radius, 1.0], atol=0.02)


# ---------------------------------------------------------------- energy and momentum


def test_energy_of_a_pendulum():
    """One rigid rod on a pin, 90 degrees: m L^2 omega^2 / 6 and m g z from the tip's path; their sum stays, to 1 %."""
    rod = vinesim.CaneBuilder(length=1.5, segments=1, base="pinned", density=700.0, pose=(0, 0, 2, 0, 0, 0, 1))
    simulation = vinesim.Simulation(rod, parameters=vinesim.PhysicsParameters(phi=0.5), sleep=False)
    mass = 700.0 * np.pi * 0.004**2 * 1.5
    begin = simulation.energy()
    assert begin.kinetic == 0.0
    assert begin.gravitational == pytest.approx(mass * G * 2.0, rel=1e-5)
    tips = [simulation.tip()]
    samples = [begin]
    for _ in range(300):
        simulation.step()
        tips.append(simulation.tip())
        samples.append(simulation.energy())
    tips = np.array(tips)
    assert tips[:, 2].min() < 0.51  # it passed the lowest point
    speed = np.linalg.norm(tips[2:] - tips[:-2], axis=1) / (2.0 * simulation.dt)
    kinetic = mass * speed**2 / 6.0  # the tip moves at L omega
    # a chord is shorter than the arc by (omega dt)^2 / 6, less than a tenth of a percent here
    np.testing.assert_allclose([e.kinetic for e in samples[1:-1]], kinetic, rtol=0.01, atol=1e-4)
    height = 2.0 + 0.5 * (tips[:, 2] - 2.0)
    np.testing.assert_allclose([e.gravitational for e in samples], mass * G * height, rtol=1e-4)
    assert [e.elastic for e in samples] == [0.0] * len(samples)
    swing = mass * G * 0.75
    assert np.ptp([e.total for e in samples]) < 0.01 * swing


def test_energy_of_an_undamped_cane_is_conserved():
    """Released straight, phi 1/2, 10 s: kinetic, elastic and gravitational energy pass into each other, total to 2
    %."""
    cane = vinesim.CaneBuilder(length=0.6, tip_mass=0.02)
    simulation = vinesim.Simulation(cane, parameters=vinesim.PhysicsParameters(phi=0.5), sleep=False)
    samples = [simulation.energy()]
    for _ in range(1000):
        simulation.step()
        samples.append(simulation.energy())
    exchanged = np.ptp([e.gravitational for e in samples])
    assert max(e.kinetic for e in samples) > 0.2 * exchanged
    assert max(e.elastic for e in samples) > 0.8 * exchanged
    assert np.ptp([e.total for e in samples]) < 0.02 * exchanged


def test_elastic_energy_is_the_work_of_the_load():
    """Small deflection under a tip weight: the energy of the beam is P^2 L^3 / 6 EI (Clapeyron)."""
    mass = 0.1 * EI / G  # P L^2 / EI = 0.1
    cane = vinesim.CaneBuilder(segments=48, density=1.0, tip_mass=mass, damping_ratio=1.0)
    simulation = vinesim.Simulation(cane, sleep=False)
    simulation.step(1000)
    assert simulation.energy().elastic == pytest.approx((mass * G) ** 2 / (6.0 * EI), rel=0.01)


def test_momentum_of_a_floating_tree():
    """Cut and moving: momentum grows by F t + m g t, angular momentum by r x F t + r_com x m g t."""
    cane = vinesim.CaneBuilder(length=0.6, tip_mass=0.05, pose=(0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 1.0))
    simulation = vinesim.Simulation(cane, sleep=False)
    simulation.cut(0)
    mass = float(simulation.model.body_mass.sum())
    body = simulation.tip_body()
    force = np.array([0.5, 2.0, 1.0])
    dt = simulation.dt
    point = simulation.tip()
    simulation.apply_wrench(body, force, at=point)
    before = simulation.momentum()
    centre = center_of_mass(simulation)
    simulation.step()
    after = simulation.momentum()
    weight = np.array([0.0, 0.0, -mass * G])
    np.testing.assert_allclose(after.linear - before.linear, dt * (force + weight), atol=1e-5)
    moment = np.cross(point, force) + np.cross(centre, weight)
    np.testing.assert_allclose(after.angular - before.angular, dt * moment, atol=5e-4)
    path = [center_of_mass(simulation)]
    for _ in range(20):
        simulation.step()
        path.append(center_of_mass(simulation))
    found = simulation.momentum().linear
    np.testing.assert_allclose(found, after.linear + 20 * dt * weight, atol=1e-4)
    mean = mass * (path[-1] - path[0]) / (20 * dt)  # half way between the momenta at both ends
    np.testing.assert_allclose(mean, 0.5 * (after.linear + found), atol=0.01)


def center_of_mass(simulation) -> np.ndarray:
    """[3] m, summed body by body from poses."""
    model = simulation.model
    poses = [simulation.body_pose(body) for body in range(len(model.body_mass))]
    centres = [pose[:3] + frames.rotate(pose[3:], com) for pose, com in zip(poses, model.body_com, strict=True)]
    return np.average(centres, axis=0, weights=model.body_mass)


# ---------------------------------------------------------------- simulation


def test_a_wrench_wakes_its_tree_and_ends_with_the_step():
    simulation = vinesim.Simulation(vinesim.CaneBuilder(shape="equilibrium", damping_ratio=0.5))
    assert len(simulation.awake) == 0
    start = simulation.tip()
    simulation.apply_wrench(simulation.tip_body(), (0.0, 0.2, 0.0))
    simulation.apply_wrench(simulation.tip_body(), (0.0, 0.2, 0.0))
    assert simulation.awake.tolist() == [0]
    simulation.step(300)
    held = simulation.tip()[1]
    bent = 0.4 / 3.0 / EI  # P L^3 / 3 EI, applied 1/32 L before the tip
    assert held == pytest.approx(bent * (1.0 - 1.5 / 32.0), rel=0.05)
    simulation.step(600)
    np.testing.assert_allclose(simulation.tip(), start, atol=2e-3)
    assert not simulation.physics.plants.body_load.any()


def test_a_written_pose_is_applied_at_once():
    simulation = vinesim.Simulation(vinesim.CaneBuilder(shape="equilibrium"))
    simulation.snapshot()
    simulation.state.joint_q[0] = frames.exp(np.array([0.0, 0.0, 0.3]))
    simulation.wake()
    assert simulation.tip()[1] == pytest.approx(np.sin(0.3), abs=0.02)
    np.testing.assert_array_equal(simulation.snapshot().body_q, simulation.state.body_q)
    before = simulation.tip()
    simulation.step(5)
    assert simulation.tip()[1] < before[1] - 0.01
    assert simulation.time == pytest.approx(0.05)


def test_a_robot_bends_a_cane_on_its_path():
    upwards = frames.pose(np.array([1.0, 0.0, 0.0]), frames.from_x_axis(np.array([0.0, 0.0, 1.0])))
    simulation = vinesim.Simulation(vinesim.CaneBuilder(length=1.2, pose=upwards, damping_ratio=0.1), dt=0.01)
    robot = simulation.add_robot("vinebot", name="picker")
    assert isinstance(robot, vinesim.Robot)
    contacts = []
    for _ in range(320):
        robot.command_base(0.2, 0.0, simulation.time)
        simulation.step()
        contacts += simulation.contacts
    assert {contact.actor for contact in contacts} == {"picker"}
    assert sum(contact.force[0] for contact in contacts) < -10.0  # on the robot, against its motion
    assert simulation.tip()[0] > 1.05
    with pytest.raises(UsageError, match="robot 'picker' exists already; give another name"):
        simulation.add_robot("vinebot", name="picker")


def test_a_picked_bunch_is_a_detachment():
    simulation = vinesim.Simulation(vinesim.load_scene("demo", seed=3))
    simulation.pick(2)
    simulation.step(2)
    assert [one.bunch for one in simulation.detachments] == [2]
    simulation.step()
    assert simulation.detachments == ()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: s.tip(1), "tree 1 does not exist; give 0 to 0"),
        (lambda s: s.body_pose(99), "body 99 does not exist; give 0 to 15"),
        (lambda s: s.pick(0), "bunch 0 does not exist"),
        (lambda s: s.cut(2.7), "body 2.7 does not exist; give 0 to 15, a whole number"),
        (lambda s: s.wake("left"), "tree left does not exist"),
        (lambda s: s.step(-1), "count is -1; give a whole number of steps, 0 or more"),
        (lambda s: s.step(2.5), "count is 2.5; give a whole number of steps, 0 or more"),
        (lambda s: s.add_robot("vinebot", np.zeros(7)), r"pose is \[0.0, .*; give position \[m\] and unit quaternion"),
        (lambda _: vinesim.Simulation(None), "cannot simulate a NoneType; give a scene, a model or cane builders"),
        (lambda s: s.apply_wrench(0, (1.0, 2.0)), r"force is \(1.0, 2.0\); give three finite numbers \[N\]"),
        (lambda s: s.add_robot("vinebot", (1.0, 2.0)), r"pose is \[1.0, 2.0\]; give \(x, y, yaw\)"),
        (lambda s: vinesim.Lidar().scan(s), "no place, or two; give either a pose"),
        (lambda s: vinesim.look_at((0, 0, 0), (0, 0, 0)), "give two points"),
        (lambda s: vinesim.Simulation([1.0]), "cannot simulate a list; give a scene, a model or cane builders"),
    ],
)
def test_invalid_calls_are_refused_in_one_line(call, message):
    simulation = vinesim.Simulation(vinesim.CaneBuilder())
    with pytest.raises(UsageError, match=message) as error:
        call(simulation)
    assert "\n" not in str(error.value)


# ---------------------------------------------------------------- sensors, recordings, clients


def test_cameras_and_lidars_render_the_current_state():
    simulation = vinesim.Simulation(vinesim.CaneBuilder(radius=0.02, shape="equilibrium"))
    camera = vinesim.Camera("pinhole", size=(64, 48))
    pose = vinesim.look_at((0.5, -0.6, 1.0), (0.5, 0.0, 1.0))
    frame = camera.render(simulation, pose)
    assert frame.rgb.shape == (48, 64, 3)
    cane = frame.organs == vinesim.Organ.CANE
    assert frame.depth[cane].min() == pytest.approx(0.58, abs=0.005)
    simulation.state.joint_q[0] = frames.exp(np.array([0.0, 0.0, 1.2]))
    simulation.wake()
    assert (camera.render(simulation, pose).organs == vinesim.Organ.CANE).sum() < 0.7 * cane.sum()
    scan = vinesim.Lidar("vlp16").scan(simulation, (0.0, -2.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    assert len(scan.xyz) == len(scan.organs) > 100


def test_a_recording_is_read_message_by_message(tmp_path):
    path = tmp_path / "run.mcap"
    hello = encode_hello(Hello(name="ada", kind="spectator", scene="demo", digest="0" * 16, index=1))
    with RecordingWriter(path, {"scene": "demo"}) as file:
        file.put(1_000_000_000, "live/ada", b"1")
        file.put(1_500_000_000, "hello/ada", hello)
    recording = vinesim.Recording(path)
    assert recording.info["scene"] == "demo"
    assert (recording.actors, len(recording), recording.damage) == (["ada"], 2, "")
    assert recording.duration == pytest.approx(0.5)
    first, second = recording
    assert (first.time, first.actor, first.data["live"]) == (0.0, "ada", True)
    assert (second.key, second.data["kind"]) == ("hello/ada", "spectator")


def test_a_client_without_peers_drives_its_robot():
    with vinesim.Client("demo", name="ada", pose=(-2.0, 0.0, 0.0)) as client:
        for _ in range(100):
            client.robot.command_base(0.3, 0.0, client.time)
            client.step()
        assert client.time == pytest.approx(1.0)
        assert client.remote_actors == ()
        assert client.actor_pose("ada")[0] > -1.85
        with pytest.raises(KeyError, match="no actor 'bob'; there are: ada"):
            client.actor_pose("bob")


def test_the_vineyard_of_a_client_in_a_cell_of_a_notebook():
    with vinesim.Client("demo", name="ada", pose=(-2.0, 0.0, 0.0)) as client:
        page = client.page()
        (address,) = re.findall(r'<iframe src="([^"]+)"', page._repr_html_())
        assert address.startswith(page.address)
        with urllib.request.urlopen(address, timeout=deadline(60.0)) as answer:
            assert b"vinesim" in answer.read()
            assert "frame-ancestors 'self' http://localhost:* " in answer.headers["Content-Security-Policy"]
            assert "X-Frame-Options" not in answer.headers
        client.step()
    with pytest.raises(urllib.error.URLError, match="refused"):  # the page ends with the client
        urllib.request.urlopen(address, timeout=deadline(60.0))


# ---------------------------------------------------------------- robots


@pytest.mark.parametrize("by_itself", [False, True])
def test_a_world_goes_on_without_a_robot_that_was_removed(by_itself):
    simulation = vinesim.Simulation([])
    first = simulation.add_robot("vinebot", (0.0, 0.0, 0.0))
    second = simulation.add_robot("vinebot", (0.0, 3.0, 0.0))
    simulation.push_robot(first.name, "arm_left_7_link", (1.0, 0.0, 0.0))
    if by_itself:
        first.remove()
    else:
        simulation.remove_robot(first.name)
    simulation.step(2)
    assert list(simulation.robots) == [second.name]
    third = simulation.add_robot("vinebot", (0.0, 0.0, 0.0))  # its name is no former one's
    simulation.step()
    assert list(simulation.robots) == ["robot_1", "robot_2"] == [second.name, third.name]
    with pytest.raises(UsageError, match="no robot 'robot_0'; there are: robot_1, robot_2"):
        simulation.remove_robot(first.name)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda one: one.apply_wrench(0, "abc"), r"force is abc; give three finite numbers \[N\]"),
        (lambda one: one.apply_wrench(0, [1.0, [2.0], 3.0]), r"force is .*; give three finite numbers \[N\]"),
        (lambda one: one.add_robot("vinebot", pose="here"), r"pose is here; give \(x, y, yaw\)"),
        (lambda _: vinesim.Simulation([], parameters={"dt": 0.01}), "parameters is a dict; give PhysicsParameters"),
    ],
)
def test_what_is_no_number_is_refused_in_one_line(call, message):
    with pytest.raises(UsageError, match=message) as error:
        call(vinesim.Simulation(vinesim.CaneBuilder()))
    assert "\n" not in str(error.value)


def test_a_push_on_a_robot_acts_in_one_call_of_step_and_is_felt_in_its_joints():
    simulation = vinesim.Simulation([])
    robot = simulation.add_robot("vinebot")
    (joint,) = robot.joint_indices(["arm_left_4_joint"])
    simulation.step(50)

    def felt():
        return robot.sample(simulation.time).joints.effort[joint]

    free = felt()
    link = "arm_left_7_link"
    centre = simulation.physics.rigid.link_centre(robot.name, link)
    simulation.push_robot(robot.name, link, (0.0, 0.0, 10.0))
    simulation.step(100)
    pushed = felt()
    assert abs(pushed - free) > 0.5
    simulation.push_robot(robot.name, link, (0.0, 0.0, 10.0), at=centre)  # the same, in other words
    simulation.step(100)
    assert felt() == pytest.approx(pushed, abs=0.02)
    simulation.step(100)  # the push has ended
    assert felt() == pytest.approx(free, abs=0.02)


def test_a_push_on_what_is_not_there_is_refused():
    simulation = vinesim.Simulation([])
    with pytest.raises(UsageError, match="no robot 'bob'; there are: none"):
        simulation.push_robot("bob", "hand", (0.0, 0.0, 1.0))
    simulation.add_robot("vinebot", name="bob")
    with pytest.raises(ValueError, match="force"):
        simulation.push_robot("bob", "arm_left_7_link", (0.0, 1.0))
    with pytest.raises(Exception, match="no_such_link"):
        simulation.push_robot("bob", "no_such_link", (0.0, 0.0, 1.0))


# ---------------------------------------------------------------- faults


def test_a_tree_that_is_stopped_is_counted_and_warned_of_once():
    simulation = vinesim.Simulation(vinesim.CaneBuilder())
    simulation.step()
    assert simulation.faults == {}
    body = simulation.tip_body()
    simulation.apply_wrench(body, (1e30, 0.0, 0.0))
    with pytest.warns(RuntimeWarning, match="1 trees moved too fast, .* reset to rest .*trees_stopped") as told:
        simulation.step(2)
    assert [one.filename for one in told] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulation.apply_wrench(body, (1e30, 0.0, 0.0))
        simulation.step(2)
    assert simulation.faults == {"trees_stopped": 2}


def test_a_tree_that_turns_too_fast_is_counted_and_warned_of():
    """A base joint without a spring is let go at 100 rad/s, twice the limit."""
    spinning = vinesim.Simulation(vinesim.CaneBuilder(base="pinned", segments=1), sleep=False)
    spinning.state.joint_qd[0, 1] = 100.0
    with pytest.warns(RuntimeWarning, match="turned faster than max_joint_rate") as told:
        spinning.step()
    assert set(spinning.faults) == {"trees_slowed"}
    assert len(told) == 1


# ---------------------------------------------------------------- impossible values


def bunch_on_cane(mass=0.3, **fields):
    tree = vinesim.CaneBuilder(length=0.5, damping_ratio=0.1).tree()
    tree.add_bunch(len(tree.bodies) - 1, mass, **fields)
    return vinesim.assemble([tree])


def with_model_value(name, value):
    model = bunch_on_cane()
    getattr(model, name)[0] = value
    return vinesim.Simulation(model)


def with_state_value(simulation, name, value, call):
    getattr(simulation.state, name)[3] = value
    call(simulation)


def rod(length=0.5, segments=4, bends=None, rest=frames.IDENTITY, **material):
    tree = vinesim.TreeBuilder(frames.pose(np.array([0.0, 0.0, 1.0])))
    wood = vinesim.RodMaterial(**{"modulus": 5e9, "density": 800.0, "damping": 0.01} | material)
    tree.add_rod(-1, length, (0.004, 0.003), wood, segments, bends=bends, rest=rest)
    return vinesim.Simulation(tree)


NAN = float("nan")
ON_A_CANE = [
    (lambda s: s.cut(True), "body True does not exist; give 0 to 15, a whole number"),
    (lambda s: s.cut(np.True_), "body True does not exist; give 0 to 15, a whole number"),
    (lambda s: s.tip(False), "tree False does not exist; give 0 to 0, a whole number"),
    (lambda s: s.step(True), "count is True; give a whole number of steps, 0 or more"),
    (lambda s: s.apply_wrench(0, (True, False, True)), r"force is .*; give three finite numbers \[N\]"),
    (lambda s: s.apply_wrench(0, (True, 0.0, 1.0)), r"force is .*; give three finite numbers \[N\]"),
    (lambda s: s.apply_wrench(0, ("1", "2", "3")), r"force is .*; give three finite numbers \[N\]"),
    (lambda s: s.apply_wrench(0, (1e39, 0.0, 0.0)), r"force is .*; give three finite numbers \[N\]"),
    (lambda s: s.apply_wrench(0, (0, 0, 1), at=(NAN, 0, 0)), r"at is .*; give three finite numbers \[m\]"),
    (
        lambda s: with_state_value(s, "joint_q", 0.0, lambda s: s.wake()),
        r"state.joint_q\[3\] is \[0.0, .*; give a unit q",
    ),
    (
        lambda s: with_state_value(s, "joint_q", 0.0, lambda s: s.step()),
        r"state.joint_q\[3\] is \[0.0, .*; give a unit q",
    ),
    (lambda s: with_state_value(s, "joint_q", (0, 0, 0, 2), lambda s: s.step()), "give a unit quaternion"),
    (
        lambda s: with_state_value(s, "joint_q", NAN, lambda s: s.step()),
        r"state.joint_q\[3\] is \[nan, .*; give a unit",
    ),
    (
        lambda s: with_state_value(s, "joint_qd", NAN, lambda s: s.step()),
        r"state.joint_qd\[3\] is \[nan, .*finite rates",
    ),
    (lambda s: s.add_robot("vinebot", (True, 0, 0)), r"pose is \(True, 0, 0\); give \(x, y, yaw\)"),
    (lambda s: s.add_robot("vinebot", name=3), "name is 3; give a text, or none"),
    (lambda s: s.add_robot("vinebot").command_base(True, 0.0, 0.0), r"base velocity is \(True, 0.0\); give finite"),
    (lambda s: s.add_robot("vinebot").command_position([True], ["head_1_joint"]), "'head_1_joint' is not finite; give"),
]
ALONE = [
    (lambda: vinesim.Simulation(vinesim.CaneBuilder(), dt=True), "physics.dt is True; give a finite number"),
    (lambda: vinesim.Simulation(vinesim.CaneBuilder(), detach="no"), "detach is 'no'; give True or False"),
    (lambda: vinesim.Simulation(vinesim.CaneBuilder(), device=3), "device 3: give cpu, cuda or cuda:N"),
    (lambda: vinesim.cane(length=True), "cane: length is True; give a finite number above 0"),
    (lambda: vinesim.cane(segments=True), "cane: segments is True; give a whole number, 1 or more"),
    (lambda: vinesim.cane(radius=(True, 0.004)), r"cane: radius\[0\] is True; give a finite number above 0"),
    (lambda: vinesim.cane(tip_mass=True), "cane: tip_mass is True; give a finite number of 0 or more"),
    (lambda: vinesim.cane(pose="here"), "cane: pose is here; give position .* and unit quaternion"),
    (lambda: vinesim.cane(pose=(0, 0, 1, 0, 0, 0, 0)), "cane: pose is .*; give position .* and unit quaternion"),
    (lambda: with_model_value("bunch_pull", -1.0), "bunch 0: bunch_pull is -1.0; give a number above 0"),
    (lambda: with_model_value("bunch_bend", 0.0), "bunch 0: bunch_bend is 0.0; give a number above 0"),
    (lambda: with_model_value("bunch_variety", 99), "bunch 0: bunch_variety is 99; give 0 to"),
    (lambda: with_model_value("bunch_body", 99), "bunch 0: bunch_body is 99; give 0 to"),
    (lambda: with_model_value("tree_pose", 0.0), "root frame's rotation .*; give a unit quaternion xyzw"),
    (lambda: with_model_value("body_organ", 99), "body 0 of tree 0: organ 99; give a member of vinesim.Organ"),
    (lambda: bunch_on_cane(pull=-1.0), "bunch on body 15: pull is -1.0; give a finite number above 0"),
    (lambda: bunch_on_cane(bend=True), "bunch on body 15: bend is True; give a finite number above 0"),
    (lambda: bunch_on_cane(pul=3.0), "bunch on body 15 has no field 'pul'; it has: pull, bend"),
    (lambda: bunch_on_cane(mass=True), "bunch of True kg, .* give a finite mass above 0"),
    (lambda: bunch_on_cane(count=2.5), "bunch of 0.3 kg, 2.5 berries; give a finite mass above 0"),
    (lambda: bunch_on_cane(seed=-1), "bunch on body 15: seed is -1; give a whole number from 0"),
    (lambda: rod(length=NAN), "rod of length nan m, .*: all must be positive and finite"),
    (lambda: rod(segments=2.5), "rod of .* 2.5 segments, .* segments a whole number"),
    (lambda: rod(damping=-1.0), "rod of .*damping=-1.0.*: all must be positive and finite"),
    (lambda: rod(shear_modulus=NAN), "rod of .*shear_modulus=nan.*: all must be positive and finite"),
    (lambda: rod(bends=np.zeros((2, 4))), r"rod: bends has the shape \(2, 4\); give \[4, 4\]"),
    (lambda: rod(rest=np.zeros(4)), "rest rotation .*; give a unit quaternion xyzw"),
    (lambda: vinesim.load_scene("demo", seed=True), "seed is True: give a whole number of 0 to 9223372036854775807"),
    (lambda: vinesim.load_scene("demo", seed=1.5), "seed is 1.5: give a whole number of 0 to 9223372036854775807"),
    (lambda: vinesim.look_at((NAN, 0, 0), (1, 0, 0)), "cannot look from .*; give two points"),
    (lambda: next(iter(vinesim.sweep(abs, [1], workers=True))), "workers is True; give a whole number of 1 or more"),
    (lambda: vinesim.reachable_grasps("demo", reach=NAN), r"reach is nan; give a finite number above 0 \[m\]"),
    (lambda: vinesim.reachable_grasps("demo", spawn=True), "spawn is True; give a whole number"),
]


@pytest.mark.parametrize(("call", "message"), [pytest.param(*row, id=row[1][:40]) for row in ON_A_CANE])
def test_calls_with_impossible_values_are_refused_and_the_world_goes_on(call, message):
    simulation = vinesim.Simulation(vinesim.CaneBuilder(), sleep=False)
    before = simulation.state.joint_q[3].copy()
    with pytest.raises(ValueError, match=message) as error:
        call(simulation)
    assert "\n" not in str(error.value)
    simulation.state.joint_q[3] = before
    simulation.state.joint_qd[3] = 0.0
    simulation.step()
    assert simulation.faults == {}


@pytest.mark.parametrize(("call", "message"), [pytest.param(*row, id=row[1][:40]) for row in ALONE])
def test_impossible_values_are_refused_in_one_line(call, message):
    with pytest.raises(ValueError, match=message) as error:
        call()
    assert "\n" not in str(error.value)


# ---------------------------------------------------------------- experiments without a scene

MID_WIRE = 4.0 * 900.0 / 2.0
"""Stiffness of a string of 900 N and 2 m at its middle [N/m]."""


@pytest.mark.parametrize(("wire", "stiffness"), [(None, 2000.0), (0, 1.0 / (1.0 / 2000.0 + 1.0 / MID_WIRE))])
def test_a_tie_carries_a_bar_on_its_spring_and_the_string_law_of_the_wire(wire, stiffness):
    """A bar on a hinge, tied below its centre of mass: the tie carries the weight, m g = k d."""
    bar = vinesim.CaneBuilder(length=1.0, radius=0.01, base="pinned", segments=1)
    model = vinesim.assemble(
        [bar],
        wires=[vinesim.Wire((0.5, -1.0, 1.0), (0.5, 1.0, 1.0), tension=900.0)],
        ties=[vinesim.Tie(tree=0, along=0.5, wire=wire, stiffness=2000.0)],
    )
    simulation = vinesim.Simulation(model, sleep=False)
    simulation.step(1000)
    weight = G * 800.0 * np.pi * 0.01**2
    assert 1.0 - simulation.tip()[2] == pytest.approx(2.0 * weight / stiffness, rel=0.01)


def test_the_shear_modulus_of_a_cane_sets_its_twist():
    """Torsion of a round rod: angle = T L / G J, less half a segment."""
    cane = vinesim.CaneBuilder(shear_modulus=1e9, damping_ratio=0.5, shape="equilibrium")
    simulation = vinesim.Simulation(cane, sleep=False)
    body = simulation.tip_body()
    before = simulation.body_pose(body)
    simulation.apply_wrench(body, (0.0, 0.0, 0.0), (0.01, 0.0, 0.0))
    simulation.step(600)
    turned = frames.log(frames.multiply(frames.conjugate(before[3:]), simulation.body_pose(body)[3:]))
    polar = np.pi * 0.004**4 / 2.0
    assert turned[0] == pytest.approx(0.01 * (1.0 - 0.5 / 16.0) / (1e9 * polar), rel=0.02)


@pytest.mark.parametrize(
    ("shape", "size", "reach"),
    [("sphere", (0.03,), 0.03), ("capsule", (0.02, 0.2), 0.02), ("box", (0.06, 0.04, 0.05), 0.02)],
)
def test_a_pusher_bends_a_cane_by_the_force_of_beam_theory(shape, size, reach):
    """A clamped beam that is bent by d at the distance a from its clamp: F = 3 EI d / a^3."""
    cane = vinesim.CaneBuilder(segments=32, damping_ratio=0.5, shape="equilibrium")
    simulation = vinesim.Simulation(cane, sleep=False)
    gap = 0.004 + reach
    pusher = simulation.add_pusher(shape=shape, size=size, position=(0.5, -gap - 0.01, 1.0))
    simulation.step(20)
    np.testing.assert_allclose(pusher.position, (0.5, -gap - 0.01, 1.0), atol=1e-5)
    assert not pusher.force.any()
    pusher.follow([(0.5, -gap, 1.0), (0.5, -gap + 0.02, 1.0)], speed=0.05)
    steps = 0
    while not pusher.is_done:
        simulation.step()
        steps += 1
    assert steps == round(0.03 / 0.05 / simulation.dt)
    simulation.step(300)
    bent = pusher.position[1] + gap
    near = 0.5 - (0.5 * size[0] if shape == "box" else 0.0)  # a box touches with its edge, which the cane bends around
    assert -pusher.force[1] == pytest.approx(3.0 * EI * bent / near**3, rel=0.05)
    assert {contact.actor for contact in simulation.contacts} == {pusher.name} == {"pusher_0"}


def test_a_pusher_stalls_at_its_force():
    simulation = vinesim.Simulation(vinesim.CaneBuilder(radius=0.02, damping_ratio=0.5, shape="equilibrium"))
    pusher = simulation.add_pusher(position=(0.3, -0.05, 1.0), force=5.0)
    pusher.follow((0.3, 0.5, 1.0), speed=0.1)
    while not pusher.is_done:
        simulation.step()
    simulation.step(200)
    assert pusher.position[1] < 0.0
    assert -pusher.force[1] == pytest.approx(5.0, rel=0.01)
    simulation.remove_pusher(pusher.name)
    simulation.step(500)
    assert abs(simulation.tip()[1]) < 1e-3
    with pytest.raises(UsageError, match="no pusher 'pusher_0'; there are: none"):
        simulation.remove_pusher(pusher.name)


def test_boxes_fall_and_carry_and_go():
    model = vinesim.assemble([vinesim.CaneBuilder()], boxes=[vinesim.Box(position=(2.0, 0.0, 0.0))])
    simulation = vinesim.Simulation(model)
    second = simulation.add_box(vinesim.Box(position=(2.0, 0.0, 0.5), mass=1.0))
    simulation.step(300)
    assert sorted(simulation.boxes) == [0, second] == [0, 1]
    assert simulation.box_pose(0)[2] == pytest.approx(0.0, abs=2e-3)
    assert simulation.box_pose(second)[2] == pytest.approx(0.25, abs=5e-3)  # on the walls of the first
    simulation.remove_box(0)
    simulation.step(300)
    assert simulation.box_pose(second)[2] == pytest.approx(0.0, abs=2e-3)
    with pytest.raises(UsageError, match="no box 0; there are: 1"):
        simulation.box_pose(0)


def test_a_blade_on_a_pusher_cuts_the_cane_in_its_mouth():
    simulation = vinesim.Simulation(vinesim.CaneBuilder(damping_ratio=0.1, shape="equilibrium"))
    pusher = simulation.add_pusher(position=(0.5, -0.06, 1.0))
    blade = simulation.add_blade(pusher.name, "body", (0, 0.06, 0, 0, 0, 0, 1), size=(0.02, 0.04, 0.04))
    blade.close()
    simulation.step(2)
    (cut,) = simulation.detachments
    assert (cut.cause, cut.actor) == ("blade", pusher.name)


def blade_of(simulation: vinesim.Simulation, **fields) -> vinesim.Blade:
    """A blade on a new pusher, around the middle of a cane of the default builder."""
    pusher = simulation.add_pusher(position=(0.5, -0.06, 1.0))
    return simulation.add_blade(pusher.name, "body", (0, 0.06, 0, 0, 0, 0, 1), size=(0.02, 0.04, 0.04), **fields)


def test_a_blade_with_too_little_force_stalls_and_says_so():
    simulation = vinesim.Simulation(vinesim.CaneBuilder(damping_ratio=0.1, shape="equilibrium"))
    blade_of(simulation, force=50.0, speed=0.4).close()
    simulation.step(12)
    (closing,) = simulation.closings
    assert (closing.outcome, closing.force) == ("stalled", pytest.approx(50.0))
    assert 0.0 < closing.depth < closing.diameter
    assert simulation.detachments == ()
    simulation.step()
    assert simulation.closings == ()


def test_a_bunch_that_is_picked_falls_and_has_a_history():
    model, _, _ = bunch_scene()
    simulation = vinesim.Simulation(model)
    simulation.pick(0)
    simulation.step(120)
    (fall,) = [event for event in simulation.fruit_events if event.what == "dropped"]
    history = simulation.bunch_history(0)
    assert history.drop_height == fall.value > 1.5
    assert 0.0 < history.damage < 1.0


def test_a_wind_that_is_set_bends_a_cane_and_ends():
    model = vinesim.cane(damping_ratio=0.3, shape="equilibrium")
    model.body_drag[:] = 0.01
    simulation = vinesim.Simulation(model, sleep=False)
    simulation.wind = wind = vinesim.Wind((0.0, 4.0, 0.0))
    simulation.step(500)
    assert simulation.wind is wind
    assert simulation.tip()[1] > 0.05
    simulation.wind = None
    simulation.step(1500)
    assert abs(simulation.tip()[1]) < 2e-3


BUILDERS = [
    (lambda _: vinesim.Wire((0, 0, 1), (0, 0, 1)), "wire: start and end are .* that differ"),
    (lambda _: vinesim.Wire((0, 0, 1), (0, 1, 1), tension=-1.0), r"wire: tension is -1.0; give .* 0 or more \[N\]"),
    (lambda _: vinesim.Wire((0, 0, NAN), (0, 1, 1)), "wire: start is .*; give three finite numbers"),
    (lambda _: vinesim.Tie(along=True), "tie: along is True; give a finite number of 0 or more"),
    (lambda _: vinesim.Tie(along=0.1, stiffness=0.0), "tie: stiffness is 0.0; give a finite number above 0"),
    (lambda _: vinesim.Box(mass=-1.0), "box: mass is -1.0; give a finite number above 0"),
    (lambda _: vinesim.Box(size=(1, 1, 0)), "box: size is .*; give three lengths above 0"),
    (lambda _: vinesim.Box(position=(0, 0, 0, 0, 0, 0, 0)), "box: position is .* unit quaternion"),
    (lambda _: vinesim.assemble([vinesim.CaneBuilder()], ties=[vinesim.Tie(along=1.2)]), "tree 0 is 1.000 m long"),
    (
        lambda _: vinesim.assemble([vinesim.CaneBuilder()], ties=[vinesim.Tie(along=0.2, wire=0)]),
        "wire 0 does not exist",
    ),
    (lambda _: vinesim.assemble([], ties=[vinesim.Tie(along=0.2)]), "tie: tree 0 does not exist; there is none"),
    (lambda _: vinesim.assemble([], wires=[1.0]), "wires contain a float; give vinesim.Wire"),
    (lambda _: vinesim.cane(shear_modulus=-1.0), "cane: shear_modulus is -1.0; give a finite number above 0"),
    (lambda s: s.add_pusher(shape="cone", position=(0, 0, 1)), "shape is 'cone'; give one of: sphere, capsule, box"),
    (lambda s: s.add_pusher(size=(0.1, 0.1), position=(0, 0, 1)), r"size is .*; a sphere has \(radius,\)"),
    (lambda s: s.add_pusher(position=(0, 0, NAN)), "position is .*; give three finite numbers"),
    (lambda s: s.add_pusher(position=(0, 0, 1), force=-1.0), "force is -1.0; give a finite number above 0"),
    (lambda s: s.add_pusher(position=(0, 0, 1), mass=True), "mass is True; give a finite number above 0"),
    (lambda s: s.add_pusher(position=(3, 0, 1)).follow((0, 0), 0.1), "path is .*; give a point"),
    (lambda s: s.add_pusher(position=(3, 0, 1)).follow((0, 0, 1), -0.1), "speed is -0.1; give a finite number above 0"),
    (lambda s: s.add_box((0, 0, 0)), "box is a tuple; give vinesim.Box"),
    (lambda s: s.remove_box(True), "no box True; there are: none"),
    (lambda s: s.add_blade("bob", "body", size=(1, 1, 1)), "no robot or pusher 'bob'; there are: none"),
    (lambda s: blade_of(s, force=0.0), "force is 0.0; give more than 0 N"),
    (lambda s: blade_of(s, speed=True), "speed is True; give more than 0 m/s"),
    (lambda s: blade_of(s, kind="axe"), "kind is 'axe'; give bypass, anvil, saw"),
    (lambda s: blade_of(s).close(NAN), "a blade closes with nan N; give more than 0"),
    (lambda s: s.bunch_history(3), "bunch 3 does not exist"),
    (lambda s: setattr(s, "wind", 3.0), "wind is a float; give vinesim.Wind, or None"),
    (lambda _: vinesim.Wind((NAN, 0, 0)), "mean wind .*: give three finite numbers"),
    (lambda _: vinesim.Wind((1, 0, 0), gusts=-1.0), "gusts -1.0 m/s"),
]


@pytest.mark.parametrize(("call", "message"), [pytest.param(*row, id=row[1][:40]) for row in BUILDERS])
def test_impossible_experiments_are_refused_in_one_line(call, message):
    with pytest.raises(ValueError, match=message) as error:
        call(vinesim.Simulation(vinesim.CaneBuilder()))
    assert "\n" not in str(error.value)
