"""A .tar.gz that is written shard by shard, by several processes, and read front to back.

Each packed shard is the tar entry of a file (header, contents, padding), deflated alone and ended by a full flush, so
that packed shards can be concatenated. Together with an end block the result is a single gzip member. (Whole gzip
members may be concatenated, too, but Python's tarfile in mode "r|gz" reads the first only.) `split_file` cuts a large
archive into parts for transport; the upload page takes the joined file.
"""

import hashlib
import math
import os
import shutil
import struct
import tarfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from glob import escape
from itertools import chain
from pathlib import Path
from typing import BinaryIO

from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.files import errors_name, remove_temporaries, temporary_path, write_atomically

LEVEL = 1
"""Of deflate. On rollouts 6 and 9 save less than 1 % and take twice as long."""
_CHUNK = 1 << 18
_COPIED = 1 << 22
MAX_EXPANSION, LEAST_UNPACKED = 200, 1 << 28
"""Most bytes that a packed byte stands for, in archives of more than so many bytes: sampled rollouts have 2."""
_GZIP_HEADER = b"\x1f\x8b\x08\x00" + bytes(4) + b"\x04\xff"  # deflate, no name, no time, fastest, unknown system
_TAR_RECORD = 10240
_ALL_BITS = 0xFFFFFFFF


@dataclass(frozen=True)
class PackedShard:
    """A deflated tar entry in a separate file."""

    file: str
    """Name of the packed file."""
    size: int
    """Bytes of the packed file."""
    piece_crc: int
    """CRC-32 of the packed file."""
    raw_size: int
    """Bytes of the tar entry."""
    raw_crc: int
    """CRC-32 of the tar entry."""


