"""Checks of a model and its state before the simulation. Each error message names the fault and its correction."""

from __future__ import annotations

import logging

import numpy as np

from vinesim.core.errors import checked_index
from vinesim.scene.berries import VARIETIES
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.state import State

_log = logging.getLogger(__name__)


def checked_trees(trees: np.ndarray | int, count: int) -> np.ndarray:
    """Returns tree indices [k] as an array. Raises :class:`ValueError` for the first index that is not from 0 to
    ``count`` - 1."""
    trees = np.atleast_1d(trees)
    if len(trees) and (trees.dtype.kind not in "iu" or trees.min() < 0 or trees.max() >= count):
        for tree in trees.tolist():
            checked_index("tree", tree, count)
    return trees


def warn_of_raised_damping(model: Model, dt: float, phi: float) -> None:
    """Log one warning if joints have less damping in the model than the integrator adds with steps of ``dt`` [s].

    ``phi``: implicitness of the integrator, 0.5 (trapezoidal, adds no damping) to 1 (backward Euler).
    """
    floor = (2.0 * phi - 1.0) * dt
    stiffness = model.joint_stiffness.astype(float)
    raised = ((stiffness > 0.0) & (model.joint_damping < (1.0 - 1e-3) * floor * stiffness)).any(1)
    if raised.any():
        _log.warning(
            "%d of %d joints move with more damping than the model gives them: with steps of %g s and phi %g, a joint"
            " has at least a damping of %.2g ms times its stiffness; lower dt or phi (0.5 adds none), or raise the"
            " damping",
            raised.sum(),
            len(model.body_mass),
            dt,
            phi,
            1e3 * floor,
        )


def validate(model: Model, state: State) -> None:
    """Raise :class:`ValueError` for the first tree or body that cannot be simulated. The message says how to correct
    it."""
    model.check()
    state.check()
    if len(state.joint_q) != len(model.body_mass) or len(state.tree_awake) != len(model.tree_first):
        raise ValueError(
            f"state of {len(state.joint_q)} bodies for a model of {len(model.body_mass)}; use State.at_rest"
        )

    def refuse(bad: np.ndarray, what: str, value: np.ndarray, remedy: str) -> None:
        if bad.any():
            body = int(np.argmax(bad.reshape(len(bad), -1).any(-1)))
            tree = int(model.body_tree[body])
            raise ValueError(f"body {body} of tree {tree}: {what} {np.asarray(value[body]).tolist()}; {remedy}")

    count = len(model.body_mass)
    owner = np.repeat(np.arange(len(model.tree_first)), model.tree_size)
    start = np.cumsum(model.tree_size) - model.tree_size
    if len(owner) != count or (model.tree_first != start).any() or (model.tree_size < 1).any():
        raise ValueError(
            "tree_first and tree_size do not tile the bodies; build the model with vinesim.scene.builder.assemble"
        )
    refuse(model.body_tree != owner, "is listed in tree", model.body_tree, "body_tree must agree with tree_first")
    parent = model.body_parent
    refuse(parent >= np.arange(count), "parent", parent, "a parent stands before its children (no cycles); reorder")
    refuse((parent < -1) | ((parent >= 0) & (parent < start[owner])), "parent", parent, "name a body of the same tree")
    refuse(~(model.body_length > 0.0), "length [m]", model.body_length, "give a positive length or leave the body out")
    refuse(~(model.body_radius >= 0.0), "radius [m]", model.body_radius, "give radii of 0 or more")
    refuse(~(model.body_mass > 0.0), "mass [kg]", model.body_mass, "give a positive mass or leave the body out")
    refuse(~(model.body_inertia > 0.0), "inertia [kg m^2]", model.body_inertia, "give positive principal moments")
    refuse(
        model.joint_stiffness < 0.0, "stiffness [N m/rad]", model.joint_stiffness, "a spring pulls back: use 0 or more"
    )
    refuse(
        model.joint_damping < 0.0, "damping [N m s/rad]", model.joint_damping, "a damper takes energy: use 0 or more"
    )
    for what, q in (("rest rotation", model.body_rest), ("joint rotation", state.joint_q)):
        refuse(abs(np.linalg.norm(q, axis=-1) - 1.0) > 1e-3, what, q, "give a unit quaternion xyzw")
    pose = model.tree_pose[model.body_tree, 3:]
    refuse(
        abs(np.linalg.norm(pose, axis=-1) - 1.0) > 1e-3, "root frame's rotation", pose, "give a unit quaternion xyzw"
    )
    organs = [int(organ) for organ in Organ]
    refuse(~np.isin(model.body_organ, organs), "organ", model.body_organ, "give a member of vinesim.Organ")
    refuse(~(model.body_drag >= 0.0), "drag area [m^2]", model.body_drag, "air holds back: use 0 or more")
    _validate_bunches(model)
    _validate_clusters(model)
    _validate_ties(model)


def _validate_bunches(model: Model) -> None:
    """Check that bunches are bodies of the model, and that their sizes and strengths are positive."""

    def refuse(bad: np.ndarray, name: str, remedy: str) -> None:
        if bad.any():
            bunch = int(np.argmax(bad))
            raise ValueError(f"bunch {bunch}: {name} is {getattr(model, name)[bunch].item()}; {remedy}")

    body = model.bunch_body
    refuse((body < 0) | (body >= len(model.body_mass)), "bunch_body", f"give 0 to {len(model.body_mass) - 1}")
    for name in ("bunch_pull", "bunch_bend", "bunch_length", "bunch_radius", "bunch_berries"):
        refuse(~(getattr(model, name) > 0), name, "give a number above 0")
    count = len(VARIETIES)
    refuse((model.bunch_variety < 0) | (model.bunch_variety >= count), "bunch_variety", f"give 0 to {count - 1}")


