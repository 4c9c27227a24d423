"""How other machines open a page: the address as a QR code in the terminal."""

import io
import sys

import cv2
import numpy as np
import pytest

from vinesim.client.page.page_access import print_code

ADDRESS = "https://192.168.1.23:8443/?token=Zx3-7f_QwErTyUiOpAsDfG"
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
