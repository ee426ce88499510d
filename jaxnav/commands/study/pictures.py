"""`jaxnav plot STORE`: draw pictures of a study."""

import itertools
from collections.abc import Iterator
from typing import Any

import xarray as xr

from jaxnav.commands.bars import progress_bar
from jaxnav.commands.drive.arguments import Plot as Arguments
from jaxnav.commands.report import save_figure
from jaxnav.commands.study.study import summary_of
from jaxnav.errors import BadInput, visible
from jaxnav.files import output_folder, write_json
from jaxnav.pictures.study import numeric_axes, study_curves, study_map, study_reliability

MAPS = {
    "ambiguity": ("flip_rate", "success_rate", "rotation_error_deg_median"),
    "drive": ("success_rate", "flip_rate", "position_error_m_median"),
}
CURVES = {
    "ambiguity": "flip_rate success_rate declined_rate position_error_m_median "
    "rotation_error_deg_median error_ratio_median nees_mean lm_steps_median".split(),
    "drive": "success_rate flip_rate duration_s_median time_to_decide_s_median "
    "position_error_m_median rotation_error_deg_median nees_median lm_steps_median".split(),
}
_MIN_MAP = 3  # values along either axis, for a map to be worth looking at
_MAX_PICTURES = 24  # of one sort


def draw_study(args: Arguments) -> int:
    """Summarise the stored trials, draw them, and print how many are missing."""
    with progress_bar(unit="trial", unit_scale=True, disable=args.headless, leave=False) as bar:
        kind, done, summary = summary_of(args.store, bar)
        total = int(bar.total or 0)
    if not done:
        raise BadInput(args.store, "holds no trial yet: run the study first")
    numeric = numeric_axes(summary)
    if not numeric:
        raise BadInput(args.store, "has no axis of numbers with two values or more to draw over")
    out = output_folder(args.out)
    drawn = []
    x, *rest = numeric
    if rest and summary.sizes[rest[0]] >= _MIN_MAP and summary.sizes[x] >= _MIN_MAP:
        across, upward = sorted((x, rest[0]), key=list(summary.coords).index)
        panels = _first_of(summary, (across, upward))
        for name, part in _slices(summary, (across, upward, panels)):
            for measure in MAPS[kind]:
                figure = study_map(part, measure, across, upward, panels)
                save_figure(figure, out / f"map_{measure}{name}.png")
                drawn.append(f"map_{measure}{name}.png")
    lines = _first_of(summary, (x,))
    for name, part in _slices(summary, (x, lines)):
        save_figure(study_curves(part, CURVES[kind], x, lines), out / f"curves{name}.png")
        drawn.append(f"curves{name}.png")
    if "reliability_count" in summary:
        save_figure(study_reliability(summary), out / "reliability.png")
        drawn.append("reliability.png")
    write_json(out / "summary.json", _plain(summary))
    if done < total:
        print(f"{visible(args.store)} holds {done} of {total} trials so far")
    invalid = int(summary["outcome_count"].sel(outcome="invalid").sum())
    print(f"{done} trials, {invalid} outcomes not finite; {len(drawn)} pictures in {visible(out)}")
    return 0


def _first_of(summary: xr.Dataset, plot_axes: tuple[str | None, ...]) -> str | None:
    """The remaining axis for panels or lines: the selectors, else the shortest one."""
    left = [
        str(name)
        for name in summary.coords
        if name not in plot_axes and summary[name].ndim == 1 and name not in _LABELS
    ]
    left = [name for name in left if summary.sizes[name] > 1]
    if "selector" in left:
        return "selector"
    return min(left, key=lambda name: summary.sizes[name]) if left else None


_LABELS = ("outcome", "ever_wrong")  # coordinates of counts


def _slices(summary: xr.Dataset, free: tuple[str | None, ...]) -> Iterator[tuple[str, xr.Dataset]]:
    """The summary at every value of the other axes, and a suffix for the file's name."""
    fixed = [str(name) for name in summary.coords if name not in free and name not in _LABELS]
    combinations = itertools.product(*(range(summary.sizes[name]) for name in fixed))
    for index in itertools.islice(combinations, _MAX_PICTURES):
        at = dict(zip(fixed, index, strict=True))
        part = summary.isel({name: [i] for name, i in at.items()})
        several = {name: i for name, i in at.items() if summary.sizes[name] > 1}
        yield "".join(f"_{name}={summary[name].values[i]}" for name, i in several.items()), part


def _plain(summary: xr.Dataset) -> dict[str, Any]:
    return {
        "axes": {str(name): c.values.tolist() for name, c in summary.coords.items()},
        "measures": {
            str(name): {"dims": list(v.dims), "values": v.values.tolist()} | v.attrs
            for name, v in summary.items()
        },
    }
