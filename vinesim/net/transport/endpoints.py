"""Endpoints of servers and clients as text, and the two links between a client and a server: a stream and datagrams.
All functions but those that look for free ports are pure.

``tcp`` and ``tls`` carry everything. ``udp`` and ``quic`` use the same port number and carry best-effort messages
(poses) without head-of-line blocking. ``tls`` and ``quic`` need certificates on both sides.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from typing import NamedTuple

from vinesim.core.errors import UsageError

PORT = 7447
"""Default port of Zenoh."""

_COUNTERPART = {"tcp": "udp", "udp": "tcp", "tls": "quic", "quic": "tls"}
_MIXED = {"udp": "?rel=1;mixed_rel=auto", "quic": "?mixed_rel=auto"}
"""Options for one session over two links: a reliable one, and datagrams. Without ``rel=1`` udp would be lossy only."""


class Endpoint(NamedTuple):
    """An address to listen on or to connect to."""

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
        """Whether it carries best-effort messages as datagrams."""
        return self.protocol in _MIXED

    @property
    def secured(self) -> bool:
        """Whether both sides show certificates."""
        return self.protocol in ("tls", "quic")

    @property
    def loopback(self) -> bool:
        """Whether it stays on this machine."""
        try:
            return ipaddress.ip_address(self.host.strip("[]")).is_loopback
        except ValueError:
            return self.host == "localhost"

    @property
    def counterpart(self) -> Endpoint:
        """The other link to the same server: datagrams for a stream and vice versa."""
        return self._replace(protocol=_COUNTERPART[self.protocol])


def parse(text: str, *, secured: bool = False) -> Endpoint:
    """Parse the text ``PROTOCOL/HOST:PORT``. Raises :class:`vinesim.core.errors.UsageError` for anything else and, if
    ``secured``, for a protocol without TLS."""
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
    """Default endpoints of a server, a stream and datagrams. They listen on this machine only, or on all interfaces if
    the server is ``secured`` by certificates or allowed to be ``insecure``."""
    host = "0.0.0.0" if secured or insecure else "127.0.0.1"
    return tuple(f"{protocol}/{host}:{PORT}" for protocol in (("tls", "quic") if secured else ("tcp", "udp")))


def check_exposure(listen: Sequence[str], *, secured: bool = False, insecure: bool = False) -> None:
    """Raise :class:`vinesim.core.errors.UsageError` if anyone on the network could join without a check."""
    for text in listen:
        endpoint = parse(text, secured=secured)
        if not (endpoint.secured or endpoint.loopback or insecure):
            raise UsageError(
                f"--listen {endpoint}: any program that reaches it may publish under any name; give certificates "
                "(--tls DIR, see vinesim certs new), or --insecure if everyone on that network is trusted"
            )


class Links(NamedTuple):
    """How one client reaches its server."""

    bulk: Endpoint
    """A stream: events, queries, snapshots, everything large."""
    live: Endpoint | None
    """Datagrams: poses and states. None: poses and states use the stream, too."""


def client_links(connect: str, *, secured: bool = False) -> Links:
    """Both links to a remote server. To a server on this machine only the stream, which is the cheapest, unless the
    protocol ``udp/`` or ``quic/`` asks for both."""
    endpoint = parse(connect, secured=secured)
    if endpoint.datagrams:
        return Links(endpoint.counterpart, endpoint)
    return Links(endpoint, None if endpoint.loopback else endpoint.counterpart)


def resolve_ports(listen: Sequence[str], *, secured: bool = False) -> tuple[Endpoint, ...]:
    """Endpoints to listen on. Port 0 is replaced by one number that is free for both streams and datagrams."""
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
    """Whether no socket listens at an endpoint. Zenoh 1.10 may release the socket of datagrams 0.1 s after its
    session."""
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
