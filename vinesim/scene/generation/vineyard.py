"""Generates the model of a scene. Poles, wires and old wood are fixed; every shoot is a tree with leaves and bunches.

Shoots are rows of a table, all with the same slots (:mod:`~vinesim.scene.generation.shoot_slots`). Slots that a shoot
does not use are removed at the end. So only the sampling of random numbers loops over plants. Each vine has its own
random number generator, seeded by (seed, row, place), so its numbers do not depend on the number of vines.
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from typing import Any

import msgspec
import numpy as np

from vinesim.core import array_fields, disk_cache, frames, portable_math
from vinesim.scene import berries, builder, leaves, palette, plant_parameters
from vinesim.scene.generation.bearers import with_bearers
from vinesim.scene.generation.dormant import Vines, build_dormant, ripe_canes
from vinesim.scene.generation.fixed_structure import FixedStructure, build_fixed_structure
from vinesim.scene.generation.old_wood import with_old_wood
from vinesim.scene.generation.plant_bodies import Bodies, build_bodies, place_leaves
from vinesim.scene.generation.shoot_slots import CORE_SLOTS, MAX_BUNCHES, cluster_slots, peduncle_slots
from vinesim.scene.generation.shoots import Shoots, sample_shoots
from vinesim.scene.generation.shoots_by_date import grow_to_date
from vinesim.scene.generation.ties import find_ties
from vinesim.scene.generation.uneven_ground import (
    TrellisRise,
    build_terrain,
    raise_shoots,
    raise_structure,
    raise_ties,
)
from vinesim.scene.ids import Organ
from vinesim.scene.look import Look
from vinesim.scene.model import Model
from vinesim.scene.nodes import DormantCanes, Nodes
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.plant_import.imported_plant import load_imported_plant
from vinesim.scene.plant_import.ties import tie_to_wires
from vinesim.scene.plant_import.wood import build_model, join_models
from vinesim.scene.plant_parameters import VineParameters
from vinesim.scene.season import SeasonState, load_season
from vinesim.scene.spare_bodies import DORMANT_SPARES, SPARES, with_spares
from vinesim.scene.spec import Clutter, Datum, Scene, Sun, Wind, on_its_date, season_of
from vinesim.scene.strength import with_reserve
from vinesim.scene.terrain import Terrain, ground_height


def generate(scene: Scene) -> Model:
    """Returns the model of a scene, from the disk cache (:mod:`vinesim.core.disk_cache`) if the cache contains it.

    The model of a scene has the same bits on every machine.

    Raises :class:`~vinesim.core.toml_loader.DataError` if the scene's plant parameters cannot be read.
    """
    parameters = plant_parameters.load_plant(scene.plants)
    terrain = build_terrain(scene)

    scene = on_its_date(scene)

    def make() -> disk_cache.Arrays:
        model = _generate(scene, parameters, terrain)
        arrays = {name: getattr(model, name) for name in Model.array_fields()}
        for part, kind in _DORMANT_TABLES.items():
            arrays |= {f"{part}.{name}": getattr(getattr(model, part), name) for name in kind.array_fields()}
        return arrays

    # settings that no plant depends on must not change the digest
    plants = msgspec.structs.replace(
        scene,
        name="",
        palette=palette.PaletteTable(),
        sun=Sun(),
        wind=Wind(),
        datum=Datum(),
        spawns=(),
        fruit=msgspec.structs.replace(scene.fruit, ripeness=None, rot=0.0, shrivelled=0.0, sunburn=0.0),
        physics=PhysicsParameters(),
        plants="",
        imported=(),
        clutter=Clutter(old_wood=scene.clutter.old_wood, posts=scene.clutter.posts),
    )
    if terrain is not None:  # the path of an image must not change the digest, but its content must
        plants = msgspec.structs.replace(plants, terrain=None)
    ground = (
        None if terrain is None else (repr(terrain.origin), terrain.cell, terrain.slope, terrain.residual.tobytes())
    )
    imported = [(load_imported_plant(one.file), msgspec.structs.replace(one, file="")) for one in scene.imported]
    curves = None if scene.date is None else load_season()
    inputs = (plants, parameters, imported, ground, curves)
    digest = disk_cache.source_digest(_code_digest(), msgspec.json.encode(inputs))
    arrays = disk_cache.load_or_make("vineyard", digest, make)
    fields: dict[str, Any] = {name: arrays[name] for name in Model.array_fields()}
    model = Model(terrain=terrain, look=Look.of(scene), **fields).check()
    for part, kind in _DORMANT_TABLES.items():
        table = kind(**{name: arrays[f"{part}.{name}"] for name in kind.array_fields()})
        setattr(model, part, table.check())
    return model


def generate_uncached(scene: Scene) -> Model:
    """Returns the same model as :func:`generate` without using the cache. For scenes that are needed only once."""
    return _generate(on_its_date(scene), plant_parameters.load_plant(scene.plants), build_terrain(scene))


_DORMANT_TABLES: dict[str, type[Nodes] | type[DormantCanes]] = {"nodes": Nodes, "canes": DormantCanes}
"""Tables of a model besides its arrays, by the name of the model's field."""


