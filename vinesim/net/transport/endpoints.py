"""Endpoints of servers and clients, and the two links between a client and a server: a stream and datagrams.

A stream (``tcp``, ``tls``) can carry all messages. Datagrams (``udp``, ``quic``) use the same port number and carry
best-effort messages like poses without head-of-line blocking. ``tls`` and ``quic`` need certificates on both sides.
Only the functions that search for free ports do I/O.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from typing import NamedTuple

from vinesim.core.errors import UsageError

PORT = 7377
"""Default port of a server. It differs from the default port of Zenoh (7447), where ``rmw_zenohd`` of ROS 2 listens,
and lies below the ports of DDS (from 7400), which any ROS 2 program on the machine may hold."""

_COUNTERPART = {"tcp": "udp", "udp": "tcp", "tls": "quic", "quic": "tls"}
_MIXED = {"udp": "?rel=1;mixed_rel=auto", "quic": "?mixed_rel=auto"}
"""Zenoh's options for one session over two links, a reliable one and datagrams. Without ``rel=1`` a udp session would
have no reliable link."""


class Endpoint(NamedTuple):
    """An address on which a server listens or to which a client connects."""

    protocol: str
    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.protocol}/{self.host}:{self.port}"

    @property
    def locator(self) -> str:
        """The endpoint in Zenoh's notation."""
        return f"{self}{_MIXED.get(self.protocol, '')}"

    @property
    def datagrams(self) -> bool:
        """Whether best-effort messages are sent as datagrams."""
        return self.protocol in _MIXED

    @property
    def secured(self) -> bool:
        """Whether server and client need certificates."""
        return self.protocol in ("tls", "quic")

    @property
    def loopback(self) -> bool:
        """Whether only programs on this machine can use the endpoint."""
        try:
            return ipaddress.ip_address(self.host.strip("[]")).is_loopback
        except ValueError:
            return self.host == "localhost"

    @property
    def counterpart(self) -> Endpoint:
        """Endpoint of the other link to the same server: datagrams for a stream, a stream for datagrams."""
        return self._replace(protocol=_COUNTERPART[self.protocol])


def parse(text: str, *, secured: bool = False) -> Endpoint:
    """Parse the text ``PROTOCOL/HOST:PORT``. ``secured``: whether certificates are given.

    Raises :class:`vinesim.core.errors.UsageError` for any other text, for protocols without TLS if ``secured``, and for
    protocols with TLS if not.
    """
    allowed = ("tls", "quic") if secured else ("tcp", "udp")
    protocol, _, address = text.partition("/")
    host, colon, port = address.rpartition(":")
    example = f"expected {allowed[0]}/HOST:PORT or {allowed[1]}/HOST:PORT, e.g. {allowed[0]}/192.168.1.5:{PORT}"
    if protocol in _COUNTERPART and protocol not in allowed:
        remedy = "use tls/ or quic/ where certificates are given" if secured else "give the certificates with --tls DIR"
        raise UsageError(f"endpoint {text!r}: {remedy}; {example}")
    if protocol not in allowed or not colon or not host or any(c in host for c in "?#;/ "):
        raise UsageError(f"endpoint {text!r}: {example}")
    if not port.isascii() or not port.isdigit() or int(port) > 65535:
        raise UsageError(f"endpoint {text!r}: port {port!r} is not from 0 to 65535; {example}")
    return Endpoint(protocol, host, int(port))


def default_listen(*, secured: bool = False, insecure: bool = False) -> tuple[str, ...]:
    """Returns the default endpoints of a server, for a stream and for datagrams.

    They are reachable from this machine only, unless the server is ``secured`` by certificates or the user allows it to
    be ``insecure``.
    """
    host = "0.0.0.0" if secured or insecure else "127.0.0.1"
    return tuple(f"{protocol}/{host}:{PORT}" for protocol in (("tls", "quic") if secured else ("tcp", "udp")))


def check_exposure(listen: Sequence[str], *, secured: bool = False, insecure: bool = False) -> None:
    """Raise :class:`vinesim.core.errors.UsageError` if any program on the network could join without a certificate.

    ``listen``: endpoints of the server. ``insecure``: whether the user allows this.
    """
    for text in listen:
        endpoint = parse(text, secured=secured)
        if not (endpoint.secured or endpoint.loopback or insecure):
            raise UsageError(
                f"--listen {endpoint}: any program that reaches it may publish under any name; give certificates "
                "(--tls DIR, see vinesim certs new), or --insecure if everyone on that network is trusted"
            )


class Links(NamedTuple):
    """The endpoints to which a client connects to reach its server."""

    bulk: Endpoint
    """Stream for events, queries, snapshots and everything large."""
    live: Endpoint | None
    """Datagrams for poses and states. None: the stream carries poses and states, too."""


def client_links(connect: str, *, secured: bool = False) -> Links:
    """Returns the links to the server at the endpoint ``connect``.

    To a server on this machine, a client uses only the stream, which is cheapest, unless the protocol is ``udp`` or
    ``quic``. To any other server it uses both links.
    """
    endpoint = parse(connect, secured=secured)
    if endpoint.datagrams:
        return Links(endpoint.counterpart, endpoint)
    return Links(endpoint, None if endpoint.loopback else endpoint.counterpart)


def resolve_ports(listen: Sequence[str], *, secured: bool = False) -> tuple[Endpoint, ...]:
    """Parse the endpoints of a server. Replaces port 0 by one number that is free for both streams and datagrams."""
    wanted = [parse(text, secured=secured) for text in listen]
    if not wanted:
        raise UsageError("a server that listens nowhere: give --listen at least once")
    free: int | None = None
    found = []
    for endpoint in wanted:
        if endpoint.port == 0:
            free = free or _free_port(endpoint.host)
            endpoint = endpoint._replace(port=free)
        found.append(endpoint)
    return tuple(found)


def can_listen(endpoint: Endpoint) -> bool:
    """Whether a server could listen at an endpoint now.

    Zenoh 1.10 may keep the socket of datagrams for 0.1 s after its session was closed.
    """
    family = socket.AF_INET6 if endpoint.host.startswith("[") else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM if endpoint.datagrams else socket.SOCK_STREAM) as probe:
        if not endpoint.datagrams:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((endpoint.host.strip("[]"), endpoint.port))
            if not endpoint.datagrams:
                probe.listen()
        except OSError:
            return False
        return True


def can_connect(endpoint: Endpoint, timeout: float = 1.0) -> bool:
    """Whether a program accepts connections at the endpoint of a stream. Waits up to ``timeout`` [s]."""
    try:
        socket.create_connection((endpoint.host.strip("[]"), endpoint.port), timeout).close()
    except OSError:
        return False
    return True


def _free_port(host: str) -> int:
    family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
    while True:
        with socket.socket(family, socket.SOCK_STREAM) as stream, socket.socket(family, socket.SOCK_DGRAM) as datagram:
            stream.bind((host.strip("[]"), 0))
            try:
                datagram.bind(stream.getsockname()[:2])
            except OSError:
                continue
            return stream.getsockname()[1]
