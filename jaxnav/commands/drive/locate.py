"""`jaxnav locate`: find the markers in a photograph, with both poses of each."""

import contextlib
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.commands.drive.arguments import Locate
from jaxnav.commands.process import configure_jax
from jaxnav.commands.report import normals_px, save_figure
from jaxnav.core.filter.choose import LowestReprojection
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.candidates import find_candidates
from jaxnav.core.pose.observation import Observation, Snapshot
from jaxnav.core.pose.refine import Candidates
from jaxnav.detection import ArucoDetector, Detections, Detector, make_detector
from jaxnav.detection.acquire import acquire_in_photograph
from jaxnav.detection.families import LARGEST_FAMILIES
from jaxnav.errors import BadInput
from jaxnav.files import poses
from jaxnav.files.cameras import load_camera_entry
from jaxnav.files.executables import kept
from jaxnav.files.images import MIRRORED, read_photograph

_FREEDOM = 2  # of a marker's eight numbers: a pose has six
_CLOSER_LOOKS = 400
_EXCESS = 4.0  # mean square of residuals, in sigmas, beyond chance: one marker in 55 of white noise
_LARGE_M, _SMALL_M = 1.5, 0.003  # sides that markers rarely have, and other units often make
# What is noted of a marker beyond a limit.
_DOUBTS = (
    (
        "misfit_sigmas",
        5.0,
        "corners are {poses[0][reprojection_error_px]:.2g} px off the pose, {misfit_sigmas:.0f} of "
        "their sigmas, and count as {sigma_factor:.2g} times as unsure: is --camera that of this "
        "photograph, with its zoom and focus, and is the marker flat?",
    ),
    (
        "flip_probability",
        0.3,
        "both poses are possible (P(flip) {flip_probability:.2f}): take it from nearer, or more "
        "from the side",
    ),
)
_TURNED_DEG = {3: 180, 4: 180, 5: 90, 6: 90, 7: 270, 8: 270}  # clockwise, by EXIF's number


def run(args: Locate) -> int:
    """Detect markers, solve for their poses, print them and, with --out, draw them."""
    if args.out is not None and args.out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise BadInput("--out", f"must end in .png or .jpg, got {args.out}")
    configure_jax(float64=True)
    detectors = detectors_for(args.corner_backend, args.family)
    entry = load_camera_entry(args.camera, args.camera_name)
    camera, size_px = entry.camera(), entry.size_px
    lens_sigma_px = entry.sigma.lens_px() if entry.sigma else None
    image, orientation = read_photograph(args.image)
    height, width = image.shape[:2]
    if (width, height) != size_px:
        raise BadInput(
            args.image,
            f"is {width} x {height} pixels, but --camera {args.camera} was calibrated at "
            f"{size_px[0]} x {size_px[1]}",
        )
    detections = detect(detectors, image, camera)
    blurred = not len(detections)
    if blurred:
        detections = acquire_in_photograph(image, camera, args.family)
    rigs = [
        CameraRig.create([one], [jaxlie.SE3.identity()], ["camera"], [size_px])
        for one in _cameras(camera, lens_sigma_px)
    ]
    detections = detections.only(np.argsort(detections.ids, kind="stable"))
    markers = [
        _locate(rigs, args.marker_size_m, detections, index) for index in range(len(detections))
    ]
    report = {
        "image": str(args.image),
        "camera": str(args.camera),
        "family": args.family,
        "marker_size_m": args.marker_size_m,
        "markers": markers,
        "notes": list(notes(args, markers, image, orientation, lens_sigma_px is not None, blurred)),
    }
    if args.out is not None:
        _draw(args.out, image, camera, args.marker_size_m, markers)
    print(json.dumps(report, indent=2) if args.as_json else table(report))
    return 0


def detect(
    detectors: Sequence[Detector], image: np.ndarray, camera: Camera | None = None
) -> Detections:
    """The markers that any of the detectors finds, each once."""
    first, *more = (detector.detect(image, camera) for detector in detectors)
    # What the pattern does not fit is a ghost, or was found better by the first.
    more = [found.only(found.refined) for found in more]
    return Detections.concatenate([first, *more]).once_each()


