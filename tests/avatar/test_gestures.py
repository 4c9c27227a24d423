"""Gestures: the combinations of three inputs, names of finger poses, and a person's own poses from a file."""

import itertools

import pytest

from vinesim.avatar.gestures import FIST, GESTURES, OPEN_HAND, GestureError, Gestures


def test_six_of_the_eight_combinations_of_thumb_index_and_others_are_gestures():
    combinations = [(float(t), float(i), *(float(o),) * 3) for t, i, o in itertools.product((0, 1), repeat=3)]
    assert len(set(GESTURES.values())) == 6
    assert set(GESTURES.values()) <= set(combinations)
    gestures = Gestures()
    for pose in combinations:
        assert gestures.name_of(pose) == next((name for name, bend in GESTURES.items() if bend == pose), "")


def test_fingers_that_are_nearly_there_make_the_gesture():
    assert Gestures().name_of((0.9, 0.1, 0.8, 1.0, 0.7)) == "point"
    assert Gestures().name_of((0.5, 0.5, 0.5, 0.5, 0.5)) == ""


def test_own_poses_are_added_and_lie_on_buttons(tmp_path):
    file = tmp_path / "gestures.toml"
    file.write_text('[poses]\nvictory = [1, 0, 0, 1, 1]\n[buttons]\na = "victory"\nb = "fist"\n')
    gestures = Gestures.load(file)
    victory = (1.0, 0.0, 0.0, 1.0, 1.0)
    assert gestures.buttons == {"a": victory, "b": FIST}
    assert gestures.name_of(victory) == "victory"
    assert gestures.poses["open_hand"] == OPEN_HAND


@pytest.mark.parametrize(
    ("text", "finding"),
    [
        ("[poses]\nv = [1, 0, 0, 1]\n", "poses"),
        ("[poses]\nv = [1, 0, 0, 1, 2]\n", "poses"),
        ('[buttons]\na = "wave"\n', "buttons.a: no pose 'wave'; give one of open_hand"),
        ('[buttons]\nc = "fist"\n', "buttons"),
        ("[pose]\n", "pose"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_in_one_line(tmp_path, text, finding):
    file = tmp_path / "gestures.toml"
    file.write_text(text)
    with pytest.raises(GestureError, match=r"gestures\.toml") as error:
        Gestures.load(file)
    assert finding in str(error.value)
    assert "\n" not in str(error.value)
