"""Small damage to files, drawn by hypothesis: to their bytes, or to one value of what they hold."""

import copy
import math
from dataclasses import dataclass
from typing import Any

from hypothesis import strategies as st

VALUES = [
    None, True, "", "text", "1", "1e3", "x" * 5000, "../up", "a\nb",
    0, -1, 1, 2, 2**31, 2**63, 10**30, 10**400, -(10**400),
    0.0, 0.5, -0.5, 1e-308, 1e308, -1e308, math.nan, math.inf, -math.inf,
    [], {}, [0], [[]], [None], ["text"], [10**400, 0.5], {"a": {"b": 1}}, {"name": 1}, [1.0] * 500,
]  # fmt: skip


@dataclass(frozen=True)
class Changed:
    """Plain data with one thing changed.

    Attributes:
        keys: the way there, from the top; the last is what was changed.
        new_key: what it is called now, None where it is called as before or gone.
    """

    data: Any
    keys: tuple[str | int, ...]
    new_key: str | None = None

    def is_named_in(self, line: str) -> bool:
        """Whether a message names the place, or one that it lies in."""
        words = [key for key in (*self.keys, self.new_key) if isinstance(key, str)]
        return not words or any(word in line for word in words)


def edited(raw: bytes) -> st.SearchStrategy[bytes]:
    """Bytes with a few changed, put in, taken out or repeated, or cut short."""
    kinds = st.sampled_from(["change", "flip", "insert", "remove", "repeat", "cut"])
    edit = st.tuples(kinds, st.integers(0, len(raw)), st.binary(min_size=1, max_size=8))

    def apply(edits: list[tuple[str, int, bytes]]) -> bytes:
        changed = bytearray(raw)
        for kind, place, new in edits:
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

    return st.lists(edit, min_size=1, max_size=3).map(apply)


def restructured(data: Any) -> st.SearchStrategy[Changed]:
    """A mapping with one value replaced, removed or renamed, anywhere in it."""
    places = list(_places(data))
    actions = st.sampled_from(["replace", "replace", "replace", "drop", "rename", "repeat"])

    def apply(drawn: tuple[tuple[str | int, ...], str, Any]) -> Changed:
        keys, action, value = drawn
        changed = copy.deepcopy(data)
        holder = changed
        for key in keys[:-1]:
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

    drawn = st.tuples(st.sampled_from(places), actions, st.sampled_from(VALUES))
    return drawn.map(apply)


def _places(data: Any, keys: tuple[str | int, ...] = ()) -> Any:
    """The ways to all values; of a long list to its first and last."""
    inner = data.items() if isinstance(data, dict) else enumerate(data)
    count = len(data)
    for key, value in inner:
        if isinstance(key, int) and 3 < key < count - 1:
            continue
        yield (*keys, key)
        if isinstance(value, dict | list):
            yield from _places(value, (*keys, key))
