"""Result folders: the results in a folder, the results that may be written there, and the processes that may write.

A folder is recognized by the files of its results. Results are made by a single driver, or by the shares of a run: a
lock refuses all other processes. A lock belongs to an open file, so the lock ends with the process that holds it,
however that process ends. Network file systems of today carry such locks between machines. On a file system without
locks two drivers at a time are not noticed.
"""

import errno
import fcntl
import json
import os
import re
import socket
import time
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, TextIO

from rlftsim.errors import MAX_VALUE, ConfigError, DataError, NotYetError, in_short, shorten
from rlftsim.jobs.documents import MAX_NAME_BYTES, read_json
from rlftsim.jobs.files import check_result_file, describe_type, errors_name, write_text
from rlftsim.jobs.runner import Runner, Share, Unfinished, check_begun

FolderType = Literal["data set", "submission", "set of rollouts", "model", "run", "results"]
"""Type of a result folder. "results" are files that lie beside others, such as evaluations, pages and reports."""

MARKERS: dict[FolderType, tuple[tuple[str, ...], ...]] = {
    "data set": (("manifest.json", "index.parquet"), ("manifest.json", "shards"), ("INCOMPLETE",)),
    "submission": (("plan.json", "shards"), ("plan.json", "submission.tar.gz"), ("plan.json", ".lock")),
    "set of rollouts": (("rollouts.json",),),
    "model": (("config.json", "model.safetensors"),),
    "run": (("config.json", "environment.json"), ("config.json", "checkpoints")),
}
"""Names by which each type of folder is recognized: all of any group. "results" have none."""
INNER_FOLDERS: dict[FolderType, tuple[str, ...]] = {
    "data set": ("shards",),
    "submission": ("shards",),
    "run": ("checkpoints", "tensorboard"),
}
"""Folders inside a result folder that are its own alone."""
COMPATIBLE: dict[FolderType, tuple[FolderType, ...]] = {"results": ("set of rollouts", "run")}
"""Types of result that may be written into a folder of another type, which has no use for their names."""
SECONDS_TO_WAIT = 10.0
"""A share waits so long for a driver that may only be putting the result together, or for its predecessor to end."""
WITHOUT_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)
"""Errors of file systems that have no locks, such as Lustre mounted without `flock`."""
_CHECKSUM = re.compile(r"\b([0-9a-f]{8})[0-9a-f]{8,}\b")
_OWNER = re.compile(r"^\S+ process \d+ since \d{4}-", re.MULTILINE)
"""Beginning of the line that `describe_owner` writes. Shares write into one file, so others may precede or follow."""


def recognize_folder(folder: Path) -> FolderType | None:
    """Type of a result folder; None for any other folder, and where there is none."""
    for folder_type, groups in MARKERS.items():
        if any(all((folder / name).exists() for name in names) for names in groups):
            return folder_type
    return None


def check_folder(folder: Path, folder_type: FolderType) -> None:
    """Check that results of a type may be written into a folder.

    Args:
        folder: Folder of the results; may be missing, and may hold files of no result.
        folder_type: Type of the results, which decides beside which other results new results may lie.

    Raises:
        DataError: A file, the folder of another type of result, or a folder inside a result folder.
    """
    if os.path.lexists(folder) and not folder.is_dir():
        raise DataError(f"{folder} is {describe_type(folder)}, not a folder: choose another folder.")
    if holder := _find_holder(folder):
        raise DataError(f"{folder} lies inside {holder}: choose another folder.")
    stored_type = recognize_folder(folder)
    if stored_type not in (None, folder_type, *COMPATIBLE.get(folder_type, ())):
        raise DataError(f"{folder} is the folder of a {stored_type}: choose another folder.")


def check_file(path: Path) -> None:
    """Check that a file that a command is to write would not replace a file of a result folder.

    Args:
        path: File that the command is to write; need not exist.

    Raises:
        DataError: The folder is recognized by this file, or is an inner folder of a result.
    """
    stored_type = recognize_folder(path.parent)
    if stored_type and path.exists() and any(path.name in names for names in MARKERS[stored_type]):
        raise DataError(f"{path} is part of a {stored_type}: choose another file.")
    if holder := _find_holder(path.parent):
        raise DataError(f"{path} lies inside {holder}: choose another file.")


