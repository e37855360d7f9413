"""The verb that runs the whole pipeline: demo."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

from rlftsim.evaluation.evaluate import EvaluateConfig
from rlftsim.experiments.demo import DemoConfig, run_demo
from rlftsim.recipes.smart import smart_demo_quick, smart_demo_rlftsim
from rlftsim.scenario.synthetic import pack_path


@dataclass(frozen=True)
class Demo:
    """Run the whole pipeline on synthetic scenarios, in minutes, on a CPU.

    Vocabulary, pre-training, closed-loop fine-tuning with the MLOO reward, evaluation on held-out scenarios,
    and a report with pictures. An interrupted demo continues when the same command is repeated.
    """

    out: Path | None = None
    """Folder for everything; the report is OUT/report.html. Left out: runs/demo or runs/demo-quick."""
    quick: bool = False
    """Run every stage at its smallest size. This shows that all stages work, not that fine-tuning helps."""

    def run(self) -> int:
        """Run the stages; print the table and the path of the report."""
        # More processes than this only compete for memory bandwidth on the machines that the demo is made for.
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
