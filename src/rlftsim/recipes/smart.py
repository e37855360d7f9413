"""SMART's sizes with the numbers they are trained by. A variant calls one of these and changes fields."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

from rlftsim.policies.smart.config import SmartConfig, smart_demo, smart_mini, smart_nano, smart_tiny
from rlftsim.tokens.clustering import TokensConfig
from rlftsim.training.catk import CatkConfig
from rlftsim.training.finetune import FinetuneConfig
from rlftsim.training.gcsl import GcslConfig
from rlftsim.training.goals import GoalConfig, with_goals_asked
from rlftsim.training.pretrain import PretrainConfig
from rlftsim.training.reference import KlConfig


@dataclass(frozen=True)
class SmartRecipe:
    """Everything from the vocabulary to the fine-tuned policy."""

    tokens: TokensConfig = field(default_factory=TokensConfig)
    model: SmartConfig = field(default_factory=SmartConfig)
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    finetune: FinetuneConfig = field(default_factory=FinetuneConfig)
    catk: CatkConfig = field(default_factory=CatkConfig)
    gcsl: GcslConfig = field(default_factory=GcslConfig)

    def with_goals(self) -> "SmartRecipe":
        """The same, fine-tuning with goals: everybody is asked to go where the record ends. With the paper's reward; or by CAT-K, which then
        trains the weights that see goals and no others, on all tokens as candidates."""
        goals = with_goals_asked(self.finetune.goals)
        catk = replace(self.catk, goal_share=1.0, trained="goals", num_candidates=self.tokens.num_tokens)
        return replace(self, finetune=replace(self.finetune, goals=goals, reward="gcft"), catk=catk)


def smart_tiny_rlftsim() -> SmartRecipe:
    """The paper: SMART-tiny (7 M), pre-trained on WOMD for 32 epochs, fine-tuned for one."""
    return SmartRecipe(model=smart_tiny())


def smart_mini_rlftsim() -> SmartRecipe:
    """SMART-mini (3 M)."""
    return SmartRecipe(model=smart_mini())


def smart_nano_rlftsim() -> SmartRecipe:
    """SMART-nano (1 M): fits one small GPU."""
    return SmartRecipe(model=smart_nano(), pretrain=PretrainConfig(batch_size=16), catk=CatkConfig(batch_size=16))


def smart_demo_rlftsim() -> SmartRecipe:
    """Minutes on two CPU cores, for a few hundred scenarios: a small model, a pre-training of many small updates, large fine-tuning steps."""
    return SmartRecipe(
        tokens=TokensConfig(num_tokens=1024, num_map_prototypes=256),
        model=smart_demo(),
        pretrain=PretrainConfig(
            epochs=10.0, batch_size=2, learning_rate=3e-3, warmup_updates=40, gradient_clip=1.0, label_smoothing=0.0,
            max_trained_agents=None, checkpoint_every=200,
        ),
        finetune=FinetuneConfig(
            epochs=1.5, batch_size=4, num_rollouts=8, rollouts_per_pass=8, learning_rate=3e-4, warmup_updates=5,
            checkpoint_every=20, kl=KlConfig(target=0.05, initial_beta=0.01), goals=GoalConfig(learning_rate_scale=5.0),
        ),
        catk=CatkConfig(
            epochs=3.0, batch_size=8, learning_rate=3e-4, warmup_updates=5, gradient_clip=1.0, max_trained_agents=None,
            checkpoint_every=20,
        ),
        gcsl=GcslConfig(
            epochs=1.0, batch_size=1, num_rollouts=4, warmup_updates=10, max_trained_agents=None, checkpoint_every=80,
        ),
    )  # fmt: skip


def smart_demo_quick() -> SmartRecipe:
    """The demo's stages at the smallest size that still exercises all of them."""
    recipe = smart_demo_rlftsim()
    return replace(
        recipe,
        tokens=replace(recipe.tokens, num_tokens=256, num_map_prototypes=64),
        pretrain=replace(recipe.pretrain, epochs=1.0),
        finetune=replace(recipe.finetune, epochs=0.25, num_rollouts=4),
        catk=replace(recipe.catk, epochs=0.25, batch_size=4),
        gcsl=replace(recipe.gcsl, epochs=0.25),
    )


def smart_synthetic() -> SmartRecipe:
    """For experiments on the synthetic scenarios: the demo with shorter fine-tuning, because it is run many times."""
    recipe = smart_demo_rlftsim()
    return replace(recipe, finetune=replace(recipe.finetune, epochs=1.0))


RecipeName = Literal["smart-tiny", "smart-mini", "smart-nano", "smart-demo"]
RECIPES: dict[RecipeName, Callable[[], SmartRecipe]] = {
    "smart-tiny": smart_tiny_rlftsim,
    "smart-mini": smart_mini_rlftsim,
    "smart-nano": smart_nano_rlftsim,
    "smart-demo": smart_demo_rlftsim,
}
"""By the names the command line takes."""
