"""Parsing of endpoints, and the two links to a server."""

from __future__ import annotations

import pytest

from vinesim.core.errors import UsageError
from vinesim.net.transport.endpoints import Endpoint, check_exposure, client_links, default_listen, parse, resolve_ports


@pytest.mark.parametrize(
    ("text", "secured", "reason"),
    [
        ("", False, "expected tcp/HOST:PORT or udp/HOST:PORT"),
        ("192.168.1.5:7377", False, "expected tcp/"),
        ("tcp/192.168.1.5", False, "expected tcp/"),
        ("tcp/host:x", False, "port 'x'"),
        ("tcp/host:65536", False, "port '65536'"),
        ("tcp/host:7377?rel=1", False, "port"),
        ("tcp/a?b:1", False, "expected"),
        ("serial/dev:1", False, "expected tcp/"),
        ("tls/host:7377", False, "--tls DIR"),
        ("quic/host:7377", False, "--tls DIR"),
        ("tcp/host:7377", True, "use tls/ or quic/"),
        ("udp/host:7377", True, "expected tls/HOST:PORT or quic/HOST:PORT"),
    ],
)
def test_an_invalid_endpoint_is_refused_with_the_expected_form(text, secured, reason):
    with pytest.raises(ValueError, match=reason) as caught:
        parse(text, secured=secured)
    assert repr(text) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_endpoint_is_parsed_and_formatted():
    assert parse("tcp/[::1]:7377") == Endpoint("tcp", "[::1]", 7377)
    for text in ("tcp/host:1", "udp/10.0.0.1:7377"):
        assert str(parse(text)) == text
    assert parse("udp/host:1").locator == "udp/host:1?rel=1;mixed_rel=auto"
    assert parse("quic/host:1", secured=True).locator == "quic/host:1?mixed_rel=auto"
    assert parse("tcp/host:1").locator == "tcp/host:1"


@pytest.mark.parametrize(
    ("connect", "secured", "bulk", "live"),
    [
        ("tcp/192.168.1.5:7377", False, "tcp/192.168.1.5:7377", "udp/192.168.1.5:7377"),
        ("tls/server:7377", True, "tls/server:7377", "quic/server:7377"),
        ("tcp/127.0.0.1:7377", False, "tcp/127.0.0.1:7377", "None"),
        ("tcp/[::1]:7377", False, "tcp/[::1]:7377", "None"),
        ("tls/localhost:7377", True, "tls/localhost:7377", "None"),
        ("udp/127.0.0.1:7377", False, "tcp/127.0.0.1:7377", "udp/127.0.0.1:7377"),
        ("quic/localhost:7377", True, "tls/localhost:7377", "quic/localhost:7377"),
    ],
)
def test_datagrams_are_used_beyond_loopback_or_on_request(connect, secured, bulk, live):
    links = client_links(connect, secured=secured)
    assert (str(links.bulk), str(links.live)) == (bulk, live)


def test_port_0_is_one_free_number_for_both_protocols():
    stream, datagrams = resolve_ports(["tcp/127.0.0.1:0", "udp/127.0.0.1:0"])
    assert stream.port == datagrams.port > 1023
    assert resolve_ports(["tcp/127.0.0.1:7"]) == (Endpoint("tcp", "127.0.0.1", 7),)
    with pytest.raises(ValueError, match="listens nowhere"):
        resolve_ports([])


def test_a_server_listens_on_both_protocols_by_default():
    assert [str(one) for one in resolve_ports(default_listen())] == ["tcp/127.0.0.1:7377", "udp/127.0.0.1:7377"]
    assert default_listen(insecure=True) == ("tcp/0.0.0.0:7377", "udp/0.0.0.0:7377")
    assert [one.protocol for one in resolve_ports(default_listen(secured=True), secured=True)] == ["tls", "quic"]


def test_nobody_listens_to_a_network_unchecked_unless_told_to():
    check_exposure(["tcp/127.0.0.1:0", "udp/[::1]:0", "tcp/localhost:7377"])
    check_exposure(["tls/0.0.0.0:7377", "quic/0.0.0.0:7377"], secured=True)
    check_exposure(["tcp/0.0.0.0:7377"], insecure=True)
    for place in ("tcp/0.0.0.0:7377", "udp/192.168.1.5:0", "tcp/[::]:7377", "tcp/vines.example:7377"):
        with pytest.raises(UsageError, match=r"--tls DIR.*--insecure"):
            check_exposure(["tcp/127.0.0.1:7377", place])
