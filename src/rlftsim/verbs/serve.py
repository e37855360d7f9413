"""`rlftsim serve`: traffic for other simulators."""

from rlftsim.errors import ConfigError
from rlftsim.jobs.progress import print_line
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.policy import frozen_copy
from rlftsim.scenario.dataset import ScenarioDataset, dataset_folder
from rlftsim.verbs.arguments import Device

CACHED_SCENARIOS = 16


def serve_alpasim(
    *,
    model: str = "demo-tuned",
    data: str | None = None,
    split: str | None = None,
    host: str = "127.0.0.1",
    port: int = 6200,
    device: Device = "cpu",
) -> None:
    """Serve AlpaSim's traffic service: AlpaSim drives the ego, the model all other road users.

    Serves until Ctrl-C, unencrypted, as AlpaSim speaks. A session ends 8 s after its handover. Needs `pip install
    'rlftsim[alpasim]'`.

    Args:
        model: Run, model folder, or registered name.
        data: Folder of a data set, or "synthetic": the map of a scene is that of the scenario with the scene's id. Left
            out, there is no map, and the model has to be "constant_velocity".
        split: Split of the data set; left out, all scenarios.
        host: Address to listen on; any other than this machine's is reachable from outside.
        port: Port to listen on; 0 takes a free one.
        device: Device of the model.

    Raises:
        ConfigError: No map for a model that needs one, no grpcio, or a port that is taken.
    """
    policy = frozen_copy(load_policy(model, device))
    if data is None and not isinstance(policy, ConstantVelocity):
        raise ConfigError(
            f"--model {model} needs maps: name --data, whose scenario ids are the scene ids, or --model "
            "constant_velocity."
        )
    scenes = None if data is None else ScenarioDataset(dataset_folder(data), split, cache_size=CACHED_SCENARIOS)
    from rlftsim.envs.alpasim_service import TrafficService, start_server

    server, port = start_server(TrafficService(policy, scenes), host=host, port=port)
    print_line(
        f"traffic.TrafficService on {host}:{port}, model {model}, {'no' if scenes is None else len(scenes)} maps"
    )
    try:
        server.wait_for_termination()
    finally:
        server.stop(grace=1).wait()