def detectors_for(backend: str, family: str) -> list[Detector]:
    """The detector that is asked for; AprilTag's beside OpenCV's where it is there.

    A photograph has the time for a closer look at every quadrilateral.
    """
    if backend != "aruco":
        return [make_detector(backend, family)]
    detectors: list[Detector] = [ArucoDetector(family, closer_looks=_CLOSER_LOOKS)]
    with contextlib.suppress(BadInput):
        detectors.append(make_detector("apriltag", family))
    return detectors


def _cameras(camera: Camera, lens_sigma_px: np.ndarray | None) -> list[Camera]:
    """The camera, and three that are off by one sigma: in both focal lengths, which what leaves one
    unsure does to the other, and in x and y of the centre."""
    if lens_sigma_px is None:
        return [camera]
    focal, centre = jnp.asarray(lens_sigma_px[:2]), jnp.asarray(lens_sigma_px[2:])
    return [
        camera,
        replace(camera, focal_px=camera.focal_px + focal),
        *(replace(camera, center_px=camera.center_px + centre * axis) for axis in jnp.eye(2)),
    ]


@kept
def _solve(rig: CameraRig, markers: MarkerMap, obs: Observation) -> tuple[Candidates, jax.Array]:
    """Both poses of one marker, and the probability that the better one is the mirror image."""
    snapshot = Snapshot.create(rig, markers, obs)
    candidates = find_candidates(snapshot, max_steps=32)
    prior = ConstantVelocity().poses(ConstantVelocity().init())
    selection = LowestReprojection()(prior, candidates, snapshot)
    return candidates, selection.flip_probability


def _locate(
    rigs: list[CameraRig], size_m: float, detections: Detections, index: int
) -> dict[str, Any]:
    """What is reported of a marker."""
    # The marker is the world and the camera the vehicle: T_vehicle_world is T_camera_marker.
    world = jaxlie.SE3(jaxlie.SE3.identity().wxyz_xyz[None])
    markers = MarkerMap(world, jnp.asarray([size_m]), (0,), (detections.families[index],))

    def solve(rig: CameraRig, factor: float = 1.0) -> tuple[Candidates, jax.Array]:
        obs = Observation(
            corners_px=jnp.asarray(detections.corners_px[index])[None, None],
            visible=jnp.ones((1, 1), bool),
            corner_sigma_px=jnp.asarray(factor * detections.sigma_px[index])[None, None],
        )
        solved: tuple[Candidates, jax.Array] = jax.device_get(_solve(rig, markers, obs))
        return solved

    candidates, flip_probability = solve(rigs[0])
    # Corners that no pose explains are worse than their sigmas say, and the flip as unsure.
    misfit = float(candidates.cost[0]) / _FREEDOM if candidates.valid[0] else 0.0
    factor = np.sqrt(misfit / _EXCESS) if misfit > _EXCESS else 1.0
    if factor > 1:
        candidates, flip_probability = solve(rigs[0], factor)
    kept = np.flatnonzero(candidates.valid)
    errors_px = np.sqrt(candidates.e1_px2[kept] / 4)
    others = [solve(rig, factor)[0] for rig in rigs[1:]]
    return {
        "id": int(detections.ids[index]),
        "corners_px": detections.corners_px[index].tolist(),
        "corner_sigma_px": (factor * detections.sigma_px[index]).tolist(),
        "sigma_factor": float(factor),
        "misfit_sigmas": float(np.sqrt(misfit)),
        "flip_probability": float(flip_probability),
        "error_ratio": float(errors_px[0] / errors_px[1]) if len(kept) > 1 else None,
        "poses": [
            _pose(candidates, int(n), error, others)
            for n, error in zip(kept, errors_px, strict=True)
        ],
    }


