"""Types of the page's modules, by TypeScript from their JSDoc."""

import shutil
import subprocess
from pathlib import Path

import pytest


@pytest.mark.skipif(shutil.which("tsc") is None, reason="no TypeScript compiler: make types-js brings one")
def test_modules_of_the_page_pass_the_type_checker():
    words = ["tsc", "--project", str(Path(__file__).parent / "jsconfig.json")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.stdout == ""
    assert done.returncode == 0
