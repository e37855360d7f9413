"""Lossless compression of the arrays of a scenario.

Neighbors along the last axis (steps of a track, points of a polyline) are alike. So an array becomes integers, then
differences or differences of differences along the last axis, then bytes sorted by significance, then zstd:

    float32 on a binary grid (all values are multiples of 2**-k)   the multiples
    floats off a grid                                              the bits
    integers                                                       the integers, 32 bits wide if they fit
    one-byte values                                                the bytes

Every bit comes back: NaN payloads, infinities and -0.0 too. An encoded array holds dtype and shape, too.
"""

import struct

import numpy as np
import pyarrow as pa

_LEVEL = 9
_CODEC = pa.Codec("zstd", compression_level=_LEVEL)
_DTYPES = tuple(np.dtype(name) for name in ("bool", "int8", "uint8", "int32", "int64", "float32", "float64"))
_HEADER = struct.Struct("<BBBBB")  # dtype, method, grid exponent, order of differences, number of axes
_BITS, _GRID, _NARROW = 0, 1, 2
_MAX_GRID_EXPONENT = 16
_MAX_ORDER = 2


def encode_array(array: np.ndarray | np.generic) -> bytes:
    """Compressed form of `array` [..., n], whose neighbors along the last axis are alike.

    Raises:
        TypeError: The dtype is not among bool, int8, uint8, int32, int64, float32, float64.
    """
    if array.dtype not in _DTYPES:
        raise TypeError(f"cannot encode dtype {array.dtype}: it must be one of {', '.join(map(str, _DTYPES))}")
    # 1. Integers that stand for the values, as narrow as possible.
    words, method, exponent = _to_words(np.ascontiguousarray(array))
    # 2. Small numbers: differences along the last axis. Single bytes are left alone.
    order = 0
    if words.itemsize > 1:
        words, order = _smallest_differences(words)
    header = _HEADER.pack(_DTYPES.index(array.dtype), method, exponent, order, array.ndim)
    # 3. All lowest bytes, then all second ones and so on: the high bytes are nearly all zero, which zstd sees in runs.
    planes = words.reshape(-1).view(np.uint8).reshape(-1, words.itemsize).T  # [bytes of a word, words]
    return header + struct.pack(f"<{array.ndim}I", *array.shape) + _CODEC.compress(planes.tobytes(), asbytes=True)


def decode_array(data: bytes | pa.Buffer) -> np.ndarray:
    """Array that `encode_array` turned into `data`; a new one that may be written to.

    Raises:
        ValueError: The bytes are no encoded array.
    """
    view = memoryview(data)
    try:
        # the steps of `encode_array` backwards
        code, method, exponent, order, num_axes = _HEADER.unpack_from(view)
        shape = struct.unpack_from(f"<{num_axes}I", view, _HEADER.size)
        dtype = _DTYPES[code]
        word = np.dtype(f"i{4 if method == _NARROW else dtype.itemsize}")
        num_words = int(np.prod(shape, dtype=np.int64))
        body = _CODEC.decompress(view[_HEADER.size + 4 * num_axes :], num_words * word.itemsize)
        planes = np.frombuffer(body, np.uint8).reshape(word.itemsize, num_words)
        words = np.ascontiguousarray(planes.T).reshape(-1).view(word).reshape(shape)
    except (struct.error, IndexError, ValueError, OverflowError, MemoryError, OSError, pa.ArrowException) as error:
        raise ValueError("not an encoded array") from error
    if word.itemsize > 1:
        unsigned = words.view(f"u{word.itemsize}")
        # asarray: of an array without axes numpy makes a scalar
        words = np.asarray((unsigned >> np.uint8(1)).view(word) ^ -(words & 1))
        for _ in range(order):
            words = np.cumsum(words, axis=-1, dtype=word)
    return _from_words(words, dtype, method, exponent)


def _to_words(array: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Signed integers that stand for the values, the method and the exponent of the grid."""
    if array.dtype == np.float32:
        on_grid = _to_grid(array)
        if on_grid is not None:
            return on_grid[0], _GRID, on_grid[1]
    if array.dtype == np.int64:
        narrow = array.astype(np.int32)
        if np.array_equal(narrow, array):
            return narrow, _NARROW, 0
    return array.view(f"i{array.itemsize}"), _BITS, 0


def _from_words(words: np.ndarray, dtype: np.dtype, method: int, exponent: int) -> np.ndarray:
    """Inverse of `_to_words`."""
    if method == _GRID:
        return np.asarray(np.ldexp(words.astype(np.float32), -exponent))
    if method == _NARROW:
        return words.astype(dtype)
    return words.view(dtype)


def _to_grid(array: np.ndarray) -> tuple[np.ndarray, int] | None:
    """Multiples of 2**-exponent that are exactly `array`, with the smallest such exponent; None without a grid."""
    if not np.isfinite(array).all():
        return None
    values = array.astype(np.float64)
    largest = np.abs(values).max(initial=0.0)
    for exponent in range(_MAX_GRID_EXPONENT + 1):
        scaled = np.ldexp(values, exponent)
        if largest * 2.0**exponent >= 2**30:  # differences of differences must fit into 32 bits
            return None
        if not np.array_equal(scaled, np.rint(scaled)):
            continue
        words = scaled.astype(np.int32)
        is_exact = np.array_equal(_from_words(words, array.dtype, _GRID, exponent).view(np.int32), array.view(np.int32))
        return (words, exponent) if is_exact else None  # -0.0 is on the grid, but its sign would be lost
    return None


def _smallest_differences(words: np.ndarray) -> tuple[np.ndarray, int]:
    """Zigzag-coded differences along the last axis, of the order that needs the fewest bits, and that order."""
    smallest, smallest_order, fewest_bits = words, 0, np.inf
    for order in range(_MAX_ORDER + 1):
        if order:
            # each value minus the one before it, modulo the width; the first stays
            differences = words.copy()
            differences[..., 1:] -= words[..., :-1]
            words = differences
        # zigzag: small magnitudes of either sign become small unsigned numbers, 0, -1, 1, -2 -> 0, 1, 2, 3
        sign = words >> (8 * words.itemsize - 1)
        candidate = ((words << 1) ^ sign).view(f"u{words.itemsize}")
        bits = np.log2(candidate.astype(np.float64) + 1.0).sum()
        if bits < fewest_bits:
            smallest, smallest_order, fewest_bits = candidate, order, bits
    return smallest, smallest_order
