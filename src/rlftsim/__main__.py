"""Command line: `python -m rlftsim` is the same as `rlftsim`."""

import sys

from rlftsim.cli import main

sys.exit(main())
