"""Descriptions of entries."""

import pytest
import torch
from entries import TOML
from torch import nn

from rlftsim.errors import ConfigError
from rlftsim.evaluation.submission_pb2 import SimAgentsChallengeSubmission
from rlftsim.submission.entry import REQUIRED_FIELDS, count_parameters, describe_entry, find_problems, read_entry


@pytest.fixture
def read(tmp_path):
    def read_text(text, **changes):
        (tmp_path / "entry.toml").write_text(text)
        return read_entry(tmp_path / "entry.toml", **changes)

    return read_text


def test_a_file_becomes_all_required_fields(read):
    entry = read(TOML, method="Another")
    message = SimAgentsChallengeSubmission.FromString(describe_entry(entry, "7M"))
    assert find_problems(message) == []
    assert all(message.HasField(name) for name in REQUIRED_FIELDS)
    assert (message.unique_method_name, message.submission_type, message.uses_lidar_data) == ("Another", 1, False)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("jane.doe@university.edu", "your_account@test.com", "your_account@test.com"),
        ("jane.doe@university.edu", "jane", "no e-mail address"),
        ("jane.doe@university.edu", "jané@university.edu", "no e-mail address"),
        ("jane.doe@university.edu", "jane@university..edu", "no e-mail address"),
        ("A model.", "<what it does>", "no entry's"),
        ('"A method"', '"test"', "'test' is no entry's"),
        ('"A method"', f'"{"m" * 41}"', "1 to 40 printable ASCII characters, it has 41"),
        ('"A method"', '"Méthode"', "printable ASCII"),
        ('["Jane Doe"]', "[]", "name at least one author"),
        ('["Jane Doe"]', '"Jane Doe"', "authors must be a list"),
        ('description = "A model."', "", "description missing"),
        ("link =", "lnk = 3\nlink =", "lnk unknown"),
        ("link =", "uses_lidar = 1\nlink =", "uses_lidar must be true or false"),
        ("link =", "uses_public_models = true\nlink =", "name the models"),
        ("link =", "link = =", "not TOML: "),
    ],
)
def test_mistakes_are_named_with_the_file(read, old, new, message):
    with pytest.raises(ConfigError, match=message) as caught:
        read(TOML.replace(old, new))
    assert str(caught.value).count("entry.toml") == 1
    assert "\n" not in str(caught.value).replace("(at", "")


@pytest.mark.parametrize(("count", "text"), [(7_123_456, "7M"), (512_000, "512K"), (999, "999"), (0, "0")])
def test_parameters_are_a_whole_number_and_a_suffix(count, text):
    policy = nn.Module()
    policy.register_parameter("weight", nn.Parameter(torch.empty(count)))
    assert count_parameters(policy) == text
    assert count_parameters(object()) == "0"


def test_an_account_of_bytes_that_are_no_text_is_refused(read):
    with pytest.raises(ConfigError, match="no e-mail address"):
        read(TOML, account="\udcff@university.edu")


def test_a_comparison_is_no_placeholder(read):
    assert read(TOML.replace("A model.", "ADE < 1 m")).description == "ADE < 1 m"
