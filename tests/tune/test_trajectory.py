"""Tracks: what is read is what was written; what does not fit is refused with line, column and remedy."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.tune import Trajectory, TrajectoryError, read_trajectory

ROWS = "".join(f"{0.1 * i:.1f},{i},{-i}\n" for i in range(10))


def read(tmp_path, text):
    path = tmp_path / "track.csv"
    path.write_text(text)
    return read_trajectory(path)


def test_units_markers_gaps_and_comments_are_understood(tmp_path) -> None:
    rows = "".join(f"{100 * i},{i},{2 * i},{'' if i == 3 else 5}\n" for i in range(9))
    track = read(tmp_path, "# camera 2\ntime [ms],z [mm],middle x [cm],force [N]\n" + rows)
    assert track.markers == ("tip", "middle")
    np.testing.assert_allclose(track.time, 0.1 * np.arange(9))
    np.testing.assert_allclose(track.position[:, 0, 2], 1e-3 * np.arange(9))
    np.testing.assert_allclose(track.position[:, 1, 0], 2e-2 * np.arange(9))
    assert track.tracked.tolist() == [[False, False, True], [True, False, False]]
    assert track.force is not None
    assert np.flatnonzero(np.isnan(track.force)).tolist() == [3]


def test_units_may_stand_in_round_brackets(tmp_path) -> None:
    """As spreadsheets and trackers write them."""
    track = read(tmp_path, "Time (s),X (mm),middle z (cm)\n" + ROWS)
    assert track.markers == ("tip", "middle")
    np.testing.assert_allclose(track.position[:, 0, 0], 1e-3 * np.arange(10))
    np.testing.assert_allclose(track.position[:, 1, 2], -1e-2 * np.arange(10))


def test_a_track_survives_its_file(tmp_path) -> None:
    rng = np.random.default_rng(1)
    position = rng.normal(size=(20, 2, 3))
    position[:, 1, 0] = np.nan
    position[4, 0, 1] = np.nan
    track = Trajectory(np.cumsum(rng.uniform(0.01, 0.1, 20)), position, ("tip", "middle"), rng.uniform(0.0, 9.0, 20))
    track.write(tmp_path / "out.csv")
    again = read_trajectory(tmp_path / "out.csv")
    assert again.markers == track.markers
    np.testing.assert_allclose(again.position, position, rtol=1e-5)
    np.testing.assert_allclose(again.time, track.time, rtol=1e-5)
    np.testing.assert_allclose(again.force, track.force, rtol=1e-5)


@pytest.mark.parametrize(
    ("text", "place", "remedy"),
    [
        ("time [s],x,y [m]\n" + ROWS, "track.csv:1: column 2 'x' has no unit", "'x [mm]'"),
        ("time [s],x [inch]\n", "track.csv:1: column 2 'x [inch]': unit 'inch'", "m or cm or mm"),
        ("time [s],x [px]\n", "track.csv:1: column 2 'x [px]': a position in pixels", "the mm of a pixel"),
        ("frame,x [mm]\n", "track.csv:1: column 1 'frame' numbers pictures", "'time [s]'"),
        ("time [s],x [mm]\n0,00,1,5\n", "track.csv:2: 4 cells, the header has 2", "by semicolons"),
        ("time [s];x [mm]\n0,5;1.5\n", "track.csv:2: column 'x [mm]' is '1.5'", "all decimals as points"),
        ('time [s],x [mm]\n0,"1\n', "track.csv:2: has a quotation mark", "close it"),
        ("time [s],x [mm],force [kg]\n", "unit 'kg' of a force; give N", "9.81 N"),
        ("time [s],colour [m]\n", "column 2 'colour [m]' is not known", "MARKER x"),
        ("time [s],x [m],x [mm]\n" + ROWS, "columns 2 and 3 are the same", "remove one"),
        ("x [m],y [m]\n", "no column of time", "time [s]"),
        ("time [s],force [N]\n", "no column of position", "x [mm]"),
        ("time [s],x [m],y [m]\n" + ROWS + "1.0,1\n", "track.csv:12: 2 cells, the header has 3", "complete the line"),
        ("time [s],x [m],y [m]\n" + ROWS + "1.0,1,off\n", "track.csv:12: column 'y [m]' is 'off'", "leave the cell"),
        ("time [s],x [m],y [m]\n" + ROWS + ",1,1\n", "track.csv:12: column 'time [s]' is ''", "give a number"),
        ("time [s],x [m],y [m]\n" + ROWS + "0.9,1,1\n", "track.csv:12: column 'time [s]' does not increase", "sort"),
        ("time [s],x [m],y [m]\n0,1,1\n", "1 samples", "give 8 or more"),
        ("time [s],x [m]\n" + "".join(f"{i},\n" for i in range(9)), "column tip x is empty in 100%", "remove"),
        ("\n", "is empty", "header"),
        ("time [s],x [m]\n", "no samples follow the header", "give 8 or more"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(tmp_path, text, place, remedy) -> None:
    with pytest.raises(TrajectoryError) as refused:
        read(tmp_path, text)
    words = str(refused.value)
    assert place in words
    assert remedy in words
    assert "\n" not in words


def test_a_file_that_is_missing_is_named(tmp_path) -> None:
    with pytest.raises(TrajectoryError, match=r"none\.csv: no such file; give the CSV file"):
        read_trajectory(tmp_path / "none.csv")
