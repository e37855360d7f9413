"""Closed-loop reinforcement-learning fine-tuning of traffic simulation models against the realism meta-metric.

    import rlftsim as rs

    data = rs.load_dataset("synthetic", "validation")
    policy = rs.load_policy("runs/base")
    rollouts = rs.simulate(policy, data[0], num_rollouts=32, seed=0)
    print(rs.score(data[0], rollouts))
    rs.show(data[0], rollouts)

Names are loaded on first use, so that the import itself takes no time and needs no torch (PEP 562). Editors and type
checkers read them in `__init__.pyi`.
"""

# pyright: reportUnsupportedDunderAll=false

import importlib
import sys
from typing import Any

__version__ = "0.2.0.dev0"

_MODULES = {
    "rlftsim.errors": ("RlftsimError",),
    "rlftsim.evaluation.results": ("Evaluation",),
    "rlftsim.goals.types": ("Goals",),
    "rlftsim.policies.smart.policy": ("SmartPolicy",),
    "rlftsim.realism": ("RealismResult",),
    "rlftsim.rewards": ("leave_one_out", "masked_mean", "register_reward"),
    "rlftsim.rollout.baselines": ("ConstantVelocity",),
    "rlftsim.rollout.policy": ("Policy", "Sampling"),
    "rlftsim.rollout.types": ("Rollouts",),
    "rlftsim.scenario.dataset": ("write_dataset",),
    "rlftsim.scenario.types": ("Scenario",),
    "rlftsim.studio.notebook": ("open_studio",),
    "rlftsim.training.config": ("FinetuneConfig",),
    "rlftsim.verbs.check_policy": ("check_policy",),
    "rlftsim.verbs.check_reward": ("check_reward",),
    "rlftsim.verbs.compare": ("compare",),
    "rlftsim.verbs.evaluate": ("evaluate",),
    "rlftsim.verbs.finetune": ("finetune",),
    "rlftsim.verbs.inputs": ("load_dataset", "load_policy"),
    "rlftsim.verbs.pretrain": ("pretrain",),
    "rlftsim.verbs.recipe": ("recipe",),
    "rlftsim.verbs.report": ("report",),
    "rlftsim.verbs.score": ("score",),
    "rlftsim.verbs.simulate": ("simulate",),
    "rlftsim.viewer.notebook": ("film", "show"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_MODULE_OF)
_SYNONYMS = {
    **dict.fromkeys(("load_model", "from_pretrained"), "load_policy"),
    **dict.fromkeys(("load_data", "load_scenarios"), "load_dataset"),
    **dict.fromkeys(("rollout", "sample"), "simulate"),
    **{name: f"rlftsim.envs.{name}" for name in ("EgoEnv", "EgoVectorEnv", "EnvConfig", "parallel_env")},
    **dict.fromkeys(("make", "make_vec"), 'gymnasium.make("rlftsim.envs:rlftsim/Ego-v0", ...)'),
    **dict.fromkeys(("train", "fit"), "pretrain or finetune"),
}
"""Names that people type first -> those of the same meaning."""


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        import difflib  # seldom needed

        from rlftsim.verbs.commands import COMMANDS

        near = _SYNONYMS.get(name) or next(iter(difflib.get_close_matches(name, __all__, n=1, cutoff=0.8)), None)
        hint = f": did you mean {near}?" if near else ": it is a command, rlftsim " + name if name in COMMANDS else ""
        raise AttributeError(f"module 'rlftsim' has no attribute {name!r}{hint}")
    value = getattr(importlib.import_module(_MODULE_OF[name]), name)
    if "IPython" in sys.modules:  # a notebook plays scenarios and rollouts that end a cell
        importlib.import_module("rlftsim.viewer.notebook")
    globals()[name] = value  # from now on found without this function
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
