"""How other machines open a page: the address as a QR code in the terminal, and a certificate."""

import contextlib
import io
import pathlib
import shutil
import socket
import ssl
import sys

import cv2
import numpy as np
import pytest

from vinesim.client.page import page_access
from vinesim.client.page.page_access import print_code
from vinesim.net.transport import certificates
from vinesim.net.transport.access_control import SERVER, Role, authority_folder

ADDRESS = "https://192.168.1.23:8443/57ed42fae165308acbcd5871e17f500f/"
HALVES = {" ": (0, 0), "\u2580": (1, 0), "\u2584": (0, 1), "\u2588": (1, 1)}
"""Whether the upper and the lower half of a character are light."""


class Terminal(io.StringIO):
    """Standard error of a terminal."""

    def isatty(self) -> bool:
        return True


def test_the_code_in_a_terminal_is_read_by_a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    print_code(ADDRESS)
    rows = [np.array([HALVES[one] for one in line]).T for line in terminal.getvalue().splitlines() if line]
    picture = np.kron(255 * np.concatenate(rows).astype(np.uint8), np.ones((8, 8), np.uint8))
    found, *_ = cv2.QRCodeDetector().detectAndDecode(picture)
    assert found == ADDRESS


def test_a_file_gets_no_code(monkeypatch: pytest.MonkeyPatch) -> None:
    file = io.StringIO()
    monkeypatch.setattr(sys, "stderr", file)
    print_code(ADDRESS)
    assert file.getvalue() == ""


@pytest.fixture
def folder(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    """The folder of the page's certificates on a machine with a private address."""
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path))
    monkeypatch.setattr(page_access, "own_address", lambda: "192.168.1.23")
    return tmp_path / "page-certificate"


def is_trusted(folder: pathlib.Path, host: str, asked: str) -> bool:
    """Whether a program that trusts the page's authority trusts a server of the name ``asked`` with a certificate for
    ``host`` that the authority's key has signed."""
    thief = folder.parent / f"thief-{host.replace(':', '-')}"
    if not thief.exists():
        thief.mkdir()
        shutil.copy(folder / "ca.pem", thief)
        certificates.create(thief, SERVER, Role.SERVER, (host,), authority=authority_folder(folder))
    server_side = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    server_side.load_cert_chain(thief / "server.pem", thief / "server.key")
    client_side = ssl.create_default_context(cafile=folder / "ca.pem")
    ends = [ssl.MemoryBIO() for _ in range(4)]
    client = client_side.wrap_bio(ends[0], ends[1], server_hostname=asked)
    server = server_side.wrap_bio(ends[2], ends[3], server_side=True)
    is_done = False
    for _ in range(8):
        try:
            client.do_handshake()
            is_done = True
        except ssl.SSLWantReadError:
            pass
        except ssl.SSLCertVerificationError:
            return False
        ends[2].write(ends[1].read())
        with contextlib.suppress(ssl.SSLWantReadError, ssl.SSLError):
            server.do_handshake()
        ends[0].write(ends[3].read())
        if is_done:
            return True
    raise AssertionError("the handshake does not end")


def test_the_authority_vouches_for_this_machine_and_private_networks_only(folder: pathlib.Path) -> None:
    """A browser that has installed it is not deceived by a stolen key about sites of the internet."""
    page_access.network_access()
    for host in ("192.168.1.23", "10.0.0.7", "127.0.0.1", "::1", "fd00::1", "localhost", socket.gethostname()):
        assert is_trusted(folder, host, host), host
    for host in ("example.org", "bank.example", "198.51.100.7", "11.0.0.1", "2001:db8::1"):
        assert not is_trusted(folder, host, host), host


def test_the_authority_lasts_while_its_limits_fit_and_one_without_limits_is_replaced(
    folder: pathlib.Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    certificates.create(folder, SERVER, Role.SERVER, ("192.168.1.23",))
    assert is_trusted(folder, "example.org", "example.org"), "as before"
    unlimited = (folder / "ca.pem").read_bytes()
    page_access.network_access()
    limited = (folder / "ca.pem").read_bytes()
    assert limited != unlimited
    assert "install" in caplog.text, "it is said that browsers need the new one"
    monkeypatch.setattr(page_access, "own_address", lambda: "10.1.2.3")
    page_access.network_access()
    assert (folder / "ca.pem").read_bytes() == limited, "another private network needs no new authority"
    monkeypatch.setattr(page_access, "own_address", lambda: "198.51.100.7")
    page_access.network_access()
    assert (folder / "ca.pem").read_bytes() != limited
    assert is_trusted(folder, "198.51.100.7", "198.51.100.7")
    assert not is_trusted(folder, "198.51.100.8", "198.51.100.8")
