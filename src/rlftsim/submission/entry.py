"""Description of an entry: account, method and authors from a TOML file, the message that each shard repeats, and the
challenge's rule about closed loop: the statement of an entry, and a check of the policy.
"""

import re
from dataclasses import MISSING, dataclass, fields
from os import PathLike
from typing import Any

import torch
from torch import Tensor, nn

from rlftsim.errors import ConfigError, in_short
from rlftsim.evaluation.submission_pb2 import SimAgentsChallengeSubmission
from rlftsim.jobs.documents import read_toml
from rlftsim.realism import SIM_AGENTS, Challenge
from rlftsim.rollout.check import POSE_TOLERANCE_M
from rlftsim.rollout.edge_scenes import without_future
from rlftsim.rollout.noise import draw_noise
from rlftsim.rollout.policy import Policy, Sampling, get_device
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import FUTURE_STEPS, STEP_S, Scenario
from rlftsim.submission.messages import as_text

MAX_METHOD_LENGTH = 40
MAX_STEPS_PER_DECISION = 10
"""Inference may be called as rarely as once a second, with interpolation to 10 Hz."""
PARAMETERS = re.compile(r"\d+[KMBT]?")
REQUIRED_FIELDS = (
    "submission_type", "account_name", "unique_method_name", "uses_lidar_data", "uses_camera_data",
    "uses_public_model_pretraining", "num_model_parameters", "acknowledge_complies_with_closed_loop_requirement",
)  # fmt: skip
_LISTS, _SWITCHES = ("authors", "public_models"), ("uses_lidar", "uses_camera", "uses_public_models")
_EMAIL = re.compile(r"[^@\s]+@[^@\s.]+(\.[^@\s.]+)+")
_PLACEHOLDERS = ("test", "todo", "none", "method", "example", "your name", "your affiliation")
_PLACEHOLDER_MARKS = ("your_account", "your.account", "@test.", "@example.")
_BRACKETED = re.compile(r"<[^<>]*>")
"""A text to be replaced, such as <your name>."""


@dataclass(frozen=True)
class Entry:
    """Account, method and authors, as in `submission.toml`.

    All texts are required, because the server has refused empty texts.
    """

    account: str
    """E-mail address of the account that uploads."""
    method: str
    """Name on the leaderboard, at most 40 characters; only the latest result of an account's method is shown."""
    authors: tuple[str, ...]
    affiliation: str
    description: str
    link: str
    uses_lidar: bool = False
    uses_camera: bool = False
    uses_public_models: bool = False
    public_models: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("account", "method", "affiliation", "description", "link"):
            value = getattr(self, name)
            if not value.strip() or _is_placeholder(value):
                raise ConfigError(
                    f"{name} = {in_short(value)} is no entry's: write your own, the server refuses such texts."
                )
        if not self.authors or any(_is_placeholder(author) for author in self.authors):
            raise ConfigError(f"authors = {list(self.authors)} are no entry's: name at least one author.")
        if not (_EMAIL.fullmatch(self.account) and self.account.isascii()):
            raise ConfigError(f"account = {self.account!r} is no e-mail address: give the one you registered with.")
        if len(self.method) > MAX_METHOD_LENGTH or not (self.method.isascii() and self.method.isprintable()):
            raise ConfigError(
                f"method = {self.method!r} must be 1 to {MAX_METHOD_LENGTH} printable ASCII characters, "
                f"it has {len(self.method)}."
            )
        if self.uses_public_models != bool(self.public_models):
            raise ConfigError(
                f"uses_public_models is {str(self.uses_public_models).lower()} and public_models names "
                f"{len(self.public_models)}: name the models, or neither."
            )


