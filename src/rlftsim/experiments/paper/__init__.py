"""The paper's tables and figures, an experiment in a file each, listed in `experiments.registry`."""
