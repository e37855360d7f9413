"""Files that are written whole or not at all: under a temporary name in the same folder, then renamed."""

import errno
import json
import os
import re
import shutil
import socket
import tempfile
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from functools import lru_cache
from pathlib import Path

from safetensors.torch import save
from torch import Tensor

from rlftsim.errors import DataError
from rlftsim.jobs.documents import parse_json

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of the operating system where a file does not fit."""
_TEMPORARY = re.compile(r"\.(.+)\.(\d+)\.tmp")
"""Names that `temporary_path` gives: of file and machine, and the number of the process."""


@contextmanager
def errors_name(path: Path) -> Iterator[None]:
    """Turn an error of the operating system, such as a full disk, into a line that names a path and the way out.

    Raises:
        DataError: in place of an OSError.
    """
    try:
        yield
    except OSError as error:
        raise cannot_write(path, error) from None


def cannot_write(path: Path, error: OSError) -> DataError:
    """Error of a file that cannot be written, with a way out that fits the cause.

    Args:
        path: File that was to be written, which begins the message.
        error: Error of the operating system, such as that of a full disk.
    """
    remedy = "choose another place, then run the same command again."
    # some libraries tell no error number: a full disk is the likeliest cause there
    if error.errno in (None, *NO_ROOM):
        remedy = f"make room or {remedy}"
    elif isinstance(error, FileExistsError | NotADirectoryError):
        # the file stands where the path needs a folder
        file = next((parent for parent in (path, *path.parents) if parent.is_file()), None)
        remedy = f"{file} is a file, not a folder: choose another place." if file else remedy
    elif isinstance(error, IsADirectoryError):
        remedy = "it is a folder: name a file."
    return DataError(f"cannot write {path} ({error.strerror or error}): {remedy}")


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename the file to `path`. A missing folder is created.

    A symbolic link stays, and the target of the link is replaced. Devices and pipes stay, too, and receive the finished
    bytes. Temporary files of ended processes of this machine are removed.

    Args:
        path: File that appears when the content is whole.
        write: Writer of the content, called with the path of the temporary file.

    Raises:
        DataError: The file cannot be written, such as on a full disk. Then, and after any other error, no temporary
            file is left behind and an older file of this name is untouched.
    """
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    # Asked of the path: /dev/stdout leads to a pipe, which has no path of its own.
    is_stream = path.exists() and not (path.is_file() or path.is_dir())
    folder = tempfile.TemporaryDirectory() if is_stream else nullcontext(target.parent)
    with errors_name(path), folder as temporary_folder:
        temporary = temporary_path(Path(temporary_folder) / target.name)
        try:
            temporary.parent.mkdir(parents=True, exist_ok=True)
            for process, leftover in _list_temporaries(temporary.parent).pop(target.name, ()):
                if not _is_running(process):
                    leftover.unlink(missing_ok=True)
            write(temporary)
            # On disk before it gets the name: after a power cut the name must not stand for an empty file.
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
                if is_stream:
                    with path.open("wb") as stream:
                        shutil.copyfileobj(file, stream)
            if not is_stream:
                temporary.replace(target)
        finally:
            if temporary.is_file():
                temporary.unlink()


def check_result_file(path: Path) -> None:
    """Check that a path at which a result is read or written is a file, if anything: a pipe would wait for ever.

    Args:
        path: File of a result; may be missing.

    Raises:
        DataError: A folder, a pipe or a device.
    """
    if path.exists() and not path.is_file():
        raise DataError(f"{path} is {describe_type(path)}, not a file: choose another --out or name, or remove it.")


def list_folder(folder: Path) -> Iterator[Path]:
    """Yields files and folders in a folder and its subfolders; unlike `Path.rglob` passes over no closed data.

    Args:
        folder: Folder whose links to other folders are not followed.

    Raises:
        OSError: A folder that cannot be listed, such as for lack of permission, and is none of the system's.
    """

    def stop(error: OSError) -> None:
        # such as .Trash-0 and lost+found, which a disk has beside data
        is_of_system = Path(error.filename).name.startswith((".", "lost+found"))
        if not is_of_system or Path(error.filename) == folder:
            raise error

    for root, folders, files in os.walk(folder, onerror=stop):
        yield from map(Path(root).joinpath, (*folders, *files))


def describe_type(path: Path) -> str:
    """What a path leads to, in words."""
    if path.is_dir():
        return "a folder"
    if path.exists():
        return "a file" if path.is_file() else "a pipe or device"
    return "a link that leads nowhere" if path.is_symlink() else "no such file or folder"


