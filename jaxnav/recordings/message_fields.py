"""Field types of the messages of a recorded drive: how each is read, and its JSON schema."""

import base64
import binascii
import enum
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Shaped
from pydantic import BeforeValidator, Field, WithJsonSchema
from pydantic_core import core_schema

from jaxnav.drive.flags import Fault
from jaxnav.files.ranges import RANGES

# JSON schema's name of a type -> the check of its values, and their dtype.
_ITEMS: dict[str, tuple[core_schema.CoreSchema, type]] = {
    "number": (core_schema.float_schema(strict=True), float),
    "integer": (core_schema.int_schema(strict=True, ge=-(2**63), lt=2**63), int),
    "boolean": (core_schema.bool_schema(strict=True), bool),
}
_MOST_KNOWN = 1000  # lists of words whose flags are cached
_MOST_SIDES = 32  # of a covariance: a state has 6 to 9 numbers


@dataclass(frozen=True)
class Array:
    """A field that reads a flat list as an array, row by row.

    Attributes:
        items: type of the values, as JSON schema names it.
        shape: shape of the array; its first axis may be -1, of any length.
    """

    items: str
    shape: tuple[int, ...] = (-1,)

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        # The values are checked by compiled code: a drive has a million lists.
        values = core_schema.list_schema(_ITEMS[self.items][0], strict=True)
        return core_schema.no_info_after_validator_function(self._shaper(), values)

    def _shaper(self) -> Callable[[list[Any]], np.ndarray]:
        dtype, shape = _ITEMS[self.items][1], self.shape
        row, is_fixed = math.prod(size for size in shape if size > 0), -1 not in shape
        of_none = (0, *shape[1:])
        if shape == (-1,):
            return lambda values: np.array(values, dtype)

        def shaped(values: list[Any]) -> np.ndarray:
            if len(values) % row or (is_fixed and len(values) != row):
                raise ValueError(f"must hold {row} values{'' if is_fixed else ' a row'}")
            return np.array(values, dtype).reshape(shape if values else of_none)

        return shaped

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        return {"type": "array", "items": {"type": self.items}}


@dataclass(frozen=True)
class Rows:
    """Rows of an array as one list, made by the thread that writes them, not by the driving one."""

    array: Any
    which: Any = ...
    made: Callable[[Any], Any] | None = None  # of the rows, as to the world's coordinates

    @property
    def values(self) -> Shaped[np.ndarray, "..."]:
        """The rows as an array."""
        rows = self.array[self.which]
        return np.asarray(rows if self.made is None else self.made(rows))

    def tolist(self) -> list[Any]:
        """The rows as one list, as `encode` writes them."""
        values: list[Any] = self.values.ravel().tolist()
        return values


@dataclass(frozen=True)
class Words:
    """A field that reads flags from the list of their names, or an enum from its name."""

    kind: type[enum.Enum]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        known: dict[Any, Any] = {}

        def read(value: Any) -> Any:
            words = tuple(value) if isinstance(value, list) else value
            try:
                return known[words]
            except (KeyError, TypeError):  # TypeError: holds what is no text
                result = self._read(value)
            if len(known) < _MOST_KNOWN:
                known[words] = result
            return result

        return core_schema.no_info_plain_validator_function(read)

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


def square(array: Float[np.ndarray, " entries"]) -> Float[np.ndarray, "side side"]:
    """The square matrix of these values.

    Raises:
        ValueError: their number is not a square, or the matrix is too large.
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
