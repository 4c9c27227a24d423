"""Picks by ROS alone, vineyard by vineyard: a client, examples/ros/pick_a_bunch.py as another process, and a check.

    python benchmarks/ros_pick.py --seeds 10

This third process asks the simulation by simulation_interfaces whether the bunch is in a box. It prints one JSON object
a line, as ``vinesim bench --json`` does, and takes about a minute of real time for a vineyard.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import time

import numpy as np

from vinesim.core import frames

ROOT = pathlib.Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "ros" / "pick_a_bunch.py"
HALF_BOX = (0.30, 0.20)
"""Half the inner length and width of a box of the scene harvest [m]."""
BOX_HEIGHT = 0.30
"""A bunch whose middle is higher than this is not in a box [m]."""
MIDDLE = 0.07
"""Distance from a bunch's upper end, its origin, to its middle [m]."""
TIMEOUT = 600.0
"""Time limit for one vineyard [s]."""


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=10, help="vineyards")
    parser.add_argument("--first", type=int, default=1, help="seed of the first vineyard")
    options = parser.parse_args()
    os.environ |= {"ROS_DOMAIN_ID": str(1 + os.getpid() % 100), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    succeeded = 0
    for seed in range(options.first, options.first + options.seeds):
        row = pick(seed)
        succeeded += bool(row["in_box"])
        report({"bench": "ros_pick", "case": f"harvest, seed {seed}", **row})
    report({"bench": "ros_pick", "case": "all", "value": succeeded, "of": options.seeds})
    return 0 if succeeded == options.seeds else 1


def report(row: dict[str, object]) -> None:
    """Print one JSON line."""
    sys.stdout.write(json.dumps(row) + "\n")
    sys.stdout.flush()


def pick(seed: int) -> dict[str, object]:
    """Run one vineyard with this ``seed``; return which bunches were tried, and whether one is in a box at the end."""
    command = [
        sys.executable,
        "-m",
        "vinesim",
        "client",
        "--role",
        "robot",
        "--scene",
        "harvest",
        "--seed",
        str(seed),
    ]
    began = time.monotonic()
    client = subprocess.Popen(
        [*command, "--sensor-hz", "0.2", "--status", "json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        picker = subprocess.run(
            [sys.executable, str(EXAMPLE)], capture_output=True, text=True, timeout=TIMEOUT, check=False
        )
        tried = re.findall(r"(bunch_\d+): \w+ hand", picker.stdout)
        said = picker.stdout.strip().splitlines()[-1:] or picker.stderr.strip().splitlines()[-1:]
        in_box = bool(tried) and lies_in_a_box(tried[-1])
    except subprocess.TimeoutExpired:
        tried = []
        said = ["timed out"]
        in_box = False
    finally:
        client.send_signal(signal.SIGINT)
        lines = client.communicate()[0].splitlines()
    status = next((json.loads(line) for line in reversed(lines) if line.startswith("{")), {})
    return {
        "in_box": in_box,
        "tried": len(tried),
        "said": said[0] if said else "",
        "s": round(time.monotonic() - began, 1),
        "tick_hz": round(status.get("tick_hz", 0.0), 2),
    }


def lies_in_a_box(bunch: str) -> bool:
    """Returns whether the simulation reports ``bunch`` between the walls of a box."""
    import rclpy

    from vinesim.ros.messages import message_packages

    message_packages.ensure_importable(["simulation_interfaces"])
    from simulation_interfaces.msg import EntityFilters
    from simulation_interfaces.srv import GetEntitiesStates

    rclpy.init()
    try:
        node = rclpy.create_node("judge")
        service = node.create_client(GetEntitiesStates, "/get_entities_states")
        service.wait_for_service(30.0)
        answer = service.call_async(GetEntitiesStates.Request(filters=EntityFilters(filter=f"^(box_.*|{bunch})$")))
        rclpy.spin_until_future_complete(node, answer, timeout_sec=30.0)
        found = answer.result()
        assert found is not None
        poses = {
            name: np.array(
                [
                    *(getattr(state.pose.position, a) for a in "xyz"),
                    *(getattr(state.pose.orientation, a) for a in "xyzw"),
                ]
            )
            for name, state in zip(found.entities, found.states, strict=True)
        }
        node.destroy_node()
    finally:
        rclpy.shutdown()
    middle = frames.compose(poses[bunch], frames.pose([MIDDLE, 0.0, 0.0]))
    inside = [frames.compose(frames.inverse(box), middle)[:3] for name, box in poses.items() if name != bunch]
    return any((np.abs(at[:2]) < HALF_BOX).all() and 0.0 < at[2] < BOX_HEIGHT for at in inside)


if __name__ == "__main__":
    sys.exit(main())
