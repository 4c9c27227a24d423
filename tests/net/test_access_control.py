"""Access control with a real router: writing under another name, in another world, or without a certificate."""

from __future__ import annotations

import contextlib
import json
import pathlib
import stat
import time

import numpy as np
import pytest
import zenoh

from tests.support.waiting import wait
from vinesim.net.codec.control import (
    Hello,
    RetainedRecord,
    decode_hello,
    decode_records,
    decode_time,
    encode_hello,
    encode_records,
    encode_time,
)
from vinesim.net.codec.meshes import MeshPart, decode_part, decode_wanted, encode_part, encode_request
from vinesim.net.replication.interest import FAR_KEY, POSE_LAYERS
from vinesim.net.server.admission import SceneId
from vinesim.net.server.server import Server
from vinesim.net.transport import zenoh_bus, zenoh_session
from vinesim.net.transport.access_control import CertificateError, Role, tls_config
from vinesim.net.transport.bus import KEEP_ALL, BusError, JoinRejected
from vinesim.net.transport.certificates import create, roles
from vinesim.net.transport.endpoints import parse
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.net.transport.zenoh_session import ServerUnreachable, close_session, config, open_session
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.triangles import digest_of, encode_triangles


@pytest.fixture(scope="module")
def certs(tmp_path_factory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("pki") / "certs"
    for name in ("ada", "bob"):
        create(folder, name)
    create(folder, "guest", Role.SPECTATOR)
    return folder


@pytest.fixture(scope="module")
def server(certs):
    with Server(("tls/127.0.0.1:0", "quic/127.0.0.1:0"), certificates=certs) as running:
        yield running


def bus(name, server, certs, **options):
    return ZenohBus(name, connect=server.endpoint, certificates=certs, **options)


def hello(name, digest="D1"):
    return encode_hello(Hello(name, digest=digest, scene="vsp"))


@contextlib.contextmanager
def session(name, server, certs):
    """A plain Zenoh session with a certificate: what any other program could do with it."""
    endpoint = parse(server.endpoint, secured=True)
    one = open_session(config("client", connect__endpoints=[endpoint.locator], **tls_config(certs, name)))
    try:
        yield one
    finally:
        close_session(one)


WRITTEN = [
    "a/{}",
    "a/{}/far",
    "a/{}/mid",
    "a/{}/near",
    "pose/0/-1/{}",
    "c/0/-1/{}",
    "tree/0/-1/{}",
    "near/0/-1/{}",
    "own/0/0/{}",
    "fact/3/4/{}",
    "force/bob/{}",
    "voice/{}",
    "voice/{}/pcm",
]


@contextlib.contextmanager
def subscription_of_bob(server, certs, pattern="**"):
    """Keys of all samples that reach bob."""
    received = []
    with session("bob", server, certs) as bob:
        declared = bob.declare_subscriber(
            f"vs/1/vineyard/{pattern}", lambda sample: received.append(str(sample.key_expr))
        )
        yield received
        declared.undeclare()


def keys_received(certs, server, name, keys):
    """Put a sample under each of ``keys`` with the certificate of ``name``; return the keys that reached bob."""
    with (
        subscription_of_bob(server, certs) as received,
        session("ada", server, certs) as ada,
        session(name, server, certs) as writer,
    ):
        end = ada.declare_publisher("vs/1/vineyard/own/9/9/ada")
        wait(lambda: end.matching_status.matching, "bob's subscription")
        for key in keys:
            writer.put(key, b"x", congestion_control=zenoh.CongestionControl.BLOCK)
        # samples put before in this session have arrived when the reply to a query has
        list(writer.get(f"vs/1/vineyard/clock/{name}", payload=encode_time(1.0)))
        end.put(b"end")
        wait(lambda: "vs/1/vineyard/own/9/9/ada" in received, "the end mark")
        return [key for key in received if key != "vs/1/vineyard/own/9/9/ada"]


def test_an_actor_writes_under_its_own_name_and_no_other(server, certs):
    own = [f"vs/1/vineyard/{key.format('ada')}" for key in WRITTEN]
    others = [f"vs/1/vineyard/{key.format('bob')}" for key in WRITTEN if key != "force/bob/{}"]
    invalid = [
        "vs/1/vineyard/anything",
        "vs/1/vineyard/c/0/0/0/ada",
        "vs/1/vineyard/force/ada/bob",
        "vs/1/vineyard/clock/ada",
        "vs/1/vineyard/hello/bob",
    ]
    assert keys_received(certs, server, "ada", [*others, *own, *invalid]) == own


def test_a_spectator_writes_its_pose_and_its_voice_and_nothing_else(server, certs):
    keys = [f"vs/1/vineyard/{key.format(name)}" for key in WRITTEN for name in ("guest", "ada")]
    poses = [FAR_KEY, *(layer.key for layer in POSE_LAYERS)]
    own = [f"vs/1/vineyard/{key.format(actor='guest', region='0/-1')}" for key in poses]
    own += [f"vs/1/vineyard/voice/guest{suffix}" for suffix in ("", "/pcm")]
    assert sorted(keys_received(certs, server, "guest", keys)) == sorted(own)


def test_another_world_is_inaccessible(server, certs):
    with session("ada", server, certs) as ada, session("bob", server, certs) as bob:
        received = []
        elsewhere = bob.declare_subscriber("vs/1/other/**", lambda sample: received.append(str(sample.key_expr)))
        everywhere = bob.declare_subscriber("**", lambda sample: received.append(str(sample.key_expr)))
        own_events = bob.declare_subscriber(
            "vs/1/vineyard/own/9/9/*", lambda sample: received.append(str(sample.key_expr))
        )
        end = ada.declare_publisher("vs/1/vineyard/own/9/9/ada")
        wait(lambda: end.matching_status.matching, "bob's subscription")
        ada.put("vs/1/other/c/0/0/ada", b"x")
        ada.put("vs/1/vineyard/c/0/0/ada", b"x")
        end.put(b"end")
        wait(lambda: received, "the end mark")
        assert set(received) == {"vs/1/vineyard/own/9/9/ada"}
        for each in (elsewhere, everywhere, own_events):
            each.undeclare()
    with pytest.raises(JoinRejected, match="refuses actors named 'ada' in world 'other'"):
        bus("ada", server, certs, world="other")


def test_connecting_needs_a_certificate_of_the_servers_authority(server, certs, tmp_path, monkeypatch):
    monkeypatch.setattr(zenoh_session, "CONNECT_TIMEOUT", 0.7)  # Zenoh retries until this timeout
    address = server.endpoint.partition("/")[2]
    with pytest.raises(ServerUnreachable):
        ZenohBus("ada", connect=f"tcp/{address}")
    bare = {"transport__link__tls": {"root_ca_certificate": str(certs / "ca.pem")}}
    tries = {
        "connect__endpoints": [f"tls/{address}"],
        "connect__timeout_ms": 700,
        "connect__exit_on_failure": True,
    }
    with pytest.raises(zenoh.ZError):
        close_session(open_session(config("client", **tries, **bare)))
    create(tmp_path, "ada")  # of another authority
    with pytest.raises(ServerUnreachable):
        bus("ada", server, tmp_path)


def test_all_bus_functions_work_under_access_control(server, certs):
    """The whole bus under access control: names, matching, poses, events, queries, snapshots."""
    with bus("ada", server, certs) as ada, bus("bob", server, certs) as bob, bus("guest", server, certs) as guest:
        for each in (ada, bob, guest):
            each.join(hello(each.name))
        assert server._admission.scene_of("vineyard") == SceneId("vsp", "D1")
        wait(
            lambda: all(each.alive() == {"ada", "bob", "guest"} for each in (ada, bob, guest)), "all to see each other"
        )
        pose = ada.publisher("a/ada")
        event = ada.publisher("own/0/0/ada", reliable=True)
        alone = ada.publisher("c/0/0/ada")
        for each in (bob, guest):
            each.subscribe("a/*")
            each.subscribe("own/0/0/*", KEEP_ALL)
        wait(lambda: pose.matching and event.matching, "their subscriptions")
        assert not alone.matching
        received: dict[str, set] = {"bob": set(), "guest": set()}

        def both_received_both():  # one subscription may be newer than the matching status
            pose.put(b"pose")
            event.put(b"event")
            time.sleep(0.01)
            for each in (bob, guest):
                received[each.name].update(each.poll())
            return all(found == {("a/ada", b"pose"), ("own/0/0/ada", b"event")} for found in received.values())

        wait(both_received_both, "both samples")
        record = RetainedRecord(object_id(ObjectKind.BOX, 1), 1, 0, "ada")
        publisher = ada.publisher("fact/0/0/ada", reliable=True)
        wait(lambda: publisher.matching, "the server's subscription")
        publisher.put(encode_records([record]))
        wait(lambda: server.store.count() == 1, "the record to be stored")
        ada.declare_queryable("hello/ada", lambda _: hello("ada"))
        guest.declare_queryable("hello/guest", lambda _: hello("guest"))
        answers: dict = {}

        def all_replied():
            for key in ("hello/ada", "clock/guest", "snap/0/0"):
                guest.query(key, encode_time(1.0))
            ada.query("hello/guest")
            time.sleep(0.02)
            answers.update({answer.key: answer.payload for answer in [*guest.replies(), *ada.replies()]})
            return len(answers) == 4

        wait(all_replied, "four answers")
        assert decode_records(answers["snap/0/0"]) == [record]
        assert decode_hello(answers["hello/guest"]).name == "guest"


def test_a_robot_offers_its_own_meshes_and_all_may_ask_for_them(server, certs, monkeypatch):
    """Under another name nothing is offered; a spectator offers nothing; neither answers for the server."""
    payload = encode_triangles(np.eye(3)[None])
    digest = digest_of(payload)
    part = encode_part(MeshPart(digest, len(payload), 0, payload))
    forged = encode_part(MeshPart(digest, len(payload), 0, bytes(36)))
    with (
        bus("ada", server, certs) as ada,
        bus("bob", server, certs) as bob,
        bus("guest", server, certs) as guest,
        session("bob", server, certs) as program,
    ):
        for each in (ada, bob, guest):
            each.join(hello(each.name))
        answers: list = []
        served = program.declare_queryable(
            f"vs/1/vineyard/mesh/{digest}", lambda query: query.reply(str(query.key_expr), forged)
        )
        heard = program.declare_queryable("vs/1/vineyard/offer/*", lambda query: answers.append(str(query.key_expr)))
        with monkeypatch.context() as patched:
            patched.setattr(zenoh_bus, "FETCH_TIMEOUT", 1.0)  # a denied question waits until then
            for each, key in ((bob, "offer/ada"), (guest, "offer/guest"), (guest, "offer/ada")):
                assert each.fetch(key, part) == []
        assert len(server.meshes) == 0
        (reply,) = ada.fetch("offer/ada", part)
        assert decode_wanted(reply).offset == len(payload)
        for each in (bob, guest):
            (reply,) = each.fetch(f"mesh/{digest}", encode_request(0))
            assert decode_part(reply).data == payload
        assert not answers
        for each in (served, heard):
            each.undeclare()


def test_liveliness_and_replies_of_another_name_are_blocked(server, certs):
    with session("ada", server, certs) as ada, bus("bob", server, certs) as bob:
        forged = ada.liveliness().declare_token("vs/1/vineyard/live/carl/1")
        served = ada.declare_queryable("vs/1/vineyard/hello/carl", lambda query: query.reply(str(query.key_expr), b"x"))
        clock = ada.declare_queryable("vs/1/vineyard/clock/*", lambda query: query.reply(str(query.key_expr), b"x"))
        own = ada.liveliness().declare_token("vs/1/vineyard/live/ada/1")
        wait(lambda: "ada" in bob.alive(), "ada herself")
        assert "carl" not in bob.alive()
        bob.query("hello/carl")
        bob.query("clock/bob", encode_time(1.0))
        answers: list = []
        wait(lambda: answers.extend(bob.replies()) or answers, "the clock")
        assert [answer.key for answer in answers] == ["clock/bob"]
        assert decode_time(answers[0].payload)[0] == 1.0
        for each in (served, clock, forged, own):
            each.undeclare()


def test_over_quic_poses_use_datagrams_and_events_a_stream(server, certs):
    port = server.endpoint.rpartition(":")[2]
    with (
        ZenohBus("ada", connect=f"quic/127.0.0.1:{port}", certificates=certs) as ada,
        ZenohBus("bob", connect=f"quic/127.0.0.1:{port}", certificates=certs) as bob,
    ):
        assert [link.split()[0].partition("/")[0] + link.partition(" ")[2] for link in ada.links] == [
            "quicbest effort",
            "quicreliable",
            "tlsreliable",
        ]
        ada.join(hello("ada"))
        bob.subscribe("a/*")
        pose = ada.publisher("a/ada")
        wait(lambda: pose.matching, "bob's subscription")
        received: list = []

        def arrived():
            pose.put(b"pose")
            time.sleep(0.01)
            received.extend(bob.poll())
            return received

        wait(arrived, "a pose")
        assert received[0] == ("a/ada", b"pose")


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_linked_servers_check_names_of_their_own_actors(certs, protocol):
    with (
        Server(("tls/127.0.0.1:0", "quic/127.0.0.1:0"), certificates=certs) as hub,
        Server(
            "tls/127.0.0.1:0", connect=[f"{protocol}/{hub.endpoint.partition('/')[2]}"], certificates=certs
        ) as relay,
        bus("ada", relay, certs) as ada,
        bus("bob", hub, certs) as bob,
        session("ada", relay, certs) as impostor,
    ):
        wait(lambda: ada.alive() == bob.alive() == {"ada", "bob"}, "both to see each other")

        def admitted():
            try:
                ada.join(hello("ada"))
            except JoinRejected:  # the link between the servers is not ready
                return False
            return True

        wait(admitted, "the hub to reply over the relay")
        bob.subscribe("own/0/0/*", KEEP_ALL)
        event = ada.publisher("own/0/0/ada", reliable=True)
        wait(lambda: event.matching, "bob's subscription")
        impostor.put("vs/1/vineyard/own/0/0/bob", b"forged", congestion_control=zenoh.CongestionControl.BLOCK)
        list(impostor.get("vs/1/vineyard/clock/bob", payload=encode_time(1.0)))
        event.put(b"event")
        received: list = []
        wait(lambda: received.extend(bob.poll()) or received, "the event")
        assert received == [("own/0/0/ada", b"event")]


# ---------------------------------------------------------------- folder of certificates


def test_key_files_are_private_and_roles_are_read(tmp_path):
    written = create(tmp_path / "pki", "guest", Role.SPECTATOR)
    authority = "pki-authority"
    pki = "pki"
    assert [f"{path.parent.name}/{path.name}" for path in written] == [
        f"{authority}/ca.key",
        f"{authority}/ca.pem",
        f"{pki}/ca.pem",
        f"{pki}/server.key",
        f"{pki}/server.pem",
        f"{pki}/guest.key",
        f"{pki}/guest.pem",
    ]
    for path in written:
        assert stat.S_IMODE(path.stat().st_mode) == (0o600 if path.suffix == ".key" else 0o644), path
    assert [path.name for path in create(tmp_path / "pki", "ada")] == ["ada.key", "ada.pem"]
    assert roles(tmp_path / "pki") == {"ada": Role.ROBOT, "guest": Role.SPECTATOR, "server": Role.SERVER}
    before = (tmp_path / "pki" / "ca.pem").read_bytes()
    create(tmp_path / "pki", "server", Role.SERVER, ["vines.example", "192.168.1.5"])
    assert (tmp_path / "pki" / "ca.pem").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "role", "hosts", "reason"),
    [
        ("a/b", Role.ROBOT, [], "letters, digits"),
        ("ca", Role.ROBOT, [], "not 'ca'"),
        ("server", Role.ROBOT, [], "only the server"),
        ("ada", Role.SERVER, [], "only the server"),
        ("ada", Role.ROBOT, ["host"], "only the server's certificate names hosts"),
    ],
)
def test_an_invalid_certificate_request_is_refused_without_files(tmp_path, name, role, hosts, reason):
    with pytest.raises(ValueError, match=reason):
        create(tmp_path / "pki", name, role, hosts)
    assert not (tmp_path / "pki").exists()


