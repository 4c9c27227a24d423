"""Fixed structure as round cones: poles, wires, trunks and arms; and the random number generator of each vine."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.scene import builder
from vinesim.scene.generation.gnarl import POST_RADIUS, gnarled_arms, gnarled_trunks, post_kinds
from vinesim.scene.generation.shoot_slots import ARM_SEGMENTS, TRUNK_SEGMENTS
from vinesim.scene.ids import Organ
from vinesim.scene.plant_parameters import VineParameters
from vinesim.scene.season import load_season
from vinesim.scene.spec import Scene

_WIRE_GAP = 0.012
"""[m] Depth of a fruiting cane's axis below its wire: it hangs in ties."""


@dataclasses.dataclass
class FixedStructure:
    """Vines with their random number generators, their trunks and arms, and all fixed parts."""

    foot: np.ndarray
    """[vine, 3] m, position of the trunk's base on the ground."""
    row: np.ndarray
    """[vine] index of the vine's row."""
    place: np.ndarray
    """[vine] index of the vine in its row."""
    rngs: list[np.random.Generator]
    arms: np.ndarray
    """[vine, arm, point, 3] m, points along the axis of each arm."""
    trunk: np.ndarray
    """[vine, point, 3] m, points along the axis of each trunk."""
    arm_radius: np.ndarray
    """[vine, arm, point] m"""
    trunk_radius: np.ndarray
    """[vine, point] m"""
    fixed: dict[str, np.ndarray]


def build_fixed_structure(scene: Scene, parameters: VineParameters) -> FixedStructure:
    layout = scene.layout
    tendone = scene.training == "tendone"
    row, place = (a.ravel() for a in np.mgrid[0 : layout.rows, 0 : layout.vines])
    pole = np.stack([place * layout.vine_spacing, row * layout.row_spacing, 0.0 * row], -1)
    pole_row = row
    there = [one not in layout.missing for one in zip(row.tolist(), place.tolist(), strict=True)]
    row = row[there]
    place = place[there]
    foot = pole[there]
    rngs = [
        np.random.default_rng(np.random.SeedSequence(scene.seed, spawn_key=(int(r), int(p))))
        for r, p in zip(row, place, strict=True)
    ]
    arm_count = int((parameters.arm.tendone_arms if tendone else parameters.arm.vsp_arms).value)
    wobble = np.stack([g.normal(size=(TRUNK_SEGMENTS + 1, 3)) for g in rngs])
    bend = np.stack([g.normal(size=(arm_count, ARM_SEGMENTS + 1, 3)) for g in rngs])

    head = layout.height - (0.06 if tendone else 0.03)
    if scene.pruning == "cane":
        head = layout.height - load_season().dormant.fruiting_cane_drop.value
    up = np.linspace(0.0, 1.0, TRUNK_SEGMENTS + 1)[:, None]
    beside = parameters.trunk.beside_pole.value
    side = np.array([0.0, beside, 0.0] if tendone else [beside, 0.0, 0.0])
    trunk = foot[:, None] + up * [0.0, 0.0, head] + side * (1.0 - 0.45 * up)
    trunk += np.cumsum(wobble, 1) * [0.015, 0.015, 0.0] * np.sin(np.pi * np.minimum(up, 0.5))

    angle = 2.0 * np.pi * np.arange(arm_count) / arm_count
    out = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
    reach = parameters.arm.share.value * np.where(np.abs(out[:, 1]) > 0.5, layout.row_spacing, layout.vine_spacing)
    along = np.linspace(0.0, 1.0, ARM_SEGMENTS + 1)[:, None]
    arms = trunk[:, -1, None, None] + out[:, None] * reach[:, None, None] * along
    sway = np.cumsum(bend, 2) * [0.016, 0.016, 0.008]
    sway[:, :, 0] = 0.0
    arms = arms + sway
    arms[..., 2] = np.minimum(arms[..., 2] + 0.03 * along[:, 0], layout.height - 0.005)

    thick = 0.5 * parameters.trunk.diameter.at(up[:, 0])
    thin = 0.5 * parameters.arm.diameter.at(along[:, 0])
    count = len(foot)
    twists = scene.pruning == "spur"
    if not twists:
        arms, thin = _lay_down(scene, arms)
    arm_radius = np.broadcast_to(thin, arms.shape[:3])
    trunk_radius = np.broadcast_to(thick, trunk.shape[:2])
    if scene.clutter.old_wood > 0.0:
        trunk, trunk_radius = gnarled_trunks(scene, row, place, trunk, trunk_radius)
        if twists:
            arms, arm_radius = gnarled_arms(scene, row, place, arms, arm_radius, trunk[:, -1])
    radius = np.full((len(pole), 2), 0.5 * parameters.trellis.pole_diameter.value)
    for kind, thickness in POST_RADIUS.items():
        radius[post_kinds(scene.clutter, scene.seed, pole_row) == kind] = thickness
    pieces = [
        cone_chains(trunk, trunk_radius, Organ.TRUNK, np.arange(count)),
        cone_chains(
            arms.reshape(-1, *arms.shape[2:]),
            arm_radius.reshape(-1, arms.shape[2]),
            Organ.ARM,
            np.arange(count * arm_count),
            shear_modulus=builder.shear_modulus(parameters.cane.woody_modulus.value) if twists else 0.0,
        ),
        cone_chains(
            pole[:, None] + np.array([[0, 0, -0.3], [0, 0, layout.height + (0.1 if tendone else 1.15)]]),
            radius,
            Organ.POLE,
            np.arange(len(pole)),
        ),
        *_wires(scene, parameters),
    ]
    fixed = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    return FixedStructure(foot, row, place, rngs, arms, trunk, arm_radius, trunk_radius, fixed)


