"""The paper's tables and figures, an experiment in a file each. `experiments.registry` lists them."""
