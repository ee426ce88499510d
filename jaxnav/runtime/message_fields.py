"""Kinds of fields of the messages of a recorded drive: how each is read, and its JSON schema."""

import base64
import binascii
import enum
import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, WithJsonSchema
from pydantic_core import core_schema

from jaxnav.files.ranges import RANGES
from jaxnav.runtime.flags import Fault

_MOST_SIDES = 32  # of a covariance: a state has 6 to 9 numbers


@dataclass(frozen=True)
class Array:
    """A list as an array, row by row.

    Attributes:
        items: their type in JSON schema's word.
        shape: its first axis may be -1, of any length.
    """

    items: str
    shape: tuple[int, ...] = (-1,)

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.no_info_plain_validator_function(self._read)

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        return {"type": "array", "items": {"type": self.items}}

    def _read(self, value: Any) -> np.ndarray:
        if not isinstance(value, list):
            raise ValueError("must be a list")
        kinds, dtype = {"number": ("fi", float), "integer": ("i", int), "boolean": ("b", bool)}[
            self.items
        ]
        array = np.array(value)  # ValueError: lists inside, of several lengths
        if array.ndim != 1 or (array.size and array.dtype.kind not in kinds):
            raise ValueError(f"must be a list of values that are each of the type {self.items}")
        row = math.prod(size for size in self.shape if size > 0)
        if array.size % row or (-1 not in self.shape and array.size != row):
            raise ValueError(f"must hold {row} values{' a row' if -1 in self.shape else ''}")
        return array.astype(dtype).reshape(self.shape if array.size else (0, *self.shape[1:]))


@dataclass(frozen=True)
class Words:
    """Flags as the list of their names, or an enum as its name."""

    kind: type[enum.Enum]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.no_info_plain_validator_function(self._read)

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        word = {"type": "string", "enum": list(self.kind.__members__)}
        return {"type": "array", "items": word} if issubclass(self.kind, enum.IntFlag) else word

    def _read(self, value: Any) -> Any:
        if not issubclass(self.kind, enum.IntFlag):
            return self._member(value)
        if not isinstance(value, list):
            raise ValueError("must be a list")
        flags = self.kind(0)
        for word in value:
            flags |= self._member(word)
        return flags

    def _member(self, word: Any) -> Any:
        if not isinstance(word, str) or word not in self.kind.__members__:
            raise ValueError(f"unknown word {str(word)[:40]!r}")
        return self.kind[word]


def _bytes(value: Any) -> bytes:
    try:
        return base64.b64decode(value, validate=True)
    except (binascii.Error, TypeError, ValueError):
        raise ValueError("must be base64") from None


def square(array: np.ndarray) -> np.ndarray:
    """The matrix of these values.

    Raises:
        ValueError: their number is no square.
    """
    side = math.isqrt(array.size)
    if side**2 != array.size or side > _MOST_SIDES:
        raise ValueError(f"must be a square matrix, got {array.size} values")
    return array.reshape(side, side)


_STAMP, _INDEX = RANGES["stamp_ns"], RANGES["index"]
Now = Annotated[int, Field(strict=True, ge=0, lt=int(_STAMP.most) + 1)]  # ns, the loop's own clock
Index = Annotated[int, Field(strict=True, ge=int(_INDEX.least), le=int(_INDEX.most))]  # -1: none
# ns, whatever a driver says.
Stamp = Annotated[int, Field(strict=True, ge=int(_STAMP.least), le=int(_STAMP.most))]
Real = Annotated[float, Field(strict=True)]  # also NaN and infinite
Flag = Annotated[bool, Field(strict=True)]
Word = Annotated[str, Field(strict=True)]
Faults = Annotated[Fault, Words(Fault)]
Base64 = Annotated[
    bytes,
    BeforeValidator(_bytes),
    WithJsonSchema({"type": "string", "contentEncoding": "base64"}),
]
