import struct

import pytest

from rlftsim.errors import DataError
from rlftsim.scenario.tfrecord import (
    SkippedRecord,
    count_lost,
    iterate_records,
    masked_crc32c,
    read_records,
    write_records,
)

RECORDS = [b"first", b"", b"third record" * 100, b"last"]
# start of record k: 16 bytes of framing for each record before it
STARTS = [sum(16 + len(r) for r in RECORDS[:k]) for k in range(len(RECORDS) + 1)]


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "x.tfrecord"
    write_records(path, RECORDS)
    return path


def flip(path, offset):
    data = bytearray(path.read_bytes())
    data[offset] ^= 0x40
    path.write_bytes(data)


def read_skipping(path):
    items = list(enumerate(iterate_records(path)))
    skipped = [item for _, item in items if isinstance(item, SkippedRecord)]
    assert all(items[item.record] == (item.record, item) for item in skipped)
    return [(record, item) for record, item in items if isinstance(item, bytes)], skipped


def test_records_come_back_in_order_with_their_numbers(file):
    assert list(read_records(file)) == list(enumerate(RECORDS))


def test_the_checksum_is_the_one_of_the_published_vectors():
    # RFC 3720 B.4: 32 zero bytes have crc32c 8a9136aa; rotated by 15 and shifted by a282ead8
    crc = 0x8A9136AA
    rotated = ((crc >> 15) | (crc << 17)) & 0xFFFFFFFF
    assert masked_crc32c(bytes(32)) == (rotated + 0xA282EAD8) % 2**32


def test_a_flipped_data_byte_costs_one_record(file):
    flip(file, STARTS[2] + 12 + 5)
    with pytest.raises(DataError, match=r"x\.tfrecord: record 2: damaged: the checksum of its 1200 bytes"):
        list(read_records(file))
    records, skipped = read_skipping(file)
    assert [number for number, _ in records] == [0, 1, 3]
    assert count_lost(skipped) == "1"
    assert [(s.file, s.record) for s in skipped] == [(str(file), 2)]


def test_a_flipped_length_byte_costs_the_rest_and_says_so(file):
    flip(file, STARTS[2] + 1)
    with pytest.raises(DataError, match=r"record 2: .*length does not match; the rest of the file is lost"):
        list(read_records(file))
    records, skipped = read_skipping(file)
    assert [number for number, _ in records] == [0, 1]
    assert [s.record for s in skipped] == [2]


@pytest.mark.parametrize("cut", [STARTS[3] + 3, STARTS[3] + 12, STARTS[3] + 14, STARTS[4] - 1])
def test_a_truncated_file_keeps_the_records_before(file, cut):
    file.write_bytes(file.read_bytes()[:cut])
    with pytest.raises(DataError, match="record 3: truncated"):
        list(read_records(file))
    records, skipped = read_skipping(file)
    assert len(records) == 3
    assert "truncated" in skipped[0].cause
    assert skipped[0].cause.endswith("; the rest of the file is lost")
    assert count_lost(skipped) == "at least 1"


def test_a_length_with_a_good_checksum_beyond_the_end_is_a_truncation(tmp_path):
    length = struct.pack("<Q", 2**62)
    path = tmp_path / "x.tfrecord"
    path.write_bytes(length + struct.pack("<I", masked_crc32c(length)) + b"abc")
    with pytest.raises(DataError, match="truncated"):
        list(read_records(path))


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        (b"", "the file is empty"),
        (b"abc", "not a TFRecord file: too short"),
        (b"scenario_id,split\n0a1b,training\n" * 10, "not a TFRecord file, or damaged at its start"),
        (b"\x1f\x8b\x08\x00" + bytes(40), "gzip"),
    ],
    ids=["empty", "short", "text", "gzip"],
)
def test_what_is_no_tfrecord_is_refused_in_words(tmp_path, content, cause):
    path = tmp_path / "other.tfrecord"
    path.write_bytes(content)
    with pytest.raises(DataError, match=rf"other\.tfrecord: record 0: .*{cause}"):
        list(read_records(path))
    records, skipped = read_skipping(path)
    assert records == []
    assert len(skipped) == 1


def test_a_missing_file_is_refused_even_when_skipping(tmp_path):
    with pytest.raises(DataError, match="cannot be opened"):
        list(iterate_records(tmp_path / "none"))
