"""`python -m rlftsim` is the command line."""

import sys

from rlftsim.cli import main

sys.exit(main())
