"""Archives in pieces, read by other programs."""

import gzip
import io
import os
import subprocess
import tarfile
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlftsim.errors import DataError
from rlftsim.evaluation.wire_format import iterate_fields
from rlftsim.submission.archive import GzipReader, combine_crc32, count_joined, join_shards, pack_shard


@given(st.binary(max_size=300), st.binary(max_size=300))
def test_checksums_combine(first, second):
    assert combine_crc32(zlib.crc32(first), zlib.crc32(second), len(second)) == zlib.crc32(first + second)


@pytest.fixture
def contents():
    """Files of awkward sizes: empty, a whole block, more than a chunk."""
    return {"a": b"", "b": bytes(512), "c": os.urandom(300_001), "d": b"text" * 999}


def make_pieces(folder, contents):
    pieces = []
    for name, data in contents.items():
        (folder / "raw").write_bytes(data)
        pieces.append(pack_shard(folder / "raw", name, folder / f"{name}.part"))
    (folder / "raw").unlink()
    return pieces


def test_every_program_reads_the_whole_archive(contents, tmp_path):
    archive = tmp_path / "a.tar.gz"
    join_shards(archive, tmp_path, make_pieces(tmp_path, contents), delete=False)
    for mode in ("r:gz", "r|gz"):
        with tarfile.open(archive, mode) as tar:
            assert {member.name: tar.extractfile(member).read() for member in tar} == contents
    subprocess.run(["gzip", "-t", archive], check=True)
    (tmp_path / "out").mkdir()
    subprocess.run(["tar", "xzf", archive, "-C", tmp_path / "out"], check=True)
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == contents
    with archive.open("rb") as file:
        reader = GzipReader(file)
        assert reader.read(1 << 30) == gzip.decompress(archive.read_bytes())
        reader.finish()


def test_a_stopped_join_goes_on_without_the_pieces_that_are_gone(contents, tmp_path):
    pieces = make_pieces(tmp_path, contents)
    whole, archive = tmp_path / "whole.tar.gz", tmp_path / "a.tar.gz"
    join_shards(whole, tmp_path, pieces, delete=False)
    # as after a kill in the middle of the third piece: two are deleted, a part of the third is written
    joined = 10 + pieces[0].size + pieces[1].size
    (tmp_path / ".a.tar.gz.partial").write_bytes(whole.read_bytes()[: joined + 777])
    for name in ("a", "b"):
        (tmp_path / f"{name}.part").unlink()
    join_shards(archive, tmp_path, pieces, delete=True)
    assert archive.read_bytes() == whole.read_bytes()
    assert not list(tmp_path.glob("*.part"))


def test_pieces_before_a_damaged_one_stay_joined(contents, tmp_path):
    pieces = make_pieces(tmp_path, contents)
    whole, archive = tmp_path / "whole.tar.gz", tmp_path / "a.tar.gz"
    join_shards(whole, tmp_path, pieces, delete=False)
    third = (tmp_path / "c.part").read_bytes()
    (tmp_path / "c.part").write_bytes(third[:-1])
    with pytest.raises(DataError, match=r"c\.part was damaged"):
        join_shards(archive, tmp_path, pieces, delete=True)
    assert not (tmp_path / "a.part").exists()
    assert count_joined(archive, tmp_path, pieces) == 2
    (tmp_path / "c.part").write_bytes(third)  # simulated once more
    join_shards(archive, tmp_path, pieces, delete=True)
    assert archive.read_bytes() == whole.read_bytes()


def test_a_damaged_piece_is_named_and_removed(contents, tmp_path):
    pieces = make_pieces(tmp_path, contents)
    damaged = tmp_path / "c.part"
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"?")
    with pytest.raises(DataError, match=r"c\.part was damaged or missing: run the same command again"):
        join_shards(tmp_path / "a.tar.gz", tmp_path, pieces, delete=False)
    assert not damaged.exists()


def test_an_archive_that_unfolds_without_end_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("rlftsim.submission.archive.LEAST_UNPACKED", 1 << 20)
    (tmp_path / "a.gz").write_bytes(gzip.compress(bytes(1 << 25)))
    with (tmp_path / "a.gz").open("rb") as file:
        reader = GzipReader(file)
        with pytest.raises(DataError, match="unfolds to more than 200 times its size"):
            reader.finish()


def test_a_field_larger_than_the_rollouts_of_any_scenario_is_refused_unread(tmp_path, monkeypatch):
    monkeypatch.setattr("rlftsim.evaluation.wire_format.MAX_FIELD_BYTES", 100)
    with pytest.raises(DataError, match="more than any scenario's"):
        list(iterate_fields(io.BytesIO(b"\x0a\xc8\x01" + bytes(200)), 0, 203, is_stream=True))
