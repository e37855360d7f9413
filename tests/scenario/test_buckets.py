"""Data sets and sources in buckets, against moto's server: a real HTTP end point on this machine."""

import json
import os
import urllib.request

import numpy as np
import pytest

import rlftsim as rs
from full_disk import limit_files_to
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError, DataError, NotYetError
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
from rlftsim.jobs import buckets
from rlftsim.jobs.buckets import fetch_shard, remote_lease
from rlftsim.jobs.folder import Lease
from rlftsim.jobs.runner import Inline, Share, Unfinished
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.scenario.convert import convert
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.scenario.transfer import pull_dataset, push_dataset


@pytest.fixture(scope="module")
def server():
    """An empty S3 on a free port."""
    moto = pytest.importorskip("moto.server", reason="moto is not installed: pip install 'moto[server]'")
    pytest.importorskip("s3fs", reason='s3fs is not installed: pip install "rlftsim[s3]"')
    server = moto.ThreadedMotoServer("127.0.0.1", port=0)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def bucket(server, tmp_path, monkeypatch):
    """Address of an empty bucket; the cache is empty, too."""
    import s3fs

    for name, value in {
        "AWS_ENDPOINT_URL": server, "AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b",
        "AWS_DEFAULT_REGION": "us-east-1", "RLFTSIM_CACHE": str(tmp_path / "cache"),
    }.items():  # fmt: skip
        monkeypatch.setenv(name, value)
    request = urllib.request.Request(f"{server}/moto-api/reset", method="POST")
    urllib.request.urlopen(request).close()
    s3fs.S3FileSystem.clear_instance_cache()
    s3fs.S3FileSystem().mkdir("bucket")
    return "s3://bucket"


@pytest.fixture
def source(tmp_path, make_message, make_tfrecord):
    for number in range(3):
        messages = [make_message(f"{number}-{k}") for k in range(2)]
        make_tfrecord(tmp_path / "womd" / "training" / f"training.tfrecord-{number:05d}-of-00003", *messages)
    return tmp_path / "womd"


@pytest.fixture
def data(source, tmp_path):
    convert(source, tmp_path / "data", jobs=1, show_progress=False)
    return tmp_path / "data"


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def fetched(monkeypatch):
    """Addresses of the files that are fetched, in turn."""
    names, fetch = [], buckets.fetch

    def count(url, path, sha256=None):
        names.append(url.partition("bucket/")[2])
        return fetch(url, path, sha256)

    monkeypatch.setattr(buckets, "fetch", count)
    return names


def test_a_data_set_comes_back_from_a_bucket_as_it_was(bucket, data, tmp_path, capsys):
    assert main(["data", "push", str(data), f"{bucket}/set/"]) == 0
    assert main(["data", "pull", f"{bucket}/set", str(tmp_path / "back")]) == 0
    assert contents(tmp_path / "back") == contents(data)
    assert main(["data", "verify", f"{bucket}/set"]) == 2
    assert "copy it with `rlftsim data pull` first" in capsys.readouterr().err


def test_an_evaluation_from_a_bucket_is_that_of_the_folder_and_fetches_each_shard_once(bucket, tmp_path, fetched):
    pack = ScenarioDataset("synthetic", "validation")
    write_dataset(list(pack[:3]), tmp_path / "data", split="validation")
    push_dataset(tmp_path / "data", f"{bucket}/set", show_progress=False)
    del fetched[:]
    config = EvaluateConfig(num_rollouts=2)
    for _ in range(2):  # a second process of the machine finds the shards in the cache
        remote = evaluate(ConstantVelocity(), f"{bucket}/set", None, config, show_progress=False)
    assert fetched == ["set/manifest.json", "set/index.parquet", "set/shards/00000.arrow", "set/manifest.json"]
    local = evaluate(ConstantVelocity(), tmp_path / "data", None, config, show_progress=False)
    assert remote.scenario_ids == local.scenario_ids
    np.testing.assert_array_equal(remote.values("meta_metric"), local.values("meta_metric"))
    assert remote.provenance.dataset == f"{bucket}/set"


