"""JSON and TOML from files that anybody may have written, damaged or edited.

The only module that parses either: size, depth, repeated names and numbers are checked here.
"""

import json
import math
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from errno import ESPIPE
from itertools import chain
from os import PathLike, fspath, fstat, stat
from stat import S_ISFIFO, S_ISSOCK
from typing import Any
from zlib import decompressobj
from zlib import error as ZlibError

from rlftsim.errors import PERMISSION_WAY_OUT, DataError, RlftsimError, printable

MAX_TEXT_BYTES = 64 << 20
"""Largest text that is parsed; the largest that this package writes is the manifest of a data set, some MB."""
MAX_TOML_BYTES = 1 << 20
"""The same of TOML, which is written by hand and parsed slowly."""
MAX_DEPTH = 64
"""Brackets that may be nested; deeper ones exhaust the stack of whatever walks through the values."""
_LONG_DOTTED_KEY = re.compile(rf"""(?<![\w"'-])(?:[\w"'-]++\s*+\.\s*+){{{MAX_DEPTH + 1}}}""")
LONGEST_INTEGER = 40
"""Digits of a whole number: the seeds of numpy have 39."""
LONGEST_NAME = 40
"""Characters of a name that a message repeats."""
MAX_NAME_BYTES = 200
"""Bytes of a text that becomes a file name; file systems take names of 255 bytes, and a suffix follows."""
_GZIP = b"\x1f\x8b"
_TYPE_NAMES = {dict: "an object", list: "a list", str: "text", bool: "true or false", type(None): "null"}


def read_json(
    path: str | PathLike[str],
    remedy: str,
    *,
    expected: type = dict,
    allow_nan: bool = False,
    error: type[RlftsimError] = DataError,
    missing: str = "",
) -> Any:
    """Value of a JSON file in UTF-8, with or without a mark in front, perhaps compressed by gzip.

    Args:
        path: JSON file of at most `MAX_TEXT_BYTES`.
        remedy: Way out at the end of every message, such as "convert again".
        expected: Type of the outermost value; `object` takes all.
        allow_nan: True takes NaN and infinities, too, which are no JSON.
        error: Class of the errors raised.
        missing: Whole message where there is no such file; empty leaves it to the caller.

    Raises:
        FileNotFoundError: No such file, and no message for that.
        RlftsimError: The file cannot be read, or `parse_json` refuses the text.
    """
    text = _read_bytes(path, MAX_TEXT_BYTES, remedy, error, missing)
    return parse_json(text, remedy, source=str(path), expected=expected, allow_nan=allow_nan, error=error)


def parse_json(
    text: str | bytes,
    remedy: str,
    *,
    source: str,
    expected: type = dict,
    allow_nan: bool = False,
    error: type[RlftsimError] = DataError,
) -> Any:
    """Value of a JSON text.

    Args:
        text: Whole text, bytes in UTF-8.
        remedy: Way out at the end of every message, such as "evaluate again".
        source: File, and position of the text in the file, for messages.
        expected: Type of the outermost value; `object` takes all.
        allow_nan: True takes NaN and infinities, too, which are no JSON.
        error: Class of the errors raised.

    Raises:
        RlftsimError: Damaged text, brackets nested too deeply, a name twice, a number out of range, or a value of the
            wrong type.
    """

    def parse_float(digits: str) -> float:
        number = float(digits)
        if not (allow_nan or math.isfinite(number)):
            raise ValueError(f"{digits[:LONGEST_NAME]} is no finite number")
        return number

    def parse_int(digits: str) -> int:
        if len(digits) > LONGEST_INTEGER:
            raise ValueError(f"a whole number of {len(digits)} digits")
        return int(digits)

    def parse(decoded: str) -> Any:
        try:
            value = json.loads(
                decoded, parse_float=None if allow_nan else parse_float, parse_constant=parse_float, parse_int=parse_int
            )
            # every name has a colon; more of them are in texts, or behind a name that is written twice
            if _count_names(value) < decoded.count(":"):
                json.loads(decoded, object_pairs_hook=_build_object)
            # escapes such as \ud800 are halves of characters, which no file, terminal or picture can hold
            if "\\u" in decoded:
                json.dumps(value, ensure_ascii=False).encode()
        except json.JSONDecodeError as problem:
            raise ValueError(f"not JSON, line {problem.lineno}, column {problem.colno}: {problem.msg}") from None
        return value

    value = _parse(text, parse, source, remedy, error)
    if not isinstance(value, expected):
        raise error(f"{source}: holds {describe_type(value)} instead of {_TYPE_NAMES[expected]}: {remedy}.")
    return value


def read_toml(
    path: str | PathLike[str], remedy: str, *, error: type[RlftsimError] = DataError, missing: str = ""
) -> dict[str, Any]:
    """Values of a TOML file in UTF-8 by name, with or without a mark in front.

    Args:
        path: TOML file of at most `MAX_TOML_BYTES`.
        remedy: Way out at the end of every message.
        error: Class of the errors raised.
        missing: Whole message where there is no such file; empty leaves it to the caller.

    Raises:
        FileNotFoundError: No such file, and no message for that.
        RlftsimError: The file cannot be read, is no TOML, or nests brackets too deeply.
    """

    def parse(decoded: str) -> dict[str, Any]:
        if _LONG_DOTTED_KEY.search(decoded):  # tomllib takes a time that grows with the square of a key's length
            raise RecursionError
        try:
            value = tomllib.loads(decoded)
            _count_names(value)
            return value
        except tomllib.TOMLDecodeError as problem:
            raise ValueError(f"not TOML: {problem}") from None

    text = _read_bytes(path, MAX_TOML_BYTES, remedy, error, missing)
    return _parse(text, parse, str(path), remedy, error)


