"""Emulated links of a wide area network on one machine: delay, jitter, loss and cuts between network namespaces.

    with NetworkEmulator({"ada": Link(LinkProfile(0.05, 0.02, 0.01)), "bob": Link()}) as net:
        server = net.start("hub", ["vinesim", "server", "--insecure"])
        client = net.start("ada", ["vinesim", "client", "--connect", f"tcp/{net.hub('ada')}:7377"])
        sent, received = net.counts("ada")

Each end of the star is a namespace of its own. A pair of TUN devices joins it to the namespace of the hub, and a
process between them forwards the packets: not every kernel has tc-netem, but all have TUN. The emulator needs Linux and
root, see :func:`unusable`.

The names of the namespaces contain the process id of the process that created them. If that process dies, the
forwarding process removes the namespaces; if the forwarding process is killed, too, the next emulator removes them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import heapq
import json
import os
import random
import re
import select
import shutil
import struct
import subprocess
import sys
import time
from typing import IO, Any, Self

HUB = "hub"
"""Name of the end to which all links lead."""

_PREFIX = "vinesim-link"
_TUNSETIFF = 0x400454CA
_TUN = 0x0001
_NO_PACKET_INFO = 0x1000
_MAX_PACKET = 2048


@dataclasses.dataclass(frozen=True, slots=True)
class LinkProfile:
    """Delay, jitter and loss in one direction: packets take from ``delay`` - ``jitter`` to ``delay`` + ``jitter`` [s],
    uniformly.

    Packets stay in order, as in the queue of a router. ``loss`` is the probability that a packet is lost.
    """

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0

    def __post_init__(self) -> None:
        if self.delay < 0.0 or self.jitter < 0.0 or not 0.0 <= self.loss <= 1.0:
            raise ValueError(f"{self}: delay and jitter must not be negative, loss from 0 to 1")


@dataclasses.dataclass(frozen=True, slots=True)
class Link:
    """Link between one end and the hub. Its directions are equal unless ``back`` is given for the way from the hub."""

    there: LinkProfile = LinkProfile()
    back: LinkProfile | None = None

    def ways(self) -> tuple[LinkProfile, LinkProfile]:
        """Returns the profiles from the end to the hub, and from the hub to the end."""
        return self.there, self.there if self.back is None else self.back


@dataclasses.dataclass(frozen=True, slots=True)
class Count:
    """Numbers of packets and bytes in one direction, IP headers included."""

    packets: int = 0
    bytes: int = 0
    lost: int = 0
    """Number of packets that did not arrive."""

    def __sub__(self, earlier: Count) -> Count:
        return Count(self.packets - earlier.packets, self.bytes - earlier.bytes, self.lost - earlier.lost)


def unusable() -> str:
    """Returns the reason why links cannot be emulated here, or an empty string."""
    if not sys.platform.startswith("linux"):
        return "network namespaces are Linux's"
    if os.geteuid() != 0:
        return "network namespaces need root"
    if not os.path.exists("/dev/net/tun"):
        return "there is no /dev/net/tun"
    if shutil.which("ip") is None:
        return "there is no ip command (package iproute2)"
    probe = f"{_PREFIX}-{os.getpid()}-probe"
    made = subprocess.run(["ip", "netns", "add", probe], capture_output=True, text=True)
    if made.returncode != 0:
        return f"namespaces cannot be made: {made.stderr.strip()}"
    _ip("netns", "del", probe)
    return ""


class NetworkEmulator:
    """A star of namespaces around :data:`HUB`; see the module. A context manager."""

    def __init__(self, lines: dict[str, Link], *, seed: int = 0) -> None:
        if reason := unusable():
            raise RuntimeError(f"links cannot be emulated here: {reason}")
        for end in lines:
            if end == HUB or not re.fullmatch(r"[a-z0-9]{1,12}", end):
                raise ValueError(f"end {end!r}: use 1 to 12 small letters and digits, not {HUB!r}")
        _remove_stale_namespaces()
        self._ends = {end: i + 1 for i, end in enumerate(lines)}
        self._started: list[subprocess.Popen] = []
        made = {end: self._namespace(end) for end in (HUB, *lines)}
        self._forwarder = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.support.network_emulator"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        shapes = {end: _to_json(line) for end, line in lines.items()}
        try:
            self._request({"spaces": made, "lines": shapes, "seed": seed})
        except BaseException:
            self.close()
            raise

    def _namespace(self, end: str) -> str:
        return f"{_PREFIX}-{os.getpid()}-{id(self):x}-{end}"

    def _request(self, what: dict[str, Any]) -> Any:
        carrier = self._forwarder
        assert carrier.stdin is not None
        assert carrier.stdout is not None
        carrier.stdin.write(json.dumps(what) + "\n")
        carrier.stdin.flush()
        answer = carrier.stdout.readline()
        if not answer:
            raise RuntimeError(f"the process that carries packets ended with {carrier.wait()}")
        return json.loads(answer)

    def hub(self, end: str) -> str:
        """Returns the hub's address as ``end`` reaches it."""
        return _addresses(self._ends[end])[0]

    def address(self, end: str) -> str:
        """Returns the address of ``end`` as the hub reaches it."""
        return _addresses(self._ends[end])[1]

    def start(self, end: str, command: list[str], **options: Any) -> subprocess.Popen:
        """Run a command in the namespace of an end or of the hub. The process is ended when the emulator closes."""
        process = subprocess.Popen(["ip", "netns", "exec", self._namespace(end), *command], **options)
        self._started.append(process)
        return process

    def start_server(self, *options: str) -> None:
        """Start ``vinesim server`` in the hub with these ``options``, and wait until it listens."""
        command = [sys.executable, "-m", "vinesim", "server", "--status", "none", *options]
        server = self.start("hub", command, stdout=subprocess.PIPE, text=True)
        assert server.stdout is not None
        server.stdout.readline()

    def shape(self, end: str, line: Link) -> None:
        """Change the link of ``end`` immediately."""
        self._request({"shape": end, "line": _to_json(line)})

    def disconnect(self, end: str) -> None:
        """Drop all packets of the link of ``end`` until :meth:`shape` is called."""
        self.shape(end, Link(LinkProfile(loss=1.0)))

    def counts(self, end: str) -> tuple[Count, Count]:
        """Returns counts of packets on the link of ``end``: sent by the end, and sent by the hub."""
        there, back = self._request({"counts": end})
        return Count(*there), Count(*back)

    def close(self) -> None:
        """End all started processes and remove the namespaces. Further calls do nothing."""
        for process in self._started:
            if process.poll() is None:
                process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout, process.stderr):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()
        self._started.clear()
        for pipe in (self._forwarder.stdin, self._forwarder.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        self._forwarder.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _to_json(line: Link) -> list[tuple]:
    return [dataclasses.astuple(way) for way in line.ways()]


def _addresses(number: int) -> tuple[str, str]:
    """Returns the addresses of the hub and of the end on link ``number``, in a private network for this link."""
    return f"10.77.{number}.1", f"10.77.{number}.2"


def _ip(*words: str) -> None:
    done = subprocess.run(["ip", *words], capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"ip {' '.join(words)}: {done.stderr.strip()}")


def _list_namespaces() -> list[str]:
    listed = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True).stdout
    return [line.split()[0] for line in listed.splitlines() if line.startswith(f"{_PREFIX}-")]


