from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from vinesim.plants.device_buffers import DeviceBuffers

FIRST = np.array([0, 2, 3, 6], np.int32)
SIZE = np.array([2, 1, 3, 2], np.int32)


@pytest.fixture(params=[1, 2, 3, 32])
def buffers(request: pytest.FixtureRequest) -> DeviceBuffers:
    buffers = DeviceBuffers("cpu", interleave=request.param)
    buffers.set_layout(FIRST, SIZE)
    buffers.add_shared("trees", np.array([2, 0, 0, 0], np.int32), wp.int32)
    return buffers


def test_every_body_has_its_own_slot_one_pitch_from_its_parent(buffers: DeviceBuffers) -> None:
    assert len(set(buffers.slots.tolist())) == 8
    assert buffers.slots.max() < buffers.slot_count
    first = buffers.arrays["tree_first"].numpy()
    for tree in range(4):
        slots = buffers.slots[FIRST[tree] : FIRST[tree] + SIZE[tree]]
        assert slots.tolist() == [first[tree] + i * buffers.pitch for i in range(SIZE[tree])]
        assert slots[-1] - slots[0] < buffers.max_tree_extent


def test_neighbouring_trees_are_interleaved() -> None:
    buffers = DeviceBuffers("cpu", interleave=3)
    buffers.set_layout(FIRST, SIZE)
    assert buffers.slots.tolist() == [0, 3, 1, 2, 5, 8, 9, 12]
    assert buffers.slot_count == 15


def test_rows_of_listed_trees_are_uploaded_and_downloaded(buffers: DeviceBuffers) -> None:
    positions = np.arange(24, dtype=np.float32).reshape(8, 3)
    numbers = np.arange(8, dtype=np.int32)
    buffers.add_body_rows("place", positions, wp.vec3)
    buffers.add_body_rows("number", numbers, wp.int32)
    on_device = buffers.arrays["place"].numpy()[buffers.slots]
    np.testing.assert_array_equal(on_device, positions)
    names = ("place", "number")
    count = wp.array([2], dtype=wp.int32, device="cpu")
    upload, download = (buffers.row_copier(names, "trees", count, to_host=back) for back in (False, True))
    before = positions.copy()
    positions += 100.0
    numbers += 100
    upload(2)
    listed = np.array([1, 1, 0, 1, 1, 1, 0, 0], bool)  # trees 2 and 0
    np.testing.assert_array_equal(
        buffers.arrays["place"].numpy()[buffers.slots], np.where(listed[:, None], before + 100.0, before)
    )
    np.testing.assert_array_equal(buffers.arrays["number"].numpy()[buffers.slots], np.arange(8) + 100 * listed)
    positions[:] = 0.0
    numbers[:] = 0
    count.fill_(1)
    download(1)
    returned = np.array([0, 0, 0, 1, 1, 1, 0, 0], bool)
    np.testing.assert_array_equal(positions, np.where(returned[:, None], before + 100.0, 0.0))
    np.testing.assert_array_equal(numbers, (np.arange(8) + 100) * returned)


def test_rows_of_body_indices_are_translated_to_slots(buffers: DeviceBuffers) -> None:
    parent = np.array([-1, 0, -1, -1, 3, 3, -1, 6], np.int32)
    buffers.add_body_rows("parent", parent, wp.int32, body_indices=True)
    on_device = buffers.arrays["parent"].numpy()[buffers.slots]
    np.testing.assert_array_equal(on_device, np.where(parent >= 0, buffers.slots[parent], -1))
    parent[4] = -1
    buffers.upload(["parent"])
    assert buffers.arrays["parent"].numpy()[buffers.slots[4]] == -1


def test_on_the_cpu_host_memory_is_shared() -> None:
    buffers = DeviceBuffers("cpu")
    buffers.set_layout(FIRST, SIZE)
    positions = np.zeros((8, 3), np.float32)
    buffers.add_body_rows("place", positions, wp.vec3)
    assert buffers.arrays["place"].ptr == positions.ctypes.data
    assert buffers.slots.tolist() == list(range(8))
    with pytest.raises(ValueError, match="strided cannot be shared with Warp; give a C-contiguous array"):
        buffers.add_body_rows("strided", np.zeros((8, 6), np.float32)[:, ::2], wp.vec3)
