"""Every test process has its own ROS domain with discovery on this host only; in CI a skipped test fails."""

from __future__ import annotations

import os
from collections.abc import Generator

import pytest

if "PYTEST_XDIST_WORKER" in os.environ or "ROS_DOMAIN_ID" not in os.environ:
    # also in a worker, which inherits the domain of the process that started it
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

SKIPS_FAIL = bool(os.environ.get("CI"))
"""In CI everything that tests need is installed, so a skip hides a missing part. Tests marked ``gpu`` may be
skipped."""


SLOW = (
    "tests/cli/test_", "tests/docs/", "tests/laws/", "tests/story/", "tests/bench/", "tests/client/test_humans.py",
    "tests/client/test_domain_randomizer.py", "tests/client/test_task_registry.py", "tests/net/test_replicator.py",
    "tests/net/test_faults.py", "tests/net/test_replication_laws.py", "tests/net/test_wire.py",
    "tests/net/test_zenoh_bus.py", "tests/robot/test_pick.py", "tests/robot/test_push.py",
    "tests/robot/test_swap_boxes.py", "tests/scene/test_vineyard.py", "tests/sensors/test_camera_raster.py",
    "tests/sensors/test_cuda_rasterizer.py", "tests/sensors/test_dataset.py",
    "tests/sensors/test_taichi_rasterizer.py", "tests/test_examples.py",
)  # fmt: skip
"""Files and folders that ``make check`` leaves out: each takes more than about ten seconds."""


@pytest.hookimpl(wrapper=True)  # else xdist reads the groups before they are there
def pytest_collection_modifyitems(items: list[pytest.Function]) -> Generator[None]:
    for item in items:
        if item.nodeid.startswith(SLOW):
            item.add_marker("slow")
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
