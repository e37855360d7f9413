"""Result folders: what a folder holds, by the files that it has anyway, and which results may be written into it."""

from pathlib import Path
from typing import Literal

from rlftsim.errors import ConfigError, DataError, in_short

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
MAY_LIE_BESIDE: dict[FolderType, tuple[FolderType, ...]] = {"results": ("set of rollouts", "run")}
"""Types of result that may be written into a folder of another type, which has no use for their names."""


def recognize_folder(folder: Path) -> FolderType | None:
    """Type of a result folder; None for any other folder, and where there is none."""
    for folder_type, groups in MARKERS.items():
        if any(all((folder / name).exists() for name in names) for names in groups):
            return folder_type
    return None


def check_folder(folder: Path, folder_type: FolderType) -> None:
    """Check that results of a type may be written into a folder. It may be missing, and may hold files of others.

    Args:
        folder: Place of the results.
        folder_type: Type of the results.

    Raises:
        DataError: A file, the folder of another type of result, or a folder inside one.
    """
    if folder.exists() and not folder.is_dir():
        raise DataError(f"{folder} is a file, not a folder: choose another folder.")
    if holder := _find_holder(folder):
        raise DataError(f"{folder} lies inside {holder}: choose another folder.")
    found = recognize_folder(folder)
    if found not in (None, folder_type, *MAY_LIE_BESIDE.get(folder_type, ())):
        raise DataError(f"{folder} is the folder of a {found}: choose another folder.")


def check_file(path: Path) -> None:
    """Check that a file that a command is to write would replace none that a result folder consists of.

    Args:
        path: The file, which need not exist.

    Raises:
        DataError: It is one by which the folder is recognized, or lies in a folder of its own alone.
    """
    found = recognize_folder(path.parent)
    if found and path.exists() and any(path.name in names for names in MARKERS[found]):
        raise DataError(f"{path} is part of a {found}: choose another file.")
    if holder := _find_holder(path.parent):
        raise DataError(f"{path} lies inside {holder}: choose another file.")


def check_name(name: str, what: str) -> None:
    """Check that a name can be that of a file.

    Args:
        name: Text of a user.
        what: Meaning of the name in the message, such as "an evaluation's name".

    Raises:
        ConfigError: It is empty, longer than 200 bytes, or has a slash, a line break or another control character.
    """
    is_file_name = name.strip() and name not in (".", "..") and not {*"/\\"} & {*name}
    if not (is_file_name and name.isprintable() and len(name.encode()) <= 200):
        raise ConfigError(f"{what} becomes a file name, {in_short(name)} cannot: choose another name.")


def _find_holder(folder: Path) -> str | None:
    """The result folder, in words, that a folder is an inner one of."""
    folder = folder.resolve()
    for outer in folder.parents:
        found = recognize_folder(outer)
        if found and folder.relative_to(outer).parts[0] in INNER_FOLDERS.get(found, ()):
            return f"the {found} {outer}"
    return None
