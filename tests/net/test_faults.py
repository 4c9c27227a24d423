"""Faults of real processes over Zenoh: killed, frozen, restarted; and wrong clocks.

All tests share one server and one set of clients; a link that is cut is in ``test_wire.py``.
"""

from __future__ import annotations

import contextlib
import math
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from benchmarks.support.fake_client import FakeClientProcess
from tests.support import programs
from tests.support.live_server import ServerProcess, wait
from tests.support.waiting import deadline

pytestmark = pytest.mark.slow

PLACES = {"ada": 1.0, "bob": 2.0, "cleo": 3.0, "dan": 2.5}
SKEWS = {"ada": 2.0, "bob": -2.0}
LEAVE_TIMEOUT = 2.5
"""A frozen client is gone within [s], on a machine that is idle."""
RESUME_TIMEOUT = 1.5
"""Streams go on within this time after a server listens again [s], on a machine that is idle."""
ATTEMPTS = 5
"""One of so many has to keep to its time: a busy machine makes single ones late, a fault all of them."""


class FakeClients:
    """Fake clients that have joined, each in its own process with its own clock."""

    def __init__(self, server: ServerProcess, processes: dict[str, FakeClientProcess]) -> None:
        self.server = server
        self.processes = processes

    def __getitem__(self, name: str) -> FakeClientProcess:
        return self.processes[name]

    def has_received(self, name: str, tree: int, since: float) -> bool:
        """An update of a tree arrived after ``since`` [s] by that client's clock."""
        return self[name].command()["heard"].get(str(tree), -math.inf) > since

    def owners(self, tree: int) -> set:
        return {process.command()["owner"].get(str(tree)) for process in self.processes.values()}

    def agree(self, tree: int) -> bool:
        """All hold the same claim and name the same owner."""
        claims = {str(process.command()["claim"].get(str(tree))) for process in self.processes.values()}
        return len(claims) == 1 and len(self.owners(tree)) == 1


@pytest.fixture(scope="module")
def clients() -> Iterator[FakeClients]:
    with ServerProcess("tcp/127.0.0.1:0") as server, contextlib.ExitStack() as stack:

        def start(name: str) -> FakeClientProcess:
            return FakeClientProcess(
                server.endpoint,
                [{"name": name, "place": [PLACES[name], 0.0]}],
                skew=SKEWS.get(name, 0.0),
                start=programs.Popen,
            )

        with ThreadPoolExecutor() as pool:
            processes = dict(zip(PLACES, pool.map(start, PLACES), strict=True))
        for process in processes.values():
            stack.enter_context(process)
        wait(lambda: all(len(s.command()["poses"]) == len(PLACES) - 1 for s in processes.values()), "all to join")
        yield FakeClients(server, processes)


