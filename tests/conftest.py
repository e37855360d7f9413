import os
from pathlib import Path

import pytest
from hypothesis import settings

# slow machines are no failure; the same examples every time
settings.register_profile("rlftsim", deadline=None, derandomize=True)
settings.load_profile("rlftsim")


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with official material that is not part of the repository: RLFTSIM_SHARED, else ../shared."""
    folder = Path(os.environ.get("RLFTSIM_SHARED", Path(__file__).parents[2] / "shared"))
    if not folder.is_dir():
        pytest.skip(f"no official material at {folder}: set RLFTSIM_SHARED to compare with it")
    return folder
