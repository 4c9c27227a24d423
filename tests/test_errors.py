"""Files that cannot be written: one line that names the place and the reason, exit code 5, other results kept."""

from __future__ import annotations

import json
import pathlib
import sys

import numpy as np
import pytest

from tests.support import programs
from tests.support.waiting import deadline
from vinesim.cli.client_session import save_report
from vinesim.cli.demo.progress import PICKER
from vinesim.cli.demo.summary import write_summary
from vinesim.core.errors import WriteError, writing

FULL = pathlib.Path("/dev/full")
pytestmark = pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")


def test_what_cannot_be_written_is_one_line_and_exit_code_5(tmp_path):
    full = tmp_path / "full.npz"
    full.symlink_to(FULL)
    message = r"full\.npz cannot be written: No space left on device; make room"
    with pytest.raises(WriteError, match=message) as said, writing(full):
        np.savez(full, numbers=np.zeros(100_000))
    assert said.value.exit_code == 5
    assert "\n" not in str(said.value)


def test_a_reader_of_standard_output_that_is_gone_is_no_matter_of_files():
    with pytest.raises(BrokenPipeError), writing("stdout"):
        raise BrokenPipeError


def test_a_report_on_a_full_disk_leaves_the_former_one(tmp_path):
    save_report(tmp_path, {"run": 1})
    (tmp_path / "report.json.part").symlink_to(FULL)
    with pytest.raises(WriteError, match=r"report\.json cannot be written: No space left on device"):
        save_report(tmp_path, {"run": 2})
    assert json.loads((tmp_path / "report.json").read_text()) == {"run": 1}


def test_a_summary_is_written_before_pictures_that_find_no_room(tmp_path):
    (tmp_path / PICKER).mkdir()
    (tmp_path / PICKER / "rgb.png").write_bytes(b"picture")
    (tmp_path / "rgb.png").symlink_to(FULL)
    with pytest.raises(WriteError, match="No space left on device"):
        write_summary(tmp_path, {"picked": True})
    assert json.loads((tmp_path / "summary.json").read_text()) == {"picked": True}


@pytest.mark.parametrize("role", ["robot", "human", "spectator"])
def test_a_client_whose_folder_cannot_be_made_says_so_at_once(role, tmp_path):
    (tmp_path / "file").write_text("")
    command = [sys.executable, "-m", "vinesim", "client", "--role", role, "--out", str(tmp_path / "file" / "out")]
    done = programs.run(command, timeout=deadline(300.0))
    assert done.returncode == 5
    assert done.stderr.splitlines()[-1].startswith(f"vinesim: {tmp_path / 'file' / 'out'} cannot be written: Not a dir")
    assert "Traceback" not in done.stderr
