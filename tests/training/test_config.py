"""Settings of training methods: read without torch, which a help text has no time to import."""

import os
import subprocess
import sys

from rlftsim.rewards import parse_reward, write_reward
from rlftsim.training.calibrate import split_scenarios
from rlftsim.training.config import CONSTRAINED_MEANS, SHIPPED_REWARDS, CalibrateConfig
from rlftsim.training.constraints import CONSTRAINTS

ALL_SETTINGS = """
import sys
from rlftsim.training.config import *
FinetuneConfig(), PretrainConfig(), CatkConfig(), RoadConfig(), GcslConfig(), CalibrateConfig(), AugmentConfig()
FinetuneConfig(reward="gcft", goals=with_goals(GoalConfig()))
assert "torch" not in sys.modules
"""


def test_settings_of_every_method_need_no_torch():
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", ALL_SETTINGS], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_rewards_that_are_known_without_torch_are_what_the_parser_makes_of_them():
    assert {text: write_reward(parse_reward(text)) for text in SHIPPED_REWARDS} == SHIPPED_REWARDS


def test_each_constraint_that_settings_name_by_default_exists():
    assert set(CONSTRAINED_MEANS) < set(CONSTRAINTS.names())


def test_a_calibration_has_an_update_for_each_batch_of_each_stage():
    config = CalibrateConfig(batch_size=4, num_scenarios=30, lengths=(0.7, 1.4))
    fitted, held_back = split_scenarios(config, [str(index) for index in range(100)])
    assert (len(fitted), len(held_back)) == (24, 6)
    assert config.num_updates(100) == 6 + 3 * 2
