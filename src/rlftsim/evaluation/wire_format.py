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
    head: bytes = b""
    """Key, and length where there is one."""
    payload: bytes = b""
    """All bytes of the payload, of a stream."""


def iterate_fields(file: BufferedIOBase, start: int, stop: int, *, is_stream: bool = False) -> Iterator[WireField]:
    """Fields of the message in bytes [start, stop) of a file, in order.

    See https://protobuf.dev/programming-guides/encoding.

    Args:
        file: File that can be sought; the position afterwards is undefined. A stream is at the first byte.
        start: Position of the first byte of the message.
        stop: Position after the last byte of the message.
        is_stream: True reads front to back, payloads included: for files that cannot be sought, and for messages larger
            than memory.

    Raises:
        DataError: Bytes that are no protobuf message, or end too early; names the byte.
    """
    position = start
    while position < stop:
        if not is_stream:  # the caller may have read elsewhere meanwhile
            file.seek(position)
        head, payload = _read_varint(file, position), b""
        number, wire_type = _to_number(head) >> 3, head[0] & 7
        # groups (3, 4) are in no message we know: their end lies beyond the stop, so they are refused below
        length = _FIXED_SIZE.get(wire_type, stop + 1)
        if wire_type == BYTES:
            digits = _read_varint(file, position + len(head))
            head, length = head + digits, _to_number(digits)
        elif wire_type == VARINT:
            payload = _read_varint(file, position + len(head))
            length = len(payload)
        begin = position + len(head)
        # checked before the payload is read: a damaged length may be of any size
        if number == 0 or begin + length > stop:
            raise DataError(f"not a protobuf message, or cut off: the field at byte {position} cannot be")
        if is_stream:
            if length > MAX_FIELD_BYTES:
                raise DataError(f"the field at byte {position} is {length / 1e9:.3g} GB, more than any scenario's")
            payload = payload or file.read(length)
            if len(payload) < length:
                raise DataError(f"cut off: the field at byte {position} does not end")
        yield WireField(number, wire_type, begin, begin + length, head, payload)
        position = begin + length


def _read_varint(file: BufferedIOBase, position: int) -> bytes:
    """The bytes of a number; `position` is for the message of an error."""
    digits = b""
    # seven bits a byte, the lowest first; the high bit says that another byte follows
    for _ in range(_MAX_VARINT_BYTES):
        byte = file.read(1)
        digits += byte
        if not byte or byte[0] < 0x80:
            break
    if not digits or digits[-1] >= 0x80:
        raise DataError(f"not a protobuf message, or cut off: the number at byte {position} does not end")
    return digits


def _to_number(digits: bytes) -> int:
    return sum((byte & 0x7F) << (7 * position) for position, byte in enumerate(digits))
