"""The page's server, by real requests: what is new reaches a page, and no page is behind by more than the window."""

import asyncio
import json
import re
import socket
import ssl
import threading
import urllib.error
import urllib.parse
import urllib.request

import aiohttp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.waiting import deadline, wait
from vinesim.client.page import page_access
from vinesim.client.programs import free_port
from vinesim.core.errors import UsageError
from vinesim.web import page_files, page_token
from vinesim.web.page_input import decode_input
from vinesim.web.page_server import WINDOW, PageServer

HERE = [1.0, 2.0, 1.6, 0.0, 0.0, 0.0, 1.0]


class CountingWorld:
    """A world whose state is the number of its tick."""

    def __init__(self):
        self.tick = -1
        self.poses = []

    def scene(self):
        return b"scene"

    def plants(self, place):
        return str(place.tolist()).encode()

    def rigid(self):
        return b"rigid"

    def state(self, since, page):
        return (self.tick, str(self.tick).encode()) if self.tick > since else None

    def take(self, page, said):
        self.poses.append(list(said.view))

    def leave(self, page):
        pass


@pytest.fixture
def served():
    world = CountingWorld()
    with PageServer(world) as server:
        yield world, server


def advance(world, server, ticks):
    for _ in range(ticks):
        world.tick += 1
        server.notify()


async def settle(server, count):
    while server.states_sent < count:
        await asyncio.sleep(0.002)


def test_files_and_arrays_are_served(served):
    _, server = served
    for path, part in (("", b"<title>vinesim</title>"), ("main.js", b"import"), ("vendor/three.module.js", b"WebGL")):
        assert part in urllib.request.urlopen(server.address + path, timeout=deadline(10.0)).read()
    assert urllib.request.urlopen(server.address + "scene", timeout=deadline(10.0)).read() == b"scene"
    plants = urllib.request.urlopen(server.address + "plants?x=1.5&y=-2&z=1e1", timeout=deadline(10.0)).read()
    assert plants == b"[1.5, -2.0, 10.0]"
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(server.address + "..%2f..%2fpyproject.toml", timeout=deadline(10.0))


@pytest.mark.parametrize(
    "query", ["", "?x=1&y=2", "?x=1&y=2&z=nan", "?x=1&y=2&z=inf", "?x=1&y=2&z=1e6", "?x=1&y=2&z=b"]
)
def test_plants_around_no_place_are_refused(served, query):
    _, server = served
    with pytest.raises(urllib.error.HTTPError, match="400") as refused:
        urllib.request.urlopen(server.address + "plants" + query, timeout=deadline(10.0))
    assert b"give x, y and z in metres" in refused.value.read()


def test_a_page_that_stalls_gets_no_more_than_the_window_and_then_the_newest_state(served):
    world, server = served

    async def page():
        async with aiohttp.ClientSession() as session, session.ws_connect(server.address + "state") as socket:
            world.tick = 1
            server.notify()
            got = [int((await socket.receive()).data)]
            for _ in range(100):
                advance(world, server, 1)
                await asyncio.sleep(0.001)
            await settle(server, WINDOW)
            assert server.states_sent == WINDOW
            got.append(int((await socket.receive()).data))
            await socket.send_json({"drawn": got[-1], "view": HERE})
            got.append(int((await socket.receive()).data))
            return got

    got = asyncio.run(page())
    assert got[0] >= 1
    assert got == sorted(got)
    assert got[-1] == 101, "after the stall comes the newest state, not the one after the last"
    assert world.poses == [HERE]


