"""Places of the fields of a serialized protobuf message, found without reading their contents.

A submission file holds the rollouts of hundreds of scenarios: listing them must not cost their memory.

    field = key, payload        key = varint(number << 3 | type)        type 2 = length, bytes
"""

from collections.abc import Iterator
from io import BufferedIOBase
from typing import NamedTuple

from rlftsim.errors import DataError

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
_FIXED_SIZE = {FIXED64: 8, FIXED32: 4}
_MAX_VARINT_BYTES = 10


class WireField(NamedTuple):
    """One field of a message and the range of its payload in the file."""

    number: int
    wire_type: int
    start: int
    stop: int


def iterate_fields(file: BufferedIOBase, start: int, stop: int) -> Iterator[WireField]:
    """Fields of the message in bytes [start, stop) of a file, in order.

    See https://protobuf.dev/programming-guides/encoding.

    Args:
        file: can be sought.
        start: first byte of the message.
        stop: byte after its last one.

    Raises:
        DataError: the bytes are no protobuf message; names the byte.
    """
    position = start
    while position < stop:
        # the caller may have read elsewhere meanwhile
        file.seek(position)
        key = _read_varint(file, stop)
        number, wire_type = key >> 3, key & 7
        # only the place of the payload: its bytes are skipped
        if wire_type == BYTES:
            length = _read_varint(file, stop)
            begin = file.tell()
            end = begin + length
        elif wire_type == VARINT:
            begin = file.tell()
            _read_varint(file, stop)
            end = file.tell()
        else:
            begin = file.tell()
            # groups (3, 4) are in no message we know: their end lies beyond the stop, so they are refused below
            end = begin + _FIXED_SIZE.get(wire_type, stop + 1)
        if number == 0 or end > stop:
            raise DataError(f"not a protobuf message, or cut off: the field at byte {position} cannot be")
        yield WireField(number, wire_type, begin, end)
        position = end


def _read_varint(file: BufferedIOBase, stop: int) -> int:
    begin = file.tell()
    value = 0
    # seven bits a byte, the lowest first; the high bit says that another byte follows
    for shift in range(_MAX_VARINT_BYTES):
        byte = file.read(1)
        if not byte or file.tell() > stop:
            break
        value |= (byte[0] & 0x7F) << (7 * shift)
        if byte[0] < 0x80:
            return value
    raise DataError(f"not a protobuf message, or cut off: the number at byte {begin} does not end")
