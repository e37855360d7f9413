"""Mutants: damaged copies of a good file, by its bytes or by its meaning. The same seed gives the same mutant.

A mutant of the bytes is what a broken disk, a cut copy or an editor leaves. A mutant of the meaning is well-formed,
with sound checksums, and says something else: another type, another number of axes, NaN, a missing or a foreign name.
"""

import gzip
import hashlib
import io
import json
import pickle
import random
import re
import struct
import tarfile
import warnings
import zipfile
from collections.abc import Callable, Mapping
from typing import Any

import google_crc32c
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from rlftsim.evaluation.submission_pb2 import ScenarioRollouts, SimAgentsChallengeSubmission
from rlftsim.scenario.codec import decode_array, encode_array
from rlftsim.scenario.tfrecord import masked_crc32c
from rlftsim.scenario.womd_pb2 import Scenario

HEAD_BYTES = 512
"""Where most formats keep sizes and offsets; as much at the end."""
LONG = "long " * 20_000
CONTROL = "a\n\x1b[31mb\r\tc\x00d"
Change = Callable[[bytes], bytes]


# ---- bytes ----------------------------------------------------------------------------------------


def mutate_bytes(data: bytes, seed: object) -> bytes:
    """Copy of a file with one to three faults in its bytes, half of them near its head or its tail.

    Args:
        data: Bytes of a good file.
        seed: Value whose text the mutant follows from.
    """
    dice, mutant = random.Random(str(seed)), bytearray(data)
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        start = dice.choice((dice.randrange, _near_an_end(dice)))(max(len(mutant), 1))
        length = min(dice.choice((1, 2, 4, 8, 64, 512, 4096)), len(mutant) - start)
        block = bytes(mutant[start : start + length])
        other = dice.randrange(max(len(mutant), 1))
        number = dice.choice((0, 1, -1, 2**31 - 1, -(2**31), 2**40, 2**62, -(2**63), 2**63 - 1))
        match dice.randrange(9):
            case 0 if block:
                mutant[start] ^= 1 << dice.randrange(8)
            case 1:
                mutant[start : start + length] = dice.randbytes(length)
            case 2:
                del mutant[start:]
            case 3:
                del mutant[start : start + length]
            case 4:
                mutant[start:start] = dice.randbytes(length)
            case 5:
                mutant[start:start] = block
            case 6:
                mutant[start : start + length] = bytes(length)
            case 7:
                mutant[other : other + length] = block
            case _:
                word = (number & (2**64 - 1)).to_bytes(8, dice.choice(("little", "big")))[: dice.choice((4, 8))]
                mutant[start : start + len(word)] = word
    return bytes(mutant)


def _near_an_end(dice: random.Random) -> Callable[[int], int]:
    """Draw of an offset among the first or the last bytes of a file."""
    return lambda size: dice.choice((0, max(size - HEAD_BYTES, 0))) + dice.randrange(max(min(size, HEAD_BYTES), 1))


# ---- JSON and TOML --------------------------------------------------------------------------------


class Raw(str):
    """Text that stands in JSON as it is, such as `NaN` or a bracket that is never closed."""


VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 7, 2**31, 2**63, 2**64, -(2**70), 10**400, 0.5, -0.0, 1e-320, 1e308, Raw("NaN"),
    Raw("Infinity"), Raw("-Infinity"), Raw("1" * 5000), Raw("1e999"), "", "x", "7", "nan", LONG, CONTROL, "../x", "/",
    "e\u0301\u202e", Raw('"\\ud800"'), [], [[]], {}, {"a": 1}, [None], [1, 2, 3], [0] * 50_000, ["a"] * 3,
    Raw("[" * 50 + "]" * 50), Raw("[" * 2000 + "]" * 2000), Raw('{"a":' * 900 + "1" + "}" * 900),
    Raw("[" * 100_000 + "]" * 100_000),
    {LONG: 1}, {CONTROL: 1},
)  # fmt: skip


def mutate_json(data: bytes, dice: random.Random) -> bytes:
    """JSON with one to three values replaced, removed, repeated or renamed."""
    tree = json.loads(data)
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        tree = _mutate_tree(tree, dice)
    text = _json_text(tree)
    match dice.randrange(20):
        case 0:
            text = "\ufeff" + text
        case 1:
            return text.encode("utf-16")
        case 2:
            text += dice.choice((text, "x", "}", "\x00"))
    return text.encode("utf-8", "surrogatepass")


