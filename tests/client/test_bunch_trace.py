import numpy as np
import pytest

from vinesim.client.recording.bunch_trace import Rows, remote_error, touch_to_motion


def rows(clock, x, force, is_remote=True):
    x = np.asarray(x, float)
    force = np.asarray(force, float)
    zero = np.zeros_like(x)
    clock = np.asarray(clock, float)
    return Rows(
        clock, clock, np.stack([x, zero, zero], -1), np.stack([zero, force, zero], -1), np.full(len(x), is_remote)
    )


def test_motion_in_the_tick_of_contact_counts_as_zero_ticks():
    t = np.arange(5) * 0.01
    assert touch_to_motion(rows(t, [0, 0, 1e-4, 2e-4, 3e-4], [0, 0, 1, 1, 1])) == 0
    assert touch_to_motion(rows(t, [0, 0, 0, 0, 3e-4], [0, 0, 1, 1, 1])) == 2


def test_without_contact_or_motion_there_is_no_result():
    t = np.arange(4) * 0.01
    assert touch_to_motion(rows(t, [0, 0, 0, 0], [0, 0, 0, 0])) is None
    assert touch_to_motion(rows(t, [0, 0, 0, 0], [0, 1, 1, 0])) is None


def test_motion_before_contact_does_not_count():
    t = np.arange(4) * 0.01
    assert touch_to_motion(rows(t, [0.1, 0.1, 0.1, 0.2], [0, 0, 1, 1])) == 1


def test_remote_error_is_delay_times_speed():
    t = np.arange(0, 4, 0.01)
    owner = rows(t, 0.1 * t, np.ones_like(t))
    copy = rows(t, 0.1 * (t - 0.05).clip(0), np.zeros_like(t))
    error = remote_error(owner, copy)
    assert error["p50"] == pytest.approx(5.0, rel=1e-6)
    assert error["peak_displacement"] == pytest.approx(399.0, rel=0.01)


def test_remote_error_needs_common_time():
    t = np.arange(0, 1, 0.01)
    assert remote_error(rows(t, 0.1 * t, t), rows(t + 10, t, t)) is None


def test_rows_are_saved_and_loaded(tmp_path):
    before = rows([0.0, 0.1], [0.0, 0.5], [0.0, 2.0])
    before.save(tmp_path / "trace.npz")
    after = Rows.load(tmp_path / "trace.npz")
    assert np.array_equal(after.displacement, before.displacement)
    assert np.array_equal(after.clock, before.clock)


def test_remote_error_is_judged_only_while_the_copy_follows_the_owner():
    t = np.arange(0, 4, 0.01)
    owner = rows(t, 0.1 * t, np.ones_like(t))
    assert remote_error(owner, rows(t, 0 * t, 0 * t, is_remote=False)) is None
    partly_following = rows(t, np.where(t < 2, 0.0, 0.1 * t), 0 * t)
    partly_following.is_remote[t < 2] = False
    assert remote_error(owner, partly_following)["max"] < 0.01
