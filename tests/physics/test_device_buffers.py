from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from vinesim.physics.plants.device_buffers import Memory

FIRST, SIZE = np.array([0, 2, 3, 6], np.int32), np.array([2, 1, 3, 2], np.int32)


@pytest.fixture(params=[1, 2, 3, 32])
def memory(request: pytest.FixtureRequest) -> Memory:
    memory = Memory("cpu", lanes=request.param)
    memory.arrange(FIRST, SIZE)
    memory.reach("trees", np.array([2, 0, 0, 0], np.int32), wp.int32)
    return memory


def test_every_body_has_a_place_of_its_own_a_pitch_from_its_parent(memory: Memory) -> None:
    assert len(set(memory.at.tolist())) == 8
    assert memory.at.max() < memory.places
    first = memory.arrays["tree_first"].numpy()
    for tree in range(4):
        here = memory.at[FIRST[tree] : FIRST[tree] + SIZE[tree]]
        assert here.tolist() == [first[tree] + i * memory.pitch for i in range(SIZE[tree])]
        assert here[-1] - here[0] < memory.span


def test_neighbours_lie_side_by_side() -> None:
    memory = Memory("cpu", lanes=3)
    memory.arrange(FIRST, SIZE)
    assert memory.at.tolist() == [0, 3, 1, 2, 5, 8, 9, 12]
    assert memory.places == 15


def test_rows_of_listed_trees_go_over_and_come_back(memory: Memory) -> None:
    places, numbers = np.arange(24, dtype=np.float32).reshape(8, 3), np.arange(8, dtype=np.int32)
    memory.rows("place", places, wp.vec3)
    memory.rows("number", numbers, wp.int32)
    there = memory.arrays["place"].numpy()[memory.at]
    np.testing.assert_array_equal(there, places)
    go, come = (memory.carrier(("place", "number"), "trees", back=back) for back in (False, True))
    before = places.copy()
    places += 100.0
    numbers += 100
    go(2)
    listed = np.array([1, 1, 0, 1, 1, 1, 0, 0], bool)  # trees 2 and 0
    np.testing.assert_array_equal(
        memory.arrays["place"].numpy()[memory.at], np.where(listed[:, None], before + 100.0, before)
    )
    np.testing.assert_array_equal(memory.arrays["number"].numpy()[memory.at], np.arange(8) + 100 * listed)
    places[:], numbers[:] = 0.0, 0
    come(1)
    only = np.array([0, 0, 0, 1, 1, 1, 0, 0], bool)
    np.testing.assert_array_equal(places, np.where(only[:, None], before + 100.0, 0.0))
    np.testing.assert_array_equal(numbers, (np.arange(8) + 100) * only)


def test_rows_that_name_bodies_are_translated(memory: Memory) -> None:
    parent = np.array([-1, 0, -1, -1, 3, 3, -1, 6], np.int32)
    memory.rows("parent", parent, wp.int32, points=True)
    there = memory.arrays["parent"].numpy()[memory.at]
    np.testing.assert_array_equal(there, np.where(parent >= 0, memory.at[parent], -1))
    parent[4] = -1
    memory.upload(["parent"])
    assert memory.arrays["parent"].numpy()[memory.at[4]] == -1


def test_shared_memory_is_one_memory() -> None:
    memory = Memory("cpu")
    memory.arrange(FIRST, SIZE)
    places = np.zeros((8, 3), np.float32)
    memory.rows("place", places, wp.vec3)
    assert memory.arrays["place"].ptr == places.ctypes.data
    assert memory.at.tolist() == list(range(8))
    with pytest.raises(ValueError, match="strided cannot be shared with Warp; give a C-contiguous array"):
        memory.rows("strided", np.zeros((8, 6), np.float32)[:, ::2], wp.vec3)
