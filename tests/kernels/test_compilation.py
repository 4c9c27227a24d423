"""Kernels are compiled once, whoever starts at the same time, by processes that end with the one that started them."""

from __future__ import annotations

import importlib
import os
import pathlib
import pkgutil
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest
import warp as wp

import vinesim.kernels
from tests.support.waiting import wait
from vinesim.core import disk_cache
from vinesim.kernels import compilation
from vinesim.kernels.compilation import CompiledModules, compile_kernels, module_names

PACKAGE = "stereo"
"""Small: three modules."""

PROGRAM = f"""
import logging, sys
logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
from vinesim.kernels.compilation import compile_kernels
print("compiled", compile_kernels(({PACKAGE!r},)), flush=True)
"""

FAKE = """
import os, pathlib, sys, time
log, = sys.argv[1:]
for line in sys.stdin:
    name = line.strip().removeprefix("vinesim.kernels.")
    with open(log, "a") as file:
        print(name, os.getpid(), os.nice(0), file=file)
    if name == "rigid.human_kinematics":
        os.kill(os.getpid(), 9)
    while name.startswith("raster") and not os.path.exists(log + ".go"):
        time.sleep(0.01)
    fails = name == "rigid.joint_servos"
    print('{"failure": "no"}' if fails else '{"folder": "."}', flush=True)
"""
"""Compiles nothing: logs each module, its process and its niceness; dies of one module and fails at another."""


def start(cache: pathlib.Path) -> subprocess.Popen[str]:
    environment = os.environ | {"WARP_CACHE_PATH": str(cache / "warp"), "VINESIM_CACHE": str(cache / "vinesim")}
    return subprocess.Popen([sys.executable, "-c", PROGRAM], env=environment, stdout=subprocess.PIPE, text=True)


def compiled(process: subprocess.Popen[str]) -> tuple[int, list[str]]:
    """How many modules it compiled, and what it wrote before."""
    words = process.communicate()[0].splitlines()
    assert process.returncode == 0
    return int(words[-1].removeprefix("compiled ")), [line for line in words[:-1] if line]


def compilers_of(pid: int) -> list[int]:
    """Processes that a process has started."""
    found = []
    for stat in pathlib.Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(fields[1]) == pid and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


@pytest.mark.long
def test_of_processes_that_start_together_one_compiles(tmp_path: pathlib.Path) -> None:
    results = [compiled(process) for process in [start(tmp_path) for _ in range(2)]]
    wanted = len(module_names((PACKAGE,)))
    assert sorted(count for count, _ in results) == [0, wanted]
    assert len(list((tmp_path / "warp").glob("*/wp_vinesim.kernels.stereo.*"))) == wanted
    for _, lines in results:
        assert all(line.startswith("compiling kernels, only once: ") for line in lines)
        assert all(line.endswith(f" of {wanted} done") for line in lines)

    assert compiled(start(tmp_path)) == (0, [])
    lost = next((tmp_path / "warp").glob("*/wp_vinesim.kernels.stereo.stereo_input*"))
    shutil.rmtree(lost)
    assert compiled(start(tmp_path))[0] == 1
    assert lost.is_dir()


@pytest.mark.slow
@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="looks for processes in /proc")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_compilers_end_with_the_process_that_started_them_and_another_goes_on(
    tmp_path: pathlib.Path, number: signal.Signals
) -> None:
    first = start(tmp_path)
    wait(lambda: compilers_of(first.pid), "compilers")
    compilers = compilers_of(first.pid)
    first.send_signal(number)
    first.communicate()
    wait(lambda: not any(os.path.isdir(f"/proc/{pid}") for pid in compilers), "the end of the compilers")
    compiled(start(tmp_path))
    assert compiled(start(tmp_path)) == (0, [])


@pytest.mark.long
def test_a_cache_that_cannot_be_made_is_replaced_for_this_time(tmp_path: pathlib.Path) -> None:
    (tmp_path / "warp").write_text("not a folder")
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "warp"), "TMPDIR": str(tmp_path)}
    program = PROGRAM.replace(f"({PACKAGE!r},)", "('rigid.human_kinematics',)")
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert "compiled 1" in done.stdout
    assert (done.stdout + done.stderr).count("set WARP_CACHE_PATH") == 1
    assert list(tmp_path.glob("vinesim-kernels-*/*/wp_vinesim.kernels.rigid.human_kinematics*"))


def test_every_module_that_defines_kernels_is_known() -> None:
    modules = [module.name for module in pkgutil.walk_packages(vinesim.kernels.__path__, "vinesim.kernels.")]
    for name in modules:
        importlib.import_module(name)
    assert set(module_names(without=())) == {
        name.removeprefix("vinesim.kernels.") for name in modules if wp.get_module(name).kernels
    }


