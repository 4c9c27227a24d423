"""Generated models and packed berries from the cache on disk: bit for bit what is computed without one."""

from __future__ import annotations

import pathlib

import msgspec
import numpy as np
import pytest

from vinesim.scene import berry_packing
from vinesim.scene.generation import vineyard
from vinesim.scene.generation.vineyard import generate, generate_uncached
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene, Sun, load_scene, with_seed


@pytest.fixture(autouse=True)
def cache(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path))
    return tmp_path


def models(cache: pathlib.Path) -> list[pathlib.Path]:
    return list(cache.glob("vineyard-*.npz"))


def assert_same(a: Model, b: Model) -> None:
    for name in Model.array_fields():
        x = getattr(a, name)
        y = getattr(b, name)
        assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes()), name
    assert a.digest() == b.digest()


@pytest.mark.parametrize("name", ["demo", "vsp"])
def test_a_cached_model_is_the_computed_one(name: str, cache: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(name)
    computed = generate_uncached(scene)
    first = generate(scene)
    monkeypatch.setattr(vineyard, "_generate", None)  # from here on it must come from the disk
    second = generate(scene)
    assert_same(computed, first)
    assert_same(computed, second)
    assert second.body_mass.flags.writeable
    assert len(models(cache)) == 1


def test_whatever_shapes_a_plant_makes_another_entry(cache: pathlib.Path) -> None:
    scene = load_scene("demo")
    small = msgspec.structs.replace(scene.layout, rows=1, vines=1)
    scene = msgspec.structs.replace(scene, layout=small)
    generate(scene)
    changed: list[Scene] = [
        with_seed(scene, scene.seed + 1),
        msgspec.structs.replace(scene, season=msgspec.structs.replace(scene.season, leafiness=0.5)),
        msgspec.structs.replace(scene, boxes=()),
    ]
    digests = {generate(scene).digest(), *(generate(one).digest() for one in changed)}
    assert len(digests) == len(models(cache)) == 4
    generate(msgspec.structs.replace(scene, name="other", sun=Sun(elevation=0.3)))
    assert len(models(cache)) == 4


def test_a_parameter_of_the_plants_makes_another_model(cache: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene("demo")
    before = generate(scene).digest()
    load = vineyard.plant_parameters.load_plant

    def heavier(name: str) -> object:
        plant = load(name)
        density = msgspec.structs.replace(plant.cane.density, value=1.01 * plant.cane.density.value)
        return msgspec.structs.replace(plant, cane=msgspec.structs.replace(plant.cane, density=density))

    monkeypatch.setattr(vineyard.plant_parameters, "load_plant", heavier)
    assert generate(scene).digest() != before


def test_cached_berries_are_the_packed_ones() -> None:
    berry_packing.prototypes.cache_clear()
    first = berry_packing.prototypes()
    berry_packing.prototypes.cache_clear()
    for packed, a, b in zip(berry_packing._pack("table"), first, berry_packing.prototypes(), strict=True):
        for name in ("position", "radius", "axis", "foot", "rachis", "neighbours"):
            bits = {np.ascontiguousarray(getattr(one, name)).tobytes() for one in (packed, a, b)}
            assert len(bits) == 1, name
