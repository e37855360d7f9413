"""SMART as a policy: a token of half a second for every agent, sixteen times."""

import copy
import json
import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int64
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.files import save_tensors, write_text
from rlftsim.geometry import box_corners, pose_of_corners, rotate, wrap_angle
from rlftsim.goals.types import Goals
from rlftsim.policies.layers import normalize
from rlftsim.policies.smart.config import GoalSight, SmartConfig
from rlftsim.policies.smart.distribution import TokenDistribution
from rlftsim.policies.smart.goal_sight import NUM_DECISIONS, GoalState, SeenGoals, see_goals
from rlftsim.policies.smart.heads import NEVER, ClassHeads
from rlftsim.policies.smart.neighbors import Poses
from rlftsim.policies.smart.network import Past, Scene, SmartNetwork, TokenSteps, nowhere_unless
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.tokens import public_order
from rlftsim.tokens.agent_tokens import HISTORY_TOKENS, AgentTokens, class_boxes, nearest_tokens, tokenize_agents
from rlftsim.tokens.map_tokens import tokenize_map
from rlftsim.tokens.vocabulary import STEPS_PER_TOKEN, Vocabulary, class_of_type

FORMAT = "rlftsim-smart-1"


@dataclass(frozen=True, eq=False)
class SmartContext:
    """What does not depend on what agents will do, once per scenario."""

    scene: Scene
    past: Past
    """Of the two history tokens, with a single rollout."""
    now: TokenSteps
    """The last of them, at the current step: agents that are asked something look at it anew."""
    features: Float[Tensor, "B A D"]
    """Decoder features at the current step of agents that are asked nothing; zeros for padding."""
    position: Float[Tensor, "B A 2"]
    """Where the history tokens led."""
    heading: Float[Tensor, "B A"]
    object_type: Int64[Tensor, "B A"]
    agent_mask: Bool[Tensor, "B A"]


@dataclass(eq=False)
class Sight:
    """What the network made of a state, once somebody asked. It follows from the state: a memo, no part of its value."""

    features: Float[Tensor, "B N A D"] | None = None
    """Decoder features at the state's last step."""
    past: Past | None = None
    """The past that includes the state's last step."""


@dataclass(frozen=True, eq=False)
class SmartState:
    """Simulations under way. Steps that the network has not seen yet wait in `pending`; looking at them happens at most once."""

    position: Float[Tensor, "B N A 2"]
    heading: Float[Tensor, "B N A"]
    past: Past
    pending: TokenSteps | None
    poses: Float[Tensor, "B N A 5 3"] | None = None
    draws: Tensor | None = None
    goals: SeenGoals | None = None
    """None = nobody is asked anything, or the model does not see goals."""
    num_decisions: int = 0
    """Taken so far."""
    sight: Sight = field(default_factory=Sight)


@dataclass(frozen=True, eq=False)
class TeacherForced:
    """Predictions along recorded tracks and what they should have said."""

    logits: Float[Tensor, "R V"]
    target: Int64[Tensor, "R"]
    """Token that came next."""
    target_mask: Bool[Tensor, "R"]
    """True = the next state was recorded and the agent is trained on."""
    class_id: Int64[Tensor, "R"]
    """Whose tokens they are."""


