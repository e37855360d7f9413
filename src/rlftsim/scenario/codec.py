"""Lossless compression of the arrays of a scenario.

Neighbours along the last axis (steps of a track, points of a polyline) are alike. So an array becomes integers, then
differences or differences of differences along the last axis, then bytes sorted by significance, then zstd:

    float32 on a binary grid (all values are multiples of 2**-k)   the multiples
    other floats                                                   their bits
    integers                                                       themselves, 32 bits wide if they fit
    one-byte values                                                themselves

Every bit comes back: NaN payloads, infinities and -0.0 too. An encoded array says its own dtype and shape.
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
    """Compressed form of `array` [..., n], whose neighbours along the last axis are alike.

    Raises:
        TypeError: the dtype is none of bool, int8, uint8, int32, int64, float32, float64.
    """
    if array.dtype not in _DTYPES:
        raise TypeError(f"cannot encode dtype {array.dtype}: it must be one of {', '.join(map(str, _DTYPES))}")
    words, method, exponent = _to_words(np.ascontiguousarray(array))
    order = 0
    if words.itemsize > 1:
        words, order = _smallest_differences(words)
    header = _HEADER.pack(_DTYPES.index(array.dtype), method, exponent, order, array.ndim)
    body = words.reshape(-1).view(np.uint8).reshape(-1, words.itemsize).T
    return header + struct.pack(f"<{array.ndim}I", *array.shape) + _CODEC.compress(body.tobytes(), asbytes=True)


def decode_array(data: bytes | pa.Buffer) -> np.ndarray:
    """Array that `encode_array` turned into `data`; a new one that may be written to.

    Raises:
        ValueError: the bytes are no encoded array.
    """
    view = memoryview(data)
    try:
        code, method, exponent, order, num_axes = _HEADER.unpack_from(view)
        shape = struct.unpack_from(f"<{num_axes}I", view, _HEADER.size)
        dtype = _DTYPES[code]
        word = np.dtype(f"i{4 if method == _NARROW else dtype.itemsize}")
        num_words = int(np.prod(shape, dtype=np.int64))
        body = _CODEC.decompress(view[_HEADER.size + 4 * num_axes :], num_words * word.itemsize)
    except (struct.error, IndexError, OSError, pa.ArrowException) as error:
        raise ValueError(f"not an encoded array: {error}") from error
    planes = np.frombuffer(body, np.uint8).reshape(word.itemsize, num_words)
    words = np.ascontiguousarray(planes.T).reshape(-1).view(word).reshape(shape)
    if word.itemsize > 1:
        words = _undo_differences(words, order)
    return _from_words(words, dtype, method, exponent)


def _to_words(array: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Signed integers that stand for the values, how they do, and the exponent of the grid."""
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
    if method == _GRID:
        return np.asarray(np.ldexp(words.astype(np.float32), -exponent))
    if method == _NARROW:
        return words.astype(dtype)
    return words.view(dtype)


def _to_grid(array: np.ndarray) -> tuple[np.ndarray, int] | None:
    """Multiples of 2**-exponent that are exactly `array`, with the smallest such exponent; None if there is none."""
    if not np.isfinite(array).all():
        return None
    values = array.astype(np.float64)
    largest = np.abs(values).max(initial=0.0)
    for exponent in range(_MAX_GRID_EXPONENT + 1):
        scaled = np.ldexp(values, exponent)
        if largest * 2.0**exponent >= 2**30:
            return None
        if not np.array_equal(scaled, np.rint(scaled)):
            continue
        words = scaled.astype(np.int32)
        same = np.array_equal(_from_words(words, array.dtype, _GRID, exponent).view(np.int32), array.view(np.int32))
        return (words, exponent) if same else None  # -0.0 is on the grid, but its sign would be lost
    return None


def _smallest_differences(words: np.ndarray) -> tuple[np.ndarray, int]:
    """Zigzag-coded differences along the last axis, of the order that needs the fewest bits, and that order."""
    best, best_order, best_bits = words, 0, np.inf
    for order in range(_MAX_ORDER + 1):
        if order:
            words = _differences(words)
        candidate = _zigzag(words)
        bits = np.log2(candidate.astype(np.float64) + 1.0).sum()
        if bits < best_bits:
            best, best_order, best_bits = candidate, order, bits
    return best, best_order


def _differences(words: np.ndarray) -> np.ndarray:
    """Each value minus the one before it along the last axis, modulo the width; the first stays."""
    out = words.copy()
    out[..., 1:] -= words[..., :-1]
    return out


def _undo_differences(words: np.ndarray, order: int) -> np.ndarray:
    words = _undo_zigzag(words)
    for _ in range(order):
        words = np.cumsum(words, axis=-1, dtype=words.dtype)
    return words


def _zigzag(words: np.ndarray) -> np.ndarray:
    """Small magnitudes of either sign to small unsigned numbers: 0, -1, 1, -2 to 0, 1, 2, 3."""
    sign = words >> (8 * words.itemsize - 1)
    return ((words << 1) ^ sign).view(f"u{words.itemsize}")


def _undo_zigzag(words: np.ndarray) -> np.ndarray:
    unsigned = words.view(f"u{words.itemsize}")
    return np.asarray((unsigned >> np.uint8(1)).view(words.dtype) ^ -(words & 1))  # of no axes, it would be a scalar
