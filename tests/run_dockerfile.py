"""The steps of the Dockerfile without Docker: python tests/run_dockerfile.py PYTHON FOLDER [NAME=VALUE ...]

PYTHON stands for the image, FOLDER (empty) for its root; NAME=VALUE are build arguments. Files are copied, commands run
with an environment's own pip first on the path, and in the end the entry point prints its help. What needs root, users
and folders outside, is passed over.
"""

import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
NEEDS_ROOT = ("useradd", "USER")


def steps() -> list[tuple[str, str]]:
    """Instructions of the Dockerfile and what follows them."""
    text = re.sub(r"^#.*\n", "", (ROOT / "Dockerfile").read_text(), flags=re.MULTILINE).replace("\\\n", "")
    return [tuple(line.split(maxsplit=1)) for line in text.splitlines() if line.strip()]


def main(python: str, folder: Path, arguments: dict[str, str]) -> None:
    root = folder.resolve()
    subprocess.run([python, "-m", "venv", root / "venv"], check=True)
    environment, place, entry = {"PATH": f"{root / 'venv' / 'bin'}:/usr/bin:/bin", "HOME": str(root)}, root, []
    for instruction, rest in steps():
        if instruction == "ARG":
            name, _, value = rest.partition("=")
            environment[name] = arguments.get(name, value)
        elif instruction == "ENV":
            environment |= dict(pair.split("=") for pair in rest.split())
        elif instruction == "WORKDIR":
            place = root / rest.lstrip("/")
            place.mkdir(parents=True, exist_ok=True)
        elif instruction == "COPY":
            *sources, target = rest.split()
            for source in (ROOT / name for name in sources):
                copy = shutil.copytree if source.is_dir() else shutil.copy
                copy(source, place / target)
        elif instruction == "RUN" and not rest.startswith(NEEDS_ROOT):
            subprocess.run(["bash", "-ec", rest], cwd=place, env=environment, check=True)
        elif instruction in ("ENTRYPOINT", "CMD"):
            entry += re.findall(r'"([^"]+)"', rest)
    subprocess.run([root / "venv" / "bin" / entry[0], *entry[1:]], cwd=place, env=environment, check=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), dict(word.split("=", 1) for word in sys.argv[3:]))