def mutate_json_lines(data: bytes, dice: random.Random) -> bytes:
    """Lines of JSON with one of them changed, repeated, moved or removed."""
    lines = data.splitlines()
    number = dice.randrange(len(lines))
    match dice.randrange(6):
        case 0:
            lines.insert(dice.randrange(len(lines)), lines[number])
        case 1:
            del lines[number]
        case 2:
            dice.shuffle(lines)
        case _:
            lines[number] = mutate_json(lines[number], dice)
    return b"\n".join(lines) + b"\n"


def _mutate_tree(tree: Any, dice: random.Random) -> Any:
    """A tree of JSON values with a change at one of its nodes; large trees are changed near their root, too."""
    if not isinstance(tree, (dict, list)) or not tree or dice.random() < 0.15:
        return dice.choice(VALUES)
    keys = list(tree) if isinstance(tree, dict) else list(range(len(tree)))
    key, other = dice.choice(keys), dice.choice(keys)
    tree = tree.copy()
    if isinstance(tree[key], (dict, list)) and tree[key] and dice.random() < 0.7:
        tree[key] = _mutate_tree(tree[key], dice)
        return tree
    match dice.randrange(7):
        case 0:
            del tree[key]
        case 1 if isinstance(tree, dict):
            tree[dice.choice((f"{key}_", "architecture", "format", "a b", LONG, CONTROL))] = tree[key]
        case 1:
            tree.insert(0, tree[key])
        case 2 if isinstance(tree, dict):
            # the same name twice, which dictionaries cannot hold
            tree[key] = Raw(f"{_json_text(tree[key])}, {json.dumps(key)}: {_json_text(dice.choice(VALUES))}")
        case 2:
            return tree * dice.choice((2, 100))
        case 3:
            tree[key], tree[other] = tree[other], tree[key]
        case 4 if isinstance(tree[key], (int, float)):
            tree[key] = dice.choice((-tree[key], tree[key] * 1e6, tree[key] + 1, str(tree[key]), float(tree[key])))
        case _:
            tree[key] = dice.choice(VALUES)
    return tree


def _json_text(tree: Any) -> str:
    raw: list[str] = []

    def marked(node: Any) -> Any:
        if isinstance(node, Raw):
            raw.append(node)
            return f"@@{len(raw) - 1}@@"
        if isinstance(node, dict):
            return {key: marked(value) for key, value in node.items()}
        return [marked(value) for value in node] if isinstance(node, list) else node

    text = json.dumps(marked(tree), ensure_ascii=False)
    return re.sub(r'"@@(\d+)@@"', lambda found: raw[int(found[1])], text)


TOML_VALUES = (
    "1", "true", '""', '"x"', "[]", "{}", "1979-05-27", "nan", "inf", f'"{LONG}"', '"a\\nb\\u001bc"', "[[]]",
    '{a = "b"}', "9" * 5000, "[" * 60 + "]" * 60, "[" * 3000 + "]" * 3000, "{a=" * 900 + "1" + "}" * 900,
    '["a", 1]', '[""]', '"\\ud800"', "'", "0x",
)  # fmt: skip


def mutate_toml(data: bytes, dice: random.Random) -> bytes:
    """TOML with lines changed, removed, repeated or renamed."""
    lines = [line for line in data.decode().splitlines() if "=" in line]
    for _ in range(dice.choice((1, 1, 2))):
        number = dice.randrange(len(lines))
        name = lines[number].partition("=")[0].strip() or "a"
        match dice.randrange(6):
            case 0 if len(lines) > 1:
                del lines[number]
            case 1:
                lines.append(lines[number])
            case 2:
                lines[number] = f"{name}_ = 1" if dice.random() < 0.5 else f"[{name}]"
            case _:
                lines[number] = f"{name} = {dice.choice(TOML_VALUES)}"
    return (dice.choice(("", "", "", "\ufeff")) + "\n".join(lines) + "\n").encode()


# ---- arrays ---------------------------------------------------------------------------------------


