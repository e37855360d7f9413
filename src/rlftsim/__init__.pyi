"""The public names for editors and type checkers; `__init__.py` loads them. A test holds both together."""

from rlftsim.errors import RlftsimError as RlftsimError
from rlftsim.evaluation.results import Evaluation as Evaluation
from rlftsim.goals.types import Goals as Goals
from rlftsim.policies.smart.policy import SmartPolicy as SmartPolicy
from rlftsim.realism import RealismResult as RealismResult
from rlftsim.rewards import leave_one_out as leave_one_out
from rlftsim.rewards import masked_mean as masked_mean
from rlftsim.rewards import register_reward as register_reward
from rlftsim.rollout.baselines import ConstantVelocity as ConstantVelocity
from rlftsim.rollout.policy import Policy as Policy
from rlftsim.rollout.policy import Sampling as Sampling
from rlftsim.rollout.types import Rollouts as Rollouts
from rlftsim.scenario.dataset import write_dataset as write_dataset
from rlftsim.scenario.types import Scenario as Scenario
from rlftsim.studio.notebook import open_studio as open_studio
from rlftsim.training.config import FinetuneConfig as FinetuneConfig
from rlftsim.verbs.check_policy import check_policy as check_policy
from rlftsim.verbs.check_reward import check_reward as check_reward
from rlftsim.verbs.compare import compare as compare
from rlftsim.verbs.evaluate import evaluate as evaluate
from rlftsim.verbs.finetune import finetune as finetune
from rlftsim.verbs.inputs import load_dataset as load_dataset
from rlftsim.verbs.inputs import load_policy as load_policy
from rlftsim.verbs.pretrain import pretrain as pretrain
from rlftsim.verbs.recipe import recipe as recipe
from rlftsim.verbs.report import report as report
from rlftsim.verbs.score import score as score
from rlftsim.verbs.simulate import simulate as simulate
from rlftsim.viewer.notebook import film as film
from rlftsim.viewer.notebook import show as show

__version__: str
__all__: list[str]
