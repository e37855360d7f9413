"""`rlftsim entries fit`: who enters the region around the ego, learned from long logs."""

from pathlib import Path

from rlftsim.errors import ConfigError
from rlftsim.jobs.progress import print_line
from rlftsim.rollout.entries import fit_entries, write_entries
from rlftsim.scenario.open import open_dataset
from rlftsim.verbs.arguments import Name


def fit(data: Name, out: Path, *, split: str = "training") -> None:
    """Fit a model of who enters a world, and how fast, to long logs, for `rlftsim simulate --entries FILE.npz`.

    Poisson regressions of those that move and of those that stand, on how fast these come nearer and how many there
    are, and the agents that entered in the logs.

    Args:
        data: Folder of a data set of long logs, as `rlftsim synthesize --seconds 70` makes.
        out: File to write, FILE.npz.
        split: Split of the data set.

    Raises:
        ConfigError: A name of the file that does not end in .npz.
        DataError: Nobody enters in these logs, or the file cannot be written.
    """
    if out.suffix != ".npz":
        raise ConfigError(f"{out}: a file of entries ends in .npz: name another --out.")
    dataset = open_dataset(data, split)
    model = fit_entries([dataset[position] for position in range(len(dataset))])
    write_entries(out, model)
    print_line(f"{out}: {len(model.entrants.speed_mps)} entrants of {len(dataset)} scenarios.")
