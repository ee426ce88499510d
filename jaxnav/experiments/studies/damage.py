"""Check a store for damaged bytes and for parts that do not fit together, and name them."""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from jaxnav.errors import BadInput
from jaxnav.experiments.studies.layout import BoxLayout
from jaxnav.experiments.studies.study import Grid
from jaxnav.files import limits

_LONGEST = 200  # characters kept of a library's message on broken bytes; it may quote them all


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn any error of a block that reads a store into `BadInput`.

    Raises:
        BadInput: the data read are damaged.
    """
    try:
        yield
    except BadInput:
        raise
    except Exception as error:
        # Zarr, its codecs and xarray may raise anything on the bytes they find.
        said = f"{type(error).__name__}: {error}"
        shown = said if len(said) <= _LONGEST else f"{said[:_LONGEST]}..."
        raise BadInput(path, f"is damaged ({shown})") from None


def check_sizes(path: Path, arrays: Mapping[str, Any]) -> None:
    """Check that no part of a store that is read at once is too large, as its arrays declare.

    Such a part is one chunk of any array, and the whole of an axis and of `done`.

    Raises:
        BadInput: a part is too large.
    """
    for name, array in arrays.items():
        is_whole = name == "done" or tuple(array.metadata.dimension_names or ()) == (name,)
        count = math.prod(array.shape if is_whole else array.chunks)
        count = max(count, math.prod(array.chunks))
        if array.shards is not None or count * array.dtype.itemsize > limits.STORE_BYTES:
            raise BadInput(f"{path}: {name}", f"is too large: {array.shape} by {array.chunks}")


def layout_of(path: Path, attributes: Mapping[str, Any], counts: tuple[int, ...]) -> BoxLayout:
    """The layout that a store declares.

    Args:
        attributes: attributes of the array `done`, which marks the finished boxes.
        counts: shape of `done`.

    Raises:
        BadInput: the layout is impossible.
    """
    sizes: dict[str, tuple[int, ...]] = {}
    for key in ("shape", "box"):
        given = attributes.get(key)
        are_sizes = isinstance(given, list) and all(type(n) is int and n > 0 for n in given)
        if not isinstance(given, list) or not are_sizes or len(given) != len(counts):
            problem = f"must be {len(counts)} whole numbers above 0, got {given!r}"
            raise BadInput(f"{path}: done.{key}", problem)
        sizes[key] = tuple(given)
    layout = BoxLayout(**sizes)
    if layout.counts != counts:
        problem = f"does not fit its attributes, which make {layout.counts}: it has {counts}"
        raise BadInput(f"{path}: done", problem)
    return layout


def check_layout(path: Path, layout: BoxLayout, grid: Grid) -> None:
    """Check that a store's layout fits the grid of its config.

    Raises:
        BadInput: it does not.
    """
    expected = (*map(len, grid.outer_axes.values()), grid.config.trials)
    if layout.shape != expected:
        problem = f"must be {list(expected)}, as the config says, got {list(layout.shape)}"
        raise BadInput(f"{path}: done.shape", problem)


def check_trials(path: Path, trials: xr.Dataset, grid: Grid) -> None:
    """Check a store's axes and variables, not yet their numbers, against its config.

    Raises:
        BadInput: an axis or a variable, which it names, does not fit.
    """
    axes = grid.config.axes
    for name, values in axes.items():
        with reading(path):
            labels = trials.coords[name].values.tolist() if name in trials.coords else None
        if labels != list(values):
            raise BadInput(f"{path}: {name}", "is not the axis that the config says")
    sizes = {name: len(values) for name, values in axes.items()} | {"trial": grid.config.trials}
    for name, variable in grid.schema.variables.items():
        dims = grid.dimensions(variable)
        wanted = dims, tuple(sizes[dim] for dim in dims), np.dtype(variable.dtype)
        if name not in trials:
            raise BadInput(f"{path}: {name}", "missing")
        form = trials[name].dims, trials[name].shape, trials[name].dtype
        if form != wanted:
            raise BadInput(f"{path}: {name}", f"must be {wanted}, got {form}")
