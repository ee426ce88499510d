"""`jaxnav replay` of a drive: run the pilot on recorded inputs, and compare its outcomes."""

import dataclasses
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxnav.commands.bars import progress_bar, update_after_compiling
from jaxnav.commands.drive.arguments import ReplayRecording as Arguments
from jaxnav.commands.kinds import flag_of
from jaxnav.commands.process import configure_jax
from jaxnav.commands.reading import given_files, read_shown
from jaxnav.commands.report import corners_in_world, write_report
from jaxnav.drive.flags import Fault, Health, Reject, counts
from jaxnav.drive.pilot import Input
from jaxnav.errors import BadInput, visible
from jaxnav.files import (
    Params,
    atomic_path,
    load_params,
    load_topics,
    output_folder,
    write_tum,
)
from jaxnav.files.configuration import step_folder
from jaxnav.recordings.drive_events import DriveEvents, refused_odometry
from jaxnav.recordings.drive_format import PROFILE
from jaxnav.recordings.drive_log import DriveLog, profile_of
from jaxnav.recordings.drive_replay import (
    Comparison,
    check_inputs,
    inputs_from_images,
    replay_drive,
)
from jaxnav.recordings.drive_setup import DriveSetup, needs_float64
from jaxnav.recordings.other.localise import DriveTrack, distances, smooth_drive
from jaxnav.recordings.other.ros import read_ros_drive
from jaxnav.recordings.plausible import keep_plausible
from jaxnav.recordings.recorder import Recorder
from jaxnav.recordings.records import Outcomes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXIT_DIFFERS = 1
_FILES = ("rig", "markers", "vehicle", "route")
_FOR_RIGS = ("one_at_a_time", "without_odometry")
_FOR_DRIVES = ("vehicle", "route", "images", "record_anew")
_OVERRIDES = (*_FILES, "params", "selector", "corner_sigma_px", "images")
# Of a track: `pose` is x_m y_m psi_rad, `T_world_vehicle` wxyz_xyz.
_ROW = np.dtype(
    [
        ("now_ns", np.int64), ("pose", float, 3), ("T_world_vehicle", float, 7), ("located", bool),
        ("decided", bool), ("health", int), ("faults", int), ("rejects", int), ("restarts", int),
        ("restart_reason", object),
    ]
)  # fmt: skip


def is_for(args: Arguments) -> bool:
    """Whether a recording is a drive.

    Raises:
        BadInput: a flag that does not go with such a recording.
    """
    path = args.recording
    moves_freely = args.topics is not None and load_topics(args.topics).imu is not None
    if moves_freely and not (args.vehicle or args.route):
        _refuse(args, _FOR_DRIVES, f"is for drives, and {path} with an IMU is a rig's")
        return False
    if args.topics is not None or profile_of(path) == PROFILE:
        _refuse(args, _FOR_RIGS, "goes with recordings of a rig, not with a drive")
        return True
    is_bag = path.suffix in (".mcap", ".db3") or (path / "metadata.yaml").is_file()
    if is_bag and path.exists():
        raise BadInput("--topics", f"missing: {path} is a ROS bag: they say which topic is what")
    _refuse(args, _FOR_DRIVES, f"is for drives, and {path} is none")
    return False


def _refuse(args: Arguments, names: Sequence[str], problem: str) -> None:
    for name in names:
        if getattr(args, name):
            raise BadInput(flag_of(name), problem)


def run(args: Arguments) -> int:
    """Drive again, compare, write a summary and the trajectory; 1 where outcomes differ."""
    params = None if args.params is None else load_params(args.params)
    log, setup, inputs = _read(args, params)
    inputs = inputs[: args.limit]
    if not inputs:
        raise BadInput(args.recording, "holds no input")
    check_inputs(inputs, setup, args.recording)
    events = None
    if args.smooth:
        refused_ns = set() if log is None else refused_odometry(log)
        events = DriveEvents.from_inputs(inputs, setup, args.recording, refused_ns)
    changed = [name for name in _OVERRIDES if getattr(args, name)]
    comparison = Comparison(log) if log is not None and not changed else None
    out = output_folder(args.out)
    if params is not None:
        print(params.describe())
    track = _replayed(args, setup, inputs, comparison)
    located, Ts_world_vehicle = track["located"], track["T_world_vehicle"]
    write_tum(out / "trajectory.tum", track["now_ns"][located] / 1e9, Ts_world_vehicle[located])
    summary = _summary(args, setup, track)
    recorded_m, off, figures = None, None, dict[str, Any]()
    if log is not None:
        recorded = keep_plausible(log.outcomes)[0]
        off = _distances(track, recorded)
        recorded_m = np.where(recorded.located[:, None], recorded.pose * [1, 1, 0], np.nan)
        summary |= {
            "changed": changed,
            "missing": log.missing,
            "truncated": log.truncated,
            "rms_position_difference_m": _rms(off[0]),
            "rms_heading_difference_deg": np.rad2deg(_rms(off[1])),
        }
    if comparison is not None:
        summary |= {
            "compared": comparison.compared,
            "bit_for_bit": comparison.bit_for_bit,
            "first_difference": comparison.first and dataclasses.asdict(comparison.first),
        }
    else:
        positions_m = np.where(located[:, None], Ts_world_vehicle[:, 4:], np.nan)
        tracks = track["now_ns"], positions_m, recorded_m
        figures["report"] = _picture(setup, *tracks, off, _text(summary))
    lines = [_text(summary)]
    if events is not None:
        summary["smoothing"], figures["smoothed"] = _smooth(args, events, setup)
        lines.append(_smoothing_text(summary["smoothing"]))
    write_report(out, summary, [*lines, f"summary in {visible(out)}"], **figures)
    return EXIT_DIFFERS if comparison is not None and comparison.first else 0


