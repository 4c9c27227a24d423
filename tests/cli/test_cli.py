"""The command line: errors are one clear line and the right exit code, without traceback or partial files."""

import contextlib
import json
import pathlib
import signal
import socket
import subprocess
import sys
import threading

import pytest
import warp as wp

from tests.support import programs
from tests.support.waiting import deadline
from vinesim.net.codec.control import Hello, encode_hello
from vinesim.net.recording.mcap_writer import RecordingWriter
from vinesim.net.server.admission import SceneId
from vinesim.net.server.server import Server
from vinesim.net.transport.zenoh_bus import ZenohBus

CANE = str(pathlib.Path(__file__).parents[2] / "examples/cane.toml")
TIMEOUT = deadline(300.0)
"""Limit for a command [s]; reached only by a failure."""


def vinesim(*arguments, cwd=None):
    return programs.run([sys.executable, "-m", "vinesim", *arguments], timeout=TIMEOUT, cwd=cwd)


def assert_refused(done, code, *reasons):
    assert done.returncode == code, done.stderr
    progress = "vinesim: compiling kernels", "vinesim: waiting for another process"  # where no kernel is cached yet
    lines = [line for line in done.stderr.splitlines() if line.strip() and not line.startswith(progress)]
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("vinesim: ")
    for word in reasons:
        assert word in lines[0]


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_help_shows_every_command_with_examples():
    top = vinesim("--help").stdout
    for command in (
        "demo",
        "server",
        "client",
        "record",
        "replay",
        "train",
        "scene",
        "bench",
        "ros",
        "certs",
        "render",
        "dataset",
        "doctor",
    ):
        assert command in top
    commands = (["demo"], ["server"], ["client"], ["scene", "show"], ["bench"], ["ros", "build-interfaces"])
    for command in (*commands, ["certs", "new"], ["record"], ["replay"], ["render"], ["dataset"]):
        assert "Examples:" in vinesim(*command, "--help").stdout, command


def test_an_unknown_outfit_is_refused_with_the_known_ones():
    done = vinesim("client", "--role", "human", "--outfit", "pink", "--status", "none")
    assert_refused(done, 2, "--outfit pink", "orange", "brown")


def test_an_unknown_scene_is_refused():
    assert_refused(vinesim("scene", "show", "nowhere"), 2, "nowhere", "demo", "tendone", "vsp")


def test_an_invalid_scene_is_refused_with_file_field_and_remedy(tmp_path):
    (tmp_path / "bad.toml").write_text('name = "bad"\nseed = 1\ntraining = "tendone"\nrow_spacing = 2\n')
    done = vinesim("scene", "show", "bad.toml", cwd=tmp_path)
    assert_refused(done, 2, "bad.toml", "row_spacing")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.toml"]


@pytest.mark.parametrize(
    ("kind", "option", "value", "said"),
    [
        ("push", "--amplitude", "0.005", "amplitude is 0.005, but belongs to shake, not to push; leave it out"),
        ("pull-release", "--to", "4", "to_frequency is 4.0, but belongs to shake, not to pull-release; leave it out"),
        ("shake", "--displacement", "0.2", "displacement is 0.2, but belongs to pull-release or push, not to shake"),
        ("shake", "--force-noise", "0.01", "force_noise is 0.01, but a shaken plant is not pulled; leave it out"),
    ],
)
def test_an_option_of_another_kind_of_experiment_is_refused(kind, option, value, said, tmp_path):
    assert_refused(vinesim("experiment", kind, "--model", CANE, option, value, cwd=tmp_path), 2, said)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", [("experiment", "push"), ("tune", "pull.csv")])
def test_missing_scipy_is_one_line_with_the_extra(command, tmp_path):
    """A module that is None in sys.modules is one that cannot be imported."""
    code = "import sys; sys.modules['scipy'] = None; from vinesim.cli import main; main()"
    done = programs.run([sys.executable, "-c", code, *command, "--model", CANE], timeout=TIMEOUT, cwd=tmp_path)
    assert_refused(done, 3, "scipy is not installed; run: pip install 'vinesim[tune]'")


