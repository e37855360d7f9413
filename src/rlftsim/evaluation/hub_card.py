"""Card of a model at Hugging Face: license by the terms of all data that the weights have seen, and scores."""

import json
import math
import re
from pathlib import Path
from typing import Any

from rlftsim.errors import ConfigError
from rlftsim.evaluation.columns import SCORES
from rlftsim.evaluation.results import Evaluation
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy

_ORIGIN = re.compile(r"^#+ Made from .*$", re.MULTILINE)
"""Heading of the card of a model that the weights were made from."""
_TERMS = re.compile(r"^\* terms(?: of the data)?: .*(?:\n  .*)*|Weights: CC0-1\.0", re.MULTILINE)
_LICENSES = {"Waymo": "other", "CC BY-NC-SA 4.0": "cc-by-nc-sa-4.0"}
"""License of weights by words in the terms of data that leave no choice."""
_WAYMO = {"license_name": "waymo-open-dataset-non-commercial", "license_link": "https://waymo.com/open/terms"}


def write_hub_card(
    url: str, card: str, license: str | None = None, *, i_comply: bool = False, evaluation: Evaluation | None = None
) -> str:
    """A card behind the header that Hugging Face reads.

    Args:
        url: Address of the model.
        card: Card of the model, with the cards of all models that the weights were made from.
        license: Identifier of the license that was chosen; None = none was.
        i_comply: True = the declaration on weights made from the Waymo Open Dataset.
        evaluation: Evaluation of this model; None = a card without scores.

    Raises:
        ConfigError: Unknown terms, a license that contradicts them, or a missing license or declaration.
    """
    terms = [" ".join(_TERMS.findall(section)) for section in _ORIGIN.split(card)]
    if not all(terms):
        raise ConfigError(
            f"{url}: the card names no terms of some of the data that the weights have seen, and these hold for the "
            'weights, too: train on a data set with a license note, or write "* terms of the data: ..." there.'
        )
    fixed = [fixed_id for words, fixed_id in _LICENSES.items() if any(words in text for text in terms)]
    is_waymo = "other" in fixed
    if is_waymo and not i_comply:
        raise ConfigError(
            f"{url}: weights made from the Waymo Open Dataset fall under its license agreement, which covers models "
            "derived from the data: non-commercial use alone, and recipients who are bound by it. Read its terms on "
            "distribution (waymo.com/open/terms), and add --i-comply if this is in keeping with them."
        )
    license_id = fixed[0] if fixed else license
    if license_id is None:
        raise ConfigError(f"{url}: add --license, such as cc-by-4.0, in keeping with: {' '.join(dict.fromkeys(terms))}")
    if license not in (None, license_id):
        raise ConfigError(f"{url}: --license {license} contradicts the terms of the data, {license_id}: leave it out.")
    header: dict[str, Any] = {"license": license_id, **(_WAYMO if is_waymo else {})}
    header |= {"library_name": "rlftsim", "tags": ["traffic-simulation"]}
    if evaluation is not None:
        header["model-index"] = [{"name": url.rpartition("/")[2], "results": [_describe_scores(evaluation)]}]
    lines = "".join(f"{name}: {json.dumps(value, ensure_ascii=False)}\n" for name, value in header.items())
    return f"---\n{lines}---\n{card}\n"


def read_evaluation(path: Path, policy: Policy) -> Evaluation:
    """Stored evaluation of a policy.

    Args:
        path: Parquet file that `rlftsim evaluate` wrote.
        policy: Policy that must have been evaluated.

    Raises:
        ConfigError: An evaluation of other weights.
        DataError: A damaged file, or none.
    """
    evaluation = Evaluation.read(path)
    if evaluation.provenance.policy_fingerprint != fingerprint_policy(policy):
        raise ConfigError(f"{path} is an evaluation of other weights: evaluate these, or leave --evaluation out.")
    return evaluation


def _describe_scores(evaluation: Evaluation) -> dict[str, Any]:
    """Means with 95 % intervals of an evaluation."""
    metrics = []
    for column in SCORES:
        estimate = evaluation.mean_and_error(column.source)
        if math.isfinite(estimate.mean):
            low, high = estimate.interval
            name = f"{column.heading}, 95 % interval [{low:.6g}, {high:.6g}]"
            metrics.append({"type": column.source, "value": round(estimate.mean, 6), "name": name})
    config = evaluation.config
    name = f"{len(evaluation)} scenarios x {config.num_rollouts} rollouts, metric {config.metric}"
    dataset = {"type": "-".join(evaluation.provenance.sources) or "unknown", "name": name}
    return {"task": {"type": "traffic-simulation"}, "dataset": dataset, "metrics": metrics}