def read_entry(path: str | PathLike[str], *, account: str | None = None, method: str | None = None) -> Entry:
    """The entry that a TOML file describes.

    Args:
        path: TOML file with the fields of `Entry`.
        account: E-mail address in place of the file's; None = the file's.
        method: Name on the leaderboard in place of the file's; None = the file's.

    Raises:
        ConfigError: A file that is missing, or unknown, missing or placeholder values; the message names the file.
    """
    way_out = "write one as docs/submission.md shows"
    values = read_toml(path, way_out, error=ConfigError, missing=f"{path}: no such file: {way_out}.")
    values |= {name: value for name, value in (("account", account), ("method", method)) if value is not None}
    names = {field.name for field in fields(Entry)}
    missing = [f.name for f in fields(Entry) if f.name not in values and f.default is MISSING]
    surplus = sorted(values.keys() - names)
    if missing or surplus:
        problem = f"{', '.join(missing)} missing" if missing else f"{', '.join(surplus)} unknown"
        raise ConfigError(f"{path}: {problem}; known are {', '.join(sorted(names))}.")
    try:
        return Entry(**{name: _validate_value(name, value) for name, value in values.items()})
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def count_parameters(policy: object) -> str:
    """Number of a policy's weights in the notation of the challenge's form: 7 123 456 is "7M", 512 000 is "512K"."""
    count = sum(weight.numel() for weight in policy.parameters()) if isinstance(policy, nn.Module) else 0
    for factor, suffix in ((10**12, "T"), (10**9, "B"), (10**6, "M"), (10**3, "K")):
        if count >= factor:
            return f"{round(count / factor)}{suffix}"
    return str(count)


def describe_entry(entry: Entry, num_parameters: str) -> bytes:
    """Serialized fields of `SimAgentsChallengeSubmission` other than the rollouts.

    The closed-loop flag is set: `submission.build` demands the declaration first.

    Args:
        entry: Account, method and authors that the shards repeat.
        num_parameters: Number of weights in the form's notation, from `count_parameters`.
    """
    message = SimAgentsChallengeSubmission(
        submission_type=SimAgentsChallengeSubmission.SIM_AGENTS_SUBMISSION,
        account_name=entry.account,
        unique_method_name=entry.method,
        authors=entry.authors,
        affiliation=entry.affiliation,
        description=entry.description,
        method_link=entry.link,
        uses_lidar_data=entry.uses_lidar,
        uses_camera_data=entry.uses_camera,
        uses_public_model_pretraining=entry.uses_public_models,
        num_model_parameters=num_parameters,
        public_model_names=entry.public_models,
        acknowledge_complies_with_closed_loop_requirement=True,
    )
    return message.SerializeToString(deterministic=True)


def find_problems(message: SimAgentsChallengeSubmission) -> list[str]:
    """Required fields that a shard lacks, or has with values that the server refuses."""
    problems = [f"{name} is missing" for name in REQUIRED_FIELDS if not message.HasField(name)]
    if message.HasField("submission_type") and message.submission_type != message.SIM_AGENTS_SUBMISSION:
        problems.append("submission_type is not SIM_AGENTS_SUBMISSION")
    if message.HasField("num_model_parameters") and not PARAMETERS.fullmatch(as_text(message.num_model_parameters)):
        problems.append(
            f'num_model_parameters is "{message.num_model_parameters}", not a whole number and K, M, B or T'
        )
    closed_loop = "acknowledge_complies_with_closed_loop_requirement"
    if message.HasField(closed_loop) and not getattr(message, closed_loop):
        problems.append(f"{closed_loop} is false")
    if message.HasField("account_name") and not _EMAIL.fullmatch(as_text(message.account_name)):
        problems.append("account_name is no e-mail address")
    return problems


def _validate_value(name: str, value: Any) -> Any:
    """A value of the file in the type of the field of `Entry`."""
    if name in _LISTS:
        if not isinstance(value, list) or not all(isinstance(text, str) and text.strip() for text in value):
            raise ConfigError(f"{name} must be a list of texts, got {in_short(value)}.")
        return tuple(value)
    value_type, words = (bool, "true or false") if name in _SWITCHES else (str, "text in quotes")
    if not isinstance(value, value_type):
        raise ConfigError(f"{name} must be {words}, got {in_short(value)}.")
    return value


def _is_placeholder(text: str) -> bool:
    lower = text.strip().lower()
    has_mark = _BRACKETED.search(lower) is not None or any(mark in lower for mark in _PLACEHOLDER_MARKS)
    return has_mark or lower in _PLACEHOLDERS


