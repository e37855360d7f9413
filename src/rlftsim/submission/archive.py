"""A .tar.gz that is written in pieces, by several processes, and read front to back.

Each piece is the tar entry of one file (header, contents, padding), deflated by itself and ended by a full flush, so
that pieces can be concatenated. Together with an end block they are a single gzip member. (Whole gzip members may be
concatenated, too, but Python's tarfile in mode "r|gz" reads the first of them only.)
"""

import hashlib
import os
import shutil
import struct
import tarfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import BinaryIO

from rlftsim.errors import DataError
from rlftsim.jobs.files import errors_name, temporary_path

LEVEL = 1
"""Of deflate. On rollouts 6 and 9 save less than 1 % and take twice as long."""
_CHUNK = 1 << 18
MAX_EXPANSION, LEAST_UNPACKED = 200, 1 << 28
"""Most bytes that a packed byte stands for, in archives of more than so many bytes: sampled rollouts have 2."""
_GZIP_HEADER = b"\x1f\x8b\x08\x00" + bytes(4) + b"\x04\xff"  # deflate, no name, no time, fastest, unknown system
_TAR_RECORD = 10240
_CRC_POLYNOMIAL = 0xEDB88320


@dataclass(frozen=True)
class PackedShard:
    """A deflated tar entry in a file of its own."""

    file: str
    """Name of the piece's file."""
    size: int
    """Bytes of the piece."""
    piece_crc: int
    """CRC-32 of the piece."""
    raw_size: int
    """Bytes of the tar entry."""
    raw_crc: int
    """CRC-32 of the tar entry."""


