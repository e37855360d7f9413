import pytest
import tiny
import torch

import scenes


@pytest.fixture(autouse=True)
def _one_thread_as_before():
    """Runs set the number of threads; the next test file shall not notice."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def drawn_scenarios():
    """Four scenarios drawn by hand."""
    return [scenes.straight_road(), scenes.junction_with_light(), scenes.with_gaps(), scenes.straight_road("again")]


@pytest.fixture(scope="session")
def vocabulary(drawn_scenarios):
    return tiny.small_vocabulary([*drawn_scenarios, scenes.crowd(num_agents=40)])
