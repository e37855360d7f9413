"""The command line: one file for each verb or two. `rlftsim VERB --help` explains a verb."""

import os

# Before torch is imported: on shared cores spinning threads made two threads twenty times slower than one.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from rlftsim.cli.main import main

__all__ = ["main"]
