"""Two people on different machines pull at one bunch over a poor link: whole clients over Zenoh, in real time.

Each client is a process in a network namespace of its own, joined to the server by the emulated link of
:data:`benchmarks.poor_link.POOR`. Both people grasp the bunch and pull in opposite directions with 10 N. If the clients
did not agree who owns the bunch, they would show it 5 cm off to either side, or it would oscillate.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.poor_link import POOR
from benchmarks.support.network_emulator import NetworkEmulator
from vinesim.client.client import Client
from vinesim.client.rate_loop import RateLoop
from vinesim.core import frames
from vinesim.rigid.human_posture import HAND_HALF_THICKNESS, standing_pose
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import HumanPose, Measurement

SIDES = {"ada": -1.0, "bob": 1.0}
"""Side of the bunch along y on which each person stands, by name."""

PULL = 0.1
"""Distance that each hand moves outwards [m]; a hand pulls with 100 N/m."""

PULLS_AT = 6.0
PULLS_UNTIL = 7.0
"""End of the pull [s after the start]; ``PULLS_AT`` is its beginning."""

SETTLE = 2.0
"""Time after the pull for which the bunch comes to rest [s]."""

SECONDS = 27.0
"""Length of a run [s]."""

START = 240.0
"""Time limit for both clients to meet, and to write their records [s]."""

_NEAR = 0.05 + HAND_HALF_THICKNESS
"""Distance of a grasping palm from the middle of the bunch [m]."""


def hanging_bunch() -> tuple[Model, int]:
    """Returns a model of a cane with a bunch that no pull tears off, and the index of the bunch's body."""
    tree = TreeBuilder(frames.pose(np.array([0.0, 0.0, 2.0])))
    tip = tree.add_rod(-1, 1.0, (0.006, 0.006), RodMaterial(5e9, 800.0), 16)[-1]
    down = frames.from_x_axis(np.array([0.0, 0.0, -1.0]))
    tree.add_bunch(tip, 0.5, clusters=False, rest=down, stiffness=np.full(3, 0.3), damping=np.full(3, 0.005))
    tree.solve_rest_pose()
    model = assemble([tree])
    model.bunch_pull[:] = model.bunch_bend[:] = 1e6
    return model, int(model.bunch_body[0])


def middle(pose: np.ndarray, length: float) -> np.ndarray:
    """Returns the middle [3] m of a bunch of ``length`` [m] whose upper end is at ``pose`` [7]."""
    return pose[:3] + frames.rotate(pose[3:].astype(float), np.array([0.5 * length, 0.0, 0.0]))


@dataclasses.dataclass(frozen=True)
class Seen:
    """Record of one client, with a row for each step."""

    clock: np.ndarray
    """Times of the steps by the host's clock [step] s."""
    way: np.ndarray
    """Displacement of the middle of the bunch along y [step] m."""
    owner: np.ndarray
    """Name of the bunch's owner, empty without an owner [step]."""
    held: np.ndarray
    """Whether the client's person holds the bunch [step]."""
    alone: np.ndarray
    """Whether the client had lost the server, so that it simulated alone [step]."""


# ---------------------------------------------------------------- in a process of its own


def run_client(connect: str, name: str, seconds: float, out: str) -> None:
    """Run the client of one of the two people for ``seconds`` [s] after the start.

    The time of the start [s, clock of the host] is read from standard input. ``out``: file for the arrays of
    :class:`Seen`.
    """
    from vinesim.net.transport.zenoh_bus import ZenohBus

    side = SIDES[name]
    start = threading.Event()
    model, body = hanging_bunch()
    length = float(model.body_length[body])
    rest = middle(model.forward_kinematics(model.joint_settled)[body], length)
    place = frames.pose([rest[0], rest[1] + 0.7 * side, 0.0], frames.from_yaw(-side * 0.5 * np.pi))
    stand = standing_pose(place)
    palm = frames.multiply(frames.from_yaw(-side * 0.5 * np.pi), frames.exp(np.array([0.0, -0.5 * np.pi, 0.0])))
    begins = [0.0]
    rows = []
    first = 2.0 + 2.0 * (side > 0.0)  # one person grasps after the other
    times = [first, first + 1.0, PULLS_AT, PULLS_UNTIL]
    ways = [_NEAR + 0.1, _NEAR, _NEAR, _NEAR + PULL]

    def pose(_: float) -> HumanPose:
        since = time.monotonic() - begins[0] if start.is_set() else 0.0
        there = rest + np.array([0.0, side * np.interp(since, times, ways), 0.0])
        raised = min(since / 2.0, 1.0)
        right = frames.pose((1.0 - raised) * stand.right[:3] + raised * there, palm)
        return dataclasses.replace(stand, right=right, right_closed=since > first + 1.0)

    def read_start() -> None:
        begins[0] = float(sys.stdin.readline())
        start.set()

    bus = ZenohBus(name, connect=connect)
    try:
        client = Client(load_scene("demo"), model, None, bus, name=name, pose=place, source=pose)
        client.physics.wind = None
        threading.Thread(target=read_start, daemon=True).start()
        loop = RateLoop(client.physics.dt)
        has_met = False
        while not (start.is_set() and time.monotonic() > begins[0] + seconds):
            loop.begin()
            client.tick()
            client.physics.update_kinematics()
            here = middle(client.physics.state.body_q[body], length)
            held = client.physics.hand(name, "right").held is not None
            rows.append(
                (time.monotonic(), here[1] - rest[1], client.replicator.owner(0) or "", held, bool(bus.status_message))
            )
            loop.end()
            if client.remote_actors and not has_met:
                has_met = True
                sys.stdout.write("met\n")
                sys.stdout.flush()
    finally:
        bus.close()
    clock, way, owners, held, alone = map(np.array, zip(*rows, strict=True))
    np.savez(out, clock=clock, way=way, owner=owners, held=held, alone=alone)


