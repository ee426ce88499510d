"""`jaxnav replay`: localise a recorded rig in every frame, or drive a recorded drive again."""

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxnav.commands.bars import progress_bar, update_after_compiling
from jaxnav.commands.drive import replay_drive
from jaxnav.commands.drive.arguments import ReplayRecording as Arguments
from jaxnav.commands.kinds import Selector
from jaxnav.commands.process import configure_jax
from jaxnav.commands.reading import given_files
from jaxnav.commands.report import corners_in_world, write_report
from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.navigator import Navigator
from jaxnav.errors import BadInput, visible
from jaxnav.files import apply_params, output_folder, write_tum
from jaxnav.files.writing import atomic_write
from jaxnav.recordings.other.recordings import Recording, read_recording
from jaxnav.recordings.other.replay import (
    Replay,
    errors,
    explain_outliers,
    frames_in_view,
    motion_of,
    replay,
    scores,
)
from jaxnav.recordings.ros.odometry_track import odometry_delay

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DEFAULT_SELECTOR: Selector = "multi-hypothesis"
_SETTLED_FRAMES = 5  # of a marker in view; a choice made later can use a history
_MANY_OUTLIERS = 0.2  # poses
_POSE_COLUMNS = "qw", "qx", "qy", "qz", "x_m", "y_m", "z_m"


def run(args: Arguments) -> int:
    """Localise the rig, write the trajectory, and its errors where there is a reference."""
    if replay_drive.is_for(args):
        return replay_drive.run(args)
    args = dataclasses.replace(args, selector=args.selector or _DEFAULT_SELECTOR)
    configure_jax(float64=True, threads=1)
    files = given_files(args, ("params", "rig", "markers", "topics"))
    params, *others = (files.get(name) for name in ("params", "rig", "markers", "topics"))
    recording = read_recording(args.recording, *others)
    if args.limit is not None:
        recording = recording.first(args.limit)
    if args.without_odometry:
        recording = dataclasses.replace(recording, odometry=None, imu=None)
    if not len(recording):
        raise BadInput(args.recording, "holds no frame")
    if params is not None:  # raises on bad input before the folder is made
        apply_params(
            Navigator(recording.rig, recording.markers, motion=motion_of(recording)), params
        )
    out = output_folder(args.out)
    if params is not None:
        print(params.describe())
    passes = 2 if args.smooth else 1
    with progress_bar(total=passes * len(recording), unit="frame", disable=args.headless) as bar:
        result = replay(
            recording,
            make_selector(str(args.selector)),
            one_at_a_time=args.one_at_a_time,
            corner_sigma_px=args.corner_sigma_px,
            progress=update_after_compiling(bar),
            params=params,
            smooth=args.smooth,
        )
    summary = _summary(args, recording, result)
    _write_tracks(args, recording, result)
    _write_detections(args, recording, result)
    lines = [_text(summary)]
    if summary.get("outlier_fraction", 0) > _MANY_OUTLIERS:
        lines.append(explain_outliers(recording))
    if recording.odometry is not None:
        track = int(np.argmax(result.seen.sum(axis=0)))  # the one that sees most
        poses, seen = result.T_world_vehicle[:, track], result.seen[:, track]
        delay = odometry_delay(recording.odometry, recording.stamps_ns, poses, seen)
        if delay is not None:
            lines.append(f"{delay}: odom_delay_s in tagslam.yaml takes it away")
    lines.append(f"report in {visible(out)}")
    write_report(out, summary, lines, report=_picture(recording, result, _text(summary)))
    return 0


