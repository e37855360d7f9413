"""Clusters of scenarios, which share a street network or a recording, and the splits that are drawn by them.

Choices are made on `tune`; `exam` is looked at once. Where a data set stores no splits of these names, a fixed third of
the clusters of the validation split is `exam` and two thirds are `tune`. Of generated scenarios `tune` is all of
validation, because the exam is generated, too: `rlftsim experiment exam`.
"""

import hashlib
import re
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Shaped

from rlftsim.errors import DataError

VALIDATION, TUNE, EXAM = "validation", "tune", "exam"
_AV2_WINDOW = re.compile(r"-(0|19)$")
"""End of the id of one of the two windows of a recording."""


@runtime_checkable
class Indexed(Protocol):
    """Attributes of a data set that say which clusters the scenarios belong to."""

    folder: Path
    index: pa.Table
    manifest: Any


def find_clusters(dataset: Indexed) -> Shaped[np.ndarray, "scenarios"]:
    """Label of each scenario's street network (synthetic) or recording (Argoverse 2), else the scenario id.

    Scenarios of one label are not independent: statistics count labels.

    Args:
        dataset: Data set, or one split of it; labels come in the order of the index.
    """
    ids, sources, shards = (dataset.index[name].to_pylist() for name in ("scenario_id", "source", "shard"))
    networks = find_networks(dataset)
    labels = [
        networks.get(shard) or (_AV2_WINDOW.sub("", scenario_id) if source == "av2" else scenario_id)
        for scenario_id, source, shard in zip(ids, sources, shards)
    ]
    return np.array(labels, dtype=object)


def find_networks(dataset: Indexed) -> dict[str, str]:
    """Street network by shard, of generated scenarios; empty for logged ones.

    Raises:
        DataError: The manifest's list of networks is damaged.
    """
    provenance = dataset.manifest.provenance
    if "networks" not in provenance:
        return {}
    try:
        return {f"shards/{entry['shard']}": "/".join(map(str, entry["seed"])) for entry in provenance["networks"]}
    except (TypeError, KeyError) as error:
        raise DataError(
            f"{dataset.folder}: the manifest's list of networks is damaged ({error}): generate again."
        ) from None


def find_split(dataset: Indexed, split: str) -> Bool[np.ndarray, "scenarios"]:
    """True for the scenarios of a split, stored or drawn, see the module; all False for an unknown split.

    Args:
        dataset: Whole data set, all splits.
        split: Name of the split, such as "training", "tune" or "exam".
    """
    stored = dataset.index["split"].to_numpy(zero_copy_only=False)
    if split not in (TUNE, EXAM) or split in stored:
        return stored == split
    if find_networks(dataset):
        return (stored == VALIDATION) & (split == TUNE)
    is_exam = np.array([is_in_exam(label) for label in find_clusters(dataset)], dtype=bool)
    return (stored == VALIDATION) & (is_exam == (split == EXAM))


def is_in_exam(label: str) -> bool:
    """True for a third of all labels of clusters: the same labels on any machine and in any data set."""
    return int.from_bytes(hashlib.sha256(label.encode()).digest()[:8]) % 3 == 0
