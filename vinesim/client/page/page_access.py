"""Access to a page from other machines on the network: by https and with a token.

Browsers allow headsets and microphones only on https pages. Anyone on the network could open a page without a token,
and would then control the person.
"""

from __future__ import annotations

import dataclasses
import ipaddress
import logging
import shutil
import socket
import ssl
import sys

from vinesim.core import disk_cache
from vinesim.net.transport import certificates
from vinesim.net.transport.access_control import SERVER, Role, authority_folder
from vinesim.web.page_token import new_token

log = logging.getLogger(__name__)

_ELSEWHERE = ("192.0.2.1", 9)
"""An address that no machine has (RFC 5737). The route to it reveals the address of this machine; nothing is sent."""
PRIVATE = (
    "127.0.0.0/8",
    "10.0.0.0/8",
    "172.16.0.0/12",
    "192.168.0.0/16",
    "169.254.0.0/16",
    "::1/128",
    "fc00::/7",
    "fe80::/10",
)
"""Networks that are not part of the internet (RFC 1918, 3927, 4193 and 4291)."""


@dataclasses.dataclass(frozen=True, slots=True)
class NetworkAccess:
    """Settings of a page's server for access from other machines."""

    host: str
    """Address of this machine in its network."""
    tls: ssl.SSLContext
    token: str
    """Secret in the address of the page; it is new in every run."""


def network_access() -> NetworkAccess:
    """Returns the settings for access at the address under which the network reaches this machine.

    The certificate is signed by this machine's own authority, which is stored in the folder for caches. Browsers warn
    once about the certificate, or never if the authority's ``ca.pem`` is installed. A browser that has installed it
    trusts whoever has the authority's key, so the authority may sign for this machine's names and for private networks
    only, and is made anew if those change or if it was made without limits. Raises
    :class:`certificates.CryptographyMissing`.
    """
    host = own_address()
    folder = disk_cache.folder() / "page-certificate"
    permitted = _permitted(host)
    with disk_cache.exclusive("page-certificate"):
        if not certificates.may_sign_only_for(folder, permitted):
            if folder.exists():
                log.warning("the page has a new certificate authority: install %s/ca.pem again in browsers", folder)
            for each in (folder, authority_folder(folder)):
                shutil.rmtree(each, ignore_errors=True)
        certificates.create(folder, SERVER, Role.SERVER, (host,), permitted=permitted)
    tls = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    tls.load_cert_chain(folder / f"{SERVER}.pem", folder / f"{SERVER}.key")
    return NetworkAccess(host, tls, new_token())


def _permitted(host: str) -> tuple[str, ...]:
    """Returns the names, addresses and networks for which the page's authority may sign; ``host``: this machine's
    address in its network."""
    address = ipaddress.ip_address(host)
    is_private = any(address in ipaddress.ip_network(one) for one in PRIVATE)
    return ("localhost", socket.gethostname(), *PRIVATE, *([] if is_private else [host]))


def own_address() -> str:
    """Returns the address of this machine in its network; 127.0.0.1 without a network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(_ELSEWHERE)
        except OSError:
            return "127.0.0.1"
        return str(probe.getsockname()[0])


def print_code(address: str) -> None:
    """Show an address as a QR code on standard error, if that is a terminal and segno is installed."""
    if not sys.stderr.isatty():
        return
    try:
        import segno
    except ImportError:
        return
    segno.make(address).terminal(out=sys.stderr, compact=True)
