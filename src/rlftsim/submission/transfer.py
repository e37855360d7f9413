"""Large archives cut into parts for transport. The upload page takes the joined file."""

import math
import os
from glob import escape
from pathlib import Path

from rlftsim.errors import ConfigError
from rlftsim.jobs.files import errors_name, remove_temporaries, temporary_path

_CHUNK = 1 << 22


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
                    while left and (chunk := source.read(min(left, _CHUNK))):
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
