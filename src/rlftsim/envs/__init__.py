"""A planner in the loop: environments in which a planner drives and a traffic model answers.

    import gymnasium
    env = gymnasium.make("rlftsim.envs:rlftsim/Ego-v0", data="synthetic", traffic="policy", action="bicycle")

Importing this module registers the environments. It needs the extra `env`: `pip install 'rlftsim[env]'`.
"""

from rlftsim.errors import ConfigError

try:
    import gymnasium
except ImportError:
    raise ConfigError("rlftsim.envs needs gymnasium and pettingzoo: pip install 'rlftsim[env]'.") from None

from rlftsim.envs.ego_env import EgoEnv

__all__ = ["EgoEnv"]

if "rlftsim/Ego-v0" not in gymnasium.registry:
    gymnasium.register("rlftsim/Ego-v0", entry_point="rlftsim.envs.ego_env:EgoEnv")
