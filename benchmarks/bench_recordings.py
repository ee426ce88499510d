"""Score selectors on recordings with a reference, every marker by itself.

    python benchmarks/bench_recordings.py [NAME ...] [--frames N] [--smooth] [--all-markers]

The recordings are the folders of `JAXNAV_DATA`/tagslam, or of ../shared/data/tagslam. A pose of a
marker is judged as `jaxnav replay --one-at-a-time` does: wrong where another candidate is
nearer to the reference in angle, an outlier where none is within 10 degrees.
"""

import argparse
import dataclasses
import functools
import itertools
import os
import time
from pathlib import Path

from jaxnav.files.configuration import configure

configure(float64=True)  # before the first array, as the commands do

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import jaxlie  # noqa: E402
import numpy as np  # noqa: E402

from jaxnav.core.filter.free import ConstantVelocity  # noqa: E402
from jaxnav.core.filter.selectors import make_selector  # noqa: E402
from jaxnav.core.models.vehicle import default_odometry_sigma  # noqa: E402
from jaxnav.files.poses import matrix, pose_from_matrix  # noqa: E402
from jaxnav.recordings.other.recordings import Recording, read_recording  # noqa: E402
from jaxnav.recordings.other.replay import Replay, errors, replay, scores  # noqa: E402
from jaxnav.recordings.ros.odometry_track import OdometryTrack  # noqa: E402

DATA = Path(os.environ.get("JAXNAV_DATA", Path(__file__).parents[2] / "shared/data")) / "tagslam"


def score(recording: Recording, result: Replay) -> dict[str, float]:
    """The cells of a row."""
    assert recording.reference is not None
    known = scores(result, recording)
    position_m, rotation_deg = (error[np.isfinite(error)] for error in errors(result, recording))
    return {
        "poses": int((result.seen & recording.reference.valid[:, None]).sum()),
        "wrong %": 100 * known["wrong"],
        "outliers %": 100 * known["outlier"],
        "claimed %": 100 * known["claimed"],
        "wrong of those %": 100 * known["wrong_of_claimed"],
        "log score": known["log_score"],
        "of a constant": known["log_score_of_a_constant"],
        "ANEES": known["anees"],
        "NEES median": known["nees_median"],
        "mm": 1e3 * float(np.median(position_m)),
        "mm, 95 %": 1e3 * float(np.percentile(position_m, 95)),
        "deg": float(np.median(rotation_deg)),
        "deg, 95 %": float(np.percentile(rotation_deg, 95)),
    }


def by_count(recording: Recording) -> np.ndarray:
    """Indices (M,) of the markers, those that are seen most first."""
    seen = np.bincount(recording.seen_at[2], minlength=len(recording.markers.ids))
    return np.argsort(-seen, kind="stable")


def with_sightings(recording: Recording, kept: np.ndarray) -> Recording:
    """The recording with some of its sightings alone."""
    return dataclasses.replace(
        recording, seen_at=recording.seen_at[:, kept], seen_px=recording.seen_px[kept]
    )


def of_most_seen(recording: Recording, count: int) -> Recording:
    """The recording with the markers that are seen most, in the map's order."""
    chosen = np.sort(by_count(recording)[:count])
    index = np.full(len(recording.markers.ids), -1)
    index[chosen] = np.arange(len(chosen))
    kept = index[recording.seen_at[2]] >= 0
    frame, camera, marker = recording.seen_at[:, kept]
    whole = recording.markers
    markers = dataclasses.replace(
        whole,
        Ts_world_marker=jaxlie.SE3(whole.Ts_world_marker.wxyz_xyz[chosen]),
        size_m=whole.size_m[chosen],
        ids=tuple(whole.ids[row] for row in chosen),
        families=tuple(whole.families[row] for row in chosen),
    )
    return dataclasses.replace(
        recording,
        markers=markers,
        seen_at=np.stack([frame, camera, index[marker]]),
        seen_px=recording.seen_px[kept],
    )


