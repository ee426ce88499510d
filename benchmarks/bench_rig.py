"""How well and how fast a rig is calibrated: simulated truth, TagSLAM's recordings, many frames.

    python benchmarks/bench_rig.py trials|branches|rendered|tagslam|scale [--trials N] [--frames N]

`trials`   the QCar's rig in a room of eight markers, corners with 0.3 px: errors against truth, how
           many true values lie within 3 sigma, ANEES.
`branches` the same room with corners of up to 3 px, where the pose that fits a sighting better is
           the mirrored one almost as often as not.
`rendered` the same room in images of the demo's cameras (lens blur 0.7 px, noise), corners found
           by jaxnav's detector: at rest, and driving with 5 ms of exposure and a rolling shutter.
`tagslam`  test_5 of TagSLAM, every camera's place off by 5 degrees and 5 cm, of the map marker 1
           alone: against TagSLAM's own result on the same corners, and test_7 localised with both.
`scale`    time and memory of so many frames.
"""

import argparse
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from scipy import stats

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

NOISE_PX = 0.3
DRIVING_MPS = 0.4


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("section", choices=("trials", "branches", "rendered", "tagslam", "scale"))
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--frames", type=int, default=None)
    args = parser.parse_args()
    from jaxnav.files.configuration import configure

    configure(float64=True)
    if args.section == "trials":
        trials(args.trials, args.frames or 300)
    elif args.section == "branches":
        branches(args.frames or 200)
    elif args.section == "rendered":
        rendered(args.frames or 120)
    elif args.section == "tagslam":
        tagslam()
    else:
        scale(args.frames or 5000)


def trials(count: int, frames: int) -> None:
    import rig_rooms
    from tqdm import trange

    from jaxnav.calibrate.rig.calibrate import calibrate_rig
    from jaxnav.calibrate.rig.views import Ts_vehicle_camera, turn_rad

    rig, markers = rig_rooms.qcar(), rig_rooms.room()
    path, true = rig_rooms.lemniscate(frames), Ts_vehicle_camera(rig)
    everything = np.concatenate([true, markers])
    errors, within, nees, sigmas, rms = [], [], [], [], []
    for seed in trange(count, unit="trial"):
        views = rig_rooms.views_of(rig, markers, path, NOISE_PX, seed)
        start = rig_rooms.spoiled(rig, seed)
        start = type(rig)(
            rig.cameras,
            type(rig.Ts_camera_vehicle)(
                start.Ts_camera_vehicle.wxyz_xyz.at[0].set(rig.Ts_camera_vehicle.wxyz_xyz[0])
            ),
            rig.names,
            rig.image_sizes_px,
        )
        found = calibrate_rig(views, start, {0: markers[0]}, 0)
        xi = rig_rooms.twists_to(
            np.concatenate([found.Ts_vehicle_camera, found.Ts_world_marker]), everything
        )
        moved = found.sigmas() > 0
        within.append(np.abs(xi[moved]) < 3 * found.sigmas()[moved])
        nees.append(rig_rooms.nees(found, xi, np.arange(xi.size)))
        errors.append(
            [
                (np.rad2deg(turn_rad(a, b)), 1e3 * np.linalg.norm((a - b)[:3, 3]))
                for a, b in zip(found.Ts_vehicle_camera[1:], true[1:], strict=True)
            ]
        )
        sigmas.append(found.sigma_px)
        rms.append(found.rms_px())
    errors = np.array(errors)
    values, dof = np.array(nees).T
    low, high = (stats.chi2.ppf(p, dof.sum()) / count for p in (0.0005, 0.9995))
    print(f"{count} trials, {frames} frames, {len(views)} sightings, corners {NOISE_PX} px")
    print(f"cameras, RMS: {np.sqrt((errors[..., 0] ** 2).mean()):.4f} deg, "
          f"{np.sqrt((errors[..., 1] ** 2).mean()):.3f} mm; worst {errors[..., 0].max():.4f} deg, "
          f"{errors[..., 1].max():.3f} mm")  # fmt: skip
    print(f"corners' sigma {np.mean(sigmas):.4f} px, reprojection RMS {np.mean(rms):.4f} px")
    print(f"true values within 3 sigma: {100 * np.mean(within):.2f} % of {np.size(within)}")
    print(f"ANEES {values.mean():.2f}, band {low:.2f} to {high:.2f} ({dof[0]:.0f} dof)")


