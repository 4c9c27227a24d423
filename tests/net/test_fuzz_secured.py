"""Malformed messages under all kinds of keys over TLS, from a let-in actor past the bus, and from strangers."""

from __future__ import annotations

import contextlib
import itertools
import random
import threading
import time

import zenoh

from benchmarks.message_fuzz import ATTACKER, storm
from benchmarks.support.fake_client import FakeClient, tree_row
from tests.support.waiting import wait
from vinesim.net.codec.objects import check_object_id
from vinesim.net.replication.streams import object_counts
from vinesim.net.server.server import Server
from vinesim.net.transport.access_control import tls_config
from vinesim.net.transport.certificates import create
from vinesim.net.transport.endpoints import parse
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.net.transport.zenoh_session import close_session, config, open_session

KEYS = (
    "{key}",
    "*/{key}",
    "vineyard/**",
    "vineyard/*/*/*/" + ATTACKER,
    "other/{key}",
    "vineyard",
    "vineyard/fact",
    "vineyard/fact/*/*/" + ATTACKER,
    "vineyard/fact/0",
    "vineyard/own/0/0/ada",
    "vineyard/fact/0/0/ada",
    "vineyard/a/ada",
    "vineyard/live/ada/1",
    "vineyard/join/ada/1",
    "vineyard/hello/ada",
    "vineyard/clock/ada",
    "vineyard/snap/0/0",
    "vineyard/snap/*/x",
    "vineyard/" + "n/" * 500 + "n",
    "vineyard/" + "n" * 5000,
    "vineyard/fact/x/" + ATTACKER,
    "vineyard/force/ada/ada",
    "vineyard/voice/ada",
    "vineyard/mesh/0",
    "vineyard/offer/0",
)
"""Patterns of keys below the root; ``{key}``: as the storm chose it."""


def test_over_tls_no_message_of_any_kind_or_key_stops_a_thread_or_is_believed_against_the_model(tmp_path):
    certs = tmp_path / "certs"
    other = tmp_path / "other"
    for folder, name in ((certs, "ada"), (certs, ATTACKER), (other, ATTACKER)):
        create(folder, name)
    model = tree_row()
    chance = random.Random(4)
    with (
        Server("tls/127.0.0.1:0", certificates=certs) as server,
        ZenohBus("ada", connect=server.endpoint, certificates=certs) as bus,
        ZenohBus(ATTACKER, connect=server.endpoint, certificates=certs) as let_in,
    ):
        ada = FakeClient(bus, model, (1.0, 0.0))
        evil = FakeClient(let_in, model, (2.0, 0.0))

        def both_see_each_other() -> bool:
            now = time.monotonic()
            ada.tick(now)
            evil.tick(now)
            return ATTACKER in ada.robots and "ada" in evil.robots

        wait(both_see_each_other, "the two to join")
        threads = {thread.name for thread in threading.enumerate()}
        locator = parse(server.endpoint, secured=True).locator
        strangers = {"connect__endpoints": [locator], "connect__timeout_ms": 300, "connect__exit_on_failure": False}
        heard = ada.replicator.counters.to_report(), server.figures()
        for credentials in (
            tls_config(other, ATTACKER),
            {"transport__link__tls": {"root_ca_certificate": str(certs / "ca.pem")}},
        ):
            with contextlib.suppress(zenoh.ZError):  # refused, or open to nothing
                stranger = open_session(config("client", **strangers, **credentials))
                for key, payload in itertools.islice(storm(model, evil, 8, names=["ada", "bob", ATTACKER]), 300):
                    stranger.put(f"vs/1/vineyard/{key}", payload, congestion_control=zenoh.CongestionControl.BLOCK)
                assert list(stranger.info.routers_zid()) == []
                close_session(stranger)
        ada.tick(time.monotonic())
        assert server.actors == ["vineyard/ada", f"vineyard/{ATTACKER}"]
        for what in ("foreign", "malformed", "facts_heard"):
            assert server.figures()[what] == heard[1][what], "nothing arrives at the server"
        for what in ("foreign", "malformed", "dropped"):
            assert ada.replicator.counters.to_report()[what] == heard[0][what], "and nothing at a client"

        raw = open_session(config("client", connect__endpoints=[locator], **tls_config(certs, ATTACKER)))
        before = ada.replicator.counters.malformed
        publishers: dict = {}
        for number, (key, payload) in enumerate(itertools.islice(storm(model, evil, 7, time.monotonic()), 600)):
            if number % 2:
                publishers.setdefault(key, let_in.publisher(key, reliable=True)).put(payload)
            else:
                with contextlib.suppress(zenoh.ZError):  # no key at all: refused at the sender
                    raw.put(f"vs/1/{chance.choice(KEYS).format(key=key)}", payload)
            if number % 20 == 0:
                ada.tick(time.monotonic())
                time.sleep(0.005)
        close_session(raw)
        wait(
            lambda: ada.tick(time.monotonic()) or ada.replicator.counters.malformed > before + 20,
            "malformed ones to arrive",
        )
        assert threads <= {thread.name for thread in threading.enumerate()}, "no thread ended"
        assert set(ada.robots) == {ATTACKER}
        for known in ada.replicator.known:
            check_object_id(known, object_counts(model))
        figures = server.figures()
        assert figures["facts_failed"] == 0
        ada.touching = {1}
        wait(lambda: ada.tick(time.monotonic()) or ada.replicator.owner(1) is not None, "the world to go on")