def _lens_sigma_m(candidates: Candidates, n: int, others: list[Candidates]) -> np.ndarray:
    """How far one sigma of the lens moves the position of a pose, (3,)."""
    pose, moved_m = candidates.T_vehicle_world.wxyz_xyz[n], []
    for other in others:
        # The pose that is nearest to it in angle: their order may have changed.
        turns = np.abs(other.T_vehicle_world.wxyz_xyz[:, :4] @ pose[:4])
        same = int(np.argmax(np.where(other.valid, turns, -1)))
        moved_m.append((other.T_vehicle_world.wxyz_xyz[same] - pose)[4:])
    return np.linalg.norm(np.reshape(moved_m, (-1, 3)), axis=0)


def _pose(
    candidates: Candidates, n: int, error_px: float, others: list[Candidates]
) -> dict[str, Any]:
    T_camera_marker = poses.matrix(np.asarray(candidates.T_vehicle_world.wxyz_xyz[n]))
    position_m = T_camera_marker[:3, 3]
    distance_m = np.linalg.norm(position_m)
    cosine = -T_camera_marker[:3, 2] @ position_m / max(distance_m, 1e-12)
    # The covariance is of xi in T_marker_camera * exp(xi); the marker moves by -v + position x w.
    x, y, z = position_m
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    to_position = np.hstack([-np.eye(3), cross])
    covariance = np.asarray(candidates.covariance[n])
    corners_sigma_m = np.sqrt(np.diag(to_position @ covariance @ to_position.T))
    lens_sigma_m = _lens_sigma_m(candidates, n, others)
    rotation_sigma_deg = np.rad2deg(np.sqrt(np.diag(covariance)[3:]))
    return {
        "T_camera_marker": T_camera_marker.tolist(),
        "distance_m": float(distance_m),
        "view_angle_deg": float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))),
        "reprojection_error_px": float(error_px),
        "converged": bool(candidates.converged[n]),
        "position_sigma_m": np.hypot(corners_sigma_m, lens_sigma_m).tolist(),
        "lens_sigma_m": lens_sigma_m.tolist() if others else None,
        "rotation_sigma_deg": rotation_sigma_deg.tolist(),
    }


def notes(
    args: Locate,
    markers: Sequence[dict[str, Any]],
    image: np.ndarray,
    orientation: int,
    knows_lens: bool,
    blurred: bool,
) -> Iterator[str]:
    """What a person should know of a photograph before trusting its poses.

    Args:
        markers: as in the report.
        orientation: of the photograph, 1 to 8, as EXIF counts.
        blurred: whether no marker could be read without restoring the photograph.
    """
    size_m = args.marker_size_m
    if not _SMALL_M <= size_m <= _LARGE_M:
        other = f"{1000 * size_m:g} if it was divided by 1000 twice"
        if size_m > _LARGE_M:
            other = f"{size_m / 1000:g} if {size_m:g} are mm, {size_m / 100:g} if they are cm"
        yield f"--marker-size-m {size_m:g} is {size_m:g} m: {other}"
    if orientation != 1:
        turned = f"turned by {_TURNED_DEG[orientation]} deg" if orientation in _TURNED_DEG else ""
        mirrored = "mirrored" if orientation in MIRRORED else ""
        shown = " and ".join(filter(None, (mirrored, turned)))
        yield (
            f"viewers show this photograph {shown} (EXIF); x (right) and y (down) are those of the "
            "pixels as the camera stored them"
        )
    if not markers:
        yield from _other_family(args, image)
    elif blurred:
        yield (
            "the photograph is blurred by a motion: ids were read in a restored one, and corners "
            "fitted to the photograph as it is"
        )
    for marker in markers:
        if not marker["poses"]:
            yield f"marker {marker['id']}: no pose explains its corners"
    for key, limit, text in _DOUBTS:
        if beyond := [marker for marker in markers if marker[key] > limit]:
            worst = max(beyond, key=lambda marker: marker[key])
            many = len(beyond) > 1
            name = f"{len(beyond)} markers, {worst['id']} most of all" if many else "marker {id}"
            yield f"{name}: {text}".format(**worst)
    for number, count in sorted(Counter(marker["id"] for marker in markers).items()):
        if count > 1:
            one = "at most one of them is the one that you mean"
            yield f"marker {number} is seen {count} times: {one}"
    if markers and not knows_lens:
        yield (
            f"--camera {args.camera.name} has no sigmas of its lens, so sigma (m) leaves out what "
            "its focal length and centre are wrong: `jaxnav calibrate intrinsics` writes them"
        )


