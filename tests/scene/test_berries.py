"""Berries: packed without overlap, requested count, deterministic by seed."""

import msgspec
import numpy as np
import pytest

from vinesim.scene import berries, berry_packing
from vinesim.scene.generation.vineyard import generate, generate_uncached
from vinesim.scene.spec import Fruit, load_scene


def distances(bunch, radius):
    distance = np.linalg.norm(bunch.position[:, None] - bunch.position[None], axis=2)
    return distance + np.diag(np.full(len(radius), np.inf)), radius[:, None] + radius[None]


@pytest.mark.parametrize("which", range(len(berry_packing.prototypes())))
def test_prototypes_are_dense_and_do_not_overlap(which):
    bunch = berry_packing.prototypes()[which]
    distance, touching = distances(bunch, bunch.radius)
    assert (touching - distance).max() < 0.04 * bunch.radius.mean()
    assert (distance < 1.03 * touching).sum(1).mean() > 5.0
    assert np.linalg.norm(bunch.position - bunch.foot, axis=1).max() < 6.0


def test_shapes_differ_and_taper():
    """Slenderness varies, and most bunches are wider at the shoulder than near the tip."""
    slender = []
    taper = []
    for bunch in berry_packing.prototypes():
        x = bunch.position[:, 0]
        across = np.hypot(*bunch.position[:, 1:].T)
        slender.append(x.max() / across.max())
        taper.append(across[x < np.quantile(x, 0.5)].max() / across[x > np.quantile(x, 0.85)].max())
    assert np.ptp(slender) > 0.6
    assert np.median(taper) > 1.25
    assert {len(b.rachis) for b in berry_packing.prototypes()} == {1, 2, 3}


@pytest.mark.parametrize("count", [40, 64, 65, 99, 140])
@pytest.mark.parametrize("variety", range(len(berries.VARIETIES)))
def test_a_bunch_has_its_count_and_fits_its_hull(count, variety):
    kind = berries.VARIETIES[variety]
    length, radius = berries.hull_size(count, 5, variety) * kind.volume_radius
    bunch = berries.lay_out_berries(length, radius, count, variety, 5)
    assert len(bunch.position) == len(bunch.radius) == len(bunch.axis) == len(bunch.foot) == count
    assert bunch.radius.mean() == pytest.approx(kind.radius, rel=0.03)
    full = bunch.radius * kind.elongation ** (1.0 / 3.0)
    distance, touching = distances(bunch, full)
    if kind.style == "table":
        assert (touching - distance).max() < 0.04 * kind.volume_radius
    assert (1.0 - distance / touching).max() <= berry_packing.MAX_OVERLAP
    assert (bunch.position[:, 0] + full).max() == pytest.approx(length, rel=1e-3)
    assert (bunch.position[:, 0] - full).min() > -1e-6
    across = np.hypot(*bunch.position[:, 1:].T) + full
    assert 0.82 < (across <= radius * 1.001).mean() <= 1.0
    assert np.allclose(np.linalg.norm(bunch.axis, axis=1), 1.0)


def test_neighbours_are_the_nearest():
    bunch = berries.lay_out_berries(0.18, 0.05, 90, 0, 1)
    distance = distances(bunch, bunch.radius)[0]
    for i in range(90):
        near = bunch.neighbours[i][bunch.neighbours[i] >= 0]
        assert near.max() < 90
        assert distance[i].argmin() in near
        assert (np.diff(distance[i][near]) >= 0.0).all()


def test_berries_are_determined_by_the_seed():
    one, two, other = (berries.lay_out_berries(0.18, 0.05, 90, 0, seed) for seed in (4, 4, 5))
    berries._scaled.cache_clear()
    recomputed = berries.lay_out_berries(0.18, 0.05, 90, 0, 4)
    assert np.array_equal(one.position, two.position)
    assert np.array_equal(one.position, recomputed.position)
    assert not np.array_equal(one.position, other.position)


def test_prototypes_are_deterministic():
    before = [b.position.copy() for b in berry_packing.prototypes()]
    berry_packing.prototypes.cache_clear()
    assert all(np.array_equal(a, b.position) for a, b in zip(before, berry_packing.prototypes(), strict=True))


def test_too_many_berries_are_refused():
    with pytest.raises(ValueError, match="1 to 140 berries, not 141"):
        berries.lay_out_berries(0.2, 0.05, 141, 0, 0)


def test_mass_of_a_bunch_is_that_of_its_berries():
    model = generate(load_scene("demo"))
    for i in range(0, len(model.bunch_body), 7):
        kind = berries.VARIETIES[model.bunch_variety[i]]
        bunch = berries.lay_out_berries(
            model.bunch_length[i],
            model.bunch_radius[i],
            model.bunch_berries[i],
            model.bunch_variety[i],
            model.bunch_seed[i],
        )
        mass = berries.DENSITY * 4.0 / 3.0 * np.pi * (bunch.radius**3 * kind.elongation).sum()
        assert mass == pytest.approx(0.97 * model.body_mass[model.bunch_body[i]], rel=0.07)


