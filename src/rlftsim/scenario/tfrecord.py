"""TFRecord framing: length, masked checksum of the length, bytes, masked checksum of the bytes.

    uint64 length | uint32 crc(length) | length bytes | uint32 crc(bytes)        little-endian, crc = masked crc32c

A damaged checksum of the bytes costs one record. A damaged length costs the rest of the file, because the start of the
next record follows from it alone.
"""

import os
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import google_crc32c

from rlftsim.errors import DataError

OnError = Literal["stop", "skip"]

_HEADER = struct.Struct("<QI")
_FOOTER = struct.Struct("<I")
RECORD_OVERHEAD_BYTES = _HEADER.size + _FOOTER.size
"""Bytes that the framing of a record takes."""
_MASK_DELTA = 0xA282EAD8
_GZIP_MAGIC = b"\x1f\x8b"
_REST_IS_LOST = "the rest of the file is lost"


@dataclass(frozen=True)
class SkippedRecord:
    """A record that could not be read."""

    file: str
    record: int
    """Number of the record in its file, from 0. Where the rest of the file is lost: the first one lost."""
    cause: str
    rest_is_lost: bool = False
    """True = the file cannot be read from this record on, and the number of lost records is unknown."""

    def __str__(self) -> str:
        return f"{self.file}: record {self.record}: {self.cause}"


def count_lost(skipped: Sequence[SkippedRecord]) -> str:
    """Number of lost records in words, "at least" in front where the rest of a file is lost."""
    return f"at least {len(skipped)}" if any(record.rest_is_lost for record in skipped) else str(len(skipped))


def masked_crc32c(data: bytes) -> int:
    """Checksum of `data` as TFRecord files store it, in [0, 2**32)."""
    # rotated and shifted, so that the checksum of data with an embedded checksum is not degenerate
    crc = google_crc32c.value(data)
    return (((crc >> 15) | (crc << 17)) + _MASK_DELTA) & 0xFFFFFFFF


def write_records(path: str | os.PathLike[str], records: Iterable[bytes]) -> int:
    """Write a TFRecord file, replacing an existing one.

    Args:
        path: File to write, of any name.
        records: Content of each record, in the order of the file.

    Returns:
        Number of records written.
    """
    count = 0
    with open(path, "wb") as file:
        for record in records:
            length = struct.pack("<Q", len(record))
            file.write(length + _FOOTER.pack(masked_crc32c(length)) + record + _FOOTER.pack(masked_crc32c(record)))
            count += 1
    return count


def read_records(path: str | os.PathLike[str]) -> Iterator[tuple[int, bytes]]:
    """Read a TFRecord file record by record, checking both checksums of each.

    Args:
        path: File to read, of any name.

    Yields:
        Number of the record in the file, from 0, and the record's bytes.

    Raises:
        DataError: Damage; the message names file, record and cause. Also: the file does not exist or cannot be opened.
    """
    for record, data in enumerate(iterate_records(path)):
        if isinstance(data, SkippedRecord):
            raise DataError(str(data))
        yield record, data


def iterate_records(path: str | os.PathLike[str]) -> Iterator[bytes | SkippedRecord]:
    """Bytes or damage of each record of a TFRecord file, as far as the framing allows.

    Raises:
        DataError: The file does not exist or cannot be opened.
    """
    path = Path(path)
    try:
        file = open(path, "rb")  # noqa: SIM115 (the with follows; only the opening is guarded)
    except OSError as error:
        raise DataError(f"{path}: cannot be opened: {error.strerror}") from error
    with file:
        # an empty file enters the loop once, to be reported
        size = os.fstat(file.fileno()).st_size
        record = 0
        while file.tell() < size or size == 0:
            data, cause = _read_record(file, size, record)
            if cause is None and data is not None:
                yield data
            else:
                yield SkippedRecord(str(path), record, str(cause), rest_is_lost=data is None)
            if data is None:
                return
            record += 1


def _read_record(file: BinaryIO, size: int, record: int) -> tuple[bytes | None, str | None]:
    """Next record and the damage, None for a sound record; no bytes = the rest of the file cannot be read."""
    bytes_left = size - file.tell()
    header = file.read(_HEADER.size)
    if bytes_left == 0:
        return None, "the file is empty"
    if record == 0 and header.startswith(_GZIP_MAGIC):
        return None, "not a TFRecord file but a gzip-compressed one: unpack it with gunzip first"
    if len(header) < _HEADER.size:
        if record == 0:
            return None, "not a TFRecord file: too short"
        return None, f"truncated: the file ends inside the record's header; {_REST_IS_LOST}"
    # the length is trusted only with a matching checksum: a wrong length would be read as gigabytes
    length, crc = _HEADER.unpack(header)
    if crc != masked_crc32c(header[:8]):
        if record == 0:
            return None, "not a TFRecord file, or damaged at its start: the checksum of the first length does not match"
        return None, f"damaged: the checksum of its length does not match; {_REST_IS_LOST}"
    needed = _HEADER.size + length + _FOOTER.size
    if needed > bytes_left:
        return None, f"truncated: the record needs {needed} bytes, the file has {bytes_left} left; {_REST_IS_LOST}"
    data = file.read(length)
    (crc,) = _FOOTER.unpack(file.read(_FOOTER.size))
    if crc != masked_crc32c(data):
        return data, f"damaged: the checksum of its {length} bytes does not match"
    return data, None
