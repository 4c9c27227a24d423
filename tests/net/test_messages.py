"""Messages: round trips within their stated error, and only MessageError for any bytes."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import itertools

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.examples import share
from vinesim.core import frames
from vinesim.net.codec import rotation
from vinesim.net.codec.control import (
    HELLO,
    RETAINED,
    Hello,
    RetainedRecord,
    decode_claims,
    decode_description,
    decode_hello,
    decode_records,
    decode_time,
    description_digest,
    encode_claims,
    encode_description,
    encode_hello,
    encode_records,
    encode_time,
)
from vinesim.net.codec.header import (
    HEADER,
    MAGIC,
    MAX_DATAGRAM,
    MAX_MESSAGE,
    PROTOCOL,
    MessageError,
    WrongVersion,
    kind_of,
)
from vinesim.net.codec.meshes import MeshPart, MeshWanted, encode_part, encode_request, encode_wanted
from vinesim.net.codec.messages import FAMILIES, MESSAGES, Counters, Traffic, schema_of, shift_time, time_of
from vinesim.net.codec.objects import ObjectStates, check_object_id, decode_objects, encode_objects
from vinesim.net.codec.robot import MAX_JOINTS, decode_robot, encode_robot
from vinesim.net.codec.trees import TreeStates, decode_trees, encode_trees, quantise_tree
from vinesim.net.codec.wood import decode_wood, encode_wood, joined_wood
from vinesim.net.pace import PaceReport
from vinesim.net.replication.authority import Claim
from vinesim.scene import ids
from vinesim.scene.values import GivenWood, LightPattern, Lights, RobotUpdate


def robot(rng: np.random.Generator, joints: int = 14) -> RobotUpdate:
    base = np.concatenate([rng.uniform(-100, 100, 3), frames.normalize(rng.standard_normal(4))])
    velocity = rng.uniform(-3, 3, joints)
    return RobotUpdate("tiago", 12.5, base, rng.uniform(-2, 2, 6), rng.uniform(-3, 3, joints), velocity)


def trees(rng: np.random.Generator, sizes: list[int], rate: float = 5.0) -> TreeStates:
    count = len(sizes)
    bodies = sum(sizes)
    q = frames.exp(rng.uniform(-1.7, 1.7, (bodies, 3)))
    ids = np.sort(rng.choice(1000, count, replace=False))
    sequences = rng.integers(0, 65536, (2, count))
    qd = rng.uniform(-rate, rate, (bodies, 3))
    return TreeStates(3.25, ids, *sequences, rng.integers(0, 4, count), np.array(sizes), q, qd)


def cut(batch: TreeStates, roots: list[int], rng: np.random.Generator) -> TreeStates:
    """The same trees with some bodies cut off each."""
    where = [np.sort(rng.choice(size, k, replace=False)) for size, k in zip(batch.bodies, roots, strict=True)]
    x = rng.uniform(-50, 50, (sum(roots), 3))
    xd = rng.uniform(-5, 5, (sum(roots), 3))
    return dataclasses.replace(batch, roots=np.array(roots), root=np.concatenate(where), root_x=x, root_xd=xd)


def objects(rng: np.random.Generator, count: int, cell=(0, 0), speed: float = 3.0) -> ObjectStates:
    kinds = rng.choice([ids.ObjectKind.BUNCH, ids.ObjectKind.BOX], count) * ids.OBJECT_STRIDE
    numbers = np.sort(kinds + rng.choice(10000, count, replace=False))
    at = rng.uniform([0.0, 0.0, -0.5], [6.0, 6.0, 5.5], (count, 3)) + 6.0 * np.array([*cell, 0.0])
    pose = np.concatenate([at, frames.normalize(rng.standard_normal((count, 4)))], -1)
    sequences = rng.integers(0, 65536, (2, count))
    return ObjectStates(
        7.5, numbers, *sequences, rng.integers(0, 2, count), pose, rng.uniform(-speed, speed, (count, 6))
    )


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(frames.log(frames.multiply(a, frames.conjugate(b))), axis=-1)


def one_message(batch: TreeStates) -> bytes:
    (payload,), _ = encode_trees(batch)
    return payload


@pytest.mark.parametrize("joints", [0, 1, 14, 256])
def test_a_robot_pose_is_decoded_within_quantisation(joints):
    sent = robot(np.random.default_rng(joints), joints)
    payload = encode_robot(sent)
    received = decode_robot(payload, "tiago")
    assert len(payload) == 50 + 3 * joints
    assert (received.actor, received.time) == ("tiago", 12.5)
    np.testing.assert_allclose(received.base_q[:3], sent.base_q[:3], atol=1e-5)
    assert angle_between(received.base_q[3:], sent.base_q[3:]) < np.radians(0.005)
    np.testing.assert_allclose(received.base_qd, sent.base_qd, atol=0.5e-3 + 1e-9)
    np.testing.assert_allclose(received.position, sent.position, atol=1e-4 + 1e-9)
    fastest = np.abs(sent.velocity).max(initial=0.0)
    np.testing.assert_allclose(received.velocity, sent.velocity, atol=0.004 * fastest + 1e-5)
    for pattern in LightPattern:
        lights = Lights(pattern, (0, 128, 255))
        assert decode_robot(encode_robot(dataclasses.replace(sent, lights=lights)), "a").lights == lights
    at = HEADER.size + 12 + 6 + 12 + 2
    with pytest.raises(MessageError, match="unknown pattern, 4"):
        decode_robot(payload[:at] + b"\4" + payload[at + 1 :], "tiago")


def test_joint_angles_beyond_a_turn_are_decoded():
    sent = robot(np.random.default_rng(3), 5)
    sent.position[[1, 4]] = 6.6, -1234.5678
    payload = encode_robot(sent)
    received = decode_robot(payload, "tiago")
    assert len(payload) == 50 + 3 * 5 + 4 * 2
    np.testing.assert_allclose(received.position[[1, 4]], [6.6, -1234.5678], rtol=1e-7)
    np.testing.assert_allclose(received.position[[0, 2, 3]], sent.position[[0, 2, 3]], atol=1e-4 + 1e-9)
    with pytest.raises(MessageError, match="2 wide joints and 4 B"):
        decode_robot(payload[:-4], "tiago")


def test_a_decoded_message_encodes_to_the_same_bytes():
    payload = encode_robot(robot(np.random.default_rng(1)))
    assert encode_robot(decode_robot(payload, "tiago")) == payload


@pytest.mark.parametrize("rate", [0.0, 1e-3, 5.0, 60.0])
def test_trees_are_decoded_within_quantisation(rate):
    sent = trees(np.random.default_rng(7), [5, 1, 12], rate)
    payload = one_message(sent)
    received = decode_trees(payload)
    assert received.time == sent.time
    for field in ("tree", "ownership", "authority", "flags", "bodies"):
        np.testing.assert_array_equal(getattr(received, field), getattr(sent, field))
    assert angle_between(received.joint_q, sent.joint_q).max() < np.radians(0.005)
    for part in (slice(0, 5), slice(5, 6), slice(6, 18)):
        fastest = np.abs(sent.joint_qd[part]).max()
        assert np.abs(received.joint_qd[part] - sent.joint_qd[part]).max() <= 0.004 * fastest + 1.3e-3
    assert len(payload) == 14 + 3 * 13 + 18 * 9


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 20), min_size=1, max_size=40))
def test_owner_and_receivers_hold_the_same_bits_and_messages_fit_a_datagram(seed, sizes):
    sent = trees(np.random.default_rng(seed), sizes)
    payloads, quantised = encode_trees(sent)
    parts = [decode_trees(payload) for payload in payloads]
    assert all(len(payload) <= MAX_DATAGRAM for payload in payloads)
    for field in ("tree", "ownership", "authority", "flags", "bodies"):
        np.testing.assert_array_equal(np.concatenate([getattr(part, field) for part in parts]), getattr(sent, field))
    for field in ("joint_q", "joint_qd"):
        received = np.concatenate([getattr(part, field) for part in parts])
        assert received.tobytes() == getattr(quantised, field).tobytes()
    first = slice(0, sizes[0])
    q, qd = quantise_tree(sent.joint_q[first], sent.joint_qd[first])
    assert q.tobytes() == quantised.joint_q[first].tobytes()
    assert qd.tobytes() == quantised.joint_qd[first].tobytes()


@given(st.lists(st.floats(-np.pi, np.pi), min_size=3, max_size=3))
def test_fast_rotation_functions_equal_those_of_frames(vector):
    v = np.array(vector)
    np.testing.assert_allclose(rotation.quaternion(v), frames.exp(v), atol=1e-12)
    q = frames.exp(v)
    # at half a turn both signs of the axis are right: compare the rotations, not the vectors
    assert angle_between(frames.exp(rotation.rotation_vector(q)), q) < 1e-6


def test_updates_split_a_batch_by_tree():
    batch = trees(np.random.default_rng(3), [2, 3])
    first, second = batch.updates("ada")
    assert (first.tree, first.owner, len(first.joint_q), len(second.joint_qd)) == (int(batch.tree[0]), "ada", 2, 3)
    np.testing.assert_array_equal(second.joint_q, batch.joint_q[2:])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"time": float("nan")}, "finite"),
        ({"base_q": np.array([0, 0, np.nan, 0, 0, 0, 1.0])}, "finite"),
        ({"base_q": np.array([0, 0, 1e12, 0, 0, 0, 1.0])}, "1e9"),
        ({"base_q": np.zeros(7)}, "unit quaternion"),
        ({"velocity": np.zeros(3)}, "velocities"),
        ({"lights": Lights(LightPattern.ALARM, (0, 256, 0))}, "must be 0 to 255"),
        ({"position": np.full(14, np.inf)}, "finite"),
        ({"position": np.zeros(300), "velocity": np.zeros(300)}, "at most 256"),
    ],
)
def test_an_invalid_robot_pose_is_not_encoded(change, reason):
    update = dataclasses.replace(robot(np.random.default_rng(0)), **change)
    with pytest.raises(MessageError, match=reason):
        encode_robot(update)


def test_invalid_trees_are_not_encoded():
    batch = trees(np.random.default_rng(0), [4, 4])
    poisoned = batch.joint_q.copy()
    poisoned[2, 1] = np.nan
    for invalid in (
        dataclasses.replace(batch, joint_q=poisoned),
        dataclasses.replace(batch, tree=batch.tree[::-1]),
        dataclasses.replace(batch, bodies=np.array([4, 5])),
        dataclasses.replace(batch, time=float("inf")),
    ):
        with pytest.raises(MessageError):
            encode_trees(invalid)


@pytest.mark.parametrize("cut", [0, 3, 4, 13, 14, 30, -1])
def test_truncated_messages_are_refused(cut):
    rng = np.random.default_rng(0)
    pose = encode_robot(robot(rng))
    batch = one_message(trees(rng, [4, 4]))
    with pytest.raises(MessageError):
        decode_robot(pose[:cut], "tiago")
    with pytest.raises(MessageError):
        decode_trees(batch[:cut])
    with pytest.raises(MessageError):
        decode_trees(batch + b"\0")


def test_errors_name_other_versions_kinds_and_programs():
    payload = encode_robot(robot(np.random.default_rng(0)))
    with pytest.raises(WrongVersion, match=rf"version {PROTOCOL + 1}.*speaks {PROTOCOL}\b"):
        decode_robot(payload[:2] + bytes((PROTOCOL + 1,)) + payload[3:], "tiago")
    with pytest.raises(MessageError, match="not from vinesim"):
        decode_robot(b"GET / HTTP/1.1", "tiago")
    with pytest.raises(MessageError, match="kind 1 where trees"):
        decode_trees(payload)
    with pytest.raises(MessageError, match="at most"):
        kind_of(bytes(MAX_MESSAGE + 1))


def test_tree_numbers_and_sizes_are_checked_against_the_scene():
    batch = dataclasses.replace(trees(np.random.default_rng(0), [4, 6]), tree=np.array([1, 2]))
    payload = one_message(batch)
    decode_trees(payload, np.array([9, 4, 6]))
    with pytest.raises(MessageError, match="tree 2, this scene has 2"):
        decode_trees(payload, np.array([9, 4]))
    with pytest.raises(MessageError, match="tree 2 with 6 bodies, in this scene it has 5"):
        decode_trees(payload, np.array([9, 4, 5]))


def test_a_pose_that_is_not_finite_or_rotated_by_more_than_a_half_turn_is_refused():
    payload = bytearray(encode_robot(robot(np.random.default_rng(0))))
    nan = payload.copy()
    nan[14:18] = np.float32(np.nan).tobytes()
    with pytest.raises(MessageError, match="finite"):
        decode_robot(bytes(nan), "tiago")
    turned = payload.copy()
    turned[26:32] = np.full(3, 32767, "<i2").tobytes()
    with pytest.raises(MessageError, match="half a turn"):
        decode_robot(bytes(turned), "tiago")


def test_a_hello_is_decoded_and_invalid_ones_are_refused():
    hello = Hello("robot-1.a", "robot", "tiago", "<robot/>", "tendone", "0123456789abcdef", index=3, joints=14)
    description = encode_description(hello)
    digest = description_digest(description)
    sent = msgspec.structs.replace(hello, urdf="", sidecar="", robot_digest=digest)
    assert decode_hello(encode_hello(hello)) == sent
    assert decode_description(description, digest).complete(sent) == msgspec.structs.replace(hello, robot_digest=digest)
    with pytest.raises(MessageError, match="announced"):
        decode_description(description, description_digest(b"another"))
    with pytest.raises(MessageError, match="with the digest 'no digest'"):
        encode_hello(Hello("a", robot_digest="no digest"))
    for name in ("", "a/b", "a*", "ä", "x" * 49):
        with pytest.raises(MessageError, match="actor name"):
            encode_hello(Hello(name))
    other = PROTOCOL + 1
    with pytest.raises(WrongVersion, match=f"version {other}"):
        decode_hello(encode_hello(Hello("a", protocol=other)))
    with pytest.raises(MessageError, match="too long"):
        encode_hello(Hello("a", urdf="x" * MAX_MESSAGE))


def test_a_greeting_has_the_same_size_for_a_robot_of_any_size():
    sizes = {len(encode_hello(Hello("a", urdf="<robot>" + count * "<link/>" + "</robot>"))) for count in (1, 30)}
    assert len(sizes) == 1
    assert sizes.pop() < 150


_NAN = float("nan")
_INF = float("inf")


@pytest.mark.parametrize(
    "change",
    [
        *({"index": index} for index in (-1, ids.LABEL_STRIDE, 1 << 40)),
        *({"joints": joints} for joints in (-2, MAX_JOINTS + 1, 1 << 40)),
        *({"seed": seed} for seed in (-2, 1 << 63)),
        *({"height": height} for height in (_NAN, _INF, -_INF, 0.0, 0.9, 2.6, 1e9)),
        {"kind": "ghost"},
        *({"outfit": outfit} for outfit in ("x" * 49, "no outfit", "../green")),
    ],
    ids=str,
)
def test_a_number_of_a_hello_that_is_out_of_its_range_is_refused(change):
    (field,) = change
    hello = Hello("ada", **change)
    with pytest.raises(MessageError, match=f"'ada' with {field}"):
        encode_hello(hello)
    payload = MAGIC + bytes((PROTOCOL, HELLO)) + msgspec.msgpack.encode(hello)
    with pytest.raises(MessageError, match=f"'ada' with {field}"):
        decode_hello(payload)


def test_every_index_of_a_hello_fits_a_label_of_any_organ():
    hello = decode_hello(encode_hello(Hello("ada", index=ids.LABEL_STRIDE - 1)))
    for organ in ids.Organ:
        value = np.array(ids.label(organ, hello.index), np.int32)
        assert ids.unlabel(int(value)) == (organ, hello.index)


def test_claims_are_decoded_and_invalid_ones_are_refused():
    claims = [(3, Claim(1, 65535, "ada"), True), (4, Claim(0, 7, ""), False)]
    assert decode_claims(encode_claims(claims), (5, 0, 0)) == claims
    for invalid in (
        (5, Claim(), False),
        (-1, Claim(), False),
        (0, Claim(65536, 0, "a"), False),
        (0, Claim(0, 0, "a/b"), True),
    ):
        with pytest.raises(MessageError):
            decode_claims(encode_claims([invalid]), (5, 0, 0))


def test_clock_messages_are_decoded():
    report = PaceReport(7.0, 1.25, "sensors")
    whole = decode_time(encode_time(1.5, 2.5, 0.2, 3.5, "ada: sensors", report))
    assert whole == (1.5, 2.5, 0.2, 3.5, "ada: sensors", report)
    with pytest.raises(MessageError, match="finite"):
        decode_time(encode_time(float("nan")))


DECODERS = (
    lambda payload: decode_description(payload, "0" * 40),
    lambda payload: decode_description(payload, description_digest(payload)),
    lambda payload: decode_robot(payload, "a"),
    lambda payload: decode_trees(payload, np.array([3, 4])),
    decode_trees,
    decode_hello,
    lambda payload: decode_claims(payload, (5, 0, 0)),
    lambda payload: decode_objects(payload, (0, 0)),
    lambda payload: decode_records(payload, (5, 3, 2)),
    decode_time,
    kind_of,
)


def decode_with_all(payload: bytes) -> None:
    """Every decoder returns a value or raises MessageError."""
    for decode in DECODERS:
        with contextlib.suppress(MessageError):
            decode(payload)


@given(st.binary(max_size=200), st.sampled_from([1, 2, 3, 4, 5, 16, 17]), st.booleans())
@settings(max_examples=share(8.0))
def test_arbitrary_bytes_raise_only_message_errors(tail, kind, framed):
    decode_with_all((b"VS\x01" + bytes([kind]) if framed else b"") + tail)


@given(st.data())
@settings(max_examples=share(8.0))
def test_damaged_messages_raise_only_message_errors(data):
    rng = np.random.default_rng(5)
    sound = [
        encode_robot(robot(rng, 3)),
        one_message(trees(rng, [3, 4])),
        one_message(cut(trees(rng, [3, 4]), [1, 2], rng)),
        encode_objects(objects(rng, 3), (0, 0))[0][0],
        encode_records([record(), record(object=3)]),
        encode_hello(Hello("a", urdf="<robot/>")),
        encode_description(Hello("a", urdf="<robot/>")),
        encode_claims([(1, Claim(1, 2, "a"), True)]),
        encode_time(1.0, 2.0),
    ]
    payload = bytearray(data.draw(st.sampled_from(sound)))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    decode_with_all(
        bytes(payload[: data.draw(st.integers(0, len(payload)))]) if data.draw(st.booleans()) else bytes(payload)
    )


@given(st.integers(0, 2**32 - 1), st.integers(1, 100), st.integers(-9, 9), st.sampled_from([0.0, 1e-3, 0.3, 4.0, 60.0]))
def test_objects_are_decoded_within_quantisation(seed, count, where, speed):
    sent = objects(np.random.default_rng(seed), count, (where, -where), speed)
    cell = (where, -where)
    payloads, received = encode_objects(sent, cell)
    assert max(len(payload) for payload in payloads) <= MAX_DATAGRAM
    assert sum(len(payload) - 14 for payload in payloads) == 26 * count
    parts = [decode_objects(payload, cell) for payload in payloads]
    for field in dataclasses.fields(ObjectStates)[1:]:
        decoded = np.concatenate([getattr(part, field.name) for part in parts])
        assert decoded.tobytes() == getattr(received, field.name).tobytes(), "owner and copies hold the same bits"
        if field.name not in ("pose", "velocity"):
            np.testing.assert_array_equal(decoded, getattr(sent, field.name))
    assert np.abs(received.pose[:, :3] - sent.pose[:, :3]).max() <= 0.5e-4 + 1e-9
    assert angle_between(received.pose[:, 3:], sent.pose[:, 3:]).max() < np.radians(0.28)
    np.testing.assert_allclose(np.linalg.norm(received.pose[:, 3:], axis=1), 1.0, atol=1e-12)
    for part, least in ((slice(0, 3), 2.0**-11), (slice(3, 6), 2.0**-9)):
        fastest = np.abs(sent.velocity[:, part]).max(1)
        assert (np.abs(received.velocity - sent.velocity)[:, part].max(1) <= np.maximum(fastest / 126.0, least)).all()


@pytest.mark.parametrize("height", [-60.0, -4.0, -0.6, 5.6, 7.0, 12.3, 126.0])
def test_objects_on_a_slope_are_decoded_within_quantisation(height):
    sent = objects(np.random.default_rng(3), 20)
    sent.pose[:, 2] = height + np.linspace(0.0, 0.05, 20)
    payloads, received = encode_objects(sent, (0, 0))
    assert np.abs(received.pose[:, :3] - sent.pose[:, :3]).max() <= 0.5e-4 + 1e-9
    np.testing.assert_array_equal(received.flags, sent.flags)
    decoded = [decode_objects(payload, (0, 0)) for payload in payloads]
    assert np.concatenate([part.pose for part in decoded]).tobytes() == received.pose.tobytes()
    flags = np.frombuffer(payloads[0], np.uint8)[HEADER.size + 8 :: 26]
    assert (flags < 4).all() == (-0.7 < height < 5.66), "on level ground the bytes are as ever"


@pytest.mark.parametrize(("column", "limit"), [(0, 64.0), (3, 256.0)])
def test_an_object_at_an_absurd_speed_is_refused_and_never_sent(column, limit):
    """A box that was believed to spin at 16,000 rad/s, as the format could say, made MuJoCo unstable where it hit."""
    sent = objects(np.random.default_rng(0), 2)
    sent.velocity[1, column] = 4000.0
    (payload,), received = encode_objects(sent, (0, 0))
    assert 0.9 * limit < received.velocity[1, column] < limit
    assert decode_objects(payload, (0, 0)).velocity.tobytes() == received.velocity.tobytes()
    scale = HEADER.size + 26 + 9  # of the second object
    payload = payload[:scale] + bytes([0xFF]) + payload[scale + 1 :]
    with pytest.raises(MessageError, match="faster than anything"):
        decode_objects(payload, (0, 0))


@pytest.mark.parametrize("number", [5, 3 * ids.OBJECT_STRIDE])
def test_an_invalid_object_id_is_refused(number):
    batch = objects(np.random.default_rng(0), 1)
    (payload,), _ = encode_objects(dataclasses.replace(batch, object=np.array([number])), (0, 0))
    with pytest.raises(MessageError, match="of no kind"):
        decode_objects(payload, (0, 0))
    with pytest.raises(MessageError, match="bunch 17, this scene has 17"):
        check_object_id(ids.object_id(ids.ObjectKind.BUNCH, 17), (100, 17, 2))


@given(st.integers(0, 2**32 - 1), st.lists(st.tuples(st.integers(1, 20), st.integers(0, 4)), min_size=1, max_size=40))
def test_trees_are_decoded_with_their_cut_bodies(seed, shapes):
    rng = np.random.default_rng(seed)
    sent = trees(rng, [size for size, _ in shapes])
    sent = cut(sent, [min(k, size) for size, k in shapes], rng)
    payloads, received = encode_trees(sent)
    parts = [update for payload in payloads for update in decode_trees(payload).updates("ada")]
    ends = np.cumsum(sent.roots)
    for update, here, end, count in zip(parts, received.updates("ada"), ends, sent.roots, strict=True):
        assert update.joint_q.tobytes() == here.joint_q.tobytes()
        assert update.root.tolist() == sent.root[end - count : end].tolist()
        np.testing.assert_allclose(update.root_x, sent.root_x[end - count : end], atol=1e-5)
        assert update.root_x.tobytes() == here.root_x.tobytes()
        np.testing.assert_allclose(update.root_xd, sent.root_xd[end - count : end], atol=0.51e-3)


def record(**change) -> RetainedRecord:
    usual = {"object": ids.object_id(ids.ObjectKind.BUNCH, 17), "ownership": 3, "authority": 65535, "author": "picker"}
    return RetainedRecord(**{**usual, "pose": (1.0, 2.0, 0.1, 0.0, 0.6, 0.0, 0.8), "parent": "box/2", **change})


def gave(
    turn: float = 1.0,
    flow: float = 0.2,
    slid: float = 0.1,
    depth: float = 0.5,
    to: float = 1.5,
    opened: bool = False,
    leaves: tuple[int, ...] = (1, 4),
    places: tuple[int, int] = (3, 7),
) -> GivenWood:
    turns = np.array([[0.0, 0.6, 0.0, 0.8], [0.0, 0.0, 0.0, turn]], np.float32)
    return GivenWood(
        joints=np.array(places),
        turns=turns,
        flows=np.array([0.1, flow], np.float32),
        ties=np.array([2]),
        slid=np.array([slid], np.float32),
        slid_in_all=np.array([abs(slid)], np.float32),
        broken=np.array([True]),
        notched=np.array([5]),
        notch_at=np.array([0.01], np.float32),
        notch_depth=np.array([depth], np.float32),
        tied=np.array([4, 4]),
        tied_at=np.array([200, 300]),
        tied_to=np.array([[1.0, 2.0, to], [1.0, 2.1, 1.5]], np.float32),
        opened=np.array([opened, True]),
        bare=np.array(leaves),
    )


def test_states_of_one_tree_join_in_any_order():
    """Nothing that was done on one client is lost, whichever record arrives first."""
    one = encode_wood(gave(flow=0.3, slid=0.2, depth=0.4, leaves=(1, 4)))
    two = encode_wood(gave(flow=0.2, slid=-0.3, depth=0.6, opened=True, leaves=(2,)))
    three = encode_wood(gave(places=(2, 8), leaves=(9,)))
    joined = decode_wood(joined_wood(one, two))
    np.testing.assert_array_equal(joined.flows, np.array([0.1, 0.3], np.float32))
    np.testing.assert_array_equal(joined.slid, np.array([-0.3], np.float32))
    np.testing.assert_array_equal(joined.notch_depth, np.array([0.6], np.float32))
    assert joined.opened.tolist() == [True, True]
    assert joined.bare.tolist() == [1, 2, 4]
    ends = {functools.reduce(joined_wood, order, b"") for order in itertools.permutations([one, two, three, one])}
    assert len(ends) == 1
    assert decode_wood(ends.pop()).joints.tolist() == [2, 3, 7, 8]


def test_how_wood_has_given_is_decoded_to_the_bit():
    sent = gave()
    received = decode_wood(encode_wood(sent))
    for name in (field.name for field in dataclasses.fields(GivenWood)):
        np.testing.assert_array_equal(getattr(received, name), getattr(sent, name))
    nothing = decode_wood(b"")
    assert encode_wood(nothing) == b""


def test_records_are_decoded_as_encoded():
    sent = [
        record(),
        record(stalk=(12, 345)),
        record(passed=(ids.FIXED_PIECES, 0, 7)),
        record(wood=encode_wood(gave())),
        record(object=ids.object_id(ids.ObjectKind.TREE, 5), parent="", cut=(7, 9), trees=b"abc"),
    ]
    received = decode_records(encode_records(sent))
    assert received == sent
    assert received[0].claim == Claim(3, 65535, "picker")
    assert ids.split_object_id(received[0].object) == (ids.ObjectKind.BUNCH, 17)
    assert kind_of(encode_records(sent)) == RETAINED


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"object": 3 * ids.OBJECT_STRIDE}, "of no kind"),
        ({"object": -1}, "of no kind"),
        ({"authority": 65536}, "with claim"),
        ({"author": "a/b"}, "record by 'a/b'"),
        ({"pose": (np.nan, 0, 0, 0, 0, 0, 1.0)}, "not finite"),
        ({"pose": (0, 0, 2e5, 0, 0, 0, 1.0)}, "too far away"),
        ({"pose": (0, 0, 0, 0, 0, 0, 0.5)}, "no unit quaternion"),
        ({"place": (0, np.inf, 0, 0, 0, 0, 1.0)}, "not finite"),
        ({"place": (0, 0, 0, 0, 0, 0, 0.0)}, "no unit quaternion"),
        ({"cut": (-1,)}, "impossible"),
        ({"stalk": (-1, 10)}, "impossible stalk"),
        ({"stalk": (5, 0)}, "impossible stalk"),
        ({"stalk": (5, 65536)}, "impossible stalk"),
        ({"wood": b"\x01"}, r"wood of \[\] rows in 1 B"),
        ({"wood": b"\x09\x00" + 22 * b"\x00"}, r"wood of \[9, 0, 0, 0, 0\] rows in 24 B"),
        ({"wood": encode_wood(gave(turn=0.5))}, "no rotation"),
        ({"wood": encode_wood(gave(flow=np.nan))}, "out of range"),
        ({"wood": encode_wood(gave(slid=np.inf))}, "out of range"),
        ({"wood": encode_wood(gave(depth=1.5))}, "out of range"),
        ({"wood": encode_wood(gave(to=np.nan))}, "out of range"),
        ({"wood": encode_wood(gave(places=(3, 3)))}, "does not increase"),
        ({"wood": encode_wood(gave(leaves=(4, 1)))}, "does not increase"),
        ({"fruit": (-1.0, 0.0)}, "impossible number of berries"),
        ({"passed": (-2, 4)}, "impossible passed trees"),
        ({"passed": (4, 4)}, "impossible passed trees"),
        ({"passed": tuple(range(65))}, "impossible passed trees"),
        ({"parent": "x" * 201}, "impossible"),
    ],
)
def test_an_invalid_record_is_refused_with_the_reason(change, reason):
    with pytest.raises(MessageError, match=reason):
        decode_records(encode_records([record(**change)]))


def test_too_many_records_are_refused():
    with pytest.raises(MessageError, match="at most 4096"):
        decode_records(encode_records([record()] * 4097))


@pytest.mark.parametrize(
    "payload",
    [
        encode_part(MeshPart("0" * 40, 36, 0, b"\xff" * 36)),
        encode_request(5),
        encode_wanted(MeshWanted(5)),
    ],
)
def test_messages_about_meshes_have_no_time(payload):
    """Their first bytes were once taken for one, and replaced when a recording was played at another time."""
    assert time_of(payload) is None
    assert shift_time(payload, 5.0) == payload


def test_every_family_of_keys_has_a_counter_and_every_published_one_a_kind():
    counters = Counters()
    assert all(isinstance(counters.of(name), Traffic) for name in FAMILIES)
    published = {name for name, family in FAMILIES.items() if family.is_published}
    assert published <= {name for row in MESSAGES.values() for name in row.families}


def test_the_schemas_of_recordings_stay_as_they_are():
    """Their text is part of the file format."""
    keys = ("a/x", "c/0/0/x", "tree/0/0/x", "near/0/0/x", "own/0/0/x", "fact/0/0/x", "force/y/x", "snap/0/0", "hello/x")
    text = b"".join(name.encode() + schema for name, schema in map(schema_of, (*keys, "live/x", "other/x")))
    assert hashlib.blake2b(text, digest_size=8).hexdigest() == "335322279f6bbd5e"
