"""The verb that shows everything: demo."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

from rlftsim.experiments.demo import DemoConfig, run_demo
from rlftsim.experiments.evaluate import EvaluateConfig
from rlftsim.recipes.smart import smart_demo_quick, smart_demo_rlftsim
from rlftsim.scenario.synthetic import pack_path


@dataclass(frozen=True)
class Demo:
    """See the whole pipeline work on synthetic scenarios, in minutes, on a CPU.

    Vocabulary, pre-training, closed-loop fine-tuning with the MLOO reward, evaluation on held-out scenarios, and a report with
    pictures. Interrupted in any way, the same command goes on where it was.
    """

    out: Path | None = None
    """Folder for everything; the report is OUT/report.html. Left out, runs/demo or runs/demo-quick."""
    quick: bool = False
    """Every stage at its smallest: shows that all of them run, not that fine-tuning helps."""

    def run(self) -> int:
        """Run the stages, print the table and where the report is."""
        jobs = min(os.cpu_count() or 1, 4)
        evaluation = EvaluateConfig(jobs=jobs)
        config = DemoConfig(smart_demo_rlftsim(), pack_path(), evaluation)
        if self.quick:
            config = replace(
                config, recipe=smart_demo_quick(), evaluate=replace(evaluation, num_rollouts=8, limit=8), num_scenes=2
            )
        result = run_demo(config, self.out or Path("runs/demo-quick" if self.quick else "runs/demo"))
        print(f"report: {result.report}")
        return 0