def temporary_path(path: Path) -> Path:
    """Name for a file that is not whole yet: unique to this process, on all machines that see the folder."""
    # Beside the file, as a rename is atomic within a file system only.
    return path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}.tmp")


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Folder to be filled, renamed when whole and removed after an error.

    Args:
        folder: Folder that no other machine is writing now; missing, or empty at the end.

    Raises:
        DataError: The folder cannot be made, or is not empty.
    """
    folder = folder.absolute()
    temporary = temporary_path(folder)  # beside the folder, so that renaming it never crosses file systems
    remove_temporaries([folder])  # of processes that were killed
    try:
        with errors_name(folder):
            temporary.mkdir(parents=True)
        yield temporary
        with errors_name(folder):
            if folder.exists():
                folder.rmdir()
            temporary.replace(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)  # still there after an error alone


@lru_cache(maxsize=256)
def _list_temporaries(folder: Path) -> dict[str, list[tuple[int, Path]]]:
    """Processes and temporary files of this machine in a folder, by the name of the file; listed once, as folders may
    be large.
    """
    temporaries: dict[str, list[tuple[int, Path]]] = defaultdict(list)
    host = f".{socket.gethostname()}"
    for path in folder.glob(".*.tmp"):
        match = _TEMPORARY.fullmatch(path.name)
        if match and match[1].endswith(host) and path.is_file():
            temporaries[match[1].removesuffix(host)].append((int(match[2]), path))
    return temporaries


def remove_temporaries(paths: Iterable[Path]) -> None:
    """Remove temporary files and folders that ended processes left beside results; those of other results stay.

    Args:
        paths: Files or folders that no other machine is writing now; processes of this machine are asked for.
    """
    names: dict[Path, set[str]] = defaultdict(set)
    for path in paths:
        names[path.parent].add(path.name)
    for folder, outputs in names.items():
        for leftover in folder.glob(".*.tmp"):
            if (match := _TEMPORARY.fullmatch(leftover.name)) and _is_left(match[1], int(match[2]), outputs):
                if leftover.is_dir():
                    shutil.rmtree(leftover, ignore_errors=True)
                else:
                    leftover.unlink(missing_ok=True)


def _is_left(name_and_host: str, process: int, names: Collection[str]) -> bool:
    """True for a temporary file of one of the names whose writer has ended, or is on another machine."""
    name = name_and_host.removesuffix(f".{socket.gethostname()}")
    if name == name_and_host:  # of another machine, whose name may have dots as the file's may
        return any(name.startswith(f"{output}.") for output in names)
    return name in names and (process == os.getpid() or not _is_running(process))


def _is_running(process: int) -> bool:
    """True for a process of this machine that has not ended."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    # in containers nobody collects the exit status of orphans, which stay in the list of processes for good
    with suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return True


def remove_folder(folder: Path, names: Collection[str]) -> None:
    """Remove files of the given names and the temporary files of killed writers, then the folder if empty.

    Args:
        folder: May be missing. Files of other names, and inner folders, stay.
        names: Files that the caller has written there.
    """
    # first: who lists the names by the files that are there would not name these again after a kill in between
    remove_temporaries(folder / name for name in names)
    for name in names:
        (folder / name).unlink(missing_ok=True)
    with suppress(OSError):  # it holds something else, or is gone
        folder.rmdir()


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8.

    Args:
        path: File that appears when all of the text is on disk; a missing folder is created.
        text: Whole content of the file.

    Raises:
        DataError: The file cannot be written, see `write_atomically`.
    """
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def append_text(path: Path, text: str) -> None:
    """Add a text to the end of a file, in UTF-8. Unlike `write_atomically` this may leave a part of the text.

    Args:
        path: File of lines, created if missing.
        text: Whole lines, so that a reader can drop a line that was cut short.

    Raises:
        DataError: The file cannot be written, such as on a full disk.
    """
    with errors_name(path), path.open("a", encoding="utf-8") as file:
        file.write(text)


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None) -> None:
    """Write named tensors as safetensors, the same bytes in each process, readable by all that may read the folder.

    Args:
        path: File that appears when all tensors are on disk.
        tensors: Tensors of any shape by name, on any device.
        metadata: Texts by name, stored in the header of the file.

    Raises:
        DataError: The file cannot be written, see `write_atomically`.
    """
    content = save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, metadata)
    content = _sort_metadata(content) if metadata else content
    write_atomically(path, lambda temporary: temporary.write_bytes(content))


def _sort_metadata(content: bytes) -> bytes:
    """Sort the metadata in the header of a safetensors file: the order differs from process to process."""
    size = int.from_bytes(content[:8], "little")
    header = parse_json(content[8 : 8 + size], "write it again", source="tensors")
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode().ljust(size)
    assert len(text) == size, "both write JSON without spaces"
    return content[:8] + text + content[8 + size :]
