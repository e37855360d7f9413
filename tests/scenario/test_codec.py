import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rlftsim.scenario.codec import decode_array, encode_array

DTYPES = ["bool", "int8", "uint8", "int32", "int64", "float32", "float64"]
SHAPES = hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=7)


def assert_same_bits(array):
    back = decode_array(encode_array(array))
    assert back.dtype == array.dtype
    assert back.shape == array.shape
    assert back.tobytes() == np.ascontiguousarray(array).tobytes()


@given(st.sampled_from(DTYPES).flatmap(lambda dtype: hnp.arrays(dtype, SHAPES)))
def test_any_array_comes_back_bit_by_bit(array):
    assert_same_bits(array)


@given(hnp.arrays(np.uint32, SHAPES))
def test_any_float32_bit_pattern_comes_back(bits):
    assert_same_bits(bits.view(np.float32))


@given(hnp.arrays(np.int32, SHAPES, elements=st.integers(-(2**31), 2**31 - 1)), st.integers(0, 20))
def test_values_on_a_binary_grid_come_back(multiples, exponent):
    assert_same_bits(np.ldexp(multiples.astype(np.float32), -exponent))


@pytest.mark.parametrize(
    "values",
    [
        [np.nan, 1.0, -np.nan],
        [np.inf, -np.inf, 0.0],
        [0.0, -0.0, 1.0],
        [np.finfo(np.float32).max, np.finfo(np.float32).tiny, 1e-45],
        [],
    ],
    ids=["nan", "infinite", "negative zero", "extremes and subnormal", "empty"],
)
def test_odd_values_come_back(values):
    assert_same_bits(np.array(values, np.float32))
    assert_same_bits(np.array(values, np.float64))


def test_a_nan_payload_comes_back():
    assert_same_bits(np.array([0x7FC12345, 0xFF800001, 0x7F800001], np.uint32).view(np.float32))


def test_a_view_that_is_not_contiguous_comes_back():
    assert_same_bits(np.arange(24, dtype=np.float32).reshape(4, 6)[:, ::2].T)


def test_the_decoded_array_may_be_written_to():
    for dtype in DTYPES:
        decode_array(encode_array(np.zeros(3, dtype)))[0] = 1


def test_uniform_motion_on_a_grid_costs_next_to_nothing():
    # 40 tracks at 40 speeds, positions on a grid of 1/64 m: the second differences are zero
    position = (np.arange(40)[:, None] * np.arange(91) / 64 + 1000).astype(np.float32)
    assert len(encode_array(position)) < position.nbytes / 50


def test_an_unknown_dtype_is_refused_in_words():
    with pytest.raises(TypeError, match="complex64"):
        encode_array(np.zeros(3, np.complex64))


@pytest.mark.parametrize(
    "data", [b"", b"\x05", b"\x09\x00\x00\x00\x01\x03\x00\x00\x00", b"\x05\x00\x00\x00\x01\x03\x00\x00\x00abc"]
)
def test_bytes_that_are_no_encoded_array_are_refused(data):
    with pytest.raises(ValueError, match="not an encoded array"):
        decode_array(data)
