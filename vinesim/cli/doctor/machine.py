"""Checks of the machine: processor, GPU, shared memory, ports, datagrams, clock."""

from __future__ import annotations

import contextlib
import ctypes
import os
import pathlib
import platform
import shutil
import socket
import sys
import time

from vinesim.cli.doctor.finding import ERROR, OK, WARNING, Finding, amount
from vinesim.net.transport.endpoints import PORT

CORES = 2
"""Smallest number of cores with which cameras and steps run in parallel."""
SHARED_MEMORY = pathlib.Path("/dev/shm")
LEAST_SHARED_MEMORY = 64 << 20
"""[B] Shared memory needed by one robot: a segment of 24 MiB for its sensors, and the state of the world."""
ADVISED_SHARED_MEMORY = 256 << 20
"""[B] Shared memory for several robots with cameras."""
NETWORK = pathlib.Path("/proc")
"""Folder with Linux' statistics of the network."""
MOST_DROPPED = 1e-3
"""[1] Largest fraction of datagrams dropped because a socket was full; beyond it ROS subscribers miss messages."""
ADVISED_BUFFER = 4 << 20
"""[B] Advised buffer of a socket. It holds a robot's messages for some seconds; the default holds them for 0.2 s."""
RESOLUTION = 1e-3
"""[s] Coarsest resolution of the clock that is enough, a tenth of a step."""
_UNSYNCHRONISED = 0x0040
"""Bit STA_UNSYNC of adjtimex(2)."""