def is_locked() -> bool:
    """Whether compilers are at work."""
    lock = disk_cache.try_exclusive("kernels")
    if lock is not None:
        lock.close()
    return lock is None


class Fake:
    """Compilers that compile nothing, and what they were asked for."""

    def __init__(self, log: pathlib.Path) -> None:
        self._log = log

    def start(self) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", FAKE, str(self._log)]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def rows(self) -> list[tuple[str, int, int]]:
        """Module, process and its niceness of each request."""
        rows = [line.split() for line in self._log.read_text().splitlines()]
        return [(name, int(pid), int(niceness)) for name, pid, niceness in rows]

    def go_on(self) -> None:
        """Let those go on that were asked for modules of ``raster``."""
        pathlib.Path(f"{self._log}.go").touch()


@pytest.fixture
def fake(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fake]:
    one = Fake(tmp_path / "log")
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(compilation, "_start_compiler", one.start)
    yield one
    one.go_on()
    wait(lambda: not is_locked(), "the end of the compilers")


@pytest.mark.skipif(not hasattr(os, "setpriority"), reason="has no niceness")
def test_what_comes_later_is_not_waited_for_and_is_compiled_nicer(fake: Fake) -> None:
    assert compile_kernels(("stereo", "shading"), then=("raster",)) == len(module_names(("stereo", "shading")))
    compiled = CompiledModules()
    assert not compiled.missing(module_names(("stereo", "shading")))
    assert compiled.missing(module_names(("raster",)))
    fake.go_on()
    wait(lambda: not compiled.missing(module_names(("raster",))), "the other modules")
    names = [name for name, _, _ in fake.rows()]
    assert sorted(names) == sorted(module_names(("stereo", "shading", "raster")))  # each once
    niceness = {niceness for name, _, niceness in fake.rows() if name.startswith("raster")}
    assert niceness == {compilation.NICENESS}
    assert {niceness for name, _, niceness in fake.rows() if not name.startswith("raster")} == {os.nice(0)}


def test_of_what_another_compiles_only_the_own_part_is_waited_for(fake: Fake) -> None:
    first = threading.Thread(target=compile_kernels, args=(("shading", "stereo"),), kwargs={"then": ("raster",)})
    first.start()
    wait(is_locked, "the first to begin")
    assert compile_kernels(("stereo",)) == 0
    assert CompiledModules().missing(module_names(("raster",)))
    fake.go_on()
    assert compile_kernels(("raster",)) == 0
    first.join()
    names = [name for name, _, _ in fake.rows()]
    assert sorted(names) == sorted(module_names(("shading", "stereo", "raster")))  # each once


def test_a_module_of_which_compilers_die_costs_the_others_nothing(fake: Fake, caplog: pytest.LogCaptureFixture) -> None:
    packages = ("rigid.human_kinematics", "robot.inverse_kinematics", "stereo.stereo_input")
    assert compile_kernels(packages) == 2
    assert CompiledModules().missing(module_names(packages)) == ["rigid.human_kinematics"]
    assert "rigid.human_kinematics was not compiled in advance: the compiler ended with exit code -9" in caplog.text
    assert [name for name, _, _ in fake.rows()].count("rigid.human_kinematics") == compilation.ATTEMPTS


def test_a_module_that_cannot_be_compiled_is_logged(fake: Fake, caplog: pytest.LogCaptureFixture) -> None:
    assert compile_kernels(("rigid.joint_servos", "stereo.stereo_input")) == 1
    assert "rigid.joint_servos was not compiled in advance: no" in caplog.text


@pytest.mark.slow
def test_a_damaged_file_of_compiled_kernels_is_made_anew_with_one_line(tmp_path):
    """Of one module the code has another byte, of one the code ends early, of one the description is no JSON."""
    first, _ = compiled(start(tmp_path))
    assert first == 3
    codes = sorted((tmp_path / "warp").glob("*/wp_vinesim*/*.o"))
    descriptions = sorted((tmp_path / "warp").glob("*/wp_vinesim*/*.meta"))
    assert len(codes) == len(descriptions) == 3
    content = bytearray(codes[0].read_bytes())
    content[len(content) // 2] ^= 1
    codes[0].write_bytes(content)
    codes[1].write_bytes(codes[1].read_bytes()[:100])
    descriptions[2].write_text("{")
    again, lines = compiled(start(tmp_path))
    assert again == 3
    assert sum("are damaged: compiling them again" in line for line in lines) == 3
    assert compiled(start(tmp_path))[0] == 0