def pack_shard(source: Path, name: str, destination: Path) -> PackedShard:
    """Deflate a file as a tar entry. The same contents and name give the same bytes.

    Args:
        source: File whose contents are packed.
        name: Name of the entry in the archive.
        destination: File of the packed shard; appears under this name when complete.

    Raises:
        DataError: A destination that cannot be written, such as on a full disk.
    """
    entry = tarfile.TarInfo(name)
    entry.size = source.stat().st_size
    header = entry.tobuf(tarfile.USTAR_FORMAT)
    padding = bytes(-entry.size % tarfile.BLOCKSIZE)
    deflate = zlib.compressobj(LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
    raw_size = raw_crc = size = piece_crc = 0

    def write(temporary: Path) -> None:
        nonlocal raw_size, raw_crc, size, piece_crc
        with source.open("rb") as contents, temporary.open("wb") as out:
            for chunk in chain([header], iter(lambda: contents.read(_CHUNK), b""), [padding, None]):
                if chunk is not None:
                    raw_size, raw_crc = raw_size + len(chunk), zlib.crc32(chunk, raw_crc)
                packed = deflate.flush(zlib.Z_FULL_FLUSH) if chunk is None else deflate.compress(chunk)
                size, piece_crc = size + len(packed), zlib.crc32(packed, piece_crc)
                out.write(packed)

    write_atomically(destination, write)
    return PackedShard(destination.name, size, piece_crc, raw_size, raw_crc)


def join_shards(archive: Path, folder: Path, shards: Sequence[PackedShard], *, delete: bool) -> None:
    """Write the archive of packed shards. Interrupted in any way, the same call goes on.

    Args:
        archive: Path of the archive; appears when complete.
        folder: Folder that holds the packed shards.
        shards: Packed shards, in the order of the archive.
        delete: True removes each packed shard once in the archive, so that the disk need not hold both.

    Raises:
        DataError: A packed shard that is damaged or missing, or an archive that cannot be written.
    """
    partial = _partial_path(archive)
    num_joined = count_joined(archive, folder, shards)
    start = len(_GZIP_HEADER) + sum(shard.size for shard in shards[:num_joined])
    with errors_name(archive), partial.open("r+b" if num_joined else "wb") as out:
        if num_joined:
            out.truncate(start)
            out.seek(start)
        else:
            out.write(_GZIP_HEADER)
        for shard in shards[num_joined:]:
            _check_shard(folder / shard.file, shard)
            with (folder / shard.file).open("rb") as packed:
                shutil.copyfileobj(packed, out, _CHUNK)
            if delete:
                out.flush()
                os.fsync(out.fileno())
                (folder / shard.file).unlink()
        size = sum(shard.raw_size for shard in shards)
        end = bytes(2 * tarfile.BLOCKSIZE)
        end += bytes(-(size + len(end)) % _TAR_RECORD)
        deflate = zlib.compressobj(LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
        out.write(deflate.compress(end) + deflate.flush(zlib.Z_FINISH))
        crc = 0
        for shard in shards:
            crc = combine_crc32(crc, shard.raw_crc, shard.raw_size)
        crc = combine_crc32(crc, zlib.crc32(end), len(end))
        out.write(struct.pack("<II", crc, (size + len(end)) % (1 << 32)))
        out.flush()
        os.fsync(out.fileno())
        partial.replace(archive)


def count_joined(archive: Path, folder: Path, shards: Sequence[PackedShard | None]) -> int:
    """Number of leading shards that are in the unfinished archive and were deleted; the next may have been begun there.

    Args:
        archive: Path that the archive gets when complete.
        folder: Folder that holds the packed shards that are not deleted.
        shards: Packed shards, in the order of the archive; None = not packed yet.
    """
    partial = _partial_path(archive)
    size = partial.stat().st_size if partial.exists() else 0
    count, end = 0, len(_GZIP_HEADER)
    for shard in shards:
        if shard is None or (folder / shard.file).exists() or end + shard.size > size:
            break
        count, end = count + 1, end + shard.size
    return count


def _partial_path(archive: Path) -> Path:
    return archive.with_name(f".{archive.name}.partial")


def _check_shard(path: Path, shard: PackedShard) -> None:
    """Compare a packed shard with the receipt before the archive gets any byte; a damaged file is removed."""
    crc = size = 0
    if path.exists():
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK):
                crc, size = zlib.crc32(chunk, crc), size + len(chunk)
    if (crc, size) != (shard.piece_crc, shard.size):
        path.unlink(missing_ok=True)
        raise DataError(f"{path} was damaged or missing: run the same command again, which simulates it once more.")


def combine_crc32(first: int, second: int, second_size: int) -> int:
    """CRC-32 of two byte strings one after the other.

    A checksum is linear but for the inversion of its bits: zeros of the second string's length move the first one on.

    Args:
        first: CRC-32 of the first string.
        second: CRC-32 of the second string.
        second_size: Length of the second string in bytes.
    """
    inverted = first ^ _ALL_BITS
    for start in range(0, second_size, _CHUNK):
        inverted = zlib.crc32(bytes(min(_CHUNK, second_size - start)), inverted)
    return inverted ^ _ALL_BITS ^ second


class GzipReader:
    """Contents of a gzip file, front to back, with checksums: the file object of `tarfile.open(mode="r|")`.

    Both of Python's ways to read a .tar.gz, "r:gz" and "r|gz", see what this reader sees, because only a single gzip
    member that ends with the file is read.
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
        """The next bytes; fewer than `size` only at the end.

        Raises:
            DataError: A file that is damaged, cut off, or goes on after the gzip member.
        """
        chunks = []
        while size > 0 and not self._inflate.eof:
            self._pending = self._pending or self._read_packed()
            if not self._pending:
                raise DataError(f"cut off: the gzip data do not end within its {self.packed_size} bytes")
            try:
                chunk = self._inflate.decompress(self._pending, size)
            except zlib.error as error:
                raise DataError(f"damaged near byte {self.packed_size} ({error})") from None
            self._pending = self._inflate.unconsumed_tail
            chunks.append(chunk)
            size -= len(chunk)
            self._unpacked_size += len(chunk)
            if self._unpacked_size > max(MAX_EXPANSION * self.packed_size, LEAST_UNPACKED):
                raise DataError(f"unfolds to more than {MAX_EXPANSION} times its size: no rollouts are packed so small")
        return b"".join(chunks)

    def finish(self) -> None:
        """Read the bytes that the tar format did not need.

        Raises:
            DataError: Damage, as in `read`.
        """
        while self.read(_CHUNK):
            pass
        remainder = self._inflate.unused_data + self._read_packed()
        if remainder:
            surplus = "another gzip member" if remainder[:2] == _GZIP_HEADER[:2] else "other bytes"
            way_out = "Python's tarfile reads the first one only, pack it again as one"
            raise DataError(f"{surplus} behind the first gzip member: {way_out}")

    def read_to_end(self) -> None:
        """Read the remaining bytes of the file, of any content, for the checksum."""
        while self._read_packed():
            pass

    def _read_packed(self) -> bytes:
        chunk = self._file.read(_CHUNK)
        self._sha256.update(chunk)
        self.packed_size += len(chunk)
        return chunk


def split_file(path: Path, part_gb: float) -> list[Path]:
    """Copy a file into parts named `<name>.000`, `<name>.001` and so on; `cat` joins the parts.

    Parts of an earlier cut are removed when all new parts are written.

    Args:
        path: File that is copied, and stays.
        part_gb: Size of a part in gigabytes of 10^9 bytes.

    Raises:
        ConfigError: More than 1000 parts.
        DataError: A part cannot be written; parts of an earlier cut are left unchanged.
    """
    part_bytes = int(part_gb * 1e9) if 0 < part_gb < math.inf else 0
    count = -(-path.stat().st_size // part_bytes) if part_bytes else 0
    if not 0 < count <= 1000:
        raise ConfigError(f"{path} cannot be cut into parts of {part_gb:g} GB: choose 1 to 1000 parts.")
    paths = [path.with_name(f"{path.name}.{number:03d}") for number in range(count)]
    try:
        with path.open("rb") as source:
            for target in paths:
                with errors_name(target), temporary_path(target).open("wb") as out:
                    left = part_bytes
                    while left and (chunk := source.read(min(left, _COPIED))):
                        out.write(chunk)
                        left -= len(chunk)
                    out.flush()
                    os.fsync(out.fileno())
        for old in path.parent.glob(f"{escape(path.name)}.[0-9][0-9][0-9]"):
            old.unlink()  # `cat` would join those of an earlier, finer cut, too
        for target in paths:
            temporary_path(target).replace(target)
    finally:
        for target in paths:
            remove_temporaries([target])
    return paths