def test_an_evaluation_from_a_bucket_is_shared_and_refuses_a_second_driver(bucket, tmp_path):
    write_dataset(list(ScenarioDataset("synthetic", "validation")[:6]), tmp_path / "data", split="validation")
    push_dataset(tmp_path / "data", f"{bucket}/set", show_progress=False)
    config, out = EvaluateConfig(num_rollouts=2), tmp_path / "out"

    def work(folder, runner=None):
        return evaluate(
            ConstantVelocity(), f"{bucket}/set", folder, config, name="a", runner=runner, show_progress=False
        )

    with pytest.raises(Unfinished, match="share 2/2 is done"):
        work(out, Share(2, 2, Inline()))
    other = Lease(out / "a.parts" / ".lock", Inline(), "works in")
    with other, pytest.raises(NotYetError, match="another process works in"):
        work(out)
    work(out, Share(1, 2, Inline()))
    work(tmp_path / "whole")
    assert contents(out) == contents(tmp_path / "whole")


def test_sources_in_a_bucket_are_converted_to_the_same_bytes(bucket, source, data, tmp_path):
    for path in source.rglob("*tfrecord*"):
        buckets.publish(path, f"{bucket}/womd/{path.relative_to(source).as_posix()}")
    for place in (f"{bucket}/womd", f"{bucket}/womd/training/*tfrecord*"):
        convert(place, tmp_path / "from_bucket", jobs=1, show_progress=False)
        assert contents(tmp_path / "from_bucket") == contents(data)
    with pytest.raises(DataError, match=r"s3://bucket/nothing: no \*tfrecord\* there"):
        convert(f"{bucket}/nothing", tmp_path / "other")


def cut_push(folder, url, monkeypatch):
    """A push that ends when all shards are there."""
    publish = buckets.publish

    def cut(path, url):
        if path.name == "index.parquet":
            raise DataError("cut")
        publish(path, url)

    with monkeypatch.context() as patch:
        patch.setattr("rlftsim.scenario.transfer.publish", cut)
        with pytest.raises(DataError, match="cut"):
            push_dataset(folder, url, show_progress=False)


def test_a_push_that_is_cut_short_leaves_no_data_set_and_goes_on(bucket, data, tmp_path, monkeypatch):
    url = f"{bucket}/set"
    cut_push(data, url, monkeypatch)
    with pytest.raises(DataError, match=r"s3://bucket/set/manifest\.json: there is no such file or bucket"):
        ScenarioDataset(url)
    push_dataset(data, url, show_progress=False)
    pushed = []
    monkeypatch.setattr("rlftsim.scenario.transfer.publish", lambda path, url: pushed.append(path.name))
    push_dataset(data, url, show_progress=False)
    assert pushed == ["index.parquet", "manifest.json"]  # the shards are there by the manifest


@pytest.mark.parametrize("kind", ["s3", "file"])
def test_two_pushes_to_one_place_do_not_mix_and_a_killed_one_is_taken_over(
    kind, data, tmp_path, monkeypatch, request, capsys
):
    monkeypatch.setenv("RLFTSIM_CACHE", str(tmp_path / "cache"))
    url = f"{request.getfixturevalue('bucket')}/set" if kind == "s3" else f"file://{tmp_path}/there"
    owner = (
        rf"another process is copying to {url} \(.* process {os.getpid()}, last heard of 0:00:0\d ago\): wait for it,"
    )
    with remote_lease(url) as renew:
        renew()
        with pytest.raises(NotYetError, match=owner + rf" or remove {url}/\.lease if it is gone"):
            push_dataset(data, url, show_progress=False)
    buckets.put_text(f"{url}/.lease", "gone process 1 since 2026-01-01T00:00:00+00:00\n", is_new=True)
    push_dataset(data, url, show_progress=False)
    assert f"{url}: taken over from gone process 1, silent for " in capsys.readouterr().err
    with pytest.raises(DataError, match="there is no such file"):
        buckets.get_text(f"{url}/.lease")
    pull_dataset(url, tmp_path / "back", show_progress=False)
    assert contents(tmp_path / "back") == contents(data)


