"""Models at Hugging Face: hf://USER/NAME, or hf://USER/NAME@REVISION for the same bits later, also without a network.

Only files of model folders are downloaded and uploaded, weights as safetensors. huggingface_hub finds the credentials.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from rlftsim import __version__
from rlftsim.errors import CheckpointError, ConfigError, DataError, RlftsimError
from rlftsim.jobs.documents import first_line

PROTOCOL = "hf://"
FILES = ("README.md", "*.json", "*.safetensors")


def is_hub_url(name: object) -> bool:
    """True for an address of a model at Hugging Face."""
    return isinstance(name, str) and name.startswith(PROTOCOL)


@cache
def pull_model(url: str) -> Path:
    """Folder of a model, named after the commit and downloaded once.

    Raises:
        ConfigError: huggingface_hub is not installed, or no address of a model.
        DataError: No such model or revision, no network, or no right to read there.
        CheckpointError: The repository holds no model folder.
    """
    repository, _, revision = url.removeprefix(PROTOCOL).partition("@")
    with _open_hub(url, repository) as hub:
        folder = hub.snapshot_download(
            repository, revision=revision or None, allow_patterns=list(FILES), library_name="rlftsim",
            library_version=__version__,
        )  # fmt: skip
    names = {path.name for path in Path(folder).iterdir()}
    if "config.json" not in names or not any(name.endswith(".safetensors") for name in names):
        raise CheckpointError(
            f"{url} holds no model folder of rlftsim, config.json and *.safetensors: pickles such as .pkl, .ckpt and "
            ".bin are never loaded."
        )
    return Path(folder)


def pin_model(name: Any) -> Any:
    """The address of a model at Hugging Face with the commit; all other names unchanged."""
    return f"{name.partition('@')[0]}@{pull_model(name).name}" if is_hub_url(name) else name


def push_files(url: str, files: Mapping[str, Path | bytes]) -> str:
    """Address of the commit that adds files to a repository, which is made if missing.

    Args:
        url: Address of the repository, without a revision.
        files: Paths on this machine, or contents, by name.

    Raises:
        ConfigError: huggingface_hub is not installed, or no address of a model.
        DataError: No network, or no right to write there.
    """
    repository = url.removeprefix(PROTOCOL)
    with _open_hub(url, repository) as hub:
        api = hub.HfApi(library_name="rlftsim", library_version=__version__)
        api.create_repo(repository, exist_ok=True)
        additions = [hub.CommitOperationAdd(name, content) for name, content in files.items()]
        commit = api.create_commit(repository, additions, commit_message=f"Model of rlftsim {__version__}")
    return f"{PROTOCOL}{repository}@{commit.oid}"


@contextmanager
def _open_hub(url: str, repository: str) -> Iterator[Any]:
    """The library; errors inside the block become a single line that names the address."""
    if not is_hub_url(url) or repository.count("/") != 1 or not all(repository.split("/")):
        raise ConfigError(f"{url} is no address of a model: write hf://USER/NAME, or hf://USER/NAME@REVISION to load.")
    try:
        import huggingface_hub  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ConfigError(f'{url}: hf:// needs another library: pip install "rlftsim[hf]".') from None
    try:
        yield huggingface_hub
    except RlftsimError:
        raise
    except Exception as error:  # the library has dozens of its own: no such revision, no token, no network
        raise DataError(
            f"{url}: {type(error).__name__}: {first_line(error)}: check name, revision and network, and the token of "
            "this machine (hf auth login)."
        ) from error
