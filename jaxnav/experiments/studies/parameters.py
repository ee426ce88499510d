"""Define a study's parameters, with unit, default and bounds, and parse the values of an axis."""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxnav.errors import BadInput

Value = float | int | str | None
RANDOM = "random"
_MAX_VALUES = 100_000
_LEAST_TOLD_PX = 0.1


@dataclass(frozen=True)
class Parameter:
    """A parameter that an axis may vary or a study may hold fixed."""

    description: str
    unit: str
    default: Value
    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False  # `low` itself is excluded
    whole: bool = False  # whole numbers only
    choices: tuple[str, ...] = ()  # words instead of numbers
    words: tuple[str, ...] = ()  # words besides numbers, for a fixed value
    static: bool = False  # another value needs another compiled program

    def check(self, value: Any, where: str) -> Value:
        """The checked value.

        Raises:
            BadInput: this parameter cannot have the value.
        """
        if self.choices:
            if value not in self.choices:
                raise BadInput(where, f"unknown {value!r}: expected {', '.join(self.choices)}")
            return str(value)
        if value is None and self.default is None:
            return None
        if isinstance(value, str) and value in self.words:
            return value
        if isinstance(value, bool) or not isinstance(value, int | float):
            also = f" or {' or '.join(self.words)}" if self.words else ""
            raise BadInput(where, f"must be a number{also}, got {value!r}")
        if not _is_finite(value):
            raise BadInput(where, f"must be finite, got {str(value)[:40]}")
        if self.whole and value != int(value):
            raise BadInput(where, f"must be a whole number, got {value}")
        if not self.low <= value <= self.high or (self.open_low and value == self.low):
            raise BadInput(where, f"must be {self._bounds()}, got {value}")
        return int(value) if self.whole else float(value)

    def values(self, given: Any, where: str) -> list[Value]:
        """The values of an axis: a list, or `{from, to, count}` with an optional `scale: log`.

        Raises:
            BadInput: empty, repeated or impossible values.
        """
        if isinstance(given, Mapping):
            return [self.check(x, where) for x in _spaced(given, where)]
        if not isinstance(given, Sequence) or isinstance(given, str):
            raise BadInput(where, f"must be a list, or {{from, to, count}}, got {given!r}")
        if not given:
            raise BadInput(where, "is an empty axis: the grid has no cell")
        if len(given) > _MAX_VALUES:
            raise BadInput(where, f"has {len(given)} values, at most {_MAX_VALUES} are possible")
        values = [self.check(x, f"{where}[{i}]") for i, x in enumerate(given)]
        for i, value in enumerate(values):
            if value is None or (value in self.words and not self.choices):
                raise BadInput(f"{where}[{i}]", "must be a number to lie on an axis")
            if value in values[:i]:
                raise BadInput(f"{where}[{i}]", f"repeats {value!r}")
        return values

    def _bounds(self) -> str:
        low = f"{'>' if self.open_low else '>='} {self.low:g}" if self.low > -math.inf else ""
        high = f"<= {self.high:g}" if self.high < math.inf else ""
        return " and ".join(bound for bound in (low, high) if bound)


def positive(description: str, unit: str, default: float | None) -> Parameter:
    """A parameter whose values are numbers above zero."""
    return Parameter(description, unit, default, low=0.0, open_low=True)


def cameras(description: str) -> Parameter:
    """A parameter for the number of cameras."""
    return Parameter(description, "", None, low=1, high=64, whole=True, static=True)


def told_noise_px(told_px: float | None, noise_px: float) -> float:
    """The sigma given to an estimator: by default the true noise, but at least a small number."""
    return max(noise_px, _LEAST_TOLD_PX) if told_px is None else told_px


def _is_finite(value: float) -> bool:
    """Whether a value is finite as a float: integers in a file may be too large."""
    return abs(value) <= sys.float_info.max


def _spaced(given: Mapping[str, Any], where: str) -> list[float]:
    """The values of `{from, to, count}`, or with `scale: log`, evenly spaced, ends included."""
    unknown = set(given) - {"from", "to", "count", "scale"}
    if unknown:
        raise BadInput(
            f"{where}.{min(map(str, unknown))}", "unknown key: expected from, to, count, scale"
        )
    ends = []
    for key in ("from", "to", "count"):
        value = given.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise BadInput(f"{where}.{key}", f"must be a number, got {value!r}")
        if not _is_finite(value):
            raise BadInput(f"{where}.{key}", f"must be finite, got {str(value)[:40]}")
        ends.append(float(value))  # NumPy takes no whole number above 2^64
    begin, end, count = ends
    if not 1 <= count <= _MAX_VALUES or count != int(count):
        raise BadInput(
            f"{where}.count", f"must be a whole number from 1 to {_MAX_VALUES}, got {count}"
        )
    if count > 1 and not begin < end:
        raise BadInput(f"{where}.to", f"must be larger than `from`, got {begin} and {end}")
    scale = given.get("scale", "linear")
    if scale not in ("linear", "log"):
        raise BadInput(f"{where}.scale", f"must be linear or log, got {scale!r}")
    if scale == "log":
        if begin <= 0:
            raise BadInput(f"{where}.from", f"must be > 0 on a log scale, got {begin}")
        spaced = np.geomspace(begin, end, int(count))
    else:
        spaced = np.linspace(begin, end, int(count))
    # Rounded as a person would type them: 0.3 and not 0.30000000000000004.
    return [float(f"{x:.12g}") for x in spaced]
