"""Encode recorded messages as JSON that gives every number back bit for bit, and a NaN as a NaN.

Foxglove knows fields that are a number, a text, an object, or a list of these: no lists of lists,
and no "number or text". So an array is one list, row by row, and a field with a value that is not
finite, for which JSON has no number, stands apart from the others with words for such values:

    {"nis": 0.5, "not_finite": {"costs": [1.5, "inf"]}}
"""

import enum
import json
import math
import zlib
from pathlib import Path
from typing import Any, NoReturn

from pydantic_core import from_json

from jaxnav.drive.flags import names
from jaxnav.errors import BadInput

FORMAT_VERSION = 1
PROFILE = "jaxnav"  # of the MCAP file
HEADER = "jaxnav.drive"  # the name of the metadata record, the first of the file
NOT_FINITE = "not_finite"
_PARTS = {dict, list}
_WORDS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def encode(message: dict[str, Any]) -> bytes:
    """Encode a message as JSON.

    Args:
        message: plain values, arrays, flags (written as the list of their names) and enums (as
            their name).

    Raises:
        TypeError: a value of another kind.
        ValueError: a key is called `not_finite`.
    """
    return json.dumps(_object(message), allow_nan=False, separators=(",", ":")).encode()


def decode(raw: bytes) -> dict[str, Any]:
    """Decode what `encode` wrote into plain values.

    Raises:
        ValueError: the bytes are not such JSON.
    """
    try:
        message = from_json(raw, allow_inf_nan=False, cache_strings="keys")
    except ValueError:  # Python's own reader takes half a surrogate pair, and says where errors are
        try:
            message = json.loads(raw, parse_constant=_refuse)
        except RecursionError:
            raise ValueError("it is nested too deep") from None
    if NOT_FINITE.encode() in raw:
        message = _merged(message)
    if not isinstance(message, dict):
        raise ValueError("it is not an object")
    return message


def header_metadata(header: dict[str, Any]) -> dict[str, str]:
    """The header of a drive as MCAP metadata, with a CRC, since no chunk's CRC covers it."""
    text = encode(header).decode()
    checksum = f"{zlib.crc32(text.encode()):08x}"
    return {"format_version": str(FORMAT_VERSION), "header": text, "crc32": checksum}


def header_of(metadata: dict[str, str], path: Path) -> dict[str, Any]:
    """The header of a drive from MCAP metadata made by `header_metadata`.

    Raises:
        BadInput: the header has a newer format, or is damaged.
    """
    version = metadata.get("format_version", "")
    if not (version.isascii() and version.isdecimal() and len(version) < 10):
        raise BadInput(f"{path}: format_version", f"must be a whole number, got {version[:40]!r}")
    if int(version) != FORMAT_VERSION:
        problem = f"this program reads format {FORMAT_VERSION}, the file has {int(version)}"
        raise BadInput(f"{path}: format_version", problem)
    text = metadata.get("header", "")
    if metadata.get("crc32") != f"{zlib.crc32(text.encode()):08x}":
        raise BadInput(f"{path}: header", "is damaged (its checksum differs)")
    try:
        return decode(text.encode())
    except ValueError as error:
        raise BadInput(f"{path}: header", f"is not valid JSON: {error}") from None


def _object(mapping: dict[str, Any]) -> dict[str, Any]:
    if NOT_FINITE in mapping:
        raise ValueError(f"no key may be called {NOT_FINITE}")
    plain = {key: _plain(value) for key, value in mapping.items()}
    words = {key: _in_words(value) for key, value in plain.items() if not _is_finite(value)}
    if not words:
        return plain
    return {key: value for key, value in plain.items() if key not in words} | {NOT_FINITE: words}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return _object(value)
    if isinstance(value, enum.IntFlag):
        return names(value)
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return value.tolist() if hasattr(value, "tolist") else value  # arrays and their scalars


def _is_finite(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def _in_words(value: Any) -> Any:
    if isinstance(value, list):
        return [_in_words(inner) for inner in value]
    return value if _is_finite(value) else repr(float(value))


def _merged(value: Any) -> Any:
    """Plain values with what is not finite among the others again."""
    if isinstance(value, list) and not _PARTS.isdisjoint(map(type, value)):
        return [_merged(one) for one in value]
    if not isinstance(value, dict):
        return value
    mapping = {key: _merged(inner) for key, inner in value.items()}
    words = mapping.pop(NOT_FINITE, {})
    if not isinstance(words, dict) or words.keys() & mapping.keys():
        raise ValueError(f"{NOT_FINITE} must be an object of other keys")
    return mapping | {key: _in_numbers(word) for key, word in words.items()}


def _in_numbers(value: Any) -> Any:
    if isinstance(value, list):
        return [_in_numbers(inner) for inner in value]
    return _WORDS.get(value, value) if isinstance(value, str) else value


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON")
