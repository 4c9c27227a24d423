"""``vinesim train``: trains a policy, and evaluates one."""

from __future__ import annotations

import contextlib
import math
import pathlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from vinesim.cli.signals import Interrupts
from vinesim.core.errors import UsageError, writing
from vinesim.core.progress import ProgressLine

if TYPE_CHECKING:
    from vinesim.learn.train import Progress

SAVE_PERIOD = 10.0
"""Time between two updates of the files of a training [s]."""
TRAINING_WORLDS = 4096
EVALUATION_WORLDS = 500
FULL_PHYSICS_WORLDS = 100
"""Default number of worlds of an evaluation with full physics, which takes them one after the other."""
TRAINING_ITERATIONS = 300
"""Default number of updates of a policy in a training."""


def run_training(
    task: str,
    out: pathlib.Path | None,
    worlds: int | None,
    *,
    device: str,
    seed: int,
    iterations: int,
    minutes: float | None,
    variation: pathlib.Path | None,
    full: bool,
) -> int:
    """Train, write the files into ``out``, and evaluate. Returns the exit code: 130 if Ctrl-C has ended it."""
    if out is None:
        raise UsageError("give --out FOLDER to train, or --evaluate FILE")
    if full:
        raise UsageError("--full-physics without --evaluate FILE: a training runs in batches")
    _check(task, device)
    from vinesim.learn.evaluate import evaluate
    from vinesim.learn.train import Rank, Training, require_libraries
    from vinesim.learn.variation import Variation

    require_libraries()
    count = worlds or TRAINING_WORLDS
    ranges = variation or Variation()
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    is_first = Rank.of_environment().number == 0  # the others only train
    note = "; the first start on a GPU compiles kernels for some minutes" if device != "cpu" else ""
    if is_first:
        print(f"making {count} worlds{note}", file=sys.stderr, flush=True)
    training = Training(task, count, device=device, seed=seed, variation=ranges)
    if is_first:
        training.save(out)  # a place that cannot be written is refused before the training
    limit = math.inf if minutes is None else 60.0 * minutes
    saved = time.monotonic()
    interrupted = False
    try:
        with Interrupts() as interrupts, ProgressLine() as line:
            for done in training.iterations(iterations):
                interrupts.check()
                if is_first:
                    line.show(_progress(done, iterations, limit))
                if is_first and time.monotonic() - saved > SAVE_PERIOD:
                    training.save(out)
                    saved = time.monotonic()
                if training.any_process(done.seconds > limit):
                    break
    except KeyboardInterrupt:
        interrupted = True
    if not is_first:
        return 130 if interrupted else 0
    training.save(out)
    if training.curve:
        last = training.curve[-1]
        print(
            f"trained  {last.iteration} iterations, {1e-6 * last.actions:.2f} million actions in {last.seconds:.0f} s; "
            f"{_share(last.success)} of the last episodes succeeded"
        )
    print(f"policy   {out / 'policy.npz'}", flush=True)
    if interrupted:
        return 130
    with _reporting() as report:
        result = evaluate(
            training.policy(), EVALUATION_WORLDS, seed=seed, device=device, variation=ranges, report=report
        )
    training.save(out, {"unseen_vines": result.fields()})
    print(f"unseen   {result.line()}")
    return 0


def run_evaluation(
    task: str,
    file: pathlib.Path,
    out: pathlib.Path | None,
    worlds: int | None,
    *,
    device: str,
    seed: int,
    variation: pathlib.Path | None,
    full: bool,
) -> int:
    """Evaluate the policy in ``file`` and print the result. Returns the exit code."""
    if out is not None:
        raise UsageError(f"--out {out} with --evaluate {file}: an evaluation writes no files; omit --out")
    _check(task, device)
    from vinesim.learn.evaluate import evaluate, evaluate_with_full_physics
    from vinesim.learn.policy import load_policy
    from vinesim.learn.variation import Variation

    policy = load_policy(file)
    if policy.task != task:
        raise UsageError(f"{file} is a policy for {policy.task}; run: vinesim train {policy.task} --evaluate {file}")
    ranges = variation or Variation()
    if full and device != "cpu":
        raise UsageError(f"--full-physics with --device {device}: it runs on the cpu; omit --device")
    with _reporting() as report:
        if full:
            count = worlds or FULL_PHYSICS_WORLDS
            result = evaluate_with_full_physics(policy, count, seed=seed, variation=ranges, report=report)
        else:
            count = worlds or EVALUATION_WORLDS
            result = evaluate(policy, count, seed=seed, device=device, variation=ranges, report=report)
    print(result.line())
    return 0


@contextlib.contextmanager
def _reporting() -> Iterator[Callable[[str], None]]:
    """Context of an evaluation, whose value shows its progress. Ctrl-C ends the evaluation, and prints how far it
    was."""
    last = ""

    def report(text: str) -> None:
        nonlocal last
        interrupts.check()
        last = text
        line.show(text)

    try:
        with Interrupts() as interrupts, ProgressLine() as line:
            yield report
    except KeyboardInterrupt:
        if last:
            print(f"interrupted  {last}", file=sys.stderr, flush=True)
        raise


def _check(task: str, device: str) -> None:
    """Raise an error of one line for an unknown task, a missing extra or device."""
    from vinesim.learn import TASKS
    from vinesim.plants.device_buffers import find_device

    if task not in TASKS:
        raise UsageError(f"no task {task!r}; give one of {', '.join(TASKS)}")
    find_device(device)


def _progress(done: Progress, iterations: int, limit: float) -> str:
    left = min(done.seconds / done.iteration * (iterations - done.iteration), limit - done.seconds)
    return (
        f"iteration {done.iteration} of {iterations}  reward of an action {done.mean_reward:7.3f}  "
        f"success {_share(done.success)}  faults {done.faults}  "
        f"{done.actions / max(done.seconds, 1e-9):,.0f} actions/s  {max(left, 0.0):.0f} s left"
    )


def _share(share: float) -> str:
    return "-" if math.isnan(share) else f"{100.0 * share:.1f} %"
