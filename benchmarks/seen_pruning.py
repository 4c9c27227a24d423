"""``python -m benchmarks pruning --by cameras``: prunes a dormant vine that the robot only sees, in simulated time.

Each seed is a vineyard. The robot drives along the vine nearest to its start place, looks, plans the cuts by the rule,
cuts, and knows nothing of the plants but what its head camera shows. Afterwards the truth tells which canes were found,
how far each cut is from the place that the rule wants, which canes were removed that should have stayed, and how many
buds are left on each spur.
"""

from __future__ import annotations

import collections
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from vinesim.api.picking import ROBOT
from vinesim.client.tasks.motions import LookAt
from vinesim.client.tasks.pruning import PruningRule, prune
from vinesim.client.tasks.seen_pruning import SAME_CANE, PruneBySight, axis_distance, vine_stretch
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.core import frames
from vinesim.perception.robot_eyes import RobotEyes
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.sight import SeenCane
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene, with_seed
from vinesim.scene.values import Measurement
from vinesim.world import Physics

SCENE = "winter_spur"
RIGHT = 0.010
"""[m] Distance from the wanted place up to which a cut counts as right."""


def prune_seen(seed: int, spurs: int) -> dict[str, Any]:
    """Prune one vine by sight. Returns the result as plain values. ``spurs``: largest number of spurs; 0: all."""
    scene = with_seed(load_scene(SCENE), seed)
    model = generate(scene)
    rule = PruningRule()
    stretch = vine_stretch(model, spawn_pose(scene, 0)[:2])
    physics = Physics(model, parameters=scene.physics)
    robot = Robot(physics.rigid, load_description(ROBOT), "pruner", pose=stretch.start(model))
    robot.fit_cutters(physics)
    eyes = RobotEyes(physics, robot, seed=seed)
    task = PruneBySight(physics, robot, stretch, rule, eyes, spurs=spurs or None)
    turn_head = LookAt(robot, task.focus)
    canes = model.canes
    axes = true_axes(model)
    cane_of = canes.of_bodies(len(model.body_mass))
    parted: dict[int, float] = {}
    while not task.is_done:
        task.control(physics.time)
        turn_head(physics.time)
        robot.control(physics.time)
        physics.step()
        for one in physics.detachments:
            cane, at = _place_of(model, physics, cane_of, one.segment, one.body, one.at)
            if cane >= 0:
                parted[cane] = min(parted.get(cane, math.inf), at)
    # truth: the canes of this vine, and those that the robot meant
    mine = np.flatnonzero((canes.year == 1) & (canes.vine == _vine(model, stretch.foot)))
    meant = {one.number: _same_cane(one.seen, axes) for one in task.memory.sure()}
    worked = {meant[cut.cane] for stop in task.stops for cut in stop.cuts} - {-1}
    spurs_worked = {int(canes.parent[cane]) for cane in worked}
    wanted = {cut.cane: cut for cut in prune(model.nodes, canes, rule)}
    rows = []
    for cane in np.flatnonzero((canes.year == 1) & np.isin(canes.parent, sorted(spurs_worked))).tolist():
        cut = wanted.get(cane)
        place = None if cut is None else _from_base(model, cane, cut.body) + cut.along
        at = parted.get(cane)
        along = bud_places(model, cane)
        rows.append(
            {
                "cane": cane,
                "spur": int(canes.parent[cane]),
                "found": cane in meant.values(),
                "stays": bool(cut is not None and cut.is_kept),
                "wanted": place,
                "at": at,
                "buds": int(len(along) if at is None else np.count_nonzero(along < at)),
            }
        )
    return {
        "pictures": eyes.pictures,
        "vine_canes": len(mine),
        "vine_found": len(set(mine.tolist()) & set(meant.values())),
        "false_canes": sum(cane < 0 for cane in meant.values()),
        "canes": rows,
        "others_cut": len(set(parted) - {row["cane"] for row in rows}),
        "planned": sum(len(stop.cuts) for stop in task.stops),
        "made": sum(one.done for one in task.results),
        "reasons": [one.reason for one in task.results if one.reason] + ([] if task.results else [task.reason]),
        "seconds": round(physics.time, 2),
    }


def true_axes(model: Model) -> dict[int, np.ndarray]:
    """Returns the axis [n, 3] m of each cane of last year at rest, by its id."""
    q = model.forward_kinematics(model.joint_settled).astype(float)
    found = {}
    for cane in np.flatnonzero(model.canes.year == 1).tolist():
        bodies = int(model.canes.body[cane]) + np.arange(int(model.canes.size[cane]))
        share = np.linspace(0.0, 1.0, 8)
        along = share * model.body_length[bodies, None]
        way = along[..., None] * frames.rotate(q[bodies, 3:], np.array([1.0, 0.0, 0.0]))[:, None]
        found[cane] = (q[bodies, None, :3] + way).reshape(-1, 3)
    return found


