"""Other sites in the same browser: a notebook may frame the page of its cell, others neither frame a page nor load what
it shows."""

import contextlib
import http.server
import threading

import pytest

from tests.support.waiting import wait
from tests.web.test_page_server import CountingWorld
from vinesim.web.page_server import PageServer


class SiteWorld(CountingWorld):
    """A world that counts what is made for pages."""

    made = 0

    def scene(self):
        self.made += 1
        return super().scene()

    def plants(self, place):
        self.made += 1
        return super().plants(place)


@contextlib.contextmanager
def site(content):
    """Serve a page of another site, as a notebook does; yields its address."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(content.encode())

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f":{server.server_address[1]}/"
        finally:
            server.shutdown()
            thread.join()


FRAME = (
    """<!doctype html><script>window.loaded = 0</script><iframe src="{address}" onload="++window.loaded"></iframe>"""
)


@pytest.mark.slow
@pytest.mark.xdist_group("browser")
@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_a_notebook_shows_the_page_of_its_cell_and_no_site_shows_another_page(page, host):
    """In the frame the page's own requests need the secret, too; a cookie would not reach them from localhost."""
    with PageServer(SiteWorld(), in_notebook=True) as cell, site(FRAME.format(address=cell.address)) as notebook:
        page.open(f"http://{host}{notebook}")
        wait(lambda: cell._world.made, "the framed page loads its vineyard")
    with PageServer(SiteWorld()) as server, site(FRAME.format(address=server.address)) as other:
        page.open(f"http://{host}{other}")
        wait(lambda: page.run("window.loaded"), "the browser has decided about the frame")
        assert server._world.made == 0


@pytest.mark.slow
@pytest.mark.xdist_group("browser")
@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_a_site_that_knows_the_address_loads_nothing_from_it(page, host):
    with PageServer(SiteWorld()) as server, site("<!doctype html>") as other:
        page.open(f"http://{host}{other}")
        tried = ["plants?x=0&y=0&z=0", "scene", "vendor/three.module.js"]
        result = page.run(
            f"""Promise.all({tried}.map((path) => Promise.all([
              new Promise((end) => {{
                const picture = new Image();
                picture.onload = picture.onerror = end;
                picture.src = {server.address!r} + path;
              }}),
              fetch({server.address!r} + path, {{ mode: "no-cors" }}).catch(() => 0),
              new Promise((end) => {{
                const socket = new WebSocket({server.address!r}.replace("http", "ws") + "state");
                socket.onopen = () => end("open");
                socket.onclose = () => end("closed");
              }}),
            ]))).then((all) => all.map((one) => one[2]))"""
        )
        assert result == ["closed"] * len(tried)
        assert server._world.made == 0
        assert not server.has_viewers
