"""Data in buckets: `s3://`, `gs://`, `hf://`, `file://` and whatever else fsspec knows.

Credentials are found by the libraries in their own ways; nothing here reads, keeps or prints them.
"""

import hashlib
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from glob import has_magic
from pathlib import Path
from typing import Any

from rlftsim.errors import ConfigError, DataError, RlftsimError
from rlftsim.jobs.files import (
    NO_ROOM,
    errors_name,
    remove_temporaries,
    remove_temporaries_below,
    temporary_beside,
    write_text,
    write_whole,
)

ORIGIN = "origin.txt"
"""File in a local copy of a remote data set's index: the address of its shards."""
BLOCK_BYTES = 1 << 24
OBJECT_STORES = ("s3", "s3a", "gs", "gcs", "az", "abfs")
"""Protocols of stores without folders."""
READ_ONLY = ("hf", "http", "https")
"""Protocols that only read: what is written to a repository at Hugging Face is a commit of its own."""
SECONDS_OF_A_TEMPORARY = 24 * 3600.0
"""What a killed process left in the cache is removed after so long."""
_SHA256 = re.compile("[0-9a-f]{64}")
"""Names of shards in the cache; a file of another name is somebody else's."""
_EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gcs", "gcs": "gcs", "hf": "hf"}


def is_url(place: object) -> bool:
    """True for an address such as s3://bucket/folder, in place of a path."""
    return isinstance(place, str) and "://" in place


def folder_address(url: str) -> str:
    """The address of a remote folder, without a slash at its end.

    Raises:
        ConfigError: no address, or one without a place in it.
    """
    if not is_url(url) or not url.partition("://")[2].strip("/"):
        raise ConfigError(f"{url} is no address of a folder: write one such as s3://bucket/folder.")
    return url.rstrip("/")


def require_writable(url: str) -> None:
    """Refuse an address that data is only read from.

    Raises:
        ConfigError: it is one.
    """
    protocol = url.partition("://")[0]
    if protocol in READ_ONLY:
        raise ConfigError(f"{url}: {protocol}:// is read only here: upload the folder with that site's own tools.")


def require_folder(place: str | os.PathLike[str]) -> Path:
    """The path of a folder of this machine.

    Raises:
        ConfigError: it is an address.
    """
    if is_url(place):
        raise ConfigError(f"{place} is an address: name a folder of this machine here (docs/machines.md, Buckets).")
    return Path(place)


def cache_folder() -> Path:
    """Folder for what was fetched: RLFTSIM_CACHE, else ~/.cache/rlftsim."""
    return Path(os.environ.get("RLFTSIM_CACHE", "~/.cache/rlftsim")).expanduser()


def local_copy(url: str, kind: str) -> Path:
    """Local folder that stands for an address.

    Args:
        url: the address.
        kind: name of the cache's part.
    """
    return cache_folder() / kind / hashlib.sha256(url.rstrip("/").encode()).hexdigest()[:16]


@contextmanager
def remote(url: str) -> Iterator[tuple[Any, str]]:
    """File system of an address and the path in it; errors inside the block become one line that names the address.

    Raises:
        ConfigError: the protocol is unknown or its library is not installed.
        DataError: nothing is there, or it cannot be reached.
    """
    protocol = url.partition("://")[0]
    try:
        import fsspec

        yield fsspec.core.url_to_fs(url)
    except RlftsimError:
        raise
    except ImportError as error:
        hint = f'pip install "rlftsim[{_EXTRAS[protocol]}]"' if protocol in _EXTRAS else str(error)
        raise ConfigError(f"{url}: {protocol}:// needs another library: {hint}.") from None
    except FileNotFoundError:
        raise DataError(
            f"{url}: there is no such file or bucket: check the address, and that the copy to it has ended."
        ) from None
    # Each library has errors of its own: no permission, no credentials, no connection, no such protocol.
    except Exception as error:
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            raise DataError(
                f"cannot write {url} ({error.strerror}): make room there, then run the same command again."
            ) from None
        cause = (str(error).strip().splitlines() or [""])[0].rstrip(".")
        raise DataError(
            f"{url}: {type(error).__name__}: {cause}: check the address, the network and the credentials of this "
            "machine (docs/machines.md, Buckets)."
        ) from error


def fetch(url: str, path: Path, sha256: str | None = None) -> str:
    """Copy a remote file, whole or not at all; returns its SHA-256.

    Args:
        url: of the file.
        path: of the copy.
        sha256: that the file must have; None = any.

    Raises:
        DataError: it cannot be fetched, or is another one.
    """
    digest = hashlib.sha256()

    def write(temporary: Path) -> None:
        # The copy is opened outside: a disk that is full is no trouble of the remote side.
        with temporary.open("wb") as copy, remote(url) as (files, place):
            with files.open(place, "rb", block_size=BLOCK_BYTES, cache_type="readahead") as source:
                while block := source.read(BLOCK_BYTES):
                    digest.update(block)
                    with errors_name(path):
                        copy.write(block)
            if sha256 not in (None, digest.hexdigest()):
                raise DataError(f"{url}: damaged or replaced: its checksum is not that of the manifest.")

    write_whole(path, write)
    return digest.hexdigest()