def test_an_invalid_urdf_is_refused(tmp_path):
    (tmp_path / "bad.urdf").write_text("<robot name='x'><link name='a'/></robot")
    assert_refused(
        vinesim("client", "--robot", str(tmp_path / "bad.urdf"), "--out", str(tmp_path / "out")), 2, "bad.urdf"
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "command",
    [
        ("demo",),
        ("demo", "--job", "pick"),
        ("render", "demo", "--at", "0.4,1.2,1.3", "--look", "3,1,1.7"),
        ("dataset", "--images", "1"),
    ],
)
def test_no_gpu_is_one_line_before_anything_is_written(command, tmp_path):
    out = tmp_path / "out"
    device = "cuda:0" if wp.get_cuda_device_count() == 0 else f"cuda:{wp.get_cuda_device_count()}"
    assert_refused(vinesim(*command, "--device", device, "--out", str(out)), 3, f"'{device}'")
    assert not out.exists()


def test_an_unavailable_device_is_refused():
    assert_refused(vinesim("client", "--device", "abacus"), 3, "abacus", "cpu, cuda")
    if wp.get_cuda_device_count() == 0:
        assert_refused(vinesim("client", "--device", "cuda:0"), 3, "'cuda:0'", "no NVIDIA GPU", "use cpu")


def test_an_unreachable_server_is_reported():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    assert_refused(
        vinesim("client", "--connect", endpoint, "--seconds", "1", "--no-ros"), 4, endpoint, "vinesim server"
    )


def test_a_port_in_use_is_reported():
    with socket.socket() as occupied:
        occupied.bind(("127.0.0.1", 0))
        occupied.listen()
        endpoint = f"tcp/127.0.0.1:{occupied.getsockname()[1]}"
        assert_refused(vinesim("server", "--listen", endpoint), 4, endpoint)


def test_files_that_cannot_be_replayed_are_refused(tmp_path):
    (tmp_path / "scene.toml").write_text('name = "demo"\n')
    assert_refused(vinesim("replay", "scene.toml", "--out", "pictures", cwd=tmp_path), 2, "scene.toml", "no MCAP file")
    with RecordingWriter(tmp_path / "old.mcap", {"protocol": "0", "release": "0.0.9"}):
        pass
    assert_refused(vinesim("replay", "old.mcap", "--out", "pictures", cwd=tmp_path), 2, "version 0", "0.0.9")
    with RecordingWriter(tmp_path / "empty.mcap"):
        pass
    assert_refused(vinesim("replay", "empty.mcap", "--out", "pictures", cwd=tmp_path), 2, "empty.mcap", "no message")
    assert not (tmp_path / "pictures").exists()