def describe_type(value: object) -> str:
    """Type of a value of JSON or TOML in words, for messages."""
    return _TYPE_NAMES.get(type(value), "a number")


def to_finite(value: Any) -> Any:
    """Value for JSON, with None for numbers that are not finite, which JSON does not have."""
    if isinstance(value, Mapping):
        return {str(key): to_finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def first_line(problem: BaseException) -> str:
    """Beginning of the text of an error of a library, printable."""
    text = getattr(problem, "strerror", None) or str(problem) or type(problem).__name__
    line = text.strip().splitlines()[0].rstrip(".")[:200] if text.strip() else type(problem).__name__
    return printable(line)


def check_has_end(path: str | PathLike[str]) -> None:
    """Check that a path is no pipe, whose reader may wait for ever; those that a shell makes, `<(...)`, have an end.

    Raises:
        OSError: No file, or a named pipe or socket.
    """
    mode = stat(path).st_mode
    if (S_ISFIFO(mode) or S_ISSOCK(mode)) and not fspath(path).startswith("/dev/"):
        raise OSError(ESPIPE, "a pipe, not a file")


@contextmanager
def explained_damage(
    path: str | PathLike[str],
    damage: tuple[type[Exception], ...],
    remedy: str,
    *,
    words: str = ": cannot be read",
    describe: Callable[[BaseException], str] = first_line,
    error: type[RlftsimError] = DataError,
    missing: str = "",
) -> Iterator[None]:
    """Context in which a library reads a file, no pipe: its errors become one line that names file, cause and way out.

    Args:
        path: File that is read.
        damage: Errors of the library that stand for a damaged file.
        remedy: Way out at the end of the message.
        words: Words behind the path.
        describe: Function from an error to the cause in words.
        error: Class of the errors raised.
        missing: Whole message where there is no such file; empty leaves it to the caller.

    Raises:
        FileNotFoundError: No such file, and no message for that.
        RlftsimError: Damaged file, or a pipe.
    """
    try:
        check_has_end(path)
        yield
    except FileNotFoundError:
        if missing:
            raise error(missing) from None
        raise
    except damage as problem:
        way_out = PERMISSION_WAY_OUT if isinstance(problem, PermissionError) else remedy
        raise error(f"{path}{words} ({describe(problem)}): {way_out}.") from None


def _read_bytes(path: str | PathLike[str], limit: int, remedy: str, error: type[RlftsimError], missing: str) -> bytes:
    # ValueError: a null byte in the name
    with explained_damage(path, (OSError, ValueError, ZlibError), remedy, error=error, missing=missing):
        with open(path, "rb") as file:
            # a device or a pipe has no size, so the bytes that come are counted, too
            text = file.read(limit + 1) if fstat(file.fileno()).st_size <= limit else None
        if text and text.startswith(_GZIP):
            text = decompressobj(wbits=31).decompress(text, limit + 1)
    if text is None or len(text) > limit:
        raise error(f"{path}: larger than {limit >> 20} MiB, which no such file is: {remedy}.")
    return text


def _parse(text: str | bytes, parse: Callable[[str], Any], source: str, remedy: str, error: type[RlftsimError]) -> Any:
    """Parsed text; every cause of failure becomes an error of a single line."""
    try:
        decoded = text.decode("utf-8-sig") if isinstance(text, bytes) else text.removeprefix("\ufeff")
        value = parse(decoded)
    except UnicodeDecodeError:
        cause = "not text in UTF-8"
    except UnicodeEncodeError as problem:
        cause = f"half a character, U+{ord(problem.object[problem.start]):04X}, in a text"
    except RecursionError:
        cause = f"brackets nested more than {MAX_DEPTH} deep"
    except ValueError as problem:
        cause = first_line(problem)
    else:
        return value
    raise error(f"{source}: {cause}: {remedy}.") from None


def _build_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON, in which no name is written twice; `json` would keep the last value."""
    values = dict(pairs)
    if len(values) < len(pairs):
        repeated = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"{repeated[:LONGEST_NAME]!r} is written more than once")
    return values


def _count_names(value: Any) -> int:
    """Number of names in all objects; a RecursionError where brackets are nested more than `MAX_DEPTH` deep."""
    count, level = 0, [value]
    for _ in range(MAX_DEPTH + 2):
        objects = [inner for inner in level if inner.__class__ is dict]
        lists = [inner for inner in level if inner.__class__ is list]
        if not objects and not lists:
            return count
        count += sum(map(len, objects))
        level = chain(chain.from_iterable(map(dict.values, objects)), chain.from_iterable(lists))
        level = [inner for inner in level if inner.__class__ is dict or inner.__class__ is list]
    raise RecursionError
