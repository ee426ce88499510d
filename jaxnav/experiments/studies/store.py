"""Keep results on disk, one Zarr store per study, which xarray can open.

The grid is cut into boxes of cells and trials. A box is written whole, as one chunk, and only then
marked as done, so a killed study continues where it stopped. A store belongs to one config and to
one set of versions; others are refused.
"""

import glob
import itertools
import json
import math
import os
import secrets
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray as xr
import zarr
from jaxtyping import Shaped
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.errors import ZarrUserWarning

from jaxnav.errors import BadInput
from jaxnav.experiments.studies.study import Config, Study
from jaxnav.files import limits
from jaxnav.files.reading import check_regular

_DONE = "done"  # the array of marks: 1 where a box is done
# Both with checksums, so that a number changed by the disk is not taken for a result.
_CHECKED, _COMPRESSED = Crc32cCodec(), ZstdCodec(level=0, checksum=True)
_PACKAGES = ("jaxnav", "jax", "jaxlib", "equinox", "optimistix", "numpy")
_LONGEST = 200  # characters kept of a library's message on broken bytes; it may quote them all
Box = tuple[int, ...]


def versions() -> dict[str, str]:
    """The versions on which the bits of a result depend besides its config."""
    return {name: version(name) for name in _PACKAGES} | {"backend": jax.default_backend()}