def _remove_stale_namespaces() -> None:
    """Remove the namespaces of processes that no longer exist."""
    for space in _list_namespaces():
        maker = space.split("-")[2]
        if not os.path.exists(f"/proc/{maker}"):
            subprocess.run(["ip", "netns", "del", space], capture_output=True)


# ---------------------------------------------------------------- the process between


class _Direction:
    """Packets on their way from the device ``source`` to the device ``target``."""

    def __init__(self, source: int, target: int, way: LinkProfile) -> None:
        self.source = source
        self.target = target
        self.way = way
        self.packets = self.bytes = self.lost = 0
        self.last = 0.0


def _device(space: str, name: str, mine: str, other: str) -> int:
    """Create a TUN device in the namespace ``space`` with address ``mine``, which leads to address ``other``; return
    its file descriptor. ``%d`` in ``name`` is replaced by a free number."""
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    made = fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _TUN | _NO_PACKET_INFO))
    name = made[:16].rstrip(b"\0").decode()
    _ip("link", "set", name, "netns", space)
    _ip("-n", space, "addr", "add", mine, "peer", other, "dev", name)
    _ip("-n", space, "link", "set", name, "mtu", "1400", "up")
    return device


def _forward(answers: IO[str]) -> None:
    """Create the links that the first request on standard input names, then forward packets and answer requests until
    standard input is closed."""
    request = b""
    # read single bytes: input must not wait in a buffer, where select does not find it
    while not request.endswith(b"\n"):
        if not (more := os.read(0, 1)):
            return
        request += more
    first = json.loads(request)
    rng = random.Random(first["seed"])
    spaces: dict[str, str] = first["spaces"]
    try:
        for space in spaces.values():
            _ip("netns", "add", space)
            _ip("-n", space, "link", "set", "lo", "up")
        lines: dict[str, tuple[_Direction, _Direction]] = {}
        for number, (end, shape) in enumerate(first["lines"].items(), 1):
            at_hub, at_end = _addresses(number)
            hub = _device(spaces[HUB], f"vslink{number}h%d", at_hub, at_end)
            leaf = _device(spaces[end], f"vslink{number}e%d", at_end, at_hub)
            there, back = (LinkProfile(*way) for way in shape)
            lines[end] = _Direction(leaf, hub, there), _Direction(hub, leaf, back)
        print(json.dumps(True), file=answers, flush=True)
        _loop(answers, lines, rng)
    finally:
        for space in spaces.values():
            subprocess.run(["ip", "netns", "del", space], capture_output=True)


