"""``vinesim doctor``: each fault of a machine is found, with a remedy, and only what a client needs is an error."""

import importlib.util
import json
import os
import pathlib
import socket
import sys
import time

import pytest

from tests.support import programs
from vinesim.cli.doctor import command, machine, software
from vinesim.cli.doctor.finding import ERROR, OK, WARNING, Finding
from vinesim.ros import dead_segments


def test_every_check_gives_one_line_and_json_says_the_same():
    done = programs.run([sys.executable, "-m", "vinesim", "doctor", "--json"])
    report = json.loads(done.stdout)
    assert [each["check"] for each in report["checks"]] == [
        "python",
        "packages",
        "cpu",
        "gpu",
        "ros",
        "page",
        "certificates",
        "ports",
        "shared memory",
        "datagrams",
        "clock",
        "caches",
    ]
    errors = [each for each in report["checks"] if each["state"] == ERROR]
    assert errors == []  # where the tests run, a client can run
    assert (done.returncode, report["ready"]) == (0, True)
    for each in report["checks"]:
        assert each["found"]
        assert "\n" not in each["found"] + each["remedy"]
        assert each["state"] == OK or each["remedy"], each


def test_an_error_is_the_exit_code_and_a_check_that_fails_is_one(capsys):
    def sound():
        return Finding("one", OK, "there")

    def doubtful():
        return Finding("two", WARNING, "old", "update it")

    def broken():
        raise OSError("no\nsuch thing")

    assert command.run(False, [sound, doubtful]) == 0
    assert capsys.readouterr().out.splitlines()[:2] == [
        "ok       one            there",
        "warning  two            old; update it",
    ]
    assert command.run(False, [sound, broken]) == 1
    assert "error    broken         the check failed with OSError: no such thing" in capsys.readouterr().out
    assert command.run(True, [broken]) == 1
    assert json.loads(capsys.readouterr().out)["ready"] is False


def test_python_and_packages_of_other_versions():
    assert software.python((3, 10, 4)).state == ERROR
    assert "make a venv" in software.python((3, 10, 4)).remedy
    assert software.packages(["numpy>=2", 'nonsense-of-test>=1; extra == "voice"']).state == OK
    assert "voice" in software.packages(["numpy>=2", 'nonsense-of-test>=1; extra == "voice"']).found
    old = software.packages(["numpy>=99", "nonsense-of-test"])
    assert old.state == ERROR
    assert "numpy" in old.found
    assert "nonsense-of-test is missing" in old.found


def test_cores_and_vectors(tmp_path, monkeypatch):
    description = tmp_path / "cpuinfo"
    description.write_text("processor : 0\nflags : fpu sse2 avx2 fma\n")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(machine.platform, "machine", lambda: "x86_64")
    assert machine.cpu(description, tmp_path) == Finding("cpu", OK, "8 cores, x86_64 with avx2, fma")
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert machine.cpu(description, tmp_path).state == OK
    (tmp_path / "cpu.max").write_text("150000 100000\n")
    limited = machine.cpu(description, tmp_path)
    assert (limited.state, "leaves 1.5" in limited.found) == (WARNING, True)
    (tmp_path / "cpu.max").unlink()
    description.write_text("flags : fpu sse2\n")
    assert "avx2" in machine.cpu(description, tmp_path).remedy
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
    assert machine.cpu(description, tmp_path).state == WARNING


def test_a_driver_without_a_gpu_and_a_gpu_that_does_not_compute(tmp_path, monkeypatch):
    import warp as wp

    from vinesim.plants import device_buffers

    driver = tmp_path / "version"
    monkeypatch.setattr(wp, "get_cuda_device_count", lambda: 0)
    monkeypatch.setattr(machine.shutil, "which", lambda _: None)
    assert machine.gpu(driver).state == OK
    driver.touch()
    assert machine.gpu(driver).state == WARNING
    monkeypatch.setattr(wp, "get_cuda_device_count", lambda: 2)
    monkeypatch.setattr(device_buffers, "device_fault", lambda name: "out of memory" if name == "cuda:1" else None)
    broken = machine.gpu(driver)
    assert (broken.state, broken.found) == (WARNING, "cuda:1 does not compute: out of memory")


def test_ros_that_is_sourced_twice_and_messages_that_are_not_built(monkeypatch):
    from vinesim.ros import middleware
    from vinesim.ros.messages import message_packages

    monkeypatch.setattr(middleware, "unavailable_reason", lambda: "ROS 2 is missing (no rclpy); source one")
    missing = software.ros()
    assert (missing.state, missing.found) == (WARNING, "ROS 2 is missing (no rclpy)")
    assert missing.remedy.startswith("source one")
    monkeypatch.setattr(middleware, "unavailable_reason", lambda: None)
    monkeypatch.setattr(message_packages, "available_packages", lambda: ["nonsense_msgs"])
    monkeypatch.setattr(message_packages, "is_built", lambda _: False)
    assert "nonsense_msgs" in software.ros().found
    assert "build-interfaces" in software.ros().remedy
    monkeypatch.setattr(message_packages, "is_built", lambda _: True)
    assert software.ros().state == OK


