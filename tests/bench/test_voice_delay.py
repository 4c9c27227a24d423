"""The stages of ``python -m benchmarks voice``: the first frame of each burst is followed through all of them."""

import numpy as np

from benchmarks.voice_delay import STAGES, _stages


def test_the_stages_of_a_burst_are_those_of_its_first_frame_and_add_up_to_its_way():
    """Frames of 20 ms; those of silence are not sent, some are still on their way when a burst
    begins, and some are the same as others before."""
    said = np.array([85.0, 145.0, 185.0])
    took = np.array([80.0, 90.0, np.nan])
    full = 20.0 * np.arange(1, 11)
    sent = np.delete(np.arange(10), 4)  # the fifth was silence
    times = {
        "full": [(at, "") for at in full],
        "sent": [(full[k] + 1.0, str(k % 6)) for k in sent],
        "received": [(full[k] + 46.0, str(k % 6)) for k in sent],
        "decoded": [(full[k] + 48.0, "") for k in sent],
    }
    stages = _stages(said, took, times)
    assert len(stages) == len(STAGES)
    np.testing.assert_allclose(stages[:, 0], [35.0, 1.0, 45.0, 2.0, -3.0], err_msg="its frame is full at 120 ms")
    np.testing.assert_allclose(stages[:, 1], [15.0, 1.0, 45.0, 2.0, 27.0])
    np.testing.assert_allclose(stages[:, :2].sum(0), took[:2])
    assert np.isnan(stages[4, 2]), "a burst that was not heard"
    assert np.isnan(_stages(np.array([500.0]), np.array([9.0]), times)).all(), "no frame after it"
