"""Keep results on disk, one Zarr store per study, which xarray can open.

A box is written whole and only then marked as done, so a killed study continues where it stopped.
A store belongs to one config and to one set of versions; others are refused.
"""

import glob
import json
import math
import os
import secrets
import shutil
import warnings
from collections.abc import Iterator, Mapping
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
from jaxnav.experiments.studies.config import difference
from jaxnav.experiments.studies.damage import check_layout, check_sizes, layout_of, reading
from jaxnav.experiments.studies.layout import BoxLayout
from jaxnav.experiments.studies.study import Study, Variable
from jaxnav.files.reading import check_regular

_DONE = "done"
# Both with checksums, so that a number changed by the disk is not taken for a result.
_CHECKED, _COMPRESSED = Crc32cCodec(), ZstdCodec(level=0, checksum=True)
_PACKAGES = ("jaxnav", "jax", "jaxlib", "equinox", "optimistix", "numpy")
Box = tuple[int, ...]


def versions() -> dict[str, str]:
    """The versions on which the bits of a result depend besides its config."""
    return {name: version(name) for name in _PACKAGES} | {"backend": jax.default_backend()}


class StudyStore:
    """The store of one study."""

    def __init__(self, path: Path, study: Study):
        """Use `open_store`."""
        self.path = path
        self.study = study
        self._group = _open_group(path, "r+")
        with reading(path):
            self._arrays: dict[str, Any] = dict(self._group.arrays())
        self.layout = read_layout(path)
        check_layout(path, self.layout, study.grid)
        for name in study.schema.variables:
            if name not in self._arrays:
                raise BadInput(f"{path}: {name}", "missing")

    def missing(self) -> Iterator[Box]:
        """The boxes that are not done, in order.

        Raises:
            BadInput: the record of finished boxes is damaged.
        """
        with reading(self.path):
            done = np.asarray(self._arrays[_DONE][...])
        for index in np.argwhere(done != 1):
            yield tuple(int(i) for i in index)

    def write(
        self, box: Box, results: Mapping[str, Shaped[np.ndarray, "cells ... trials"]]
    ) -> None:
        """Write the results of one box, and mark it as done.

        Raises:
            BadInput: the disk is full, or the store can't be written to.
        """
        region = self.layout.region(box)
        lengths = [part.stop - part.start for part in region]
        try:
            for name in self.study.schema.variables:
                values = results[name]
                inner = values.shape[1:-1]
                shaped = values.reshape(*lengths[:-1], *inner, lengths[-1])
                everything = [slice(None)] * len(inner)
                self._arrays[name][(*region[:-1], *everything, region[-1])] = shaped
            self._arrays[_DONE][box] = 1
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
    attributes = read_attributes(path)
    wanted = {"config": study.config.to_dict(), "versions": versions()}
    differing = [
        line for key in ("config", "versions") for line in difference(wanted[key], attributes[key])
    ]
    if differing:
        raise BadInput(
            path,
            f"holds another study and is not mixed with this one: {'; '.join(differing)}",
        )
    return StudyStore(path, study)


def sweep_unfinished(path: Path) -> None:
    """Remove the remains of a process that was killed while it created this store.

    Only for a caller that knows that no other process works on it, see `sole_writer`.
    """
    for left in path.parent.glob(f"{glob.escape(_unfinished(path))}*"):
        shutil.rmtree(left, ignore_errors=True)


def read_attributes(path: Path) -> dict[str, Any]:
    """The config and versions of a store.

    Raises:
        BadInput: it is not a store of a study.
    """
    attributes: dict[str, Any] = dict(_open_group(path, "r").attrs)
    entries = {}
    for key in ("config", "versions"):
        try:
            entries[key] = json.loads(attributes[key])
        except (KeyError, TypeError, ValueError, RecursionError):
            raise BadInput(path, "is not a store of jaxnav study") from None
        if not isinstance(entries[key], dict):
            raise BadInput(f"{path}: {key}", "must be a mapping")
    return entries


