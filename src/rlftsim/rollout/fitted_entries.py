"""The entry model that ships with the package, fitted to 120 long logs of 24 synthetic street networks.

python -c 'from rlftsim.scenario.synthetic.generate import generate; generate("FIT", num_scenarios=120,
    seed=(1 << 48) + 20261130, num_steps=711, splits={"training": 1.0}, scenarios_per_network=5)'
rlftsim entries fit FIT src/rlftsim/rollout/fitted_entries.npz
"""

from pathlib import Path

from rlftsim.rollout.entries import load_entries

FITTED = load_entries(str(Path(__file__).with_suffix(".npz")))
