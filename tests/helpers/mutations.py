"""Small damage to files: to their bytes, or to one value of what they hold.

Drawn by hypothesis, which makes a failure small, or by a plain generator, which takes microseconds.
"""

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any

from hypothesis import strategies as st

VALUES = [
    None, True, "", "text", "1", "1e3", "x" * 5000, "../up", "a\nb", "a\rb", "\x1b[31mred\x1b[0m",
    "a\u202eb", "$\\frac$", "\u00b2",
    0, -1, 1, 2, 2**31, 2**63, 2**70, 10**30, 10**400, -(10**400),
    0.0, 0.5, -0.5, 1e-6, 1e9, 1e-308, 1e300, 1e308, -1e308, math.nan, math.inf, -math.inf,
    [], {}, [0], [[]], [None], ["text"], [10**400, 0.5], {"a": {"b": 1}}, {"name": 1}, [1.0] * 500,
]  # fmt: skip
_EDITS = ["change", "flip", "insert", "remove", "repeat", "cut"]
_ACTIONS = ["replace", "replace", "replace", "drop", "rename", "repeat"]
Keys = tuple[str | int, ...]


@dataclass(frozen=True)
class Changed:
    """Plain data with one thing changed.

    Attributes:
        keys: the way there, from the top; the last is what was changed.
        new_key: what it is called now, None where it is called as before or gone.
    """

    data: Any
    keys: Keys
    new_key: str | None = None

    def is_named_in(self, line: str) -> bool:
        """Whether a message names the place, or one that it lies in."""
        words = [key for key in (*self.keys, self.new_key) if isinstance(key, str)]
        return not words or any(word in line for word in words)


def edited_by(rng: Random, raw: bytes) -> bytes:
    """Bytes with a few changed, put in, taken out or repeated, or cut short."""
    changed = bytearray(raw)
    for _ in range(rng.randint(1, 3)):
        kind, place = rng.choice(_EDITS), rng.randint(0, len(raw))
        new = rng.randbytes(rng.randint(1, 8))
        end = place + len(new)
        if kind == "change":
            changed[place:end] = new
        elif kind == "flip" and place < len(changed):
            changed[place] ^= 1 << new[0] % 8
        elif kind == "insert":
            changed[place:place] = new
        elif kind == "remove":
            del changed[place : place + new[0]]
        elif kind == "repeat":
            changed[place:place] = changed[place : place + 8 * new[0]]
        elif kind == "cut":
            del changed[place:]
    return bytes(changed)


def restructured(data: Any) -> st.SearchStrategy[Changed]:
    """A mapping with one value replaced, removed or renamed, anywhere in it."""
    places = list(places_in(data))
    drawn = st.tuples(st.sampled_from(places), st.sampled_from(_ACTIONS), st.sampled_from(VALUES))
    return drawn.map(lambda change: _restructured(data, *change))


def restructured_by(rng: Random, data: Any, places: Sequence[Keys]) -> Changed:
    """The same, by a plain generator.

    Args:
        places: of `places_in(data)`.
    """
    return _restructured(data, rng.choice(places), rng.choice(_ACTIONS), rng.choice(VALUES))


def _restructured(data: Any, keys: Keys, action: str, value: Any) -> Changed:
    changed = holder = copy.copy(data)
    for key in keys[:-1]:  # only what changes is copied
        holder[key] = copy.copy(holder[key])
        holder = holder[key]
    last, new_key = keys[-1], None
    if action == "replace":
        holder[last] = copy.deepcopy(value)
    elif action == "drop":
        del holder[last]
    elif isinstance(holder, list):
        holder.insert(last, copy.deepcopy(holder[last]))
    else:
        new_key = f"{last}_2"
        holder[new_key] = copy.deepcopy(holder[last])
        if action == "rename":
            del holder[last]
    return Changed(changed, keys, new_key)


def places_in(data: Any, keys: Keys = ()) -> Iterator[Keys]:
    """The ways to all values; of a long list to its first and last."""
    inner = data.items() if isinstance(data, dict) else enumerate(data)
    count = len(data)
    for key, value in inner:
        if isinstance(key, int) and 3 < key < count - 1:
            continue
        yield (*keys, key)
        if isinstance(value, dict | list):
            yield from places_in(value, (*keys, key))