def with_made_odometry(recording: Recording, scale: float, yaw_deg: float) -> Recording:
    """The recording with odometry made from its reference, 0.1 m ahead of the rig's origin.

    Its way is `scale` of the true one, its body is turned by `yaw_deg` beside what is told, and it
    drifts by half of what `motion.odometry_drift` allows. It is made of the corners it is to help.
    """
    assert recording.reference is not None
    rows = np.flatnonzero(recording.reference.valid)
    true = jaxlie.SE3(jnp.asarray(recording.reference.T_world_vehicle[rows]))
    told = np.array([1.0, 0, 0, 0, 0.1, 0, 0])
    z_rad = jnp.asarray(np.deg2rad(yaw_deg))
    turned = jaxlie.SE3.from_rotation(jaxlie.SO3.from_z_radians(z_rad))
    body = true @ jaxlie.SE3(jnp.asarray(told)) @ turned
    before, after = (jaxlie.SE3(body.wxyz_xyz[part]) for part in (slice(-1), slice(1, None)))
    steps = np.array((before.inverse() @ after).log())
    steps[:, :3] *= scale
    way, angle = (np.linalg.norm(steps[:, part], axis=1) for part in (slice(3), slice(3, 6)))
    dt_s = np.diff(recording.stamps_ns[rows]) / 1e9
    per_m, per_rad, walk_m, walk_rad = (np.asarray(ConstantVelocity().odometry_drift) / 2) ** 2
    sigmas = np.sqrt([per_m * way + walk_m * dt_s] * 3 + [per_rad * angle + walk_rad * dt_s] * 3).T
    steps = steps + sigmas * np.random.default_rng(0).standard_normal(steps.shape)
    moves = np.asarray(jaxlie.SE3.exp(jnp.asarray(steps)).as_matrix())
    places = list(itertools.accumulate(moves, np.matmul, initial=np.eye(4)))
    poses = np.array([pose_from_matrix(T) for T in places])
    track = OdometryTrack(recording.stamps_ns[rows], poses, told)
    return dataclasses.replace(recording, odometry=track)


def print_held_out(recording: Recording, selector: str) -> None:
    """How well poses from every second marker predict the corners of the others, in pixels.

    The reference is made of all corners, so that it has a part of each frame's noise; the corners
    of other markers have none of it.
    """
    assert recording.reference is not None
    frame, camera, marker = recording.seen_at
    used = np.isin(marker, by_count(recording)[::2])
    half = with_sightings(recording, used)
    result = replay(half, make_selector(selector), one_at_a_time=False, smooth=True)
    assert result.filtered is not None
    compared = ~used & (result.filtered.located[:, 0] & recording.reference.valid)[frame]
    compared &= np.isin(frame, frame[used])
    frame, camera, marker = frame[compared], camera[compared], marker[compared]
    corners = recording.markers.corners_world_m[marker]

    @jax.jit
    @jax.vmap
    def predicted(pose: jax.Array, camera: jax.Array, corners: jax.Array) -> jax.Array:
        return recording.rig.project(jaxlie.SE3(pose).inverse(), corners)[camera]

    for title, poses in {
        "reference": recording.reference.T_world_vehicle,
        f"{selector}, filter": result.filtered.T_world_vehicle[:, 0],
        f"{selector}, smoothed": result.T_world_vehicle[:, 0],
    }.items():
        off = np.asarray(predicted(jnp.asarray(poses)[frame], camera, corners))
        rms_px = np.sqrt(np.mean(np.sum((off - recording.seen_px[compared]) ** 2, -1), -1))
        cells = (f"{value:.2f}" for value in np.percentile(rms_px, [50, 95]))
        print(f"| {recording.name} | {title} | {len(rms_px)} | {' | '.join(cells)} |", flush=True)


def print_gaps(recording: Recording, gap_s: float) -> None:
    """How the error grows while no marker is seen, and that of the odometry alone meanwhile."""
    assert recording.reference is not None
    assert recording.odometry is not None
    times_s = (recording.stamps_ns - recording.stamps_ns[0]) / 1e9
    rows = np.flatnonzero(recording.reference.valid)
    in_gap = times_s % (1.6 * gap_s) > 0.6 * gap_s
    hidden = with_sightings(recording, ~in_gap[recording.seen_at[0]])
    found = replay(hidden, make_selector("multi-hypothesis")).T_world_vehicle[rows, 0]
    truth = recording.reference.T_world_vehicle[rows]
    stamps_ns, twists = (
        recording.stamps_ns[rows],
        recording.odometry.twists(recording.stamps_ns[rows]),
    )
    steps = jaxlie.SE3.exp(jnp.asarray(twists[1:] * np.diff(stamps_ns)[:, None] / 1e9)).as_matrix()
    print(
        f"| a gap of {gap_s:g} s: error before, mm | after | of the odometry alone |\n|---|---|---|"
    )
    pieces = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(in_gap[rows])) + 1)
    for piece in pieces[:-1]:
        if not in_gap[rows[piece[0]]] or not piece[0]:
            continue
        before, last = piece[0] - 1, piece[-1]
        T_told = functools.reduce(np.matmul, np.asarray(steps[before:last]), matrix(truth[before]))
        ends_m = found[before, 4:], found[last, 4:], T_told[:3, 3]
        there_m = truth[before, 4:], truth[last, 4:], truth[last, 4:]
        off_mm = 1e3 * np.linalg.norm(np.subtract(ends_m, there_m), axis=1)
        print("| " + " | ".join(f"{one:.0f}" for one in off_mm) + " |", flush=True)


