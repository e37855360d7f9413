import pytest

from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.synthetic import pack_path


@pytest.fixture(scope="session")
def pack():
    """Six synthetic scenarios."""
    data = ScenarioDataset(pack_path(), "validation")
    return [data[i] for i in range(0, 36, 6)]
