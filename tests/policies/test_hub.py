"""Models go to Hugging Face and come back with the same bits; a stand-in on this machine answers."""

import contextlib
import multiprocessing
import os
import re
import sys

import pytest

import hub_server
import rlftsim as rs
import scenes
import tiny
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError
from rlftsim.evaluation.hub_card import write_hub_card
from rlftsim.evaluation.results import Evaluation
from rlftsim.policies.checkpoint import read_card
from rlftsim.policies.hub import is_hub_url, pin_model
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.scenario.womd import WomdSource

OWN = "# Model\n\n* trained on 3 scenarios of mine\n* terms of the data: my own recordings\n"
WAYMO = f"# Model\n\n* trained on 3 scenarios of womd\n* terms of the data: {WomdSource.license_note}\n"


@pytest.fixture
def hub():
    with hub_server.serve() as server:
        yield server


@pytest.fixture
def vocabulary():
    return tiny.small_vocabulary([scenes.straight_road(), scenes.junction_with_light()])


@pytest.fixture
def model(tmp_path, vocabulary):
    policy = tiny.tiny_policy(vocabulary)
    policy.save_pretrained(tmp_path / "model", card=OWN)
    (tmp_path / "model" / "notes.pkl").write_bytes(b"never uploaded")
    return tmp_path / "model"


def run_command(words, environment, printed):
    for name in [name for name in sys.modules if name.partition(".")[0] == "huggingface_hub"]:
        del sys.modules[name]
    os.environ.update(environment)
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = main([*map(str, words)])
    printed.flush()
    sys.exit(status)


@pytest.fixture
def run(hub, tmp_path):
    """A command in a forked process, where the library is imported anew: it reads its settings at that moment."""
    pytest.importorskip("huggingface_hub", reason="huggingface_hub is not installed")

    def call(*words, token=hub_server.TOKEN, status=0):
        environment = {
            "HF_ENDPOINT": hub.url, "HF_HOME": str(tmp_path / "home"), "HF_TOKEN": token,
            "HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_TELEMETRY": "1", "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        }  # fmt: skip
        with open(tmp_path / "printed.txt", "w+") as printed:
            child = multiprocessing.get_context("fork").Process(target=run_command, args=(words, environment, printed))
            child.start()
            child.join(300)
            printed.seek(0)
            text = printed.read()
        assert child.exitcode == status, text
        assert "Traceback" not in text
        return text

    return call


@pytest.mark.slow
def test_a_model_goes_up_and_comes_back_with_the_same_bits_also_without_a_network(hub, run, model, tmp_path):
    data = tmp_path / "data"
    rs.write_dataset([scenes.straight_road("v1")], data, split="validation")
    words = ("--data", data, "--out", tmp_path / "out", "--num-rollouts", 2, "--device", "cpu")
    run("evaluate", model, *words, "--name", "here")
    scores = ("--evaluation", tmp_path / "out" / "here.parquet")
    printed = run("model", "push", model, "hf://me/traffic", "--license", "cc-by-4.0", *scores)
    url = f"hf://me/traffic@{hub.head}"
    assert f"{url}: 4 files" in printed
    assert sorted(hub.commits[hub.head]) == ["README.md", "config.json", "model.safetensors", "vocabulary.safetensors"]
    card = hub.commits[hub.head]["README.md"].decode()
    assert card.startswith(
        '---\nlicense: "cc-by-4.0"\nlibrary_name: "rlftsim"\ntags: ["traffic-simulation"]\nmodel-index'
    )
    assert re.search(r'"type": "meta_metric", "value": 0\.\d+, "name": "RMM, 95 % interval \[', card)
    assert OWN in card
    # evaluated under a name with the commit, with equal results
    run("evaluate", "hf://me/traffic", *words)
    here, there = (tmp_path / "out" / name for name in ("here.parquet", f"traffic@{hub.head}.parquet"))
    evaluations = [Evaluation.read(path) for path in (here, there)]
    assert repr(evaluations[0].table.to_pylist()) == repr(evaluations[1].table.to_pylist())
    assert evaluations[0].provenance.policy_fingerprint == evaluations[1].provenance.policy_fingerprint
    # the same commit after a later one, and with the hub gone
    hub.add_commit({**hub.commits[hub.head], "README.md": b"changed"})
    hub.shutdown()
    hub.server_close()
    run("simulate", url, "--data", data, "--out", tmp_path / "rollouts", "--num-rollouts", 2)
    assert "Model" in run("model", "show", url)


@pytest.mark.slow
def test_what_the_hub_refuses_is_one_line(hub, run, model, tmp_path):
    def last_line(text):
        (line,) = [line for line in text.splitlines() if line.startswith("rlftsim: ")]
        return line

    push = ("model", "push", model, "hf://me/traffic", "--license", "cc-by-4.0")
    assert "401" in last_line(run(*push, token="hf_wrong", status=2))
    hub.exists = True  # the repository is there already
    run(*push)
    assert "RevisionNotFound" in last_line(run("model", "show", "hf://me/traffic@v9", status=2))
    assert "NotFound" in last_line(run("model", "show", "hf://me/elsewhere", status=2))
    hub.is_cut = True
    assert "hf://me/traffic" in last_line(run("model", "show", "hf://me/traffic", status=2))
    hub.is_cut = False
    assert "SmartPolicy" in run("model", "show", "hf://me/traffic")
    hub.add_commit({"README.md": b"theirs", "pytorch_model.bin": b"\x80\x02", "config.json": b"{}"})
    assert "pickles such as .pkl, .ckpt and .bin are never loaded" in last_line(
        run("model", "show", "hf://me/traffic", status=2)
    )
    hub.add_commit({"model.safetensors": b"12345678", "config.json": b'{"model_type": "bert"}'})
    assert "names no architecture" in last_line(run("model", "show", "hf://me/traffic", status=2))


def test_addresses_are_checked_and_the_extra_is_named(monkeypatch):
    assert is_hub_url("hf://me/traffic")
    assert not is_hub_url("me/traffic")
    assert pin_model("runs/tuned") == "runs/tuned"
    for url in ("hf://traffic", "hf://me/", "hf://a/b/c"):
        with pytest.raises(ConfigError, match=r"is no address of a model: write hf://USER/NAME"):
            rs.load_policy(url)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ConfigError, match=r'hf:// needs another library: pip install "rlftsim\[hf\]"'):
        rs.load_policy("hf://me/traffic")