# ---------------------------------------------------------------- both


def run_two_pullers(seconds: float = SECONDS, protocol: str = "tcp") -> tuple[float, dict[str, Seen]]:
    """Run both clients. Returns the start of the run [s, clock of the host], and the record of each client by name.

    Raises RuntimeError if a client ends early.
    """
    with tempfile.TemporaryDirectory() as folder, NetworkEmulator(dict.fromkeys(SIDES, POOR)) as net:
        net.start_server("--insecure")
        files = {name: pathlib.Path(folder) / f"{name}.npz" for name in SIDES}
        people: list[subprocess.Popen] = []
        for name, file in files.items():
            wanted = {"connect": f"{protocol}/{net.hub(name)}:7377", "name": name, "seconds": seconds, "out": str(file)}
            command = [sys.executable, "-m", "benchmarks.two_pullers", json.dumps(wanted)]
            people.append(net.start(name, command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
        watchdog = threading.Timer(START, lambda: [person.kill() for person in people])
        watchdog.start()
        try:
            pipes = [(person.stdout, person.stdin) for person in people if person.stdout and person.stdin]
            if any(said.readline() != "met\n" for said, _ in pipes):
                raise RuntimeError(f"the clients did not meet within {START:.0f} s")
            begin = time.monotonic() + 1.0
            for _, say in pipes:
                say.write(f"{begin}\n")
                say.flush()
            for person in people:
                person.wait(seconds + START)
            if missing := [name for name, file in files.items() if not file.exists()]:
                raise RuntimeError(f"no report of {', '.join(missing)}")
        finally:
            watchdog.cancel()
        seen = {}
        for name, file in files.items():
            with np.load(file) as columns:
                seen[name] = Seen(**{column: columns[column] for column in columns})
        return begin, seen


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How far two clients agree about the bunch that both people pull."""

    owners: tuple[str, ...]
    """All actors that either client considered the owner in the last seconds."""
    held: bool
    """Whether both people held the bunch to the end."""
    moving: float
    """95th percentile of the difference between the bunch's displacements on the two clients, from the start of the
    pull until the bunch has settled [m]."""
    resting: float
    """95th percentile of the difference between the bunch's displacements on the two clients in the last seconds
    [m]."""
    off: float
    """Largest displacement of the bunch in the last seconds, on either client [m]."""
    spans: tuple[float, float]
    """Largest range of the displacement on either client: in the seconds after the bunch has settled, and in the last
    seconds [m]."""
    rate: float
    """Steps a second of the slower client [Hz]."""
    alone: float
    """Share of the steps since the start in which a client had lost the server; the larger share of the two clients.

    On a busy machine the process that emulates the link may stop for longer than the lease.
    """


def outcome(begin: float, seen: dict[str, Seen]) -> Outcome:
    """Compare the records of both clients of a run that started at ``begin`` [s]."""
    end = min(one.clock[-1] for one in seen.values())
    settled = begin + PULLS_UNTIL + SETTLE
    part = 0.4 * (end - settled)

    def difference(since: float, until: float) -> float:
        times = np.arange(since, until, 0.01)
        first, second = (np.interp(times, one.clock, one.way) for one in seen.values())
        return float(np.percentile(np.abs(first - second), 95))

    def ways(since: float, until: float) -> list[np.ndarray]:
        return [one.way[(one.clock >= since) & (one.clock <= until)] for one in seen.values()]

    lasts = [(one, one.clock >= end - part) for one in seen.values()]
    return Outcome(
        owners=tuple(sorted({str(name) for one, rows in lasts for name in one.owner[rows]})),
        held=all(bool(one.held[rows].all()) for one, rows in lasts),
        moving=difference(begin + PULLS_AT, settled),
        resting=difference(end - part, end),
        off=max(float(np.abs(way).max()) for way in ways(end - part, end)),
        spans=(
            max(float(np.ptp(way)) for way in ways(settled, settled + part)),
            max(float(np.ptp(way)) for way in ways(end - part, end)),
        ),
        alone=max(float(one.alone[one.clock > begin].mean()) for one in seen.values()),
        rate=min(float((one.clock > begin).sum() / (end - begin)) for one in seen.values()),
    )


def two_pullers() -> Iterator[Measurement]:
    """Measure one run over tcp and one over udp."""
    for protocol in ("tcp", "udp"):
        found = outcome(*run_two_pullers(protocol=protocol))
        case = f"two people pull at one bunch, 50 +- 20 ms to the server, 2 % lost each way, {protocol}"
        yield Measurement("link", f"{case}: owners, on both clients", float(len(found.owners)), "", "wanted", 1.0)
        yield Measurement("link", f"{case}: both hold it to the end", float(found.held), "", "wanted", 1.0)
        yield Measurement("link", f"{case}: difference of both clients while they pull, p95", 1e3 * found.moving, "mm")
        yield Measurement("link", f"{case}: the same at rest, p95", 1e3 * found.resting, "mm")
        yield Measurement("link", f"{case}: distance from the middle at rest, at most", 1e3 * found.off, "mm")
        yield Measurement("link", f"{case}: span of the motion after 2 s", 1e3 * found.spans[0], "mm")
        yield Measurement("link", f"{case}: the same in the last seconds", 1e3 * found.spans[1], "mm")
        yield Measurement("link", f"{case}: steps without the server", 100.0 * found.alone, "%", "wanted", 0.0)
        yield Measurement("link", f"{case}: steps of the slower client", found.rate, "Hz", "wanted", 100.0)


if __name__ == "__main__":
    run_client(**json.loads(sys.argv[1]))