def statement(policy: Policy, sampling: Sampling, challenge: Challenge = SIM_AGENTS) -> str:
    """Statement that an entry makes with the closed-loop flag, as far as this code can vouch for the policy.

    Args:
        policy: Policy whose rollouts are submitted; gives the seconds between decisions.
        sampling: Temperature and truncation of the submitted rollouts, quoted in the statement.
        challenge: Challenge of the entry.
    """
    knowledge = "it sees the log up to the current step only: no future, no goals;"
    if challenge.makes_scenes:
        knowledge = """agents but the ego begin at states drawn from the lanes, by number and type alone: of the log it
  sees the map, the lights up to the current step and the ego's past, and nothing of the others;"""
    stride = policy.steps_per_decision
    sampling = getattr(policy, "sampling", Sampling()).narrow(sampling)
    limit = "" if sampling.top_k is None else f", top {sampling.top_k}"
    return f"""The challenge takes outputs of "individual next-state prediction inference calls", each conditioned on
the preceding states, made at least once a second. The ego's next state must be independent of the others'
given the past. How these rollouts are made:
* the policy decides every {stride * STEP_S:g} s, {FUTURE_STEPS // stride} times in 8 s, from the states so far;
* every agent's decision is drawn independently given the common past (temperature {sampling.temperature:g}{limit});
* {knowledge}
* nothing drawn at the start of a rollout is shared by the ego and other agents;
* every rollout that is drawn is submitted: none is selected, repaired or drawn again by its outcome.
The code makes sure of the first and the last three points. That the policy itself draws agents independently is
for you to know."""


def check_closed_loop(policy: Policy, scenario: Scenario) -> None:
    """Check that a policy can make the statement.

    Args:
        policy: Policy whose rollouts will be submitted.
        scenario: Any scenario, to try the policy on.

    Raises:
        ConfigError: A policy that decides less than once a second, reads the logged future, or couples the draws of
            ego and other agents at the start of a rollout.
    """
    stride = policy.steps_per_decision
    if stride > MAX_STEPS_PER_DECISION:
        raise ConfigError(
            f"the policy decides every {stride * STEP_S:g} s: the challenge wants an inference call at least once "
            "a second."
        )
    if scenario.has_future:  # in a test split there is none that could be read
        informed, blind = (
            simulate(policy, collate([variant]).to(get_device(policy)), num_rollouts=1, seed=0).position
            for variant in (scenario, without_future(scenario))
        )
        if not torch.allclose(informed, blind, rtol=0.0, atol=POSE_TOLERANCE_M):
            raise ConfigError(
                "the policy's rollouts change where the logged future is taken away: the challenge wants each state "
                "to follow from the states before it. Let `encode` read no step behind the current one."
            )
    if not policy.initial_noise_size:
        return
    batch = collate([scenario]).to(get_device(policy))
    noise = draw_noise(batch, range(1), seed=0, purpose="begin", per_agent=policy.initial_noise_size)
    is_ego = torch.from_numpy(scenario.simulated_indices == scenario.ego_index).to(batch.device)  # [A]
    with torch.no_grad():
        context = policy.encode(batch)
        draws, ego_draws = (
            policy.begin(context, 1, None, agent_noise).draws
            for agent_noise in (noise, torch.where(is_ego[:, None], 1 - noise, noise))
        )
    if draws is not None and not _is_ego_alone(draws, ego_draws, is_ego):
        raise ConfigError(
            "the policy draws something at the start of a rollout that the ego shares with other agents: the challenge "
            "wants the ego to be independent of them, because a planner will take its place."
        )


def _is_ego_alone(draws: Tensor, ego_draws: Tensor, is_ego: Tensor) -> bool:
    """True if draws have an agent axis along which only the ego's differ."""
    has_agents = draws.dim() >= 3 and draws.shape[2] == len(is_ego)
    return has_agents and bool((draws[:, :, ~is_ego] == ego_draws[:, :, ~is_ego]).all())
