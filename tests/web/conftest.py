"""One browser for all tests of the page, which pytest-xdist runs in one process (``xdist_group("browser")``)."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from benchmarks.support.browser import Page, browser_page


@pytest.fixture(scope="session")
def browser() -> Iterator[Page]:
    """Its page, as the test before has left it."""
    with browser_page() as page:
        yield page


@pytest.fixture
def page(browser: Page) -> Iterator[Page]:
    """Its page, blank before the test and after it: a vineyard that nobody looks at is not drawn."""
    yield browser
    browser.open("about:blank")
    browser.call("Emulation.clearDeviceMetricsOverride")
    browser.call("Network.clearBrowserCookies")  # a page remembers by a cookie that its user knows the first steps
