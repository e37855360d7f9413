"""`rlftsim model`: show, average and upload models, import and export checkpoints of CAT-K."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from torch import nn

from rlftsim import __version__
from rlftsim.errors import ConfigError
from rlftsim.evaluation.hub_card import read_evaluation, write_hub_card
from rlftsim.jobs.folder import check_file
from rlftsim.jobs.progress import print_line, print_lines
from rlftsim.policies.averaging import average_policies
from rlftsim.policies.checkpoint import CARD, find_model, read_card, save_new_model
from rlftsim.policies.hub import FILES, push_files
from rlftsim.policies.registry import POLICIES, load_policy, needs_no_arguments
from rlftsim.policies.smart.alpasim_checkpoint import import_alpasim
from rlftsim.policies.smart.catk_checkpoint import (
    CatkImport,
    export_catk,
    import_catk,
    write_catk,
    write_catk_vocabulary,
)
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.recipes.card import append_cards
from rlftsim.recipes.docstrings import summarize_docstring

Format = Literal["catk"]
Source = Literal["catk", "alpasim"]


def import_model(checkpoint: Path, out: Path, *, vocabulary: Sequence[Path] = (), format: Source = "catk") -> None:
    """Convert a checkpoint of the public CAT-K code, or of AlpaSim's, to a model folder.

    No code in the checkpoint is executed. It must have exactly the expected weights with the right shapes;
    otherwise all differences are listed and nothing is written.

    Args:
        checkpoint: File: Lightning .ckpt, or .safetensors with the keys of its state dict. Of AlpaSim the folder
            catk_v120, with the folder tokens beside it.
        out: Folder for the model.
        vocabulary: Token tables of its training: npz with veh, ped, cyc and traj_src (may be two files), or a
            vocabulary file. AlpaSim's are found by its settings.
        format: Code that the checkpoint comes from.

    Raises:
        ConfigError: Token tables are missing, or named for AlpaSim; or the folder holds files.
    """
    _check_empty(out)
    if format == "catk" and not vocabulary:
        raise ConfigError(f"{checkpoint}: comes without its token tables: hand them over, --vocabulary.")
    if format == "alpasim" and vocabulary:
        raise ConfigError("--vocabulary has no effect with --from alpasim: its tables are in the folder tokens.")
    imported = import_catk(checkpoint, vocabulary) if format == "catk" else import_alpasim(checkpoint)
    save_new_model(imported.policy, out, card=_card(checkpoint, imported, format))
    weights = sum(p.numel() for p in imported.policy.parameters())
    print_line(f"{out}: SMART {imported.size}, {weights} weights, every key accounted for.")
    for note in imported.notes:
        print_line(f"  {note}")


def export_model(model: str, out: Path, *, format: Format = "catk") -> None:
    """Write a model's weights with the keys of the public CAT-K code, and its token tables.

    Importing them again gives the same bits.

    Args:
        model: SMART model: run, model folder or registered name.
        out: File for the weights, .safetensors; the tables go to the same name with .vocabulary.npz.
        format: Code that the keys are for.
    """
    if out.suffix != ".safetensors":
        raise ConfigError(f"{out}: weights are written as .safetensors: name the file so.")
    policy = load_policy(model)
    if not isinstance(policy, SmartPolicy):
        raise ConfigError(
            f"{model}: a {type(policy).__name__} cannot be exported, the public CAT-K code has SMART models alone"
            f"{_describe_base(model, policy)}."
        )
    tables = out.with_suffix(".vocabulary.npz")
    check_file(out)
    write_catk(policy, out)
    write_catk_vocabulary(policy.vocabulary, tables)
    print_line(f"{out}: weights")
    print_line(f"{tables}: token tables")
    if not policy.config.catk_compat:
        print_line("  trained here: the public code treats an agent's first motion differently (docs/catk.md)")


def push_model(
    model: Path, url: str, *, license: str | None = None, i_comply: bool = False, evaluation: Path | None = None
) -> None:
    """Upload a model to Hugging Face, with a card that names data, license and scores.

    The license follows from the data that the weights have seen, those of the models they were made from included.

    Args:
        model: Model folder, or folder of a finished run.
        url: Address of the repository, hf://USER/NAME; made if missing. A login is found by huggingface_hub.
        license: License of the weights, an identifier of Hugging Face such as cc-by-4.0. Left out where the data's
            terms leave no choice.
        i_comply: Declare, of weights made from the Waymo Open Dataset, that publishing them is in keeping with its
            license agreement: non-commercial use alone, its notice, and recipients who are bound by it.
        evaluation: Result of `rlftsim evaluate` with this very model; its means and intervals go onto the card.

    Raises:
        ConfigError: Data of unknown terms, a license that contradicts them, a missing declaration, or an evaluation of
            another model.
        DataError: No network, or no right to write there.
    """
    policy, folder = load_policy(model), find_model(model)
    result = None if evaluation is None else read_evaluation(evaluation, policy)
    card = read_card(folder, heading_shift=0) or ""
    text = write_hub_card(url, card, license, i_comply=i_comply, evaluation=result)
    paths = [path for pattern in FILES for path in sorted(folder.rglob(pattern)) if path.is_file()]
    files: dict[str, Path | bytes] = {path.relative_to(folder).as_posix(): path for path in paths}
    print_line(f"{push_files(url, files | {CARD: text.encode()})}: {len(files)} files")


def average_models(models: list[str], out: Path, *, base: str | None = None, scale: float = 1.0) -> None:
    """Write the mean of models that were fine-tuned from one base, as with other seeds.

    It keeps what they share and has less of the noise of their gradients.

    Args:
        models: Models with the same settings and vocabulary: runs, model folders or registered names.
        out: Folder for the model.
        base: Model that they were fine-tuned from; for --scale alone.
        scale: Factor on their distance from the base; above 1 goes further from the base than they did, along what
            they share.
    """
    if base is not None and scale == 1.0:
        raise ConfigError(f"--base {base} has no effect: the mean needs none, add --scale 2 to go further.")
    _check_empty(out)
    average = average_policies(
        [load_policy(name) for name in models], base=None if base is None else load_policy(base), scale=scale
    )
    scaled = "" if base is None else f"* scale {scale:g} from {base}\n"
    card = f"# Mean of {len(models)} models\n\n* {', '.join(models)}\n{scaled}"
    card += f"* command: rlftsim {' '.join(sys.argv[1:])}\n* rlftsim {__version__}\n"
    save_new_model(average, out, card=append_cards(card, [*models, *filter(None, [base])]))
    print_line(f"model: {out}")


def list_models() -> None:
    """List the models that are used by their name alone: those in the box, baselines, and those of other packages.

    Every command that takes MODEL takes these names, the folder of a run, or a model folder. `rlftsim model show NAME`
    prints a card with data, scores and terms.
    """
    policies = {name: POLICIES.get(name) for name in POLICIES.names()}
    summaries = {name: summarize_docstring(make) for name, make in policies.items() if needs_no_arguments(make)}
    for name, summary in summaries.items():
        print_line(f"{name:{max(map(len, summaries))}}  {summary}")


def show_model(model: str) -> None:
    """Print what a model is: class, number of weights, card, and what the features of a calibrated one earn.

    Args:
        model: Run, model folder or registered name.
    """
    policy = load_policy(model)
    weights = sum(p.numel() for p in policy.parameters()) if isinstance(policy, nn.Module) else 0
    print_line(f"{model}: {type(policy).__name__}, {weights:,} weights")
    print_lines("\n" + (read_card(model, heading_shift=0) or "No card."))


def _describe_base(model: str, policy: object) -> str:
    """Where the SMART model is that a calibrated one has below its features; empty for all others.

    Raises:
        CheckpointError: That model cannot be exported either.
    """
    base = getattr(policy, "base", None)
    if not isinstance(base, SmartPolicy):
        return ""
    export_catk(base)
    return f": export {find_model(model) / 'base'}, which is this model without the features"


def _check_empty(folder: Path) -> None:
    """Check that a folder holds neither a model nor files that a model would replace."""
    if folder.is_dir() and any(folder.iterdir()):
        raise ConfigError(f"{folder} is not empty: name another folder for the model.")


_ORIGIN = {
    "catk": """a checkpoint of the public CAT-K code
* computes what the public code computes (`catk_compat`)
* terms: those of the checkpoint, of its token tables (CAT-K's own: NVIDIA, non-commercial research) and of the data
  that it was trained on (Waymo Open Motion Dataset: non-commercial)""",
    "alpasim": """a CAT-K model in AlpaSim's layout
* terms: those of the files (NVlabs/alpasim: Apache-2.0) and of the data that it was trained on""",
}


def _card(checkpoint: Path, imported: CatkImport, source: Source) -> str:
    notes = "\n".join(f"* {note}" for note in imported.notes)
    return f"""# SMART traffic model ({imported.size}), imported

* from {checkpoint.name}, {_ORIGIN[source]}
{notes}
* command: rlftsim {" ".join(sys.argv[1:])}
* rlftsim {__version__}
"""
