"""`jaxnav replay` of a drive: run the pilot on recorded inputs, and compare its outcomes."""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.figure import Figure

from jaxnav.commands.bars import progress_bar, update_after_compiling
from jaxnav.commands.drive import replay_smoothed
from jaxnav.commands.drive.arguments import ReplayRecording as Arguments
from jaxnav.commands.kinds import flag_of
from jaxnav.commands.process import configure_jax
from jaxnav.commands.reading import given_files, read_shown
from jaxnav.commands.report import corners_in_world, save_figure
from jaxnav.drive.flags import Fault, Health, Reject, names
from jaxnav.drive.pilot import Input, Outcome
from jaxnav.errors import BadInput, visible
from jaxnav.files import (
    Params,
    atomic_path,
    load_params,
    load_topics,
    output_folder,
    write_json,
    write_tum,
)
from jaxnav.files.configuration import step_folder
from jaxnav.pictures.localisation import localisation_report
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
from jaxnav.recordings.other.ros import read_ros_drive
from jaxnav.recordings.other.smoothed_drive import distances
from jaxnav.recordings.plausible import keep_plausible
from jaxnav.recordings.recorder import Recorder
from jaxnav.recordings.records import Outcomes

EXIT_DIFFERS = 1
_FILES = ("rig", "markers", "vehicle", "route")
_FOR_RIGS = ("one_at_a_time", "without_odometry")
_FOR_DRIVES = ("vehicle", "route", "images", "record_anew")
_OVERRIDES = (
    *("rig", "markers", "vehicle", "route", "params"),
    *("selector", "corner_sigma_px", "images"),
)


