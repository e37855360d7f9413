"""Damaged and hostile files of every format end as a result or as one line; no reader can be forgotten.

The long run is benchmarks/mutants.py.
"""

import ast
import json
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "rlftsim"
BENCHMARK = ROOT / "benchmarks" / "mutants.py"
MUTANTS = 1
"""Of each family; the hostile inputs come besides."""
READS = {
    "read_bytes", "read_text", "read_table", "read_schema", "read_metadata", "ParquetFile", "memory_map", "open_file",
    "open_stream", "safe_open", "load_file", "is_zipfile", "ZipFile", "FromString", "ParseFromString",
    "read_json", "parse_json", "read_toml", "read_tensors", "read_npz", "read_parquet",
    "read_parquet_metadata", "map_arrow", "find_differences",
}  # fmt: skip
"""Calls that open a file or parse its bytes, by their last name."""
PARSERS = {"json", "tomllib", "np", "numpy", "torch", "pickle", "tarfile"}
"""Modules whose `load`, `loads` and `open` do."""
NO_FORMAT = {
    "jobs.files": "copies and appends bytes that it does not look at",
    "jobs.ray": "bytes of this program's own processes",
    "jobs.arrays": "for modules that know the format",
    "jobs.documents": "for modules that know the format",
    "jobs.folder": "for modules that know the format, and the text of a lock, damaged or not",
    "jobs.tables": "for modules that know the format",
    "policies.shipped.__init__": "weights in the box",
    "scenario.synthetic.bodies": "what SUMO has just written",
    "scenario.synthetic.windows": "what SUMO has just written",
    "scenario.synthetic.rerun": "a process of its own: what `worlds` has read before, and poses from this program",
    "envs.sumo_traffic": "bytes of this program's own processes",
    "evaluation.explain_page": "whether a page that it moves has an end",
    "evaluation.report": "a picture of this program, which it does not look at",
    "experiments.tables": "the paper's tables in the box",
    "jobs.buckets": "copies bytes that it does not look at",
    "studio.server": "the page in the box",
    "training.parallel": "bytes of this program's own processes",
    "viewer.page": "the page in the box",
    "jobs.processes": "code that the user runs anyway, and bytes of this program's own processes",
    "jobs.runner": "the machine's quota",
    "verbs.forecast": "the machine's limit of memory",
}
"""Modules that open files, and why they are none of the table of formats."""


@lru_cache
def _formats() -> dict[str, list[str]]:
    """Modules that read each format."""
    listed = subprocess.run([sys.executable, BENCHMARK, "--list"], check=True, capture_output=True, text=True).stdout
    return json.loads(listed)


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """Faults and counts by format; of a process without run-time type checks, as users have."""
    path = tmp_path_factory.mktemp("mutants") / "outcomes.json"
    words = ["--mutants", str(MUTANTS), "--seed", "1", "--json", str(path)]
    done = subprocess.run([sys.executable, str(BENCHMARK), *words], capture_output=True, text=True)
    assert path.exists(), done.stderr[-3000:]
    return json.loads(path.read_text())


def names_of_formats():
    """Keys of the table of formats, read from its source: importing it takes seconds."""
    tree = ast.parse((ROOT / "tests" / "mutated_formats.py").read_text())
    table = next(node for node in tree.body if isinstance(node, ast.AnnAssign) and node.target.id == "FORMATS")
    return [key.value for key in table.value.keys]


@pytest.mark.slow
@pytest.mark.parametrize("name", names_of_formats())
def test_a_damaged_file_ends_as_a_result_or_as_one_line(outcomes, name):
    faults, counts = outcomes[name]["faults"], outcomes[name]["counts"]
    assert not faults, "\n".join(faults)
    assert sum(counts.values()) > 2 * MUTANTS


def test_a_mutant_is_the_same_for_the_same_seed_and_never_the_file_itself():
    data = json.dumps({"a": [1, 2, {"b": "text"}], "c": None}).encode()
    from mutants import mutate_bytes, mutate_meaning

    for mutate in (mutate_bytes, lambda one, seed: mutate_meaning(one, "json", seed)):
        mutants = [mutate(data, seed) for seed in range(60)]
        assert mutants == [mutate(data, seed) for seed in range(60)]
        assert len({*mutants}) > 40
        assert sum(one == data for one in mutants) < 6


def _reads(node: ast.AST) -> bool:
    """True for a call that opens a file to read it, or parses bytes."""
    if not isinstance(node, ast.Call):
        return False
    called = node.func
    name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
    if name in READS:
        return True
    if name in ("load", "loads", "open") and getattr(getattr(called, "value", None), "id", "") in PARSERS:
        return True
    if name == "load" and isinstance(called, ast.Name):  # of safetensors
        return True
    words = [word.value for word in (*node.args, *(k.value for k in node.keywords)) if isinstance(word, ast.Constant)]
    modes = [word for word in words if isinstance(word, str) and set(word) <= set("rwaxbt+")]
    return name == "open" and all("r" in mode or "+" in mode for mode in modes)


def test_whatever_opens_a_file_is_in_the_table_of_formats():
    opening = {
        ".".join(path.relative_to(SOURCE).with_suffix("").parts)
        for path in SOURCE.rglob("*.py")
        if any(_reads(node) for node in ast.walk(ast.parse(path.read_text())))
    }
    formats = {module for modules in _formats().values() for module in modules}
    forgotten = opening - formats - NO_FORMAT.keys()
    assert not forgotten, f"they read files: add formats to tests/mutated_formats.py ({', '.join(sorted(forgotten))})"
    gone = (formats | NO_FORMAT.keys()) - opening
    assert not gone, f"they open no file any more: take them out ({', '.join(sorted(gone))})"
