"""Interest: the cell window always covers the interest radius, and listeners are counted by distance."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vinesim.net.replication import interest

metres = st.floats(-200, 200)
points = st.tuples(metres, metres)


def test_cell_indices_on_both_sides_of_the_origin():
    assert interest.cell_of(np.array([0.0, 0.0, 5.0])) == (0, 0)
    assert interest.cell_of(np.array([-0.1, 8.0])) == (-1, 1)
    many = np.array([[0.0, 0.0, 5.0], [-0.1, 8.0, 0.0]])
    assert [tuple(cell) for cell in interest.cells_of(many).tolist()] == [(0, 0), (-1, 1)]


@given(st.lists(points, min_size=1, max_size=30), points)
def test_the_window_covers_the_interest_radius_on_any_path(walk, direction):
    middle = None
    for here in walk:
        middle = interest.move_window(middle, np.array(here))
        offset = np.array(direction) / max(np.hypot(*direction), 1e-9) * (interest.MAX_INTEREST_RADIUS - 1e-6)
        assert interest.cell_of(np.array(here) + offset) in interest.cell_window(middle)


def test_the_window_has_hysteresis_at_a_cell_edge():
    middle = interest.move_window(None, np.array([5.9, 4.0]))
    middles = {middle}
    for k in range(100):
        middle = interest.move_window(middle, np.array([6.0 + 0.9 * (-1) ** k, 4.0]))
        middles.add(middle)
    assert middles == {(0, 0)}
    assert interest.move_window(middle, np.array([7.1, 4.0])) == (1, 0)


def test_a_window_is_nine_cells():
    assert len(interest.cell_window((2, -3))) == 9
    assert {(1, -4), (3, -2), (2, -3)} <= interest.cell_window((2, -3))


@given(st.lists(points, max_size=6), st.lists(points, max_size=6), st.floats(0.1, 5.0))
def test_listeners_are_counted_by_the_exact_distance(trees, actors, radius):
    tree, actor = (np.array([(*p, 1.0) for p in ps]).reshape(-1, 3) for ps in (trees, actors))
    expected = [sum((t[0] - a[0]) ** 2 + (t[1] - a[1]) ** 2 <= radius * radius for a in actor) for t in tree]
    assert interest.count_listeners(tree, actor, radius).tolist() == expected


def test_height_does_not_count():
    assert interest.count_listeners(np.array([[0.0, 0.0, 2.0]]), np.array([[0.0, 4.9, -30.0]]), 5.0).tolist() == [1]


@pytest.mark.parametrize("radius", [0.0, -1.0, 5.01, float("nan")])
def test_a_radius_that_cells_cannot_cover_is_refused(radius):
    with pytest.raises(ValueError, match=r"at most 5\.0 m"):
        interest.check_radius(radius)


def test_layers_of_poses_have_hysteresis():
    assert [interest.count_layers(d, 1) for d in (2.9, 3.1, 6.1, 12.1)] == [4, 3, 2, 1]
    assert [interest.count_layers(d, 4) for d in (3.5, 3.7, 7.1, 7.3, 14.3, 14.5)] == [4, 3, 3, 2, 2, 1]


@given(st.floats(0.05, interest.BODY_DISTANCE))
def test_the_rate_of_poses_falls_with_the_distance(distance):
    """Rate times distance is bounded both ways: what moves at 1 m/s moves by 1/180 to 1/90 rad between two poses."""
    received = interest.count_layers(distance, 1)
    rate = interest.POSE_RATE / interest.POSE_LAYERS[received - 1].every
    assert rate == 60.0 or distance * rate >= 90.0 - 1e-9 or rate == 5.0
    assert rate == 5.0 or distance * rate <= 180.0 + 1e-9


@given(st.integers(1, 4), st.lists(st.integers(1, 30), min_size=5, max_size=200))
def test_a_receiver_of_some_layers_gets_their_rate_at_any_rate_of_steps(layers, gaps):
    """Of ``gaps`` poses from step to step: less than ``every`` poses and one step lie between two that are received."""
    before = 0
    received = [0]
    for gap in gaps:
        number = before + gap
        if interest.pose_layer(before, number) < layers:
            received.append(number)
        before = number
    every = interest.POSE_LAYERS[layers - 1].every
    assert all(b - a < every + max(gaps) for a, b in zip(received, [*received[1:], before], strict=True))
    if max(gaps) == 1:
        assert len(received) - 1 == before // every


@given(points, st.floats(0.1, 6.0), st.floats(0.0, 2 * np.pi), st.floats(0.0, 1.0))
def test_the_cells_of_trees_cover_a_circle_and_no_more(position, distance, angle, share):
    cells = interest.tree_cells_within(np.array(position), distance)
    inside = np.array(position) + share * (distance - 1e-6) * np.array([np.cos(angle), np.sin(angle)])
    assert tuple(interest.cells_of(inside[None], interest.TREE_CELL_SIZE)[0].tolist()) in cells
    for cell in cells:
        low = interest.TREE_CELL_SIZE * np.array(cell)
        nearest = np.clip(position, low, low + interest.TREE_CELL_SIZE)
        assert np.hypot(*(nearest - position)) <= distance + 1e-9


def test_an_error_of_a_tree_is_seen_at_no_larger_angle_from_farther_away():
    """Each layer's tolerance is at most that of the nearest, times how much farther away its receivers are than 1 m."""
    layers = sorted(interest.TREE_LAYERS, key=lambda layer: layer.distance)
    assert layers[0].tolerance == 1.0
    for near, far in itertools.pairwise(layers):
        assert far.tolerance <= near.distance


def test_a_cell_of_events_consists_of_whole_cells_of_trees():
    """So the claims of the trees of one cell share a message."""
    assert interest.CELL_SIZE % interest.TREE_CELL_SIZE == 0.0
