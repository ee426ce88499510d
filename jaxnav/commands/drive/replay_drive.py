"""`jaxnav replay` of a drive: run the pilot on recorded inputs, and compare its outcomes."""

import dataclasses
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from jaxnav.commands.drive.arguments import ReplayRecording as Arguments
from jaxnav.commands.drive.track import Track, TrackRow
from jaxnav.commands.pictures import corners_in_world, save_figure
from jaxnav.commands.process import configure_jax
from jaxnav.commands.reading import read_shown
from jaxnav.configuration import step_folder
from jaxnav.datasets.ros_drives import read_ros_drive
from jaxnav.errors import BadInput, visible
from jaxnav.files import (
    Params,
    atomic_path,
    load_markers,
    load_params,
    load_rig,
    load_route,
    load_topics,
    load_vehicle,
    output_folder,
    write_json,
    write_tum,
)
from jaxnav.loop.pilot import Input
from jaxnav.plots.localisation import localisation_report
from jaxnav.recording.drive_format import PROFILE
from jaxnav.recording.drive_log import DriveLog
from jaxnav.recording.drive_replay import (
    Comparison,
    check_inputs,
    inputs_from_images,
    replay_drive,
)
from jaxnav.recording.drive_setup import DriveSetup, needs_float64
from jaxnav.recording.mcap_messages import profile_of
from jaxnav.recording.message_schemas import OUTCOME
from jaxnav.recording.messages import digest, input_message
from jaxnav.recording.outcomes import Outcomes, outcome_message
from jaxnav.recording.plausible import keep_plausible
from jaxnav.recording.recorder import Recorder

EXIT_DIFFERS = 1
_FOR_DRIVES = ("vehicle", "route", "images", "record")
_OVERRIDES = (
    *("rig", "markers_file", "vehicle", "route", "params"),
    *("selector", "corner_sigma_px", "images"),
)


def is_for(args: Arguments) -> bool:
    """Whether a recording is a drive.

    Raises:
        BadInput: a flag that does not go with such a recording.
    """
    path = args.recording
    if args.topics is not None or profile_of(path) == PROFILE:
        if args.markers != "all":
            raise BadInput("--markers", f"must be all for a drive, got {args.markers}")
        return True
    if path.suffix in (".mcap", ".db3") or (path / "metadata.yaml").is_file():
        if path.exists():
            problem = f"missing: {path} is a ROS bag: they say which topic is what"
            raise BadInput("--topics", problem)
    for name in _FOR_DRIVES:
        if getattr(args, name):
            raise BadInput(f"--{name}", f"is for drives, and {path} is none")
    return False


def run(args: Arguments) -> int:
    """Drive again, compare, write a summary and the trajectory; 1 where outcomes differ."""
    params = None if args.params is None else load_params(args.params)
    load = _own_drive if args.topics is None else _ros_drive
    log, setup, inputs = load(args, params)
    inputs = inputs[: args.limit]
    if not inputs:
        raise BadInput(args.recording, "holds no input")
    check_inputs(inputs, setup, args.recording)
    changed = [name for name in _OVERRIDES if getattr(args, name)]
    comparison = Comparison(log) if log is not None and not changed else None
    out = output_folder(args.out)
    if params is not None:
        print(params.describe())
    track = _replayed(args, setup, inputs, comparison)
    summary: dict[str, Any] = {
        "recording": str(args.recording),
        "selector": setup.selector,
        "parameters": setup.parameters,
    }
    summary |= track.summary()
    recorded = None
    if log is not None:
        summary |= {"changed": changed, "missing": log.missing, "truncated": log.truncated}
        recorded = keep_plausible(log.outcomes)[0]
        summary |= track.rms_differences(recorded)
    if comparison is not None:
        summary |= {
            "compared": comparison.compared,
            "bit_for_bit": comparison.bit_for_bit,
            "first_difference": comparison.first and dataclasses.asdict(comparison.first),
        }
    else:
        save_figure(_picture(setup, track, recorded, _text(summary)), out / "report.png")
    write_json(out / "summary.json", summary)
    located = track.located
    write_tum(out / "trajectory.tum", track.now_ns[located] / 1e9, track.Ts_world_vehicle[located])
    print(_text(summary))
    print(f"summary in {visible(out)}")
    return EXIT_DIFFERS if comparison is not None and comparison.first else 0


