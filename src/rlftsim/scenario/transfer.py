"""Data sets to and from buckets."""

import os
import shutil
from pathlib import Path

from rlftsim.errors import DataError
from rlftsim.jobs.buckets import check_writable, fetch, folder_address, mirror, publish, remote_lease, remove
from rlftsim.jobs.files import remove_temporaries
from rlftsim.jobs.folder import Lease, check_folder
from rlftsim.jobs.progress import progress_bar
from rlftsim.jobs.runner import Inline
from rlftsim.scenario.dataset import INCOMPLETE, INDEX, MANIFEST, Manifest, parse_manifest, read_manifest
from rlftsim.scenario.shards import hash_file


def push_dataset(folder: str | os.PathLike[str], url: str, *, show_progress: bool = True) -> Manifest:
    """Copy a data set to a bucket: shards first, the manifest last, so that readers never see a part of it.

    Shards that are there already, by the manifest there, are not copied again. Where others are replaced, the manifest
    is removed first: until the end there is no data set, and after an interruption the same call copies all.

    Args:
        folder: Folder of the data set, which must be finished.
        url: Address of the copy, such as s3://bucket/womd.
        show_progress: False prints neither progress nor the time left.

    Raises:
        ConfigError: No address of a folder, or one that is only read from.
        DataError: No finished data set in the folder, or the bucket cannot be written to.
        NotYetError: Another process copies a data set to this address.
    """
    folder, url = Path(folder), folder_address(url)
    check_writable(url)
    manifest = read_manifest(folder)
    with remote_lease(url) as renew:
        try:
            published = {(entry.file, entry.sha256) for entry in parse_manifest(mirror(url, (INDEX, MANIFEST))).shards}
        except DataError:  # no data set there yet
            published = set()
        if published and any((entry.file, entry.sha256) not in published for entry in manifest.shards):
            remove(f"{url}/{MANIFEST}")
        with progress_bar("push", len(manifest.shards), show=show_progress) as advance:
            for entry in manifest.shards:
                if (entry.file, entry.sha256) not in published:
                    publish(folder / entry.file, f"{url}/{entry.file}")
                    renew()
                advance(1)
        renew()
        for name in (INDEX, MANIFEST):
            publish(folder / name, f"{url}/{name}")
    return manifest


def pull_dataset(url: str, folder: str | os.PathLike[str], *, show_progress: bool = True) -> Manifest:
    """Copy a data set from a bucket to a folder. Interrupted in any way, the same call goes on.

    Args:
        url: Address of the data set, such as s3://bucket/womd.
        folder: Folder of the copy: new, empty, or with a begun copy of this data set.
        show_progress: False prints neither progress nor the time left.

    Raises:
        ConfigError: No address of a folder.
        DataError: No data set at the address, a folder with other contents or another process at work, or a shard that
            is not the manifest's.
    """
    folder, url = Path(folder), folder_address(url)
    check_folder(folder, "data set")
    mark = folder / INCOMPLETE
    note = f"A copy of {url} runs here or was interrupted: run the same command again, it goes on."
    # the mark itself may be cut short
    is_begun = mark.is_file() and note.encode().startswith(mark.read_bytes()[: len(note.encode())])
    if folder.exists() and not is_begun and any(folder.iterdir()):
        raise DataError(f"{folder} is not empty: choose another folder or delete it")
    manifest = read_manifest(source := mirror(url, (INDEX, MANIFEST)))
    # The folder is marked as unfinished until the mark is removed.
    with Lease(mark, Inline(), "is copying to", note) as lease:
        remove_temporaries(folder / name for name in (INDEX, MANIFEST, *(entry.file for entry in manifest.shards)))
        with progress_bar("pull", len(manifest.shards), show=show_progress) as advance:
            for entry in manifest.shards:
                path = folder / entry.file
                if not path.exists() or hash_file(path) != entry.sha256:
                    fetch(f"{url}/{entry.file}", path, entry.sha256)
                advance(1)
        for name in (INDEX, MANIFEST):
            shutil.copyfile(source / name, folder / name)
        lease.remove()
    return manifest