def main() -> None:
    """Print a row for each recording and selector."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="folders of tagslam; all of them by default")
    parser.add_argument("--frames", type=int, default=3000, help="at most so many of each")
    parser.add_argument("--every", type=int, default=1, help="every 2nd, 5th ... frame alone")
    parser.add_argument(
        "--selectors", nargs="*", default=["lowest-reprojection", "multi-hypothesis"]
    )
    parser.add_argument("--camera-sigma", type=float, nargs=2, metavar=("DEG", "M"),
                        help="of a camera's direction and place; 0 0: exact ones")  # fmt: skip
    parser.add_argument("--without-odometry", action="store_true")
    parser.add_argument("--odometry-delay-s", type=float, default=0.0,
                        help="its poses were taken so long before their stamps")  # fmt: skip
    parser.add_argument("--odometry-sigma", type=float, nargs=2, metavar=("SCALE", "DEG"),
                        help="of its scale and direction; 0 0: exact ones")  # fmt: skip
    parser.add_argument("--made-odometry", type=float, nargs=2, metavar=("SCALE", "YAW_DEG"),
                        help="make it from the reference, off by so much")  # fmt: skip
    parser.add_argument("--smooth", action="store_true", help="and the smoothed poses beside")
    parser.add_argument("--markers", type=int, help="only so many, those that are seen most")
    parser.add_argument("--all-markers", action="store_true", help="one pose from all in view")
    parser.add_argument("--held-out", action="store_true",
                        help="poses by half of the markers, judged by the others")  # fmt: skip
    parser.add_argument("--gap-s", type=float, help="hide all markers so long, now and then")
    args = parser.parse_args()
    head_is_printed = False
    for folder in sorted(DATA.glob("test_*"), key=lambda path: int(path.name[5:])):
        if args.names and folder.name not in args.names:
            continue
        recording = read_recording(folder).every(args.every).first(args.frames)
        if args.markers is not None:
            recording = of_most_seen(recording, args.markers)
        if args.without_odometry:
            recording = dataclasses.replace(recording, odometry=None)
        if args.made_odometry is not None:
            recording = with_made_odometry(recording, *args.made_odometry)
        if recording.odometry is not None:
            track = recording.odometry.earlier_by(args.odometry_delay_s)
            if args.odometry_sigma is not None:
                scale, turn_deg = args.odometry_sigma
                sigma = default_odometry_sigma(scale, np.deg2rad(turn_deg))
                track = dataclasses.replace(track, sigma=sigma)
            recording = dataclasses.replace(recording, odometry=track)
        if args.camera_sigma is not None:
            turn_rad, shift_m = np.deg2rad(args.camera_sigma[0]), args.camera_sigma[1]
            sigma = np.repeat([[shift_m] * 3 + [turn_rad] * 3], len(recording.rig), axis=0)
            known = None if not sigma.any() else jnp.asarray(sigma)
            rig = dataclasses.replace(recording.rig, extrinsics_sigma=known)
            recording = dataclasses.replace(recording, rig=rig)
        if args.gap_s is not None:
            print_gaps(recording, args.gap_s)
            continue
        if args.held_out:
            print_held_out(recording, args.selectors[-1])
            continue
        for name in args.selectors:
            begin = time.perf_counter()
            one = not args.all_markers
            result = replay(recording, make_selector(name), one_at_a_time=one, smooth=args.smooth)
            scored = {name: result.filtered or result}
            if result.filtered is not None:
                scored[f"{name}, smoothed"] = result
            for title, found in scored.items():
                row = score(recording, found)
                if not head_is_printed:
                    head = ["recording", "selector", *row, "s"]
                    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
                    head_is_printed = True
                cells = [folder.name, title, *(f"{value:.4g}" for value in row.values())]
                print(f"| {' | '.join(cells)} | {time.perf_counter() - begin:.0f} |", flush=True)


if __name__ == "__main__":
    main()
