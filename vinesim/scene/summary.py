"""Summary of a generated vineyard as rows of a table."""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.scene import leaves
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene, season_of


def summary_rows(scene: Scene, model: Model) -> list[tuple[str, str, str]]:
    """Returns the rows of the summary table: (quantity, value, unit)."""
    counts = model.counts()
    layout = scene.layout
    places = layout.rows * layout.vines
    ground = places * layout.row_spacing * layout.vine_spacing
    vines = places - len(set(layout.missing)) + len(scene.imported)
    bent = np.linalg.norm(frames.log(model.joint_settled.astype(float)), axis=1)
    memory = sum(getattr(model, name).nbytes for name in model.array_fields())
    fruit = model.body_mass[model.bunch_body].sum()
    state = season_of(scene)
    dated = [] if state is None else [("date", f"{scene.date:%d %B}, {state.form}, {scene.pruning} pruning", "")]
    nodes = model.nodes
    if len(nodes.body):
        last = int((model.canes.year == 1).sum())
        dated += [("dormant canes, nodes, buds", f"{last}, {len(nodes.body)}, {int((nodes.bud >= 0).sum())}", "")]
    return [
        ("scene", f"{scene.name}, {scene.training}, seed {scene.seed}", ""),
        *dated,
        ("ground", f"{ground:.0f}", "m^2"),
        ("vines", f"{vines}", ""),
        ("trees (shoots)", f"{counts['tree']}", ""),
        ("bodies", f"{counts['body']}", ""),
        ("bodies of the largest tree", f"{model.tree_size.max(initial=0)}", ""),
        ("bunches", f"{counts['bunch']}", ""),
        ("berries", f"{model.bunch_berries.sum()}", ""),
        ("fruit per vine", f"{fruit / vines:.1f}", "kg"),
        ("leaves", f"{counts['leaf']}", ""),
        ("leaf area index", f"{total_leaf_area(model) / ground:.2f}", "m^2/m^2"),
        ("poles, wires, old wood", f"{counts['fixed']}", "pieces"),
        ("boxes", f"{counts['box']}", ""),
        ("start places", ", ".join(s.name for s in scene.spawns) or "none", ""),
        ("largest settled angle", f"{bent.max(initial=0.0):.2f}", "rad"),
        ("memory", f"{memory / 1e6:.1f}", "MB"),
        ("digest", model.digest(), ""),
    ]


def total_leaf_area(model: Model) -> float:
    """Returns the area of one side of all flat blades [m^2]."""
    return float(leaves.BLADE_AREA * (model.leaf_size.astype(float) ** 2).sum())