def test_a_page_that_is_not_built(monkeypatch):
    from vinesim.web import page_files

    monkeypatch.setattr(page_files, "THREE", pathlib.Path("/nowhere/three.js"))
    assert (software.page().state, "tools/build_page" in software.page().remedy) == (WARNING, True)
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "aiohttp" else real(name, *a))
    assert "vinesim[web]" in software.page().remedy


def test_certificates_that_expire_soon_are_broken_or_missing(tmp_path, monkeypatch):
    from vinesim.net.transport import certificates

    assert software.certificates([tmp_path / "none"]).state == OK
    certificates.create(tmp_path / "long", "picker")
    assert software.certificates([tmp_path / "long"]) == Finding(
        "certificates", OK, f"valid for more than 30 days: {tmp_path / 'long'}"
    )
    certificates.create(tmp_path / "short", "picker", days=3)
    short = software.certificates([tmp_path / "long", tmp_path / "short"])
    assert (short.state, "short/picker.pem" in short.found, short.remedy) == (WARNING, True, "make a new one in time")
    (tmp_path / "long" / "picker.pem").write_text("no certificate")
    broken = software.certificates([tmp_path / "long"])
    assert (broken.state, bool(broken.remedy)) == (WARNING, True)


def test_a_port_that_is_used():
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        port = server.getsockname()[1]
        used = machine.ports(port)
        assert (used.state, f"{port} is used: tcp" in used.found) == (WARNING, True)
    assert "tcp" not in machine.ports(port).found.partition("used")[2]


@pytest.mark.skipif(sys.platform != "linux", reason="shared memory is a folder on Linux only")
def test_shared_memory_that_is_small_missing_or_full_of_dead_segments(tmp_path, monkeypatch):
    room = machine.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda _: room._replace(total=64 << 20, free=60 << 20))
    docker = machine.shared_memory(tmp_path)
    assert (docker.state, "--shm-size" in docker.remedy) == (ERROR, True)
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda _: room._replace(total=1 << 30, free=128 << 20))
    assert machine.shared_memory(tmp_path).state == WARNING
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda _: room._replace(total=1 << 30, free=1 << 30))
    assert machine.shared_memory(tmp_path).state == OK
    for name, size in (("fastrtps_1", dead_segments.SMALLEST), ("fastrtps_1_el", 0)):
        with (tmp_path / name).open("wb") as file:
            file.truncate(size)
        os.utime(tmp_path / name, (time.time() - 3600.0,) * 2)
    dead = machine.shared_memory(tmp_path)
    assert (dead.state, "1 segments (4 MB) of killed" in dead.found) == (WARNING, True)
    assert (tmp_path / "fastrtps_1").exists()  # a check changes nothing
    monkeypatch.undo()
    assert machine.shared_memory(tmp_path / "none").state == ERROR


def test_datagrams_that_the_system_dropped(tmp_path):
    def found(dropped: int, buffer: int) -> Finding:
        (tmp_path / "net").mkdir(exist_ok=True)
        (tmp_path / "sys/net/core").mkdir(parents=True, exist_ok=True)
        (tmp_path / "net/snmp").write_text(
            f"Tcp: InErrs\nTcp: 7\nUdp: InDatagrams NoPorts RcvbufErrors\nUdp: 100000 9 {dropped}\nUdpLite: InErrors\n"
        )
        (tmp_path / "sys/net/core/rmem_default").write_text(f"{buffer}\n")
        return machine.datagrams(tmp_path)

    assert (found(50, 212992).state, found(0, 212992).remedy) == (OK, "")
    few = found(5000, 212992)
    assert (few.state, few.found) == (WARNING, "5000 of 105000 dropped since boot; buffers of 213 kB")
    assert "sysctl -w net.core.rmem_default=4194304" in few.remedy
    assert "sysctl" not in found(5000, machine.ADVISED_BUFFER).remedy
    assert machine.datagrams(tmp_path / "none").state == OK


def test_a_clock_that_is_coarse_or_not_synchronised(monkeypatch):
    monkeypatch.setattr(machine, "_clock_status", lambda: 0x2000)
    assert machine.clock().state == OK
    monkeypatch.setattr(machine, "_clock_status", lambda: 0x0040)
    assert (machine.clock().state, "NTP" in machine.clock().remedy) == (WARNING, True)
    coarse = type("Info", (), {"resolution": 0.015})
    monkeypatch.setattr(machine.time, "get_clock_info", lambda _: coarse)
    assert "steps of 10 ms" in machine.clock().remedy


def test_caches_that_cannot_be_written_or_have_no_room(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "kernels"))
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path / "tables"))
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "one.npz").write_bytes(bytes(3_000_000))
    monkeypatch.setattr(software, "FREE_SPACE", 0)
    assert (software.caches().state, "tables 3 MB" in software.caches().found) == (OK, True)
    assert not (tmp_path / "kernels").exists()  # a check makes nothing
    monkeypatch.setattr(software, "FREE_SPACE", 1 << 60)
    assert "free" in software.caches().found
    (tmp_path / "kernels").write_text("a file, not a folder")
    unwritable = software.caches()
    assert (unwritable.state, "WARP_CACHE_PATH" in unwritable.remedy) == (WARNING, True)


def test_the_folder_of_kernels_is_that_of_warp():
    import warp as wp

    import vinesim.kernels

    assert vinesim.kernels
    assert pathlib.Path(wp.config.kernel_cache_dir).is_relative_to(software.kernel_folder())