def branches(frames: int) -> None:
    import rig_rooms

    from jaxnav.calibrate.rig.calibrate import calibrate_rig
    from jaxnav.calibrate.rig.views import (
        Ts_vehicle_camera,
        both_poses,
        inverted,
        rays_camera,
        turn_rad,
    )

    rig, path = rig_rooms.qcar(), rig_rooms.lemniscate(frames)
    true = Ts_vehicle_camera(rig)
    for noise_px in (0.3, 1.0, 2.0, 3.0):
        for seed in range(3):
            room = rig_rooms.room(seed=seed)
            views = rig_rooms.views_of(rig, room, path, noise_px, seed)
            both = both_poses(rays_camera(rig, views), views.size_m[views.marker])
            exact = inverted(true)[views.camera] @ inverted(path)[views.frame] @ room[views.marker]
            off = np.array(
                [[turn_rad(T, of) for T in pair] for pair, of in zip(both, exact, strict=True)]
            )
            found = calibrate_rig(views, rig_rooms.spoiled(rig, seed), {0: room[0]}, 0)
            placed = true[0] @ inverted(found.Ts_vehicle_camera[0]) @ found.Ts_vehicle_camera
            worst_deg = np.rad2deg(max(map(turn_rad, placed, true)))
            worst_mm = 1e3 * np.linalg.norm((placed - true)[:, :3, 3], axis=1).max()
            turned_deg = np.rad2deg(
                [
                    turn_rad(a, b)
                    for a, b in zip(
                        found.Ts_world_vehicle @ found.Ts_vehicle_camera[0],
                        path[np.unique(views.frame)] @ true[0],
                        strict=True,
                    )
                ]
            )
            print(f"{noise_px} px, room {seed}: the better fit is mirrored in "
                  f"{np.mean(off[:, 0] > off[:, 1]):.1%} of {len(views)} sightings; frames "
                  f"mirrored {np.sum(turned_deg > 20)} of {len(turned_deg)}; worst camera "
                  f"{worst_deg:.3f} deg, {worst_mm:.2f} mm")  # fmt: skip


