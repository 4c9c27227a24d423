"""Admission to a world: the first actor decides the scene, and a refusal names both sides and a remedy."""

from __future__ import annotations

import collections
import types
from collections.abc import Callable

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vinesim.net.codec.control import Hello, Welcome, encode_hello, encode_welcome
from vinesim.net.codec.header import PROTOCOL
from vinesim.net.server.admission import PROVISIONAL_TIMEOUT, AdmissionControl, SceneId
from vinesim.net.transport import zenoh_admission


def join(admission, name, digest="D1", *, world="w", session="", scene="vsp", now=0.0):
    session = session or name
    admission.on_join(world, name, session)
    hello = encode_hello(Hello(name, scene=scene, digest=digest))
    return admission.decide(world, name, session, hello, now)


def test_the_first_actor_decides_the_scene_and_another_is_refused_with_both_names():
    admission = AdmissionControl()
    assert join(admission, "ada") == Welcome("", "vsp", "D1")
    reason = join(admission, "bob", "D2", scene="tendone").refused
    for word in ("'bob'", "'tendone'", "'D2'", "'vsp'", "'D1'", "same scene, seed"):
        assert word in reason
    assert not join(admission, "eve").refused
    assert (admission.joined, admission.refused) == (3, 1)
    assert not join(admission, "bob", "D2", world="another").refused


def test_a_world_loses_its_scene_with_the_last_actor_unless_records_are_stored():
    admission = AdmissionControl()
    join(admission, "ada")
    admission.on_leave("w", "ada", "ada")
    assert admission.scene_of("w") == SceneId()
    assert not join(admission, "bob", "D2").refused
    admission.pin_scene("w", SceneId("vsp", "D2"))
    admission.on_leave("w", "bob", "bob")
    assert admission.scene_of("w") == SceneId("vsp", "D2")
    assert "--state-dir" in join(admission, "ada", "D1").refused


def test_a_server_started_for_a_scene_refuses_others():
    admission = AdmissionControl(SceneId("vsp", "D1"))
    reason = join(admission, "ada", "D2", scene="tendone").refused
    assert "'D1'" in reason
    assert "'D2'" in reason
    assert not join(admission, "bob").refused


def test_another_protocol_is_refused_with_both_versions():
    hello = bytearray(encode_hello(Hello("ada")))
    hello[2] = PROTOCOL + 1
    reason = AdmissionControl().decide("w", "ada", "s", bytes(hello), 0.0).refused
    assert f"version {PROTOCOL + 1}" in reason
    assert f"version {PROTOCOL}" in reason
    inner = encode_hello(msgspec.structs.replace(Hello("ada"), protocol=PROTOCOL + 1))
    assert f"version {PROTOCOL + 1}" in AdmissionControl().decide("w", "ada", "s", inner, 0.0).refused


@pytest.mark.parametrize("payload", [b"", b"VS", b"nonsense", encode_hello(Hello("ada"))[:-3], bytes(1 << 21)])
def test_an_invalid_hello_is_refused_with_the_reason(payload):
    assert "cannot be read" in AdmissionControl().decide("w", "ada", "s", payload, 0.0).refused


def test_a_hello_under_another_name_is_refused():
    hello = encode_hello(Hello("bob"))
    assert "introduces itself as 'bob'" in AdmissionControl().decide("w", "ada", "s", hello, 0.0).refused


def test_a_name_belongs_to_one_session_and_joining_twice_is_allowed():
    admission = AdmissionControl()
    assert not join(admission, "ada", session="one").refused
    assert not join(admission, "ada", session="one").refused
    assert "already live" in join(admission, "ada", session="two").refused
    admission.on_leave("w", "ada", "two")
    admission.on_leave("w", "ada", "one")
    assert not join(admission, "ada", session="two").refused
    assert admission.joined == 2


def test_the_number_of_actors_is_limited():
    admission = AdmissionControl(max_actors=2)
    assert not join(admission, "ada").refused
    assert not join(admission, "bob", world="another").refused
    assert "admits 2 actors" in join(admission, "eve").refused
    assert not join(admission, "ada").refused
    admission.on_leave("another", "bob", "bob")
    assert not join(admission, "eve").refused


def test_an_admitted_actor_that_never_joins_loses_its_place():
    admission = AdmissionControl(max_actors=1)
    hello = encode_hello(Hello("ghost"))
    assert not admission.decide("w", "ghost", "g", hello, 0.0).refused
    assert join(admission, "ada", now=1.0).refused
    assert not join(admission, "ada", now=PROVISIONAL_TIMEOUT + 1.0).refused