@functools.cache
def _code_digest() -> str:
    """Returns the digest of the code that generates models and of the grape varieties."""
    package = pathlib.Path(builder.__file__).parent
    others = [pathlib.Path(str(module.__file__)) for module in (frames, array_fields, portable_math)]
    return disk_cache.source_digest(package, *others, repr(berries.VARIETIES))


def _generate(scene: Scene, parameters: VineParameters, terrain: Terrain | None) -> Model:
    structure = build_fixed_structure(scene, parameters)
    shoots = sample_shoots(scene, parameters, structure)
    state = season_of(scene)
    if state is None:
        model = _build_leafy(scene, parameters, terrain, structure, shoots)
    elif state.has_shoots:
        structure = with_bearers(structure, shoots.bearers, scene.pruning)
        shoots = grow_to_date(scene, shoots, state)
        model = _build_leafy(scene, parameters, terrain, structure, shoots)
    else:
        model = _build_bare(scene, parameters, terrain, Vines(structure, ripe_canes(shoots)), state)
    if terrain is not None:
        model.terrain = terrain
        for i, box in enumerate(scene.boxes):
            half = 0.5 * box.size[0], 0.5 * box.size[1]
            model.box_pose[i] = terrain.resting_pose(box.x, box.y, box.yaw, half)
    model = with_reserve(builder.solve_rest_pose(model)).check()
    model.look = Look.of(scene)
    variety = [v.name for v in berries.VARIETIES].index(scene.fruit.varieties[0])
    for number, one in enumerate(scene.imported):
        foot = one.z + float(ground_height(terrain, one.x, one.y))
        pose = frames.pose(np.array([one.x, one.y, foot]), frames.from_yaw(one.yaw))
        # spawn keys of length 3, because those of vines have length 2
        rng = np.random.default_rng(np.random.SeedSequence(scene.seed, spawn_key=(0, 0, number)))
        plant = build_model(
            load_imported_plant(one.file),
            pose,
            len(structure.foot) + number,
            parameters,
            variety,
            (scene, rng) if one.leaves else None,
        )
        model = join_models(model, tie_to_wires(plant, model, one.tie_gap, parameters.trellis))
    return with_spares(model, DORMANT_SPARES if len(model.canes.body) else SPARES)


def _build_leafy(
    scene: Scene,
    parameters: VineParameters,
    terrain: Terrain | None,
    structure: FixedStructure,
    shoots: Shoots,
) -> Model:
    """Returns the model of vines with green shoots, not yet in equilibrium."""
    bodies = build_bodies(parameters, shoots)
    ties = find_ties(scene, parameters, structure, shoots, bodies)
    if terrain is not None:
        rise = TrellisRise(terrain, scene.layout)
        structure = raise_structure(structure, terrain, rise)
        shoots = raise_shoots(shoots, rise)
        level = bodies
        bodies = build_bodies(parameters, shoots)
        ties = raise_ties(ties, shoots, level, bodies)
    structure = _with_old_wood(scene, structure, shoots)
    leaf = place_leaves(scene, parameters, shoots, bodies)
    return _assemble_model(scene, parameters, structure, shoots, bodies, leaf, ties)


def _build_bare(
    scene: Scene, parameters: VineParameters, terrain: Terrain | None, level: Vines, state: SeasonState
) -> Model:
    """Returns the model of dormant vines, not yet in equilibrium. ``level``: the vines on level ground."""
    vines = level
    if terrain is not None:
        rise = TrellisRise(terrain, scene.layout)
        vines = Vines(raise_structure(level.structure, terrain, rise), raise_shoots(level.shoots, rise))
    vines = dataclasses.replace(vines, structure=_with_old_wood(scene, vines.structure, vines.shoots))
    return build_dormant(scene, parameters, level, vines, state)


def _with_old_wood(scene: Scene, structure: FixedStructure, shoots: Shoots) -> FixedStructure:
    """Returns the structure with old wood: spur heads stand below shoots, or below two-year spurs."""
    start = shoots.points[:, 0].copy()
    for bearer in shoots.bearers:
        start[list(bearer.shoots)] = bearer.points[0]
    return with_old_wood(scene, structure, start, has_cordons=scene.pruning == "spur")


