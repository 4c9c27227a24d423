"""What goes wrong, with real processes over real Zenoh: killed, frozen, cut off, restarted; and wrong clocks."""

from __future__ import annotations

import contextlib
import math
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from ends import Served, need_links, wait

from vinesim.net.emulator import Emulator, Line, Way
from vinesim.net.puppet import Stage

PLACES = {"ada": 1.0, "bob": 2.0, "cleo": 3.0}
NOTICED = 2.5
"""A frozen client is gone within [s]."""


@contextlib.contextmanager
def company(connect: Callable[[str], str], *names: str, start=None, **options: dict) -> Iterator[dict[str, Stage]]:
    """Puppets, each in a process of its own, that have met."""
    with contextlib.ExitStack() as stack:

        def open_stage(name: str) -> Stage:
            where = {} if start is None else {"start": lambda *a, **k: start(name, *a, **k)}
            cast = [{"name": name, "place": [PLACES[name], 0.0]}]
            return Stage(connect(name), cast, **where, **options.get(name, {}))

        with ThreadPoolExecutor() as pool:
            stages = dict(zip(names, pool.map(open_stage, names), strict=True))
        for stage in stages.values():
            stack.enter_context(stage)
        wait(lambda: all(len(s.tell()["poses"]) == len(names) - 1 for s in stages.values()), "all to meet")
        yield stages


@pytest.fixture
def server() -> Iterator[Served]:
    with Served("tcp/127.0.0.1:0") as running:
        yield running


def hears(stage: Stage, tree: int, since: float) -> bool:
    """News of a tree came after ``since`` [s] by the puppet's clock."""
    return stage.tell()["heard"].get(str(tree), -math.inf) > since


def owners(stages: dict[str, Stage], tree: int) -> set:
    return {stage.tell()["owner"].get(str(tree)) for stage in stages.values()}


def claims(stages: dict[str, Stage], tree: int) -> list:
    return [stage.tell()["claim"].get(str(tree)) for stage in stages.values()]


def test_a_server_that_is_killed_and_restarted_carries_again_within_a_second(server):
    with company(lambda _: server.endpoint, "ada", "bob") as stages:
        ada, bob = stages.values()
        ada.tell(touch=[0])
        wait(lambda: hears(bob, 0, 0.0), "bob to hear of the tree")
        server.kill()
        wait(lambda: ada.tell()["trouble"] and bob.tell()["trouble"], "both to notice")
        ticks = ada.tell()["ticks"]
        wait(lambda: ada.tell()["ticks"] > ticks + 20, "ada's world to go on without a server")
        assert ada.tell()["owner"]["0"] == "ada"
        server.run()
        ready = bob.tell()["now"]
        took = wait(lambda: hears(bob, 0, ready), "the stream to come again")
        assert took < 1.0 + 0.5, "a second, and half of one for a busy machine"
        assert owners(stages, 0) == {"ada"}


def test_a_client_that_is_killed_is_gone_and_what_it_moved_is_the_neighbours(server):
    with company(lambda _: server.endpoint, "ada", "bob", "cleo") as stages:
        ada = stages.pop("ada")
        ada.tell(touch=[1])
        wait(lambda: owners(stages, 1) == {"ada"}, "all to hear who moves the tree")
        ada.process.kill()
        took = wait(lambda: not any("ada" in stage.tell()["others"] for stage in stages.values()), "ada to be missed")
        assert took < NOTICED
        wait(lambda: owners(stages, 1) <= {None, "bob"}, "the tree to be the nearest one's, or to rest")
        wait(lambda: len({str(claim) for claim in claims(stages, 1)}) == 1, "both to hold the same claim")