def _read(
    args: Arguments, params: Params | None
) -> tuple[DriveLog | None, DriveSetup, Sequence[Input]]:
    """The recorded drive (None of a bag), what is driven with, and the inputs."""
    log = None
    if args.topics is None:
        log = read_shown(args.recording, args.headless)
        configure_jax(float64=needs_float64(log.header, args.recording), threads=1)
        setup = DriveSetup.from_header(log.header, args.recording)
        setup = dataclasses.replace(setup, **given_files(args, _FILES))
    else:
        configure_jax(float64=True, threads=1)
        setup = DriveSetup(**given_files(args, _FILES, bag=args.recording), float64=True)
    for name in ("selector", "corner_sigma_px"):
        if getattr(args, name) is not None:
            setup = dataclasses.replace(setup, **{name: getattr(args, name)})
    if params is not None:
        setup = setup.with_params(params)
    if args.topics is not None:
        topics, backend = load_topics(args.topics), args.corner_backend
        figures = setup.rig, setup.markers, setup.vehicle
        return None, setup, read_ros_drive(args.recording, topics, *figures, backend)
    assert log is not None
    if args.images:
        return log, setup, inputs_from_images(log, setup, args.corner_backend)[0]
    return log, setup, log.inputs


def _replayed(
    args: Arguments, setup: DriveSetup, inputs: Sequence[Input], comparison: Comparison | None
) -> np.ndarray:
    """The track that is driven again, a row of `_ROW` for each outcome."""
    rows = []
    outcomes = replay_drive(inputs, setup, step_folder())
    with ExitStack() as closing:
        recorder = None
        if args.record_anew:
            path = args.out / "replay.mcap"
            beside = closing.enter_context(atomic_path(path))
            # No car waits for this replay, so that the queue may hold every message.
            recorder = Recorder(beside, setup.header(), queue_messages=2 * len(inputs) + 1)
            closing.callback(recorder.close, timeout_s=60.0)
        bar = closing.enter_context(
            progress_bar(total=len(inputs), unit="input", disable=args.headless)
        )
        update = update_after_compiling(bar)
        for given, outcome in zip(inputs, outcomes, strict=True):
            # Not the bank of hypotheses: those of a long drive are gigabytes.
            poses, output = (outcome.pose, outcome.T_world_vehicle), outcome.output
            flags = outcome.health, outcome.faults, outcome.rejects
            restarted = outcome.restarts, outcome.restart_reason
            row = outcome.now_ns, *poses, output.located, output.decided, *flags, *restarted
            rows.append(np.array(row, _ROW))
            if comparison is not None:
                comparison.look(outcome)
            if recorder is not None:
                recorder.record(given, outcome)
            update(1)
        if recorder is not None:
            recorder.close(timeout_s=60.0)
            if recorder.failed is not None:
                raise BadInput("--record-anew", recorder.failed.replace(str(beside), str(path)))
    return np.stack(rows)


def _summary(args: Arguments, setup: DriveSetup, track: np.ndarray) -> dict[str, Any]:
    """What was driven, counts of faults and rejects, shares of health, last pose and restarts."""
    last = track[-1]
    return {
        "recording": str(args.recording),
        "selector": setup.selector,
        "parameters": setup.parameters,
        "states": len(track),
        "duration_s": float((last["now_ns"] - track["now_ns"][0]) / 1e9),
        "health_shares": {h.name: float(np.mean(track["health"] == h)) for h in Health},
        "located_share": float(np.mean(track["located"])),
        "decided_share": float(np.mean(track["decided"])),
        "faults": counts(Fault, track["faults"]),
        "rejects": counts(Reject, track["rejects"]),
        "final_pose": last["pose"] if last["located"] else None,
        "restarts": int(last["restarts"]),
        "restart_reason": str(last["restart_reason"]),
    }


def _distances(track: np.ndarray, recorded: Outcomes) -> tuple[np.ndarray, np.ndarray]:
    """Distances (N,) m and (N,) rad to the recorded track, NaN where either has no pose."""
    if not len(recorded.now_ns):
        return np.full(len(track), np.nan), np.full(len(track), np.nan)
    index = np.searchsorted(recorded.now_ns, track["now_ns"])
    known = index < len(recorded.now_ns)
    index = np.where(known, index, 0)
    known &= (recorded.now_ns[index] == track["now_ns"]) & recorded.located[index]
    return distances(track["pose"], recorded.pose[index], known & track["located"])