def read_dataset(path: Path) -> xr.Dataset:
    """All trials of a store as a lazy dataset: values are loaded on access.

    Raises:
        BadInput: it is not a store of a study.
    """
    read_attributes(path)
    with reading(path):
        whole = xr.open_zarr(path, chunks=None, consolidated=False, mask_and_scale=False)
        return whole.drop_vars(_DONE)


def read_layout(path: Path) -> BoxLayout:
    """The layout of a store.

    Raises:
        BadInput: it is not a store of a study.
    """
    with reading(path):
        done: Any = _open_group(path, "r")[_DONE]
        return layout_of(path, dict(done.attrs), done.shape)


def count_done(path: Path) -> int:
    """The number of finished trials in a store, over all cells.

    Raises:
        BadInput: it is not a store of a study.
    """
    layout = read_layout(path)
    with reading(path):
        done: Any = _open_group(path, "r")[_DONE]
        boxes = np.argwhere(done[...] == 1).tolist()
    return sum(layout.size(box) for box in boxes)


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


def _create(path: Path, study: Study, most: int) -> None:
    """Create a new store, whole or not at all."""
    config = study.config
    axes = study.grid.outer_axes
    layout = BoxLayout.of([*map(len, axes.values()), config.trials], most)
    beside = path.with_name(_unfinished(path) + secrets.token_hex(4))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            group = zarr.create_group(
                beside,
                attributes={
                    "title": f"jaxnav study {study.schema.kind}",
                    "config": json.dumps(config.to_dict()),
                    "versions": json.dumps(versions()),
                },
            )
            for name, values in config.axes.items():
                parameter = study.schema.parameters[name]
                array = np.asarray(values) if not parameter.choices else np.asarray(values, object)
                _coordinate(group, name, array, parameter.unit, parameter.description)
            for name, variable in study.schema.variables.items():
                _empty(group, name, variable, study, layout)
            done = group.create_array(
                _DONE,
                shape=layout.counts,
                chunks=(1,) * len(layout.counts),
                dtype="int8",
                fill_value=0,
                dimension_names=[f"{name}_box" for name in (*axes, "trial")],
                compressors=_CHECKED,
            )
            done.attrs.update({"shape": list(layout.shape), "box": list(layout.box)})
            if path.exists():
                path.rmdir()
            beside.rename(path)
        finally:
            shutil.rmtree(beside, ignore_errors=True)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise BadInput(path, f"can't be made: {reason}") from None


def _unfinished(path: Path) -> str:
    """The prefix of the name of a store that is being created."""
    return f".jaxnav-{path.name}-"


def _coordinate(
    group: zarr.Group, name: str, values: np.ndarray, unit: str, description: str
) -> None:
    dtype: Any = "string" if values.dtype == object else values.dtype
    array = group.create_array(
        name,
        shape=values.shape,
        chunks=values.shape,
        dtype=dtype,
        dimension_names=[name],
        compressors=_CHECKED,
    )
    array[...] = values
    array.attrs.update({"units": unit or "1", "long_name": description})


def _empty(
    group: zarr.Group, name: str, variable: Variable, study: Study, layout: BoxLayout
) -> None:
    dimensions = study.grid.dimensions(variable)
    places = dict(zip((*study.grid.outer_axes, "trial"), range(len(layout.shape)), strict=True))
    shape, box = [], []
    for dimension in dimensions:
        if dimension in places:
            shape.append(layout.shape[places[dimension]])
            box.append(layout.box[places[dimension]])
        else:
            shape.append(len(study.config.axes[dimension]))
            box.append(shape[-1])
    dtype = np.dtype(variable.dtype)
    missing = math.nan if dtype.kind == "f" else np.iinfo(dtype).max
    array = group.create_array(
        name,
        shape=shape,
        chunks=tuple(box),
        dtype=dtype,
        fill_value=missing,
        dimension_names=dimensions,
        compressors=_COMPRESSED,
    )
    attributes: dict[str, Any] = {"units": variable.unit or "1", "long_name": variable.description}
    if variable.outcomes:
        attributes["flag_values"] = list(range(len(variable.outcomes)))
        attributes["flag_meanings"] = " ".join(variable.outcomes)
    array.attrs.update(attributes)
