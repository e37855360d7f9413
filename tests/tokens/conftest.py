import pytest

from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary


@pytest.fixture(scope="session")
def pack_scenarios():
    """Small scenarios of the embedded pack that have vehicles, pedestrians and cyclists."""
    data = ScenarioDataset(pack_path(), "training")
    columns = (data.index[name].to_pylist() for name in ("num_vehicles", "num_pedestrians", "num_cyclists"))
    mixed = sorted((sum(counts), i) for i, counts in enumerate(zip(*columns)) if all(counts))
    return [data[i] for _, i in mixed[:6]]


@pytest.fixture(scope="session")
def built(pack_scenarios):
    """Vocabulary and coverage reports."""
    return build_vocabulary(pack_scenarios, TokensConfig(num_tokens=64, num_map_prototypes=24), origin="a test")


@pytest.fixture(scope="session")
def vocabulary(built):
    return built[0]
