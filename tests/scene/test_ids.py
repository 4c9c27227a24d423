"""Labels: organ and index are packed into an int32 and unpacked."""

import numpy as np

from vinesim.scene.ids import LABEL_STRIDE, Organ, label, unlabel


def test_labels_are_unpacked_and_fit_an_int32():
    for organ in Organ:
        for index in (0, 1, 9999, LABEL_STRIDE - 1):
            value = label(organ, index)
            assert int(np.int32(value)) == value
            assert unlabel(value) == (organ, index)


def test_labels_are_unique():
    values = {label(o, i) for o in Organ for i in range(50)}
    assert len(values) == len(Organ) * 50


def test_the_label_of_nothing_is_zero():
    assert label(Organ.NOTHING, 0) == 0
