"""Data sets to and from buckets."""

import os
import shutil
from pathlib import Path

from rlftsim.atomic_io import write_text
from rlftsim.errors import DataError
from rlftsim.progress import progress_bar
from rlftsim.scenario.dataset import INCOMPLETE, INDEX, MANIFEST, Manifest, parse_manifest, read_manifest
from rlftsim.scenario.shards import hash_file
from rlftsim.storage import fetch, mirror, publish


def push_dataset(folder: str | os.PathLike[str], url: str, *, show_progress: bool = True) -> Manifest:
    """Copy a data set to a bucket: shards first, the manifest last, so that readers never see a part of it.

    Shards that are there already, by the manifest there, are not copied again.

    Args:
        folder: the data set.
        url: of its copy, such as s3://bucket/womd.
        show_progress: False = no progress bar.

    Raises:
        DataError: no finished data set in the folder, or the bucket cannot be written to.
    """
    folder, url = Path(folder), url.rstrip("/")
    manifest = read_manifest(folder)
    try:
        there = {(entry.file, entry.sha256) for entry in parse_manifest(mirror(url, (INDEX, MANIFEST))).shards}
    except DataError:  # no data set there yet
        there = set()
    with progress_bar("push", len(manifest.shards), show=show_progress) as advance:
        for entry in manifest.shards:
            if (entry.file, entry.sha256) not in there:
                publish(folder / entry.file, f"{url}/{entry.file}")
            advance(1)
    for name in (INDEX, MANIFEST):
        publish(folder / name, f"{url}/{name}")
    return manifest


def pull_dataset(url: str, folder: str | os.PathLike[str], *, show_progress: bool = True) -> Manifest:
    """Copy a data set from a bucket to a folder. Interrupted in any way, the same call goes on.

    Args:
        url: of the data set.
        folder: new, empty, or one with a part of this data set.
        show_progress: False = no progress bar.

    Raises:
        DataError: no data set there, something else in the folder, or a shard that is not the manifest's.
    """
    folder, url = Path(folder), url.rstrip("/")
    if folder.exists() and not (folder / INCOMPLETE).exists() and any(folder.iterdir()):
        raise DataError(f"{folder} is not empty: choose another folder or delete it")
    manifest = read_manifest(source := mirror(url, (INDEX, MANIFEST)))
    write_text(folder / INCOMPLETE, f"A copy of {url} was interrupted: run the same command again, it goes on.\n")
    with progress_bar("pull", len(manifest.shards), show=show_progress) as advance:
        for entry in manifest.shards:
            path = folder / entry.file
            if not path.exists() or hash_file(path) != entry.sha256:
                fetch(f"{url}/{entry.file}", path, entry.sha256)
            advance(1)
    for name in (INDEX, MANIFEST):
        shutil.copyfile(source / name, folder / name)
    (folder / INCOMPLETE).unlink()
    return manifest
