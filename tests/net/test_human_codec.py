"""Messages of human poses and wrenches: size, quantisation, and refusal of invalid values."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vinesim.core import frames
from vinesim.net.codec.forces import WRENCHES, WrenchMessage, decode_wrenches, encode_wrenches
from vinesim.net.codec.header import MessageError, kind_of
from vinesim.net.codec.human import (
    decode_human,
    decode_pose,
    encode_human,
    encode_pose,
    quantise_pose,
)
from vinesim.rigid.human_posture import standing_pose
from vinesim.scene.values import INTENTIONS, POINT_NAMES, HumanUpdate, RobotUpdate

HERE = frames.pose(np.array([31.25, -7.5, 0.4]), frames.from_yaw(2.0))


def random_human(seed: int = 0) -> HumanUpdate:
    rng = np.random.default_rng(seed)
    pose = standing_pose(HERE, 1.8)
    points = pose.points
    points[1:, :3] += rng.uniform(-0.5, 0.5, (6, 3))
    points[1:, 3:] = frames.normalize(rng.normal(size=(6, 4)))
    fingers = tuple(rng.uniform(size=5))
    pose = dataclasses.replace(pose.with_points(points), left_closed=True, right_busy=True, right_fingers=fingers)
    pose = dataclasses.replace(pose, left_shears=True)
    return HumanUpdate("eva", 12.5, pose, rng.normal(size=(7, 6)))


def rotation_cosine(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.abs((a * b).sum(-1))


def test_a_human_pose_is_root_three_inputs_hips_and_feet_in_162_bytes():
    """F88: root, head and two hands; F89: hips and feet."""
    sent = random_human()
    payload = encode_pose(sent)
    assert len(payload) == 162
    received = decode_pose(payload, "eva")
    assert isinstance(received, HumanUpdate)
    assert (received.actor, received.time) == ("eva", 12.5)
    for name in ("root", "head", "left", "right", "hips", "left_foot", "right_foot"):
        one = getattr(sent.pose, name)
        other = getattr(received.pose, name)
        np.testing.assert_allclose(other[:3], one[:3], atol=1.01e-4)
        assert rotation_cosine(one[3:], other[3:]) > np.cos(0.5 * np.radians(0.006))
    fastest = np.abs(sent.velocity.reshape(7, 2, 3)).max(axis=(0, 2))
    error = np.abs(received.velocity - sent.velocity).reshape(7, 2, 3).max(axis=(0, 2))
    assert (error < fastest / 127).all()
    assert (received.pose.left_closed, received.pose.right_closed) == (True, False)
    assert (received.pose.left_busy, received.pose.right_busy) == (False, True)
    assert (received.pose.left_shears, received.pose.right_shears) == (True, False)
    np.testing.assert_allclose(received.pose.right_fingers, sent.pose.right_fingers, atol=0.5 / 255 + 1e-9)
    assert received.pose.left_fingers == (0.0,) * 5
    for intention in INTENTIONS:
        told = decode_pose(encode_pose(dataclasses.replace(sent, intention=intention)), "eva")
        assert isinstance(told, HumanUpdate)
        assert told.intention == intention
    with pytest.raises(MessageError, match="unknown intention, 200"):
        decode_pose(payload[:-1] + b"\xc8", "eva")
    with pytest.raises(MessageError, match="'fly' of"):
        encode_pose(dataclasses.replace(sent, intention="fly"))


@given(st.integers(0, 1 << 32))
def test_quantisation_is_idempotent(seed):
    once = quantise_pose(random_human(seed).pose)
    assert quantise_pose(once).points.tobytes() == once.points.tobytes()


def test_robot_poses_use_the_same_functions():
    update = RobotUpdate("anna", 1.0, HERE, np.zeros(6), np.array([0.1, 0.2]), np.zeros(2))
    assert decode_pose(encode_pose(update), "anna").position == pytest.approx([0.1, 0.2])


@pytest.mark.parametrize("point", [0, 3])
@pytest.mark.parametrize("error", [np.nan, np.inf])
def test_an_invalid_pose_is_not_encoded(point, error):
    sent = random_human()
    points = sent.pose.points
    points[point, 1] = error
    with pytest.raises(MessageError, match="not finite"):
        encode_human(dataclasses.replace(sent, pose=sent.pose.with_points(points)))
    points[point] = 0.0
    with pytest.raises(MessageError, match="unit quaternion"):
        encode_human(dataclasses.replace(sent, pose=sent.pose.with_points(points)))


def test_wrenches_are_decoded_as_encoded():
    message = WrenchMessage(
        3.0, {"arm_left_3_link": np.array([1.0, -2.5, 30.0, 0.5, 0.0, -0.25]), "chassis": np.zeros(6)}
    )
    payload = encode_wrenches(message)
    assert len(payload) == 14 + 25 + 15 + 25 + 7
    received = decode_wrenches(payload)
    assert received.time == 3.0
    assert received.wrenches.keys() == message.wrenches.keys()
    for link, wrench in message.wrenches.items():
        np.testing.assert_array_equal(received.wrenches[link], wrench)
    assert decode_wrenches(encode_wrenches(WrenchMessage(4.0, {}))).wrenches == {}
    with pytest.raises(MessageError, match="too strong"):
        encode_wrenches(WrenchMessage(0.0, {"arm": np.full(6, 1e4)}))


MESSAGES = [encode_human(random_human()), encode_wrenches(WrenchMessage(1.0, {"arm": np.ones(6), "hand": np.ones(6)}))]


@pytest.mark.parametrize("payload", MESSAGES)
@given(data=st.data())
def test_damaged_messages_are_decoded_or_refused(payload, data):
    """Truncated, longer, or with changed bytes."""
    damaged = bytearray(payload[: data.draw(st.integers(0, len(payload)))] + data.draw(st.binary(max_size=8)))
    for _ in range(data.draw(st.integers(0, 4))):
        if damaged:
            damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    for decode in (lambda raw: decode_human(raw, "eva"), decode_wrenches, lambda raw: decode_pose(raw, "eva")):
        try:
            received = decode(bytes(damaged))
        except MessageError:
            continue
        if isinstance(received, HumanUpdate):
            assert np.isfinite(received.pose.points).all()
            np.testing.assert_allclose(np.linalg.norm(received.pose.points[:, 3:], axis=1), 1.0, atol=1e-9)
            assert np.isfinite(received.velocity).all()
        elif isinstance(received, WrenchMessage):
            assert all(np.isfinite(wrench).all() for wrench in received.wrenches.values())


@pytest.mark.parametrize("payload", MESSAGES)
def test_a_truncated_message_is_refused(payload):
    read = decode_wrenches if kind_of(payload) == WRENCHES else lambda raw: decode_human(raw, "eva")
    for length in range(len(payload)):
        with pytest.raises(MessageError):
            read(payload[:length])
    with pytest.raises(MessageError):
        read(payload + b"\0")


@pytest.mark.parametrize("point", ["head", "left", "right", "left_foot", "right_foot"])
def test_a_pose_of_no_human_size_or_speed_is_refused(point):
    sent = random_human()
    at = POINT_NAMES.index(point)
    for size, speed, is_human in ((1.5, 20.0, True), (2.6, 0.0, False), (1.0, 60.0, False)):
        points = sent.pose.points.copy()
        velocity = np.zeros((len(POINT_NAMES), 6))
        points[at, :3] = points[POINT_NAMES.index("hips"), :3] + [0.0, size, 0.0]
        velocity[at, 2] = speed
        payload = encode_human(HumanUpdate("eva", 1.0, sent.pose.with_points(points), velocity))
        if is_human:
            assert decode_human(payload, "eva").pose is not None
        else:
            with pytest.raises(MessageError, match=r"from the hips|faster than"):
                decode_human(payload, "eva")