def _loop(answers: IO[str], lines: dict[str, tuple[_Direction, _Direction]], rng: random.Random) -> None:
    by_source = {way.source: way for pair in lines.values() for way in pair}
    asked = 0
    pending: list[tuple[float, int, int, bytes]] = []
    order = 0
    unread = b""
    while True:
        wait = max(0.0, pending[0][0] - time.monotonic()) if pending else None
        ready, _, _ = select.select([asked, *by_source], [], [], wait)
        now = time.monotonic()
        for source in ready:
            if source == asked:
                more = os.read(asked, 65536)
                if not more:
                    return
                *whole, unread = (unread + more).split(b"\n")
                for request in whole:
                    print(json.dumps(_answer(json.loads(request), lines)), file=answers, flush=True)
                continue
            direction = by_source[source]
            way = direction.way
            while True:
                try:
                    packet = os.read(source, _MAX_PACKET)
                except BlockingIOError:
                    break
                # IPv6 sends neighbour discovery packets on every new device; they are not wanted
                if packet[0] >> 4 != 4:
                    continue
                direction.packets += 1
                direction.bytes += len(packet)
                if rng.random() < way.loss:
                    direction.lost += 1
                    continue
                at = max(direction.last, now + way.delay + rng.uniform(-way.jitter, way.jitter))
                direction.last = at
                order += 1
                heapq.heappush(pending, (at, order, direction.target, packet))
        now = time.monotonic()
        while pending and pending[0][0] <= now:
            _, _, target, packet = heapq.heappop(pending)
            with contextlib.suppress(OSError):  # a full device drops packets, as any device does
                os.write(target, packet)


def _answer(request: dict[str, Any], lines: dict[str, tuple[_Direction, _Direction]]) -> Any:
    if "counts" in request:
        return [(way.packets, way.bytes, way.lost) for way in lines[request["counts"]]]
    for direction, way in zip(lines[request["shape"]], request["line"], strict=True):
        direction.way = LinkProfile(*way)
    return True


if __name__ == "__main__":
    _forward(sys.stdout)