def mutate_array(array: np.ndarray, dice: random.Random) -> np.ndarray:
    """An array of another dtype, shape or of other values."""
    match dice.randrange(13):
        case 0 if array.dtype.kind not in "US":
            kind = dice.choice(
                ("float64", "float32", "float16", "int8", "uint8", "int64", "bool", "U8", "S4", "complex64")
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return array.astype(kind)
        case 1:
            return array[..., None]
        case 2:
            return array.reshape(-1)
        case 3 if array.ndim:
            return array[:0]
        case 4 if array.ndim:
            return array[..., :-1]
        case 5 if array.ndim:
            return np.concatenate([array, array])
        case 6 if array.ndim:
            return array.swapaxes(0, -1)
        case 7 if array.size:
            return array.reshape(-1)[0]
        case 8:
            return np.full_like(
                array, dice.choice((0, 1)) if array.dtype.kind in "US" else dice.choice((0, 1, -1)) % 128
            )
        case 9 if array.ndim:
            return array[::-1]
        case _ if array.size and array.dtype.kind in "fiu":
            changed = array.copy().reshape(-1)
            numbers = (np.nan, np.inf, -np.inf, 1e30, -1e30, 3e38, 1e-40, 1e9) if array.dtype.kind == "f" else ()
            least, most = (-1e30, 1e30) if numbers else (np.iinfo(array.dtype).min, np.iinfo(array.dtype).max)
            with np.errstate(over="ignore"):
                changed[dice.randrange(array.size)] = dice.choice(numbers or (least, most, 0, most // 2))
            return changed.reshape(array.shape)
        case _ if array.dtype.kind in "US":
            return np.array(dice.choice(("", "x", LONG, CONTROL, "../x", "\u202e")))
    return np.zeros((2, 3), np.float32)


def _npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, array, allow_pickle=True)
    return file.getvalue()


def _npy_header(descr: str, shape: str, body: bytes = b"") -> bytes:
    """An npy file whose header says anything."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + body


def mutate_npz(data: bytes, dice: random.Random) -> bytes:
    """An npz with an array of another kind, missing, added, exchanged, pickled, or with a header that is not true."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name, other = (dice.choice([*members]) for _ in range(2))
    array = np.lib.format.read_array(io.BytesIO(members[name]))
    extra: list[tuple[str, bytes]] = []
    match dice.randrange(12):
        case 0:
            del members[name]
        case 1:
            extra = [(dice.choice((name, "more.npy", "../x.npy", "x", LONG[:60_000], "a\nb.npy")), members[name])]
        case 2:
            members[name], members[other] = members[other], members[name]
        case 3:
            members[name] = _npy(np.array([{"a": 1}, None], object))
        case 4:
            shape = dice.choice(
                ("(1000000000, 1000)", "(-1,)", "(2, 3)", "(99999999999999999999,)", "()", "(0, 1000000000000)", "'a'")
            )
            members[name] = _npy_header(
                dice.choice((repr(array.dtype.str), "'<f8'", "'<U1000000000'", "'|O'", "[('a', '<f4')]", "'x'")),
                shape,
                members[name][128:],
            )
        case 5:
            members[name] = dice.choice((b"", b"x", pickle.dumps([1]), members[name][:-7], bytes(1_000_000)))
        case 6:
            members[name] = mutate_bytes(members[name], dice.random())
        case _:
            members[name] = _npy(mutate_array(array, dice))
    file = io.BytesIO()
    with (
        warnings.catch_warnings(),
        zipfile.ZipFile(file, "w", dice.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive,
    ):
        warnings.simplefilter("ignore")  # the same name twice
        for member, body in [*members.items(), *extra]:
            archive.writestr(member, body)
    return file.getvalue()


# ---- safetensors, checkpoints, snapshots -----------------------------------------------------------

_TENSOR_TYPES = {"F64": 8, "F32": 4, "F16": 2, "BF16": 2, "I64": 8, "I32": 4, "I16": 2, "I8": 1, "U8": 1, "BOOL": 1}


def mutate_safetensors(data: bytes, dice: random.Random) -> bytes:
    """Safetensors with another tensor, names, metadata, or a header that is not true."""
    (length,) = struct.unpack_from("<Q", data)
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    metadata = header.pop("__metadata__", None)
    tensors = {name: (one["dtype"], one["shape"], body[slice(*one["data_offsets"])]) for name, one in header.items()}
    name, other = (dice.choice([*tensors]) for _ in range(2))
    kind, shape, values = tensors[name]
    match dice.randrange(10):
        case 0:
            del tensors[name]
        case 1:
            tensors[dice.choice((f"{name}_", f"module.{name}", f"_orig_mod.{name}", "x", LONG, CONTROL, "a.b"))] = (
                tensors.pop(name)
            )
        case 2:
            tensors[name], tensors[other] = tensors[other], tensors[name]
        case 3:
            number = dice.choice(("nan", "inf", "-inf", "1e30", "0"))
            size = _TENSOR_TYPES[kind]
            if kind.startswith("F") and values:
                at = size * dice.randrange(len(values) // size)
                one = np.array(float(number)).astype(f"<f{size}").tobytes()
                values = values[:at] + one + values[at + size :] if dice.random() < 0.7 else one * (len(values) // size)
            else:
                values = dice.randbytes(len(values)) if kind != "BOOL" else bytes(len(values))
            tensors[name] = (kind, shape, values)
        case 4:
            kind = dice.choice([*_TENSOR_TYPES])
            count = int(np.prod(shape, dtype=np.int64))
            tensors[name] = (kind, shape, bytes(count * _TENSOR_TYPES[kind]))
        case 5:
            size = _TENSOR_TYPES[kind]
            shape = dice.choice(([], [0], [1], [*shape, 1], shape[1:], [2, *shape], [*shape[:-1], 7], shape[::-1]))
            count = int(np.prod(shape, dtype=np.int64))
            tensors[name] = (kind, shape, (values * 3)[: count * size].ljust(count * size, b"\0"))
        case 6 | 7 if metadata is not None:
            key = dice.choice([*metadata])
            try:
                inside = mutate_json(metadata[key].encode(), dice).decode("utf-8", "replace")
            except ValueError:
                inside = dice.choice(("", "x", LONG, "{}", "[" * 100_000))
            metadata = dice.choice(
                ({**metadata, key: inside}, {**metadata, key: inside}, {**metadata, f"{key}_": "x"}, {}, None)
            )
    offset, header = 0, {} if metadata is None else {"__metadata__": metadata}
    for name, (kind, shape, values) in tensors.items():
        header[name] = {"dtype": kind, "shape": shape, "data_offsets": [offset, offset + len(values)]}
        offset += len(values)
    text = json.dumps(header).encode()
    if dice.random() < 0.2:
        text = mutate_json(text, dice)
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + b"".join(values for *_, values in tensors.values())


class _Unsafe:
    """An object whose pickle calls a function."""

    def __reduce__(self) -> Any:
        return print, ("executed",)


def mutate_checkpoint(data: bytes, dice: random.Random) -> bytes:
    """A torch checkpoint with other weights, names or settings."""
    content = torch.load(io.BytesIO(data), weights_only=True)
    weights = content["state_dict"]
    name = dice.choice([*weights])
    array = weights[name].float().numpy()
    match dice.randrange(9):
        case 0:
            del weights[name]
        case 1:
            weights[dice.choice((f"{name}_", "x", 7, None, (1, 2), LONG, CONTROL))] = weights.pop(name)
        case 2:
            weights[name] = dice.choice(
                (
                    None,
                    1,
                    "x",
                    [1.0],
                    {"a": 1},
                    torch.zeros(0),
                    torch.tensor(1j),
                    torch.zeros(3).to_sparse(),
                    torch.zeros(1).expand(1 << 40),
                )
            )
        case 3 | 4:
            changed = mutate_array(array, dice)
            if changed.dtype.kind not in "US":
                weights[name] = torch.from_numpy(np.ascontiguousarray(changed))
        case 5 | 6:
            settings = content["hyper_parameters"]["model_config"]["decoder"]
            settings[dice.choice([*settings])] = dice.choice(
                (None, 0, -1, 1 << 40, 10**9, 1e18, float("nan"), "x", [], {}, True, 0.5, LONG)
            )
        case 7:
            content = dice.choice(
                (
                    {"state_dict": dice.choice((None, [], 1, {}))},
                    {},
                    [],
                    weights,
                    torch.zeros(3),
                    {
                        **content,
                        "hyper_parameters": dice.choice(
                            (None, 1, {"model_config": 1}, {"model_config": {"decoder": []}})
                        ),
                    },
                )
            )
        case _:
            content = dice.choice(({**content, "more": _Unsafe()}, {**content, 7: 1, None: 2}))
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def mutate_snapshot(data: bytes, dice: random.Random) -> bytes:
    """A planner's snapshot of another text or other motion, with a sound checksum."""
    body = data[:-32]
    (length,) = struct.unpack_from("<Q", body)
    header = json.loads(body[8 : 8 + length])
    start, stop = header["about"]["data_offsets"]
    about = body[8 + length :][start:stop]
    if dice.random() < 0.6:
        changed = mutate_json(about, dice)
        motion = body[8 + length :][slice(*header["motion"]["data_offsets"])]
        header["about"] |= {"shape": [len(changed)], "data_offsets": [len(motion), len(motion) + len(changed)]}
        header["motion"]["data_offsets"] = [0, len(motion)]
        text = json.dumps(header).encode()
        body = struct.pack("<Q", len(text)) + text + motion + changed
    else:
        body = mutate_safetensors(body, dice) if dice.random() < 0.8 else mutate_bytes(body, dice.random())
    return body + hashlib.sha256(body).digest()


# ---- tables ---------------------------------------------------------------------------------------


def mutate_table(table: pa.Table, dice: random.Random) -> pa.Table:
    """A table with another column, other rows, or other metadata."""
    number = dice.randrange(table.num_columns)
    field, column = table.schema.field(number), table.column(number).combine_chunks()
    values = column.to_pylist()
    row = dice.randrange(max(len(values), 1))
    match dice.randrange(14):
        case 0:
            return table.remove_column(number)
        case 1:
            return table.append_column(dice.choice((field.name, "more", LONG, CONTROL)), column)
        case 2:
            name = dice.choice((f"{field.name}_", field.name.upper(), "", CONTROL))
            return table.rename_columns([name if n == number else old for n, old in enumerate(table.schema.names)])
        case 3:
            return table.slice(0, dice.choice((0, 1, max(len(table) - 1, 0))))
        case 4:
            return pa.concat_tables([table, table])
        case 5:
            rows = [*range(len(table))]
            dice.shuffle(rows)
            return table.take(pa.array(rows, pa.int64()))
        case 6 if table.schema.metadata:
            metadata = dict(table.schema.metadata)
            key = dice.choice([*metadata])
            try:
                metadata[key] = mutate_json(metadata[key], dice)
            except ValueError:
                metadata[key] = dice.choice((b"", b"x", b"\xff\xfe", LONG.encode()))
            return table.replace_schema_metadata(dice.choice((metadata, metadata, metadata, None)))
        case 7 | 8:
            casts = (
                "string",
                "large_string",
                "binary",
                "float64",
                "float32",
                "float16",
                "int64",
                "int8",
                "uint64",
                "bool",
                "null",
                "list",
                "dictionary",
                "decimal",
                "timestamp",
                "struct",
            )
            column = _cast(column, dice.choice(casts))
        case 9 if len(values):
            values = [*values[:row], None, *values[row + 1 :]] if dice.random() < 0.7 else [None] * len(values)
            column = pa.array(values, field.type)
        case _ if len(values):
            try:
                changed = _other_value(values[row], field.type, dice)
                values = (
                    [changed] * len(values) if dice.random() < 0.3 else [*values[:row], changed, *values[row + 1 :]]
                )
                column = pa.array(values, field.type)
            except (pa.ArrowException, OverflowError, ValueError, TypeError):
                return table.remove_column(number)
    return table.set_column(number, pa.field(field.name, column.type), column)


def _other_value(value: Any, kind: pa.DataType, dice: random.Random) -> Any:
    if pa.types.is_floating(kind):
        return dice.choice((float("nan"), float("inf"), -float("inf"), 1e308, -5.0, 0.0, 1e30, 1e6, -1e-30))
    if pa.types.is_boolean(kind):
        return not value
    if pa.types.is_integer(kind):
        least, most = (
            (0, 2**kind.bit_width - 1)
            if pa.types.is_unsigned_integer(kind)
            else (-(2 ** (kind.bit_width - 1)), 2 ** (kind.bit_width - 1) - 1)
        )
        return dice.choice((least, most, 0, 1, -1, 999, (value or 0) + 1))
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return dice.choice(("", "x", LONG, CONTROL, "../../x", "/etc/passwd", "\u202e", f"{value}_"))
    if pa.types.is_list(kind):
        return dice.choice(([], (value or []) * 2, [None], (value or [])[:-1]))
    return value


def _cast(column: pa.Array, name: str) -> pa.Array:
    """A column of another type; values that it cannot have are left out."""
    if name == "list":
        return pa.array([[value] for value in column.to_pylist()])
    if name == "struct":
        return pa.array([{"a": value} for value in column.to_pylist()])
    if name == "null":
        return pa.nulls(len(column))
    if name == "dictionary":
        return column.dictionary_encode() if not pa.types.is_nested(column.type) else column
    kind = {
        "decimal": pa.decimal128(38, 4),
        "timestamp": pa.timestamp("ns"),
        "bool": pa.bool_(),
        "float16": pa.float16(),
    }
    try:
        return column.cast(kind.get(name) or getattr(pa, name)(), safe=False)
    except (pa.ArrowException, AttributeError):
        return pa.array([str(value) for value in column.to_pylist()])


def mutate_parquet(data: bytes, dice: random.Random) -> bytes:
    """A Parquet table with other contents."""
    table, file = pq.read_table(io.BytesIO(data)), io.BytesIO()
    for _ in range(dice.choice((1, 1, 2))):
        if table.num_columns:
            table = mutate_table(table, dice)
    try:
        pq.write_table(table, file, compression=dice.choice(("none", "zstd", "snappy")))
    except (pa.ArrowException, OverflowError):  # a type that the format does not have
        return mutate_bytes(data, dice.random())
    return file.getvalue()


def mutate_shard(data: bytes, dice: random.Random) -> bytes:
    """An Arrow shard with other contents; mostly its rows have sound checksums."""
    table = pa.ipc.open_file(io.BytesIO(data)).read_all()
    binary = [name for name in table.schema.names if table.schema.field(name).type == pa.binary()]
    if binary and dice.random() < 0.6:
        name, row = dice.choice(binary), dice.randrange(len(table))
        cells = table[name].to_pylist()
        if cells[row] is not None:
            if dice.random() < 0.6:
                changed = mutate_array(decode_array(cells[row]), dice)
                cells[row] = (
                    encode_array(changed) if changed.dtype.kind in "fib" and changed.itemsize != 2 else cells[row]
                )
            else:
                cells[row] = mutate_bytes(cells[row], dice.random())
        table = table.set_column(table.schema.names.index(name), name, pa.array(cells, pa.binary()))
    else:
        table = mutate_table(table, dice)
    if "checksum" in table.schema.names and dice.random() < 0.8:
        columns = [column.to_pylist() for column in table.columns if column.type == pa.binary()]
        sums = [google_crc32c.value(b"".join(cell for cell in row if cell is not None)) for row in zip(*columns)]
        if len(sums) == len(table):
            table = table.set_column(table.schema.names.index("checksum"), "checksum", pa.array(sums, pa.uint32()))
    file = io.BytesIO()
    with pa.ipc.new_file(file, table.schema) as writer:
        writer.write_table(table)
    return file.getvalue()


# ---- messages -------------------------------------------------------------------------------------

_NUMBERS = {
    "f": (float("nan"), float("inf"), -float("inf"), 1e308, -1e30, 0.0, 3e38, 1e6),
    "i": (0, 1, -1, 2**31 - 1, -(2**31), 2**62, -(2**63), 99),
}


def mutate_message(message: Any, dice: random.Random) -> None:
    """Change a field somewhere in a protobuf message, in place."""
    node = message
    while True:
        inner = [value for field, value in node.ListFields() if field.message_type is not None]
        if not inner or dice.random() < 0.35:
            break
        chosen = dice.choice(inner)
        node = chosen if hasattr(chosen, "ListFields") else dice.choice(chosen)
    field = dice.choice(node.DESCRIPTOR.fields)
    value = getattr(node, field.name)
    if field.is_repeated:
        match dice.randrange(6):
            case 0:
                node.ClearField(field.name)
            case 1 if len(value):
                value.extend([value[0]] * dice.choice((1, 2, 100)))
            case 2 if len(value):
                del value[dice.randrange(len(value))]
            case 3 if len(value):
                del value[dice.randrange(len(value)) :]
            case 4 if len(value) and field.message_type is None:
                value[dice.randrange(len(value))] = _other_number(field, dice)
            case _ if len(value) > 1:
                kept = [*value]
                dice.shuffle(kept)
                node.ClearField(field.name)
                getattr(node, field.name).extend(kept)
    elif field.message_type is not None or dice.random() < 0.3:
        node.ClearField(field.name)
    else:
        setattr(node, field.name, _other_number(field, dice))


def _other_number(field: Any, dice: random.Random) -> Any:
    kinds = type(field)
    if field.type == kinds.TYPE_STRING:
        return dice.choice(("", "x", LONG, "a\nb\x1b", "../../x", "\u202e"))
    if field.type == kinds.TYPE_BYTES:
        return dice.randbytes(5)
    if field.type == kinds.TYPE_BOOL:
        return dice.random() < 0.5
    if field.type == kinds.TYPE_ENUM:
        return dice.choice([one.number for one in field.enum_type.values])
    if field.type in (kinds.TYPE_DOUBLE, kinds.TYPE_FLOAT):
        return dice.choice(_NUMBERS["f"])
    bits = 64 if field.type in (kinds.TYPE_INT64, kinds.TYPE_UINT64, kinds.TYPE_SINT64, kinds.TYPE_FIXED64) else 32
    number = dice.choice(_NUMBERS["i"]) % 2**bits
    return (
        number if field.type in (kinds.TYPE_UINT32, kinds.TYPE_UINT64) or number < 2 ** (bits - 1) else number - 2**bits
    )


def _mutated(kind: Any, data: bytes, dice: random.Random) -> bytes:
    """Serialized message of a kind with one to three changed fields, or with changed bytes."""
    if dice.random() < 0.25:
        return mutate_bytes(data, dice.random())
    message = kind.FromString(data)
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        mutate_message(message, dice)
    return message.SerializeToString()


def mutate_records(data: bytes, dice: random.Random) -> bytes:
    """TFRecords of scenarios with one of them changed, under sound checksums."""
    records, start = [], 0
    while start < len(data):
        (length,) = struct.unpack_from("<Q", data, start)
        records.append(data[start + 12 : start + 12 + length])
        start += length + 16
    number = dice.randrange(len(records))
    if dice.random() < 0.1:
        records.insert(0, records[number])
    records[number] = _mutated(Scenario, records[number], dice)
    mutant = b""
    for record in records:
        length = struct.pack("<Q", len(record))
        mutant += length + struct.pack("<I", masked_crc32c(length)) + record + struct.pack("<I", masked_crc32c(record))
    return mutant


def mutate_submission(data: bytes, dice: random.Random) -> bytes:
    """A shard of a submission with other fields."""
    return _mutated(SimAgentsChallengeSubmission, data, dice)


def mutate_rollouts_message(data: bytes, dice: random.Random) -> bytes:
    """The message of a scenario's rollouts with other fields."""
    return _mutated(ScenarioRollouts, data, dice)


def mutate_archive(data: bytes, dice: random.Random) -> bytes:
    """A .tar.gz of submission shards with a changed message, member or frame."""
    with tarfile.open(fileobj=io.BytesIO(data), mode="r:gz") as tar:
        members = [(member, tar.extractfile(member).read()) for member in tar]  # type: ignore[union-attr]
    number = dice.randrange(len(members))
    member, body = members[number]
    raw = gzip.decompress(data)
    match dice.randrange(10):
        case 0:
            del members[number]
        case 1:
            members.append(members[number])
        case 2:
            member.name = dice.choice(
                ("x", "../x", "/etc/x", "a\nb", "n" * 5000, member.name.upper(), "submission.binproto-99999-of-00002")
            )
        case 3:
            member.type = dice.choice(
                (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.DIRTYPE, tarfile.FIFOTYPE, b"Z")
            )
            member.linkname = "../../etc/passwd"
        case 4:
            return gzip.compress(mutate_bytes(raw, dice.random()), 1)
        case 5:
            return dice.choice(
                (
                    data + data,
                    data + b"x",
                    data + bytes(1000),
                    raw,
                    gzip.compress(raw[:-1024], 1),
                    gzip.compress(raw + bytes(50_000_000), 1),
                )
            )
        case _:
            members[number] = (member, mutate_submission(body, dice))
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w:gz", compresslevel=1) as tar:
        for member, body in members:
            member.size = len(body)
            tar.addfile(member, io.BytesIO(body))
    return file.getvalue()


def mutate_text(data: bytes, dice: random.Random) -> bytes:
    """Other text in place of a file's."""
    return dice.choice(
        (
            b"",
            b"\n",
            LONG.encode(),
            CONTROL.encode(),
            b"\xff\xfe\x00",
            data * 2,
            data[::-1],
            data.upper(),
            b"s3://x",
            b"{}",
        )
    )


# ---- all ------------------------------------------------------------------------------------------

_BY_MEANING: Mapping[str, Callable[[bytes, random.Random], bytes]] = {
    "json": mutate_json,
    "jsonl": mutate_json_lines,
    "toml": mutate_toml,
    "npz": mutate_npz,
    "safetensors": mutate_safetensors,
    "checkpoint": mutate_checkpoint,
    "snapshot": mutate_snapshot,
    "parquet": mutate_parquet,
    "shard": mutate_shard,
    "tfrecord": mutate_records,
    "submission": mutate_submission,
    "rollouts": mutate_rollouts_message,
    "archive": mutate_archive,
    "text": mutate_text,
}
KINDS = tuple(_BY_MEANING)


def mutate_meaning(data: bytes, kind: str, seed: object) -> bytes:
    """A well-formed file that says something else.

    Args:
        data: Bytes of a good file.
        kind: Kind of the file, of `KINDS`.
        seed: Value whose text the mutant follows from.
    """
    try:
        return _BY_MEANING[kind](data, random.Random(str(seed)))
    except Exception:  # a change that files of this kind cannot hold, one in thousands
        return mutate_bytes(data, seed)


def _framed(header: bytes) -> Change:
    return lambda data: struct.pack("<Q", len(header)) + header


def _npz_of(**members: bytes) -> Change:
    def change(data: bytes) -> bytes:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            names = archive.namelist()
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            for name in names:
                archive.writestr(name, *members.values())
        return file.getvalue()

    return change


def _pickled(data: bytes) -> bytes:
    return pickle.dumps(_Unsafe())


def _executing_checkpoint(data: bytes) -> bytes:
    file = io.BytesIO()
    torch.save({"state_dict": _Unsafe()}, file)
    return file.getvalue()


def _with_checksum(change: Change) -> Change:
    return lambda data: (body := change(data)) + hashlib.sha256(body).digest()


def _with_bad_offset(data: bytes) -> bytes:
    """A shard in which one byte makes the offset of a binary column negative."""
    table, mutant = pa.ipc.open_file(io.BytesIO(data)).read_all(), bytearray(data)
    name = next(name for name in table.schema.names if table.schema.field(name).type == pa.binary())
    offsets = bytes(table[name].chunk(0).buffers()[1])[:8]
    mutant[data.index(offsets, 1000) + 7] = 0xFF
    return bytes(mutant)


def _compressed(data: bytes) -> bytes:
    """A shard of some kB whose batches unfold to 3 GB."""
    batch, sink = pa.record_batch({"a": [bytes(1 << 28)]}), io.BytesIO()
    with pa.ipc.new_file(sink, batch.schema, options=pa.ipc.IpcWriteOptions(compression="zstd")) as writer:
        for _ in range(12):
            writer.write_batch(batch)
    return sink.getvalue()


def _long_record(data: bytes) -> bytes:
    length = struct.pack("<Q", 1 << 50)
    return length + struct.pack("<I", masked_crc32c(length)) + data


_DEEP = b"[" * 100_000
_HEADER = b'{"x":{"dtype":"F32","shape":[1000000000000],"data_offsets":[0,4000000000000]}}'
HOSTILE: Mapping[str, Mapping[str, Change]] = {
    "json": {"nested deeply": lambda data: _DEEP + b"]" * 100_000, "a number of 5000 digits": lambda data: b"1" * 5000},
    "jsonl": {"nested deeply": lambda data: data + _DEEP + b"]" * 100_000 + b"\n"},
    "toml": {"nested deeply": lambda data: b"x = " + b"[" * 3000 + b"]" * 3000},
    "npz": {
        "8 TB promised": _npz_of(a=_npy_header("'<f8'", "(1000000000, 1000)")),
        "1 GB of zeros": _npz_of(a=_npy_header("'<f8'", "(125000000,)", bytes(50_000_000))),
        "a pickle": _pickled,
    },
    "safetensors": {
        "a header of 8 EB": lambda data: struct.pack("<Q", 1 << 63),
        "4 TB promised": _framed(_HEADER),
        "nested deeply": _framed(_DEEP),
    },
    "checkpoint": {"a pickle that calls": _executing_checkpoint, "a plain pickle": _pickled},
    "snapshot": {"nested deeply": _with_checksum(_framed(_DEEP)), "nothing inside": _with_checksum(_framed(b"{}"))},
    "parquet": {
        "a footer of 4 GB": lambda data: data[:-8] + b"\xff\xff\xff\xffPAR1",
        "frame alone": lambda data: b"PAR1PAR1",
    },
    "shard": {
        "a negative offset": _with_bad_offset,
        "frame alone": lambda data: b"ARROW1\x00\x00ARROW1",
        "compressed": _compressed,
    },
    "tfrecord": {"a record of 1 PB": _long_record},
    "submission": {"a field of 2 GB": lambda data: b"\x0a\xff\xff\xff\xff\x07" + data},
    "rollouts": {"a field of 2 GB": lambda data: b"\x0a\xff\xff\xff\xff\x07" + data},
    "archive": {"1 GB of zeros": lambda data: gzip.compress(bytes(250_000_000), 1) * 4},
    "text": {"no text": lambda data: b"\xff\xfe\x00\x80"},
}
"""Inputs that someone would write to harm a reader, by kind; `EVERYWHERE` has those of every kind."""
EVERYWHERE: Mapping[str, Change] = {"nothing": lambda data: b"", "zeros": lambda data: bytes(4096)}
assert HOSTILE.keys() == _BY_MEANING.keys()
