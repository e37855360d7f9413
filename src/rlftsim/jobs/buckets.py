"""Data in buckets: `s3://`, `gs://`, `hf://`, `file://` and further protocols of fsspec.

Credentials are found by the libraries themselves; this module never reads, keeps or prints credentials.
"""

import fcntl
import hashlib
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase
from glob import has_magic
from pathlib import Path
from typing import Any

from rlftsim.errors import ConfigError, DataError, NotYetError, RlftsimError
from rlftsim.jobs.documents import first_line
from rlftsim.jobs.files import NO_ROOM, errors_name, remove_temporaries, temporary_path, write_atomically, write_text
from rlftsim.jobs.folder import describe_owner, parse_owner
from rlftsim.jobs.progress import log

ORIGIN = "origin.txt"
"""File in a local copy of a remote data set's index: the address of its shards."""
BLOCK_BYTES = 1 << 24
OBJECT_STORES = ("s3", "s3a", "gs", "gcs", "az", "abfs")
"""Protocols of stores without folders."""
READ_ONLY = ("hf", "http", "https")
"""Protocols that only read: what is written to a repository at Hugging Face is a commit of its own."""
SECONDS_OF_A_TEMPORARY = 24 * 3600.0
"""What a killed process left in the cache is removed after so long."""
REMOTE_LEASE = ".lease"
"""File of a remote folder that is being written to."""
SECONDS_OF_SILENCE = 600.0
"""A remote lease that was not renewed for so long belongs to a process that is gone."""
_SHA256 = re.compile("[0-9a-f]{64}")
"""Names of shards in the cache; a file of another name is somebody else's."""
_EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gcs", "gcs": "gcs", "hf": "hf"}


def is_url(address: object) -> bool:
    """True for an address such as s3://bucket/folder, in place of a path."""
    return isinstance(address, str) and "://" in address


def folder_address(url: str) -> str:
    """The address of a remote folder, without a slash at the end.

    Raises:
        ConfigError: No address, or an address without a bucket or path.
    """
    if not is_url(url) or not url.partition("://")[2].strip("/"):
        raise ConfigError(f"{url} is no address of a folder: write one such as s3://bucket/folder.")
    return url.rstrip("/")


def check_writable(url: str) -> None:
    """Check that data may be written to an address.

    Raises:
        ConfigError: The protocol is in `READ_ONLY`.
    """
    protocol = url.partition("://")[0]
    if protocol in READ_ONLY:
        raise ConfigError(f"{url}: {protocol}:// is read only here: upload the folder with that site's own tools.")


def validate_folder(folder: str | os.PathLike[str]) -> Path:
    """The path of a folder of this machine.

    Raises:
        ConfigError: The text is an address.
    """
    if is_url(folder):
        raise ConfigError(f"{folder} is an address: name a folder of this machine here (docs/machines.md, Buckets).")
    return Path(folder)


def cache_folder() -> Path:
    """Folder for fetched files: RLFTSIM_CACHE, else ~/.cache/rlftsim."""
    return Path(os.environ.get("RLFTSIM_CACHE", "~/.cache/rlftsim")).expanduser()


