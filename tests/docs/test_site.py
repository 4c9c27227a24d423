"""The documentation site builds without a warning, and its pages ask no other host for anything."""

import html.parser
import os
import pathlib
import re
import subprocess
import sys

import pytest

pytestmark = pytest.mark.long

ROOT = pathlib.Path(__file__).parents[2]
LOADED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src", "video": "src"}
"""Elements that a browser loads without being asked, and the attribute that says from where."""


class Loaded(html.parser.HTMLParser):
    """Addresses that a page loads, ids that it has, and local pages that it links to."""

    def __init__(self, path: pathlib.Path) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.linked: list[str] = []
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        if tag in LOADED and LOADED[tag] in given:
            self.loaded.append(given[LOADED[tag]])
        if tag == "a" and "href" in given:
            self.linked.append(given["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stdout + done.stderr
    return folder


def test_every_page_is_there_and_every_local_link_leads_somewhere(site):
    pages = sorted(site.rglob("*.html"))
    sources = {path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")}
    built = {path.relative_to(site) for path in pages}
    names = {path.with_name("index.md" if path.name == "README.md" else path.name) for path in sources}
    assert {path.with_suffix(".html") for path in names} <= built
    dead = []
    for page in pages:
        if page.name == "404.html":
            continue  # its links begin at the root of a server
        read = Loaded(page)
        for address in read.linked + read.loaded:
            path = address.partition("#")[0].partition("?")[0]
            if not path or re.match(r"[a-z]+:", address):
                continue
            if not (page.parent / path).exists():
                dead.append(f"{page.relative_to(site)}: {address}")
    assert dead == []


def test_pages_load_nothing_from_other_hosts(site):
    for page in sorted(site.rglob("*.html")):
        foreign = [address for address in Loaded(page).loaded if re.match(r"([a-z]+:)?//", address)]
        assert foreign == [], page
    for sheet in site.rglob("*.css"):
        assert re.findall(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//", sheet.read_text()) == [], sheet


def test_the_list_of_decisions_is_complete(site):
    listed = Loaded(site / "decisions" / "index.html").linked
    for page in (ROOT / "docs" / "decisions").glob("*.md"):
        assert page.name == "README.md" or f"{page.stem}.html" in listed, page


def test_the_reference_has_every_public_name(site):
    import vinesim
    import vinesim.tune

    text = (site / "reference.html").read_text()
    names = [name for name in (*vinesim.__all__, *vinesim.tune.__all__) if not name.startswith("_")]
    assert [name for name in names if not re.search(rf'id="[\w.]*\b{name}"', text)] == []