def test_a_lease_that_was_cut_short_is_as_old_as_its_file(data, tmp_path):
    url, lease = f"file://{tmp_path}/there", tmp_path / "there" / ".lease"
    lease.parent.mkdir()
    lease.touch()
    with pytest.raises(NotYetError, match=r"\(unknown, last heard of 0:00:0\d ago\): wait for it"):
        push_dataset(data, url, show_progress=False)
    os.utime(lease, (1, 1))
    push_dataset(data, url, show_progress=False)
    assert not lease.exists()


def test_a_push_that_was_taken_over_leaves_the_new_owner_alone(tmp_path):
    url, other = f"file://{tmp_path}", "other process 1 since 2026-01-01T00:00:00+00:00\n"
    with remote_lease(url) as renew:
        buckets.put_text(f"{url}/.lease", other, is_new=False)
        with pytest.raises(NotYetError, match=f"other process 1 has taken over {url}"):
            renew()
    assert buckets.get_text(f"{url}/.lease") == other


def test_a_push_to_a_folder_leaves_whole_files_or_none(data, tmp_path, monkeypatch):
    monkeypatch.setenv("RLFTSIM_CACHE", str(tmp_path / "cache"))
    there, manifest = tmp_path / "there", "manifest.json"
    push_dataset(data, f"file://{there}", show_progress=False)
    before = contents(there)
    assert before == contents(data)
    size = (data / manifest).stat().st_size
    with (
        limit_files_to(size // 2),
        pytest.raises(DataError, match=r"^cannot write file://.* \(File too large\): make room there"),
    ):
        buckets.publish(data / manifest, f"file://{there}/{manifest}")
    with (
        limit_files_to(10),
        pytest.raises(DataError, match=r"^cannot write file://.*/\.lease \(File too large\): make room"),
    ):
        push_dataset(data, f"file://{there}", show_progress=False)
    assert contents(there) == before


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """A stand-in for the file system of Hugging Face."""
    from fsspec.implementations.memory import MemoryFileSystem
    from fsspec.registry import _registry

    class Hub(MemoryFileSystem):
        protocol = "hf"
        store, pseudo_dirs = {}, [""]

        @classmethod
        def _strip_protocol(cls, path):
            return super()._strip_protocol(path.removeprefix("hf://"))

    monkeypatch.setenv("RLFTSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setitem(_registry, "hf", Hub)
    return Hub()


def test_data_at_hugging_face_is_read_and_not_written(hub, data, source, tmp_path):
    url = "hf://datasets/lab/womd"
    for path in (data, source):
        hub.put(str(path), f"datasets/lab/{path.name}", recursive=True)
    assert ScenarioDataset("hf://datasets/lab/data").scenario_ids == ScenarioDataset(data).scenario_ids
    pull_dataset("hf://datasets/lab/data", tmp_path / "back", show_progress=False)
    assert contents(tmp_path / "back") == contents(data)
    convert(url, tmp_path / "converted", jobs=1, show_progress=False)
    assert contents(tmp_path / "converted") == contents(data)
    before = dict(hub.store)
    with pytest.raises(ConfigError, match=rf"^{url}: hf:// is read only here: upload the folder with that site's own"):
        push_dataset(data, url, show_progress=False)
    assert hub.store == before


def test_a_pull_that_is_cut_short_goes_on_and_disturbs_no_other_work(bucket, data, tmp_path, monkeypatch):
    url, back = f"{bucket}/set", tmp_path / "back"
    push_dataset(data, url, show_progress=False)
    fetched = []

    def cut(url, path, sha256):
        if fetched:
            raise DataError("cut")
        fetched.append(buckets.fetch(url, path, sha256))

    with monkeypatch.context() as patch:
        patch.setattr("rlftsim.scenario.transfer.fetch", cut)
        with pytest.raises(DataError, match="cut"):
            pull_dataset(url, back, show_progress=False)
    with pytest.raises(DataError, match="is not empty"):
        pull_dataset(f"{bucket}/other", back, show_progress=False)
    pull_dataset(url, back, show_progress=False)
    assert contents(back) == contents(data)

    converting = tmp_path / "converting"
    with Lease(converting / "INCOMPLETE", Inline(), "is converting to", "A conversion runs here"):
        with pytest.raises(DataError, match="is not empty"):
            pull_dataset(url, converting, show_progress=False)
        assert (converting / "INCOMPLETE").read_text().startswith("A conversion runs here")


def test_a_push_over_another_data_set_that_is_cut_short_leaves_none(bucket, data, source, tmp_path, monkeypatch):
    url = f"{bucket}/set"
    convert(source, tmp_path / "one", jobs=1, show_progress=False, split="validation")
    push_dataset(data, url, show_progress=False)
    cut_push(tmp_path / "one", url, monkeypatch)
    with pytest.raises(DataError, match="there is no such file or bucket"):
        ScenarioDataset(url)
    push_dataset(data, url, show_progress=False)
    pull_dataset(url, tmp_path / "again", show_progress=False)
    assert contents(tmp_path / "again") == contents(data)


def test_a_shard_that_was_replaced_in_the_bucket_is_refused(bucket, data, tmp_path):
    push_dataset(data, f"{bucket}/set", show_progress=False)
    entry = json.loads((data / "manifest.json").read_text())["shards"][0]["file"]
    (tmp_path / "other").write_bytes(b"other")
    buckets.publish(tmp_path / "other", f"{bucket}/set/{entry}")
    with pytest.raises(DataError, match="damaged or replaced: its checksum is not that of the manifest"):
        ScenarioDataset(f"{bucket}/set")[0]
    assert not list((tmp_path / "cache").rglob("*.tmp"))


def test_the_cache_keeps_what_was_used_last(tmp_path, monkeypatch):
    monkeypatch.setenv("RLFTSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("RLFTSIM_CACHE_GB", "0.0000021")  # 2100 bytes
    shas = {}
    for number in range(3):
        (tmp_path / str(number)).write_bytes(bytes([number]) * 1000)
        shas[number] = buckets.fetch(f"file://{tmp_path}/{number}", tmp_path / "any")
    kept = {}
    for age, number in enumerate((0, 1, 0, 2)):
        path = fetch_shard(f"file://{tmp_path}/{number}", shas[number])
        os.utime(path, (age, age))
        kept[number] = path
    assert [number for number, path in sorted(kept.items()) if path.exists()] == [0, 2]


def test_the_cache_gets_rid_of_what_killed_processes_left(tmp_path, monkeypatch):
    monkeypatch.setenv("RLFTSIM_CACHE", str(tmp_path / "cache"))
    (tmp_path / "file").write_bytes(b"shard")
    sha = buckets.fetch(f"file://{tmp_path}/file", tmp_path / "any")
    shards = tmp_path / "cache" / "shards"
    shards.mkdir(parents=True)
    same, old, recent = (shards / f".{name}.machine.12.tmp" for name in (sha, "old", "recent"))
    for path in (same, old, recent):
        path.touch()
    os.utime(old, (0, 0))
    fetch_shard(f"file://{tmp_path}/file", sha)
    assert [path.exists() for path in (same, old, recent)] == [False, False, True]


def test_addresses_that_cannot_be_read_are_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("RLFTSIM_CACHE", str(tmp_path / "cache"))
    with pytest.raises(DataError, match=r"^file:///nowhere/manifest\.json: there is no such file or bucket: check the"):
        ScenarioDataset("file:///nowhere")
    with pytest.raises(DataError, match=r"^nonsense://x/manifest\.json: .*nonsense"):
        ScenarioDataset("nonsense://x")

    for url in ("file://", "s3://", "s3:///", "/a/path"):
        with pytest.raises(ConfigError, match="is no address of a folder"):
            pull_dataset(url, tmp_path / "x")
    assert not (tmp_path / "x").exists()
    config = EvaluateConfig(num_rollouts=2, limit=1)
    for make in (
        lambda: convert(tmp_path, "s3://b/x"),
        lambda: evaluate(ConstantVelocity(), "synthetic", "s3://b/x", config),
        lambda: rs.evaluate("constant_velocity", "synthetic", out="s3://b/x", num_rollouts=2, limit=1),
        lambda: write_dataset([], "s3://b/x"),
    ):
        with pytest.raises(ConfigError, match=r"^s3://b/x is an address: name a folder of this machine here"):
            make()

    def missing(url):
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr("fsspec.core.url_to_fs", missing)
    for protocol in ("s3", "hf"):
        hint = rf'{protocol}:// needs another library: pip install "rlftsim\[{protocol}\]"'
        with pytest.raises(ConfigError, match=hint):
            ScenarioDataset(f"{protocol}://x")


@pytest.mark.parametrize("credentials", ["wrong", "none"])
def test_a_bucket_that_refuses_is_explained_with_a_way_out(bucket, data, tmp_path, monkeypatch, credentials, capsys):
    import s3fs

    with pytest.raises(DataError, match=r"^s3://other/.*: there is no such file or bucket: check the address"):
        push_dataset(data, "s3://other/set", show_progress=False)
    if credentials == "none":
        monkeypatch.delenv("AWS_ACCESS_KEY_ID")
        monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
        monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
        monkeypatch.setenv("HOME", str(tmp_path))
    else:

        def refuse(*arguments, **more):
            raise PermissionError("Forbidden")

        monkeypatch.setattr(s3fs.S3FileSystem, "_get_file", refuse)
        monkeypatch.setattr(s3fs.S3FileSystem, "open", refuse)
    s3fs.S3FileSystem.clear_instance_cache()
    assert main(["data", "pull", f"{bucket}/set", str(tmp_path / "back")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "check the address, the network and the credentials of this machine" in said


@pytest.mark.parametrize("name", ["womd", "a [1]? b%20"])
def test_sources_at_a_file_address_are_converted_to_the_same_bytes(source, data, tmp_path, name):
    place = source.rename(tmp_path / name)
    convert(f"file://{place}", tmp_path / "converted", jobs=1, show_progress=False)
    assert contents(tmp_path / "converted") == contents(data)


def test_a_full_disk_is_not_blamed_on_the_bucket(tmp_path):
    (tmp_path / "source").write_bytes(bytes(100_000))
    with limit_files_to(20_000), pytest.raises(DataError, match=r"cannot write .*copy .*: make room or choose another"):
        buckets.fetch(f"file://{tmp_path}/source", tmp_path / "copy")
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


def test_a_cache_that_cannot_be_written_to_is_named_with_a_way_out(data, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("RLFTSIM_CACHE", str(tmp_path / "file"))
    with pytest.raises(DataError, match="file is a file, not a folder: choose another place"):
        pull_dataset(f"file://{data}", tmp_path / "back")


def test_a_pull_removes_what_a_killed_one_was_fetching(data, tmp_path, monkeypatch):
    monkeypatch.setenv("RLFTSIM_CACHE", str(tmp_path / "cache"))
    with monkeypatch.context() as patch:
        patch.setattr("rlftsim.scenario.transfer.fetch", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            pull_dataset(f"file://{data}", tmp_path / "back")
    (tmp_path / "back" / ".index.parquet.machine.12.tmp").touch()
    (tmp_path / "back" / "INCOMPLETE").write_bytes(b"")  # killed while it marked the folder
    pull_dataset(f"file://{data}", tmp_path / "back", show_progress=False)
    assert contents(tmp_path / "back") == contents(data)
