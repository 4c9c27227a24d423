"""Runs all checks of ``vinesim doctor`` and prints the findings."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence

import msgspec

from vinesim.cli.doctor import machine, software
from vinesim.cli.doctor.finding import ERROR, OK, WARNING, Finding

CHECKS: tuple[Callable[[], Finding], ...] = (
    software.python,
    software.packages,
    machine.cpu,
    machine.gpu,
    software.ros,
    software.page,
    software.certificates,
    machine.ports,
    machine.shared_memory,
    machine.datagrams,
    machine.clock,
    software.caches,
)


def diagnose(checks: Sequence[Callable[[], Finding]] = CHECKS) -> list[Finding]:
    """Returns the findings of all checks. A check that raises an exception yields an error, and the other checks still
    run."""
    found = []
    for check in checks:
        try:
            found.append(check())
        except Exception as fault:
            text = " ".join(f"{type(fault).__name__}: {fault}".split())
            found.append(Finding(check.__name__.replace("_", " "), ERROR, f"the check failed with {text}"))
    return found


def run(as_json: bool, checks: Sequence[Callable[[], Finding]] = CHECKS) -> int:
    """Print one line for each check, or all findings as one JSON object. Returns the exit code."""
    findings = diagnose(checks)
    is_ready = all(each.state != ERROR for each in findings)
    if as_json:
        print(json.dumps({"ready": is_ready, "checks": msgspec.to_builtins(findings)}))
        return int(not is_ready)
    for each in findings:
        print(each.line)
    counts = ", ".join(f"{sum(each.state == state for each in findings)} {state}" for state in (OK, WARNING, ERROR))
    print(f"{counts}: " + ("a client can run here" if is_ready else "fix the errors first"))
    return int(not is_ready)
