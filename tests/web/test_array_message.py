"""Messages of named arrays: what goes in comes out, at places that a browser can read from."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vinesim.web.array_message import decode, encode

arrays = st.dictionaries(
    st.text(min_size=1, max_size=8),
    hnp.arrays(
        st.sampled_from([np.uint8, np.int8, np.uint16, np.int16, np.uint32, np.int32, np.float32, np.float64]),
        hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=5),
    ),
    max_size=6,
)


@given(
    st.dictionaries(
        st.text(max_size=8).filter(lambda key: key != "arrays"), st.floats(allow_nan=False, allow_subnormal=False)
    ),
    arrays,
)
def test_values_and_arrays_come_out_as_they_went_in(values, given_arrays):
    message = encode(values, given_arrays)
    header, found = decode(message)
    assert header == values
    assert list(found) == list(given_arrays)
    for name, array in given_arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)
        place = found[name].ctypes.data - np.frombuffer(message, np.uint8).ctypes.data
        assert not array.size or place % array.itemsize == 0, "typed arrays of browsers must be aligned"


def test_an_array_that_browsers_lack_is_refused():
    with pytest.raises(ValueError, match="'index' of int64"):
        encode({}, {"index": np.arange(3)})
