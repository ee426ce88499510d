"""`jaxnav replay --smooth` of a drive: its track by all that was seen, beside the filter's own."""

from typing import Any

import numpy as np

from jaxnav.commands.bars import progress_bar, update_after_compiling
from jaxnav.commands.drive.arguments import ReplayRecording as Arguments
from jaxnav.commands.report import corners_in_world, save_figure
from jaxnav.files import write_tum
from jaxnav.pictures.localisation import localisation_report
from jaxnav.recordings.drive_events import DriveEvents
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.other.smoothed_drive import DriveTrack, smooth_drive


def run(args: Arguments, events: DriveEvents, setup: DriveSetup) -> dict[str, Any]:
    """Write smoothed.tum and smoothed.png; what smoothing has changed, for the summary."""
    with progress_bar(
        total=2 * len(events), unit="event", desc="smooth", disable=args.headless
    ) as bar:
        filtered, smoothed = smooth_drive(events, setup, update_after_compiling(bar))
    stamps_s, located = smoothed.stamps_ns / 1e9, smoothed.located
    write_tum(args.out / "smoothed.tum", stamps_s[located], smoothed.Ts_world_vehicle[located])
    shift_m, turn_rad = filtered.distances_to(smoothed)
    turn_deg = np.rad2deg(turn_rad)
    summary = {
        "events": len(events),
        "filtered": _known(filtered),
        "smoothed": _known(smoothed),
        "rms_position_difference_m": rms(shift_m[filtered.decided]),
        "rms_heading_difference_deg": rms(turn_deg[filtered.decided]),
    }
    picture = localisation_report(
        stamps_s - stamps_s[0],
        filtered.positions_m,
        smoothed.positions_m,
        {
            name: np.where(off > 0, off, np.nan)  # a logarithmic axis shows no zero
            for name, off in (("position off (m)", shift_m), ("heading off (deg)", turn_deg))
        },
        corners_in_world(setup.markers),
        title=text(summary),
        names=("filtered", "smoothed"),
    )
    save_figure(picture, args.out / "smoothed.png")
    return summary


def text(summary: dict[str, Any]) -> str:
    """What smoothing has changed, in two lines."""
    shares = (summary[of]["decided_share"] for of in ("filtered", "smoothed"))
    before, after = (_sigmas(summary[of]) for of in ("filtered", "smoothed"))
    off_cm = 100 * summary["rms_position_difference_m"]
    decided = "decided {:.0%} of {} events, smoothed {:.0%}"
    first, second = shares
    return (
        f"{decided.format(first, summary['events'], second)}; sigma {before}, smoothed {after}\n"
        f"once decided, the filter was off the smoothed track by {off_cm:.2g} cm and "
        f"{summary['rms_heading_difference_deg']:.2g} deg (rms)"
    )


def _known(track: DriveTrack) -> dict[str, float]:
    """Shares of the events, and how well the pose is known where it is decided."""
    return {
        "located_share": float(np.mean(track.located)),
        "decided_share": float(np.mean(track.decided)),
        "median_sigma_m": _median(track.sigma_m[track.decided]),
        "median_sigma_deg": _median(np.rad2deg(track.sigma_rad[track.decided])),
    }


def _sigmas(known: dict[str, float]) -> str:
    return f"{100 * known['median_sigma_m']:.2g} cm {known['median_sigma_deg']:.2g} deg"


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else np.nan


def rms(values: np.ndarray) -> float:
    """The root mean square of those that are finite; NaN of none."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan
