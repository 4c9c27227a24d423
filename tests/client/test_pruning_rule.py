"""The rule of pruning: which canes stay, where the others are cut; and where the mouth of a cutter goes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from vinesim.client.tasks.pruning import ABOVE_BUD, REMOVED_AT, PruningRule, placed, plan_pruning, prune, rating
from vinesim.core.errors import UsageError
from vinesim.interaction.cutting_force import shear_force
from vinesim.robot.description.loader import load_description
from vinesim.robot.tasks.mouth_place import KINDS, HandShape, Wood, mouth_place
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.nodes import DormantCanes, Nodes, no_canes, no_nodes
from vinesim.scene.spec import load_scene

RULE = PruningRule()


def canes(**changes) -> DormantCanes:
    """A piece of two-year wood (0) with three canes of last year (1, 2, 3), of which 2 is the wanted one."""
    table = DormantCanes.allocate(cane=4)
    table.year[:] = [2, 1, 1, 1]
    table.body[:] = [0, 1, 11, 21]
    table.size[:] = [1, 10, 10, 10]
    table.parent[:] = [-1, 0, 0, 0]
    table.diameter[:] = [0.015, 0.0082, 0.0092, 0.0101]
    table.length[:] = [0.1, 0.95, 1.05, 1.10]
    table.from_trunk[:] = 0.11
    table.height[:] = 0.83
    for name, values in changes.items():
        getattr(table, name)[1:] = values
    return table


def nodes() -> Nodes:
    """Five nodes with buds on each cane, 6 cm apart; the first one is 4 cm above the cane's base."""
    table = Nodes.allocate(node=15)
    table.cane[:] = np.repeat([1, 2, 3], 5)
    table.rank[:] = np.tile(np.arange(5), 3)
    table.bud[:] = np.arange(15)
    place = 0.04 + 0.06 * np.arange(5)
    body, along = np.divmod(place, 0.08)
    table.body[:] = np.concatenate([first + body for first in (1, 11, 21)])
    table.along[:] = np.tile(along, 3)
    return table


def test_the_cane_nearest_to_the_published_means_stays_with_two_buds_and_the_others_go():
    cuts = prune(nodes(), canes(), RULE)
    assert [(cut.cane, cut.is_kept) for cut in cuts] == [(2, True), (3, False), (1, False)]
    kept = cuts[0]
    # the second bud is 0.10 m from the base: in the second body, 20 mm from its origin
    assert (kept.body, kept.along) == (12, pytest.approx(0.02 + ABOVE_BUD))
    # between the base and the first node, which is 0.04 m above it
    assert all(
        (cut.body, cut.along) == (first, pytest.approx(REMOVED_AT * 0.04))
        for cut, first in zip(cuts[1:], (21, 1), strict=True)
    )


def test_the_rule_rates_by_all_four_measures_and_excludes_by_thickness_and_length():
    assert np.argmin(rating(canes(), RULE)) == 2
    assert rating(canes(), RULE)[2] == pytest.approx(0.0, abs=1e-4)
    assert np.isinf(rating(canes(), RULE)[0])  # two-year wood
    for name, far in (("from_trunk", 0.5), ("height", 1.0)):
        assert np.argmin(rating(canes(**{name: [0.11 if name == "from_trunk" else 0.83, far, far]}), RULE)) == 1
    assert np.isinf(rating(canes(diameter=[0.0069, 0.0121, 0.009]), RULE)[1:]).tolist() == [True, True, False]
    assert np.isinf(rating(canes(length=[0.59, 0.61, 1.0]), RULE)[1:]).tolist() == [True, False, False]


def test_a_rule_that_no_cane_satisfies_is_one_clear_line():
    with pytest.raises(
        UsageError, match=r"^no cane of 3 satisfies the rule: 7 to 12 mm thick, .* 13.0 mm and up to 1.10 m$"
    ):
        prune(nodes(), canes(diameter=[0.004, 0.013, 0.013]), RULE)
    with pytest.raises(UsageError, match="there is no dormant cane to prune; give a scene with a date in winter"):
        prune(no_nodes(), no_canes(), RULE)
    with pytest.raises(UsageError, match="rule: buds is 0; give 1 or more"):
        PruningRule(buds=0)
    with pytest.raises(UsageError, match="rule: of is 'row'; give 'spur' or 'vine'"):
        PruningRule(of="row")


def test_a_cane_without_further_buds_is_not_shortened():
    cuts = prune(nodes(), canes(), dataclasses.replace(RULE, buds=5))
    assert [cut.cane for cut in cuts] == [3, 1]


def test_each_spur_of_a_dormant_vine_keeps_one_cane_with_two_buds():
    model = generate(load_scene("winter_spur"))
    cuts = [placed(model, cut) for cut in prune(model.nodes, model.canes, RULE)]
    last = np.flatnonzero(model.canes.year == 1)
    spurs, count = np.unique(model.canes.parent[last], return_counts=True)
    assert len(cuts) == len(last)
    assert sum(cut.is_kept for cut in cuts) == len(spurs)
    assert count.max() == 2
    for cut in cuts:
        assert 0.0 <= cut.along <= model.body_length[cut.body]
        mine = np.flatnonzero((model.nodes.cane == cut.cane) & (model.nodes.bud >= 0))
        first = int(model.canes.body[cut.cane])
        along = [float(model.body_length[first : int(model.nodes.body[i])].sum() + model.nodes.along[i]) for i in mine]
        at = float(model.body_length[first : cut.body].sum()) + cut.along
        assert sum(bud < at for bud in along) == (RULE.buds if cut.is_kept else 0)


