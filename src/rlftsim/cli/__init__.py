"""A person's verbs. `rlftsim VERB --help` explains each."""

import os

# Before torch is imported: on shared cores spinning threads made two threads twenty times slower than one.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from rlftsim.cli.main import main

__all__ = ["main"]
