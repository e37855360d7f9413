"""The verb that shows and averages models, and imports and exports checkpoints of the public CAT-K code: model."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from torch import nn
from tyro.conf import Positional

from rlftsim import __version__
from rlftsim.errors import ConfigError
from rlftsim.jobs.folder import check_file
from rlftsim.policies.averaging import average_policies
from rlftsim.policies.checkpoint import read_card
from rlftsim.policies.registry import load_policy
from rlftsim.policies.smart.catk_checkpoint import CatkImport, import_catk, write_catk
from rlftsim.policies.smart.catk_vocabulary import write_catk_vocabulary
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.recipes.card import append_cards

Format = Literal["catk"]


@dataclass(frozen=True)
class Import:
    """Convert a checkpoint of the public CAT-K code to a model folder.

    No code in the checkpoint is executed. It must have exactly the expected weights with the right shapes;
    otherwise all differences are listed and nothing is written.
    """

    checkpoint: Positional[Path]
    """Lightning .ckpt, or .safetensors with the keys of its state dict."""
    vocabulary: list[Path]
    """Token tables of its training: npz with veh, ped, cyc and traj_src (may be two files), or a vocabulary file."""
    out: Path
    """Folder for the model."""
    format: Annotated[Format, tyro.conf.arg(name="from")] = "catk"
    """Code that the checkpoint comes from."""

    def run(self) -> int:
        """Read strictly, write the folder, print a summary."""
        _refuse_to_replace(self.out)
        imported = import_catk(self.checkpoint, self.vocabulary)
        imported.policy.save_pretrained(self.out, card=_card(self.checkpoint, imported))
        weights = sum(p.numel() for p in imported.policy.parameters())
        print(f"{self.out}: SMART {imported.size}, {weights} weights, every key accounted for.")
        for note in imported.notes:
            print(f"  {note}")
        return 0


@dataclass(frozen=True)
class Export:
    """Write a model's weights with the keys of the public CAT-K code, and its token tables.

    Importing them again gives the same bits.
    """

    model: Positional[str]
    """A SMART model: a run, a model folder or a registered name."""
    out: Positional[Path]
    """File for the weights, .safetensors; the tables go to the same name with .vocabulary.npz."""
    format: Annotated[Format, tyro.conf.arg(name="to")] = "catk"
    """Code that the keys are for."""

    def run(self) -> int:
        """Read the model folder, write both files."""
        if self.out.suffix != ".safetensors":
            raise ConfigError(f"{self.out}: weights are written as .safetensors: name the file so.")
        policy = load_policy(self.model)
        if not isinstance(policy, SmartPolicy):
            raise ConfigError(
                f"{self.model}: a {type(policy).__name__} cannot be exported, the public CAT-K code has SMART models "
                "alone."
            )
        tables = self.out.with_suffix(".vocabulary.npz")
        check_file(self.out)
        write_catk(policy, self.out)
        write_catk_vocabulary(policy.vocabulary, tables)
        print(f"{self.out}: weights\n{tables}: token tables")
        if not policy.config.catk_compat:
            print("  trained here: the public code treats an agent's first motion differently (docs/catk.md)")
        return 0


@dataclass(frozen=True)
class Average:
    """Write the mean of models that were fine-tuned from one base, as with other seeds.

    It keeps what they share and has less of the noise of their gradients.
    """

    models: Positional[list[str]]
    """Models with the same settings and vocabulary: runs, model folders or registered names."""
    out: Path
    """Folder for the model."""
    base: str | None = None
    """Model that they were fine-tuned from; for --scale alone."""
    scale: float = 1.0
    """Above 1 goes further from the base than they did, along what they share."""

    def run(self) -> int:
        """Load all, write the folder."""
        if self.base is not None and self.scale == 1.0:
            raise ConfigError(f"--base {self.base} has no effect: the mean needs none, add --scale 2 to go further.")
        _refuse_to_replace(self.out)
        base = None if self.base is None else load_policy(self.base)
        average = average_policies([load_policy(name) for name in self.models], base=base, scale=self.scale)
        scaled = "" if self.base is None else f"* scale {self.scale:g} from {self.base}\n"
        card = f"# Mean of {len(self.models)} models\n\n* {', '.join(self.models)}\n{scaled}"
        card += f"* command: rlftsim {' '.join(sys.argv[1:])}\n* rlftsim {__version__}\n"
        average.save_pretrained(self.out, card=append_cards(card, [*self.models, *filter(None, [self.base])]))
        print(f"model: {self.out}")
        return 0


@dataclass(frozen=True)
class Show:
    """Print what a model is: class, number of weights, card, and what the features of a calibrated one earn."""

    model: Positional[str]
    """Run, model folder or registered name."""

    def run(self) -> int:
        """Load it, print its card."""
        policy = load_policy(self.model)
        weights = sum(p.numel() for p in policy.parameters()) if isinstance(policy, nn.Module) else 0
        print(f"{self.model}: {type(policy).__name__}, {weights:,} weights\n")
        print(read_card(self.model, heading_shift=0) or "No card.")
        return 0


@dataclass(frozen=True)
class Model:
    """Show or average models, import a checkpoint of the public CAT-K code, or export a model to it."""

    action: (
        Annotated[Show, tyro.conf.subcommand("show")]
        | Annotated[Average, tyro.conf.subcommand("average")]
        | Annotated[Import, tyro.conf.subcommand("import")]
        | Annotated[Export, tyro.conf.subcommand("export")]
    )

    def run(self) -> int:
        """Run the action."""
        return self.action.run()


def _refuse_to_replace(folder: Path) -> None:
    """Refuse a folder that holds anything: a model, or files that one would replace."""
    if folder.is_dir() and any(folder.iterdir()):
        raise ConfigError(f"{folder} is not empty: name another folder for the model.")


def _card(checkpoint: Path, imported: CatkImport) -> str:
    notes = "\n".join(f"* {note}" for note in imported.notes)
    return f"""# SMART traffic model ({imported.size}), imported

* from {checkpoint.name}, a checkpoint of the public CAT-K code
{notes}
* computes what the public code computes (`catk_compat`)
* terms: those of the checkpoint, of its token tables (CAT-K's own: NVIDIA, non-commercial research) and of the data
  that it was trained on (Waymo Open Motion Dataset: non-commercial)
* command: rlftsim {" ".join(sys.argv[1:])}
* rlftsim {__version__}
"""