def test_recording_needs_a_server_and_a_writable_file(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    assert_refused(vinesim("record", "run.mcap", "--connect", endpoint, cwd=tmp_path), 4, endpoint, "vinesim server")
    assert list(tmp_path.iterdir()) == []
    with Server("tcp/127.0.0.1:0") as server:
        assert_refused(vinesim("record", "no/run.mcap", "--connect", server.endpoint, cwd=tmp_path), 5, "no/run.mcap")


@pytest.mark.long
def test_a_second_actor_of_one_name_is_refused():
    with Server("tcp/127.0.0.1:0") as server:
        arguments = ["client", "--connect", server.endpoint, "--name", "twin", "--no-ros", "--status", "json"]
        first = programs.Popen(
            [sys.executable, "-m", "vinesim", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        try:
            assert first.stdout.readline()  # its first status: it is in
            assert_refused(vinesim(*arguments, "--seconds", "1"), 4, "twin")
        finally:
            first.terminate()
            first.communicate(timeout=TIMEOUT)
        assert first.returncode == 0


@contextlib.contextmanager
def running_server(*arguments):
    """A server process and its first line."""
    process = programs.Popen(
        [sys.executable, "-m", "vinesim", "server", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process, process.stdout.readline()
    finally:
        process.kill()
        process.communicate()


def test_the_server_reports_actors_and_ends_cleanly(tmp_path):
    with running_server("--listen", "tcp/127.0.0.1:0", "--status", "json", "--state-dir", str(tmp_path / "kept")) as (
        process,
        line,
    ):
        figures = json.loads(line)
        assert figures["actors"] == []
        (endpoint,) = figures["endpoints"]
        with ZenohBus("ada", connect=endpoint) as ada:
            ada.join(encode_hello(Hello("ada", digest="D1")))
            while (figures := json.loads(process.stdout.readline()))["actors"] != ["vineyard/ada"]:
                assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=TIMEOUT) == 0
        assert process.stderr.read() == ""
    with running_server("--listen", "tcp/127.0.0.1:0", "--listen", "udp/127.0.0.1:0", "--status", "text") as (
        process,
        line,
    ):
        assert line.startswith("listening on tcp/127.0.0.1:")
        assert "udp/127.0.0.1:" in line
        assert process.stdout.readline().startswith("no actors: 0 links")
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=TIMEOUT) == 0


def test_a_file_that_is_not_a_journal_is_left_unchanged(tmp_path):
    (tmp_path / "vineyard.facts").write_text("notes on grapes")
    assert_refused(
        vinesim("server", "--listen", "tcp/127.0.0.1:0", "--state-dir", str(tmp_path)),
        4,
        "vineyard.facts",
        "--state-dir",
    )
    assert (tmp_path / "vineyard.facts").read_text() == "notes on grapes"


def test_a_client_of_another_scene_is_refused_with_both_digests():
    with Server("tcp/127.0.0.1:0", scene=SceneId("vsp", "0123456789abcdef")) as server:
        arguments = ["client", "--connect", server.endpoint, "--name", "ada", "--no-ros", "--seconds", "1"]
        assert_refused(vinesim(*arguments), 4, "'ada'", "'demo'", "'vsp'", "0123456789abcdef", "scene and seed")


def test_secured_from_certificate_to_client(tmp_path):
    certs = tmp_path / "certs"
    done = vinesim("certs", "new", "ada", "--dir", str(certs))
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-2:] == [str(certs / "ada.key"), str(certs / "ada.pem")]
    assert_refused(vinesim("certs", "new", "ada", "--dir", str(certs)), 4, "ada.pem", "there already")
    arguments = ["--listen", "tls/127.0.0.1:0", "--tls", str(certs), "--status", "text", "--scene", "demo"]
    with running_server(*arguments) as (_, line):
        endpoint = line.split()[-1]
        common = [
            "client",
            "--connect",
            endpoint,
            "--tls",
            str(certs),
            "--no-ros",
            "--seconds",
            "0.5",
            "--status",
            "none",
        ]
        done = vinesim(*common, "--name", "ada")
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("arguments", "reasons"),
    [
        (["client", "--role", "spectator", "--status", "xml"], ["xml", "json"]),
        (["client", "--role", "tractor"], ["tractor", "robot"]),
        (["client", "--push", "99999", "--no-ros"], ["99999"]),
        (["client", "--walk", "1", "2"], ["--walk", "human", "not of robot"]),
        (["client", "--role", "human", "--push", "3"], ["--push", "robot", "not of human"]),
        (["client", "--role", "human", "--tls", "certs"], ["--tls certs", "--connect tls/HOST:7377"]),
        (["client", "--role", "spectator", "--no-ros"], ["--no-ros", "robot", "not of spectator"]),
        (["client", "--tls", "certs", "--no-ros"], ["--tls certs", "--connect tls/HOST:7377"]),
        (["client", "--world", "north", "--no-ros"], ["--world north", "--connect tcp/HOST:7377"]),
        (
            ["client", "--world", "n", "--tls", "c", "--connect", "tls/h:1", "--no-ros"],
            ["one world", "leave --world out"],
        ),
        (["client", "--namespace", "north side"], ["--namespace 'north side'", "give for example north_side"]),
        (["client", "--namespace", "/1/2/", "--no-ros"], ["'1' has other characters", "give for example _1/_2"]),
        (["client", "--namespace", "n\N{LATIN SMALL LETTER O WITH DIAERESIS}rd"], ["is no ROS namespace", "n_rd"]),
        (["client", "--namespace", "a" * 300], ["it has 300 characters; give at most 244"]),
        (["server", "--listen", "7377"], ["'7377'", "tcp/HOST:PORT"]),
        (["server", "--listen", "tls/0.0.0.0:7377"], ["tls/0.0.0.0:7377", "--tls DIR"]),
        (["server", "--listen", "tcp/0.0.0.0:7377"], ["tcp/0.0.0.0:7377", "--tls DIR", "--insecure"]),
        (["replay", "run.mcap", "--listen", "tcp/192.168.1.5:7377"], ["tcp/192.168.1.5:7377", "--insecure"]),
        (["server", "--connect", "tcp/127.0.0.1:1", "--state-dir", "kept"], ["only routes", "--state-dir"]),
        (["server", "--status", "xml"], ["xml", "json"]),
        (["server", "--quota", "0", "1"], ["--quota", "above zero"]),
        (
            ["client", "--real-time-factor", "0.5", "--connect", "tcp/h:1", "--no-ros"],
            ["--real-time-factor 0.5", "give it to vinesim server"],
        ),
        (["server", "--seed", "3"], ["--seed 3", "--scene"]),
        (["server", "--scene", "nowhere"], ["nowhere"]),
        (["certs", "new", "a/b"], ["a/b", "letters"]),
        (["certs", "new", "ada", "--role", "king"], ["king", "robot, human, spectator"]),
        (["certs", "new", "ada", "--host", "h"], ["only the server's"]),
        (["client", "--spawn", "99", "--no-ros"], ["99"]),
        (["client", "--status", "xml"], ["xml", "json"]),
        (["bench", "nothing"], ["nothing", "plants", "camera"]),
        (["record", "run.mcap", "--only", "cats"], ["cats", "poses", "trees"]),
        (["record", "run.mcap", "--area", "0", "0", "-1", "1"], ["area 0 0 -1 1", "X0 < X1"]),
        (["replay", "nowhere.mcap", "--out", "pictures"], ["nowhere.mcap", "No such file"]),
        (["replay", "run.mcap"], ["--connect", "--listen", "--out", "--ros"]),
        (["demo", "--scene", "nowhere"], ["nowhere"]),
        (["demo", "--robot", "unknown"], ["unknown"]),
        (["demo", "--job", "dance"], ["dance", "push", "pick", "exchange"]),
        (["client", "--job", "dance", "--no-ros"], ["dance", "pick", "exchange"]),
    ],
)
def test_invalid_options_are_refused(arguments, reasons, tmp_path):
    assert_refused(vinesim(*arguments, cwd=tmp_path), 2, *reasons)
    assert list(tmp_path.iterdir()) == []


def test_a_human_client_runs_and_writes_its_report(tmp_path):
    done = vinesim("client", "--role", "human", "--reach", "3", "--seconds", "1", "--out", str(tmp_path), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["name"] == "human"
    assert report["time"] == pytest.approx(1.0)


def status_when(process, condition):
    """The first status line of a client for which ``condition`` holds."""
    watchdog = threading.Timer(TIMEOUT, process.kill)
    watchdog.start()
    try:
        for line in process.stdout:
            if condition(status := json.loads(line)):
                return status
    finally:
        watchdog.cancel()
    return pytest.fail(f"the client ended before that: {process.stderr.read()}")


def test_three_roles_join_one_server_each_in_its_own_process():
    """F06, F50: robot and human are known to each other and to the spectator, which has no body."""
    with Server("tcp/127.0.0.1:0") as server, contextlib.ExitStack() as stack:
        common = ["client", "--connect", server.endpoint, "--status", "json"]
        clients = {}
        for name, role, options in (
            ("picker", "robot", ["--no-ros"]),
            ("eva", "human", ["--spawn", "1"]),
            ("guest", "spectator", []),
        ):
            command = [sys.executable, "-m", "vinesim", *common, "--role", role, "--name", name, *options]
            clients[name] = stack.enter_context(
                programs.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            )
            stack.callback(clients[name].kill)
        expected = {"picker": ["eva"], "eva": ["picker"], "guest": ["eva", "picker"]}
        for name, others in expected.items():
            status_when(clients[name], lambda status, others=others: status["others"] == others)
        assert sorted(server.figures()["actors"]) == ["vineyard/eva", "vineyard/guest", "vineyard/picker"]
        for client in clients.values():
            client.send_signal(signal.SIGINT)
        for name, client in clients.items():
            _, errors = client.communicate(timeout=TIMEOUT)
            assert client.returncode == 0, errors
            assert ("in a browser: http://127.0.0.1:" in errors) == (name != "picker"), (
                "people and spectators have a page"
            )