def _validate_clusters(model: Model) -> None:
    """Check that the bodies after a tree's core are exactly its berry clusters, and that each cluster hangs on its
    bunch or on another cluster of that bunch."""
    core = model.tree_core
    size = model.tree_size
    if (bad := (core < 1) | (core > size)).any():
        tree = int(np.argmax(bad))
        raise ValueError(f"tree {tree}: tree_core {core[tree]} of {size[tree]} bodies; give 1 to tree_size (all)")
    spares = model.tree_spares
    if (bad := (spares < 0) | (spares >= core)).any():
        tree = int(np.argmax(bad))
        raise ValueError(
            f"tree {tree}: tree_spares {spares[tree]} of {core[tree]} core bodies; give 0 to less than all"
        )
    riding = np.arange(len(model.body_mass)) - model.tree_first[model.body_tree] >= core[model.body_tree]
    owner = np.full(len(model.body_mass), -1)
    for bunch in np.flatnonzero(model.bunch_clusters > 0).tolist():
        first = model.bunch_cluster[bunch]
        count = model.bunch_clusters[bunch]
        body = model.bunch_body[bunch]
        parts = np.arange(first, first + count)
        where = f"bunch {bunch}: clusters {first} to {first + count - 1}"
        if first < 0 or first + count > len(owner) or not riding[parts].all():
            raise ValueError(f"{where} are not behind the core of a tree; put clusters last and set tree_core")
        if (owner[parts] >= 0).any():
            raise ValueError(f"{where} are also bunch {owner[parts].max()}'s; give each bunch its own")
        owner[parts] = bunch
        parent = model.body_parent[parts]
        if (bad := (parent != body) & ((parent < first) | (parent >= first + count))).any():
            part = int(np.argmax(bad))
            raise ValueError(
                f"bunch {bunch}: cluster {parts[part]} hangs on body {parent[part]}; hang it on the bunch, body "
                f"{body}, or on another of its clusters"
            )
        if not model.bunch_head_mass[bunch] > 0.0 or not (model.bunch_head_inertia[bunch] > 0.0).all():
            raise ValueError(
                f"bunch {bunch}: its head has mass {model.bunch_head_mass[bunch]} kg, moments "
                f"{model.bunch_head_inertia[bunch].tolist()}; give positive ones"
            )
        whole = model.bunch_head_mass[bunch] + model.body_mass[parts].sum()
        if abs(whole - model.body_mass[body]) > 1e-3 * whole:
            raise ValueError(
                f"bunch {bunch}: head and clusters weigh {whole:g} kg, its body {model.body_mass[body]:g} kg; "
                "body_mass is the whole bunch's"
            )
    if (bad := riding & (owner < 0)).any():
        body = int(np.argmax(bad))
        raise ValueError(
            f"body {body} of tree {model.body_tree[body]} is behind its core, but no bunch's cluster; list it in "
            "bunch_cluster or raise tree_core"
        )


def _validate_ties(model: Model) -> None:
    """Check that ties are sorted, are on existing bodies that always move, and have positive stiffness."""
    body = model.tie_body
    count = len(model.body_mass)

    def refuse(bad: np.ndarray, what: str) -> None:
        if bad.any():
            tie = int(np.argmax(bad))
            raise ValueError(f"tie {tie} on body {body[tie]}: {what}")

    refuse((body < 0) | (body >= count), f"there are {count} bodies, counted from 0")
    refuse(np.append(False, body[1:] < body[:-1]), "it stands behind a tie of a later body; sort ties by body")
    tree = model.body_tree[body]
    refuse(body - model.tree_first[tree] >= model.tree_core[tree], "a berry cluster cannot be tied; tie its bunch")
    refuse(~(model.tie_stiffness >= 0.0), "stiffness below 0 N/m; a spring pulls back: use 0 or more")
    wire = model.tie_wire
    pieces = len(model.fixed_start)
    refuse(
        (wire < -1) | (wire >= pieces),
        f"wire of {pieces} fixed pieces, counted from 0; give one of them, or -1 for none",
    )
    if (bad := (model.tree_piece < -1) | (model.tree_piece >= pieces)).any():
        tree = int(np.argmax(bad))
        raise ValueError(
            f"tree {tree}: piece {model.tree_piece[tree]} of {pieces} fixed pieces, counted from 0; give one of them, "
            "or -1 for none"
        )
    if (bad := ~(model.fixed_shear_modulus >= 0.0)).any():
        piece = int(np.argmax(bad))
        raise ValueError(f"fixed piece {piece}: shear modulus {model.fixed_shear_modulus[piece]} Pa; give 0 or more")
    if (bad := ~((model.fixed_tension >= 0.0) & np.isfinite(model.fixed_tension))).any():
        piece = int(np.argmax(bad))
        raise ValueError(f"fixed piece {piece}: tension {model.fixed_tension[piece]} N; give 0 or more")
    for values, name, unit in ((model.fixed_stretch, "stretch", "N/m"), (model.fixed_strength, "strength", "N")):
        if (bad := ~((values >= 0.0) & np.isfinite(values))).any():
            piece = int(np.argmax(bad))
            raise ValueError(f"fixed piece {piece}: {name} {values[piece]} {unit}; give 0 or more")
    refuse(~(model.tie_damping >= 0.0), "damping below 0 N s/m; a damper takes energy: use 0 or more")