_Drive = tuple[DriveLog | None, DriveSetup, Sequence[Input]]


def _own_drive(args: Arguments, params: Params | None) -> _Drive:
    log = read_shown(args.recording, args.headless)
    configure_jax(float64=needs_float64(log.header, args.recording), threads=1)
    setup = _overridden(DriveSetup.of_header(log.header, args.recording), args, params)
    if args.images:
        return log, setup, inputs_from_images(log, setup, args.corner_backend)[0]
    return log, setup, log.inputs


def _ros_drive(args: Arguments, params: Params | None) -> _Drive:
    configure_jax(float64=True, threads=1)
    path = args.recording

    def needed(name: str) -> Path:
        given = getattr(args, name)
        if given is None:
            problem = f"missing: a ROS bag ({path}) does not hold it"
            raise BadInput(f"--{name.replace('_', '-')}", problem)
        return Path(given)

    assert args.topics is not None
    setup = _overridden(
        DriveSetup(
            load_rig(needed("rig")),
            load_markers(needed("markers_file")),
            load_vehicle(needed("vehicle")),
            load_route(needed("route")),
            float64=True,
        ),
        dataclasses.replace(args, rig=None, markers_file=None, vehicle=None, route=None),
        params,
    )
    inputs = read_ros_drive(
        path, load_topics(args.topics), setup.rig, setup.markers, setup.vehicle, args.corner_backend
    )
    return None, setup, inputs


def _overridden(setup: DriveSetup, args: Arguments, params: Params | None) -> DriveSetup:
    changes: dict[str, Any] = {}
    for field, path, load in (
        ("rig", args.rig, load_rig),
        ("markers", args.markers_file, load_markers),
        ("vehicle", args.vehicle, load_vehicle),
        ("route", args.route, load_route),
    ):
        if path is not None:
            changes[field] = load(path)
    for field in ("selector", "corner_sigma_px"):
        if getattr(args, field) is not None:
            changes[field] = getattr(args, field)
    setup = dataclasses.replace(setup, **changes)
    return setup if params is None else setup.with_params(params)


def _replayed(
    args: Arguments, setup: DriveSetup, inputs: Sequence[Input], comparison: Comparison | None
) -> Track:
    rows = []
    outcomes = replay_drive(inputs, setup, step_folder())
    with ExitStack() as closing:
        recorder = None
        if args.record:
            path = args.out / "replay.mcap"
            beside = closing.enter_context(atomic_path(path))
            # No car waits for this replay, so that the queue may hold every message.
            recorder = Recorder(beside, setup.header(), queue_messages=2 * len(inputs) + 1)
            closing.callback(recorder.close, timeout_s=60.0)
        bar = closing.enter_context(tqdm(total=len(inputs), unit="input", disable=args.headless))
        bar.set_postfix_str("compiling")
        for given, outcome in zip(inputs, outcomes, strict=True):
            bar.set_postfix_str("", refresh=False)
            rows.append(TrackRow.of(outcome))
            if comparison is not None:
                comparison.look(outcome)
            if recorder is not None:
                recorder.put(*input_message(given))
                message = outcome_message(outcome, digest(outcome))
                recorder.put(OUTCOME, given.now_ns, message)
            bar.update()
        if recorder is not None:
            recorder.close(timeout_s=60.0)
            if recorder.failed is not None:
                raise BadInput("--record", recorder.failed.replace(str(beside), str(path)))
    return Track(rows)


def _picture(setup: DriveSetup, track: Track, recorded: Outcomes | None, title: str) -> Figure:
    recorded_m, drawn = None, {}
    if recorded is not None:
        shift_m, turn_rad = track.distances_to(recorded)
        # A logarithmic axis shows no zero: 1e-9 stands for it.
        drawn = {
            "position off (m)": np.maximum(shift_m, 1e-9),
            "heading off (deg)": np.maximum(np.rad2deg(turn_rad), 1e-9),
        }
        recorded_m = np.where(recorded.located[:, None], recorded.pose, np.nan)
        recorded_m[:, 2] = 0.0
    return localisation_report(
        track.times_s,
        track.positions_m,
        recorded_m,
        drawn,
        corners_in_world(setup.markers),
        title=title,
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
