"""Made-up evaluations of policies, and a recipe so small that a whole experiment takes seconds."""

import pyarrow as pa

from rlftsim.evaluation.results import SCHEMA, SCORE_COLUMNS, EvaluateConfig, Evaluation, Provenance
from rlftsim.experiments.tables import Row
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.recipes.smart import SmartRecipe
from rlftsim.tokens.clustering import TokensConfig
from rlftsim.training.config import CatkConfig, DeviceConfig, FinetuneConfig, PretrainConfig

CPU = DeviceConfig(accelerator="cpu", threads=1)
TINY = SmartRecipe(
    tokens=TokensConfig(num_tokens=48, num_map_prototypes=16),
    model=SmartConfig(
        dim=16, num_heads=2, head_dim=8, num_map_layers=1, num_decoder_layers=1, num_frequencies=4, history_tokens=3,
        max_map_neighbors=4, max_agent_map_neighbors=6, max_agent_neighbors=6, dropout=0.0, history_drop=0.0,
    ),
    pretrain=PretrainConfig(epochs=1.0, batch_size=2, learning_rate=1e-3, label_smoothing=0.0, device=CPU),
    finetune=FinetuneConfig(epochs=0.5, batch_size=1, num_rollouts=2, learning_rate=1e-3, warmup_updates=1, device=CPU),
    catk=CatkConfig(device=CPU),
)  # fmt: skip
"""Two updates of fine-tuning on four scenarios."""


def evaluation(name, meta_metric, ids=None, columns=None, clusters=None, **config):
    """Scores of a policy: the meta-metric as given, other columns too, everything else 0.5."""
    ids = ids or [f"s{k}" for k in range(len(meta_metric))]
    given = {"meta_metric": meta_metric, **(columns or {}), "cluster": clusters or [""] * len(meta_metric)}
    others = {"num_agents": 3, "num_evaluated": 2, **dict.fromkeys(SCORE_COLUMNS, 0.5)}
    rows = [{"scenario_id": i, **others, **dict(zip(given, v))} for i, v in zip(ids, zip(*given.values()))]
    provenance = Provenance(EvaluateConfig(**config), "Policy", "f" * 32, "/data", "a" * 64)
    return Evaluation(name, provenance, pa.Table.from_pylist(rows, schema=SCHEMA))


def row(name, *meta_metrics, **columns):
    """A row of an experiment: the meta-metric of every scenario for each seed."""
    return Row(name, tuple(evaluation(name, values, columns=columns) for values in meta_metrics))