class SmartPolicy(nn.Module):
    """Next-token traffic model: its weights, its vocabulary and nothing else.

    The vocabulary is a value, not a weight: it is saved beside the weights and never trained.
    """

    steps_per_decision = STEPS_PER_TOKEN
    noise_size = 1
    initial_noise_size = 0

    def __init__(self, config: SmartConfig, vocabulary: Vocabulary):
        super().__init__()
        self.config = config
        self.vocabulary = vocabulary
        class_sizes = tuple(vocabulary.token_mask.sum(1).tolist()) if config.head_per_class else ()
        self.network = SmartNetwork(config, vocabulary.num_tokens, class_sizes)

    def _apply(self, fn, recurse: bool = True):
        """Moves to a device take the vocabulary along."""
        super()._apply(fn, recurse)
        self.vocabulary = self.vocabulary.to(next(self.parameters()).device)
        return self

    # ---- the policy interface -------------------------------------------------------------------------------------

    def encode(self, scenarios: ScenarioBatch) -> SmartContext:
        """Map features, history tokens and what the decoder made of them."""
        tokens = self._tokenize(scenarios)
        scene = self._scene(scenarios)
        history = self._recorded_steps(tokens, slice(0, HISTORY_TOKENS))
        rows, past = self.network.decoder(scene, history, None)
        features = _place(rows, history.valid)[:, 0, :, -1]
        return SmartContext(
            scene=scene,
            past=past,
            now=self._recorded_steps(tokens, slice(HISTORY_TOKENS - 1, HISTORY_TOKENS)),
            features=features,
            position=tokens.position[:, :, HISTORY_TOKENS - 1],
            heading=tokens.heading[:, :, HISTORY_TOKENS - 1],
            object_type=scenarios.object_type,
            agent_mask=scenarios.agent_mask,
        )

    def begin(self, context: SmartContext, num_rollouts: int, goals: Goals | None, noise: Tensor) -> SmartState:
        """The current step, N times, without copies of the history. Where somebody has a goal, it has not been looked at yet."""

        def repeated(v: Tensor) -> Tensor:
            return v[:, None].expand(-1, num_rollouts, *v.shape[1:])

        position, heading = repeated(context.position), repeated(context.heading)
        if goals is None or not self.sees_goals or not goals.any:
            return SmartState(position, heading, context.past.repeat(num_rollouts), pending=None)
        scene = context.scene
        return SmartState(
            position,
            heading,
            context.past.without_last_step().repeat(num_rollouts),
            pending=context.now.repeat(num_rollouts),
            goals=see_goals(goals, nowhere_unless(scene.map_mask, scene.map_position)),
        )

    def decide(self, context: SmartContext, state: SmartState) -> TokenDistribution:
        """The next token of every agent."""
        mask = context.agent_mask[:, None].expand(state.heading.shape)
        said = self._distribution(context, self._look(context, state)[mask], mask)
        num_left = torch.full_like(state.heading, NUM_DECISIONS - state.num_decisions, dtype=torch.int64)
        return self._aimed(said, context, state.goals, Poses(state.position, state.heading), num_left)

    def advance(
        self,
        context: SmartContext,
        state: SmartState,
        decision: Int64[Tensor, "B N A"],
        forced: AgentStates | None = None,
    ) -> SmartState:
        """Place the chosen token's five poses at the current state."""
        poses = self._unroll(context, state, decision)
        if forced is not None:
            imposed = forced.valid.all(-1)
            held = torch.cat([forced.position, forced.heading[..., None]], -1)
            poses = torch.where(imposed[..., None, None], held, poses)
            decision = self._rename(context, state, decision, poses[..., -1, :], imposed)
        position, heading = poses[..., -1, :2], poses[..., -1, 2]
        block = TokenSteps(
            position=position[..., None, :],
            heading=heading[..., None],
            motion=(position - state.position)[..., None, :],
            token_id=decision[..., None],
            valid=context.agent_mask[:, None, :, None].expand(*heading.shape, 1),
        )
        if state.sight.past is not None:
            past, pending = state.sight.past, block
        else:
            past, pending = state.past, block if state.pending is None else state.pending.then(block)
        num_decisions = state.num_decisions + 1
        return SmartState(position, heading, past, pending, poses, goals=state.goals, num_decisions=num_decisions)

    def score(self, context: SmartContext, rollouts: Rollouts) -> TokenDistribution:
        """Replay the decisions without the network, then look at all steps at once."""
        no_noise = rollouts.log_prob[..., :0]
        state = self.begin(context, rollouts.num_rollouts, rollouts.goals, no_noise)
        num_decisions = rollouts.decision.shape[3]
        for index in range(num_decisions - 1):
            start = index * STEPS_PER_TOKEN
            forced = rollouts.forced and rollouts.forced.steps(start, start + STEPS_PER_TOKEN)
            state = self.advance(context, state, rollouts.decision[..., index], forced)
        parts = []
        if state.goals is None:  # the current step has been looked at
            parts.append(context.features[:, None, :, None].expand(*state.heading.shape, 1, -1))
        if state.pending is not None:
            rows, _ = self.network.decoder(context.scene, state.pending, state.past, goals=state.goals)
            parts.append(_place(rows, state.pending.valid))
        features = torch.cat(parts, 3)
        mask = context.agent_mask[:, None, :, None].expand(rollouts.decision.shape)
        said = self._distribution(context, features[mask], mask)
        if state.goals is None or state.pending is None:
            return said
        num_left = NUM_DECISIONS - torch.arange(num_decisions, device=mask.device)
        poses = Poses(state.pending.position, state.pending.heading)
        return self._aimed(said, context, state.goals, poses, num_left.expand(mask.shape))

    # ---- pre-training ---------------------------------------------------------------------------------------------

    def teacher_forced(self, scenarios: ScenarioBatch, trained: Bool[Tensor, "B A"]) -> TeacherForced:
        """Predict every next token along the recorded tracks.

        Args:
            scenarios: with their future.
            trained: True = the agent's predictions count; the others are context.
        """
        tokens = self._tokenize(scenarios)
        steps = self._recorded_steps(tokens, slice(0, -1))
        hidden = None
        if self.training and self.config.history_drop:
            hidden = torch.rand(steps.valid.shape, device=steps.valid.device) < self.config.history_drop
        rows, _ = self.network.decoder(self._scene(scenarios), steps, None, hidden)
        decides = steps.valid.clone()
        decides[..., : HISTORY_TOKENS - 1] = False
        counts = (tokens.valid[..., 1:] & trained[..., None])[:, None][decides]
        logits = self._logits(rows[decides[steps.valid]], scenarios.object_type, decides)
        class_id = class_of_type(scenarios.object_type)[:, None, :, None].expand(decides.shape)[decides]
        return TeacherForced(logits, tokens.next_token_id[:, None, :, :-1][decides], counts, class_id)

    def fine_tuned_parts(self) -> tuple[nn.Module, ...]:
        """What closed-loop fine-tuning trains: the decoder's attention and the head, as the public CAT-K code does, and the sight of goals."""
        decoder = self.network.decoder
        return decoder.time_layers, decoder.map_layers, decoder.agent_layers, decoder.head, *self.goal_parts()

    def goal_parts(self) -> tuple[nn.Module, ...]:
        """What sees goals and aims at them; nothing in a model that does not."""
        return self.network.decoder.goal_parts()

    # ---- goals ----------------------------------------------------------------------------------------------------

    @property
    def sees_goals(self) -> bool:
        """Whether goals have an effect."""
        return self.config.goal is not None

    def with_goal_sight(self, goal: GoalSight, *, aim: bool | None = None) -> "SmartPolicy":
        """The same policy with weights to see goals by, which say nothing yet; itself if it sees them so.

        Args:
            goal: how it is to see them.
            aim: weigh tokens by where they lead, too; without it a model is the paper's. None = yes, or as a model does that sees goals.

        Raises:
            ConfigError: it sees them in another way.
        """
        if self.config.goal == goal and aim in (None, self.config.goal_aim):
            return self
        if self.config.goal == goal:
            has = "an aim" if self.config.goal_aim else "no aim"
            raise ConfigError(
                f"this model sees goals and has {has}: for another one start from a model that sees none."
            )
        if self.sees_goals:
            raise ConfigError(
                f"this model sees goals by {self.config.goal}, not by {goal}: start from a model that sees none."
            )
        policy = SmartPolicy(replace(self.config, goal=goal, goal_aim=aim is not False), self.vocabulary).to(
            next(self.parameters()).device
        )
        decoder = policy.network.decoder
        if isinstance(decoder.goal, GoalState):
            decoder.goal.know(self.network.decoder.map_relation)
        new = {k: v for k, v in policy.network.state_dict().items() if k.startswith(("decoder.goal.", "decoder.aim."))}
        load_strictly(policy.network, {**self.network.state_dict(), **new}, source="the model to start from")
        return policy.train(self.training)

    def guided(self, times: float) -> "SmartPolicy":
        """The same policy, its aim counting so many times: above 1 goals are followed more closely than was learned. Itself at 1.

        Raises:
            ConfigError: it has no aim, or `times` is no number of 0 or more.
        """
        if times == 1.0:
            return self
        if not (math.isfinite(times) and times >= 0):
            raise ConfigError(f"goal_guidance is a number of 0 or more, got {times}.")
        if self.network.decoder.aim is None:
            raise ConfigError(f"goal_guidance={times:g} has no effect: this model does not aim at goals, leave it out.")
        policy = copy.deepcopy(self)
        assert policy.network.decoder.aim is not None
        with torch.no_grad():
            policy.network.decoder.aim.weight.mul_(times)
        return policy

    # ---- files ----------------------------------------------------------------------------------------------------

    def save_pretrained(self, folder: Path, *, card: str = "") -> None:
        """Write config.json, model.safetensors, vocabulary.safetensors and README.md (the card) into a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        self.vocabulary.to("cpu").save(folder / "vocabulary.safetensors")
        save_tensors(folder / "model.safetensors", self.network.state_dict())
        write_text(folder / "README.md", card or "A SMART traffic model. Origin unknown.\n")
        write_text(folder / "config.json", json.dumps({"format": FORMAT, **asdict(self.config)}, indent=1) + "\n")

    @classmethod
    def from_pretrained(cls, folder: Path) -> "SmartPolicy":
        """Read what `save_pretrained` wrote.

        Raises:
            CheckpointError: a missing or damaged file, or keys and shapes that do not fit: names them all.
        """
        try:
            values = json.loads((folder / "config.json").read_text())
            if values.pop("format", None) != FORMAT:
                raise CheckpointError(f"{folder}/config.json: not a SMART model of this version.")
            weights = load_file(folder / "model.safetensors")
            policy = cls(SmartConfig(**values), Vocabulary.load(folder / "vocabulary.safetensors"))
        except FileNotFoundError as error:
            raise CheckpointError(
                f"{folder}: not a model folder, {Path(error.filename or 'model.safetensors').name} is missing."
            ) from None
        except (ValueError, TypeError, AttributeError, SafetensorError, OSError) as error:
            raise CheckpointError(f"{folder}: damaged model folder ({error}): write it again.") from None
        load_strictly(policy.network, weights, source=str(folder))
        return policy

    # ---- parts ----------------------------------------------------------------------------------------------------

    def _scene(self, scenarios: ScenarioBatch) -> Scene:
        tokens = tokenize_map(scenarios, self.vocabulary.map_prototypes)
        class_id = class_of_type(scenarios.object_type)
        decoder = self.network.decoder
        return Scene(
            map_position=tokens.position,
            map_heading=tokens.heading,
            map_mask=tokens.token_mask,
            map_features=normalize(self.network.map_encoder(tokens, self.vocabulary.map_prototypes)),
            class_id=class_id,
            agent_features=decoder.embed_agents(class_id, scenarios.size),
            token_features=decoder.embed_tokens(self.vocabulary.end_corners()),
            relations=decoder.relations(),
        )

    def _tokenize(self, scenarios: ScenarioBatch) -> AgentTokens:
        public = self.config.public_code_quirks
        return tokenize_agents(scenarios, self.vocabulary, public_order_of_operations=public)

    def _recorded_steps(self, tokens: AgentTokens, steps: slice) -> TokenSteps:
        """A block of recorded token steps, as a single rollout."""
        position = tokens.position
        before = torch.cat([torch.zeros_like(position[:, :, :1]), position[:, :, :-1]], 2)
        motion = position - before
        if not self.config.public_code_quirks:
            known = torch.cat([torch.zeros_like(tokens.valid[..., :1]), tokens.valid[..., :-1]], -1)
            motion = torch.where(known[..., None], motion, 0.0)
        else:
            motion[:, :, 0] = 0.0
        fields = (position, tokens.heading, motion, tokens.token_id, tokens.valid)
        return TokenSteps(*(v[:, None, :, steps] for v in fields))

    def _look(self, context: SmartContext, state: SmartState) -> Float[Tensor, "B N A D"]:
        """Decoder features at the state's last step."""
        sight = state.sight
        if sight.features is None:
            if state.pending is None:
                sight.features, sight.past = context.features[:, None].expand(*state.heading.shape, -1), state.past
            else:
                rows, sight.past = self.network.decoder(context.scene, state.pending, state.past, goals=state.goals)
                sight.features = _place(rows, state.pending.valid)[..., -1, :]
        return sight.features

    def _distribution(
        self, context: SmartContext, features: Float[Tensor, "R D"], mask: Bool[Tensor, "*batch"]
    ) -> TokenDistribution:
        return TokenDistribution(self._logits(features, context.object_type, mask), mask)

    def _aimed(
        self,
        said: TokenDistribution,
        context: SmartContext,
        goals: SeenGoals | None,
        poses: Poses,
        num_left: Int64[Tensor, "*batch"],
    ) -> TokenDistribution:
        """Tokens weighed by where they lead whoever has a goal; poses and decisions left have the shape of the mask."""
        aim = self.network.decoder.aim
        if goals is None or aim is None:
            return said
        place = said.mask.nonzero(as_tuple=True)
        carriers = goals.goal_mask[place[:3]].nonzero()[:, 0]
        rows = tuple(index[carriers] for index in place)
        here = poses[rows]
        goal = rotate(goals.position[rows[:3]] - here.position, -here.heading)
        class_id = class_of_type(context.object_type)[rows[0], rows[2]]
        weighed = aim(goal, num_left[rows], class_id, self.vocabulary.poses()[:, :, -1, :2])
        weighed = weighed.masked_fill(~self.vocabulary.token_mask[class_id], 0.0)  # these stay impossible
        return TokenDistribution(said.logits.index_add(0, carriers, weighed), said.mask)

    def _logits(
        self, features: Float[Tensor, "R D"], object_type: Int64[Tensor, "B A"], mask: Bool[Tensor, "B N A *L"]
    ) -> Float[Tensor, "R V"]:
        """Logits of the elements of a mask, tokens that a class lacks ruled out."""
        place = mask.nonzero(as_tuple=True)
        class_id = class_of_type(object_type)[place[0], place[2]]
        head = self.network.decoder.head
        logits = head(features, class_id) if isinstance(head, ClassHeads) else head(features).float()
        return logits.masked_fill(~self.vocabulary.token_mask[class_id], NEVER)

    def _unroll(
        self, context: SmartContext, state: SmartState, decision: Int64[Tensor, "B N A"]
    ) -> Float[Tensor, "B N A 5 3"]:
        """The five poses of the chosen tokens, placed at the current state. Padding stands still."""
        class_id = class_of_type(context.object_type)[:, None].expand(decision.shape)
        if self.config.public_code_quirks:
            corners = self.vocabulary.corners[class_id, decision, 1:]
            placed = public_order.place_boxes(corners, state.position, state.heading)
            position, heading = pose_of_corners(placed)
            return torch.cat([position, heading[..., None]], -1)
        local = self.vocabulary.poses()[class_id, decision]  # [B, N, A, 5, 3]
        position = state.position[..., None, :] + rotate(local[..., :2], state.heading[..., None])
        heading = wrap_angle(state.heading[..., None] + local[..., 2])
        return torch.cat([position, heading[..., None]], -1)

    def _rename(
        self,
        context: SmartContext,
        state: SmartState,
        decision: Int64[Tensor, "B N A"],
        end: Float[Tensor, "B N A 3"],
        imposed: Bool[Tensor, "B N A"],
    ) -> Int64[Tensor, "B N A"]:
        """Tokens nearest to what was imposed, so that imposed agents are seen as if they had chosen it."""
        length, width = class_boxes(context.object_type)
        corners = box_corners(end[..., :2], end[..., 2], length[:, None], width[:, None])
        local = rotate(corners - state.position[..., None, :], -state.heading[..., None])
        class_id = class_of_type(context.object_type)[:, None].expand(imposed.shape)
        return torch.where(imposed, nearest_tokens(local, class_id, imposed, self.vocabulary), decision)


def _place(rows: Float[Tensor, "R D"], valid: Bool[Tensor, "*batch"]) -> Float[Tensor, "*batch D"]:
    """Rows at the places of a mask, zeros elsewhere."""
    return rows.new_zeros(*valid.shape, rows.shape[-1]).masked_scatter(valid[..., None], rows)


def load_strictly(module: nn.Module, weights: dict[str, Tensor], *, source: str) -> None:
    """Load weights; refuse, with the whole list, missing or unknown keys and wrong shapes.

    Raises:
        CheckpointError: anything differs.
    """
    own = module.state_dict()
    problems = [f"missing {k}" for k in sorted(own.keys() - weights.keys())]
    problems += [f"unknown {k}" for k in sorted(weights.keys() - own.keys())]
    problems += [
        f"{k} has shape {tuple(weights[k].shape)} instead of {tuple(own[k].shape)}"
        for k in sorted(own.keys() & weights.keys())
        if own[k].shape != weights[k].shape
    ]
    if problems:
        raise CheckpointError(f"{source}: {len(problems)} weights do not fit this model: {'; '.join(problems)}.")
    module.load_state_dict(weights)
