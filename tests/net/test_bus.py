"""The bus in memory: delivery, order, delay and loss, by an explicit clock."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vinesim.net.transport.bus import (
    KEEP_ALL,
    KEEP_LAST_1,
    KEEP_LAST_64,
    MAX_STORED_BYTES,
    NameTaken,
    SampleStore,
    matches,
)
from vinesim.net.transport.memory_bus import MemoryHub


@pytest.mark.parametrize(
    ("pattern", "key", "covers"),
    [
        ("a/*", "a/x", True),
        ("a/*", "a/x/far", False),
        ("a/*/far", "a/x/far", True),
        ("**", "a/b/c", True),
        ("a/**", "a", True),
        ("a/**/z", "a/b/c/z", True),
        ("a/**/z", "a/b/c", False),
        ("c/1/-1/*", "c/1/1/x", False),
    ],
)
def test_patterns(pattern, key, covers):
    assert matches(pattern, key) is covers


@given(
    st.lists(st.tuples(st.sampled_from([("a", KEEP_LAST_1), ("b", 3), ("e", KEEP_ALL)]), st.integers()), max_size=60)
)
def test_a_sample_store_keeps_the_newest_of_each_key_in_order(samples):
    store = SampleStore()
    for number, ((key, depth), _) in enumerate(samples):
        store.put(depth, key, b"%d" % number)
    taken = [(key, int(payload)) for key, payload in store.take()]
    assert [number for _, number in taken] == sorted(number for _, number in taken)
    for wanted, depth in (("a", KEEP_LAST_1), ("b", 3), ("e", KEEP_ALL)):
        numbers = [n for n, ((key, _), _) in enumerate(samples) if key == wanted]
        assert [number for key, number in taken if key == wanted] == numbers[-depth:]
    assert store.take() == []


def test_poses_push_no_event_out_of_a_store_that_nobody_reads():
    store = SampleStore()
    store.put(KEEP_ALL, "own", b"event")
    for number in range(5 * KEEP_ALL):
        store.put(KEEP_LAST_1, f"a/{number % 300}", b"%d" % number)
    store.put(KEEP_ALL, "own", b"another")
    taken = store.take()
    assert [payload for key, payload in taken if key == "own"] == [b"event", b"another"]
    assert [int(payload) for key, payload in taken if key != "own"] == list(range(5 * KEEP_ALL - 300, 5 * KEEP_ALL))
    assert (store.overflowed, store.missed) == (0, 0)


def test_samples_beyond_the_depth_are_dropped_and_counted():
    store = SampleStore()
    for number in range(KEEP_ALL + 5):
        store.put(KEEP_ALL, "e", b"%d" % number)
    assert len(store.take()) == KEEP_ALL
    assert (store.overflowed, store.missed) == (5, 5)


def test_the_bytes_that_wait_to_be_polled_are_bounded():
    store = SampleStore()
    payload = bytes(1 << 20)
    for _ in range(100):
        store.put(KEEP_ALL, "e", payload)
    kept = len(store.take())
    assert kept * len(payload) == MAX_STORED_BYTES
    assert kept + store.overflowed == 100
    store.put(KEEP_ALL, "e", payload)
    assert len(store.take()) == 1


def test_without_a_subscriber_nothing_is_sent_or_counted():
    hub = MemoryHub()
    ada = hub.bus("ada")
    bob = hub.bus("bob")
    publisher = ada.publisher("c/0/0/ada")
    ada.subscribe("c/0/0/*")
    assert not publisher.matching
    assert not publisher.put(b"12345")
    subscription = bob.subscribe("c/0/0/*")
    assert publisher.put(b"12345")
    hub.advance(0.0)
    assert bob.poll() == [("c/0/0/ada", b"12345")]
    assert (ada.bytes_out, bob.bytes_in, ada.bytes_in) == (5, 5, 0)
    subscription.close()
    assert not publisher.put(b"12345")
    assert ada.bytes_out == 5


def test_a_publisher_needs_an_exact_key():
    with pytest.raises(ValueError, match="wildcard"):
        MemoryHub().bus("ada").publisher("c/0/*/ada")


def test_reliable_samples_all_arrive_in_order_despite_loss():
    hub = MemoryHub(delay=0.05, jitter=0.05, loss=0.5, seed=3)
    ada = hub.bus("ada")
    bob = hub.bus("bob")
    bob.subscribe("own/**", KEEP_ALL)
    bob.subscribe("c/**", KEEP_LAST_64)
    events = ada.publisher("own/x/ada", reliable=True)
    stream = ada.publisher("c/x/ada")
    for number in range(60):
        events.put(bytes([number]))
        stream.put(bytes([number]))
        hub.advance(0.001)
    hub.advance(1.0)
    received = bob.poll()
    assert [p[0] for k, p in received if k == "own/x/ada"] == list(range(60))
    unreliable = [p[0] for k, p in received if k == "c/x/ada"]
    assert 15 < len(unreliable) < 45
    assert unreliable != sorted(unreliable)


def test_the_same_seed_gives_the_same_network():
    def run() -> list:
        hub = MemoryHub(delay=0.02, jitter=0.02, loss=0.3, seed=11)
        ada = hub.bus("ada")
        bob = hub.bus("bob")
        bob.subscribe("**", KEEP_ALL)
        publisher = ada.publisher("x")
        received = []
        for number in range(100):
            publisher.put(bytes([number]))
            hub.advance(0.004)
            received.append(bob.poll())
        return received

    assert run() == run()


def test_nothing_arrives_before_its_time():
    hub = MemoryHub(delay=0.05)
    ada = hub.bus("ada")
    bob = hub.bus("bob")
    bob.subscribe("x")
    ada.publisher("x").put(b"1")
    hub.advance(0.049)
    assert bob.poll() == []
    hub.advance(0.002)
    assert bob.poll() == [("x", b"1")]


def test_replies_have_their_age():
    hub = MemoryHub(delay=0.01)
    ada = hub.bus("ada")
    bob = hub.bus("bob")
    bob.declare_queryable("hello/bob", lambda query: query + b"!")
    ada.query("hello/*", b"hi")
    ada.query("unknown", b"hi")
    hub.advance(0.015)
    assert ada.replies() == []
    hub.advance(0.035)
    (answer,) = ada.replies()
    assert answer[:2] == ("hello/bob", b"hi!")
    assert answer.age == pytest.approx(0.03)


def test_a_name_is_live_once():
    hub = MemoryHub(delay=0.1)
    with hub.bus("ada") as ada:
        with pytest.raises(NameTaken, match="'ada' is already live"):
            hub.bus("ada")
        bob = hub.bus("bob")
        assert bob.alive() == {"ada", "bob"}
        assert ada.alive() == {"ada"}
        hub.advance(0.11)
        assert ada.alive() == {"ada", "bob"}
    assert bob.alive() == {"ada", "bob"}
    hub.advance(0.11)
    assert bob.alive() == {"bob"}
    hub.bus("ada").close()


def test_a_hub_that_is_down_is_reported_and_recovers():
    hub = MemoryHub()
    ada = hub.bus("ada")
    bob = hub.bus("bob")
    bob.subscribe("x")
    publisher = ada.publisher("x")
    hub.down = True
    assert not publisher.put(b"1")
    assert ada.alive() == {"ada"}
    assert "down" in ada.status_message
    hub.down = False
    assert publisher.put(b"2")
    hub.advance(0.0)
    assert bob.poll() == [("x", b"2")]
    assert ada.status_message == ""


def test_invalid_network_parameters_are_refused():
    with pytest.raises(ValueError, match="loss"):
        MemoryHub(loss=1.5)
