"""Every test process has its own ROS domain with discovery on this host only, and ends what it has started; in CI a
skipped test fails."""

from __future__ import annotations

import multiprocessing
import multiprocessing.forkserver
import os
from collections.abc import Generator, Iterator

import hypothesis
import pytest
import warp as wp

from tests.support import layouts, orphans

if "PYTEST_XDIST_WORKER" in os.environ or "ROS_DOMAIN_ID" not in os.environ:
    # also in a worker, which inherits the domain of the process that started it
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
orphans.end_with_this_process()

hypothesis.settings.register_profile("test", max_examples=25, deadline=None)
hypothesis.settings.register_profile("test-long", max_examples=300, deadline=None)
hypothesis.settings.load_profile("test")

SKIPS_FAIL = bool(os.environ.get("CI"))
"""In CI everything that tests need is installed, so a skip hides a missing part. Tests marked ``gpu`` may be
skipped."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--check-bounds", action="store_true", help="compile kernels with checks of array bounds; a wrong index aborts"
    )


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--check-bounds"):
        wp.config.mode = "debug"


@pytest.hookimpl(wrapper=True)  # else xdist reads the groups before they are there
def pytest_collection_modifyitems(items: list[pytest.Function]) -> Generator[None]:
    for item in items:
        if item.get_closest_marker("xdist_group"):
            continue
        fixtures = item._fixtureinfo.name2fixturedefs.values()
        if any(one.scope in ("module", "class") for found in fixtures for one in found):
            # tests that share such a fixture run in one process, which sets it up once
            item.add_marker(pytest.mark.xdist_group(item.nodeid.split("::")[0]))
    from vinesim.ros import middleware

    reason = middleware.unavailable_reason()
    if reason:
        skip = pytest.mark.skip(reason=f"ROS 2 is not usable here: {reason}")
        for item in items:
            if "ros" in item.keywords:
                item.add_marker(skip)
    yield


@pytest.fixture(scope="session", autouse=True)
def processes_share_their_imports() -> Iterator[None]:
    """The processes that a client starts are forked from one that has imported what they need: 1 to 2 s less each.

    Real starts are the subject of tests/client/test_spawned_process.py, and clients of the command line have them.
    """
    from vinesim.client.processes import worker_process

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*worker_process.sensor_modules(ros=False), "vinesim.scene.generation.vineyard"])
    worker_process.CONTEXT = context
    yield
    multiprocessing.forkserver._forkserver._stop()


@pytest.fixture(scope="module", params=layouts.LAYOUTS)
def layout(request: pytest.FixtureRequest) -> Iterator[str]:
    """Where the batches of worlds of a file run; see :mod:`tests.support.layouts`."""
    with pytest.MonkeyPatch.context() as patch:
        layouts.apply(request.param, patch)
        yield request.param


def _fail_if_skipped(report: pytest.TestReport | pytest.CollectReport) -> None:
    if SKIPS_FAIL and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"skipped in CI, where nothing may be missing: {reason}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo):
    report = yield
    if "gpu" not in item.keywords:
        _fail_if_skipped(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector):
    report = yield
    _fail_if_skipped(report)
    return report