def rendered(frames: int) -> None:
    import rig_rooms
    from scipy.interpolate import CubicSpline
    from tqdm import tqdm

    from jaxnav.calibrate.rig.calibrate import calibrate_rig
    from jaxnav.calibrate.rig.views import RigViews, Ts_vehicle_camera, turn_rad
    from jaxnav.commands.simulate.rendered_world import READOUT_S, SENSOR
    from jaxnav.detection import make_detector
    from jaxnav.files.poses import pose_from_matrix
    from jaxnav.sim.rendering import Renderer
    from jaxnav.sim.scene import Scene
    from jaxnav.sim.sensor import Shutter

    rig, room = rig_rooms.qcar(), rig_rooms.room()
    true = Ts_vehicle_camera(rig)
    scene = Scene.create(rig_rooms.as_map(room))
    detector, lenses = make_detector(), [rig.camera(c) for c in range(len(rig))]
    rows = max(height for _, height in rig.image_sizes_px)
    poses = np.stack([pose_from_matrix(T) for T in rig_rooms.lemniscate(frames)])
    poses[1:, :4] *= np.sign(np.sum(poses[1:, :4] * poses[:-1, :4], axis=1))[:, None].cumprod(
        axis=0
    )
    way_m = np.linalg.norm(np.diff(poses[:, 4:], axis=0), axis=1).sum()
    times_s = np.linspace(0, way_m / DRIVING_MPS, frames)
    spline = CubicSpline(times_s, poses)

    def pose_at(at_s: np.ndarray) -> np.ndarray:
        pose = spline(at_s)
        pose[:, :4] /= np.linalg.norm(pose[:, :4], axis=1, keepdims=True)
        return pose

    for name, shutter in (
        ("at rest", Shutter()),
        ("driving", Shutter(exposure_s=5e-3, row_time_s=READOUT_S / rows)),
    ):
        renderer = Renderer(scene, rig, shutter, SENSOR)
        rng = np.random.default_rng(0)
        seen: list[tuple[int, int, int]] = []
        corners: list[np.ndarray] = []
        for frame in tqdm(range(frames), unit="frame", desc=name):
            if name == "at rest":
                images = renderer.render_still(pose_at(times_s[frame : frame + 1])[0], rng)
            else:
                images = renderer.render(pose_at, times_s[frame], rng)
            for camera, image in enumerate(images):
                found = detector.detect(image, lenses[camera])
                seen += [(frame, camera, int(marker)) for marker in found.ids]
                corners += list(found.corners_px)
        table = np.array(seen)
        table, corners_px = (
            table[table[:, 2] < len(room)],
            np.stack(corners)[table[:, 2] < len(room)],
        )
        count = len(room)
        views = RigViews(
            table[:, 0], table[:, 1], table[:, 2], corners_px,
            np.full(count, rig_rooms.SIZE_M), tuple(range(count)), np.arange(frames),
        )  # fmt: skip
        found = calibrate_rig(views, rig_rooms.spoiled(rig, 0), {0: room[0]}, 0)
        T_now_true = true[0] @ np.linalg.inv(found.Ts_vehicle_camera[0])
        placed = T_now_true @ found.Ts_vehicle_camera
        errors = [
            (np.rad2deg(turn_rad(a, b)), 1e3 * np.linalg.norm((a - b)[:3, 3]))
            for a, b in zip(placed[1:], true[1:], strict=True)
        ]
        worst_deg, worst_mm = np.max(errors, axis=0)
        sigmas = found.sigmas()[1 : len(rig)]
        print(f"{name}: {frames} frames, {len(found.views)} sightings, corners to "
              f"{found.sigma_px:.4f} px, RMS {found.rms_px():.4f} px; worst camera "
              f"{worst_deg:.4f} deg, {worst_mm:.3f} mm (largest sigma "
              f"{np.rad2deg(sigmas[:, 3:].max()):.4f} deg, {1e3 * sigmas[:, :3].max():.3f} mm), "
              f"variances x {found.inflation:.1f}")  # fmt: skip


def tagslam() -> None:
    import jax.numpy as jnp
    import rig_rooms

    from jaxnav.calibrate.rig import bundle
    from jaxnav.calibrate.rig.calibrate import calibrate_rig
    from jaxnav.calibrate.rig.vehicle_frame import moved_to_places
    from jaxnav.calibrate.rig.views import RigViews, Ts_vehicle_camera, inverted, turn_rad, wxyz_xyz
    from jaxnav.recordings.other.recordings import read_recording

    data = Path(os.environ.get("JAXNAV_DATA", ROOT.parent / "shared" / "data")) / "tagslam"
    recording = read_recording(data / "test_5")
    frame, camera, marker = np.nonzero(recording.visible)
    ids = recording.markers.ids
    views = RigViews(
        frame, camera, marker, recording.corners_px[frame, camera, marker],
        np.asarray(recording.markers.size_m), ids, recording.stamps_ns,
    )  # fmt: skip
    Ts_world_marker = np.asarray(recording.markers.Ts_world_marker.as_matrix())
    true = Ts_vehicle_camera(recording.rig)
    one = ids.index(1)
    start = rig_rooms.spoiled(recording.rig, seed=0)
    begin = time.perf_counter()
    found = calibrate_rig(views, start, {one: Ts_world_marker[one]}, 0)
    seconds = time.perf_counter() - begin

    def off(T: np.ndarray, other: np.ndarray) -> str:
        apart_mm = 1e3 * np.linalg.norm((T - other)[:3, 3])
        return f"{np.rad2deg(turn_rad(T, other)):.3f} deg, {apart_mm:.1f} mm"

    print(f"{views.frames} frames, {len(found.views)} of {len(views)} sightings, {seconds:.0f} s")
    print("between camera 0 and the others, against TagSLAM (before; after):")
    for c in range(1, len(true)):
        before, after, reference = (
            inverted(Ts[0]) @ Ts[c]
            for Ts in (Ts_vehicle_camera(start), found.Ts_vehicle_camera, true)
        )
        print(f"  camera {c}: {off(before, reference)}; {off(after, reference)}")
    reference = recording.reference
    assert reference is not None
    kept = reference.valid[views.frame]
    same = views.only(kept)
    poses = bundle.RigUnknowns(
        jnp.asarray(reference.T_world_vehicle[np.unique(views.frame[kept])]),
        wxyz_xyz(true),
        wxyz_xyz(Ts_world_marker),
        bundle.lenses_of(recording.rig.cameras),
    )
    theirs = np.asarray(
        bundle.reprojection_residuals_px(poses, bundle.seen(recording.rig, same, 1.0))
    )
    stamps = found.views.stamps_ns[found.views.frame]
    ours = found.residuals_px[np.isin(stamps, same.stamps_ns)]
    assert len(ours) == len(theirs)
    print(f"reprojection RMS on the same {len(ours)} sightings, px a coordinate: "
          f"TagSLAM {np.sqrt(np.mean(theirs**2)):.3f}, ours {np.sqrt(np.mean(ours**2)):.3f}; "
          f"median of a sighting {np.median(np.sqrt((theirs**2).mean((1, 2)))):.3f}, "
          f"{np.median(np.sqrt((ours**2).mean((1, 2)))):.3f}")  # fmt: skip
    _localise(data, moved_to_places(found, true).Ts_vehicle_camera, true)


