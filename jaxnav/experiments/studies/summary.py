"""Summarise the trials of every cell: rates with intervals, medians, 95 % quantiles.

The trials are read box by box, so memory is bounded by a box for a study of any size. Quantiles
are exact order statistics. Missing numbers are left out of them, and counted.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float, Float32, Int, Shaped

from jaxnav.experiments.studies.store import BoxLayout
from jaxnav.experiments.studies.study import Config, Progress, Schema, nobody
from jaxnav.sim.statistics import wilson_interval

SHARES = {"median": 0.5, "p95": 0.95}
RELIABILITY_BINS = 20
# (variable, trials) -> those trials of one box of cells.
Block = Callable[[str, slice], Shaped[np.ndarray, "rows trials"]]
Blocks = Callable[[], Iterator[Float32[np.ndarray, "cells trials"]]]  # NaN where missing


def summarise(
    trials: xr.Dataset, config: Config, layout: BoxLayout, progress: Progress = nobody
) -> xr.Dataset:
    """All measures of every cell. A cell without trials has counts of zero and no numbers.

    Args:
        trials: the store's dataset.
        config: the study of the trials.
        layout: the layout of the store.
        progress: called with the number of trials read since the last call.
    """
    schema = config.schema
    coords: dict[str, Any] = {name: trials.coords[name] for name in config.axes}
    measures: dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]] = {}
    bins = _Reliability(config)
    first_cell = (0,) * (len(layout.shape) - 1)
    spans = [layout.region((*first_cell, t))[-1] for t in range(layout.counts[-1])]
    for box in np.ndindex(*layout.counts[:-1]):
        region = layout.region((*box, 0))[:-1]

        def block(
            name: str, span: slice, region: tuple[slice, ...] = region
        ) -> Shaped[np.ndarray, "rows trials"]:
            values = trials[name][(*region, ..., span)].values
            return values.reshape(-1, values.shape[-1])

        for name, variable in schema.variables.items():
            *dims, _ = config.sizes(variable)
            for measure, numbers in _summed(name, schema, block, spans).items():
                counts = measure.endswith(("_count", "_counted"))
                unit = "1" if counts else variable.unit or "1"
                extra = (name,) if numbers.ndim > 1 else ()
                shape = (*(trials.sizes[dim] for dim in dims), *numbers.shape[1:])
                about = {"units": unit, "long_name": variable.description}
                new = ((*dims, *extra), np.zeros(shape, numbers.dtype), about)
                whole = measures.setdefault(measure, new)[1]
                whole[region] = numbers.reshape(whole[region].shape)
        bins.add(block, spans)
        progress(layout.shape[-1] * int(np.prod([s.stop - s.start for s in region])))
    coords |= {name: list(v.outcomes) for name, v in schema.variables.items() if v.outcomes}
    summary = xr.Dataset(measures, coords, trials.attrs)
    for name, rate in schema.rates.items():
        of_outcome = summary[f"{rate.variable}_count"]
        happened = of_outcome.sel({rate.variable: list(rate.of)}).sum(rate.variable)
        among = of_outcome.sel({rate.variable: list(rate.among)}).sum(rate.variable)
        value = happened / among.where(among > 0)
        ends = wilson_interval(value.values, among.where(among > 0).values)
        for suffix, array in zip(("", "_low", "_high"), (value.values, *ends), strict=True):
            about = {"units": "1", "long_name": rate.description}
            summary[f"{name}{suffix}"] = (value.dims, array, about)
    return summary.merge(bins.table())


def _summed(name: str, schema: Schema, block: Block, spans: list[slice]) -> dict[str, np.ndarray]:
    """The measures of one variable in the rows of one box of cells, (rows,) or (rows, outcomes)."""
    variable = schema.variables[name]
    if variable.outcomes:
        codes = np.arange(len(variable.outcomes))[:, None]
        each = (np.sum(block(name, span)[:, None] == codes, axis=2) for span in spans)
        return {f"{name}_count": np.sum(list(each), axis=0)}
    outcomes = [schema.variables["outcome"].outcomes.index(o) for o in variable.among]

    def blocks() -> Iterator[np.ndarray]:
        for span in spans:
            values = block(name, span)
            whole = values.dtype.kind == "i"
            missing = values == np.iinfo(values.dtype).max if whole else ~np.isfinite(values)
            if outcomes:
                missing = missing | ~np.isin(block("outcome", span), outcomes)
            yield np.where(missing, np.nan, values).astype(np.float32)

    counted: Any = 0
    total: Any = 0.0
    for values in blocks():
        counted = counted + np.sum(np.isfinite(values), axis=1)
        total = total + np.nansum(values, axis=1, dtype=np.float64)
    return {
        **{
            f"{name}_{statistic}": order_statistic(blocks, share, np.asarray(counted), len(spans))
            for statistic, share in SHARES.items()
        },
        f"{name}_mean": np.where(counted, total / np.maximum(counted, 1), np.nan),
        f"{name}_counted": np.asarray(counted),
    }


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
        return np.where(counted > 0, value, np.nan).astype(float)
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
    return np.where(counted > 0, value, np.nan).astype(float)


def _ordered_bits(values: np.ndarray) -> np.ndarray:
    """Unsigned integers with the order of the finite float32 values."""
    bits = values[np.isfinite(values)].view(np.uint32)
    return np.where(bits >> 31 == 1, ~bits, bits | np.uint32(0x80000000))


class _Reliability:
    """The predicted probabilities and observed frequencies, over all cells, per selector."""

    def __init__(self, config: Config):
        self._schema = config.schema
        self._by_selector = "selector" in config.schema.inner and "selector" in config.axes
        selectors = len(config.axes["selector"]) if self._by_selector else 1
        self._sums = np.zeros((3, selectors, RELIABILITY_BINS))  # count, predicted, happened

    def add(self, block: Block, spans: list[slice]) -> None:
        """Add one box of cells."""
        if self._schema.predicted is None:
            return
        rate, selectors = self._schema.rates["flip_rate"], self._sums.shape[1]
        codes = self._schema.variables[rate.variable].outcomes
        for span in spans:
            predicted, outcome = block(self._schema.predicted, span), block(rate.variable, span)
            counted = np.isin(outcome, [codes.index(o) for o in rate.among])
            counted &= np.isfinite(predicted)
            happened = np.isin(outcome, [codes.index(o) for o in rate.of])
            for s in range(selectors):  # the fastest axis of the rows
                some = counted[s::selectors]
                p, h = predicted[s::selectors][some], happened[s::selectors][some]
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