def test_a_frozen_client_is_gone_in_two_and_a_half_seconds_and_comes_back(server):
    with company(lambda _: server.endpoint, "ada", "bob", "cleo") as stages:
        ada, bob = stages["ada"], stages["bob"]
        ada.tell(touch=[1])
        wait(lambda: hears(bob, 1, 0.0), "bob to hear of the tree")
        ada.process.send_signal(signal.SIGSTOP)
        start = bob.tell()["now"]
        wait(lambda: "ada" in bob.tell()["went"], "ada to be missed", 5.0)
        went = bob.tell()["went"]["ada"]
        ada.process.send_signal(signal.SIGCONT)
        assert went - start < NOTICED
        wait(lambda: bob.tell()["came"]["ada"] > went, "ada to be back")
        now = bob.tell()["now"]
        wait(lambda: hears(bob, 1, now) or bob.tell()["owner"]["1"] == "bob", "the tree to be told of again")
        wait(lambda: len(owners(stages, 1)) == 1, "all to name the same owner")


def test_a_link_that_is_cut_for_five_seconds_heals():
    need_links()
    with Emulator({name: Line(Way(0.01)) for name in PLACES}) as net:

        def at(end: str) -> Callable:
            return lambda *a, **k: net.start(end, *a, **k)

        with (
            Served("tcp/0.0.0.0:7447", at("hub")),
            company(
                lambda name: f"tcp/{net.hub(name)}:7447", "ada", "bob", "cleo", start=lambda n, *a, **k: at(n)(*a, **k)
            ) as stages,
        ):
            ada, bob = stages["ada"], stages["bob"]
            ada.tell(touch=[1])
            wait(lambda: hears(bob, 1, 0.0), "bob to hear of the tree")
            net.cut("ada")
            cut = time.monotonic()
            wait(lambda: "ada" in bob.tell()["went"] and "bob" in ada.tell()["went"], "both sides to notice", 5.0)
            assert time.monotonic() - cut < NOTICED + 0.5
            # what was hers is touched by another meanwhile: two owners, each in a world of its own
            bob.tell(touch=[1])
            wait(lambda: time.monotonic() - cut > 5.0, "five seconds")
            assert ada.tell()["owner"]["1"] == "ada"
            assert bob.tell()["owner"]["1"] == "bob"
            net.shape("ada", Line(Way(0.01)))
            mended = bob.tell()["now"]
            wait(lambda: len(owners(stages, 1)) == 1, "one owner again")
            wait(lambda: bob.tell()["came"]["ada"] > mended, "the streams to come again")
            wait(lambda: len({str(claim) for claim in claims(stages, 1)}) == 1, "one claim")
            assert owners(stages, 1) < {"ada", "bob"}


def test_two_that_grab_one_thing_at_once_end_with_one_owner(server):
    with company(lambda _: server.endpoint, "ada", "bob", "cleo") as stages, ThreadPoolExecutor() as pool:
        for tree in range(4):
            together = [pool.submit(stages[name].tell, grab=[tree], touch=[tree]) for name in ("ada", "bob")]
            for each in together:
                each.result()
            wait(lambda tree=tree: len({str(claim) for claim in claims(stages, tree)}) == 1, "one claim everywhere")
            assert owners(stages, tree) < {"ada", "bob"}


def test_clocks_that_are_seconds_wrong_do_not_matter(server):
    """Each shows the other where it is now, though their clocks differ by four seconds: a joint turns at up to
    0.6 rad/s, so a clock believed as it stands would be wrong by as much as the joint moves at all, 0.3 rad.
    """
    skews = {"ada": {"skew": 2.0}, "bob": {"skew": -2.0}}
    with company(lambda _: server.endpoint, "ada", "bob", **skews) as stages:
        bob = stages["bob"]
        errors = []
        for _ in range(30):
            report = bob.tell()
            truth = 0.3 * math.sin(2.0 * (report["now"] + 2.0 + 2.0))
            errors.append(abs(report["poses"]["ada"][0] - truth))
            time.sleep(0.02)
        assert sorted(errors)[len(errors) // 2] < 0.01
        ada = stages["ada"].tell()
        assert ada["offset"] - bob.tell()["offset"] == pytest.approx(-4.0, abs=0.02)
