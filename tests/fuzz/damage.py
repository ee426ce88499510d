"""One damaged file out of a sound one, the same for the same generator."""

import copy
import io
import json
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from jaxnav.files.reading import read_mapping
from tests.fuzz.seeds import Parts, drive_parts, write_drive
from tests.helpers.mutations import Keys, edited_by, places_in, restructured_by
from tests.helpers.yaml_numbers import dumped

_BYTES_SHARE = 0.2  # of files whose values can be changed too
_ALL_SHARE = 0.4  # of a recording's messages of one topic, all are changed alike
ODD_NUMBERS = [
    0, -1, 1e-6, 1e9, 1e300, -1e308, np.nan, np.inf, 2**31, 2**62, -(2**63), 2**63 - 1, 2**63,
]  # fmt: skip
NAMES = [
    "\u00b21", "a\nb", "\x1b[31mred\x1b[0m", "a\u202eb", "$\\frac$", "a b", "-x", "\udcff",
    "n" * 200, "{x}", "%s", "\u4e2d\u6587", "'", "a\rb", "x=y",
]  # fmt: skip


def damage(rng: Random, path: Path) -> None:
    """Change a file in one place or a few."""
    by_value = rng.random() >= _BYTES_SHARE
    if by_value and path.suffix in (".yaml", ".yml", ".json"):
        path.write_text(_restructured(rng, path))
    elif by_value and path.suffix == ".mcap":
        parts = _parts_of(path.read_bytes())
        if parts:
            write_drive(path, _changed_drive(rng, parts))
        else:  # a ROS bag
            path.write_bytes(edited_by(rng, path.read_bytes()))
    elif by_value and path.suffix == ".npz":
        path.write_bytes(_changed_arrays(rng, path))
    else:
        path.write_bytes(edited_by(rng, path.read_bytes()))


def _restructured(rng: Random, path: Path) -> str:
    data, places = _data_of(path.read_bytes(), path.suffix)
    changed = restructured_by(rng, data, places).data
    try:
        return json.dumps(changed) if path.suffix == ".json" else dumped(changed)
    except ValueError:  # an integer that Python does not write in digits
        return "a: 1"


@cache
def _data_of(raw: bytes, suffix: str) -> tuple[Any, list[Keys]]:
    scratch = Path(f"/dev/shm/jaxnav-fuzz-{hash(raw)}{suffix}")
    scratch.write_bytes(raw)
    try:
        data = read_mapping(scratch)
    finally:
        scratch.unlink()
    return data, list(places_in(data))


@cache
def _parts_of(raw: bytes) -> Parts:
    scratch = Path(f"/dev/shm/jaxnav-fuzz-{hash(raw)}.mcap")
    scratch.write_bytes(raw)
    try:
        return drive_parts(scratch)
    finally:
        scratch.unlink()


def _changed_drive(rng: Random, parts: Parts) -> Parts:
    """With one value of the header or of a message changed, or the same in all of a topic."""
    topic = rng.choice(sorted({name for name, _ in parts}))
    which = [index for index, (name, _) in enumerate(parts) if name == topic]
    index = rng.choice(which)
    changed = list(parts)
    action = rng.random()
    if action < 0.03:
        del changed[index]
    elif action < 0.06:
        changed.insert(index, copy.deepcopy(changed[index]))
    elif action < 0.09:
        rng.shuffle(changed)
    else:
        alike = topic != "header" and rng.random() < _ALL_SHARE
        after = rng.getrandbits(64)
        for other in which if alike else [index]:
            again = Random(after)
            places = list(places_in(changed[other][1]))
            changed[other] = (topic, restructured_by(again, changed[other][1], places).data)
    return changed


def _changed_arrays(rng: Random, path: Path) -> bytes:
    with np.load(path) as archive:
        arrays = dict(archive)
    key = rng.choice(sorted(arrays))
    array = arrays[key]
    kind = rng.choice(["number", "number", "number", "all", "drop", "dtype", "shape", "text"])
    with np.errstate(all="ignore"):
        if kind in ("number", "all") and array.dtype.kind in "if" and array.size:
            odd = rng.choice(ODD_NUMBERS)
            array = array.copy()
            where = (
                ... if kind == "all" else np.unravel_index(rng.randrange(array.size), array.shape)
            )
            try:
                array[where] = odd
            except (OverflowError, ValueError):
                array = array.astype(float)
                array[where] = float(odd)
        elif kind == "drop":
            array = None
        elif kind == "dtype":
            types = ["float32", "uint8", "uint64", "complex64", "U9", "bool", "S3"]
            array = array.astype(rng.choice(types)) if array.dtype.kind != "U" else array
        elif kind == "shape":
            shapes = [array[:0], array[:1], array.reshape(-1), array[None]]
            array = rng.choice([*shapes, np.concatenate([array, array])])
        elif kind == "text" and array.dtype.kind == "U":
            name = rng.choice(["", "a\nb", "\x1b[31mx", "n" * 300, "\u202e"])
            array = np.array([name] * len(array))
    arrays = {name: value for name, value in (arrays | {key: array}).items() if value is not None}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()