STYLES = ("loose", "medium", "dense")
WINES = [v.name for v in berries.VARIETIES if v.style != "table"]


@pytest.mark.parametrize("style", STYLES)
def test_berries_of_wine_grapes_touch_and_overlap_within_the_bound(style):
    """Two balls that overlap by h each lose caps of pi h^2 (3 r - h) / 3: the berries' volume is nearly that of their
    union."""
    for bunch in berry_packing.prototypes(style):
        distance, touching = distances(bunch, bunch.radius)
        overlap = np.maximum(1.0 - distance / touching, 0.0)
        assert overlap.max() <= berry_packing.MAX_OVERLAP
        assert (distance < 1.05 * touching).sum(1).mean() > 2.5
        depth = 0.5 * np.maximum(touching - distance, 0.0)
        caps = np.pi * depth**2 * (3.0 * bunch.radius[:, None] - depth) / 3.0
        assert caps.sum() < 0.04 * (4.0 / 3.0 * np.pi * bunch.radius**3).sum()
        assert (bunch.radius**3).mean() == pytest.approx(1.0, rel=1e-6)


def test_denser_bunches_have_more_neighbours_and_less_room():
    neighbours = []
    room = []
    for style in STYLES:
        bunches = berry_packing.prototypes(style)
        neighbours.append(np.mean([(d < 1.05 * t).sum(1).mean() for d, t in (distances(b, b.radius) for b in bunches)]))
        hulls = [np.ptp(b.position[:, 0]) * np.hypot(*b.position[:, 1:].T).max() ** 2 / len(b.radius) for b in bunches]
        room.append(np.mean(hulls))
    assert np.all(np.diff(neighbours) > 0.5)
    assert np.all(np.diff(room) < 0.0)


def test_some_bunches_of_wine_grapes_have_shoulders_and_wings():
    """A wing makes the bunch lopsided near its top; a shape without wings is even."""
    lopsided = {}
    for bunch_number, bunch in enumerate(berry_packing.prototypes("dense")):
        top = bunch.position[:, 0] < np.quantile(bunch.position[:, 0], 0.4)
        across = bunch.position[top, 1:].mean(0)
        lopsided.setdefault(bunch_number % berry_packing.shapes_of("dense"), []).append(float(np.hypot(*across)))
    assert np.mean(lopsided[2]) > 2.0 * np.mean(lopsided[0])


def wine_scene(name):
    scene = load_scene("vsp")
    layout = msgspec.structs.replace(scene.layout, rows=1, vines=6)
    return msgspec.structs.replace(scene, layout=layout, boxes=(), fruit=Fruit(bunches=(26, 26), varieties=(name,)))


@pytest.mark.parametrize("name", WINES)
def test_bunches_of_wine_grapes_have_the_masses_of_their_file(name):
    """Count times mass of a berry, plus stems, is the mass of the bunch; the mean is that of the lognormal distribution
    within its range; a bunch's primitive berries weigh what its body weighs."""
    model = generate(wine_scene(name))
    kind = berries.VARIETIES[int(model.bunch_variety[0])]
    mass = model.body_mass[model.bunch_body].astype(float)
    assert kind.name == name
    low, high = kind.bunch_mass_range
    assert low * 0.9999 <= mass.min() <= mass.max() <= high * 1.0001
    assert mass.mean() == pytest.approx(kind.bunch_mass, rel=0.12)
    assert model.bunch_berries.max() <= berries.most_berries(model.bunch_variety[0]) == 200
    assert 0.97 * mass / model.bunch_berries == pytest.approx(np.full(len(mass), kind.mass), rel=0.02)
    for i in range(0, len(mass), 9):
        args = (model.bunch_length[i], model.bunch_radius[i], model.bunch_berries[i], model.bunch_variety[i])
        bunch = berries.lay_out_berries(*args, model.bunch_seed[i])
        weight = berries.DENSITY * 4.0 / 3.0 * np.pi * (bunch.radius**3 * kind.elongation).sum()
        assert weight == pytest.approx(0.97 * mass[i], rel=0.07)
        first = int(model.bunch_cluster[i])
        parts = model.body_mass[first : first + model.bunch_clusters[i]].sum() + model.bunch_head_mass[i]
        assert parts == pytest.approx(mass[i], rel=1e-5)
    assert 0.05 < model.bunch_length.min() < model.bunch_length.max() < 0.24


@pytest.mark.parametrize("name", ["chardonnay", "syrah"])
def test_vineyards_of_wine_grapes_are_deterministic(name):
    one, other = (generate_uncached(wine_scene(name)) for _ in range(2))
    assert one.digest() == other.digest() == generate(wine_scene(name)).digest()


def test_wine_grapes_are_small_and_light():
    for kind in berries.VARIETIES:
        if kind.style != "table":
            assert 0.0009 < kind.mass < 0.0017
            assert 0.09 < kind.bunch_mass < 0.25