@pytest.mark.parametrize(
    "message",
    [
        "no json",
        "[]",
        "{}",
        '{"drawn": 1}',
        '{"drawn": 1, "view": [1, 2]}',
        '{"drawn": 1, "view": "x"}',
        json.dumps({"drawn": 1, "view": [1e9, 0, 0, 0, 0, 0, 1]}),
        json.dumps({"drawn": 1, "view": [0, 0, 0, 0, 0, 0, 0]}),
        '{"drawn": 1, "view": [NaN, 0, 0, 0, 0, 0, 1]}',
        '{"drawn": 1e999, "view": [0, 0, 0, 0, 0, 0, 1]}',
        json.dumps({"drawn": 1, "view": HERE, "person": {"head": HERE, "left": {"pose": HERE, "closed": 1}}}),
        json.dumps({"drawn": 1, "view": HERE, "person": {"head": [0.0] * 7}}),
        json.dumps({"drawn": 1, "view": HERE, "more": 1}),
        "[" * 3000,
    ],
)
def test_what_is_no_message_of_a_page_is_counted_and_changes_nothing(served, message):
    world, server = served

    async def page():
        async with aiohttp.ClientSession() as session, session.ws_connect(server.address + "state") as socket:
            await socket.send_str(message)
            advance(world, server, 1)
            await socket.receive()
            while server.refused == 0:
                await asyncio.sleep(0.002)

    asyncio.run(page())
    assert server.refused == 1
    assert world.poses == []


@pytest.mark.parametrize("message", ["x" * 100_000, b"\x00\x01" * 100], ids=["huge", "binary"])
def test_a_message_of_a_wrong_size_or_kind_is_counted_and_others_are_served(served, message):
    world, server = served

    async def page():
        async with aiohttp.ClientSession() as session, session.ws_connect(server.address + "state") as socket:
            await (socket.send_str if isinstance(message, str) else socket.send_bytes)(message)
            while server.refused == 0:
                await asyncio.sleep(0.002)
        async with aiohttp.ClientSession() as session, session.ws_connect(server.address + "state") as socket:
            advance(world, server, 1)
            return (await socket.receive()).data

    assert int(asyncio.run(page())) == world.tick
    assert server.refused == 1
    assert world.poses == []


def _mutated(value, path, new):
    """A message with what lies at a ``path`` replaced."""
    if not path:
        return new
    inner = {**value} if isinstance(value, dict) else list(value)
    inner[path[0]] = _mutated(value[path[0]], path[1:], new)
    return inner


def _paths(value, path=()):
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in items:
        yield from _paths(part, (*path, key))


_HAND = {"pose": HERE, "closed": False, "fingers": [0.0] * 5}
_WHOLE = {"drawn": 3, "view": HERE, "person": {"head": HERE, "left": _HAND, "right": _HAND, "intention": "pick"}}
_WHOLE["person"]["shears"] = [False, True]
_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=40),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.text(max_size=9), inner, max_size=5),
    max_leaves=12,
)


@given(st.sampled_from(list(_paths(_WHOLE))), _JSON, st.integers(0, 400), st.text(max_size=3))
def test_whatever_a_page_sends_is_a_pose_within_bounds_or_nothing(path, new, place, inserted):
    """Every field replaced by anything; and the text cut or changed anywhere."""
    text = json.dumps(_mutated(_WHOLE, path, new))
    for given_text in (text, text[:place], text[:place] + inserted + text[place + 1 :]):
        said = decode_input(given_text)
        for pose in () if said is None else said.poses():
            assert np.isfinite(pose).all()
            assert np.abs(pose[:3]).max() <= 1e5
            assert np.linalg.norm(pose[3:]) == pytest.approx(1.0, abs=0.011)


def test_a_site_of_another_origin_is_refused(served):
    _, server = served
    request = urllib.request.Request(server.address + "scene", headers={"Origin": "http://example.org"})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request, timeout=deadline(10.0))