def cpu(description: pathlib.Path = pathlib.Path("/proc/cpuinfo"), cgroup: pathlib.Path | None = None) -> Finding:
    """Check the cores that this process may use, the CPU limit of a container, and vector instructions."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    share = _quota(cgroup or pathlib.Path("/sys/fs/cgroup"))
    flags = _cpu_flags(description)
    vectors = [name for name in ("avx2", "fma", "avx512f", "asimd") if name in flags]
    found = f"{cores} cores, {platform.machine()}" + (f" with {', '.join(vectors)}" if vectors else "")
    if share is not None and share < cores:
        found += f"; a container's limit leaves {share:.1f} of them"
    if min(cores, cores if share is None else share) < CORES:
        return Finding(
            "cpu",
            WARNING,
            found,
            f"a client with cameras needs {CORES}; otherwise there are fewer steps and pictures a second",
        )
    if platform.machine() in ("x86_64", "AMD64") and flags and "avx2" not in flags:
        return Finding("cpu", WARNING, found, "without avx2 plants and pictures take several times as long")
    return Finding("cpu", OK, found)


def _cpu_flags(description: pathlib.Path) -> set[str]:
    """Returns the features of the first processor in Linux' names; an empty set on other systems."""
    with contextlib.suppress(OSError):
        for line in description.read_text(errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() in ("flags", "Features"):
                return set(value.split())
    return set()


def _quota(cgroup: pathlib.Path) -> float | None:
    """Returns the CPU limit of a control group as a number of cores; None without a limit."""
    with contextlib.suppress(OSError, ValueError):
        quota, period = (cgroup / "cpu.max").read_text().split()
        return float(quota) / float(period)
    with contextlib.suppress(OSError, ValueError):
        quota = float((cgroup / "cpu/cpu.cfs_quota_us").read_text())
        return quota / float((cgroup / "cpu/cpu.cfs_period_us").read_text()) if quota > 0 else None
    return None


def gpu(driver: pathlib.Path = pathlib.Path("/proc/driver/nvidia/version")) -> Finding:
    """Check NVIDIA GPUs: whether the system and Warp find them, and whether they can compute."""
    import warp as wp

    from vinesim.plants.device_buffers import device_fault

    count = wp.get_cuda_device_count()
    if count == 0:
        if driver.exists() or shutil.which("nvidia-smi"):
            return Finding(
                "gpu",
                WARNING,
                "an NVIDIA driver is installed, but Warp finds no GPU",
                "see 'nvidia-smi'; a container needs '--gpus all'; an old driver needs an update",
            )
        return Finding("gpu", OK, "no NVIDIA GPU; everything runs on the CPU")
    names = [f"cuda:{number}" for number in range(count)]
    faults = {name: fault for name in names if (fault := device_fault(name))}
    if faults:
        name, fault = next(iter(faults.items()))
        return Finding("gpu", WARNING, f"{name} does not compute: {fault}", "update the driver, or use --device cpu")
    devices = [wp.get_device(name) for name in names]
    models = ", ".join(f"{each.alias} {each.name} {amount(each.total_memory)}" for each in devices)
    version = ".".join(map(str, wp.get_cuda_driver_version() or ("?",)))
    return Finding("gpu", OK, f"{models}; CUDA {version}; use it by --device cuda")


def shared_memory(folder: pathlib.Path = SHARED_MEMORY) -> Finding:
    """Check the free space in shared memory, and files left there by killed processes."""
    from vinesim.ros.dead_segments import dead_segments

    if sys.platform != "linux":
        return Finding("shared memory", OK, f"not a folder on {platform.system()}")
    try:
        room = shutil.disk_usage(folder)
    except OSError as error:
        return Finding(
            "shared memory", ERROR, f"{folder}: {error.strerror}", "mount it: mount -t tmpfs tmpfs /dev/shm, as root"
        )
    found = f"{amount(room.free)} of {amount(room.total)} free in {folder}"
    if not os.access(folder, os.W_OK):
        return Finding("shared memory", ERROR, f"{folder} cannot be written", f"chmod 1777 {folder}, as root")
    dead = [path.stat().st_size for path, _ in dead_segments(folder)]
    if dead:
        found += f", {len(dead)} segments ({amount(sum(dead))}) of killed processes"
    remedy = "free some" if room.total > ADVISED_SHARED_MEMORY else "enlarge it; docker run --shm-size=1g"
    if room.free < LEAST_SHARED_MEMORY:
        return Finding("shared memory", ERROR, found, remedy)
    if room.free < ADVISED_SHARED_MEMORY:
        return Finding("shared memory", WARNING, found, f"{remedy}, for several robots with cameras")
    if dead:
        return Finding("shared memory", WARNING, found, "the next client removes them")
    return Finding("shared memory", OK, found)


def ports(port: int = PORT) -> Finding:
    """Check whether a server can listen on its default port."""
    busy = []
    for kind, name in ((socket.SOCK_STREAM, "tcp"), (socket.SOCK_DGRAM, "udp")):
        with socket.socket(socket.AF_INET, kind) as probe:
            if kind == socket.SOCK_STREAM:  # closed connections do not prevent a server from listening
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError as error:
                busy.append(f"{name} ({error.strerror})")
    if busy:
        return Finding(
            "ports",
            WARNING,
            f"{port} is used: {', '.join(busy)}",
            f"if that is a server, join it: --connect tcp/127.0.0.1:{port}; else --listen tcp/127.0.0.1:0",
        )
    return Finding("ports", OK, f"{port} is free for a server (tcp and udp)")


def datagrams(proc: pathlib.Path = NETWORK) -> Finding:
    """Check for datagrams dropped because a program read too slowly. ROS sends small messages as datagrams."""
    try:
        names, values = (
            line.split()[1:] for line in (proc / "net/snmp").read_text().splitlines() if line.startswith("Udp:")
        )
        buffer = int((proc / "sys/net/core/rmem_default").read_text())
    except (OSError, ValueError):
        return Finding("datagrams", OK, f"dropped datagrams are not counted on this {platform.system()}")
    counts = dict(zip(names, map(int, values), strict=True))
    dropped = counts.get("RcvbufErrors", 0)
    arrived = counts.get("InDatagrams", 0)
    found = f"{dropped} of {dropped + arrived} dropped since boot; buffers of {buffer / 1e3:.0f} kB"
    if dropped <= MOST_DROPPED * (dropped + arrived):
        return Finding("datagrams", OK, found)
    remedy = "programs on this machine read too slowly: run fewer of them, or give subscribers deeper queues"
    if buffer < ADVISED_BUFFER:
        remedy += f", and sockets larger buffers: sysctl -w net.core.rmem_default={ADVISED_BUFFER}, as root"
    return Finding("datagrams", WARNING, found, remedy)


def clock() -> Finding:
    """Check the resolution of the clock that paces steps, and whether the time of day is synchronised."""
    resolution = time.get_clock_info("monotonic").resolution
    found = f"monotonic to {resolution * 1e9:.0f} ns"
    if resolution > RESOLUTION:
        return Finding("clock", WARNING, found, "steps of 10 ms cannot be paced; choose another clock source")
    status = _clock_status()
    if status is None:
        return Finding("clock", OK, f"{found}; whether NTP runs is not known on this system")
    if status & _UNSYNCHRONISED:
        return Finding(
            "clock",
            WARNING,
            f"{found}; the time of day is not synchronised",
            "only for several machines: run an NTP service such as chrony, for certificates, logs and recordings",
        )
    return Finding("clock", OK, f"{found}; the time of day is synchronised")


def _clock_status() -> int | None:
    """Returns the status bits of the kernel's clock (adjtimex(2)); None if they cannot be read."""
    if sys.platform != "linux":
        return None
    # struct timex: modes (int), offset, freq, maxerror, esterror (long), status (int), and others; 208 bytes
    fields = (ctypes.c_long * 64)()
    try:
        if ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(fields)) < 0:
            return None
    except (OSError, AttributeError):
        return None
    return int(fields[5]) & 0xFFFFFFFF
