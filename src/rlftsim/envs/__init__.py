"""A planner in the loop: environments in which a planner drives and a traffic model answers.

    import gymnasium
    env = gymnasium.make("rlftsim.envs:rlftsim/Ego-v0", data="synthetic", traffic="policy", action="bicycle")

Importing this module registers the environments, and needs the extra `env`: `pip install 'rlftsim[env]'`.
"""

from rlftsim.errors import ConfigError

try:
    import gymnasium
    import pettingzoo  # noqa: F401
except ImportError as error:
    raise ConfigError(f"rlftsim.envs needs gymnasium and pettingzoo ({error}): pip install 'rlftsim[env]'.") from None

from rlftsim.envs.config import EnvConfig
from rlftsim.envs.ego_env import EgoEnv
from rlftsim.envs.failures import FailureEstimate, estimate_failures
from rlftsim.envs.parallel import TrafficParallelEnv, parallel_env
from rlftsim.envs.result import Result
from rlftsim.envs.vector_env import EgoVectorEnv

__all__ = [
    "EgoEnv", "EgoVectorEnv", "EnvConfig", "FailureEstimate", "Result", "TrafficParallelEnv", "estimate_failures",
    "parallel_env",
]  # fmt: skip

if "rlftsim/Ego-v0" not in gymnasium.registry:
    gymnasium.register(
        "rlftsim/Ego-v0",
        entry_point="rlftsim.envs.ego_env:EgoEnv",
        vector_entry_point="rlftsim.envs.vector_env:EgoVectorEnv",
    )