@dataclass(frozen=True)
class Track:
    """The track of a drive that is driven again: N rows in the order of their outcomes.

    Attributes:
        now_ns: when each input reached the pilot, (N,).
        poses: (N, 3), x_m y_m psi_rad.
        Ts_world_vehicle: (N, 7) wxyz_xyz.
        located, decided: (N,) bool.
        health, faults, rejects: of each outcome.
        restarts, restart_reason: at the end.
    """

    now_ns: Int[np.ndarray, " N"]
    poses: Float[np.ndarray, "N 3"]
    Ts_world_vehicle: Float[np.ndarray, "N 7"]
    located: Bool[np.ndarray, " N"]
    decided: Bool[np.ndarray, " N"]
    health: Sequence[Health]
    faults: Sequence[Fault]
    rejects: Sequence[Reject]
    restarts: int
    restart_reason: str

    @property
    def times_s(self) -> Float[np.ndarray, " N"]:
        """Times since the first row, (N,) s."""
        return np.asarray((self.now_ns - self.now_ns[0]) / 1e9)

    @property
    def positions_m(self) -> Float[np.ndarray, "N 3"]:
        """Positions of the vehicle, (N, 3) m, NaN where not located."""
        return np.where(self.located[:, None], self.Ts_world_vehicle[:, 4:], np.nan)

    def summary(self) -> dict[str, Any]:
        """Counts of faults and rejects, shares of health, and the last pose and restarts."""
        count, healths = len(self.health), Counter(self.health)
        return {
            "states": count,
            "duration_s": float(self.times_s[-1]),
            "health_shares": {h.name: healths[h] / count for h in Health},
            "located_share": float(np.mean(self.located)),
            "decided_share": float(np.mean(self.decided)),
            "faults": dict(Counter(name for one in self.faults for name in names(one))),
            "rejects": dict(Counter(name for one in self.rejects for name in names(one))),
            "final_pose": self.poses[-1] if self.located[-1] else None,
            "restarts": self.restarts,
            "restart_reason": self.restart_reason,
        }

    def distances_to(
        self, recorded: Outcomes
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
        """Distances (N,) m and (N,) rad to the recorded track, NaN where either has no pose."""
        index = np.searchsorted(recorded.now_ns, self.now_ns)
        known = index < len(recorded.now_ns)
        index = np.where(known, index, 0)
        if not len(recorded.now_ns):
            return np.full(len(index), np.nan), np.full(len(index), np.nan)
        known &= (recorded.now_ns[index] == self.now_ns) & recorded.located[index] & self.located
        return distances(self.poses, recorded.pose[index], known)

    def rms_differences(self, recorded: Outcomes) -> dict[str, Any]:
        """Root mean square differences from the recorded track."""
        shift_m, turn_rad = self.distances_to(recorded)
        return {
            "rms_position_difference_m": replay_smoothed.rms(shift_m),
            "rms_heading_difference_deg": np.rad2deg(replay_smoothed.rms(turn_rad)),
        }


def is_for(args: Arguments) -> bool:
    """Whether a recording is a drive.

    Raises:
        BadInput: a flag that does not go with such a recording.
    """
    path = args.recording
    moves_freely = args.topics is not None and load_topics(args.topics).imu is not None
    if moves_freely and not (args.vehicle or args.route):
        for name in _FOR_DRIVES:
            if getattr(args, name):
                raise BadInput(flag_of(name), f"is for drives, and {path} with an IMU is a rig's")
        return False
    if args.topics is not None or profile_of(path) == PROFILE:
        for name in _FOR_RIGS:
            if getattr(args, name):
                raise BadInput(flag_of(name), "goes with recordings of a rig, not with a drive")
        return True
    if path.suffix in (".mcap", ".db3") or (path / "metadata.yaml").is_file():
        if path.exists():
            problem = f"missing: {path} is a ROS bag: they say which topic is what"
            raise BadInput("--topics", problem)
    for name in _FOR_DRIVES:
        if getattr(args, name):
            raise BadInput(flag_of(name), f"is for drives, and {path} is none")
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
    smoothing = ""
    if events is not None:
        summary["smoothing"] = replay_smoothed.run(args, events, setup)
        smoothing = f"\n{replay_smoothed.text(summary['smoothing'])}"
    write_json(out / "summary.json", summary)
    located = track.located
    write_tum(out / "trajectory.tum", track.now_ns[located] / 1e9, track.Ts_world_vehicle[located])
    print(f"{_text(summary)}{smoothing}")
    print(f"summary in {visible(out)}")
    return EXIT_DIFFERS if comparison is not None and comparison.first else 0


_Drive = tuple[DriveLog | None, DriveSetup, Sequence[Input]]


def _own_drive(args: Arguments, params: Params | None) -> _Drive:
    log = read_shown(args.recording, args.headless)
    configure_jax(float64=needs_float64(log.header, args.recording), threads=1)
    setup = DriveSetup.from_header(log.header, args.recording)
    setup = _tuned(dataclasses.replace(setup, **given_files(args, _FILES)), args, params)
    if args.images:
        return log, setup, inputs_from_images(log, setup, args.corner_backend)[0]
    return log, setup, log.inputs


def _ros_drive(args: Arguments, params: Params | None) -> _Drive:
    configure_jax(float64=True, threads=1)
    assert args.topics is not None
    files = given_files(args, _FILES, bag=args.recording)
    setup = _tuned(DriveSetup(**files, float64=True), args, params)
    inputs = read_ros_drive(
        args.recording,
        load_topics(args.topics),
        setup.rig,
        setup.markers,
        setup.vehicle,
        args.corner_backend,
    )
    return None, setup, inputs


def _tuned(setup: DriveSetup, args: Arguments, params: Params | None) -> DriveSetup:
    """The setup with what the arguments give in place of its own figures."""
    for name in ("selector", "corner_sigma_px"):
        if getattr(args, name) is not None:
            setup = dataclasses.replace(setup, **{name: getattr(args, name)})
    return setup if params is None else setup.with_params(params)


def _replayed(
    args: Arguments, setup: DriveSetup, inputs: Sequence[Input], comparison: Comparison | None
) -> Track:
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
            rows.append(_row(outcome))
            if comparison is not None:
                comparison.look(outcome)
            if recorder is not None:
                recorder.record(given, outcome)
            update(1)
        if recorder is not None:
            recorder.close(timeout_s=60.0)
            if recorder.failed is not None:
                raise BadInput("--record-anew", recorder.failed.replace(str(beside), str(path)))
    columns: list[Any] = list(zip(*rows, strict=True))
    now_ns, poses, Ts, located, decided, health, faults, rejects, restarts, reasons = columns
    return Track(
        np.array(now_ns, np.int64),
        np.stack(poses),
        np.stack(Ts),
        np.array(located),
        np.array(decided),
        health,
        faults,
        rejects,
        restarts[-1],
        reasons[-1],
    )


def _row(outcome: Outcome) -> tuple[Any, ...]:
    """The part of an outcome that a `Track` keeps, without its bank of hypotheses."""
    output = outcome.output
    return (
        outcome.now_ns,
        np.asarray(outcome.pose, float),
        np.asarray(outcome.T_world_vehicle, float),
        bool(output.located),
        bool(output.decided),
        outcome.health,
        outcome.faults,
        outcome.rejects,
        outcome.restarts,
        outcome.restart_reason,
    )


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