def test_a_site_that_gives_this_address_a_name_of_its_own_is_refused(served):
    """DNS rebinding: its pages would be of one origin with ours, and could move the person."""
    _, server = served
    for host in ("example.org", f"example.org:{server.port}"):
        request = urllib.request.Request(server.address + "scene", headers={"Host": host, "Origin": f"http://{host}"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(request, timeout=deadline(10.0))
    request = urllib.request.Request(server.address + "scene", headers={"Host": f"localhost:{server.port}"})
    assert urllib.request.urlopen(request, timeout=deadline(10.0)).read() == b"scene"


@pytest.mark.parametrize(
    "host",
    ["", "[", "[::1", "127.0.0.1:x", "127.0.0.1:99999999", "a b", "@", "\x7f", "\xe9", "x" * 5000, "127.0.0.1:-1"],
)
def test_a_malformed_host_header_is_refused_and_no_error_of_the_server(served, host):
    _, server = served
    path = server.address.split("/", 3)[3]
    with socket.create_connection(("127.0.0.1", server.port), deadline(10.0)) as client:
        client.sendall(f"GET /{path}scene HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode("latin-1"))
        answer = b""
        while part := client.recv(4096):
            answer += part
    assert re.match(rb"HTTP/1.[01] 4\d\d ", answer), answer[:100]
    assert get(server.address + "scene")[0] == 200


def test_two_pages_of_one_browser_work_side_by_side():
    """A browser sends the cookies of one port to all ports of a machine; pages set none. Each page has its own
    secret."""
    with PageServer(CountingWorld()) as one, PageServer(CountingWorld()) as other:
        for _ in range(2):
            for server in (one, other):
                status, headers, body = get(server.address + "scene")
                assert (status, body) == (200, "scene")
                assert "Set-Cookie" not in headers
        crossed = one.address.replace(f":{one.port}/", f":{other.port}/")
        assert get(crossed + "scene")[0] == 403


def test_nothing_is_loaded_from_another_host(served):
    """Browsers are told so, and the page's own sources name no other host."""
    _, server = served
    with urllib.request.urlopen(server.address, timeout=deadline(10.0)) as index:
        policy = dict(rule.split(" ", 1) for rule in index.headers["Content-Security-Policy"].split("; "))
    assert policy["default-src"] == "'self'"
    assert not any("http" in sources or "*" in sources for sources in policy.values())
    for path in page_files.PAGE.glob("*.*"):
        if path.suffix in (".js", ".html"):
            assert not re.search(r"""["'(=]\s*(https?:)?//\w""", path.read_text()), path


def test_a_port_that_is_taken_is_said(served):
    _, server = served
    with pytest.raises(UsageError, match=f"--page {server.port}: "), PageServer(CountingWorld(), server.port):
        pass


def test_viewers_come_and_go(served):
    _, server = served

    async def page():
        async with aiohttp.ClientSession() as session, session.ws_connect(server.address + "state"):
            wait(lambda: server.has_viewers, "the page is connected")

    assert not server.has_viewers
    asyncio.run(page())
    wait(lambda: not server.has_viewers, "the page is gone")


def test_other_machines_need_the_token_and_get_https(tmp_path, monkeypatch):
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path))
    monkeypatch.setattr(page_access, "own_address", lambda: "127.0.0.1")
    access = page_access.network_access()
    trusting = ssl.create_default_context(cafile=tmp_path / "page-certificate" / "ca.pem")
    with PageServer(CountingWorld(), 0, access.host, tls=access.tls, token=access.token) as server:
        plain = f"https://{access.host}:{server.port}/"
        assert server.address == f"{plain}{access.token}/"
        for path in ("", "scene", "main.js", "x/", "x/scene", f"{access.token[:-1]}/", "state"):
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(plain + path, timeout=deadline(10.0), context=trusting)
        with pytest.raises(urllib.error.HTTPError, match="400") as refusal:
            urllib.request.urlopen(plain.replace("https", "http"), timeout=deadline(10.0))
        assert "needs https" in refusal.value.read().decode(), "a sentence for plain http"
        for path, part in (("", b"vinesim"), ("scene", b"scene")):
            with urllib.request.urlopen(server.address + path, timeout=deadline(10.0), context=trusting) as answer:
                assert part in answer.read()


def get(address, **headers):
    """Status, headers and text of the answer to a request."""
    request = urllib.request.Request(address, headers={name.replace("_", "-"): one for name, one in headers.items()})
    try:
        with urllib.request.urlopen(request, timeout=deadline(10.0)) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as refusal:
        return refusal.code, refusal.headers, refusal.read().decode()


def test_on_this_machine_too_the_page_needs_its_whole_address(served):
    """Other users of the machine reach the port, but do not know the secret."""
    _, server = served
    bare = f"http://127.0.0.1:{server.port}/"
    for path in ("", "scene", "plants?x=0&y=0&z=0", "rigid", "state", "main.js", "x/scene", "%ff%00/scene", "\udcff/"):
        status, headers, text = get(bare + urllib.parse.quote(path, safe="/?=&%", errors="surrogateescape"))
        assert status == 403, path
        assert f"in a browser: {bare}" in text, "it is said where the whole address is printed"
    status, headers, text = get(bare, Accept="text/html,*/*")
    assert (status, headers.get_content_type()) == (403, "text/html")
    assert "<p>" in text
    assert headers["X-Frame-Options"] == "DENY"
    assert server.address.removeprefix(bare).removesuffix("/") not in text
    assert get(server.address.removesuffix("/"))[0] == 200, "the slash at the end may be missing"
    assert get(server.address.removesuffix("/"))[2] == get(server.address)[2]


def test_pages_of_one_machine_do_not_disturb_each_other():
    """Cookies are shared by all ports of a machine. So the secret is not in a cookie."""
    browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    with PageServer(CountingWorld()) as one, PageServer(CountingWorld()) as other:
        assert one.address.split("/")[3] != other.address.split("/")[3]
        for server in (one, other, one):
            for path in ("", "scene"):
                answer = browser.open(server.address + path, timeout=deadline(10.0))
                assert (answer.status, answer.headers["Set-Cookie"]) == (200, None)


def test_a_client_that_was_restarted_on_its_port_has_the_same_address(tmp_path, monkeypatch):
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path / "cache"))
    port = free_port()
    address = page_token.lasting_address(port)
    for _ in range(2):
        with PageServer(CountingWorld(), port) as server:
            assert server.address == address
            assert get(address + "scene")[0] == 200
    assert page_token.lasting_address(port + 1).split("/")[3] != address.split("/")[3]
    secret = tmp_path / "cache" / "page-secret"
    assert secret.stat().st_mode & 0o777 == 0o600, "no other user can read it"
    secret.chmod(0o644)
    assert page_token.lasting_address(port) != address, "a secret that others could read is replaced"
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path / "file" / "cache"))
    assert page_token.lasting_address(port) is None
    with PageServer(CountingWorld(), port) as server:
        assert get(server.address + "scene")[0] == 200, "the address is new, and the page works"