def _picture(
    setup: DriveSetup,
    stamps_ns: np.ndarray,
    positions_m: np.ndarray,
    others_m: np.ndarray | None,
    off: tuple[np.ndarray, np.ndarray] | None,
    title: str,
    names: tuple[str, str] = ("estimate", "reference"),
) -> "Figure":
    """A track and another one beside it, which is off by m and rad."""
    # It imports matplotlib, which a drive that is compared needs not.
    from jaxnav.pictures.localisation import localisation_report

    shown = {}
    if off is not None:
        shown = {"position off (m)": off[0], "heading off (deg)": np.rad2deg(off[1])}
    return localisation_report(
        (stamps_ns - stamps_ns[0]) / 1e9,
        positions_m,
        others_m,
        # A logarithmic axis shows no zero.
        {name: np.where(values > 0, values, np.nan) for name, values in shown.items()},
        corners_in_world(setup.markers),
        title=title,
        names=names,
    )


def _text(summary: dict[str, Any]) -> str:
    shares = summary["health_shares"]
    health = ", ".join(f"{name} {share:.0%}" for name, share in shares.items() if share)
    head = (
        f"{visible(summary['recording'])}, {summary['selector']}: {summary['states']} states in "
        f"{summary['duration_s']:.1f} s, {health}, {summary['restarts']} restarts"
    )
    lost = sum(summary.get("missing", {}).values())
    if lost:
        head += f"\n{lost} messages were not recorded: what follows them may differ"
    if "compared" in summary:
        return f"{head}\n{_verdict(summary)}"
    if "rms_position_difference_m" not in summary:
        return head
    return (
        f"{head}\nchanged: {', '.join(summary['changed'])}; "
        f"off the recorded track by {summary['rms_position_difference_m']:.3g} m and "
        f"{summary['rms_heading_difference_deg']:.3g} deg (rms)"
    )


def _verdict(summary: dict[str, Any]) -> str:
    compared, difference = summary["compared"], summary["first_difference"]
    if difference is not None:
        return (
            f"differs from the recording at state {difference['index']}, "
            f"{difference['time_s']:.3f} s: {difference['what']}"
        )
    if summary["bit_for_bit"]:
        return f"{compared} states, bit for bit as recorded"
    return f"{compared} states, as recorded but for rounding (by another version or machine)"


def _smooth(
    args: Arguments, events: DriveEvents, setup: DriveSetup
) -> tuple[dict[str, Any], "Figure"]:
    """Write the track by all that was seen, smoothed.tum; what that has changed, and a picture."""
    with progress_bar(
        total=2 * len(events), unit="event", desc="smooth", disable=args.headless
    ) as bar:
        filtered, smoothed = smooth_drive(events, setup, update_after_compiling(bar))
    stamps_s, located = smoothed.stamps_ns / 1e9, smoothed.located
    write_tum(args.out / "smoothed.tum", stamps_s[located], smoothed.Ts_world_vehicle[located])
    off = shift_m, turn_rad = filtered.distances_to(smoothed)
    summary = {
        "events": len(events),
        "filtered": _known(filtered),
        "smoothed": _known(smoothed),
        "rms_position_difference_m": _rms(shift_m[filtered.decided]),
        "rms_heading_difference_deg": _rms(np.rad2deg(turn_rad[filtered.decided])),
    }
    tracks, names = (filtered.positions_m, smoothed.positions_m), ("filtered", "smoothed")
    title = _smoothing_text(summary)
    return summary, _picture(setup, smoothed.stamps_ns, *tracks, off, title, names)


def _known(track: DriveTrack) -> dict[str, float]:
    """Shares of the events, and how well the pose is known where it is decided."""

    def median(values: np.ndarray) -> float:
        return float(np.median(values)) if len(values) else np.nan

    return {
        "located_share": float(np.mean(track.located)),
        "decided_share": float(np.mean(track.decided)),
        "median_sigma_m": median(track.sigma_m[track.decided]),
        "median_sigma_deg": median(np.rad2deg(track.sigma_rad[track.decided])),
    }


def _smoothing_text(summary: dict[str, Any]) -> str:
    """What smoothing has changed, in two lines."""
    was, now = summary["filtered"], summary["smoothed"]
    before, after = (
        f"{100 * of['median_sigma_m']:.2g} cm {of['median_sigma_deg']:.2g} deg" for of in (was, now)
    )
    return (
        f"decided {was['decided_share']:.0%} of {summary['events']} events, smoothed "
        f"{now['decided_share']:.0%}; sigma {before}, smoothed {after}\n"
        "once decided, the filter was off the smoothed track by "
        f"{100 * summary['rms_position_difference_m']:.2g} cm and "
        f"{summary['rms_heading_difference_deg']:.2g} deg (rms)"
    )


def _rms(values: np.ndarray) -> float:
    """The root mean square of those that are finite; NaN of none."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan
