"""Draw studies: maps over two axes, curves over one, reliability diagrams.

One function returns one Figure; nothing is shown or saved here. All of them draw the result of
`jaxnav.experiments.studies.summary.summarise`, labelled from its attributes.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from jaxnav.pictures.localisation import look, reliability_diagram

_MAP_WIDTH, _MAP_HEIGHT = 3.9, 3.5  # of one panel, inches


def numeric_axes(summary: xr.Dataset) -> list[str]:
    """The axes that can be drawn: numeric, with at least two values; the longest first."""
    names = [
        name
        for name, values in summary.coords.items()
        if values.dtype.kind in "if" and values.ndim == 1 and values.size > 1
    ]
    return sorted(map(str, names), key=lambda name: -summary.sizes[name])


def study_map(summary: xr.Dataset, measure: str, x: str, y: str, panels: str | None) -> Figure:
    """Draw a measure over two axes, with a panel for each value of a third one.

    Args:
        summary: no other axis longer than one (select before).
        measure: name of a variable.
        x: axis across.
        y: axis upward.
        panels: the axis of the panels; None: a single panel.
    """
    data = summary[measure]
    labels = list(data[panels].values) if panels else [None]
    figure = Figure(
        figsize=(_MAP_WIDTH * len(labels) + 0.9, _MAP_HEIGHT + 0.6), layout="constrained"
    )
    all_axes = figure.subplots(1, len(labels), squeeze=False, sharex=True, sharey=True)[0]
    norm = _scale(data)
    mesh = None
    for axes, label in zip(all_axes, labels, strict=True):
        part = data.sel({panels: label}) if panels else data
        part = part.squeeze(drop=True).transpose(y, x)
        mesh = axes.pcolormesh(
            _edges(part[x].values),
            _edges(part[y].values),
            np.ma.masked_invalid(part.values),
            norm=norm,
            cmap="viridis",
        )
        axes.set_facecolor("#DDDDDD")  # no trial to judge
        axes.set_xlabel(_axis_label(summary[x]))
        axes.set_title(_value_label(summary[panels], label) if panels else "", fontsize=10)
        for name, setter in ((x, axes.set_xscale), (y, axes.set_yscale)):
            if _is_log(summary[name].values):
                setter("log")
    all_axes[0].set_ylabel(_axis_label(summary[y]))
    assert mesh is not None
    figure.colorbar(mesh, ax=list(all_axes), label=_measure_label(measure, data))
    return figure


def study_curves(summary: xr.Dataset, measures: Sequence[str], x: str, lines: str | None) -> Figure:
    """Draw measures over one axis, a panel for each; rates have their 95 % intervals.

    A `..._median` is drawn with its `..._p95` as a thin line above it.

    Args:
        summary: no other axis longer than one (select before).
        measures: names of variables.
        x: axis across.
        lines: the axis whose values are lines; None: a single line.
    """
    columns = min(len(measures), 3)
    rows = -(-len(measures) // columns)
    figure = Figure(figsize=(4.2 * columns, 3.1 * rows + 0.4), layout="constrained")
    all_axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, measure in zip(all_axes, measures, strict=False):
        _curves(axes, summary, measure, x, lines)
    for axes in all_axes[len(measures) :]:
        axes.set_axis_off()
    handles, labels = all_axes[0].get_legend_handles_labels()
    if lines:
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 4))
    return figure


def study_reliability(summary: xr.Dataset) -> Figure:
    """Draw predicted against observed frequencies of each selector, and their counts."""
    curves = {}
    selectors = list(summary["selector"].values) if "selector" in summary.sizes else [None]
    for name in selectors:
        of = summary.sel(selector=name) if name is not None else summary
        parts = ("predicted", "observed", "low", "high", "count")
        curves[str(name or "observed")] = tuple(of[f"reliability_{p}"].values for p in parts)
    return reliability_diagram(curves)


def _curves(axes: Axes, summary: xr.Dataset, measure: str, x: str, lines: str | None) -> None:
    data = summary[measure]
    on_lines = lines if lines in data.dims else None
    values = summary[x].values
    for number, label in enumerate(data[on_lines].values if on_lines else [None]):

        def part(name: str, label: Any = label) -> np.ndarray:
            array = summary[name].sel({on_lines: label}) if on_lines else summary[name]
            return array.squeeze(drop=True).values

        color, style = look(number)
        name = "" if label is None else _value_label(summary[on_lines], label)
        axes.plot(values, part(measure), color=color, ls=style, marker="o", ms=3, label=name)
        if f"{measure}_low" in summary:
            low, high = part(f"{measure}_low"), part(f"{measure}_high")
            axes.fill_between(values, low, high, color=color, alpha=0.2, lw=0)
        upper = f"{measure.removesuffix('_median')}_p95"
        if measure.endswith("_median") and upper in summary:
            axes.plot(values, part(upper), color=color, ls=style, lw=0.7, alpha=0.8)
            axes.set_title("thin: 95 %", fontsize=8, loc="right")
    axes.set(xlabel=_axis_label(summary[x]), ylabel=_measure_label(measure, data))
    if _is_log(values):
        axes.set_xscale("log")
    if measure.endswith("_rate"):
        axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)


def _scale(data: xr.DataArray) -> Normalize:
    """A linear scale from zero for rates, a logarithmic one for values that span decades."""
    finite = data.values[np.isfinite(data.values)]
    if not finite.size:
        return Normalize(0, 1)
    low, high = float(finite.min()), float(finite.max())
    if low > 0 and high > 50 * low:
        return LogNorm(low, high)
    return Normalize(min(low, 0.0), high if high > 0 else 1.0)


def _is_log(values: np.ndarray) -> bool:
    """Whether values are spaced in ratios rather than in differences."""
    if len(values) < 4 or values.min() <= 0:
        return False
    return bool(np.ptp(np.diff(np.log(np.sort(values)))) < np.ptp(np.diff(np.sort(values))))


def _edges(values: np.ndarray) -> np.ndarray:
    """The borders of cells around values of any order and spacing."""
    if len(values) == 1:
        return np.array([values[0] - 0.5, values[0] + 0.5])
    if _is_log(values):
        return np.exp(_edges_between(np.log(values)))
    return _edges_between(values.astype(float))


def _edges_between(values: np.ndarray) -> np.ndarray:
    middle = (values[1:] + values[:-1]) / 2
    first, last = 2 * values[0] - middle[0], 2 * values[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])


def _axis_label(coordinate: xr.DataArray) -> str:
    name, unit = str(coordinate.name), coordinate.attrs.get("units", "1")
    words = name.removesuffix(f"_{unit}").replace("_", " ")
    return words if unit == "1" else f"{words} ({unit})"


def _value_label(coordinate: xr.DataArray, value: Any) -> str:
    if coordinate.dtype.kind not in "if":
        return str(value)
    unit = coordinate.attrs.get("units", "1")
    return f"{_axis_label(coordinate).split(' (')[0]} {value:g}{'' if unit == '1' else f' {unit}'}"


def _measure_label(measure: str, data: xr.DataArray) -> str:
    unit = data.attrs.get("units", "1")
    words = measure.replace("_p95", ", 95 %").replace("_median", ", median")
    words = words.replace(f"_{unit}", "").replace("_", " ")
    return words if unit == "1" else f"{words} ({unit})"