def _summary(args: Arguments, recording: Recording, result: Replay) -> dict[str, Any]:
    """The content of summary.json: counts, speed and, with a reference, errors and branches."""
    summary: dict[str, Any] = {
        "recording": recording.name,
        "markers": "one-at-a-time" if args.one_at_a_time else "all",
        "selector": args.selector,
        "odometry": recording.odometry is not None,
        "imu": recording.imu is not None,
        "smoothed": args.smooth,
        "params": args.params,
        "frames": len(recording),
        "frames_located": int(result.seen.any(axis=1).sum()),
        "detections": len(recording.seen_px),
        "detections_not_in_map": recording.unmapped_detections,
        "detections_dropped": recording.dropped_detections,
        "poses": int(result.seen.sum()),
        "frames_per_second": result.frames_per_second,
        "corner_sigma_px": result.corner_sigma_px,
    }
    if recording.reference is None:
        return summary
    summary |= _against_reference(recording, result)
    if result.filtered is not None:
        summary["filtered"] = _against_reference(recording, result.filtered)
    return summary


def _against_reference(recording: Recording, result: Replay) -> dict[str, Any]:
    assert recording.reference is not None
    position_m, rotation_deg = errors(result, recording)
    judged = result.seen & recording.reference.valid[:, None]
    settled = judged & (frames_in_view(result.seen) > _SETTLED_FRAMES)
    late = (np.asarray(result.branch.wrong) & settled).sum() / max(int(settled.sum()), 1)
    known = scores(result, recording)
    return {
        "poses_with_reference": int(judged.sum()),
        "position_error_m": _spread(position_m),
        "rotation_error_deg": _spread(rotation_deg),
        "wrong_branch_fraction": known["wrong"],
        f"wrong_branch_fraction_after_{_SETTLED_FRAMES}_frames": float(late),
        "outlier_fraction": known["outlier"],
        "decided_fraction": known["decided"],
        "claimed_fraction": known["claimed"],
        "wrong_of_claimed_fraction": known["wrong_of_claimed"],
        **{name: known[name] for name in ("log_score", "log_score_of_a_constant", "anees")},
    }


def _spread(values: np.ndarray) -> dict[str, float]:
    values = values[np.isfinite(values)]
    if not len(values):
        return dict.fromkeys(("median", "p95", "rms"), np.nan)
    rms = np.sqrt(np.mean(values**2))
    return {"median": np.median(values), "p95": np.percentile(values, 95), "rms": rms}


def _write_tracks(args: Arguments, recording: Recording, result: Replay) -> None:
    """Write one TUM file, or one for each marker where every marker has a track of its own."""
    stamps_s = recording.stamps_ns / 1e9
    for track in range(result.seen.shape[1]):
        name = "trajectory"
        if args.one_at_a_time:
            name = f"trajectory_marker_{recording.markers.ids[track]}"
        known = (result.located if args.smooth else result.seen)[:, track]
        write_tum(args.out / f"{name}.tum", stamps_s[known], result.T_world_vehicle[known, track])
    if recording.reference is not None:
        valid = recording.reference.valid
        write_tum(
            args.out / "reference.tum", stamps_s[valid], recording.reference.T_world_vehicle[valid]
        )