@dataclass(frozen=True)
class BoxLayout:
    """A grid of cells and trials cut into boxes of one size; those at the ends may be smaller."""

    shape: tuple[int, ...]  # of the outer axes, then the trials
    box: tuple[int, ...]

    @staticmethod
    def from_shape(shape: Sequence[int], most: int) -> "BoxLayout":
        """Cut boxes of at most `most` trials: first one cell's, then its neighbours'."""
        room, box = max(most, 1), []
        for length in reversed(shape):
            box.append(min(length, max(room, 1)))
            room //= box[-1]
        return BoxLayout(tuple(shape), tuple(reversed(box)))

    @property
    def counts(self) -> tuple[int, ...]:
        """The number of boxes along each axis."""
        return tuple(-(-n // b) for n, b in zip(self.shape, self.box, strict=True))

    @property
    def trials(self) -> int:
        """The number of trials in all cells."""
        return math.prod(self.shape)

    def region(self, index: Sequence[int]) -> tuple[slice, ...]:
        """The slices of the box at an index."""
        return tuple(
            slice(i * b, min((i + 1) * b, n))
            for i, b, n in zip(index, self.box, self.shape, strict=True)
        )

    def size(self, index: Sequence[int]) -> int:
        """The number of trials in the box at an index."""
        return math.prod(part.stop - part.start for part in self.region(index))

    def cells(self, index: Sequence[int]) -> Iterator[tuple[int, ...]]:
        """The cells of the box at an index, the last axis fastest."""
        return itertools.product(*(range(s.start, s.stop) for s in self.region(index)[:-1]))


class StudyStore:
    """The store of a study.

    Attributes:
        config, versions: of the study that wrote it, as plain data.
        layout: how its grid is cut into boxes.
    """

    def __init__(self, path: Path, mode: Any = "r"):
        """Open a store that exists, for reading unless `mode` is "r+"; see also `open_store`.

        Raises:
            BadInput: it is not a store of a study, or damaged.
        """
        self.path = path
        group = _open_group(path, mode)
        self.config, self.versions = (_mapping(path, group, key) for key in ("config", "versions"))
        with reading(path):
            self._arrays: dict[str, Any] = dict(group.arrays())
            self._done = self._arrays[_DONE]
            self.layout = _declared_layout(path, dict(self._done.attrs), self._done.shape)

    def missing(self) -> Iterator[Box]:
        """The boxes that are not done, in order.

        Raises:
            BadInput: the record of finished boxes is damaged.
        """
        with reading(self.path):
            done = np.asarray(self._done[...])
        for index in np.argwhere(done != 1):
            yield tuple(int(i) for i in index)

    def count_done(self) -> int:
        """The number of finished trials, over all cells.

        Raises:
            BadInput: the record of finished boxes is damaged.
        """
        return self.layout.trials - sum(self.layout.size(box) for box in self.missing())

    def dataset(self, config: Config | None = None) -> xr.Dataset:
        """All trials as a lazy dataset: values are loaded on access.

        Args:
            config: axes, variables and layout must be those of this study.

        Raises:
            BadInput: the store is damaged, or an axis or a variable, which it names, does not fit.
        """
        with reading(self.path):
            trials = xr.open_zarr(
                self.path, chunks=None, consolidated=False, mask_and_scale=False
            ).drop_vars(_DONE)
            if config is not None:
                _check(self.path, self.layout, trials, config)
        return trials

    def write(
        self, box: Box, results: Mapping[str, Shaped[np.ndarray, "cells ... trials"]]
    ) -> None:
        """Write the results of one box, and mark it as done.

        Raises:
            BadInput: the disk is full, or the store can't be written to.
        """
        *outer, trials = self.layout.region(box)
        lengths = [part.stop - part.start for part in outer]
        try:
            for name, values in results.items():
                shaped = values.reshape(*lengths, *values.shape[1:])
                self._arrays[name][(*outer, ..., trials)] = shaped
            self._done[box] = 1
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise BadInput(
                self.path, f"can't be written: {reason}; what is in it stays readable"
            ) from None


def open_store(path: Path, study: Study, box_trials: int | None = None) -> StudyStore:
    """Open the store of a study, or create it.

    Raises:
        BadInput: it is not a study's store, belongs to another study, or can't be made.
    """
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        _create(path, study, box_trials or study.box_trials)
    store = StudyStore(path, "r+")
    differing = [
        *_difference(study.config.to_dict(), store.config),
        *_difference(versions(), store.versions),
    ]
    if differing:
        raise BadInput(
            path, f"holds another study and is not mixed with this one: {'; '.join(differing)}"
        )
    store.dataset(study.config)
    return store


def sweep_unfinished(path: Path) -> None:
    """Remove the remains of a process that was killed while it created this store.

    Only for a caller that knows that no other process works on it, see `sole_writer`.
    """
    for left in path.parent.glob(f"{glob.escape(_unfinished(path))}*"):
        shutil.rmtree(left, ignore_errors=True)


def check_sizes(path: Path, arrays: Mapping[str, Any]) -> None:
    """Check that no part of a store that is read at once is too large, as its arrays declare.

    Such a part is one chunk of any array, and the whole of an axis and of `done`.

    Raises:
        BadInput: a part is too large.
    """
    for name, array in arrays.items():
        is_whole = name == _DONE or tuple(array.metadata.dimension_names or ()) == (name,)
        count = math.prod(array.shape if is_whole else array.chunks)
        count = max(count, math.prod(array.chunks))
        if array.shards is not None or count * array.dtype.itemsize > limits.STORE_BYTES:
            raise BadInput(f"{path}: {name}", f"is too large: {array.shape} by {array.chunks}")


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


def _open_group(path: Path, mode: Any) -> zarr.Group:
    if not path.exists():
        raise BadInput(path, "doesn't exist")
    for folder, _, files in os.walk(path):
        for file in files:
            check_regular(Path(folder, file))
    try:
        with warnings.catch_warnings(action="ignore", category=ZarrUserWarning):
            group = zarr.open_group(path, mode=mode)
            is_ours = _DONE in group
            check_sizes(path, dict(group.arrays()))
    except BadInput:
        raise
    except Exception as error:  # damaged bytes may raise anything
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadInput(path, f"is not a store of jaxnav study ({reason})") from None
    if not is_ours:
        raise BadInput(path, "is not a store of jaxnav study")
    return group


def _mapping(path: Path, group: zarr.Group, key: str) -> dict[str, Any]:
    try:
        value = json.loads(str(dict(group.attrs)[key]))
    except (KeyError, TypeError, ValueError, RecursionError):
        raise BadInput(path, "is not a store of jaxnav study") from None
    if not isinstance(value, dict):
        raise BadInput(f"{path}: {key}", "must be a mapping")
    return value


def _declared_layout(
    path: Path, attributes: Mapping[str, Any], counts: tuple[int, ...]
) -> BoxLayout:
    """The layout by the attributes of `done`, whose shape is `counts`."""
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


def _check(path: Path, layout: BoxLayout, trials: xr.Dataset, config: Config) -> None:
    """Check a store's layout, axes and variables, not yet their numbers, against a config."""
    if layout.shape != config.shape:
        problem = f"must be {list(config.shape)}, as the config says, got {list(layout.shape)}"
        raise BadInput(f"{path}: done.shape", problem)
    for name, values in config.axes.items():
        if name not in trials.coords or trials.coords[name].values.tolist() != list(values):
            raise BadInput(f"{path}: {name}", "is not the axis that the config says")
    for name, variable in config.schema.variables.items():
        if name not in trials:
            raise BadInput(f"{path}: {name}", "missing")
        wanted = config.sizes(variable), np.dtype(variable.dtype)
        form = dict(trials[name].sizes), trials[name].dtype
        if form != wanted or [*form[0]] != [*wanted[0]]:
            raise BadInput(f"{path}: {name}", f"must be {wanted}, got {form}")


def _create(path: Path, study: Study, box_trials: int) -> None:
    """Create a new store, whole or not at all."""
    config, schema = study.config, study.schema
    layout = BoxLayout.from_shape(config.shape, box_trials)
    boxes = dict(zip((*config.outer_axes, "trial"), layout.box, strict=True))
    beside = path.with_name(_unfinished(path) + secrets.token_hex(4))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            about = {"config": json.dumps(config.to_dict()), "versions": json.dumps(versions())}
            title = f"jaxnav study {schema.kind}"
            group = zarr.create_group(beside, attributes={"title": title, **about})
            for name, values in config.axes.items():
                parameter = schema.parameters[name]
                coordinate = np.asarray(values, object if parameter.choices else None)
                dtype: Any = "string" if parameter.choices else coordinate.dtype
                group.create_array(
                    name,
                    shape=coordinate.shape,
                    chunks=coordinate.shape,
                    dtype=dtype,
                    dimension_names=[name],
                    compressors=_CHECKED,
                    attributes=_described(parameter.unit, parameter.description),
                )[...] = coordinate
            for name, variable in schema.variables.items():
                sizes, kind = config.sizes(variable), np.dtype(variable.dtype)
                attributes = _described(variable.unit, variable.description)
                if variable.outcomes:
                    attributes["flag_values"] = list(range(len(variable.outcomes)))
                    attributes["flag_meanings"] = " ".join(variable.outcomes)
                group.create_array(
                    name,
                    shape=tuple(sizes.values()),
                    chunks=tuple(boxes.get(name, length) for name, length in sizes.items()),
                    dtype=kind,
                    fill_value=math.nan if kind.kind == "f" else np.iinfo(kind).max,
                    dimension_names=list(sizes),
                    compressors=_COMPRESSED,
                    attributes=attributes,
                )
            group.create_array(
                _DONE,
                shape=layout.counts,
                chunks=(1,) * len(layout.counts),
                dtype="int8",
                fill_value=0,
                dimension_names=[f"{name}_box" for name in boxes],
                compressors=_CHECKED,
                attributes={"shape": list(layout.shape), "box": list(layout.box)},
            )
            if path.exists():
                path.rmdir()
            beside.rename(path)
        finally:
            shutil.rmtree(beside, ignore_errors=True)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise BadInput(path, f"can't be made: {reason}") from None


def _described(unit: str, description: str) -> dict[str, Any]:
    return {"units": unit or "1", "long_name": description}


def _unfinished(path: Path) -> str:
    """The prefix of the name of a store that is being created."""
    return f".jaxnav-{path.name}-"


def _difference(wanted: Mapping[str, Any], other: Mapping[str, Any], prefix: str = "") -> list[str]:
    """The differences between two studies, as lines `key: here, there`."""
    differing = []
    for key in sorted(set(wanted) | set(other)):
        here, there = wanted.get(key), other.get(key)
        if here == there and type(here) is type(there):
            continue
        name = f"{prefix}{key}"
        if isinstance(here, Mapping) and isinstance(there, Mapping):
            differing += _difference(here, there, f"{name}.") or [f"{name}: in another order"]
        else:
            differing.append(f"{name} is {_short(here)} here and {_short(there)} there")
    if not differing and list(wanted.get("axes", {})) != list(other.get("axes", {})):
        differing.append("axes are in another order")
    return differing


def _short(value: object) -> str:
    if value is None:
        return "nothing"
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
