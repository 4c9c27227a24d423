"""``python -m benchmarks joins``: memory of a server and of a resident client while others join and leave.

The server and the resident, a person with physics, are programs. The others are people with bodies, without physics of
their own, who join in groups, stand next to the resident until it shows them all, and leave.

The last rows are those of a router of Zenoh alone, to whose sessions the same happens: each subscribes to as many keys
as a person and publishes as many, and ends, while another session subscribes to the same keys.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

import zenoh

from benchmarks.support.fake_client import FakeClient
from benchmarks.support.small_world import SmallWorld, beside
from vinesim.bench.live_client import own_processes
from vinesim.bench.process_memory import check_proc, sample_process
from vinesim.client.programs import START_TIMEOUT, ProgramFailed
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.net.transport.zenoh_session import config, open_session
from vinesim.scene.values import Measurement

GROUP = 20
"""Number of people who join at once."""
SETTLING = 300
"""Number of joins after which memory counts."""
BUDGET = 5.0
"""Largest accepted growth of a process after :data:`SETTLING` joins [MB]."""
TIMEOUT = 300.0
"""Longest time for a group to join or to leave [s]."""
SUBSCRIPTIONS = 85
"""Number of keys with a wildcard to which a person subscribes and its neighbours do, too."""
BARE_SESSIONS = 300
"""Number of sessions of the router of Zenoh alone between two measurements."""

ROUTER = """
import sys
from vinesim.core.allocator import release_free_memory
from vinesim.net.transport.endpoints import resolve_ports
from vinesim.net.transport.zenoh_session import config, open_session

(endpoint,) = resolve_ports(["tcp/127.0.0.1:0"], secured=False)
session = open_session(config("router", listen__endpoints=[endpoint.locator]))
print(endpoint, flush=True)
for _ in sys.stdin:
    release_free_memory()
    print("released", flush=True)
session.close()
"""


def joins(count: int, announce: Callable[[str], None]) -> Iterator[Measurement]:
    """Let ``count`` people join and leave, and measure. ``announce`` is called with a line of text from time to time.

    Raises :class:`ProgramFailed` if a program ends, or a group is not seen in time; :class:`ProcUnavailable` on systems
    without /proc.
    """
    check_proc()
    with own_processes() as group:
        world = SmallWorld(group, 1)
        world.wait_until_ready()
        pids = {"server": world.server.child.pid, "resident client": world.clients["person_0"].child.pid}
        settled: dict[str, float] = {}
        done = 0
        while done < count:
            _join(world, done)
            done += GROUP
            if done >= SETTLING and not settled:
                settled = {what: sample_process(pid).own for what, pid in pids.items()}
            if done % (10 * GROUP) == 0:
                now = ", ".join(f"{what} {sample_process(pid).own:.1f} MB" for what, pid in pids.items())
                announce(f"{done} of {count} joins: {now}")
        ended = {what: sample_process(pid).own for what, pid in pids.items()}
        faults = world.newest["person_0"]["faults"]
    yield Measurement("joins", "joins and leaves with bodies", done, "1")
    for what, memory in ended.items():
        growth = memory - settled.get(what, memory)
        yield Measurement("joins", f"{what}: memory at the end", memory, "MB")
        case = f"{what}: growth after the first {SETTLING}"
        yield Measurement("joins", case, growth, "MB", "budget, at most", BUDGET, None)
    for name, value in sorted(faults.items()):
        yield Measurement("joins", f"resident client: {name.replace('_', ' ')}", value, "1")
    for what, end in (("keys with a wildcard", "*"), ("keys without a wildcard", "all")):
        growth = _bare_growth([f"k/{number}/{end}" for number in range(SUBSCRIPTIONS)])
        yield Measurement("joins", f"router of Zenoh alone, {SUBSCRIPTIONS} {what}: growth", growth, "kB per session")


def _bare_growth(keys: list[str]) -> float:
    """Returns by how much a router of Zenoh grows [kB] with each session that subscribes to ``keys``, publishes under
    as many keys with its own name, and ends, while another session subscribes to the same ``keys``."""
    with own_processes() as group:
        router = group.start("router", "-c", ROUTER)
        endpoint = router.next_line(START_TIMEOUT)
        settings = config("client", connect__endpoints=[endpoint])
        with open_session(settings) as resident:
            kept = [resident.declare_subscriber(key, _ignore) for key in keys]
            sizes = []
            for half in range(2):
                for number in range(BARE_SESSIONS):
                    with open_session(settings) as guest:
                        name = f"guest_{half}_{number}"
                        subscribers = [guest.declare_subscriber(key, _ignore) for key in keys]
                        publishers = [guest.declare_publisher(f"{key.rpartition('/')[0]}/{name}") for key in keys]
                        for entity in [*publishers, *subscribers]:
                            entity.undeclare()
                router.write_line("release")
                router.next_line(START_TIMEOUT)
                sizes.append(sample_process(router.child.pid).own)
            for entity in kept:
                entity.undeclare()
    return 1000.0 * (sizes[1] - sizes[0]) / BARE_SESSIONS


def _ignore(_: zenoh.Sample) -> None:
    """Callback of subscriptions whose messages do not matter."""


def _join(world: SmallWorld, first: int) -> None:
    """Let one group join, be seen, and leave."""
    with contextlib.ExitStack() as stack:
        people = []
        for number in range(GROUP):
            bus = stack.enter_context(ZenohBus(f"guest_{first + number}", connect=world.endpoint))
            place = beside(world.place, number)
            people.append(FakeClient(bus, world.model, place, kind="human", digest=world.model.digest()))
        _wait(world, GROUP, people)
    _wait(world, 0, [])


def _wait(world: SmallWorld, others: int, people: list[FakeClient]) -> None:
    """Step the people until the resident sees so many ``others``."""
    start = time.monotonic()
    while not world.all_served(start, others):
        world.read()
        for one in people:
            one.tick(time.monotonic())
        if time.monotonic() > start + TIMEOUT:
            raise ProgramFailed(f"the resident client does not see {others} others after {TIMEOUT:.0f} s")
        time.sleep(0.1)