@pytest.mark.parametrize("in_notebook", [False, True])
def test_only_notebooks_of_this_machine_may_frame_a_page_and_only_one_made_for_them(in_notebook):
    with PageServer(CountingWorld(), in_notebook=in_notebook) as server:
        _, headers, _ = get(server.address, Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate")
    (ancestors,) = [
        rule.split(" ", 1)[1]
        for rule in headers["Content-Security-Policy"].split("; ")
        if rule.startswith("frame-ancestors ")
    ]
    if in_notebook:
        assert {"http://localhost:*", "http://127.0.0.1:*", "vscode-webview:"} < set(ancestors.split())
        assert not {"*", "http:", "https:"} & set(ancestors.split())
        assert headers["X-Frame-Options"] is None, "it would forbid all frames"
    else:
        assert ancestors == "'none'"
        assert headers["X-Frame-Options"] == "DENY"


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_requests_of_other_sites_are_refused_before_any_work(served, site):
    """Such as of <img src=...>, which have no Origin. A server on another port of this machine is "same-site"."""
    world, server = served
    world.scene = world.rigid = world.plants = None  # any work would fail with 500
    for path in ("scene", "rigid", "plants?x=0&y=0&z=0", "state", "main.js", ""):
        for mode in ("no-cors", "cors", "websocket"):
            status, _, text = get(server.address + path, Sec_Fetch_Site=site, Sec_Fetch_Mode=mode)
            assert status == 403, path
            assert "other sites" in text
    assert get(server.address, Sec_Fetch_Site=site, Sec_Fetch_Mode="navigate")[0] == 200, "a link to the page"
    assert get(server.address + "main.js", Sec_Fetch_Site="same-origin", Sec_Fetch_Mode="cors")[0] == 200


def test_only_files_of_the_page_are_served(served):
    _, server = served
    for name in (".npmrc", "package.json", "package-lock.json", ".gitignore", "vendor/LICENSE", "vendor/", "vendor"):
        assert get(server.address + name)[0] == 404, name
    folder = page_files.PAGE
    for path in (folder / ".npmrc", folder / "package.json"):
        assert path.is_file(), "the test asks for files that exist"
    for name in page_files.served():
        assert get(server.address + name)[0] == 200


def ask(port, head):
    """First line of the answer to the bytes of a request."""
    with socket.create_connection(("127.0.0.1", port), timeout=deadline(10.0)) as connection:
        connection.sendall(head)
        return connection.makefile("rb").readline().decode().strip()


@pytest.mark.parametrize(
    "hosts",
    [
        [],
        [b"127.0.0.1:{port}", b"127.0.0.1:{port}"],
        *(
            [one]
            for one in (
                b"",
                b":",
                b"[",
                b"[::1",
                b"]:80",
                b"a:b",
                b"a:99999",
                b"a b",
                b"a@b",
                b"a/b",
                b"\xff\xfe",
                b"::1",
            )
        ),
    ],
)
def test_a_malformed_host_is_a_bad_request(served, hosts, caplog):
    _, server = served
    path = server.address.split("/", 3)[3].encode()
    lines = [b"Host: " + host.replace(b"{port}", str(server.port).encode()) for host in hosts]
    for line in (path + b"scene", b"", b"scene"):
        request = b"\r\n".join([b"GET /" + line + b" HTTP/1.1", *lines, b"", b""])
        assert ask(server.port, request).split()[1] == "400", request
    assert caplog.records == [], "strangers do not fill the log"


def test_malformed_requests_do_not_fill_the_log(served, caplog):
    _, server = served
    for request in (
        b"\x16\x03\x01\r\n\r\n",
        b"GET\r\n\r\n",
        b"GET http://[/ HTTP/1.1\r\nHost: a\r\n\r\n",
        b"A" * 20_000,
    ):
        assert ask(server.port, request).split()[1] == "400", request
    assert get(server.address + "scene")[0] == 200
    assert caplog.records == []


def test_states_and_files_are_served_while_a_vineyard_is_laid_out(served):
    """The first layout of a large vineyard takes seconds."""
    world, server = served
    begun, finish = threading.Event(), threading.Event()

    def lay_out():
        begun.set()
        assert finish.wait(deadline(30.0))
        return b"scene"

    world.scene = lay_out

    async def page():
        loop = asyncio.get_running_loop()
        async with aiohttp.ClientSession() as session, session.ws_connect(server.address + "state") as socket:
            scene = loop.create_task(session.get(server.address + "scene"))
            try:
                while not begun.is_set():
                    await asyncio.sleep(0.002)
                advance(world, server, 1)
                assert (await socket.receive(timeout=deadline(10.0))).data == b"0"
                async with session.get(
                    server.address + "main.js", timeout=aiohttp.ClientTimeout(deadline(10.0))
                ) as file:
                    assert file.status == 200
                assert not scene.done()
            finally:
                finish.set()
            return await (await scene).read()

    assert asyncio.run(page()) == b"scene"