def _lay_down(scene: Scene, arms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the points [vine, arm, point, 3] m and the radii [point] m of fruiting canes in place of ``arms``: they
    rise from the head of the trunk to the fruiting wire and follow it. Ties keep them from twisting."""
    dormant = load_season().dormant
    share = np.linspace(0.0, 1.0, arms.shape[2])
    low = np.maximum(1.0 - share / 0.3, 0.0)
    arms = arms.copy()
    top = scene.layout.height - _WIRE_GAP
    arms[..., 2] = top - (top - arms[:, :, :1, 2]) * (low * low)
    foot = arms[:, :, :1, :2]
    sway = (arms[..., :2] - foot) - share[:, None] * (arms[:, :, -1:, :2] - foot)
    arms[..., :2] -= 0.6 * sway  # the wire holds the cane straight
    arms[..., 1] = foot[..., 1] + (arms[..., 1] - foot[..., 1]) * 0.3
    return arms, 0.5 * dormant.fruiting_cane_diameter.at(share)


def cone_chains(
    points: np.ndarray,
    radius: np.ndarray,
    organ: Organ,
    index: np.ndarray,
    tension: float = 0.0,
    shear_modulus: float = 0.0,
    stretch: np.ndarray | float = 0.0,
    strength: float = 0.0,
) -> dict[str, np.ndarray]:
    """Returns the ``fixed_`` arrays of round cones along polylines ``points`` [chain, point, 3] m with ``radius``
    [point] or [chain, point] m; ``stretch`` [chain * piece] N/m."""
    pieces = points.shape[1] - 1
    pairs = np.broadcast_to(np.stack([radius[..., :-1], radius[..., 1:]], -1), (len(points), pieces, 2))
    return {
        "fixed_start": points[:, :-1].reshape(-1, 3),
        "fixed_end": points[:, 1:].reshape(-1, 3),
        "fixed_radius": pairs.reshape(-1, 2),
        "fixed_organ": np.full(len(points) * pieces, int(organ)),
        "fixed_index": np.repeat(index, pieces),
        "fixed_tension": np.full(len(points) * pieces, tension),
        "fixed_stretch": np.broadcast_to(stretch, len(points) * pieces),
        "fixed_strength": np.full(len(points) * pieces, strength),
        "fixed_shear_modulus": np.full(len(points) * pieces, shear_modulus),
    }


def wire_stretch(length: np.ndarray, diameter: float, modulus: float, anchor: float) -> np.ndarray:
    """Returns the rise of tension [k] N/m of pieces of wire with ``length`` [k] m for each metre by which deflection
    lengthens them: the wire and the posts at its two ends, ``anchor`` [N/m] each, in series."""
    return 1.0 / (length / (modulus * 0.25 * np.pi * diameter**2) + 2.0 / anchor)


def _wires(scene: Scene, parameters: VineParameters) -> list[dict[str, np.ndarray]]:
    """Returns the wires of a scene: an overhead net (tendone), or a fruiting wire and pairs of catch wires in each row
    (vsp)."""
    layout = scene.layout
    trellis = parameters.trellis
    wide = (layout.vines - 1) * layout.vine_spacing
    deep = (layout.rows - 1) * layout.row_spacing
    over_x = 0.5 * layout.vine_spacing
    over_y = 0.5 * layout.row_spacing
    # wires run from pole to pole, and half a vine spacing beyond the first and the last vine
    xs = np.unique([-over_x, *(np.arange(layout.vines) * layout.vine_spacing), wide + over_x])
    ys = np.unique([-over_y, *(np.arange(layout.rows) * layout.row_spacing), deep + over_y])
    radius = 0.5 * trellis.wire_diameter.value
    if scene.training == "tendone":
        step_y = layout.row_spacing / max(round(layout.row_spacing / trellis.tendone_wire_spacing.value), 1)
        step_x = layout.vine_spacing / max(round(layout.vine_spacing / trellis.tendone_wire_spacing.value), 1)
        at_y = np.arange(-over_y, deep + over_y + 1e-6, step_y)
        at_x = np.arange(-over_x, wide + over_x + 1e-6, step_x)
        along_x = np.stack(np.broadcast_arrays(xs[None], at_y[:, None], layout.height), -1)
        along_y = np.stack(np.broadcast_arrays(at_x[:, None], ys[None], layout.height + 2.0 * radius), -1)
        lines = [along_x, along_y]
    else:
        apart = radius + 0.5 * trellis.pole_diameter.value
        heights = layout.height + trellis.vsp_wire_spacing.value * np.arange(1, int(trellis.vsp_wires.value) + 1)
        across = [(0.0, layout.height), *((side * apart, z) for z in heights for side in (-1.0, 1.0))]
        rows = np.arange(layout.rows) * layout.row_spacing
        lines = [np.stack(np.broadcast_arrays(xs[None], (rows + y)[:, None], z), -1) for y, z in across]
    first = 0
    pieces = []
    for line in lines:
        number = first + np.arange(len(line))
        thickness = np.full(line.shape[1], radius)
        length = np.linalg.norm(np.diff(line, axis=1), axis=2).ravel()
        pieces.append(
            cone_chains(
                line,
                thickness,
                Organ.WIRE,
                number,
                trellis.wire_tension.value,
                stretch=wire_stretch(length, 2.0 * radius, trellis.wire_modulus.value, trellis.wire_anchor.value),
                strength=trellis.wire_strength.value * np.pi * radius**2,
            )
        )
        first += len(line)
    return pieces
