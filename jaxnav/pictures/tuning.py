"""Draw a fit: its losses, its parameters and its results on held-out drives."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnav.experiments.tuning.fit import ControllerScores, EstimatorScores, TuningFit
from jaxnav.experiments.tuning.unconstrained import Space
from jaxnav.pictures.localisation import BLACK, BLUE, COLOURS, GREEN, SKY, VERMILION

_LINES = ("-", "--", ":")


def tuning_report(
    fit: TuningFit, space: Space, judged: Mapping[str, tuple[EstimatorScores, EstimatorScores]]
) -> Figure:
    """Draw loss and parameters by step, and below them errors and covariances before and after.

    Args:
        judged: name -> scores before and after; one row each.
    """
    rows = 1 + len(judged)
    figure = Figure(figsize=(11, 3.8 * rows), layout="constrained")
    axes = figure.subplots(rows, 2, squeeze=False)
    draw_losses(axes[0, 0], fit)
    draw_parameters(axes[0, 1], fit, space)
    for (errors, covariance), (name, (before, after)) in zip(axes[1:], judged.items(), strict=True):
        _draw_errors(errors, name, before, after)
        _draw_anees(covariance, before, after)
    return figure


def controller_report(
    fit: TuningFit, space: Space, driven: Mapping[str, tuple[ControllerScores, ControllerScores]]
) -> Figure:
    """Draw loss and gains by step, and below them the loss's parts and a drive of each scenario.

    Args:
        driven: scenario -> results before and after.
    """
    figure = Figure(figsize=(11, 8), layout="constrained")
    grid = figure.add_gridspec(2, 2 * (1 + len(driven)))
    half = 1 + len(driven)
    losses = figure.add_subplot(grid[0, :half])
    draw_losses(losses, fit)
    losses.set_ylabel("loss of a drive")
    draw_parameters(figure.add_subplot(grid[0, half:]), fit, space)
    below = [figure.add_subplot(grid[1, 2 * i : 2 * i + 2]) for i in range(1 + len(driven))]
    _draw_parts(below[0], driven)
    for ax, (name, pair) in zip(below[1:], driven.items(), strict=True):
        for one, colour, label in zip(pair, (VERMILION, BLUE), ("before", "after"), strict=True):
            ax.plot(one.poses[:, 0], one.poses[:, 1], ".-", ms=3, color=colour, label=label)
        ax.plot(*pair[0].waypoints_m.T, "x", color=BLACK)
        ax.set(xlabel="x (m)", ylabel="y (m)", title=name, aspect="equal")
        ax.legend(fontsize="small")
    return figure


def _draw_parts(
    axes: Axes, driven: Mapping[str, tuple[ControllerScores, ControllerScores]]
) -> None:
    """Draw the parts of the loss as stacked bars, before and after side by side."""
    names = [f"{name}\n{when}" for name in driven for when in ("before", "after")]
    pairs = [one for pair in driven.values() for one in pair]
    foot = np.zeros(len(pairs))
    for part, colour in zip(pairs[0].parts, COLOURS, strict=False):
        heights = np.array([one.parts[part] for one in pairs])
        axes.bar(np.arange(len(pairs)), heights, bottom=foot, color=colour, label=part)
        foot += heights
    axes.set_xticks(np.arange(len(pairs)), names, rotation=90, fontsize="x-small")
    axes.set(ylabel="loss, drives never seen before")
    axes.legend(fontsize="x-small", ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def draw_losses(axes: Axes, fit: TuningFit) -> None:
    """Draw the losses on the training drives and on the held-out drives."""
    history = np.array(fit.history)
    steps = np.arange(len(history))
    axes.plot(steps, history[:, 0], color=SKY, label="learned from")
    axes.plot(steps, history[:, 1], color=BLUE, label="held out")
    # The best of the last stage: losses of other stages are not comparable.
    began = int(np.flatnonzero(np.isnan(history[:, 0]))[-1])
    best = began + int(np.argmin(history[began:, 1]))
    axes.plot(best, history[best, 1], "o", color=VERMILION, label="kept")
    axes.set(xlabel="step", ylabel="loss a frame", title=fit.ended)
    axes.legend()


def draw_parameters(axes: Axes, fit: TuningFit, space: Space) -> None:
    """Draw each parameter as a ratio to its initial value."""
    rows = np.array(fit.history)[:, 2:]
    values = jax.device_get(jax.vmap(space.values)(jnp.asarray(rows, space.start.dtype)))
    number = 0
    for name, value in values.items():
        flat = value.reshape(len(rows), -1)
        if name in space.full:
            flat = np.diagonal(value, axis1=1, axis2=2)
        for entry in range(flat.shape[1]):
            label = name if flat.shape[1] == 1 else f"{name}[{entry}]"
            axes.plot(
                flat[:, entry] / flat[0, entry],
                color=COLOURS[number % len(COLOURS)],
                ls=_LINES[number // len(COLOURS) % len(_LINES)],
                label=label,
            )
            number += 1
    axes.set(xlabel="step", ylabel="value / value at the start", yscale="log")
    axes.legend(fontsize="x-small", loc="center left", bbox_to_anchor=(1.0, 0.5))


def _draw_errors(axes: Axes, name: str, before: EstimatorScores, after: EstimatorScores) -> None:
    for tested, colour, label in ((before, VERMILION, "before"), (after, BLUE, "after")):
        errors_cm = 100 * np.sort(tested.error_m)
        axes.plot(errors_cm, np.linspace(0, 1, len(errors_cm)), color=colour, label=label)
    axes.set(
        xlabel="position error (cm)",
        ylabel="share of frames below",
        xscale="log",
        title=f"{name}: never seen before",
    )
    axes.legend()


def _draw_anees(axes: Axes, before: EstimatorScores, after: EstimatorScores) -> None:
    low, high = after.band
    axes.axhspan(low, high, color=GREEN, alpha=0.25, label="consistent (99.9 %)")
    for x, tested, colour in ((0, before, VERMILION), (1, after, BLUE)):
        value, begin, end = tested.anees
        errors = [[value - begin], [end - value]]
        axes.errorbar([x], [value], errors, fmt="o", capsize=6, color=colour)
    axes.set(ylabel="ANEES", xlim=(-0.5, 1.5), title="covariance against error")
    spans_decades = max(before.anees[0], after.anees[0]) > 3 * high
    axes.set_yscale("log" if spans_decades else "linear")
    axes.set_xticks([0, 1], ["before", "after"])
    axes.legend()
