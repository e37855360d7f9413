"""Scores in memory, without files: `rs.score`."""

from rlftsim.errors import ConfigError
from rlftsim.evaluation.rollout_checks import warn_of_doubts
from rlftsim.realism import RealismResult, metric_by_name, score, score_batch
from rlftsim.realism.agents import check_closed
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch, collate


def score_in_memory(batch: ScenarioBatch, rollouts: Rollouts, metric: str, *, is_single: bool) -> RealismResult:
    """Scores of rollouts, with a warning for each doubt.

    Args:
        batch: Scenarios with logged futures, in any frame.
        rollouts: Rollouts of all scenarios of the batch, in the same order.
        metric: Year of the meta-metric.
        is_single: True leaves out the leading axis of B scenarios, for a batch of a single scenario.

    Raises:
        ConfigError: Rollouts of other scenarios, or no such metric.
        DataError: A pose that is not finite, or a scenario that cannot be scored.
    """
    check_closed(rollouts.valid)  # before agents are compared: those that enter are in no log
    batch = _match_batch(batch, rollouts)
    # in the world frame and without padding
    states, config = states_of_rollouts(batch, rollouts), metric_by_name(metric)
    for scenario, simulated in zip(batch.scenarios, states):
        simulated.check_finite(scenario.scenario_id)
    scored = score(batch.scenarios[0], states[0], config) if is_single else score_batch(batch.scenarios, states, config)
    for scenario, simulated in zip(batch.scenarios, states):
        warn_of_doubts(scenario, simulated)
    return scored


def _match_batch(batch: ScenarioBatch, rollouts: Rollouts) -> ScenarioBatch:
    """The scenarios that rollouts are of, in the frame of the rollouts.

    Raises:
        ConfigError: Rollouts of other scenarios: by the ids of scenarios and agents where the rollouts have ids, else
            by numbers.
    """
    about = rollouts.provenance
    if about is not None:
        ids = tuple(scenario.scenario_id for scenario in batch.scenarios)
        if about.scenario_ids != ids:
            simulated = ", ".join(about.scenario_ids[:3])
            raise ConfigError(
                f"rollouts of {simulated} do not belong to {', '.join(ids[:3])}: hand over the same scenarios."
            )
        for row, scenario in enumerate(batch.scenarios):
            about.check_same_agents(row, scenario)
        if batch.frame != about.frame:
            batch = collate(batch.scenarios, frame=about.frame).to(batch.device)
    num_scenarios, _, num_agents = rollouts.position.shape[:3]
    if num_scenarios != batch.num_scenarios or num_agents < batch.agent_mask.shape[1]:
        raise ConfigError(
            f"rollouts of {num_scenarios} scenarios with up to {num_agents} agents do not belong to "
            f"{batch.num_scenarios} with up to {batch.agent_mask.shape[1]}: hand over the same scenarios."
        )
    return batch