def test_errors_in_the_folder_are_one_line_with_a_remedy(tmp_path, certs):
    with pytest.raises(CertificateError, match="vinesim certs new server"):
        Server("tls/127.0.0.1:0", certificates=tmp_path)
    create(tmp_path, "ada")
    with pytest.raises(CertificateError, match="there already"):
        create(tmp_path, "ada")
    (tmp_path / "bob.pem").write_bytes((certs / "bob.pem").read_bytes())
    with pytest.raises(CertificateError, match=r"bob\.pem: not signed by ca\.pem"):
        roles(tmp_path)
    (tmp_path / "bob.pem").write_text("junk")
    with pytest.raises(CertificateError, match="cannot be read as a certificate"):
        roles(tmp_path)
    (tmp_path / "bob.pem").write_bytes((tmp_path / "ada.pem").read_bytes())
    with pytest.raises(CertificateError, match=r"rename it to ada\.pem"):
        roles(tmp_path)
    (tmp_path / "bob.pem").unlink()
    create(tmp_path, "server", Role.SERVER, days=-1)
    with pytest.raises(CertificateError, match=r"server\.pem: not valid.*vinesim certs new server"):
        Server("tls/127.0.0.1:0", certificates=tmp_path)
    with pytest.raises(BusError, match=r"no .*eve\.pem.*vinesim certs new eve"):
        ZenohBus("eve", connect="tls/127.0.0.1:1", certificates=tmp_path)
    assert json.dumps(tls_config(tmp_path, "ada"))
