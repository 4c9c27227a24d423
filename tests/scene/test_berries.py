"""Berries: packed without overlap, requested count, deterministic by seed."""

import numpy as np
import pytest

from vinesim.scene import berries
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene


def distances(bunch, radius):
    distance = np.linalg.norm(bunch.position[:, None] - bunch.position[None], axis=2)
    return distance + np.diag(np.full(len(radius), np.inf)), radius[:, None] + radius[None]


@pytest.mark.parametrize("which", range(len(berries.prototypes())))
def test_prototypes_are_dense_and_do_not_overlap(which):
    bunch = berries.prototypes()[which]
    distance, touching = distances(bunch, bunch.radius)
    assert (touching - distance).max() < 0.04 * bunch.radius.mean()
    assert (distance < 1.03 * touching).sum(1).mean() > 5.0
    assert np.linalg.norm(bunch.position - bunch.foot, axis=1).max() < 6.0


def test_shapes_differ_and_taper():
    """Slenderness varies, and most bunches are wider at the shoulder than near the tip."""
    slender = []
    taper = []
    for bunch in berries.prototypes():
        x = bunch.position[:, 0]
        across = np.hypot(*bunch.position[:, 1:].T)
        slender.append(x.max() / across.max())
        taper.append(across[x < np.quantile(x, 0.5)].max() / across[x > np.quantile(x, 0.85)].max())
    assert np.ptp(slender) > 0.6
    assert np.median(taper) > 1.25
    assert {len(b.rachis) for b in berries.prototypes()} == {1, 2, 3}


@pytest.mark.parametrize("count", [40, 64, 65, 99, 140])
@pytest.mark.parametrize("variety", range(len(berries.VARIETIES)))
def test_a_bunch_has_its_count_and_fits_its_hull(count, variety):
    kind = berries.VARIETIES[variety]
    length, radius = berries.hull_size(count, 5) * kind.volume_radius
    bunch = berries.lay_out_berries(length, radius, count, variety, 5)
    assert len(bunch.position) == len(bunch.radius) == len(bunch.axis) == len(bunch.foot) == count
    assert bunch.radius.mean() == pytest.approx(kind.radius, rel=0.03)
    full = bunch.radius * kind.elongation ** (1.0 / 3.0)
    distance, touching = distances(bunch, full)
    assert (touching - distance).max() < 0.04 * kind.volume_radius
    assert (bunch.position[:, 0] + full).max() == pytest.approx(length, rel=1e-3)
    assert (bunch.position[:, 0] - full).min() > -1e-6
    across = np.hypot(*bunch.position[:, 1:].T) + full
    assert 0.85 < (across <= radius * 1.001).mean() <= 1.0
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
    before = [b.position.copy() for b in berries.prototypes()]
    berries.prototypes.cache_clear()
    assert all(np.array_equal(a, b.position) for a, b in zip(before, berries.prototypes(), strict=True))


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
