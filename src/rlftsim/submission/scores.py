"""Realism of the rollouts in an archive, scored during the check: the number that the file will get."""

import numpy as np
import pyarrow as pa
import torch

from rlftsim.evaluation.results import SCHEMA, EvaluateConfig, Evaluation, Provenance, Skipped, row_of_result
from rlftsim.evaluation.rollout_files import AXES
from rlftsim.evaluation.scenario_source import hash_manifest
from rlftsim.evaluation.score_files import has_road_edge
from rlftsim.realism import SimulatedStates, metric_by_name, scenario_log, score
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenario
from rlftsim.submission.messages import NUM_SCENES, DecodedRollouts


class ArchiveScores:
    """Scores scenario by scenario; an instance is the `see` of `check_archive`."""

    def __init__(self, metric: str = "2025") -> None:
        self._metric = metric_by_name(metric)
        self._rows: list[dict[str, object]] = []
        self._skipped: list[Skipped] = []

    def __call__(self, scenario: Scenario, decoded: DecodedRollouts) -> None:
        """Score a scenario.

        Args:
            scenario: Scenario with the logged future that the metric compares with.
            decoded: Rollouts without an error.
        """
        if not has_road_edge(scenario):
            self._skipped.append(Skipped(scenario.scenario_id, "has no road edge"))
            return
        assert decoded.values is not None
        x, y, z, heading = (torch.from_numpy(decoded.values[:, :, axis].copy()) for axis in range(len(AXES)))
        states = SimulatedStates(np.array(decoded.object_ids[0], np.int64), x, y, z, heading)
        result = score(scenario_log(scenario), states, self._metric)
        self._rows.append(row_of_result(result, scenario, states))

    def evaluation(self, name: str, data: ScenarioDataset, sha256: str) -> Evaluation:
        """The scores, in the order of the archive.

        Args:
            name: Name of the row in tables.
            data: Scenarios of the archive's split.
            sha256: Checksum of the archive, in place of a policy's fingerprint.
        """
        provenance = Provenance(
            config=EvaluateConfig(num_rollouts=NUM_SCENES, metric=self._metric.name, split=data.split),
            policy="rollouts of a submission",
            policy_fingerprint=sha256,
            dataset=str(data.folder.absolute()),
            manifest_sha256=hash_manifest(data.folder),
            sources=data.sources,
            guessed=data.guessed,
        )
        table = pa.Table.from_pylist(self._rows, schema=SCHEMA)
        return Evaluation(name, provenance, table, tuple(self._skipped))