def test_clocks_that_differ_by_seconds_are_corrected(clients):
    """Each client extrapolates the other to the current time, though their clocks differ by 4 s. A joint turns at up
    to 0.6 rad/s, so an uncorrected clock would give an error as large as the amplitude, 0.3 rad. On a busy machine
    poses are late for a while, and are extrapolated from further.
    """

    def median_error() -> float:
        errors = []
        for _ in range(30):
            report = clients["bob"].command()
            truth = 0.3 * math.sin(2.0 * (report["now"] + 2.0 + 2.0))
            errors.append(abs(report["poses"]["ada"][0] - truth))
            time.sleep(0.02)
        return sorted(errors)[len(errors) // 2]

    def difference() -> float:
        return clients["ada"].command()["offset"] - clients["bob"].command()["offset"]

    wait(lambda: median_error() < 0.01, "ada's present pose")
    wait(lambda: abs(difference() + 4.0) < 0.05, "one network time")


def test_simultaneous_grabs_end_with_one_owner(clients):
    with ThreadPoolExecutor() as pool:
        for tree in range(4):
            requests = [pool.submit(clients[name].command, grab=[tree], touch=[tree]) for name in ("ada", "bob")]
            for request in requests:
                request.result()
            wait(lambda tree=tree: clients.agree(tree), "one owner everywhere")
            assert clients.owners(tree) < {"ada", "bob"}
    for name in ("ada", "bob"):
        clients[name].command(touch=[])


def test_a_killed_client_leaves_and_its_trees_get_a_new_owner_or_rest(clients, record_property):
    dan = clients.processes["dan"]
    dan.command(touch=[5])
    wait(lambda: clients.owners(5) == {"dan"}, "all to receive the owner of the tree")
    dan.process.kill()
    del clients.processes["dan"]
    took = wait(lambda: not any("dan" in s.command()["others"] for s in clients.processes.values()), "dan to leave")
    dan.close()
    record_property("missed after [s]", took)
    wait(lambda: clients.agree(5), "all to agree on the new owner")
    assert clients.owners(5) <= {None, *clients.processes}


@pytest.mark.long
def test_a_frozen_client_leaves_within_2_5_s_and_rejoins(clients, record_property):
    ada = clients["ada"]
    bob = clients["bob"]
    missed: list[float] = []
    while len(missed) < ATTEMPTS and not any(after < deadline(LEAVE_TIMEOUT) for after in missed):
        since = bob.command()["now"]
        ada.command(touch=[1], grab=[1])
        wait(lambda since=since: clients.has_received("bob", 1, since), "bob to receive the tree")
        ada.process.send_signal(signal.SIGSTOP)
        start = bob.command()["now"]
        wait(lambda start=start: bob.command()["left_at"].get("ada", -math.inf) > start, "ada to leave")
        left_at = bob.command()["left_at"]["ada"]
        ada.process.send_signal(signal.SIGCONT)
        missed.append(left_at - start)
        wait(lambda left_at=left_at: bob.command()["joined_at"]["ada"] > left_at, "ada to be back")
    record_property("missed after [s]", missed)
    assert min(missed) < deadline(LEAVE_TIMEOUT)
    now = bob.command()["now"]
    wait(
        lambda: clients.has_received("bob", 1, now) or bob.command()["owner"]["1"] == "bob",
        "updates of the tree to resume",
    )
    wait(lambda: clients.agree(1), "all to name the same owner")


@pytest.mark.long
def test_what_a_frozen_client_owned_before_is_not_believed_when_it_comes_back(clients):
    """Another one has grasped its tree meanwhile; the others have gone on."""
    ada = clients["ada"]
    bob = clients["bob"]
    cleo = clients["cleo"]
    ada.command(touch=[2])
    wait(lambda: clients.owners(2) == {"ada"}, "ada to own the tree")
    ada.process.send_signal(signal.SIGSTOP)
    wait(lambda: "ada" not in bob.command()["others"] and "ada" not in cleo.command()["others"], "ada to leave")
    since = bob.command(grab=[2], touch=[2])["now"]
    ticks = cleo.command()["ticks"]
    wait(lambda: cleo.command()["owner"]["2"] == "bob", "bob to own the tree")
    wait(lambda: cleo.command()["ticks"] > ticks + 60, "the others to go on")
    ada.process.send_signal(signal.SIGCONT)
    wait(lambda: bob.command()["joined_at"]["ada"] > since, "ada to be back")
    wait(lambda: clients.agree(2), "all to name the same owner")
    assert clients.owners(2) == {"bob"}
    for one in (ada, bob):
        one.command(touch=[])


def test_streams_resume_within_a_second_of_a_server_restart(clients, record_property):
    ada = clients["ada"]
    bob = clients["bob"]
    ada.command(touch=[6])
    wait(lambda: clients.has_received("bob", 6, -math.inf), "bob to receive the tree")
    took: list[float] = []
    while len(took) < ATTEMPTS and not any(after < deadline(RESUME_TIMEOUT) for after in took):
        clients.server.kill()
        wait(lambda: ada.command()["trouble"] and bob.command()["trouble"], "both to notice")
        ticks = ada.command()["ticks"]
        wait(lambda ticks=ticks: ada.command()["ticks"] > ticks + 20, "ada to keep stepping without a server")
        assert ada.command()["owner"]["6"] == "ada"
        clients.server.run()
        ready = bob.command()["now"]
        took.append(wait(lambda ready=ready: clients.has_received("bob", 6, ready), "the stream to resume"))
    record_property("streams again after [s]", took)
    assert min(took) < deadline(RESUME_TIMEOUT)
    assert bob.command()["owner"]["6"] == "ada"
