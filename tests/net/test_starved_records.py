"""Overloaded machines delay records and lose none: a stopped router, a loop that does not run, dropped messages."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable

import pytest

from benchmarks.router_load import router
from tests.support.waiting import wait
from vinesim.net.codec.control import Hello, RetainedRecord, decode_records, encode_hello
from vinesim.net.codec.messages import Counters
from vinesim.net.replication import retained_sync
from vinesim.net.replication.retained_sync import RetainedSync
from vinesim.net.server.server import Server
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.scene.ids import ObjectKind, object_id

CELL = (0, 0)


class Loop:
    """The part of a client's real-time loop that exchanges records."""

    def __init__(self, bus: ZenohBus) -> None:
        bus.join(encode_hello(Hello(bus.name, digest="D", scene="vsp")))
        self.bus = bus
        self.sync = RetainedSync(bus, Counters())

    def publish(self, box: int) -> None:
        pose = (float(box), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        self.sync.publish(CELL, RetainedRecord(object_id(ObjectKind.BOX, box), 0, 1, self.bus.name, pose))

    def run(self) -> None:
        self.sync.update_window([CELL], 0, time.monotonic())
        self.sync.flush()
        payloads = [payload for key, payload in self.bus.poll() if key.startswith("fact/")]
        for reply in self.bus.replies():
            self.sync.mark_answered(CELL)
            payloads.append(reply.payload)
        for payload in payloads:
            for record in decode_records(payload):
                self.sync.merge(CELL, record)

    def has(self, *boxes: int) -> bool:
        return all(self.sync.state.get(object_id(ObjectKind.BOX, box)) is not None for box in boxes)


def running(loops: list[Loop], condition: Callable[[], object]) -> Callable[[], object]:
    """Returns a condition for :func:`wait` that also runs ``loops``."""

    def check() -> object:
        for loop in loops:
            loop.run()
        time.sleep(0.005)
        return condition()

    return check


@pytest.mark.slow
def test_a_router_that_gets_no_processor_time_loses_no_record_of_a_loop_that_gets_none():
    """Of three linked routers the middle one stops for longer than the lease, and the loop of ada for as long."""
    with contextlib.ExitStack() as stack:
        main, _ = stack.enter_context(router())
        middle, process = stack.enter_context(router("--connect", main))
        last, _ = stack.enter_context(router("--connect", middle))
        bob = Loop(stack.enter_context(ZenohBus("bob", connect=main)))
        ada = Loop(stack.enter_context(ZenohBus("ada", connect=last)))
        bob.publish(0)
        ada.publish(1)
        wait(running([ada, bob], lambda: ada.has(0) and bob.has(1)), "both to hear each other")
        os.kill(process.pid, signal.SIGSTOP)
        try:
            wait(running([bob], lambda: "ada" not in bob.bus.alive()), "bob to lose ada")
            bob.publish(2)
            ada.publish(3)
            wait(lambda: "bob" not in ada.bus.alive() and ada.bus.status_message, "ada's bus to lose bob")
        finally:
            os.kill(process.pid, signal.SIGCONT)
        wait(running([bob], lambda: "ada" in bob.bus.alive()), "bob to see ada again")
        wait(lambda: "bob" in ada.bus.alive() and not ada.bus.status_message, "ada's bus to be back")
        wait(running([ada, bob], lambda: ada.has(2) and bob.has(3)), "what both did meanwhile", 60.0)
        assert bob.bus.missed, "ada has left and come back"


def test_a_record_of_a_session_that_did_not_seem_to_hold_its_name_arrives_later(monkeypatch):
    """While links are lost and come back, a message may arrive before the news that its session holds the name."""
    monkeypatch.setattr(retained_sync, "REPAIR_DELAY", 0.5)
    with (
        Server("tcp/127.0.0.1:0") as server,
        ZenohBus("bob", connect=server.endpoint) as bobs,
        ZenohBus("ada", connect=server.endpoint) as adas,
    ):
        bob, ada = Loop(bobs), Loop(adas)
        bob.publish(0)
        ada.publish(1)
        wait(running([ada, bob], lambda: ada.has(0) and bob.has(1)), "both to hear each other")
        with monkeypatch.context() as news:
            news.setattr(bobs._names, "holder", lambda name: "")
            ada.publish(2)
            wait(running([ada, bob], lambda: bobs.foreign), "bob to drop it")
        assert bobs.missed == 1
        assert not bob.has(2)
        wait(running([ada, bob], lambda: bob.has(2)), "the record", 20.0)
