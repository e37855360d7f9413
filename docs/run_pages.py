"""Pages as blocks, and one way to run them; also writes what the tutorials print into the tutorials.

    python docs/run_pages.py

A page runs in a folder of its own, block after block, as its reader would: Python in one namespace, commands as a shell
reads them. `rlftsim ...` is called in this process, anything else by bash.

* A block below the comment `<!-- not run: reason -->` is not run.
* A block with a title, ```python title="careful.py", is a file: it is saved, and run by whatever uses it.
* The entry points of a toml block are registered, as if the page were an installed package.
* A text block directly below a block that is run is what that block prints.
* A picture beside the page, ![...](goals.png), is one that its blocks write.
"""

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from rlftsim.cli.main import main as rlftsim
from rlftsim.verbs.plugins import POINTS

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("[1-9]*.md"))
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "plugin_template").glob("*.md")])
PAGES += [ROOT / "docs" / "tutorials" / "index.md", *TUTORIALS, *sorted((ROOT / "benchmarks").glob("*.md"))]
"""Pages that people write; docs/qualitative holds what a program prints."""
FENCE = re.compile(
    r"^(?:<!-- not run: (?P<reason>[^\n]+) -->\n)?"
    r'^```(?P<language>\w*)(?: title="(?P<title>[^"]+)")?\n(?P<text>.*?)^```$',
    re.DOTALL | re.MULTILINE,
)
PICTURE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)")
RUN = ("python", "sh")
LANGUAGES = (*RUN, "toml", "json", "text")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: Path
    line: int
    """Of the opening fence, counted from 1; its text begins in the next line."""
    language: str
    title: str | None
    """File that the block is saved as."""
    text: str
    reason: str | None
    """Why it is not run."""
    output: re.Match[str] | None = None
    """The text block directly below, as found in the page."""

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"

    @property
    def commands(self) -> list[str]:
        """Command lines of a shell block, without comments, continued lines joined."""
        lines = (line.strip() for line in self.text.replace("\\\n", " ").splitlines())
        return [line for line in lines if line and not line.startswith("#")]


def blocks_of(page: Path) -> list[Block]:
    """All fenced blocks of a page, the outputs of others left out."""
    text = page.read_text()
    found: list[Block] = []
    end = -1
    for match in FENCE.finditer(text):
        is_output = match["language"] == "text" and found and text[end : match.start()] == "\n\n"
        end = match.end()
        if is_output and found[-1].language in RUN:
            found[-1] = Block(**{**vars(found[-1]), "output": match})
            continue
        line = text.count("\n", 0, match.start("text"))
        found.append(Block(page, line, match["language"], match["title"], match["text"], match["reason"]))
    return found


class PageRun:
    """A page that is run in the current folder, which is on the module path.

    Args:
        page: Markdown.
        names: names that its Python takes for granted.
    """

    def __init__(self, page: Path, names: dict[str, Any] | None = None):
        self.namespace: dict[str, Any] = {"__name__": page.stem, **(names or {})}
        self.tables: list[Block] = []

    def run(self, block: Block) -> str:
        """Run a block; errors point to lines of the page. Returns what it prints."""
        if block.title is not None:
            Path(block.title).write_text(block.text)
        elif block.language == "toml":
            self.tables.append(block)
        elif block.reason is None and block.language in RUN:
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                if block.language == "python":
                    exec(compile("\n" * block.line + block.text, str(block.page), "exec"), self.namespace)
                else:
                    self._announce()
                    for command in block.commands:
                        run_command(command, block)
            return printed.getvalue()
        return ""

    def _announce(self) -> None:
        """Register the entry points of the tables so far."""
        for block in self.tables:
            for group, entries in tomllib.loads(block.text).get("project", {}).get("entry-points", {}).items():
                module, _, attribute = POINTS[group].partition(":")
                point = getattr(import_module(module), attribute)
                for name, place in entries.items():
                    thing = self.namespace.get(place.partition(":")[2])
                    if thing is not None and point.find(name) is None:
                        point.register(name)(thing)


def run_command(command: str, block: Block) -> None:
    """Run a command line, and print what it prints.

    Raises:
        RuntimeError: its status is not 0.
    """
    if command.startswith("rlftsim "):
        status = rlftsim([os.path.expandvars(word) for word in shlex.split(command, comments=True)][1:])
    else:
        environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
        done = subprocess.run(["bash", "-c", command], env=environment, stdout=subprocess.PIPE, text=True)
        print(done.stdout, end="")
        status = done.returncode
    if status:
        raise RuntimeError(f"{block}: status {status} of {command}")


def pictures_of(page: Path) -> list[str]:
    """Names of the pictures of a page that lie beside it; its blocks write them, somewhere below their folder."""
    return [name for name in PICTURE.findall(page.read_text()) if "/" not in name]


def with_outputs(page: Path) -> str:
    """Text of a page with what its blocks print; commands whose output is not shown are not run.

    Its pictures are copied to its folder.
    """
    text, outputs = page.read_text(), []
    run = PageRun(page)
    for block in blocks_of(page):
        if block.language == "python" or block.output is not None:
            outputs.append((block.output, run.run(block)))
    for match, printed in reversed(outputs):
        if match is not None:
            text = text[: match.start("text")] + printed + text[match.end("text") :]
        elif printed:
            raise RuntimeError(f"{page.name} prints something and has no text block for it: {printed}")
    for name in pictures_of(page):
        shutil.copyfile(next(Path().rglob(name)), page.parent / name)
    return text


if __name__ == "__main__":
    for page in TUTORIALS:
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            page.write_text(with_outputs(page))
