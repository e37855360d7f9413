"""Rewards as text: "mloo", "mloo + 0.1*rloo", "0.5*(mloo + rloo)", "collision_offroad_ade(ade_weight=0.2)".

The reward of an update is a weighted sum of registered rewards, credited to agents.

A name may stand for a sum: "gcft" is "0.9*mloo + 0.1*goal(kind='soft', partial=False)", and settings are stored so.

By rollout, every decision of a rollout earns the rollout's reward R, the estimator of RLFTSim's proposition 1. By
agent, a decision of agent a earns

    W[a] = own[a] + credit_mixing * (R - own[a]),        sum_a own[a] = R,

the agent's share own[a] in full, and the shares of the other agents times `credit_mixing` in [0, 1]. An agent that is
not evaluated has no share and earns credit_mixing * R. credit_mixing = 1 is credit by rollout.

Where each share depends on the decisions of a single agent, the estimate is unbiased for any `credit_mixing`, and a
smaller `credit_mixing` means a smaller variance: the other agents' chance no longer adds to an agent's reward. Where
agents act on each other, that influence is weighted by `credit_mixing`. A reward without a split over agents is
credited to all in full. In a sum of rewards W is the weighted sum of the terms' W.
"""

import ast
import inspect
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.errors import ConfigError, in_short
from rlftsim.realism import AgentScores, RealismResult
from rlftsim.rewards.base import Reward, Sum, agent_rewards_by_name, reward_by_name, sum_by_name, validate_reward
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch

Option = float | int | bool | str


@dataclass(frozen=True)
class Term:
    """A registered reward with weight and options, defaults filled in."""

    weight: float
    name: str
    options: tuple[tuple[str, Option], ...] = ()

    def __str__(self) -> str:
        options = ", ".join(f"{name}={value!r}" for name, value in self.options)
        return f"{self.name}({options})" if options else self.name


def parse_reward(text: str) -> tuple[Term, ...]:
    """The terms of a sum of rewards.

    Raises:
        ConfigError: Not a sum of rewards; a reward that is not registered, cannot be called or comes twice; an option
            that the reward lacks; all weights 0.
    """
    # Read as a Python expression, of which only sums, factors, names and options are understood; nothing is evaluated.
    try:
        terms = tuple(_parse_terms(ast.parse(text.strip(), mode="eval").body, 1.0))
    except ConfigError:
        raise
    except (SyntaxError, ValueError):
        raise ConfigError(
            f"reward {in_short(text)} cannot be read: write a sum of rewards, such as 'mloo + 0.1*collision_offroad'."
        ) from None
    names = [term.name for term in terms]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(
                f"reward {in_short(text)} has {name} {names.count(name)} times: name it once, with one weight."
            )
    if not any(term.weight for term in terms):
        raise ConfigError(f"reward {in_short(text)} is always 0: give one of its terms a weight.")
    return terms


def write_reward(terms: tuple[Term, ...]) -> str:
    """Terms in the canonical spelling, which `parse_reward` reads."""
    spelled_terms = []
    for term in terms:
        size = abs(term.weight)
        factor = "" if size == 1 else f"{repr(size).removesuffix('.0')}*"
        spelled_terms.append(f"{'-' if term.weight < 0 else '+'} {factor}{term}")
    return " ".join(spelled_terms).removeprefix("+ ")


def _parse_terms(node: ast.expr, factor: float) -> Iterator[Term]:
    """Yield the terms of a summand that is multiplied by a factor. ValueError where the node is no sum of rewards."""
    match node:
        case ast.BinOp(left, ast.Add(), right):
            yield from _parse_terms(left, factor)
            yield from _parse_terms(right, factor)
        case ast.BinOp(left, ast.Sub(), right):
            yield from _parse_terms(left, factor)
            yield from _parse_terms(right, -factor)
        case ast.BinOp(left, ast.Mult(), right):
            # The number may stand on either side.
            number, summand = (right, left) if _is_number(right) else (left, right)
            yield from _parse_terms(summand, factor * _parse_number(number))
        case ast.UnaryOp(ast.USub() | ast.UAdd() as sign, operand):
            yield from _parse_terms(operand, -factor if isinstance(sign, ast.USub) else factor)
        case ast.Name(name):
            yield from _parse_name(name, factor, {})
        case ast.Call(ast.Name(name), [], keywords):
            options = {keyword.arg: ast.literal_eval(keyword.value) for keyword in keywords if keyword.arg}
            if len(options) < len(keywords):
                raise ValueError(node)  # an option twice, or **options
            yield from _parse_name(name, factor, options)
        case _:
            raise ValueError(node)


def _parse_name(name: str, factor: float, options: dict[str, Option]) -> Iterator[Term]:
    """Yield the term of a reward, or the terms of a sum that has a name."""
    named_sum = sum_by_name(name)
    if named_sum is None:
        yield Term(factor, name, _fill_options(name, validate_reward(name), options))
    else:
        text = named_sum(**dict(_fill_options(name, named_sum, options)))
        yield from _parse_terms(ast.parse(text, mode="eval").body, factor)


