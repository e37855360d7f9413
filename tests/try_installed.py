"""The first commands of a newcomer, run with an installed rlftsim: python tests/try_installed.py PYTHON

PYTHON is an interpreter of an environment in which the wheel is installed. The commands run in an empty folder, without
git or a compiler on the path, without a home folder and with a proxy that refuses every connection.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCENARIO = "9d639de83d6f5239"
COMMANDS = (
    f"simulate demo-tuned --data synthetic --scenario {SCENARIO} --out rollouts",
    "score rollouts --data synthetic --explain pages",
)
WHERE = """
import importlib.metadata, pathlib, sys, rlftsim
assert "torch" not in sys.modules
print(pathlib.Path(rlftsim.__file__).parent, importlib.metadata.version("rlftsim"))
"""


def try_installed(python: str, folder: Path, more: dict[str, str]) -> tuple[Path, str, float]:
    """Run the commands in a folder, up to a page that plays.

    Args:
        python: interpreter.
        folder: empty.
        more: environment variables.

    Returns:
        Folder of the installed package, its version, seconds from the first command to the page.
    """
    nowhere = "http://127.0.0.1:9"
    environment = {"PATH": "/nowhere", "HOME": "/dev/null/home", "http_proxy": nowhere, "https_proxy": nowhere, **more}

    def run(*words: str) -> str:
        # -P: the folder itself is no place to import from
        done = subprocess.run(
            [python, "-P", *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{' '.join(words)}: {done.stderr}"
        return done.stdout

    package, version = run("-c", WHERE).rsplit(maxsplit=1)
    start = time.monotonic()
    for command in COMMANDS:
        run("-m", "rlftsim", *command.split())
    page = (folder / "pages" / f"{SCENARIO}.html").read_text()
    assert "<canvas" in page
    assert (Path(package) / "py.typed").is_file()
    return Path(package), version, time.monotonic() - start


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        threads = {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "2")}
        package, version, seconds = try_installed(sys.argv[1], Path(folder), threads)
    print(f"rlftsim {version} in {package}: {seconds:.1f} s to a page that plays")
