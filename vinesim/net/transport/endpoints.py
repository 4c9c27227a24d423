"""Where a server listens and how a client reaches it: endpoints in words, and the two ways between them; pure.

``tcp`` and ``tls`` carry everything; ``udp`` and ``quic`` lie beside them, on the same port number, and carry what may
be lost (poses) at once instead of in line. ``tls`` and ``quic`` ask both ends for certificates.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from typing import NamedTuple

from vinesim.errors import UsageError

PORT = 7447
"""Zenoh's."""

_COUNTERPART = {"tcp": "udp", "udp": "tcp", "tls": "quic", "quic": "tls"}
_MIXED = {"udp": "?rel=1;mixed_rel=auto", "quic": "?mixed_rel=auto"}
"""One session over two links: a reliable one, and datagrams. Without ``rel=1`` udp would silently be lossy only."""


class Endpoint(NamedTuple):
    """One place to listen at or connect to."""

    protocol: str
    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.protocol}/{self.host}:{self.port}"

    @property
    def locator(self) -> str:
        """As Zenoh wants it."""
        return f"{self}{_MIXED.get(self.protocol, '')}"

    @property
    def datagrams(self) -> bool:
        """It carries what may be lost at once, instead of in line."""
        return self.protocol in _MIXED

    @property
    def secured(self) -> bool:
        """Both ends show certificates."""
        return self.protocol in ("tls", "quic")

    @property
    def loopback(self) -> bool:
        """It never leaves the machine."""
        try:
            return ipaddress.ip_address(self.host.strip("[]")).is_loopback
        except ValueError:
            return self.host == "localhost"

    @property
    def counterpart(self) -> Endpoint:
        """The other way to the same server: datagrams beside a stream and the reverse."""
        return self._replace(protocol=_COUNTERPART[self.protocol])


def parse(text: str, *, secured: bool = False) -> Endpoint:
    """``PROTOCOL/HOST:PORT``; :class:`UsageError` in words for anything else, or if it is not as safe as asked."""
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


def default_listen(*, secured: bool = False) -> tuple[str, ...]:
    """Where a server listens unless told otherwise: all interfaces, both ways."""
    return tuple(f"{protocol}/0.0.0.0:{PORT}" for protocol in (("tls", "quic") if secured else ("tcp", "udp")))


class Links(NamedTuple):
    """How one client reaches its server."""

    bulk: Endpoint
    """A stream: events, questions, snapshots, whatever is large."""
    live: Endpoint | None
    """Datagrams: poses and motion. None: they take the stream as well."""


def client_links(connect: str, *, secured: bool = False) -> Links:
    """To a server elsewhere both, on this machine a stream alone: cheapest; ``udp/`` or ``quic/`` asks for both."""
    endpoint = parse(connect, secured=secured)
    if endpoint.datagrams:
        return Links(endpoint.counterpart, endpoint)
    return Links(endpoint, None if endpoint.loopback else endpoint.counterpart)


def resolve_ports(listen: Sequence[str], *, secured: bool = False) -> tuple[Endpoint, ...]:
    """Endpoints to listen at, port 0 replaced by one number that is free for streams and datagrams alike."""
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
