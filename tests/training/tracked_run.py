"""A run with a tracker, in a process of its own: python tracked_run.py TRACKERS FOLDER [UPDATE of a kill]."""

import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import scenes
import tiny
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import RunFolder

SECONDS_TO_WRITE = 4.0
"""Trackers write behind the back of the run."""


def main(trackers: str, folder: str, update: int = 0) -> None:
    log = RunFolder.log

    def log_and_die(self, number, values):
        log(self, number, values)
        if number == update:
            time.sleep(SECONDS_TO_WRITE)
            os.kill(os.getpid(), signal.SIGKILL)

    RunFolder.log = log_and_die
    scenarios = [scenes.straight_road(), scenes.junction_with_light()]
    policy = tiny.tiny_policy(tiny.small_vocabulary(scenarios))
    train_policy(policy, scenarios, folder, replace(tiny.PRETRAIN, epochs=2.5), trackers=trackers.split(","))


if __name__ == "__main__":
    main(*sys.argv[1:3], *map(int, sys.argv[3:]))