def check_name(name: str, meaning: str) -> None:
    """Check that a name can be that of a file.

    Args:
        name: Text of a user, to be used with a suffix of at most 50 bytes.
        meaning: Meaning of the name at the beginning of the message, such as "an evaluation's name".

    Raises:
        ConfigError: An empty name, more than `MAX_NAME_BYTES`, or a slash, a line break or other control character.
    """
    is_file_name = name.strip() and name not in (".", "..") and not {*"/\\"} & {*name}
    if not (is_file_name and name.isprintable() and len(name.encode()) <= MAX_NAME_BYTES):
        raise ConfigError(f"{meaning} becomes a file name, {in_short(name)} cannot: choose another name.")


def _find_holder(folder: Path) -> str | None:
    """The result folder, in words, that an inner folder belongs to."""
    try:
        folder = folder.resolve()
    except (OSError, RuntimeError):
        raise DataError(f"{folder}: its links lead nowhere: choose another folder.") from None
    for outer in folder.parents:
        stored_type = recognize_folder(outer)
        if stored_type and folder.relative_to(outer).parts[0] in INNER_FOLDERS.get(stored_type, ()):
            return f"the {stored_type} {outer}"
    return None


def find_differences(path: Path, identity: Mapping[str, Any], remedy: str) -> dict[str, Any]:
    """Stored values by which results differ from this work, by name; empty where no identity is stored.

    Args:
        path: JSON file that `write_identity` has written.
        identity: Plain values on which the results depend, by name.
        remedy: Way out at the end of the message about a damaged file.

    Raises:
        DataError: The file is damaged, or no file.
    """
    check_result_file(path)
    stored = read_json(path, remedy) if path.exists() else identity
    return {name: stored.get(name) for name in {**identity, **stored} if stored.get(name) != identity.get(name)}


def describe_differences(stored: Mapping[str, Any], current: Mapping[str, Any]) -> str:
    """Stored values that differ from those of this work, for a message: "seed (0, not 1)"; empty without any.

    Args:
        stored: Differing values by name, see `find_differences`.
        current: Values of this work by name.
    """
    return ", ".join(
        f"{name} ({_describe_value(value)}, not {_describe_value(current.get(name))})" for name, value in stored.items()
    )


def _describe_value(value: object) -> str:
    """A value in short, of checksums the beginning."""
    return "none" if value in (None, "") else _CHECKSUM.sub(r"\1", shorten(str(value), MAX_VALUE))


def write_identity(path: Path, identity: Mapping[str, Any]) -> None:
    """Store the values on which the results in a folder depend.

    Args:
        path: JSON file in the folder; an existing file is replaced.
        identity: Plain values by name.

    Raises:
        DataError: The file cannot be written.
    """
    write_text(path, json.dumps(identity, indent=1) + "\n")