@contextmanager
def remote(url: str) -> Iterator[tuple[Any, str]]:
    """File system and path of an address; errors inside the block become a single line that names the address.

    Raises:
        ConfigError: The protocol is unknown, or the library for the protocol is not installed.
        DataError: No file has this address, or the network or the permissions fail.
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
        cause = first_line(Exception(str(error)))  # with the remote file, which an OSError has beside its cause
        raise DataError(
            f"{url}: {type(error).__name__}: {cause}: check the address, the network and the credentials of this "
            "machine (docs/machines.md, Buckets)."
        ) from error


def fetch(url: str, path: Path, sha256: str | None = None) -> str:
    """Copy a remote file, whole or not at all; returns the SHA-256 of the bytes.

    Args:
        url: Address of the remote file, which is read once, front to back.
        path: Path of the copy; a missing folder is created.
        sha256: SHA-256 that the bytes must have, in 64 hexadecimal digits; None takes any.

    Raises:
        DataError: The file cannot be fetched, or has other bytes.
    """
    digest = hashlib.sha256()

    def write(temporary: Path) -> None:
        # The copy is opened outside: a disk that is full is no trouble of the remote side.
        with temporary.open("wb") as copy, remote(url) as (files, remote_path):
            with files.open(remote_path, "rb", block_size=BLOCK_BYTES, cache_type="readahead") as source:
                while block := source.read(BLOCK_BYTES):
                    digest.update(block)
                    with errors_name(path):
                        copy.write(block)
            if sha256 not in (None, digest.hexdigest()):
                raise DataError(f"{url}: damaged or replaced: its checksum is not that of the manifest.")

    write_atomically(path, write)
    return digest.hexdigest()


def publish(path: Path, url: str) -> None:
    """Copy a file to a bucket. Readers see the whole file or none: an upload that is cut short leaves no object.

    Args:
        path: File of this machine that is copied.
        url: Address of the copy; a file that has this address is replaced.

    Raises:
        DataError: The copy cannot be written.
    """
    with remote(url) as (files, remote_path):
        if url.partition("://")[0] in OBJECT_STORES:  # no folders: one would make a bucket of a mistyped name
            files.put_file(str(path), remote_path)
            return
        folder = files._parent(remote_path)
        files.makedirs(folder, exist_ok=True)
        temporary = f"{folder}/{temporary_path(Path(remote_path)).name}"
        try:
            files.put_file(str(path), temporary)
            files.mv(temporary, remote_path)
        finally:
            if files.exists(temporary):
                files.rm_file(temporary)


def put_text(url: str, text: str, *, is_new: bool) -> bool:
    """Write a small remote file; False if `is_new` and the file exists. Of several processes one creates the file.

    Args:
        url: Address of the file.
        text: Content of the file, stored in UTF-8.
        is_new: True leaves an existing file with this address unchanged.

    Raises:
        DataError: The file cannot be written.
    """
    with remote(url) as (files, remote_path):
        has_folders = url.partition("://")[0] not in OBJECT_STORES
        if has_folders:
            files.makedirs(files._parent(remote_path), exist_ok=True)
        try:
            with files.open(remote_path, "xb" if is_new else "wb") as file:
                file.write(text.encode())
        except FileExistsError:
            return False
        except OSError:
            if has_folders and files.exists(remote_path):  # an empty file, as on a full disk
                files.rm_file(remote_path)
            raise
    return True


def get_text(url: str) -> str:
    """Content of a small remote file.

    Raises:
        DataError: The file is missing or cannot be read.
    """
    with remote(url) as (files, remote_path):
        return files.cat_file(remote_path).decode(errors="replace")


def remove(url: str) -> None:
    """Remove a remote file.

    Raises:
        DataError: The file is missing or cannot be removed.
    """
    with remote(url) as (files, remote_path):
        files.rm_file(remote_path)


def fetch_shard(url: str, sha256: str) -> Path:
    """Local path of a shard, fetched once per machine by whichever process comes first.

    Shards used least recently are removed when the cache has more than RLFTSIM_CACHE_GB (50) gigabytes.

    Args:
        url: Address of the shard, read where the cache lacks these bytes.
        sha256: SHA-256 of the bytes, also the name of the file in the cache.

    Raises:
        DataError: The shard cannot be fetched, or has other bytes.
    """
    path = cache_folder() / "shards" / sha256
    with _locked(path.with_suffix(".lock")):
        if path.exists():
            os.utime(path)  # used now
        else:
            remove_temporaries([path])  # of a process that was killed at this very shard
            fetch(url, path, sha256)
            _evict(path)
    return path


def _evict(newest: Path) -> None:
    """Remove the oldest shards of the cache above its limit. A process that has a shard open keeps the shard."""
    gigabytes = os.environ.get("RLFTSIM_CACHE_GB", "50")
    try:
        limit = float(gigabytes) * 1e9
    except ValueError:
        raise ConfigError(f"RLFTSIM_CACHE_GB={gigabytes} is no number of gigabytes.") from None
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
    """Wait for a lock file, and hold the lock."""
    with errors_name(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a")
    with file:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX)
        yield


def mirror(url: str, names: tuple[str, ...]) -> Path:
    """Local folder with some files of a remote folder, fetched again when the last file has changed.

    Args:
        url: Address of the remote folder.
        names: Names of the files, the last of which, such as a manifest, changes whenever any file does.

    Raises:
        DataError: A file is missing.
    """
    url = url.rstrip("/")
    folder = cache_folder() / "data" / hashlib.sha256(url.encode()).hexdigest()[:16]
    with _locked(folder / ".lock"):
        new = folder / f"{names[-1]}.new"
        remove_temporaries([new, *(folder / name for name in (*names, ORIGIN))])
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
    """Sizes in bytes of remote files by address: a file, those of a glob, or the matching files of a folder.

    Args:
        url: Address of a file or folder, or a glob of files.
        pattern: Glob that the names of files in a folder match, at any depth.

    Raises:
        DataError: No such files, or the folder cannot be read.
    """
    with remote(url) as (files, remote_path):
        details = files.glob(remote_path, detail=True) if has_magic(remote_path) else {}
        if not details and files.isfile(remote_path):
            details = {remote_path: files.info(remote_path)}
        if not details:  # no glob: the name of a folder may look like a pattern, too
            below = files.find(remote_path, detail=True)
            details = {name: below[name] for name in below if fnmatchcase(name.rpartition("/")[2], pattern)}
        sizes = {files.unstrip_protocol(name): info["size"] for name, info in sorted(details.items())}
    if not sizes:
        raise DataError(f"{url}: no {pattern} there.")
    return sizes


@contextmanager
def remote_lease(url: str) -> Iterator[Callable[[], object]]:
    """Hold a remote folder while it is copied to; yields a function to be called every few minutes meanwhile.

    Buckets have no locks. So the owner and the time are in a file that only a single process can create. The file
    counts until removed, or until not renewed for `SECONDS_OF_SILENCE`.

    Args:
        url: Address of the folder, without a slash at the end.

    Raises:
        NotYetError: A second process holds the folder, or took the folder over after a long silence of this process.
        DataError: The folder cannot be written to.
    """
    lease_url = f"{url}/{REMOTE_LEASE}"

    def renew() -> None:
        owner = get_text(lease_url).partition(" since ")[0]
        if owner != describe_owner().partition(" since ")[0]:
            raise NotYetError(
                f"{owner or 'another process'} has taken over {url}, after a silence of this process: run the command "
                "again."
            )
        put_text(lease_url, describe_owner(), is_new=False)

    while not put_text(lease_url, describe_owner(), is_new=True):
        owner, age = parse_owner(get_text(lease_url))
        if not owner:  # killed while it was writing this
            with remote(lease_url) as (files, path):
                silence = datetime.now(UTC) - files.modified(path)
            owner, age = "unknown", timedelta(seconds=max(int(silence.total_seconds()), 0))
        if age.total_seconds() < SECONDS_OF_SILENCE:
            raise NotYetError(
                f"another process is copying to {url} ({owner}, last heard of {age} ago): wait for it, or remove "
                f"{lease_url} if it is gone."
            )
        log.warning(f"{url}: taken over from {owner}, silent for {age}.")
        remove(lease_url)
    try:
        yield renew
    finally:
        with suppress(DataError):  # gone, or another's
            renew()
            remove(lease_url)