def _localise(data: Path, Ts_vehicle_camera: np.ndarray, theirs: np.ndarray) -> None:
    """test_7's markers and path with a rig that stays as it is: how well its corners fit."""
    import jax.numpy as jnp
    import jaxlie

    from jaxnav.calibrate.rig.views import inverted, wxyz_xyz
    from jaxnav.core.models.rig import CameraRig
    from jaxnav.files import save_rig
    from jaxnav.recordings.other.recordings import read_recording

    recording = read_recording(data / "test_7")
    for name, Ts in (("TagSLAM's", theirs), ("ours", Ts_vehicle_camera)):
        rig = CameraRig(
            recording.rig.cameras,
            jaxlie.SE3(wxyz_xyz(inverted(Ts))),
            recording.rig.names,
            recording.rig.image_sizes_px,
        )
        assert jnp.all(jnp.isfinite(rig.Ts_camera_vehicle.wxyz_xyz))
        file = ROOT / "out" / f"rig-{name.split(chr(39))[0]}.yaml"
        file.parent.mkdir(exist_ok=True)
        save_rig(file, rig)
        for alone in ((), ("--one-at-a-time",)):
            out = subprocess.run(
                [sys.executable, "-c", "from jaxnav.cli import main; main()", "replay",
                 str(data / "test_7"), "--rig", str(file),
                 *alone, "--out", str(file.with_suffix("")), "--headless"],
                capture_output=True, text=True, check=True,
                env=os.environ | {"PYTHONPATH": str(ROOT)},
            )  # fmt: skip
            print(f"test_7 with {name} extrinsics of test_5, {' '.join(alone) or 'all'}:")
            print("  " + "\n  ".join(out.stdout.strip().splitlines()))


def scale(frames: int) -> None:
    import rig_rooms

    from jaxnav.calibrate.rig.calibrate import calibrate_rig

    rig, markers = rig_rooms.qcar(), rig_rooms.room()
    views = rig_rooms.views_of(rig, markers, rig_rooms.lemniscate(frames), NOISE_PX, 0)
    begin = time.perf_counter()
    found = calibrate_rig(views, rig, {0: markers[0]}, 0)
    seconds = time.perf_counter() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{frames} frames, {len(found.views)} sightings by {len(rig)} cameras: {seconds:.0f} s, "
          f"{peak:.2f} GiB at most")  # fmt: skip


if __name__ == "__main__":
    main()