def pack_shard(source: Path, name: str, destination: Path) -> PackedShard:
    """Deflate a file as a tar entry. The same contents and name give the same bytes.

    Args:
        source: the file.
        name: of the entry.
        destination: file of the piece; it gets its name when it is whole.

    Raises:
        DataError: it cannot be written, such as on a full disk.
    """
    entry = tarfile.TarInfo(name)
    entry.size = source.stat().st_size
    header = entry.tobuf(tarfile.USTAR_FORMAT)
    padding = bytes(-entry.size % tarfile.BLOCKSIZE)
    deflate = zlib.compressobj(LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
    temporary = temporary_path(destination)
    raw_size = raw_crc = size = piece_crc = 0
    try:
        with errors_name(destination), source.open("rb") as contents, temporary.open("wb") as out:
            for chunk in chain([header], iter(lambda: contents.read(_CHUNK), b""), [padding, None]):
                if chunk is not None:
                    raw_size, raw_crc = raw_size + len(chunk), zlib.crc32(chunk, raw_crc)
                packed = deflate.flush(zlib.Z_FULL_FLUSH) if chunk is None else deflate.compress(chunk)
                size, piece_crc = size + len(packed), zlib.crc32(packed, piece_crc)
                out.write(packed)
            out.flush()
            os.fsync(out.fileno())
            temporary.replace(destination)
    finally:
        temporary.unlink(missing_ok=True)
    return PackedShard(destination.name, size, piece_crc, raw_size, raw_crc)


def join_shards(archive: Path, folder: Path, pieces: Sequence[PackedShard], *, delete: bool) -> None:
    """Write the archive of some pieces. Interrupted in any way, the same call goes on.

    Args:
        archive: appears when it is whole.
        folder: with the pieces.
        pieces: in the order of the archive.
        delete: remove each piece once it is in the archive, so that the disk need not hold both.

    Raises:
        DataError: a piece is damaged or missing, or the archive cannot be written.
    """
    partial = _partial(archive)
    num_joined = count_joined(archive, folder, pieces)
    start = len(_GZIP_HEADER) + sum(piece.size for piece in pieces[:num_joined])
    with errors_name(archive), partial.open("r+b" if num_joined else "wb") as out:
        if num_joined:
            out.truncate(start)
            out.seek(start)
        else:
            out.write(_GZIP_HEADER)
        for piece in pieces[num_joined:]:
            _check_archive(folder / piece.file, piece)
            with (folder / piece.file).open("rb") as file:
                shutil.copyfileobj(file, out, _CHUNK)
            if delete:
                out.flush()
                os.fsync(out.fileno())
                (folder / piece.file).unlink()
        size = sum(piece.raw_size for piece in pieces)
        end = bytes(2 * tarfile.BLOCKSIZE)
        end += bytes(-(size + len(end)) % _TAR_RECORD)
        deflate = zlib.compressobj(LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
        out.write(deflate.compress(end) + deflate.flush(zlib.Z_FINISH))
        crc = 0
        for piece_crc, piece_size in [*((p.raw_crc, p.raw_size) for p in pieces), (zlib.crc32(end), len(end))]:
            crc = combine_crc32(crc, piece_crc, piece_size)
        out.write(struct.pack("<II", crc, (size + len(end)) % (1 << 32)))
        out.flush()
        os.fsync(out.fileno())
        partial.replace(archive)


def count_joined(archive: Path, folder: Path, pieces: Sequence[PackedShard | None]) -> int:
    """Leading pieces that are in the unfinished archive and were deleted; later ones may have been begun there.

    Args:
        archive: the finished one.
        folder: with the pieces that are left.
        pieces: in the order of the archive; None = not made yet.
    """
    partial = _partial(archive)
    size = partial.stat().st_size if partial.exists() else 0
    count, end = 0, len(_GZIP_HEADER)
    for piece in pieces:
        if piece is None or (folder / piece.file).exists() or end + piece.size > size:
            break
        count, end = count + 1, end + piece.size
    return count


def _partial(archive: Path) -> Path:
    return archive.with_name(f".{archive.name}.partial")


def _check_archive(path: Path, piece: PackedShard) -> None:
    """Compare a piece with its receipt before any of it is in the archive; a damaged one is removed."""
    crc = size = 0
    if path.exists():
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK):
                crc, size = zlib.crc32(chunk, crc), size + len(chunk)
    if (crc, size) != (piece.piece_crc, piece.size):
        path.unlink(missing_ok=True)
        raise DataError(f"{path} was damaged or missing: run the same command again, which simulates it once more.")


def combine_crc32(first: int, second: int, second_size: int) -> int:
    """CRC-32 of two byte strings one after the other.

    The way of zlib's `crc32_combine`: appending a zero bit to a message is a linear map of its CRC over GF(2), and its
    powers of two make any number of zeros.

    Args:
        first: CRC-32 of the first.
        second: CRC-32 of the second.
        second_size: bytes of the second.
    """
    zero_bit = [_CRC_POLYNOMIAL, *(1 << n for n in range(31))]  # column n: image of bit n
    matrix, bits = zero_bit, 8 * second_size
    while bits:
        if bits & 1:
            first = _times(matrix, first)
        matrix = [_times(matrix, column) for column in matrix]
        bits >>= 1
    return first ^ second


def _times(matrix: Sequence[int], vector: int) -> int:
    """Product of a matrix over GF(2), given by its columns, and a vector of 32 bits."""
    product = 0
    for column in matrix:
        if vector & 1:
            product ^= column
        vector >>= 1
    return product


class GzipReader:
    """Contents of a gzip file, front to back, with its checksums: the file object of `tarfile.open(mode="r|")`.

    Both of Python's ways to read a .tar.gz, "r:gz" and "r|gz", see what this reader sees, because it insists on a
    single gzip member that ends with the file.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._inflate = zlib.decompressobj(16 + zlib.MAX_WBITS)  # checks CRC and length at the end
        self._pending = b""
        self._sha256 = hashlib.sha256()
        self._unpacked_size = 0
        self.packed_size = 0
        """Bytes read from the file so far."""

    @property
    def sha256(self) -> str:
        """Of the bytes read from the file so far."""
        return self._sha256.hexdigest()

    def read(self, size: int) -> bytes:
        """The next bytes; fewer than `size` at the end only.

        Raises:
            DataError: the file is damaged, cut off, or goes on after the gzip member.
        """
        parts = []
        while size > 0 and not self._inflate.eof:
            self._pending = self._pending or self._read_packed()
            if not self._pending:
                raise DataError(f"cut off: the gzip data do not end within its {self.packed_size} bytes")
            try:
                part = self._inflate.decompress(self._pending, size)
            except zlib.error as error:
                raise DataError(f"damaged near byte {self.packed_size} ({error})") from None
            self._pending = self._inflate.unconsumed_tail
            parts.append(part)
            size -= len(part)
            self._unpacked_size += len(part)
            if self._unpacked_size > max(MAX_EXPANSION * self.packed_size, LEAST_UNPACKED):
                raise DataError(f"unfolds to more than {MAX_EXPANSION} times its size: no rollouts are packed so small")
        return b"".join(parts)

    def finish(self) -> None:
        """Read what the tar format did not need.

        Raises:
            DataError: as `read`.
        """
        while self.read(_CHUNK):
            pass
        rest = self._inflate.unused_data + self._read_packed()
        if rest:
            what = "another gzip member" if rest[:2] == _GZIP_HEADER[:2] else "other bytes"
            raise DataError(
                f"{what} behind the first gzip member: Python's tarfile reads the first one only, pack it again as one"
            )

    def read_to_end(self) -> None:
        """Read the rest of the file for its checksum, whatever it is."""
        while self._read_packed():
            pass

    def _read_packed(self) -> bytes:
        chunk = self._file.read(_CHUNK)
        self._sha256.update(chunk)
        self.packed_size += len(chunk)
        return chunk