def test_stops_stand_along_the_row_with_the_row_to_the_left_of_the_robot():
    model = generate(load_scene("winter_spur"))
    stops = plan_pruning(model, np.array([3.5, 1.3]), RULE, spurs=3)
    assert len(stops) == 3
    for stop in stops:
        assert len({int(model.body_tree[cut.body]) for cut in stop.cuts}) == 1
        assert [cut.is_kept for cut in stop.cuts] == sorted((cut.is_kept for cut in stop.cuts), reverse=True)


def test_cane_pruned_vines_lose_their_fruiting_canes_and_keep_a_cane_and_a_spur_on_either_side():
    model = generate(load_scene("winter_cane"))
    canes = model.canes
    cuts = prune(model.nodes, canes, RULE)
    for vine in np.unique(canes.vine):
        mine = [cut for cut in cuts if canes.vine[cut.cane] == vine]
        removed = [cut.cane for cut in mine if not cut.is_kept]
        assert len(removed) == 2
        assert (canes.year[removed] == 2).all()
        assert ((canes.parent[:, None] == removed).sum(0) > 3).all()
        buds = sorted(_buds_below(model, cut) for cut in mine if cut.is_kept)
        assert buds == [RULE.buds, RULE.buds, RULE.cane_buds, RULE.cane_buds]


def _buds_below(model, cut) -> int:
    nodes = model.nodes
    mine = (nodes.cane == cut.cane) & (nodes.bud >= 0)
    before = (nodes.body < cut.body) | ((nodes.body == cut.body) & (nodes.along < cut.along))
    return int((mine & before).sum())


def test_the_blades_of_the_robot_cut_dormant_canes_of_5_to_12_mm_at_once_and_two_of_10_mm():
    strength = load_scene("winter_spur").physics.cutting_strength
    assert strength == load_scene("winter_cane").physics.cutting_strength == 17.8e6
    for cutter in load_description("vinebot").cutters:
        assert cutter.force > shear_force(0.012, strength)
        assert cutter.force > 2.0 * shear_force(0.010, strength)
        assert 2.0 * cutter.half[1] > 3.0 * 0.012


HAND = HandShape(
    middle=np.array([[-0.032, 0.023, 0.0], [-0.032, -0.023, 0.0]]),
    half=np.array([[0.057, 0.003, 0.003], [0.057, 0.003, 0.003]]),
    mouth=np.array([0.025, 0.020, 0.004]),
)
"""The bars of a cutter whose mouth is 40 mm wide."""
AHEAD = np.array([0.0, 1.0, 0.0])


def wood(*beside: tuple[float, float], kind: str = "bud") -> Wood:
    """Upright canes of 10 mm at distances (along the row, ahead) [m] from the cane that is cut."""
    heights = np.linspace(-0.03, 0.03, 9)
    places = np.array([(0.0, 0.0), *beside])
    point = np.array([(x, y, z) for x, y in places for z in heights])
    own = np.repeat(np.arange(len(places)) == 0, len(heights))
    kinds = np.where(own, KINDS.index("loose"), KINDS.index(kind))
    return Wood(point, np.full(len(point), 0.005), kinds, own, np.array([0.0, 0.0, 1.0]))


def gap_to_hand(place, point: np.ndarray) -> float:
    """The least distance [m] of an upright cane of 10 mm at ``point`` [2] from the bars in their final place."""
    right = np.array([place.ahead[1], -place.ahead[0]])
    at = np.array([point @ place.ahead[:2] + place.depth, point @ right + place.side])
    outside = np.maximum(np.abs(at - HAND.middle[:, :2]) - HAND.half[:, :2], 0.0)
    return float(np.linalg.norm(outside, axis=1).min()) - 0.005


def test_a_cane_alone_is_taken_in_the_middle_of_the_mouth_from_straight_ahead():
    place = mouth_place(wood(), HAND, AHEAD, 0.18)
    assert (place.depth, place.side, place.slide, place.cost) == (0.0, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(place.ahead, AHEAD, atol=1e-12)


@pytest.mark.parametrize("off", [(0.018, 0.0), (-0.018, 0.0), (0.024, 0.0), (0.0, 0.030), (-0.012, 0.020)])
def test_a_cane_that_stays_is_neither_in_the_mouth_nor_under_its_bars(off):
    place = mouth_place(wood(off), HAND, AHEAD, 0.18)
    assert gap_to_hand(place, np.array(off)) > 0.0
    right = np.array([place.ahead[1], -place.ahead[0]])
    at = np.array([np.array(off) @ place.ahead[:2] + place.depth, np.array(off) @ right + place.side])
    assert (np.abs(at) > HAND.mouth[:2] + 0.003).any()
    # the cane that is cut is in the mouth
    assert abs(place.depth) <= HAND.mouth[0] - 0.005
    assert abs(place.side) <= HAND.mouth[1] - 0.005


def test_a_cane_that_goes_too_may_be_in_the_mouth_and_the_place_tells():
    off = (0.003, 0.002)  # the canes cross at the height of the cut
    assert mouth_place(wood(off, kind="goes"), HAND, AHEAD, 0.18).catches
    assert not mouth_place(wood(off, kind="loose"), HAND, AHEAD, 0.18).catches


def test_a_direction_in_vain_is_not_taken_again():
    first = mouth_place(wood(), HAND, AHEAD, 0.18)
    second = mouth_place(wood(), HAND, AHEAD, 0.18, [first.ahead])
    assert first.ahead @ second.ahead < np.cos(0.2)
