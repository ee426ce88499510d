"""`jaxnav plot`: a recorded drive as a picture and in a few lines, or the pictures of a study; and
`jaxnav view`: a recorded drive in Rerun, or a file for it."""

import math
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxnav.commands.bars import progress_bar
from jaxnav.commands.drive.arguments import Plot, ViewDrive
from jaxnav.commands.reading import read_shown
from jaxnav.commands.report import save_figure
from jaxnav.drive.flags import Fault, Health, Reject, counts
from jaxnav.drive.interfaces import Odometry, Reading
from jaxnav.errors import BadInput, visible
from jaxnav.files import atomic_path, output_folder
from jaxnav.files.ranges import is_within
from jaxnav.pictures.drive import drive_log_report
from jaxnav.pictures.rerun.view import RerunView, import_rerun
from jaxnav.pictures.scenery import Scenery
from jaxnav.recordings.drive_log import DriveLog
from jaxnav.recordings.plausible import keep_plausible, left_out_note

_LONGEST_STEP_S = 1.0  # between two readings, for the distance; a longer gap counts as this


def run(args: Plot | ViewDrive) -> int:
    """Draw the drive or the study in the file, or show the drive and leave the window open."""
    if isinstance(args, ViewDrive):
        return _view(args)
    if args.store.suffix.lower() == ".mcap":
        return _draw_drive(args)
    # It needs the packages of the extra `study`.
    from jaxnav.commands.study.pictures import draw_study

    return draw_study(args)


def read_outcomes(path: Path, headless: bool) -> DriveLog:
    """Read a recorded drive that has outcomes to show.

    Raises:
        BadInput: the file is no recorded drive, damaged, or without outcomes.
    """
    log = read_shown(path, headless)
    if not len(log.outcomes.now_ns):
        raise BadInput(path, "holds no outcome of the pilot, so there is nothing to show")
    return log


def _draw_drive(args: Plot) -> int:
    """Write drive.png, and print a summary of the drive."""
    log = read_outcomes(args.store, args.headless)
    outcomes, odd = keep_plausible(log.outcomes)
    log = replace(log, outcomes=outcomes)
    out = output_folder(args.out)
    save_figure(drive_log_report(log, visible(args.store.name)), out / "drive.png")
    for line in summary_lines(log):
        print(visible(line))
    if odd:
        print(left_out_note(odd))
    print(f"picture in {visible(out / 'drive.png')}")
    return 0


def summary_lines(log: DriveLog) -> list[str]:
    """Lines with duration, distance, health by time, faults, rejects, restarts, and gaps.

    Args:
        log: a drive with at least one outcome.
    """
    outcomes = log.outcomes
    count, duration_s = len(outcomes.now_ns), float(outcomes.times_s[-1])
    # An outcome counts until the next one.
    weights = np.append(np.diff(outcomes.times_s), 0.0) if duration_s > 0 else np.ones(count)
    shares = {
        state.name: float(weights[outcomes.health == state].sum() / weights.sum())
        for state in Health
    }
    healths = ", ".join(f"{name} {share:.1%}" for name, share in shares.items() if share > 0)
    found = counts(Fault, outcomes.faults) | counts(Reject, outcomes.rejects)
    faults = ", ".join(f"{name} {number}" for name, number in found.items())
    restarts = int(outcomes.restarts[-1])
    reason = f", the last one: {outcomes.reason[-1]}" if restarts else ""
    lines = [
        f"{duration_s:.1f} s, {count} outcomes, {distance_m(log):.2f} m by the odometer",
        f"health by time: {healths}",
        f"outcomes with faults: {faults or 'none'}",
        f"restarts: {restarts}{reason}",
    ]
    if log.missing:
        left_out = ", ".join(f"{topic} {number}" for topic, number in log.missing.items())
        lines.append(f"left out of the recording: {left_out}")
    if log.truncated:
        lines.append("the recording was not brought to its end")
    return lines


def distance_m(log: DriveLog) -> float:
    """The distance, m, that the vehicle drove forwards and backwards, by its odometer."""
    readings = [
        given.odometry
        for given in log.inputs
        if given.odometry is not None and given.odometry.valid
    ]
    stamps_s = np.array([reading.stamp_ns for reading in readings], float) / 1e9
    speeds_mps = np.abs([_speed_mps(reading) for reading in readings])
    usable = is_within("speed_mps", speeds_mps)
    steps_s = np.clip(np.diff(stamps_s[usable]), 0, _LONGEST_STEP_S)
    return float(steps_s @ speeds_mps[usable][1:])


def _speed_mps(reading: Reading) -> float:
    if isinstance(reading, Odometry):
        return reading.speed_mps
    return math.hypot(reading.forward_mps, reading.left_mps)


# --- view ----------------------------------------------------------------------------------


def _view(args: ViewDrive) -> int:
    import_rerun()
    log = read_outcomes(args.recording, args.headless)
    scenery = Scenery.from_header(log.header)
    if args.out is not None:
        output_folder(args.out.parent)
    with ExitStack() as stack:
        save = None if args.out is None else stack.enter_context(atomic_path(args.out))
        view = RerunView(
            scenery.rig,
            scenery.markers,
            scenery.on_map_m(scenery.waypoints_m),
            live=save is None,
            save=save,
            waits=True,
        )
        stack.callback(view.close)
        _show_drive(view, log, scenery, args.headless)
    if args.out is not None:
        print(f"written to {visible(args.out)}: rerun {visible(args.out)} opens it")
    if view.dropped:
        print(f"{view.dropped} outcomes or images could not be shown")
    return 0


def _show_drive(view: RerunView, log: DriveLog, scenery: Scenery, headless: bool) -> None:
    """Show all outcomes, all frames and all images of a drive in a view."""
    outcomes, odd = keep_plausible(log.outcomes)
    if odd:
        print(left_out_note(odd))
    names = () if scenery.rig is None else scenery.rig.names
    for index in progress_bar(
        range(len(outcomes.now_ns)), unit="outcome", disable=headless, leave=False
    ):
        view.show_recorded(outcomes, index)
    for frame in (frame for given in log.inputs for frame in given.frames):
        name = names[frame.camera] if frame.camera < len(names) else f"camera_{frame.camera}"
        if frame.detections is not None:
            view.image(name, frame.stamp_ns, None, frame.detections.corners_px)
    for image in log.images():
        view.image(image.topic.removeprefix("/camera/"), image.stamp_ns, image.jpeg, None)
