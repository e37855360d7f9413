"""Recordings for the Rerun viewer."""

import re
import subprocess
import sys
from collections import Counter

import pytest

import rlftsim as rs
from rlftsim.errors import ConfigError
from rlftsim.evaluation.exporters import EXPORTERS
from rlftsim.evaluation.rerun_files import write_rerun
from rlftsim.realism.from_rollouts import logged_states


@pytest.fixture
def scenario():
    return rs.load_dataset("synthetic", "validation")[0]


def test_a_recording_has_map_boxes_lights_and_scores(scenario, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    path = write_rerun(scenario, logged_states(scenario, num_rollouts=2), tmp_path)
    assert path == tmp_path / f"{scenario.scenario_id}.rrd"
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    # Rerun's own program reads it
    command = [sys.executable, "-m", "rerun_cli", "rrd", "print", path]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    rows = Counter()  # a slow machine writes the rows of a name in several chunks
    for count, name in re.findall(r"with (\d+) rows .* - (/[a-z]\S+) - ", text):
        rows[name] += int(count)
    steps = {"/log": 91, "/lights": 91, "/rollout_0": 80}
    scores = {"/scores/collision/rollout_0": 80, "/scores/off_road/rollout_0": 80}
    assert rows == {"/map/lanes": 1, "/map/edges": 1, "/rollout_0/paths": 1, **steps, **scores}


def test_the_extra_is_named(scenario, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert EXPORTERS.get("rerun") is write_rerun
    with pytest.raises(ConfigError, match=r"need rerun-sdk: pip install 'rlftsim\[rerun\]'"):
        write_rerun(scenario, logged_states(scenario, num_rollouts=1), tmp_path)
    assert list(tmp_path.iterdir()) == []
