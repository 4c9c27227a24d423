"""Virtual couplings between clients: what is believed of whom, when they are sent, and for how long they hold."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.shared_vineyard import vineyard
from vinesim.core import frames
from vinesim.net.codec.control import Hello
from vinesim.net.codec.forces import MAX_COUPLINGS, Coupling, CouplingMessage, decode_couplings, encode_couplings
from vinesim.net.codec.header import HEADER, MessageError
from vinesim.net.codec.messages import Counters
from vinesim.net.replication.direct_messages import ARM_REACH, COUPLING_MAX_AGE, CouplingSync
from vinesim.net.replication.remote_pose import RemotePose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.values import RobotUpdate

MODEL = vineyard()
BODY = int(MODEL.bunch_body[0])
TREE = int(MODEL.body_tree[BODY])
EVA = Hello("eva", kind="human")


def coupling(body: int = BODY, x: float = 0.5) -> Coupling:
    return Coupling(body, np.array([0.1, 0.0, -0.02]), np.array([x, 0.2, 1.1]))


def pose(x: float = 0.0) -> RobotUpdate:
    return RobotUpdate("eva", 0.0, frames.pose([x, 0.0, 0.0]), np.zeros(6), np.zeros(0), np.zeros(0))


def peer(hello: Hello = EVA, update: RobotUpdate | None = None) -> RemotePose:
    actor = RemotePose(hello)
    actor.update = update
    return actor


def sync(counters: Counters | None = None, owner: str | None = "anna") -> CouplingSync:
    return CouplingSync(MemoryHub().bus("anna"), "anna", MODEL, counters or Counters(), lambda _: owner, {"eva"})


def message(*couplings: Coupling, time: float = 1.0) -> bytes:
    return encode_couplings(CouplingMessage(time, couplings))


def test_a_message_survives_the_way_and_is_28_bytes_a_coupling():
    sent = CouplingMessage(3.5, (coupling(3), coupling(7, -2.0)))
    payload = encode_couplings(sent)
    assert len(payload) == HEADER.size + 2 * 28
    received = decode_couplings(payload)
    assert received.time == 3.5
    assert [one.body for one in received.couplings] == [3, 7]
    for one, other in zip(received.couplings, sent.couplings, strict=True):
        np.testing.assert_allclose(one.point, other.point, atol=1e-6)
        np.testing.assert_allclose(one.anchor, other.anchor, atol=1e-6)
    assert decode_couplings(message()).couplings == ()


@given(st.binary(max_size=80), st.integers(0, 120))
def test_any_bytes_are_decoded_or_refused(tail, cut):
    for payload in (message(coupling())[:cut] + tail, HEADER.pack(b"VS", 1, 8, len(tail) // 28, 1.0) + tail):
        try:
            found = decode_couplings(payload)
        except MessageError:
            continue
        assert all(np.isfinite(one.point).all() and np.isfinite(one.anchor).all() for one in found.couplings)


@pytest.mark.parametrize(
    "wrong",
    [
        (coupling(x=np.nan),),
        (coupling(x=np.inf),),
        (coupling(x=1e9),),
        (coupling(5), coupling(5)),
        (coupling(5), coupling(4)),
        tuple(coupling(body) for body in range(MAX_COUPLINGS + 1)),
    ],
)
def test_what_no_client_sends_is_refused(wrong):
    with pytest.raises(MessageError):
        message(*wrong)


def test_it_holds_for_a_tenth_of_a_second_and_old_messages_count_as_dropped():
    counters = Counters()
    anna = sync(counters)
    eva = peer(EVA, pose())
    anna.receive(message(coupling(), time=2.0), eva, 10.0, 0.0)
    anna.receive(message(time=1.0), eva, 10.0, 0.0)
    assert counters.dropped == 1
    assert list(anna.current(10.0 + COUPLING_MAX_AGE)) == ["eva"]
    assert anna.partners(TREE, 10.0) == ["eva"]
    assert anna.current(10.01 + COUPLING_MAX_AGE) == {}
    anna.receive(message(time=3.0), eva, 10.0, 0.0)
    assert anna.current(10.0) == {}


@pytest.mark.parametrize(
    ("where", "owner", "is_used"),
    [
        (pose(), "anna", True),
        (pose(), "eva", True),
        (pose(), "ida", False),
        (pose(), None, False),
        (pose(0.5 + ARM_REACH + 0.1), "anna", False),
        (None, "anna", False),
    ],
)
def test_only_trees_of_either_side_within_reach(where, owner, is_used):
    counters = Counters()
    anna = sync(counters, owner)
    anna.receive(message(coupling()), peer(EVA, where), 0.0, 0.0)
    assert bool(anna.current(0.0)) == is_used
    assert counters.couplings_refused == (not is_used)


@pytest.mark.parametrize("body", [len(MODEL.body_tree), (1 << 32) - 1])
def test_bodies_that_there_are_not_are_malformed(body):
    with pytest.raises(MessageError):
        sync().receive(message(coupling(body)), peer(EVA, pose()), 0.0, 0.0)


def test_it_is_sent_at_60_hz_while_there_is_one_and_its_end_once():
    hub = MemoryHub()
    eva = hub.bus("eva")
    anna = hub.bus("anna")
    anna.subscribe("force/anna/*")
    mine = CouplingSync(eva, "eva", MODEL, Counters(), lambda _: "anna", {"anna"})
    sent = []
    for step in range(120):
        sent.append(mine.publish([coupling()] if 20 <= step < 80 else (), 0.01 * step, 0.01 * step))
    count = [len(one) for one in sent]
    assert sum(count[:20]) == 0
    assert sum(count[20:80]) == pytest.approx(36, abs=2)
    assert sum(count[80:]) == 1
    assert decode_couplings(next(one[0] for one in sent[80:] if one)).couplings == ()
