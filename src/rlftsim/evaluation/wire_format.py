"""Locations of the fields of a serialized protobuf message, without reading the contents.

A submission file holds the rollouts of hundreds of scenarios: a list must not cost the memory of the rollouts.

    field = key, payload        key = varint(number << 3 | type)        type 2 = length, bytes
"""

from collections.abc import Iterator
from io import BufferedIOBase
from typing import NamedTuple

from rlftsim.errors import DataError

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
_FIXED_SIZE = {FIXED64: 8, FIXED32: 4}
_MAX_VARINT_BYTES = 10
MAX_FIELD_BYTES = 1 << 28
"""Most bytes of a field that is read whole: 32 rollouts of 128 agents have 5 MB."""


class WireField(NamedTuple):
    """A field of a message and the range of the payload in the file."""

    number: int
    wire_type: int
    start: int
    stop: int


class FieldBytes(NamedTuple):
    """A field of a message with all bytes."""

    number: int
    wire_type: int
    head: bytes
    """Key, and length where there is one."""
    payload: bytes


def read_fields(file: BufferedIOBase, size: int) -> Iterator[FieldBytes]:
    """Fields of a message, read front to back: for files that cannot be sought and messages larger than memory.

    Args:
        file: File whose position is the first byte of the message.
        size: Length of the message in bytes.

    Raises:
        DataError: Bytes that are no protobuf message, or end too early; names the byte.
    """
    position = 0
    while position < size:
        head = _read_varint_bytes(file, position)
        number, wire_type = _to_number(head) >> 3, head[0] & 7
        length = _FIXED_SIZE.get(wire_type, size + 1)
        payload = b""
        if wire_type == BYTES:
            digits = _read_varint_bytes(file, position)
            head, length = head + digits, _to_number(digits)
        elif wire_type == VARINT:
            payload = _read_varint_bytes(file, position)
            length = len(payload)
        # checked before the payload is read: a damaged length may be of any size
        if number == 0 or position + len(head) + length > size:
            raise DataError(f"not a protobuf message, or cut off: the field at byte {position} cannot be")
        if length > MAX_FIELD_BYTES:
            raise DataError(f"the field at byte {position} is {length / 1e9:.3g} GB, more than any scenario's")
        payload = payload or file.read(length)
        if len(payload) < length:
            raise DataError(f"cut off: the field at byte {position} does not end")
        yield FieldBytes(number, wire_type, head, payload)
        position += len(head) + length


def iterate_fields(file: BufferedIOBase, start: int, stop: int) -> Iterator[WireField]:
    """Fields of the message in bytes [start, stop) of a file, in order.

    See https://protobuf.dev/programming-guides/encoding.

    Args:
        file: File that can be sought; the position afterwards is undefined.
        start: Position of the first byte of the message.
        stop: Position after the last byte of the message.

    Raises:
        DataError: Bytes that are no protobuf message; names the byte.
    """
    position = start
    while position < stop:
        # the caller may have read elsewhere meanwhile
        file.seek(position)
        key = _read_varint(file, stop)
        number, wire_type = key >> 3, key & 7
        # only the place of the payload: its bytes are skipped
        length = _read_varint(file, stop) if wire_type == BYTES else 0
        begin = file.tell()
        if wire_type == VARINT:
            _read_varint(file, stop)
            length = file.tell() - begin
        # groups (3, 4) are in no message we know: their end lies beyond the stop, so they are refused below
        end = begin + (length if wire_type in (BYTES, VARINT) else _FIXED_SIZE.get(wire_type, stop + 1))
        if number == 0 or end > stop:
            raise DataError(f"not a protobuf message, or cut off: the field at byte {position} cannot be")
        yield WireField(number, wire_type, begin, end)
        position = end


def _read_varint(file: BufferedIOBase, stop: int) -> int:
    begin = file.tell()
    digits = _read_varint_bytes(file, begin)
    if begin + len(digits) > stop:
        raise _endless(begin)
    return _to_number(digits)


def _read_varint_bytes(file: BufferedIOBase, position: int) -> bytes:
    """The bytes of a number; `position` is for the message of an error."""
    digits = b""
    # seven bits a byte, the lowest first; the high bit says that another byte follows
    for _ in range(_MAX_VARINT_BYTES):
        byte = file.read(1)
        digits += byte
        if not byte or byte[0] < 0x80:
            break
    if not digits or digits[-1] >= 0x80:
        raise _endless(position)
    return digits


def _to_number(digits: bytes) -> int:
    return sum((byte & 0x7F) << (7 * position) for position, byte in enumerate(digits))


def _endless(position: int) -> DataError:
    return DataError(f"not a protobuf message, or cut off: the number at byte {position} does not end")
