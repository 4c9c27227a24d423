"""Text that no file of the project may contain."""

import pathlib
import re
import subprocess

ROOT = pathlib.Path(__file__).parents[2]
FORBIDDEN = {
    "a registry's download address": re.compile(
        r"https?://(files\.)?(pypi|pythonhosted|registry\.npmjs|deb\.debian)\.", re.I
    ),
    "a path of one machine": re.compile(r"(?<![\w.])/(work|root|home/\w+)/"),
}


def text_files():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        path = ROOT / name
        if path.suffix not in {".png", ".jpg", ".stl", ".npz"} and path.is_file() and path != pathlib.Path(__file__):
            yield path


def test_no_addresses_and_no_machine_paths():
    found = [
        f"{path.relative_to(ROOT)}: {what}: {match.group(0)}"
        for path in text_files()
        for what, pattern in FORBIDDEN.items()
        for match in pattern.finditer(path.read_text(errors="replace"))
    ]
    assert not found


def test_files_are_small():
    big = [str(p.relative_to(ROOT)) for p in text_files() if p.stat().st_size > 1_000_000]
    assert not big