def _is_number(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) or (isinstance(node, ast.UnaryOp) and _is_number(node.operand))


def _parse_number(node: ast.expr) -> float:
    value = ast.literal_eval(node)
    if type(value) not in (int, float) or not math.isfinite(value):
        raise ValueError(value)
    return float(value)


def _fill_options(name: str, reward: Reward | Sum, options: dict[str, Option]) -> tuple[tuple[str, Option], ...]:
    """All options of a reward; options that are not written have the defaults."""
    # Keyword-only parameters are options; the positional ones are what every reward is called with.
    parameters = inspect.signature(reward).parameters.values()
    defaults = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
    values = {**defaults, **options}
    for option, value in values.items():
        if option not in defaults:
            hint = f"known are {', '.join(defaults)}" if defaults else "it has none"
            raise ConfigError(f"reward {name} has no option {option!r}: {hint}.")
        option_type = type(defaults[option])
        if option_type is float and type(value) is int:
            value = values[option] = float(value)
        # By type and not isinstance: True is an int, and no one means it as a number.
        if type(value) is not option_type:
            raise ConfigError(f"reward {name}({option}=...): expected {option_type.__name__}, got {in_short(value)}.")
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"reward {name}({option}=...): expected a finite number, got {in_short(value)}.")
    return tuple(values.items())


@dataclass(frozen=True, eq=False)
class Rewards:
    """Rewards of the rollouts of a batch. A scenario in which a term is not finite earns 0 from the term."""

    terms: tuple[Term, ...]
    by_term: Float[Tensor, "K B N"]
    """Before the weights."""
    is_missing: Bool[Tensor, "K B"]
    """True where a term is not finite in a scenario."""
    total: Float[Tensor, "B N"]
    """Weighted sum of the terms."""
    by_agent: Float[Tensor, "B N A"]
    """Reward of each agent's decisions: `total` for all agents, or W."""


def compute_rewards(
    terms: tuple[Term, ...],
    realism: RealismResult,
    rollouts: Rollouts,
    batch: ScenarioBatch,
    agents: AgentScores | None = None,
    credit_mixing: float = 1.0,
) -> Rewards:
    """Rewards of rollouts with computed scores.

    Args:
        terms: Terms of the sum, from `parse_reward`.
        realism: Scores of the same rollouts, a row per scenario.
        rollouts: N rollouts of each scenario, in the frame of the batch.
        batch: Scenarios that were simulated, in the order of the rollouts.
        agents: Scores of the same rollouts split over agents; None = credit by rollout.
        credit_mixing: Weight in [0, 1] of the other agents' shares; 1 = credit by rollout.

    Raises:
        ConfigError: A reward or a split gives no tensor, or a tensor of the wrong shape.
    """
    by_term, missing_masks, by_agent = [], [], torch.zeros_like(rollouts.heading[..., 0])  # [B, N, A]
    for term in terms:
        reward, is_missing = _call(reward_by_name(term.name), term, realism, rollouts, batch, shape=by_agent.shape[:2])
        credit = reward[..., None]  # [B, N, 1]: for all agents alike
        split = agent_rewards_by_name(term.name)
        # Without a split W is R for all agents, whatever the mixing.
        if agents is not None and split is not None:
            share, is_split_missing = _call(split, term, agents, rollouts, batch, shape=by_agent.shape)
            is_missing = is_missing | is_split_missing
            credit = share + credit_mixing * (credit - share)
        # a term that is missing in a scenario, for itself or in its split, says nothing there
        by_term.append(reward.masked_fill(is_missing[:, None], 0.0))
        missing_masks.append(is_missing)
        by_agent = by_agent + term.weight * credit.masked_fill(is_missing[:, None, None], 0.0)
    rewards = torch.stack(by_term)  # [terms, B, N]
    weights = torch.tensor([term.weight for term in terms], device=rewards.device)
    return Rewards(terms, rewards, torch.stack(missing_masks), (weights[:, None, None] * rewards).sum(0), by_agent)


def _call(
    function: Callable[..., object], term: Term, *arguments: object, shape: torch.Size
) -> tuple[Tensor, Bool[Tensor, "B"]]:
    """Values of a reward or of a split, 0 in scenarios where a value is not finite, and True for those scenarios."""
    # Arguments by position: a reward of another package may name them as it likes.
    values = function(*arguments, **dict(term.options))
    if not isinstance(values, Tensor) or values.shape != shape:
        result = f"shape {list(values.shape)}" if isinstance(values, Tensor) else f"a {type(values).__name__}"
        raise ConfigError(
            f"reward {term}: {getattr(function, '__name__', function)} gives {result}, expected {list(shape)}: a "
            "tensor with one number per rollout [B, N], a split one per agent, too [B, N, A]."
        )
    values = values.float()
    # A whole scenario at once: a leave-one-out reward of which one number is missing has no baseline.
    is_missing = ~values.isfinite().flatten(1).all(1)
    return values.masked_fill(is_missing.view(-1, *[1] * (values.dim() - 1)), 0.0), is_missing
