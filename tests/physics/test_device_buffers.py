from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from vinesim.physics.plants.device_buffers import DeviceBuffers

FIRST, SIZE = np.array([0, 2, 3, 6], np.int32), np.array([2, 1, 3, 2], np.int32)


@pytest.fixture(params=[1, 2, 3, 32])
def memory(request: pytest.FixtureRequest) -> DeviceBuffers:
    memory = DeviceBuffers("cpu", interleave=request.param)
    memory.set_layout(FIRST, SIZE)
    memory.add_shared("trees", np.array([2, 0, 0, 0], np.int32), wp.int32)
    return memory


def test_every_body_has_a_place_of_its_own_a_pitch_from_its_parent(memory: DeviceBuffers) -> None:
    assert len(set(memory.slots.tolist())) == 8
    assert memory.slots.max() < memory.slot_count
    first = memory.arrays["tree_first"].numpy()
    for tree in range(4):
        here = memory.slots[FIRST[tree] : FIRST[tree] + SIZE[tree]]
        assert here.tolist() == [first[tree] + i * memory.pitch for i in range(SIZE[tree])]
        assert here[-1] - here[0] < memory.max_tree_extent


def test_neighbours_lie_side_by_side() -> None:
    memory = DeviceBuffers("cpu", interleave=3)
    memory.set_layout(FIRST, SIZE)
    assert memory.slots.tolist() == [0, 3, 1, 2, 5, 8, 9, 12]
    assert memory.slot_count == 15


def test_rows_of_listed_trees_go_over_and_come_back(memory: DeviceBuffers) -> None:
    places, numbers = np.arange(24, dtype=np.float32).reshape(8, 3), np.arange(8, dtype=np.int32)
    memory.add_body_rows("place", places, wp.vec3)
    memory.add_body_rows("number", numbers, wp.int32)
    there = memory.arrays["place"].numpy()[memory.slots]
    np.testing.assert_array_equal(there, places)
    go, come = (memory.row_copier(("place", "number"), "trees", to_host=back) for back in (False, True))
    before = places.copy()
    places += 100.0
    numbers += 100
    go(2)
    listed = np.array([1, 1, 0, 1, 1, 1, 0, 0], bool)  # trees 2 and 0
    np.testing.assert_array_equal(
        memory.arrays["place"].numpy()[memory.slots], np.where(listed[:, None], before + 100.0, before)
    )
    np.testing.assert_array_equal(memory.arrays["number"].numpy()[memory.slots], np.arange(8) + 100 * listed)
    places[:], numbers[:] = 0.0, 0
    come(1)
    only = np.array([0, 0, 0, 1, 1, 1, 0, 0], bool)
    np.testing.assert_array_equal(places, np.where(only[:, None], before + 100.0, 0.0))
    np.testing.assert_array_equal(numbers, (np.arange(8) + 100) * only)


def test_rows_that_name_bodies_are_translated(memory: DeviceBuffers) -> None:
    parent = np.array([-1, 0, -1, -1, 3, 3, -1, 6], np.int32)
    memory.add_body_rows("parent", parent, wp.int32, body_indices=True)
    there = memory.arrays["parent"].numpy()[memory.slots]
    np.testing.assert_array_equal(there, np.where(parent >= 0, memory.slots[parent], -1))
    parent[4] = -1
    memory.upload(["parent"])
    assert memory.arrays["parent"].numpy()[memory.slots[4]] == -1


def test_shared_memory_is_one_memory() -> None:
    memory = DeviceBuffers("cpu")
    memory.set_layout(FIRST, SIZE)
    places = np.zeros((8, 3), np.float32)
    memory.add_body_rows("place", places, wp.vec3)
    assert memory.arrays["place"].ptr == places.ctypes.data
    assert memory.slots.tolist() == list(range(8))
    with pytest.raises(ValueError, match="strided cannot be shared with Warp; give a C-contiguous array"):
        memory.add_body_rows("strided", np.zeros((8, 6), np.float32)[:, ::2], wp.vec3)
