import pytest
import torch

import tiny
from rlftsim.training.parallel import start_fabric
from tiny_fixtures import drawn_scenarios, measured, simulated, vocabulary  # noqa: F401


@pytest.fixture(scope="module")
def fabric():
    return start_fabric(tiny.CPU)


@pytest.fixture(autouse=True)
def _one_thread_as_before():
    """Runs set the number of threads; the next test file shall not notice."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)
