"""Who may be in a world: the first decides the scene, and every refusal names both sides and a remedy."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vinesim.net.codec import messages
from vinesim.net.codec.messages import Hello
from vinesim.net.server.admission import PROVISIONAL_TIMEOUT, AdmissionControl, SceneId


def ask(agreement, name, digest="D1", *, world="w", session="", scene="vsp", now=0.0):
    session = session or name
    agreement.on_join(world, name, session)
    hello = messages.encode_hello(Hello(name, scene=scene, digest=digest))
    return agreement.decide(world, name, session, hello, now)


def test_the_first_decides_the_scene_and_another_is_refused_by_both_names():
    agreement = AdmissionControl()
    assert ask(agreement, "ada") == messages.Welcome("", "vsp", "D1")
    why = ask(agreement, "bob", "D2", scene="tendone").refused
    for word in ("'bob'", "'tendone'", "'D2'", "'vsp'", "'D1'", "same scene, seed"):
        assert word in why
    assert not ask(agreement, "eve").refused
    assert (agreement.joined, agreement.refused) == (3, 1)
    assert not ask(agreement, "bob", "D2", world="another").refused


def test_a_world_forgets_its_scene_with_the_last_actor_unless_facts_are_kept():
    agreement = AdmissionControl()
    ask(agreement, "ada")
    agreement.on_leave("w", "ada", "ada")
    assert agreement.scene_of("w") == SceneId()
    assert not ask(agreement, "bob", "D2").refused
    agreement.pin_scene("w", SceneId("vsp", "D2"))
    agreement.on_leave("w", "bob", "bob")
    assert agreement.scene_of("w") == SceneId("vsp", "D2")
    assert "--state-dir" in ask(agreement, "ada", "D1").refused


def test_a_server_with_a_scene_lets_in_no_other():
    agreement = AdmissionControl(SceneId("vsp", "D1"))
    why = ask(agreement, "ada", "D2", scene="tendone").refused
    assert "'D1'" in why
    assert "'D2'" in why
    assert not ask(agreement, "bob").refused


def test_another_protocol_is_refused_by_both_numbers():
    hello = bytearray(messages.encode_hello(Hello("ada")))
    hello[2] = 9
    why = AdmissionControl().decide("w", "ada", "s", bytes(hello), 0.0).refused
    assert "version 9" in why
    assert f"version {messages.PROTOCOL}" in why
    inner = messages.encode_hello(msgspec.structs.replace(Hello("ada"), protocol=7))
    assert "version 7" in AdmissionControl().decide("w", "ada", "s", inner, 0.0).refused


@pytest.mark.parametrize(
    "greeting", [b"", b"VS", b"nonsense", messages.encode_hello(Hello("ada"))[:-3], bytes(1 << 21)]
)
def test_what_is_no_greeting_is_refused_in_words(greeting):
    assert "cannot be read" in AdmissionControl().decide("w", "ada", "s", greeting, 0.0).refused


def test_nobody_comes_under_another_name():
    hello = messages.encode_hello(Hello("bob"))
    assert "introduces itself as 'bob'" in AdmissionControl().decide("w", "ada", "s", hello, 0.0).refused


def test_a_name_has_one_bearer_and_asking_twice_is_no_harm():
    agreement = AdmissionControl()
    assert not ask(agreement, "ada", session="one").refused
    assert not ask(agreement, "ada", session="one").refused
    assert "already live" in ask(agreement, "ada", session="two").refused
    agreement.on_leave("w", "ada", "two")
    agreement.on_leave("w", "ada", "one")
    assert not ask(agreement, "ada", session="two").refused
    assert agreement.joined == 2


def test_there_is_room_for_so_many():
    agreement = AdmissionControl(max_actors=2)
    assert not ask(agreement, "ada").refused
    assert not ask(agreement, "bob", world="another").refused
    assert "room for 2" in ask(agreement, "eve").refused
    assert not ask(agreement, "ada").refused
    agreement.on_leave("another", "bob", "bob")
    assert not ask(agreement, "eve").refused


def test_who_was_let_in_and_never_came_holds_no_place():
    agreement = AdmissionControl(max_actors=1)
    hello = messages.encode_hello(Hello("ghost"))
    assert not agreement.decide("w", "ghost", "g", hello, 0.0).refused
    assert ask(agreement, "ada", now=1.0).refused
    assert not ask(agreement, "ada", now=PROVISIONAL_TIMEOUT + 1.0).refused


@given(st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from(["D1", "D2"]), st.booleans()), max_size=40))
def test_all_who_are_in_share_one_vineyard_whoever_comes_and_goes(events):
    agreement, inside = AdmissionControl(max_actors=2), {}
    for name, digest, leaves in events:
        if leaves:
            agreement.on_leave("w", name, name)
            inside.pop(name, None)
        elif not ask(agreement, name, digest).refused:
            inside[name] = digest
        assert len(set(inside.values())) <= 1
        assert len(inside) <= 2
        assert agreement.scene_of("w").digest == next(iter(inside.values()), "")
