"""``python -m benchmarks pruning``: prunes a dormant vine of scene ``winter_spur`` by rule, in simulated time.

Each seed is a vineyard; the robot prunes the vine nearest to its start place, with poses of canes from the simulation
(``--by cameras``: :mod:`benchmarks.seen_pruning`).
Measured are the cuts that were made, their distance from the wanted places, other canes that were cut, the largest
force on a bud of the kept spurs, and the seconds. ``--record FILE`` keeps a line of JSON for each seed, so that a long
run can be continued. ``--jobs N`` runs seeds in N processes.
"""

from __future__ import annotations

import collections
import functools
import math
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from benchmarks.seen_pruning import prune_seen, seen_measurements
from benchmarks.support.seed_runs import SeedRuns
from vinesim.api.picking import ROBOT
from vinesim.client.tasks.pruning import PruningRule, plan_pruning
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.contact.bud_forces import bud_forces
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.prune import PruneCanes, PruneStop
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene, with_seed
from vinesim.scene.values import Measurement
from vinesim.world import Physics

SCENE = "winter_spur"
LARGEST_ERROR = 0.010
"""[m] Distance from the wanted place up to which a cut counts as right."""
LARGEST_FORCE = 5.0
"""[N] Force on a kept bud above which it counts as damaged."""


def pruning(
    by: str,
    seeds: Sequence[int],
    spurs: int,
    record: pathlib.Path | None,
    jobs: int,
    announce: Callable[[str], None],
) -> Iterator[Measurement]:
    """Measure cuts, kept canes and buds, and seconds. ``by``: what the robot knows of the plants, "truth" or "cameras".
    ``spurs``: largest number of spurs of each vine, 0: all. ``jobs``: number of processes."""
    work = functools.partial(prune_one if by == "truth" else prune_seen, spurs=spurs)
    runs = SeedRuns(work, {"benchmark": "pruning", "by": by, "spurs": spurs}, _summary, announce, record)
    lines = runs.lines(seeds, jobs)
    yield from measurements(lines) if by == "truth" else seen_measurements(lines)


def _summary(line: dict[str, Any]) -> str:
    done, planned = ("right", "wanted") if line["by"] == "truth" else ("made", "planned")
    return f"{line[done]} of {line[planned]} cuts"


def prune_one(seed: int, spurs: int) -> dict[str, Any]:
    """Prune one vine. Returns the result as plain values."""
    scene = with_seed(load_scene(SCENE), seed)
    model = generate(scene)
    rule = PruningRule()
    stops = plan_pruning(model, spawn_pose(scene, 0)[:2], rule, spurs=spurs or None)
    physics = Physics(model, parameters=scene.physics)
    robot = Robot(physics.rigid, load_description(ROBOT), "pruner", pose=stops[0].base_pose)
    robot.fit_cutters(physics)
    task = PruneCanes(physics, robot, stops)
    worst = np.zeros(int(model.nodes.bud.max()) + 1)
    by_robot = np.zeros_like(worst)
    parted: set[int] = set()
    cane_of = model.canes.of_bodies(len(model.body_mass))
    while not task.is_done:
        task.control(physics.time)
        robot.control(physics.time)
        physics.step()
        if any(contact.body >= 0 for contact in physics.contacts):
            worst = np.maximum(worst, bud_forces(model, physics.state, physics.contacts))
            mine = [contact for contact in physics.contacts if contact.actor == robot.name]
            by_robot = np.maximum(by_robot, bud_forces(model, physics.state, mine))
        parted |= {int(cane_of[max(one.segment, one.body)]) for one in physics.detachments}
    kept = kept_buds(model, stops, rule.buds)
    wanted = {cut.cane for stop in stops for cut in stop.cuts}
    return {
        "wanted": len(task.results),
        "made": sum(one.done for one in task.results),
        "right": sum(one.done and one.off <= LARGEST_ERROR for one in task.results),
        "off": [None if math.isnan(one.off) else round(one.off, 5) for one in task.results],
        "reasons": [one.reason for one in task.results if one.reason],
        "others_cut": len(parted - wanted - {-1}),
        "kept_buds": len(kept),
        "bud_forces": [round(float(force), 2) for force in worst[kept]],
        "bud_forces_by_robot": [round(float(force), 2) for force in by_robot[kept]],
        "seconds": round(physics.time, 2),
    }


def kept_buds(model: Model, stops: list[PruneStop], buds: int) -> np.ndarray:
    """Returns the ids of the buds that stay on shortened canes."""
    nodes = model.nodes
    found = []
    for cane in [cut.cane for stop in stops for cut in stop.cuts if cut.is_kept]:
        mine = np.flatnonzero((nodes.cane == cane) & (nodes.bud >= 0))
        found += nodes.bud[mine[np.argsort(nodes.rank[mine], kind="stable")][:buds]].tolist()
    return np.array(found, int)


def measurements(lines: list[dict[str, Any]]) -> Iterator[Measurement]:
    """Yields the results of several vines."""
    wanted = sum(line["wanted"] for line in lines)
    off = np.array([one for line in lines for one in line["off"] if one is not None])
    forces = np.array([one for line in lines for one in line["bud_forces"]])
    perfect = sum(
        line["right"] == line["wanted"] and max(line["bud_forces"], default=0.0) <= LARGEST_FORCE for line in lines
    )
    yield Measurement("pruning", "vines", float(len(lines)), "1")
    yield Measurement("pruning", "vines with all cuts right and no kept bud pressed", float(perfect), "1")
    share = 100.0 * sum(line["right"] for line in lines) / max(wanted, 1)
    yield Measurement("pruning", f"of {wanted} cuts within {1e3 * LARGEST_ERROR:g} mm of their places", share, "%")
    if len(off):
        yield Measurement("pruning", "distance of a cut from its place, median", 1e3 * float(np.median(off)), "mm")
        yield Measurement("pruning", "distance of a cut from its place, largest", 1e3 * float(off.max()), "mm")
    pressed = float((forces > LARGEST_FORCE).sum())
    yield Measurement("pruning", f"of {len(forces)} kept buds, pressed by more than {LARGEST_FORCE:g} N", pressed, "1")
    others = float(sum(line["others_cut"] for line in lines))
    yield Measurement("pruning", "canes cut that were not to be cut there", others, "1")
    seconds = sum(line["seconds"] for line in lines)
    yield Measurement("pruning", "seconds of a cut, way along the row included", seconds / max(wanted, 1), "s")
    yield Measurement("pruning", "seconds of a vine", seconds / max(len(lines), 1), "s")
    reasons = collections.Counter(reason.split(":")[0] for line in lines for reason in line["reasons"])
    for phase, count in reasons.most_common():
        yield Measurement("pruning", f"failed in phase {phase}", float(count), "cuts")
