"""Certificates that are added, replaced, removed, about to expire or expired, with real routers."""

from __future__ import annotations

import logging
import pathlib
import shutil
import ssl

import pytest
from cryptography import x509

from tests.support.waiting import wait
from vinesim.net.codec.control import Hello, RetainedRecord, encode_hello, encode_records
from vinesim.net.server.server import Server
from vinesim.net.transport import certificate_watch
from vinesim.net.transport.access_control import CertificateError, Role
from vinesim.net.transport.bus import BusError, JoinRejected
from vinesim.net.transport.certificates import create
from vinesim.net.transport.zenoh_bus import ZenohBus
from vinesim.scene.ids import ObjectKind, object_id


@pytest.fixture(autouse=True)
def _fast_watch(monkeypatch):
    monkeypatch.setattr(certificate_watch, "WATCH_PERIOD", 0.1)


def joined(name: str, server: Server, certs: pathlib.Path) -> ZenohBus | None:
    """A bus whose actor was let in; None if it was refused."""
    try:
        bus = ZenohBus(name, connect=server.endpoint, certificates=certs)
    except JoinRejected:
        return None
    try:
        bus.join(encode_hello(Hello(name, digest="D1", scene="vsp")))
    except BusError:
        bus.close()
        return None
    return bus


def served_serial(server: Server) -> int | None:
    """Serial number of the certificate that a new connection is shown; None while nothing listens."""
    host, port = server.endpoint.partition("/")[2].rsplit(":", 1)
    try:
        pem = ssl.get_server_certificate((host, int(port)), timeout=2.0)
    except OSError:
        return None
    return x509.load_pem_x509_certificate(pem.encode()).serial_number


def serial(file: pathlib.Path) -> int:
    return x509.load_pem_x509_certificate(file.read_bytes()).serial_number


def test_a_running_server_takes_new_certificates_and_its_actors_and_records_stay(tmp_path):
    certs = tmp_path / "certs"
    create(certs, "ada")
    with Server("tls/127.0.0.1:0", certificates=certs) as server:
        ada = joined("ada", server, certs)
        assert ada is not None
        with ada:
            record = RetainedRecord(object_id(ObjectKind.BOX, 1), 1, 0, "ada")
            publisher = ada.publisher("fact/0/0/ada", reliable=True)
            wait(lambda: publisher.matching, "the server's subscription")
            publisher.put(encode_records([record]))
            wait(lambda: server.store is not None and server.store.count() == 1, "the record to be stored")

            create(certs, "server", Role.SERVER)
            wait(lambda: served_serial(server) == serial(certs / "server.pem"), "the new certificate")
            wait(lambda: "vineyard/ada" in server.actors and not ada.status_message, "ada to come back")
            create(certs, "bob")
            wait(lambda: (found := joined("bob", server, certs)) is not None and found.close() is None, "bob")
            wait(lambda: "vineyard/ada" in server.actors and not ada.status_message, "ada to come back")
            assert server.store is not None
            assert server.store.count() == 1
            publisher.put(encode_records([RetainedRecord(object_id(ObjectKind.BOX, 2), 1, 0, "ada")]))
            wait(lambda: server.store is not None and server.store.count() == 2, "a record after that")

            for suffix in (".pem", ".key"):
                shutil.move(certs / f"bob{suffix}", tmp_path)
            (tmp_path / "ca.pem").write_bytes((certs / "ca.pem").read_bytes())

            def is_refused() -> bool:
                try:
                    bob = joined("bob", server, tmp_path)
                except BusError:  # the server is being opened again
                    return False
                return bob is None or bob.close() is not None

            wait(is_refused, "bob to be refused without his file")


def test_clients_with_datagrams_come_back_to_both_ports(tmp_path):
    """The socket of QUIC is released some time after its session is closed."""
    certs = tmp_path / "certs"
    create(certs, "ada")
    with Server(("tls/127.0.0.1:0", "quic/127.0.0.1:0"), certificates=certs) as server:
        quic = str(server.endpoints[1])
        with ZenohBus("ada", connect=quic, certificates=certs) as ada:
            links = ada.links
            assert len(links) > 1
            for _ in range(2):
                create(certs, "server", Role.SERVER)
                wait(lambda: served_serial(server) == serial(certs / "server.pem"), "the new certificate")
                wait(lambda: ada.links == links and not ada.status_message, "both links to be back")


