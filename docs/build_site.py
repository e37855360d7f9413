"""Build the site: pages of docs/, benchmarks/ and the root go to build/pages, from there to build/site.

    python docs/build_site.py                      # with Zensical
    python docs/build_site.py --builder mkdocs
    REPOSITORY=https://... python docs/build_site.py

Pages of the repository link to each other as files. Here links to pages become links of the site; links to other files
lead to the commit in REPOSITORY, and are plain text where that is not set. The reference, docs/reference in links, is
written now.
"""

import argparse
import os
import posixpath
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jupytext
import nbformat
import write_reference
from run_pages import RUN, blocks_of

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "build" / "pages"
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\((?!\w+:)([^)\s#]*)(#[^)\s]*)?\)")
FENCE = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)
ELSEWHERE = {"CHANGELOG.md": "changes.md", "CONTRIBUTING.md": "contributing.md", "README.md": "index.md"}
"""Files of the root that are pages; the README's place is the home page."""
NO_PAGES = (".py", ".toml")
DOWNLOADS = "_to_tables.py"
"""End of the names of scripts that readers take from the site."""
REFERENCE = "docs/reference/"
"""Where links look for the reference, which is no file of the repository; the builder finds dead ones."""
LAST_IN_SEARCH = "---\nsearch:\n  boost: 0.1\n---\n"
"""Front matter of measurements and of the log, which have every word often."""
TEMPLATE = ROOT / "docs" / "plugin_template"
SHIM = "https://unpkg.com/iframe-worker/shim"
"""Script of another host that the builders name in every page; docs/assets has one of our own in its place."""


def place_of(path: str) -> str | None:
    """Page of the site that a file of the repository becomes; None = none.

    Args:
        path: relative to the root, with slashes.
    """
    if path.startswith("docs/") and (path.endswith(DOWNLOADS) or not path.endswith(NO_PAGES)):
        return path.removeprefix("docs/")
    if path.startswith("benchmarks/") and not path.endswith(NO_PAGES):
        return f"results/{path.removeprefix('benchmarks/')}"
    return ELSEWHERE.get(path)


def relinked(text: str, source: str, base: str | None) -> str:
    """A page with its links rewritten for the site.

    Args:
        text: Markdown.
        source: path of the page in the repository.
        base: address of the repository at the built commit; None = links to files that are no pages become text.

    Raises:
        SystemExit: a link to a file that the repository does not have.
    """
    own = place_of(source) or source

    def rewrite(match: re.Match[str]) -> str:
        mark, words, path, anchor = match[1], match[2], match[3], match[4] or ""
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), path)) if path else source
        place = place_of(target)
        if place is not None and (target.startswith(REFERENCE) or (ROOT / target).is_file()):
            relative = posixpath.relpath(place, posixpath.dirname(own) or ".") if path else ""
            return f"{mark}[{words}]({relative}{anchor})"
        if not (ROOT / target).exists():
            raise SystemExit(f"{source}: dead link to {path}: there is no {target}.")
        return f"[{words}]({base}/{target}{anchor})" if base else words

    # Brackets in code are no links.
    return "".join(part if part.startswith("```") else LINK.sub(rewrite, part) for part in FENCE.split(text))


def notebook_of(page: Path, base: str | None) -> nbformat.NotebookNode:
    """A tutorial as a notebook; what the page shows below a block is the output of its cell.

    Args:
        page: Markdown below docs.
        base: as in `relinked`.
    """
    text, blocks = page.read_text(), [block for block in blocks_of(page) if block.language in RUN]
    for block in reversed(blocks):
        if block.output is not None:
            text = text[: block.output.start()].rstrip() + text[block.output.end() :]
    text = relinked(text, page.relative_to(ROOT).as_posix(), base)
    notebook = jupytext.reads(text, fmt="md", as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for cell, block in zip(cells, blocks, strict=True):
        if block.output is not None:
            cell.outputs = [nbformat.v4.new_output("stream", name="stdout", text=block.output["text"])]
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return notebook


def template_files() -> str:
    """The files of the plug-in template, for its page: the site alone is enough to copy them."""
    files = sorted(path for path in TEMPLATE.rglob("*") if path.suffix in NO_PAGES)
    return "".join(
        f'\n```{"toml" if path.suffix == ".toml" else "python"} title="{path.relative_to(TEMPLATE).as_posix()}"\n'
        f"{path.read_text()}```\n"
        for path in files
    )


def stage() -> None:
    """Fill build/pages anew."""
    shutil.rmtree(PAGES, ignore_errors=True)
    repository, base = os.environ.get("REPOSITORY"), None
    if repository:
        commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
        base = f"{repository}/blob/{commit.stdout.strip()}"
    sources = [*(ROOT / "docs").rglob("*"), *(ROOT / "benchmarks").rglob("*"), ROOT / "CHANGELOG.md"]
    for path in (*sources, ROOT / "CONTRIBUTING.md"):
        name = path.relative_to(ROOT).as_posix()
        place = place_of(name)
        if path.is_dir() or place is None or "__pycache__" in name:
            continue
        target = PAGES / place
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".md":
            text = relinked(path.read_text(), name, base)
            text += template_files() if path.parent == TEMPLATE else ""
            if place.startswith("tutorials/") and path.name != "index.md":
                nbformat.write(notebook_of(path, base), target.with_suffix(".ipynb"))
                text += f"\n[This page as a notebook]({path.stem}.ipynb)\n"
            target.write_text(LAST_IN_SEARCH + text if place.startswith("results/") or place == "log.md" else text)
        else:
            shutil.copyfile(path, target)
    write_reference.write_pages(PAGES / "reference")


def build(builder: str) -> Path:
    """Build the staged pages. Returns the folder of the site.

    Args:
        builder: "zensical", to build/site, or "mkdocs", to build/mkdocs.

    Raises:
        SystemExit: a dead link, or anything else that the builder's strict mode refuses.
    """
    # Zensical takes the folder from the file alone.
    out = ROOT / "build" / ("site" if builder == "zensical" else builder)
    command = [sys.executable, "-m", builder, "build", "--strict"]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "DISABLE_MKDOCS_2_WARNING": "true"}
    if builder == "mkdocs":
        command += ["--quiet", "--site-dir", str(out)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(re.sub(r"\x1b\[[0-9;]*m", "", done.stdout + done.stderr))
    for page in out.rglob("*.html"):
        up = "../" * (len(page.relative_to(out).parts) - 1)
        text = page.read_text()
        if SHIM in text:
            page.write_text(text.replace(SHIM, f"{up}assets/iframe-worker.js"))
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--builder", choices=("zensical", "mkdocs"), default="zensical")
    builder = parser.parse_args().builder
    stage()
    print(build(builder) / "index.html")