@pytest.mark.parametrize(
    ("card", "license", "i_comply", "cause"),
    [
        (
            "# Model\n\n* trained on 3 scenarios of a list\n",
            "mit",
            True,
            "names no terms of some of the data",
        ),
        (f"{OWN}## Made from runs/a\n\n### Model\n\n* trained on 3 more\n", "mit", True, "names no terms of some"),
        (OWN, None, False, r"add --license, such as cc-by-4.0, in keeping with: .*my own recordings"),
        (WAYMO, None, False, "non-commercial use alone, .* add --i-comply"),
        (f"{OWN}## Made from runs/a\n\n{WAYMO}", "mit", False, "add --i-comply"),
        (WAYMO, "mit", True, "--license mit contradicts the terms of the data, other"),
        (OWN.replace("my own", "CC BY-NC-SA 4.0"), "mit", False, "contradicts the terms of the data, cc-by-nc-sa-4.0"),
    ],
)
def test_a_license_follows_from_all_data_that_the_weights_have_seen(card, license, i_comply, cause):
    with pytest.raises(ConfigError, match=cause):
        write_hub_card("hf://me/traffic", card, license, i_comply=i_comply)


def test_weights_of_waymos_data_carry_its_license():
    text = write_hub_card("hf://me/traffic", WAYMO, i_comply=True)
    assert text.startswith('---\nlicense: "other"\nlicense_name: "waymo-open-dataset-non-commercial"\nlicense_link: ')


def test_a_model_in_the_box_has_terms_and_the_header_is_no_part_of_a_card(model):
    shipped = read_card("demo-base", heading_shift=0)
    text = write_hub_card("hf://me/traffic", f"{OWN}## Made from demo-base\n\n{shipped}", "cc0-1.0")
    (model / "README.md").write_text(text)
    assert read_card(model, heading_shift=0).startswith("# Model\n\n* trained on 3 scenarios of mine")


def test_an_evaluation_of_other_weights_is_refused(model, vocabulary, tmp_path):
    other = tiny.tiny_policy(vocabulary, seed=9)
    result = rs.evaluate(other, [scenes.straight_road("v1")], num_rollouts=2)
    result.write(tmp_path / "other.parquet")
    assert result.provenance.policy_fingerprint == fingerprint_policy(other)
    words = ["model", "push", str(model), "hf://me/traffic", "--license", "mit"]
    assert main([*words, "--evaluation", str(tmp_path / "other.parquet")]) == 2
