"""Every test runs with a ROS domain of its own and discovery on this host only; in CI a skipped test has failed."""

from __future__ import annotations

import os

import pytest

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

SKIPS_FAIL = bool(os.environ.get("CI"))
"""In CI everything that tests need is installed, so a skip hides a missing part. Tests marked ``gpu`` may be skipped."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    from vinesim.ros import ros_setup

    reason = ros_setup.unavailable_reason()
    if reason:
        skip = pytest.mark.skip(reason=f"ROS 2 is not usable here: {reason}")
        for item in items:
            if "ros" in item.keywords:
                item.add_marker(skip)


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