@given(st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from(["D1", "D2"]), st.booleans()), max_size=40))
def test_all_actors_of_a_world_share_one_scene(events):
    admission = AdmissionControl(max_actors=2)
    members = {}
    for name, digest, leaves in events:
        if leaves:
            admission.on_leave("w", name, name)
            members.pop(name, None)
        elif not join(admission, name, digest).refused:
            members[name] = digest
        assert len(set(members.values())) <= 1
        assert len(members) <= 2
        assert admission.scene_of("w").digest == next(iter(members.values()), "")


class _SlowlyRouted:
    """A Zenoh session with a server that is announced, and to which the first queries are not routed."""

    def __init__(self, lost: int) -> None:
        self.lost = lost
        self.queries = 0
        self.matching_status = types.SimpleNamespace(matching=True)
        self.info = types.SimpleNamespace(routers_zid=list)

    def zid(self) -> str:
        return "a1"

    def declare_querier(self, _key: str) -> _SlowlyRouted:
        return self

    def declare_matching_listener(self, callback: Callable[[object], None]) -> None:
        self.on_matching = callback

    def get(self, _key: str, **_: object) -> list[types.SimpleNamespace]:
        self.queries += 1
        if self.queries <= self.lost:
            return []
        payload = types.SimpleNamespace(to_bytes=lambda: encode_welcome(Welcome()))
        server = types.SimpleNamespace(zid="b2")
        return [types.SimpleNamespace(ok=types.SimpleNamespace(payload=payload), replier_id=server)]


def start_admission(session: _SlowlyRouted) -> tuple[zenoh_admission.ServerAdmission, collections.deque]:
    tasks = collections.deque()
    admission = zenoh_admission.ServerAdmission(
        session, "vs/1/w/", name="ada", world="w", endpoint="tcp/h:1", is_secured=False, submit=tasks.append
    )
    admission.join(b"hello")
    return admission, tasks


def do_all(tasks: collections.deque) -> None:
    while tasks:
        assert len(tasks) == 1
        tasks.popleft()()


def test_a_hello_is_repeated_until_the_server_that_is_announced_replies(monkeypatch):
    """However long that takes, and without keeping the thread from its other tasks."""
    monkeypatch.setattr(zenoh_admission, "RETRY_PERIOD", 0.0)
    monkeypatch.setattr(zenoh_admission, "CONNECT_TIMEOUT", 0.0)
    session = _SlowlyRouted(lost=50)
    admission, tasks = start_admission(session)
    do_all(tasks)
    assert session.queries == 51
    assert admission.rejection == ""


def test_a_server_that_came_before_its_predecessor_went_admits_again():
    session = _SlowlyRouted(lost=0)
    admission, tasks = start_admission(session)
    for matching in (True, False):  # in this order, although the server is there now
        session.on_matching(types.SimpleNamespace(matching=matching))
    do_all(tasks)
    count = admission.count
    session.on_matching(types.SimpleNamespace(matching=False))
    session.matching_status.matching = False
    admission.watch()
    do_all(tasks)
    assert (admission.is_served, admission.count) == (False, count)
    session.matching_status.matching = True
    admission.watch()
    do_all(tasks)
    assert (admission.is_served, admission.count) == (True, count + 1)


def test_a_server_that_goes_before_it_could_reply_is_missed_whatever_the_order_of_reports():
    session = _SlowlyRouted(lost=1000)
    session.matching_status.matching = False
    admission, tasks = start_admission(session)
    do_all(tasks)
    admission.watch()
    assert admission.is_served, "there was none yet"
    for matching in (False, True):  # in this order, although the server is gone now
        session.on_matching(types.SimpleNamespace(matching=matching))
    do_all(tasks)
    admission.watch()
    assert not admission.is_served


def test_a_server_that_goes_while_its_reply_is_on_the_way_is_missed():
    session = _SlowlyRouted(lost=1)
    admission, tasks = start_admission(session)
    reply = session.get

    def get_and_lose(key: str, **options: object) -> list[types.SimpleNamespace]:
        session.on_matching(types.SimpleNamespace(matching=False))
        session.matching_status.matching = False
        return reply(key, **options)

    session.get = get_and_lose
    do_all(tasks)
    admission.watch()
    assert not admission.is_served