def test_a_new_authority_for_all_is_used_by_servers_and_by_clients_that_come_back(tmp_path):
    certs = tmp_path / "certs"
    new = tmp_path / "new"
    create(certs, "ada")
    create(new, "ada")
    with Server("tls/127.0.0.1:0", certificates=certs) as server:
        ada = joined("ada", server, certs)
        assert ada is not None
        with ada:
            for file in new.iterdir():
                shutil.copy(file, certs)
            wait(lambda: served_serial(server) == serial(new / "server.pem"), "the new certificate")
            wait(lambda: "vineyard/ada" in server.actors and not ada.status_message, "ada with her new certificate")


def test_a_change_that_cannot_be_used_leaves_the_earlier_certificates_in_use(tmp_path, caplog):
    certs = tmp_path / "certs"
    create(certs, "ada")
    with Server("tls/127.0.0.1:0", certificates=certs) as server:
        before = served_serial(server)
        create(tmp_path / "other", "ada")
        shutil.copy(tmp_path / "other" / "server.key", certs)  # the key of another certificate
        wait(lambda: "cannot be used; the earlier ones stay in use" in caplog.text, "the line of the log")
        assert r"server.key: not the key of server.pem" in caplog.text
        assert served_serial(server) == before


def test_certificates_warn_before_they_expire_and_are_refused_afterwards(tmp_path, caplog):
    certs = tmp_path / "certs"
    create(certs, "server", Role.SERVER, days=10)
    create(certs, "ada", days=20)
    create(certs, "old", days=-1)
    create(certs, "bob")
    with Server("tls/127.0.0.1:0", certificates=certs) as server:
        wait(lambda: caplog.text.count("is valid until") == 3, "a warning for each that expires soon, or has")
        dates = [x509.load_pem_x509_certificate((certs / f"{name}.pem").read_bytes()) for name in ("ada", "server")]
        for certificate in dates:
            assert f"is valid until {certificate.not_valid_after_utc:%Y-%m-%d}" in caplog.text
        assert "bob.pem" not in caplog.text
        with pytest.raises(CertificateError, match=r"old\.pem: not valid now.*vinesim certs new old"):
            ZenohBus("old", connect=server.endpoint, certificates=certs)
    watch = certificate_watch.CertificateWatch(certs)
    with caplog.at_level(logging.WARNING):
        caplog.clear()
        watch.warn()
        assert caplog.text.count("ada.pem is valid until") == 1
        watch.warn()
        assert caplog.text.count("ada.pem is valid until") == 1
        watch._next_warning -= certificate_watch.WARNING_PERIOD
        watch.warn()
        assert caplog.text.count("ada.pem is valid until") == 2


def test_no_folder_with_the_key_of_the_authority_is_taken(tmp_path):
    certs = tmp_path / "certs"
    create(certs, "ada")
    assert not list(certs.glob("ca.key"))
    shutil.copy(tmp_path / "certs-authority" / "ca.key", certs)
    for refused in (
        lambda: Server("tls/127.0.0.1:0", certificates=certs),
        lambda: ZenohBus("ada", connect="tls/127.0.0.1:1", certificates=certs),
        lambda: create(certs, "bob"),
    ):
        with pytest.raises(CertificateError, match=r"ca\.key: whoever has it.* mv .*certs/ca\.key .*certs-authority/"):
            refused()


def test_the_authority_may_lie_anywhere_but_in_the_folder_and_is_not_mistaken(tmp_path):
    certs = tmp_path / "certs"
    stick = tmp_path / "stick"
    create(certs, "ada", authority=stick)
    assert sorted(path.name for path in stick.iterdir()) == ["ca.key", "ca.pem"]
    with pytest.raises(CertificateError, match="--authority"):
        create(certs, "bob")
    create(certs, "bob", authority=stick)
    with pytest.raises(ValueError, match="folder of its own"):
        create(tmp_path / "new", "bob", authority=tmp_path / "new")