def publish(path: Path, url: str) -> None:
    """Copy a file to a bucket. Readers see all of it or nothing: an upload that is cut short leaves no object.

    Args:
        path: of the file.
        url: of the copy.

    Raises:
        DataError: it cannot be written there.
    """
    with remote(url) as (files, place):
        if url.partition("://")[0] in OBJECT_STORES:  # no folders: one would make a bucket of a mistyped name
            files.put_file(str(path), place)
            return
        folder = files._parent(place)
        files.makedirs(folder, exist_ok=True)
        temporary = f"{folder}/{temporary_beside(Path(place)).name}"
        try:
            files.put_file(str(path), temporary)
            files.mv(temporary, place)
        finally:
            if files.exists(temporary):
                files.rm_file(temporary)


def put_text(url: str, text: str, *, is_new: bool) -> bool:
    """Write a small remote file; returns False where it should be new and is not. Of several processes one creates it.

    Args:
        url: of the file.
        text: its content.
        is_new: leave a file that is there as it is.

    Raises:
        DataError: it cannot be written there.
    """
    with remote(url) as (files, place):
        has_folders = url.partition("://")[0] not in OBJECT_STORES
        if has_folders:
            files.makedirs(files._parent(place), exist_ok=True)
        try:
            with files.open(place, "xb" if is_new else "wb") as file:
                file.write(text.encode())
        except FileExistsError:
            return False
        except OSError:
            if has_folders and files.exists(place):  # an empty file, as on a full disk
                files.rm_file(place)
            raise
    return True


def get_text(url: str) -> str:
    """Content of a small remote file.

    Raises:
        DataError: it is not there or cannot be read.
    """
    with remote(url) as (files, place):
        return files.cat_file(place).decode(errors="replace")


def remove(url: str) -> None:
    """Remove a remote file.

    Raises:
        DataError: it is not there or cannot be removed.
    """
    with remote(url) as (files, place):
        files.rm_file(place)


def fetch_shard(url: str, sha256: str) -> Path:
    """Local path of a shard, fetched once per machine by whichever process comes first.

    Shards used least recently are removed when the cache has more than RLFTSIM_CACHE_GB (50) gigabytes.

    Args:
        url: of the shard.
        sha256: of its bytes, which is also its name in the cache.

    Raises:
        DataError: see `fetch`.
    """
    path = cache_folder() / "shards" / sha256
    with _locked(path.with_suffix(".lock")):
        if path.exists():
            os.utime(path)  # used now
        else:
            remove_temporaries(path)  # of a process that was killed at this very shard
            fetch(url, path, sha256)
            _evict(path)
    return path


def _evict(newest: Path) -> None:
    """Remove the oldest shards of the cache above its limit. Processes that have one open keep it."""
    given = os.environ.get("RLFTSIM_CACHE_GB", "50")
    try:
        limit = float(given) * 1e9
    except ValueError:
        raise ConfigError(f"RLFTSIM_CACHE_GB={given} is no number of gigabytes.") from None
    with _locked(newest.parent / "evict.lock"):  # one process at a time counts and removes
        for path in newest.parent.glob(".*.tmp"):
            with suppress(FileNotFoundError):  # another process has just finished it
                if time.time() - path.stat().st_mtime > SECONDS_OF_A_TEMPORARY:
                    path.unlink()
        shards = [path for path in newest.parent.iterdir() if _SHA256.fullmatch(path.name)]
        shards.sort(key=lambda path: path.stat().st_mtime, reverse=True)
        total = 0
        for path in shards:
            total += path.stat().st_size
            if total > limit and path != newest:
                path.unlink(missing_ok=True)
                path.with_suffix(".lock").unlink(missing_ok=True)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Wait for a lock file, and hold it."""
    with errors_name(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a")
    with file:
        try:
            import fcntl

            fcntl.flock(file.fileno(), fcntl.LOCK_EX)
        except ImportError:  # no such locks on this platform: a shard may be fetched twice
            pass
        yield


def mirror(url: str, names: tuple[str, ...]) -> Path:
    """Local folder with some files of a remote one, fetched again when the last of them has changed.

    Args:
        url: of the remote folder.
        names: files in it; the last one changes with the others.

    Raises:
        DataError: a file is missing.
    """
    folder, url = local_copy(url, "data"), url.rstrip("/")
    with _locked(folder / ".lock"):
        remove_temporaries_below(folder)
        new = folder / f"{names[-1]}.new"
        fetch(f"{url}/{names[-1]}", new)
        old = folder / names[-1]
        if not old.exists() or old.read_bytes() != new.read_bytes():
            for name in names[:-1]:
                fetch(f"{url}/{name}", folder / name)
            write_text(folder / ORIGIN, url)
            new.replace(old)
        new.unlink(missing_ok=True)
    return folder


def find_files(url: str, pattern: str) -> dict[str, int]:
    """Addresses and sizes of the remote files at a place: a file, a glob, or the matching files of a folder.

    Args:
        url: the place.
        pattern: of file names in a folder, at any depth.

    Raises:
        DataError: there are none, or the place cannot be read.
    """
    with remote(url) as (files, place):
        found = files.glob(place, detail=True) if has_magic(place) else {}
        if not found and files.isfile(place):
            found = {place: files.info(place)}
        # No glob: the name of a folder may look like a pattern, too.
        below = {} if found else files.find(place, detail=True)
        found = found or {name: below[name] for name in below if fnmatchcase(name.rpartition("/")[2], pattern)}
        sizes = {files.unstrip_protocol(name): info["size"] for name, info in sorted(found.items())}
    if not sizes:
        raise DataError(f"{url}: no {pattern} there.")
    return sizes
