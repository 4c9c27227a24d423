"""Every test runs with a ROS domain of its own and discovery on this host only; what it starts ends with it."""

import os

import pytest

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def pytest_collection_modifyitems(items):
    from vinesim.ros import ros_setup

    reason = ros_setup.unavailable_reason()
    if reason:
        skip = pytest.mark.skip(reason=f"ROS 2 is not usable here: {reason}")
        for item in items:
            if "ros" in item.keywords:
                item.add_marker(skip)
