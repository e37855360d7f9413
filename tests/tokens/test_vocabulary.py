import pytest
import torch
from safetensors.torch import save_file

from rlftsim.errors import DataError
from rlftsim.jobs.arrays import read_tensors
from rlftsim.tokens.vocabulary import Vocabulary


@pytest.fixture
def path(tmp_path):
    corners = torch.randn(3, 5, 6, 4, 2, generator=torch.Generator().manual_seed(0))
    mask = torch.tensor([[True] * 5, [True] * 5, [True] * 3 + [False] * 2])
    Vocabulary(corners, mask, torch.zeros(7, 11, 2), origin="a test").save(tmp_path / "v.safetensors")
    return tmp_path / "v.safetensors"


def with_number(table, value):
    table = table.clone()
    table.view(-1)[17] = value
    return table


CHANGES = {
    "NaN in a motion token": (lambda t: {"corners": with_number(t["corners"], torch.nan)}, "corners holds numbers"),
    "NaN in a map piece": (lambda t: {"map_prototypes": with_number(t["map_prototypes"], torch.nan)}, "map_prototypes"),
    "a point far away": (lambda t: {"corners": with_number(t["corners"], 1e30)}, "no meters within 1000 m"),
    "a token fewer": (lambda t: {"corners": t["corners"][:, :-1].contiguous()}, r"token_mask is torch.bool \[3, 5\]"),
    "no token": (lambda t: {"corners": t["corners"][:, :0], "token_mask": t["token_mask"][:, :0]}, "0 motion tokens"),
    "no map piece": (lambda t: {"map_prototypes": t["map_prototypes"][:0]}, "0 map pieces"),
    "a mask of numbers": (lambda t: {"token_mask": t["token_mask"].byte()}, "token_mask is torch.uint8"),
    "doubles": (lambda t: {"corners": t["corners"].double()}, "corners is torch.float64"),
    "a class that never stands": (
        lambda t: {"token_mask": torch.ones(3, 5).cumsum(1) > 1},
        "first token",
    ),
    "a table too many": (lambda t: {"more": torch.zeros(1)}, "missing or unknown: 'more'"),
    "a scalar": (lambda t: {"corners": torch.tensor(1.0)}, "corners is torch.float32"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_tables_that_are_no_vocabulary_are_refused_in_one_line(path, name):
    change, words = CHANGES[name]
    tensors, metadata = read_tensors(path, "")
    save_file({**tensors, **change(tensors)}, path, dict(metadata))
    with pytest.raises(DataError, match=rf"{words}.*: damaged vocabulary, build it again") as error:
        Vocabulary.load(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("origin", [None, "x", "3", "[" * 100_000])
def test_an_origin_that_is_no_text_in_json_is_refused(path, origin):
    tensors, metadata = read_tensors(path, "")
    save_file(tensors, path, {"format": metadata["format"], **({} if origin is None else {"origin": origin})})
    with pytest.raises(DataError, match=r"v\.safetensors: origin: .*: damaged vocabulary, build it again"):
        Vocabulary.load(path)
