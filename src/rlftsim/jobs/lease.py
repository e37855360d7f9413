"""One driver at a time for a folder of results, or the shares of one run: any other is refused.

A lock belongs to an open file, so it ends with the process that holds it, however that ends. Network file systems of
today carry such locks between machines. On a file system without them two drivers at a time are not noticed.
"""

import errno
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import TextIO

from rlftsim.errors import DataError, NotYetError
from rlftsim.jobs.buckets import get_text, put_text, remove
from rlftsim.jobs.files import errors_name
from rlftsim.jobs.progress import log
from rlftsim.jobs.runner import Runner, Share, Unfinished, require_begun

SECONDS_TO_WAIT = 10.0
"""A share waits so long for a driver that may only be putting the result together, or for its predecessor to end."""
REMOTE_LEASE = ".lease"
"""File of a remote folder that is being written to."""
SECONDS_OF_SILENCE = 600.0
"""A remote lease that was not renewed for so long belongs to a process that is gone."""
WITHOUT_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)
"""Errors of file systems that have no locks, such as Lustre mounted without `flock`."""


class Lease:
    """The right to write into a folder; use it as a context manager.

    A share holds the folder together with other shares, and its own number alone.

    Args:
        path: lock file inside the folder.
        runner: that does the work; shares may work side by side.
        doing: verb of the work, for messages: "is converting to".
        note: first line of the lock file, for people who find it.

    Raises:
        NotYetError: another driver holds the folder; says which, and since when.
        Unfinished: the work ended while a share waited for its turn, so nothing is left to do.
        DataError: the folder cannot be written to.
    """

    def __init__(self, path: Path, runner: Runner, doing: str, note: str = "") -> None:
        self._path, self._doing, self._note = path, doing, note
        self._share = runner if isinstance(runner, Share) else None
        self._files: list[TextIO] = []
        require_begun(runner, path.parent)
        try:
            if self._share is None:
                self._lock(path)
            else:
                own = path.with_name(f"{path.name}.{self._share.number}-of-{self._share.of}")
                until = time.monotonic() + SECONDS_TO_WAIT
                self._lock(own, until=until)
                try:
                    self._lock(path, is_shared=True, until=until)
                except Unfinished:
                    own.unlink(missing_ok=True)
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
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for file in self._files:
            with suppress(OSError):  # the owner's line does not fit on a full disk, which has been said
                file.close()

    def finish(self, title: str) -> None:
        """Become the only driver, to put the result together.

        Raises:
            Unfinished: other shares are at work; the last of them puts the result together.
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

    def _lock(self, path: Path, *, is_shared: bool = False, until: float = 0.0, must_exist: bool = False) -> None:
        """Open a file with a lock on it.

        Args:
            path: of the file.
            is_shared: others may have such a lock, too.
            until: moment at which waiting for another process ends, `time.monotonic`.
            must_exist: the file was there; if it is gone, so is the work.

        Raises:
            NotYetError: another process has one.
            Unfinished: another process had one and has removed the file, at the end of all work.
        """
        with errors_name(path):
            if not must_exist:
                path.parent.mkdir(parents=True, exist_ok=True)
            while True:
                try:
                    # A file that was there and is gone must not come back: its work is done.
                    file = open(path, "r+" if must_exist else "a+", encoding="utf-8")  # noqa: SIM115 (stays open)
                except FileNotFoundError:
                    if not must_exist:
                        raise
                    raise Unfinished(
                        f"{path.parent}: another process has just finished this work: nothing is left to do."
                    ) from None
                try:
                    import fcntl

                    fcntl.flock(file.fileno(), (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
                except ImportError:  # no such locks on this platform: two drivers at a time are not noticed
                    pass
                except BlockingIOError:
                    with file:
                        if time.monotonic() >= until:
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
            file.truncate(0)
            file.write(f"{self._note}\n{_owner_line()}")
            file.flush()

    def _refusal(self, file: TextIO) -> str:
        """Message with the owner and age of a lock."""
        file.seek(0)
        try:
            owner, age = _owner_and_age(file.read())
            whom = f" ({owner}, for {age})"
        except (ValueError, TypeError):  # it is only just beginning, or the file was damaged
            whom = ""
        return f"another process {self._doing} {self._path.parent}{whom}: wait for it or choose another destination."


def remove_locks(path: Path) -> None:
    """Remove a lock file and those of its shares, where the work has ended. None may be there.

    Args:
        path: of the `Lease`.
    """
    for lock in (*path.parent.glob(f"{path.name}.*-of-*"), path):
        lock.unlink(missing_ok=True)


def _owner_line() -> str:
    """This process and the time."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return f"{socket.gethostname()} process {os.getpid()} since {now}\n"


def _owner_and_age(text: str) -> tuple[str, timedelta]:
    """Process and age of a line of `_owner_line`, the last of a text; ValueError or TypeError where there is none."""
    owner, _, since = (text.splitlines() or [""])[-1].partition(" since ")
    age = int((datetime.now(UTC) - datetime.fromisoformat(since)).total_seconds())
    return owner, timedelta(seconds=max(age, 0))  # its clock may be ahead of ours


@contextmanager
def remote_lease(url: str, doing: str) -> Iterator[Callable[[], object]]:
    """Hold a remote folder for the time of a block; yields a function to be called every few minutes meanwhile.

    Buckets have no locks. So the owner and the time are in a file that only one process can create, and that counts
    until it is removed, or was not renewed for `SECONDS_OF_SILENCE`.

    Args:
        url: of the folder.
        doing: verb of the work, for messages: "is copying to".

    Raises:
        NotYetError: another process holds the folder, or took it over after a long silence of this one.
        DataError: the folder cannot be written to.
    """
    place = f"{url}/{REMOTE_LEASE}"

    def renew() -> None:
        owner = get_text(place).partition(" since ")[0]
        if owner != _owner_line().partition(" since ")[0]:
            raise NotYetError(
                f"{owner or 'another process'} has taken over {url}, after a silence of this process: run the command "
                "again."
            )
        put_text(place, _owner_line(), is_new=False)

    while not put_text(place, _owner_line(), is_new=True):
        text = get_text(place)
        try:
            owner, age = _owner_and_age(text)
        except (ValueError, TypeError):  # it is only just beginning, or was damaged
            owner, age = "unknown", timedelta()
        if age.total_seconds() < SECONDS_OF_SILENCE:
            raise NotYetError(
                f"another process {doing} {url} ({owner}, last heard of {age} ago): wait for it, or remove {place} if "
                "it is gone."
            )
        log.warning(f"{url}: taken over from {owner}, silent for {age}.")
        remove(place)
    try:
        yield renew
    finally:
        with suppress(DataError):  # gone, or another's
            renew()
            remove(place)