def _write_detections(args: Arguments, recording: Recording, result: Replay) -> None:
    """Write what was seen, a line each, and what was made of it: for who wants to count again."""
    frame, camera, marker = recording.seen_at
    track = marker if args.one_at_a_time else np.zeros_like(marker)
    row = np.full(result.seen.shape, -1)
    row[result.seen] = np.arange(len(result.selected))
    used = row[frame, track] >= 0  # nothing is where the marker can be none
    frame, camera, marker, track = (each[used] for each in (frame, camera, marker, track))
    rows, poses = row[frame, track], result.T_world_vehicle[frame, track]
    turned = Rotation.from_quat(poses[:, :4], scalar_first=True)
    in_vehicle_m = np.asarray(recording.rig.Ts_camera_vehicle.inverse().translation())[camera]
    Ts_world_marker = recording.markers.Ts_world_marker
    to_camera = poses[:, 4:] + turned.apply(in_vehicle_m)
    to_camera -= np.asarray(Ts_world_marker.translation())[marker] + recording.markers.origin_m
    normal = np.asarray(Ts_world_marker.rotation().as_matrix())[marker, :, 2]
    cosine = np.sum(normal * to_camera, axis=1) / np.linalg.norm(to_camera, axis=1)
    columns = {
        "frame": frame,
        "stamp_ns": recording.stamps_ns[frame],
        "camera": np.array(recording.rig.names)[camera],
        "id": np.array(recording.markers.ids)[marker],
        "view_deg": np.rad2deg(np.arccos(np.clip(cosine, -1, 1))),
        "chosen": result.selected[rows],
        "flip_probability": result.flip_probability[frame, track],
        "decided": result.decided[frame, track].astype(int),
    }
    if recording.reference is not None:
        position_m, rotation_deg = errors(result, recording)
        columns |= {
            "nees": result.nees[frame, track],
            "position_error_m": position_m[frame, track],
            "rotation_error_deg": rotation_deg[frame, track],
        }
    candidates = enumerate(np.moveaxis(result.candidates[rows], 1, 0))
    named = {"reported": poses} | {f"candidate_{number}": pose for number, pose in candidates}
    for name, pose in named.items():
        columns |= {f"{name}_{axis}": pose[:, n] for n, axis in enumerate(_POSE_COLUMNS)}
    lines = [",".join(columns)]
    lines += [
        ",".join(f"{cell:.9g}" if isinstance(cell, float) else str(cell) for cell in line)
        for line in zip(*(column.tolist() for column in columns.values()), strict=True)
    ]
    atomic_write(args.out / "detections.csv", "\n".join(lines) + "\n")


def _picture(recording: Recording, result: Replay, title: str) -> "Figure":
    # It imports matplotlib, which a drive that is compared needs not.
    from jaxnav.pictures.localisation import localisation_report

    times_s = (recording.stamps_ns - recording.stamps_ns[0]) / 1e9
    # Tracks one after the other, so that every pose is drawn.
    positions_m = np.where(result.seen[..., None], result.T_world_vehicle[..., 4:], np.nan)
    tracks = result.seen.shape[1]
    reference_m, drawn = None, {}
    if recording.reference is not None:
        valid = recording.reference.valid[:, None]
        reference_m = np.where(valid, recording.reference.T_world_vehicle[:, 4:], np.nan)
        names = "position error (m)", "rotation error (deg)"
        off = errors(result, recording)
        drawn = {name: values.T.ravel() for name, values in zip(names, off, strict=True)}
    return localisation_report(
        np.tile(times_s, tracks),
        positions_m.transpose(1, 0, 2).reshape(-1, 3),
        reference_m,
        drawn,
        corners_in_world(recording.markers),
        title=title,
        connected=tracks == 1,
    )


def _text(summary: dict[str, Any]) -> str:
    head = (
        f"{visible(summary['recording'])}, {summary['selector']}, markers {summary['markers']}"
        f"{', with odometry' if summary['odometry'] else ''}"
        f"{', with an IMU' if summary['imu'] else ''}"
        f"{', smoothed' if summary['smoothed'] else ''}: "
        f"{summary['poses']} poses in {summary['frames']} frames, "
        f"{summary['frames_per_second']:.0f} frames/s"
    )
    if "position_error_m" not in summary:
        return head
    text = f"{head}\n{_errors_text(summary)}"
    if "filtered" in summary:
        text += f"\nbefore smoothing: {_errors_text(summary['filtered'])}"
    return text


def _errors_text(scores: dict[str, Any]) -> str:
    position, rotation = scores["position_error_m"], scores["rotation_error_deg"]
    return (
        f"position error {position['median'] * 1e3:.1f} mm median, "
        f"{position['p95'] * 1e3:.1f} mm 95 %; rotation {rotation['median']:.2f} / "
        f"{rotation['p95']:.2f} deg; wrong branch {scores['wrong_branch_fraction']:.2%}, "
        f"outliers {scores['outlier_fraction']:.2%}"
    )
