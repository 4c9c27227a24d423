"""Shows the vineyard of a client in a browser or in a cell of a notebook."""

from __future__ import annotations

import html
from collections.abc import Callable

from vinesim.client.client import Client
from vinesim.client.page.page_world import PageWorld
from vinesim.web import page_files
from vinesim.web.page_server import PageServer


class Page:
    """Live view of a client's vineyard in a browser. A notebook shows the view in a cell that ends with this object.

    A page needs ``pip install 'vinesim[web]'`` and a browser on the same machine. The view changes only while the
    client steps.
    """

    height = 480
    """Height of the view in a cell of a notebook [px]."""

    def __init__(self, client: Client, port: int = 0) -> None:
        """Start serving the view of a client; ``port`` 0: any free port.

        Raises :class:`UsageError` if the port is taken or the files of the page are missing.
        """
        page_files.check()
        world = PageWorld(client)
        self._server = PageServer(world, port, in_notebook=True)
        self._server.__enter__()
        self._posts = client.post_step
        self._collect: Callable[[Client], None] = lambda _: world.collect(self._server)
        self._posts.append(self._collect)

    @property
    def address(self) -> str:
        """Address to open in a browser on this machine. It contains a secret: only who knows it can open the page."""
        return self._server.address

    def close(self) -> None:
        """Stop serving; further calls do nothing."""
        if self._collect in self._posts:
            self._posts.remove(self._collect)
            self._server.__exit__()

    def __repr__(self) -> str:
        return f"Page({self.address})"

    def _repr_html_(self) -> str:
        return (
            f'<iframe src="{html.escape(self.address)}?rate=30" width="100%" height="{self.height}" '
            'style="border: 0" allow="fullscreen; xr-spatial-tracking; microphone"></iframe>'
        )