def _assemble_model(
    scene: Scene,
    parameters: VineParameters,
    structure: FixedStructure,
    shoots: Shoots,
    bodies: Bodies,
    leaf: dict[str, np.ndarray],
    ties: dict[str, np.ndarray],
) -> Model:
    """Build the model from the tables [shoot, slot]: remove slots that a shoot does not use, number the remaining
    bodies, and convert world poses to poses relative to parents.
    """
    size = bodies.present.sum(1)
    first = np.cumsum(size) - size
    number = first[:, None] + np.cumsum(bodies.present, 1) - 1
    has = bodies.present
    tree = np.broadcast_to(np.arange(len(size))[:, None], has.shape)[has]
    bunch = np.stack([number[:, peduncle_slots(k).stop - 1] for k in range(MAX_BUNCHES)], 1)
    order = np.argsort(leaf["slot"], axis=1, kind="stable")  # the model lists leaves in the order of their bodies
    pick = np.arange(len(order))[:, None]
    leaf = {name: value[pick, order] for name, value in leaf.items()}
    shown = leaf["present"]
    carrier = number[pick, leaf["slot"]][shown]

    model = Model.allocate(
        tree=len(size),
        body=int(size.sum()),
        bunch=int(shoots.has_bunch.sum()),
        leaf=int(shown.sum()),
        fixed=len(structure.fixed["fixed_start"]),
        tie=len(ties["slot"]),
        box=len(scene.boxes),
    )
    model.tree_first[:] = first
    model.tree_size[:] = size
    model.tree_vine[:] = shoots.vine
    model.tree_piece[:] = np.flatnonzero(structure.fixed["fixed_organ"] == int(Organ.ARM))[shoots.piece]
    model.tree_core[:] = bodies.present[:, :CORE_SLOTS].sum(1)
    model.tree_pose[:] = frames.pose(bodies.origin[:, 0], bodies.turn[:, 0])

    parent = bodies.parent[has]
    root = parent < 0
    model.body_tree[:] = tree
    model.body_parent[:] = np.where(root, -1, number[tree, np.maximum(parent, 0)])
    base = np.where(
        root[:, None], model.tree_pose[tree], frames.pose(bodies.origin, bodies.turn)[tree, np.maximum(parent, 0)]
    )
    drawn = frames.compose(frames.inverse(base), frames.pose(bodies.origin, bodies.turn)[has])
    model.body_offset[:] = drawn[:, :3]
    model.body_rest[:] = frames.normalize(drawn[:, 3:])
    for name in ("organ", "mass", "com", "inertia", "length", "radius", "drag", "strength"):
        getattr(model, f"body_{name}")[:] = getattr(bodies, name)[has]
    model.body_yield_strength[:] = parameters.cane.yield_share.value * model.body_strength
    model.body_toughness[:] = np.where(model.body_strength > 0.0, parameters.cane.toughness.value, 0.0)
    model.joint_stiffness[:] = bodies.stiffness[has]
    model.joint_damping[:] = bodies.damping[has]

    fruit = {name: value[shoots.has_bunch] for name, value in shoots.fruit.items()}
    model.bunch_body[:] = bunch[shoots.has_bunch]
    model.bunch_berries[:] = fruit["count"]
    for name in ("length", "radius", "seed", "variety", "pull"):
        getattr(model, f"bunch_{name}")[:] = fruit[name]
    strength = parameters.peduncle.bend_strength.value * fruit["strong"]
    model.bunch_bend[:] = strength * np.pi / 4.0 * portable_math.power(fruit["thick"], 3)
    model.bunch_cluster[:] = np.stack([number[:, cluster_slots(k).start] for k in range(MAX_BUNCHES)], 1)[
        shoots.has_bunch
    ]
    model.bunch_clusters[:] = np.stack([bodies.present[:, cluster_slots(k)].sum(1) for k in range(MAX_BUNCHES)], 1)[
        shoots.has_bunch
    ]
    for name, head in bodies.head.items():
        getattr(model, f"bunch_head_{name}")[:] = head[shoots.has_bunch]

    model.tie_body[:] = number[ties["shoot"], ties["slot"]]
    for name in ("point", "anchor", "wire", "stiffness", "damping", "slip", "strength"):
        getattr(model, f"tie_{name}")[:] = ties[name]

    model.leaf_body[:] = carrier
    model.leaf_base[:] = leaf["base"][shown]
    model.leaf_pose[:] = leaf["pose"][shown]
    for name in ("age", "mass", "drag"):
        getattr(model, f"leaf_{name}")[:] = leaf[name][shown]
    model.leaf_size[:] = np.sqrt(leaf["area"][shown] / leaves.BLADE_AREA)

    for name, value in structure.fixed.items():
        getattr(model, name)[:] = value
    for i, box in enumerate(scene.boxes):
        model.box_pose[i] = frames.pose(np.array([box.x, box.y, 0.0]), frames.from_yaw(box.yaw))
        model.box_size[i] = box.size
        model.box_mass[i] = box.mass
    return model
