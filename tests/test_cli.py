"""Wrong use: one clear line on standard error, the right exit code, no traceback, nothing half-written."""

import socket
import subprocess
import sys

import pytest

from vinesim.net.recording import Recording
from vinesim.net.server import Server


def vinesim(*arguments, cwd=None):
    return subprocess.run(
        [sys.executable, "-m", "vinesim.cli", *arguments], capture_output=True, text=True, timeout=120, cwd=cwd
    )


def refused(done, code, *words):
    assert done.returncode == code, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("vinesim: ")
    for word in words:
        assert word in lines[0]


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_help_shows_every_command_with_examples():
    top = vinesim("--help").stdout
    for command in ("demo", "server", "client", "record", "replay", "scene", "bench", "ros"):
        assert command in top
    commands = (
        ["demo"], ["server"], ["client"], ["record"], ["replay"], ["scene", "show"], ["bench"],
        ["ros", "build-interfaces"],
    )  # fmt: skip
    for command in commands:
        assert "Examples:" in vinesim(*command, "--help").stdout, command


def test_no_such_scene():
    refused(vinesim("scene", "show", "nowhere"), 2, "nowhere", "demo", "tendone", "vsp")


def test_bad_scene_names_file_field_and_remedy(tmp_path):
    (tmp_path / "bad.toml").write_text('name = "bad"\nseed = 1\ntraining = "tendone"\nrow_spacing = 2\n')
    done = vinesim("scene", "show", "bad.toml", cwd=tmp_path)
    refused(done, 2, "bad.toml", "row_spacing")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.toml"]


def test_bad_urdf(tmp_path):
    (tmp_path / "bad.urdf").write_text("<robot name='x'><link name='a'/></robot")
    refused(vinesim("client", "--robot", str(tmp_path / "bad.urdf"), "--out", str(tmp_path / "out")), 2, "bad.urdf")
    assert not (tmp_path / "out").exists()


def test_no_such_device():
    refused(vinesim("client", "--device", "abacus"), 3, "abacus", "cpu, cuda")
    refused(vinesim("client", "--device", "cuda:0", "--threads", "2"), *threads_or_no_gpu())


def threads_or_no_gpu():
    import warp as wp

    return (2, "--threads 2") if wp.get_cuda_device_count() else (3, "'cuda:0'", "no NVIDIA GPU", "use cpu")


def test_server_gone():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    refused(vinesim("client", "--connect", endpoint, "--seconds", "1", "--no-ros"), 4, endpoint, "vinesim server")


def test_port_taken():
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        endpoint = f"tcp/127.0.0.1:{holder.getsockname()[1]}"
        refused(vinesim("server", "--listen", endpoint), 4, endpoint)


def test_files_that_cannot_be_replayed(tmp_path):
    (tmp_path / "scene.toml").write_text('name = "demo"\n')
    refused(vinesim("replay", "scene.toml", "--out", "pictures", cwd=tmp_path), 2, "scene.toml", "no MCAP file")
    with Recording(tmp_path / "old.mcap", {"protocol": "0", "release": "0.0.9"}):
        pass
    refused(vinesim("replay", "old.mcap", "--out", "pictures", cwd=tmp_path), 2, "version 0", "0.0.9")
    with Recording(tmp_path / "empty.mcap"):
        pass
    refused(vinesim("replay", "empty.mcap", "--out", "pictures", cwd=tmp_path), 2, "empty.mcap", "no message")
    assert not (tmp_path / "pictures").exists()


def test_no_server_to_record_and_nowhere_to_write(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    refused(vinesim("record", "run.mcap", "--connect", endpoint, cwd=tmp_path), 4, endpoint, "vinesim server")
    assert list(tmp_path.iterdir()) == []
    with Server("tcp/127.0.0.1:0") as server:
        refused(vinesim("record", "no/run.mcap", "--connect", server.endpoint, cwd=tmp_path), 4, "no/run.mcap")


def test_two_actors_with_one_name():
    with Server("tcp/127.0.0.1:0") as server:
        arguments = ["client", "--connect", server.endpoint, "--name", "twin", "--no-ros", "--status", "json"]
        first = subprocess.Popen(
            [sys.executable, "-m", "vinesim.cli", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        try:
            assert first.stdout.readline()  # its first status: it is in
            refused(vinesim(*arguments, "--seconds", "1"), 4, "twin")
        finally:
            first.terminate()
            first.communicate(timeout=30)
        assert first.returncode == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["client", "--role", "human"], ["human", "not built yet"]),
        (["client", "--role", "tractor"], ["tractor", "robot"]),
        (["client", "--push", "99999", "--no-ros"], ["99999"]),
        (["client", "--spawn", "99", "--no-ros"], ["99"]),
        (["client", "--status", "xml"], ["xml", "json"]),
        (["bench", "nothing"], ["nothing", "plants", "camera"]),
        (["record", "run.mcap", "--only", "cats"], ["cats", "poses", "trees"]),
        (["record", "run.mcap", "--area", "0", "0", "-1", "1"], ["area 0 0 -1 1", "X0 < X1"]),
        (["replay", "nowhere.mcap", "--out", "pictures"], ["nowhere.mcap", "No such file"]),
        (["replay", "run.mcap"], ["--connect", "--listen", "--out"]),
        (["demo", "--scene", "nowhere"], ["nowhere"]),
        (["demo", "--robot", "nobody"], ["nobody"]),
        (["demo", "--job", "dance"], ["dance", "push", "pick", "exchange"]),
        (["client", "--job", "dance", "--no-ros"], ["dance", "pick", "exchange"]),
    ],
)
def test_wrong_use(arguments, words, tmp_path):
    refused(vinesim(*arguments, cwd=tmp_path), 2, *words)
    assert list(tmp_path.iterdir()) == []
