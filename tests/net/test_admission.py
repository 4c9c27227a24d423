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
from vinesim.net.server.admission import MAX_DEPARTED, PROVISIONAL_TIMEOUT, AdmissionControl, JoinLimits, SceneId
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
    eve = encode_hello(Hello("eve"))
    assert "admits 1 actors" in admission.decide("w", "eve", "e", eve, 1.0).refused  # she has not come either
    assert not admission.decide("w", "eve", "e", eve, PROVISIONAL_TIMEOUT + 1.0).refused
    assert admission.expire(3.0 * PROVISIONAL_TIMEOUT) == [("w", "eve")]
    assert not admission.decide("w", "ghost", "g", hello, 3.0 * PROVISIONAL_TIMEOUT).refused
    assert not join(admission, "ada", now=3.0 * PROVISIONAL_TIMEOUT).refused  # an actor that is live does not wait
    assert admission.holder("w", "ghost") == ""


def test_join_queries_that_never_come_do_not_keep_an_honest_client_out():
    admission = AdmissionControl(max_actors=12)
    for number in range(12):
        admission.decide("w", f"ghost{number}", "one session", encode_hello(Hello(f"ghost{number}")), 0.0)
        admission.decide("w", f"ghost{number}", f"s{number}", encode_hello(Hello(f"ghost{number}")), 0.0)
    assert not join(admission, "ada").refused


def test_a_liveliness_token_alone_reserves_no_name_after_the_start():
    admission = AdmissionControl()
    admission.reserved_until = 10.0
    admission.on_join("w", "ada", "squatter")
    assert "already live" in join(admission, "ada", session="ada", now=9.0).refused
    assert not join(admission, "ada", session="ada", now=11.0).refused
    assert admission.holder("w", "ada") == "ada"
    assert "already live" in join(admission, "ada", session="squatter", now=12.0).refused


@pytest.mark.parametrize("world", ["w" * 260, "a\0b", "", "../x", "a b", "ü"])
def test_a_world_that_clients_refuse_is_refused_by_the_server(world):
    admission = AdmissionControl()
    assert "use 1 to 48 letters" in join(admission, "ada", world=world).refused
    assert "use 1 to 48 letters" in admission.decide("w", world, "s", encode_hello(Hello("ada")), 0.0).refused
    assert "use 1 to 48 letters" in admission.decide("w", "ada", world, encode_hello(Hello("ada")), 0.0).refused
    assert admission.scene_of(world) == SceneId()


def test_worlds_joins_and_actors_of_one_address_are_limited():
    limits = JoinLimits(actors_per_address=3, waiting_per_address=2, worlds=4, worlds_per_address=2)

    def ask(name: str, world: str = "w", address: str = "10.0.0.7", live: bool = True, now: float = 0.0) -> str:
        if live:
            admission.on_join(world, name, name)
        return admission.decide(world, name, name, encode_hello(Hello(name)), now, address).refused

    admission = AdmissionControl(limits=limits)
    assert [ask(name) for name in "abc"] == ["", "", ""]
    assert "3 actors of one address" in ask("d")
    assert ask("d", address="10.0.0.8") == ask("d", address="10.0.0.8") == ""
    assert ask("e", address="127.0.0.1") == ask("f", address="127.0.0.1") == ""
    assert ask("g", address="127.0.0.1") == ask("h", address="127.0.0.1") == ""  # this machine itself
    assert ask("i", address="127.0.0.2", live=False) == ask("j", address="127.0.0.2", live=False) == ""
    assert "did not come" in ask("k", address="127.0.0.2", live=False)
    assert ask("l", "w2", "127.0.0.1") == ask("m", "w3", "127.0.0.1") == ""
    assert "worlds" in ask("n", "w4", "127.0.0.1")
    assert ask("o", "w3", "127.0.0.1") == ""  # a world that is there
    assert ask("p", "w5", "10.0.0.9") == ""
    assert "worlds" in ask("q", "w6", "10.0.0.10")
    assert "more than 1 times a second" in [ask("a") for _ in range(20)][-1]
    assert ask("a", now=60.0) == ""


def test_what_a_session_holds_ends_with_it():
    admission = AdmissionControl()
    join(admission, "ada", session="s")
    assert "has joined as 'ada'" in join(admission, "bob", session="s").refused
    assert admission.end_session("s") == [("w", "ada")]
    assert admission.end_session("s") == []
    assert admission.scene_of("w") == SceneId()
    assert not join(admission, "bob", session="s").refused


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


def test_the_last_records_of_an_actor_that_has_left_are_its_own():
    """Until another session has the name; a spectator has none; and only so many are known."""
    admission = AdmissionControl()
    for name, kind in (("ada", "robot"), ("eva", "spectator")):
        admission.decide("w", name, f"s-{name}", encode_hello(Hello(name, kind=kind)), 0.0)
        admission.on_join("w", name, f"s-{name}")
    admission.on_leave("w", "ada", "s-ada")
    admission.end_session("s-eva")
    assert [admission.publisher("w", name) for name in ("ada", "eva", "bob")] == ["s-ada", "s-eva", ""]
    admission.on_leave("w", "eva", "s-eva")
    assert admission.publisher("w", "eva") == ""
    admission.on_join("w", "ada", "another")
    assert admission.publisher("w", "ada") == "another"
    for number in range(MAX_DEPARTED):
        admission.decide("w", f"a{number}", f"s{number}", encode_hello(Hello(f"a{number}")), 0.0)
        admission.on_leave("w", f"a{number}", f"s{number}")
    admission.on_leave("w", "ada", "another")
    assert admission.publisher("w", "ada") == ""
    assert admission.publisher("w", "a255") == "s255"


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
