"""Hypothesis strategies for well-formed false messages of every kind: the model forbids their content, or their parts
contradict each other.

A message that carries a time is encoded for time zero plus an error; the time is shifted to the present when the
message is sent.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import hypothesis
import numpy as np
from hypothesis import strategies as st

from benchmarks.support.fuzz_world import ATTACKER, WORLD, FuzzWorld, human_at, small_vineyard
from vinesim.core import frames
from vinesim.net.codec.control import (
    Hello,
    RetainedRecord,
    Welcome,
    decode_records,
    encode_claims,
    encode_description,
    encode_hello,
    encode_records,
    encode_time,
    encode_welcome,
)
from vinesim.net.codec.forces import Coupling, CouplingMessage, WrenchMessage, encode_couplings, encode_wrenches
from vinesim.net.codec.header import MessageError
from vinesim.net.codec.human import encode_human
from vinesim.net.codec.meshes import MeshPart, MeshWanted, decode_part, encode_part, encode_request, encode_wanted
from vinesim.net.codec.messages import shift_time
from vinesim.net.codec.objects import ObjectStates, encode_objects
from vinesim.net.codec.robot import encode_robot
from vinesim.net.codec.trees import TreeStates, encode_trees
from vinesim.net.replication.authority import Claim
from vinesim.net.replication.streams import object_counts
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.sidecar import encode_sidecar
from vinesim.scene import triangles
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.model import Model
from vinesim.scene.values import HumanUpdate, RobotUpdate

Draw = Callable[[st.SearchStrategy], Any]


@dataclasses.dataclass(frozen=True)
class FalseMessage:
    """A false message: one under a key, a greeting with which the attacker comes back, an offered mesh, or a request to
    join."""

    kind: str
    """``put``, ``greet``, ``mesh`` or ``join``."""
    payload: bytes
    key: str = ""
    description: bytes = b""
    """Description of the robot of a greeting."""

    def tell(self, world: FuzzWorld) -> None:
        """Send the message into a ``world``."""
        if self.kind == "put":
            world.put(self.key, shift_time(self.payload, world.now))
        elif self.kind == "greet":
            world.greet(self.payload, self.description)
        elif self.kind == "join":
            world.admission.decide(WORLD, ATTACKER, "another", self.payload, world.now)
        else:
            world.offer(self.payload)


class Liar:
    """Sends false messages into one world that is kept from one Hypothesis example to the next.

    After a broken law it starts a new world, so that Hypothesis can find the shortest list of messages that breaks the
    law.
    """

    def __init__(self, *, kind: str = "robot") -> None:
        self.kind = kind
        self.told = 0
        self.world: FuzzWorld | None = None

    def tell(self, messages: list[FalseMessage]) -> None:
        """Send these messages, one a step, and check the laws of the world after each step."""
        world = self.world or FuzzWorld(kind=self.kind)
        self.world = None
        try:
            world.admit(self.kind)
            for one in messages:
                one.tell(world)
                world.step()
                world.check()
            world.step()
            world.check()
        except BaseException:
            world.close()
            raise
        self.told += len(messages)
        self.world = world

    def close(self) -> None:
        """Close the world. Raises :class:`benchmarks.support.fuzz_world.LawBroken` unless its journals hold the state
        of its store."""
        if self.world is not None:
            self.world.check_store()
            self.world.close()
            self.world = None


_HEALTH_CHECKS = (
    hypothesis.HealthCheck.too_slow,
    hypothesis.HealthCheck.data_too_large,
    hypothesis.HealthCheck.filter_too_much,
    hypothesis.HealthCheck.large_base_example,
)


def send_false_messages(examples: int, *, seed: int = 0, kind: str = "robot") -> int:
    """Send ``examples`` series of up to eight messages, found by Hypothesis; return the number of messages.

    Passes on exceptions of the attacked code, and :class:`benchmarks.support.fuzz_world.LawBroken`.
    """
    liar = Liar(kind=kind)

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=examples,
        deadline=None,
        database=None,
        print_blob=False,
        suppress_health_check=_HEALTH_CHECKS,
    )
    @hypothesis.given(st.lists(false_messages(small_vineyard()), min_size=1, max_size=8))
    def tell(series: list[FalseMessage]) -> None:
        liar.tell(series)

    try:
        tell()
    finally:
        liar.close()
    return liar.told


def false_messages(model: Model) -> st.SearchStrategy[FalseMessage]:
    """Returns a strategy for false messages about a model, of all kinds with equal probability."""
    return st.one_of(
        _composite(_about_trees, model),
        _composite(_about_objects, model),
        _composite(_about_owners, model),
        _composite(_records, model),
        _composite(_robot_pose, model),
        _composite(_human_pose, model),
        _composite(_wrenches, model),
        _composite(_couplings, model),
        _composite(_greeting, model),
        _composite(_mesh, model),
        _composite(_control, model),
    )


def _composite(make: Callable[[Draw, Model], FalseMessage | None], model: Model) -> st.SearchStrategy[FalseMessage]:
    @st.composite
    def strategy(draw: Draw) -> FalseMessage | None:
        try:
            return make(draw, model)
        except MessageError:  # the message is not well-formed
            return None

    return strategy().filter(lambda one: one is not None)  # type: ignore[return-value]


CELL = st.integers(-2, 1)
SEQUENCE = st.one_of(st.integers(0, 4), st.sampled_from((32767, 32768, 65535)), st.integers(0, 65535))
TIME_ERROR = st.one_of(st.just(0.0), st.floats(-1.0, 1.0), st.sampled_from((-1e300, -1e6, -60.0, 60.0, 1e6, 1e300)))
OWNERS = st.sampled_from((ATTACKER, "ada", "bob", "", "unknown"))
NEAR = st.floats(-2.5, 2.5, width=32)
FAR = st.one_of(NEAR, st.floats(-9.9e4, 9.9e4, width=32), st.sampled_from((99_999.0, -99_999.0)))
FARTHER = st.one_of(NEAR, st.floats(-9.9e8, 9.9e8, width=32))
UNIT = st.floats(-1.0, 1.0, width=32)


def _vectors(draw: Draw, number: st.SearchStrategy[float], *shape: int, scale: float = 1.0) -> np.ndarray:
    """Draw an array [shape] of numbers, times ``scale``; large arrays come from a drawn seed."""
    count = int(np.prod(shape))
    if count <= 12:
        return scale * np.array([draw(number) for _ in range(count)], float).reshape(shape)
    generator = np.random.default_rng(draw(st.integers(0, 1 << 16)))
    return scale * draw(UNIT) * generator.uniform(-1.0, 1.0, shape)


def _quaternions(draw: Draw, count: int) -> np.ndarray:
    return frames.exp(_vectors(draw, UNIT, count, 3, scale=np.pi))


def _object(draw: Draw, model: Model, kinds: tuple[ObjectKind, ...]) -> int:
    kind = draw(st.sampled_from(kinds))
    return object_id(kind, draw(st.integers(0, object_counts(model)[kind])))


def _about_trees(draw: Draw, model: Model) -> FalseMessage:
    """Draw states of trees with absurd values, or with impossible bodies cut off, far away."""
    trees = sorted(draw(st.sets(st.integers(0, len(model.tree_first) - 1), min_size=1, max_size=2)))
    sizes = np.array([int(model.tree_size[tree]) + draw(st.sampled_from((0, 0, 0, 0, 1))) for tree in trees])
    roots = [sorted(draw(st.sets(st.integers(0, int(size) - 1), max_size=3))) for size in sizes]
    total = int(sizes.sum())
    cut = sum(map(len, roots))
    ownership, authority = (np.array([draw(SEQUENCE) for _ in trees]) for _ in range(2))
    flags = np.array([draw(st.integers(0, 3)) for _ in trees])
    states = TreeStates(
        draw(TIME_ERROR),
        np.array(trees),
        ownership,
        authority,
        flags,
        sizes,
        _quaternions(draw, total),
        _vectors(draw, UNIT, total, 3, scale=83.0),
        np.array([len(one) for one in roots]),
        np.array([body for one in roots for body in one], np.int64),
        _vectors(draw, FAR, cut, 3),
        _vectors(draw, UNIT, cut, 3, scale=32.7),
    )
    family = draw(st.sampled_from(("tree", "near", "own")))
    return FalseMessage("put", encode_trees(states)[0][0], f"{family}/{draw(CELL)}/{draw(CELL)}/{ATTACKER}")


def _about_objects(draw: Draw, model: Model) -> FalseMessage:
    """Draw states of boxes and bunches that hang, belong to others or do not exist, at absurd places and speeds."""
    numbers = sorted({_object(draw, model, (ObjectKind.BUNCH, ObjectKind.BOX)) for _ in range(draw(st.integers(1, 3)))})
    count = len(numbers)
    cell = (draw(CELL), draw(CELL))
    pose = np.concatenate([_vectors(draw, NEAR, count, 3), _quaternions(draw, count)], 1)
    ownership, authority = (np.array([draw(SEQUENCE) for _ in numbers]) for _ in range(2))
    velocity = _vectors(draw, st.one_of(UNIT, st.floats(-4000.0, 4000.0, width=32)), count, 6)
    states = ObjectStates(
        draw(TIME_ERROR),
        np.array(numbers),
        ownership,
        authority,
        np.array([draw(st.integers(0, 3)) for _ in numbers]),
        pose,
        velocity,
    )
    return FalseMessage("put", encode_objects(states, cell)[0][0], f"c/{cell[0]}/{cell[1]}/{ATTACKER}")


def _about_owners(draw: Draw, model: Model) -> FalseMessage:
    """Draw claims in the name of others, for objects that do not exist, and with any sequence numbers."""
    claims = []
    for _ in range(draw(st.integers(1, 4))):
        claim = Claim(draw(SEQUENCE), draw(SEQUENCE), draw(OWNERS))
        claims.append((_object(draw, model, tuple(ObjectKind)), claim, draw(st.booleans())))
    return FalseMessage("put", encode_claims(claims), f"own/{draw(CELL)}/{draw(CELL)}/{ATTACKER}")


PARENTS = st.sampled_from(
    (
        "",
        "box/0",
        "box/1",
        "box/2",
        "box/3",
        "box/4",
        "box/-1",
        "box/" + "9" * 40,
        "bunch/0",
        "tree/0",
        "ada/base_link",
        "ada/no link",
        "bob/chest",
        "bob/left_hand",
        f"{ATTACKER}/base_link",
        "unknown/link",
        "/",
        "box/",
        "x" * 200,
    )
)


def _records(draw: Draw, model: Model) -> FalseMessage:
    """Draw records with cuts of bodies that cannot be cut, states of other trees, or supports that rest on each
    other."""
    records = []
    for _ in range(draw(st.integers(1, 3))):
        number = _object(draw, model, tuple(ObjectKind))
        tree = min(number, len(model.tree_first) - 1)
        first = int(model.tree_first[tree])
        size = int(model.tree_size[tree])
        cut = sorted(draw(st.sets(st.one_of(st.integers(first, first + size), st.integers(0, 1 << 20)), max_size=3)))
        spare = first + int(model.tree_core[tree]) - 2
        stumps = draw(
            st.lists(
                st.tuples(
                    st.integers(spare - 1, spare + 2),
                    st.one_of(st.sampled_from(cut or [first]), st.integers(first, first + size)),
                    st.integers(1, 1000),
                ),
                max_size=3,
            )
        )
        state = draw(st.one_of(st.just(b""), st.binary(max_size=30), _composite(_about_trees, model)))
        pose = (*_vectors(draw, FAR, 3).tolist(), *_quaternions(draw, 1)[0].tolist())
        records.append(
            RetainedRecord(
                number,
                draw(SEQUENCE),
                draw(SEQUENCE),
                draw(st.sampled_from((ATTACKER, ATTACKER, "ada", "bob"))),
                pose,
                draw(PARENTS),
                tuple(cut) if draw(st.booleans()) else (),
                state.payload if isinstance(state, FalseMessage) else state,
                draw(st.booleans()),
                stumps=tuple(stumps),
            )
        )
    payload = encode_records(records)
    decode_records(payload)
    return FalseMessage("put", payload, f"fact/{draw(CELL)}/{draw(CELL)}/{ATTACKER}")


def _pose_key(draw: Draw) -> str:
    places = ("a/{}", "a/{}/far", "a/{}/mid", "a/{}/near", "pose/0/0/{}", "pose/-1/-1/{}")
    return draw(st.sampled_from(places)).format(ATTACKER)


def _robot_pose(draw: Draw, _: Model) -> FalseMessage:
    """Draw robots with any number of joints, at any distance and speed, turned over."""
    count = draw(st.sampled_from((27, 27, 27, 0, 1, 256)))
    near = draw(st.booleans())
    base = np.concatenate([_vectors(draw, NEAR if near else FARTHER, 3), _quaternions(draw, 1)[0]])
    update = RobotUpdate(
        ATTACKER,
        draw(TIME_ERROR),
        base,
        _vectors(draw, st.floats(-1e3, 1e3, width=32), 6),
        _vectors(draw, UNIT, count, scale=draw(st.sampled_from((1.0, 10.0, 9e8)))) if count > 12 else np.zeros(count),
        _vectors(draw, UNIT, count, scale=83.0),
    )
    return FalseMessage("put", encode_robot(update), _pose_key(draw))


def _human_pose(draw: Draw, _: Model) -> FalseMessage:
    """Draw people turned and stretched, far away, or near others at absurd speeds."""
    place = frames.pose(_vectors(draw, NEAR if draw(st.booleans()) else FAR, 3))
    points = human_at(place).points + np.pad(_vectors(draw, UNIT, 7, 3, scale=2.0), ((0, 0), (0, 4)))
    points[:, 3:] = _quaternions(draw, 7)
    update = HumanUpdate(
        ATTACKER, draw(TIME_ERROR), human_at(place).with_points(points), _vectors(draw, UNIT, 7, 6, scale=40.0)
    )
    return FalseMessage("put", encode_human(update), _pose_key(draw))


def _wrenches(draw: Draw, _: Model) -> FalseMessage:
    """Draw forces beyond all limits, on links that are out of reach, belong to other robots or do not exist."""
    links = draw(
        st.sets(st.sampled_from(("base_link", "arm_left_7_link", "torso_lift_link", "no link", "")), max_size=3)
    )
    wrenches = {link: _vectors(draw, st.floats(-2000.0, 2000.0, width=32), 6) for link in sorted(links)}
    return FalseMessage("put", encode_wrenches(WrenchMessage(draw(TIME_ERROR), wrenches)), f"force/ada/{ATTACKER}")


def _couplings(draw: Draw, model: Model) -> FalseMessage:
    """Draw springs (ties) from far away to bodies that have no owner, cannot be held or do not exist."""
    bodies = sorted(draw(st.sets(st.integers(0, len(model.body_tree)), max_size=8)))
    couplings = tuple(
        Coupling(body, _vectors(draw, st.floats(-10.0, 10.0, width=32), 3), _vectors(draw, FAR, 3)) for body in bodies
    )
    return FalseMessage("put", encode_couplings(CouplingMessage(draw(TIME_ERROR), couplings)), f"force/ada/{ATTACKER}")


def _urdf(links: str) -> str:
    return f"<robot name='x'>{links}</robot>"


_TWO_LINKS = "<link name='a'/><link name='b'/>"

URDFS = (
    None,
    "",
    "<robot/>",
    _urdf("<link name='base_link'/>"),
    "<!DOCTYPE r [<!ENTITY a 'b'>]><robot>&a;</robot>",
    _urdf(
        f"{_TWO_LINKS}<joint name='j' type='revolute'><parent link='a'/><child link='b'/><axis xyz='0 0 0'/>"
        "<limit effort='1e300' velocity='1e300' lower='-1e300' upper='1e300'/></joint>"
    ),
    _urdf(
        "<link name='a'><inertial><mass value='1e30'/>"
        "<inertia ixx='1e30' iyy='1e30' izz='1e30' ixy='0' ixz='0' iyz='0'/></inertial>"
        "<collision><geometry><box size='1e6 1e6 1e6'/></geometry></collision></link>"
    ),
    _urdf("<link name='a'><visual><geometry><mesh filename='/etc/passwd'/></geometry></visual></link>"),
    _urdf(
        "<link name='a'><visual><geometry><mesh filename='m.stl' size='1e9 1 1' triangles='4' "
        f"digest='{'0' * 40}'/></geometry></visual></link>"
    ),
    _urdf(
        f"{_TWO_LINKS}<joint name='j' type='fixed'><parent link='b'/><child link='a'/></joint>"
        "<joint name='k' type='fixed'><parent link='a'/><child link='b'/></joint>"
    ),
)
"""Robot descriptions that are impossible; None: a possible one."""

SIDECARS = (None, "", "{}", "[]", "null", '{"groups": 3}', '{"base_limits": [1e999, -1]}', "\x00", '{"a": ' * 50)


def _greeting(draw: Draw, model: Model) -> FalseMessage:
    """Draw greetings whose parts contradict each other, with impossible robots."""
    robot = load_description("vinebot")
    urdf = draw(st.sampled_from(URDFS))
    sidecar = draw(st.sampled_from(SIDECARS))
    hello = Hello(
        draw(st.sampled_from((ATTACKER, ATTACKER, "ada", "bob"))),
        draw(st.sampled_from(("robot", "human", "spectator"))),
        draw(st.sampled_from(("vinebot", "logistic", "../../etc/passwd", "", "x" * 1000))),
        robot.urdf if urdf is None else urdf,
        encode_sidecar(robot.base_limits, robot.groups) if sidecar is None else sidecar,
        "demo",
        draw(st.sampled_from((model.digest(), model.digest(), model.digest(), "", "0" * 64))),
        index=draw(st.sampled_from((0, 1, 4095))),
        joints=draw(st.sampled_from((-1, 0, 1, 27, 256))),
        seed=draw(st.sampled_from((-1, 0, (1 << 63) - 1))),
        height=draw(st.sampled_from((1.0, 1.75, 2.5))),
        outfit=draw(st.sampled_from(("", "green", "no-such-outfit"))),
    )
    kind = draw(st.sampled_from(("greet", "greet", "join")))
    return FalseMessage(kind, encode_hello(hello), description=encode_description(hello))


def _mesh(draw: Draw, _: Model) -> FalseMessage:
    """Draw parts of meshes with false digests and sizes."""
    corners = _vectors(draw, UNIT, 4, 3, 3, scale=draw(st.sampled_from((1.0, 1e6, 1e38)))).astype("<f4").tobytes()
    data = draw(st.sampled_from((corners, corners[:-1], b"", b"\xff" * 36)))
    digest = draw(st.sampled_from((triangles.digest_of(data), "0" * 40)))
    offset = draw(st.sampled_from((0, 0, 0, 1, 36)))
    size = draw(st.sampled_from((len(data), len(data) + offset, 36, triangles.MAX_BYTES)))
    payload = encode_part(MeshPart(digest, size, offset, data))
    decode_part(payload)
    return FalseMessage("mesh", draw(st.sampled_from((payload, encode_request(offset)))))


def _control(draw: Draw, model: Model) -> FalseMessage:
    """Draw answers that were not asked for, messages under keys of other kinds, and clocks."""
    number = draw(st.floats(allow_nan=False, allow_infinity=False))
    payload = draw(
        st.sampled_from(
            (
                encode_time(number, -number),
                encode_welcome(Welcome("go away")),
                encode_wanted(MeshWanted(0, "no")),
            )
        )
    )
    family = draw(st.sampled_from(("own", "fact", "c", "tree", "near")))
    return FalseMessage("put", payload, f"{family}/{draw(CELL)}/{draw(CELL)}/{ATTACKER}")
