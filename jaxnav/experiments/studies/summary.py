"""Summarise the trials of every cell: rates with intervals, medians, 95 % quantiles.

The trials are read box by box, so memory is bounded by a box for a study of any size. Quantiles
are exact order statistics. Missing numbers are left out of them, and counted.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float, Float32, Int

from jaxnav.experiments.studies.layout import BoxLayout
from jaxnav.experiments.studies.study import Grid, Variable
from jaxnav.sim.statistics import wilson_interval

SHARES = {"median": 0.5, "p95": 0.95}
RELIABILITY_BINS = 20
Blocks = Callable[[], Iterator[Float32[np.ndarray, "cells trials"]]]  # NaN where missing


def summarise(
    trials: xr.Dataset,
    grid: Grid,
    layout: BoxLayout,
    progress: Callable[[int], object] = lambda done: None,
) -> xr.Dataset:
    """All measures of every cell. A cell without trials has counts of zero and no numbers.

    Args:
        trials: the store's dataset.
        grid: the grid of the trials.
        layout: the layout of the store.
        progress: called with the number of trials read since the last call.
    """
    summary = xr.Dataset(
        coords={name: trials.coords[name] for name in grid.config.axes}, attrs=trials.attrs
    )
    for name, variable in grid.schema.variables.items():
        dims = grid.dimensions(variable)[:-1]
        for measure, (extra, unit, dtype) in _measures(name, variable).items():
            shape = [trials.sizes[d] for d in dims] + [len(labels) for labels in extra.values()]
            empty = np.full(shape, 0 if dtype is np.int64 else np.nan, dtype)
            about = {"units": unit or "1", "long_name": variable.description}
            summary[measure] = ((*dims, *extra), empty, about)
            summary = summary.assign_coords(extra)
    bins = _Reliability(grid, trials)
    for box in np.ndindex(*layout.counts[:-1]):
        region = layout.region((*box, 0))[:-1]
        for name, variable in grid.schema.variables.items():
            dims = grid.dimensions(variable)[:-1]
            index = region + (slice(None),) * (len(dims) - len(region))
            for measure, numbers in _summed(trials, grid, layout, name, index).items():
                part = summary[measure].values[index]
                summary[measure].values[index] = numbers.reshape(part.shape)
        bins.add(layout, region)
        progress(layout.shape[-1] * int(np.prod([s.stop - s.start for s in region])))
    for name, rate in grid.schema.rates.items():
        counts = summary[f"{rate.variable}_count"]
        happened = counts.sel({rate.variable: list(rate.of)}).sum(rate.variable)
        among = counts.sel({rate.variable: list(rate.among)}).sum(rate.variable)
        value = happened / among.where(among > 0)
        ends = wilson_interval(value.values, among.where(among > 0).values)
        for suffix, array in zip(("", "_low", "_high"), (value.values, *ends), strict=True):
            about = {"units": "1", "long_name": rate.description}
            summary[f"{name}{suffix}"] = (value.dims, array, about)
    return summary.merge(bins.table())


def _measures(name: str, variable: Variable) -> dict[str, tuple[dict[str, Any], str, Any]]:
    """The measures of a variable: name -> further dimensions with labels, unit and dtype."""
    if variable.outcomes:
        return {f"{name}_count": ({name: list(variable.outcomes)}, "", np.int64)}
    measures: dict[str, tuple[dict[str, Any], str, Any]] = {
        f"{name}_{statistic}": ({}, variable.unit, np.float64) for statistic in (*SHARES, "mean")
    }
    return measures | {f"{name}_counted": ({}, "", np.int64)}


def _summed(
    trials: xr.Dataset, grid: Grid, layout: BoxLayout, name: str, index: tuple[slice, ...]
) -> dict[str, np.ndarray]:
    """The measures of one variable in one box of cells."""
    variable = grid.schema.variables[name]
    spans = _spans(layout)
    if variable.outcomes:
        counts: Any = 0
        for span in spans:
            values = _rows(trials[name], index, span)
            counts = counts + np.stack(
                [np.sum(values == i, axis=1) for i in range(len(variable.outcomes))], axis=1
            )
        return {f"{name}_count": np.asarray(counts)}
    whole = np.dtype(variable.dtype).kind == "i"

    def blocks() -> Iterator[np.ndarray]:
        for span in spans:
            values = _rows(trials[name], index, span)
            missing = values == np.iinfo(values.dtype).max if whole else ~np.isfinite(values)
            if variable.among:
                outcome = _rows(trials["outcome"], index, span)
                wanted = [
                    grid.schema.variables["outcome"].outcomes.index(o) for o in variable.among
                ]
                missing = missing | ~np.isin(outcome, wanted)
            yield np.where(missing, np.nan, values).astype(np.float32)

    counted: Any = 0
    total: Any = 0.0
    for block in blocks():
        counted = counted + np.sum(np.isfinite(block), axis=1)
        total = total + np.nansum(block, axis=1, dtype=np.float64)
    measures = {f"{name}_counted": np.asarray(counted)}
    measures[f"{name}_mean"] = np.where(counted, total / np.maximum(counted, 1), np.nan)
    for statistic, share in SHARES.items():
        measures[f"{name}_{statistic}"] = order_statistic(
            blocks, share, np.asarray(counted), len(spans)
        )
    return measures


def _rows(array: xr.DataArray, index: tuple[slice, ...], span: slice) -> np.ndarray:
    """The values of some trials of a box of cells, (cells, trials)."""
    values = array[(*index, span)].values
    return values.reshape(-1, values.shape[-1])


def order_statistic(
    blocks: Blocks, share: float, counted: Int[np.ndarray, " cells"], passes: int
) -> Float[np.ndarray, " cells"]:
    """The number of each row below which a share of its numbers lies; NaN for a row of none.

    Several blocks are never held together: two passes count the upper and then the lower halves of
    the numbers' bits, whose order is that of the numbers.

    Args:
        blocks: returns an iterator over the blocks, anew for every pass.
        share: 0.5 for the median.
        counted: count of numbers in each row.
        passes: number of blocks.
    """
    rank = np.minimum((share * counted).astype(np.int64), np.maximum(counted - 1, 0))
    if passes == 1:
        ordered = np.sort(next(blocks()), axis=1)  # NaN last
        value = np.take_along_axis(ordered, rank[:, None], axis=1)[:, 0]
        return np.where(counted > 0, value, np.nan)
    upper = np.zeros((len(rank), 2**16), np.int64)
    for block in blocks():
        for row, values in enumerate(block):
            upper[row] += np.bincount(_ordered_bits(values) >> 16, minlength=2**16)
    bucket = np.argmax(np.cumsum(upper, axis=1) > rank[:, None], axis=1)
    below = np.array([upper[row, :b].sum() for row, b in enumerate(bucket)])
    lower = np.zeros_like(upper)
    for block in blocks():
        for row, values in enumerate(block):
            bits = _ordered_bits(values)
            lower[row] += np.bincount(bits[bits >> 16 == bucket[row]] & 0xFFFF, minlength=2**16)
    last = np.argmax(np.cumsum(lower, axis=1) > (rank - below)[:, None], axis=1)
    bits = (bucket.astype(np.uint32) << 16) | last.astype(np.uint32)
    positive = bits >> 31 == 1
    value = np.where(positive, bits & 0x7FFFFFFF, ~bits).astype(np.uint32).view(np.float32)
    return np.where(counted > 0, value, np.nan)


def _ordered_bits(values: np.ndarray) -> np.ndarray:
    """Unsigned integers with the order of the finite float32 values."""
    bits = values[np.isfinite(values)].view(np.uint32)
    return np.where(bits >> 31 == 1, ~bits, bits | np.uint32(0x80000000))


class _Reliability:
    """The predicted probabilities and observed frequencies, over all cells, per selector."""

    def __init__(self, grid: Grid, trials: xr.Dataset):
        self._schema, self._trials = grid.schema, trials
        self._by_selector = "selector" in grid.schema.inner and "selector" in grid.config.axes
        selectors = len(grid.config.axes["selector"]) if self._by_selector else 1
        self._sums = np.zeros((3, selectors, RELIABILITY_BINS))  # count, predicted, happened

    def add(self, layout: BoxLayout, region: tuple[slice, ...]) -> None:
        """Add one box of cells."""
        if self._schema.predicted is None:
            return
        rate, selectors = self._schema.rates["flip_rate"], self._sums.shape[1]
        codes = self._schema.variables[rate.variable].outcomes
        index = region + (slice(None),) * self._by_selector
        for span in _spans(layout):
            predicted, outcome = (
                self._trials[name][(*index, span)].values.reshape(-1, selectors, _length(span))
                for name in (self._schema.predicted, rate.variable)
            )
            counted = np.isin(outcome, [codes.index(o) for o in rate.among]) & np.isfinite(
                predicted
            )
            happened = np.isin(outcome, [codes.index(o) for o in rate.of])
            for s in range(selectors):
                p, h = predicted[:, s][counted[:, s]], happened[:, s][counted[:, s]]
                bins = np.clip((p * RELIABILITY_BINS).astype(int), 0, RELIABILITY_BINS - 1)
                for row, weights in enumerate((np.ones_like(p), p, h)):
                    self._sums[row, s] += np.bincount(bins, weights, RELIABILITY_BINS)

    def table(self) -> xr.Dataset:
        """The count, mean prediction, frequency and its interval of every bin."""
        if self._schema.predicted is None:
            return xr.Dataset()
        count, predicted, happened = self._sums if self._by_selector else self._sums[:, 0]
        some = np.where(count > 0, count, np.nan)
        low, high = wilson_interval(happened / some, some)
        dims = ("selector", "bin") if self._by_selector else ("bin",)
        columns = {
            "count": count.astype(np.int64),
            "predicted": predicted / some,
            "observed": happened / some,
            "low": low,
            "high": high,
        }
        return xr.Dataset({f"reliability_{n}": (dims, values) for n, values in columns.items()})


def _spans(layout: BoxLayout) -> list[slice]:
    """The trials, as slices, of every box of a cell."""
    first_cell = (0,) * (len(layout.shape) - 1)
    return [layout.region((*first_cell, t))[-1] for t in range(layout.counts[-1])]


def _length(span: slice) -> int:
    return int(span.stop - span.start)