def _same_cane(seen: SeenCane, axes: dict[int, np.ndarray]) -> int:
    """Returns the id of the cane whose axis is where one was seen, -1 if there is none."""
    apart = {cane: axis_distance(seen, axis) for cane, axis in axes.items() if abs(axis[0, 0] - seen.base[0]) < 0.3}
    nearest = min(apart, key=lambda cane: apart[cane], default=-1)
    return nearest if nearest >= 0 and apart[nearest] < SAME_CANE else -1


def bud_places(model: Model, cane: int) -> np.ndarray:
    """Returns the ways [k] m from the base of a cane to its buds."""
    mine = np.flatnonzero((model.nodes.cane == cane) & (model.nodes.bud >= 0))
    way = [_from_base(model, cane, int(model.nodes.body[one])) + float(model.nodes.along[one]) for one in mine]
    return np.sort(np.array(way))


def _from_base(model: Model, cane: int, body: int) -> float:
    return float(model.body_length[int(model.canes.body[cane]) : body].sum())


def _place_of(
    model: Model, physics: Physics, cane_of: np.ndarray, segment: int, body: int, at: float
) -> tuple[int, float]:
    """Returns the id of the cane that was parted, -1 for none, and the way [m] from its base to that place."""
    body, at = (segment, at) if segment >= 0 else (body, 0.0)
    stump = int(physics.state.stump_of[body])
    body = stump if stump >= 0 else body
    cane = int(cane_of[body]) if body < len(cane_of) else -1
    if cane < 0 or model.canes.year[cane] != 1:
        return -1, 0.0
    return cane, _from_base(model, cane, body) + at


def _vine(model: Model, foot: np.ndarray) -> int:
    """Returns the number of the vine that is planted at ``foot`` [3] m."""
    q = model.forward_kinematics(model.joint_settled).astype(float)
    vines = np.unique(model.canes.vine)
    bases = [q[model.canes.body[model.canes.vine == vine], :2].mean(0) for vine in vines]
    return int(vines[np.argmin([np.linalg.norm(base - foot[:2]) for base in bases])])


def seen_measurements(lines: list[dict[str, Any]]) -> Iterator[Measurement]:
    """Yields the results of several vines that were pruned by sight."""
    rows = [row for line in lines for row in line["canes"]]
    total = sum(line["vine_canes"] for line in lines)
    yield Measurement("pruning by cameras", "vines", float(len(lines)), "1")
    found = 100.0 * sum(line["vine_found"] for line in lines) / max(total, 1)
    yield Measurement("pruning by cameras", f"of {total} canes of these vines, found", found, "%")
    false = float(sum(line["false_canes"] for line in lines))
    yield Measurement("pruning by cameras", "canes seen where none is", false, "1")
    spurs = collections.defaultdict(list)
    for line in lines:
        for row in line["canes"]:
            spurs[line["seed"], row["spur"]].append(row)
    yield Measurement("pruning by cameras", "spurs that were worked on", float(len(spurs)), "1")
    name = f"of {len(rows)} canes of these spurs"
    at = [(row, abs(row["at"] - row["wanted"])) for row in rows if row["at"] is not None and row["wanted"] is not None]
    cut = 100.0 * len(at) / max(len(rows), 1)
    yield Measurement("pruning by cameras", f"{name}, cut", cut, "%")
    right = 100.0 * sum(off <= RIGHT for _, off in at) / max(len(rows), 1)
    yield Measurement("pruning by cameras", f"{name}, cut within {1e3 * RIGHT:g} mm of the place", right, "%")
    if at:
        off = np.array([off for _, off in at])
        yield Measurement("pruning by cameras", "distance of a cut from its place, median", 1e3 * np.median(off), "mm")
        yield Measurement("pruning by cameras", "distance, 90 % of the cuts below", 1e3 * np.quantile(off, 0.9), "mm")
    stay = [row for row in rows if row["stays"]]
    wrong = sum(row["buds"] < 2 for row in stay)
    yield Measurement("pruning by cameras", f"of {len(stay)} canes that stay, cut below two buds", float(wrong), "1")
    left = collections.Counter(min(sum(row["buds"] for row in group), 5) for group in spurs.values())
    for buds, count in sorted(left.items()):
        more = " or more" if buds == 5 else ""
        yield Measurement("pruning by cameras", f"spurs with {buds}{more} buds left", float(count), "1")
    others = float(sum(line["others_cut"] for line in lines))
    yield Measurement("pruning by cameras", "canes of other spurs that were cut", others, "1")
    made = 100.0 * sum(line["made"] for line in lines) / max(sum(line["planned"] for line in lines), 1)
    yield Measurement("pruning by cameras", "of the planned cuts, the robot felt wood part", made, "%")
    seconds = sum(line["seconds"] for line in lines) / max(len(lines), 1)
    yield Measurement("pruning by cameras", "seconds of a vine, looking around included", seconds, "s")
    reasons = collections.Counter(reason.split(":")[0] for line in lines for reason in line["reasons"])
    for phase, count in reasons.most_common():
        yield Measurement("pruning by cameras", f"failed in phase {phase}", float(count), "cuts")