class Lease:
    """The right to write into a folder, as a context manager.

    A share holds the folder together with other shares, and the number of the share alone.

    Args:
        path: Lock file inside the folder, both made if missing.
        runner: Runner of the work; shares of the same count may work side by side.
        doing: Verb of the work, for messages: "is converting to".
        note: First line of the lock file, for readers of the file.

    Raises:
        NotYetError: A second driver holds the folder; says which, and since when.
        Unfinished: The work ended while a share waited, so no items are left to do.
        DataError: The folder cannot be written to, or holds a different file with the name of the lock.
    """

    def __init__(self, path: Path, runner: Runner, doing: str, note: str = "") -> None:
        self._path, self._doing, self._note, self.runner = path, doing, note, runner
        self._share = runner if isinstance(runner, Share) else None
        self._files: list[TextIO] = []
        check_begun(runner, path.parent)
        try:
            if self._share is None:
                self._lock(path)
            else:
                share_lock = path.with_name(f"{path.name}.{self._share.number}-of-{self._share.count}")
                deadline = time.monotonic() + SECONDS_TO_WAIT
                self._lock(share_lock, deadline=deadline)
                try:
                    self._lock(path, is_shared=True, deadline=deadline)
                except Unfinished:
                    share_lock.unlink(missing_ok=True)
                    with suppress(OSError):  # a folder of its own that went with the work
                        path.parent.rmdir()
                    raise
        except BaseException:
            self.__exit__(None, None, None)
            raise

    @property
    def is_alone(self) -> bool:
        """True if no share of the same run may be at work."""
        return self._share is None

    def __enter__(self) -> "Lease":
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for file in self._files:
            with suppress(OSError):  # the owner's line does not fit on a full disk, which has been said
                file.close()

    def finish(self, title: str) -> None:
        """Become the only driver, to put the result together.

        Args:
            title: Name of the work at the beginning of the message.

        Raises:
            Unfinished: Other shares are at work; the last share puts the result together.
        """
        if self._share is None:
            return
        # The lock is let go before it is wanted whole. So of shares that end together the last to let go gets it.
        self._files.pop().close()
        try:
            self._lock(self._path, must_exist=True)
        except NotYetError:
            raise Unfinished(
                f"{title}: {self._share} is done, other shares are at work. The last one puts the result together."
            ) from None
        self._share = None

    def remove(self) -> None:
        """Remove the lock files, at the end of all work. Only after `finish`."""
        remove_locks(self._path)

    def _lock(self, path: Path, *, is_shared: bool = False, deadline: float = 0.0, must_exist: bool = False) -> None:
        """Open a lock file and lock the file.

        Args:
            path: Lock file, made if missing.
            is_shared: True lets other processes have such a lock, too.
            deadline: Moment at which waiting for other processes ends, in seconds of `time.monotonic`.
            must_exist: True where the file was there: once gone, the work is done.

        Raises:
            NotYetError: A second process has a lock.
            Unfinished: A second process had a lock and has removed the file, at the end of all work.
            DataError: The file is no lock.
        """
        check_result_file(path)
        with errors_name(path):
            if not must_exist:
                path.parent.mkdir(parents=True, exist_ok=True)
            while True:
                try:
                    # A file that was there and is gone must not come back: its work is done.
                    file = open(path, "r+" if must_exist else "a+", encoding="utf-8", errors="replace")  # noqa: SIM115
                except FileNotFoundError:
                    if not must_exist:
                        raise
                    raise Unfinished(
                        f"{path.parent}: another process has just finished this work: nothing is left to do."
                    ) from None
                try:
                    fcntl.flock(file.fileno(), (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
                except BlockingIOError:
                    with file:
                        if time.monotonic() >= deadline:
                            raise NotYetError(self._refusal(file)) from None
                    must_exist = True
                    time.sleep(0.1)
                    continue
                except OSError as error:
                    if error.errno not in WITHOUT_LOCKS:
                        file.close()
                        raise
                # The driver before this one may have removed the file in between: then it is no lock for others.
                if path.exists() and os.fstat(file.fileno()).st_ino == path.stat().st_ino:
                    break
                file.close()
            self._files.append(file)
            text = f"{self._note}\n{describe_owner()}"
            # A full disk may have kept the beginning alone.
            if not (text.startswith(stored := _read_lock(file)) or _OWNER.search(stored)):
                raise DataError(f"{path} is no lock of `rlftsim`: rename it, or choose another folder.")
            file.seek(0)
            file.truncate()
            file.write(text)
            file.flush()

    def _refusal(self, file: TextIO) -> str:
        """Message with the owner and age of a lock."""
        owner, age = parse_owner(_read_lock(file))
        whom = f" ({owner}, for {age})" if owner else ""
        return f"another process {self._doing} {self._path.parent}{whom}: wait for it or choose another destination."


def remove_locks(path: Path) -> None:
    """Remove the lock files of finished work and of its shares; missing and other files are no error."""
    for lock in filter(Path.is_file, (*path.parent.glob(f"{path.name}.*-of-*"), path)):
        with suppress(FileNotFoundError), lock.open(encoding="utf-8", errors="replace") as file:
            stored = _read_lock(file)
            if not stored or _OWNER.search(stored):
                lock.unlink()


def _read_lock(file: TextIO) -> str:
    """Text of a lock file, and the beginning of any other."""
    file.seek(0)
    return file.read(1 << 20)


def describe_owner() -> str:
    """A line about this process and the time, for a lock file."""
    since = datetime.now(UTC).isoformat(timespec="seconds")
    return f"{socket.gethostname()} process {os.getpid()} since {since}\n"


def parse_owner(text: str) -> tuple[str, timedelta]:
    """Process and age of the last line of a text, in the format of `describe_owner`; no name for any other text."""
    owner, _, since = (text.splitlines() or [""])[-1].partition(" since ")
    try:
        age = int((datetime.now(UTC) - datetime.fromisoformat(since)).total_seconds())
    except (ValueError, TypeError):  # it is only just beginning, or the file was damaged
        return "", timedelta()
    return owner, timedelta(seconds=max(age, 0))  # its clock may be ahead of ours
