"""Archives before Waymo's own package, in an environment of its own that RLFTSIM_OFFICIAL_PYTHON names."""

import json
import os
import subprocess
from pathlib import Path

import entries
import pytest

from rlftsim.evaluation.score_files import ScoreConfig, score_rollouts, to_json
from rlftsim.scenario import womd_pb2
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.scenario.tfrecord import read_records, write_records
from rlftsim.scenario.womd import find_tfrecords, scenario_from_bytes
from rlftsim.submission.build import build_archive
from rlftsim.submission.check import check_archive

NUM_SYNTHETIC = 16
SCORED = "bada21415c031740"
"""The smallest real scenario: the official evaluator takes half a minute for it."""


@pytest.mark.slow
@pytest.mark.official
def test_the_official_package_accepts_the_archive_and_scores_it_alike(shared, tmp_path):
    python = os.environ.get("RLFTSIM_OFFICIAL_PYTHON")
    if python is None:
        pytest.skip("RLFTSIM_OFFICIAL_PYTHON names no Python with Waymo's package")
    # 1. seven real scenarios and some synthetic ones, as the official package and as this one has them
    logs = tmp_path / "logs"
    logs.mkdir()
    records = [data for path in find_tfrecords(shared / "data" / "womd") for _, data in read_records(path)]
    synthetic = ScenarioDataset("synthetic", "validation")[:NUM_SYNTHETIC]
    write_records(logs / "all.tfrecord", [*records, *(as_message(scenario) for scenario in synthetic)])
    write_dataset([*map(scenario_from_bytes, records), *synthetic], tmp_path / "set", split="testing")
    data = ScenarioDataset(tmp_path / "set", "testing")
    # 2. an archive of them
    archive = build_archive(entries.make_job(data, tmp_path / "out"), show_progress=False)
    assert check_archive(archive, data, show_progress=False).findings.lines() == []
    unpacked = tmp_path / "unpacked"
    unpacked.mkdir()
    subprocess.run(["tar", "xzf", archive, "-C", unpacked], check=True)
    # 3. the official validator and evaluator
    script = Path(__file__).parent / "official_reader.py"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [python, script, unpacked, logs, "--score", SCORED]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    official = json.loads(done.stdout)
    assert sorted(official["valid"]) == sorted(data.scenario_ids)
    assert len(official["valid"]) >= 20
    (metadata,) = official["metadata"]
    assert 'num_model_parameters: "7M"' in metadata
    assert "submission_type: SIM_AGENTS_SUBMISSION" in metadata
    ours = to_json(score_rollouts(unpacked, tmp_path / "set", None, ScoreConfig(jobs=1), show_progress=False))
    (row,) = (row for row in ours["scenarios"] if row["scenario_id"] == SCORED)
    scores = official["scores"][SCORED]
    assert "metametric" in scores
    assert {name: row[name] for name in scores} == pytest.approx(scores, abs=1e-6, rel=1e-6)


def as_message(scenario):
    """A log as far as the official validator reads it: ids, and who is valid when."""
    message = womd_pb2.Scenario(scenario_id=scenario.scenario_id, sdc_track_index=scenario.ego_index)
    for object_id, valid in zip(scenario.tracks.object_id.tolist(), scenario.tracks.valid.tolist()):
        track = message.tracks.add(id=object_id)
        for is_valid in valid:
            track.states.add(valid=is_valid)
    return message.SerializeToString()