def _other_family(args: Locate, image: np.ndarray) -> Iterator[str]:
    """The family of which the photograph shows most markers instead."""
    seen = {}
    for family in LARGEST_FAMILIES:
        if family != args.family:
            found = make_detector("aruco", family).detect(image)
            seen[family] = found.ids[found.refined]
    family = max(seen, key=lambda one: len(seen[one]))
    if len(seen[family]):
        ids = ", ".join(map(str, sorted(set(seen[family].tolist()))[:6]))
        yield f"{len(seen[family])} of {family} in view (id {ids}): --family {family}"


def table(report: dict[str, Any]) -> str:
    """The report as text, a line for each pose."""
    said = [f"note: {sentence}" for sentence in report["notes"]]
    lines = [
        f"{'id':>5} {'pose':>4} {'x (m)':>8} {'y (m)':>8} {'z (m)':>8} {'view (deg)':>10} "
        f"{'error (px)':>10} {'ratio':>6} {'P(flip)':>8} {'sigma (m)':>9} {'sigma (deg)':>11}"
    ]
    for marker in report["markers"]:
        number, doubt, error_ratio = marker["id"], marker["flip_probability"], marker["error_ratio"]
        ratio = "" if error_ratio is None else f"{error_ratio:.2f}"
        of_marker = f"{number:>5}", f"{ratio:>6} {doubt:>8.3f}"  # in the line of its first pose
        for rank, pose in enumerate(marker["poses"], 1):
            id_text, doubt_text = of_marker if rank == 1 else (" " * 5, " " * 15)
            x, y, z = (row[3] for row in pose["T_camera_marker"][:3])
            lines.append(
                f"{id_text} {rank:>4} {x:>8.3f} {y:>8.3f} {z:>8.3f} "
                f"{pose['view_angle_deg']:>10.1f} {pose['reprojection_error_px']:>10.3f} "
                f"{doubt_text} {np.linalg.norm(pose['position_sigma_m']):>9.4f} "
                f"{np.linalg.norm(pose['rotation_sigma_deg']):>11.2f}"
            )
    if not report["markers"]:
        lines = [f"{report['image']}: no marker of {report['family']} in view"]
    return "\n".join([*lines, *said])


def _draw(
    path: Path, image: np.ndarray, camera: Camera, size_m: float, markers: list[dict[str, Any]]
) -> None:
    """Draw the markers and both poses of each into the photograph."""
    from jaxnav.pictures.localisation import PHOTO_DPI, AnnotatedFrame, photo_with_poses

    sticks: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for marker in markers:
        for rank, pose in enumerate(marker["poses"][:2]):
            Ts_camera_marker = jaxlie.SE3.from_matrix(jnp.asarray([pose["T_camera_marker"]]))
            sticks[rank].append(normals_px(camera, Ts_camera_marker, np.array([size_m]))[0])
    view = AnnotatedFrame(
        title="",
        image=image[:, :, ::-1],
        detected_px=np.reshape([marker["corners_px"] for marker in markers], (-1, 4, 2)),
        selected_px=np.reshape(sticks[0], (-1, 2, 2)),
        other_px=np.reshape(sticks[1], (-1, 2, 2)),
        names=tuple(
            f"{marker['id']}: {marker['poses'][0]['distance_m']:.2f} m" if marker["poses"] else ""
            for marker in markers
        ),
    )
    save_figure(photo_with_poses(view), path, PHOTO_DPI)
