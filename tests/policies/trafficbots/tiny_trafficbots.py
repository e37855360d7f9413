"""A TrafficBots model of a few thousand weights."""

from rlftsim.policies.trafficbots.config import TrafficBotsConfig

TINY = TrafficBotsConfig(
    dim=32, num_heads=2, num_map_layers=1, num_light_layers=1, num_agent_layers=1, map_neighbors=4,
    light_neighbors=2, agent_map_neighbors=8, agent_light_neighbors=2, agent_neighbors=4, radius_m=100.0,
    light_radius_m=100.0, steps_per_pass=40,
)  # fmt: skip
