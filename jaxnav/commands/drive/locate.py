"""`jaxnav locate`: find the markers in a photograph, with both poses of each."""

import contextlib
import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.commands.drive.arguments import Locate
from jaxnav.commands.drive.locate_notes import notes
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
from jaxnav.errors import BadInput
from jaxnav.files.cameras import load_camera_entry
from jaxnav.files.images import read_photograph
from jaxnav.pictures.localisation import PHOTO_DPI, AnnotatedFrame, photo_with_poses

_FREEDOM = 2  # of a marker's eight numbers: a pose has six
_CLOSER_LOOKS = 400
_EXCESS = 4.0  # mean square of residuals, in sigmas, beyond chance: one marker in 55 of white noise


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
    located = [
        _locate(rigs, args.marker_size_m, detections, index)
        for index in np.argsort(detections.ids, kind="stable")
    ]
    markers = [marker for marker, _ in located]
    report = {
        "image": str(args.image),
        "camera": str(args.camera),
        "family": args.family,
        "marker_size_m": args.marker_size_m,
        "markers": markers,
        "notes": notes(args, markers, image, orientation, lens_sigma_px is not None, blurred),
    }
    if args.out is not None:
        view = _view(image, camera, args.marker_size_m, detections, located)
        save_figure(photo_with_poses(view), args.out, PHOTO_DPI)
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
    """The camera, and three that are off by one sigma: in focal length, in x and y of the centre.

    Both focal lengths are off together: what leaves one unsure does so to the other.
    """
    if lens_sigma_px is None:
        return [camera]
    focal, centre = jnp.asarray(lens_sigma_px[:2]), jnp.asarray(lens_sigma_px[2:])
    return [
        camera,
        replace(camera, focal_px=camera.focal_px + focal),
        *(replace(camera, center_px=camera.center_px + centre * axis) for axis in jnp.eye(2)),
    ]


@jax.jit
def _solve(rig: CameraRig, markers: MarkerMap, obs: Observation) -> tuple[Candidates, jax.Array]:
    """Both poses of one marker, and the probability that the better one is the mirror image."""
    snapshot = Snapshot.create(rig, markers, obs)
    candidates = find_candidates(snapshot, max_steps=32)
    prior = ConstantVelocity().poses(ConstantVelocity().init())
    selection = LowestReprojection()(prior, candidates, snapshot)
    return candidates, selection.flip_probability


def _locate(
    rigs: list[CameraRig], size_m: float, detections: Detections, index: int
) -> tuple[dict[str, Any], Candidates]:
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
    marker = {
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
    return marker, candidates


def _lens_sigma_m(candidates: Candidates, n: int, others: list[Candidates]) -> np.ndarray:
    """How far one sigma of the lens moves the position of a pose, (3,)."""
    moved_m = []
    for other in others:
        # The pose that is nearest to it in angle: their order may have changed.
        turns = np.abs(
            other.T_vehicle_world.wxyz_xyz[:, :4] @ candidates.T_vehicle_world.wxyz_xyz[n, :4]
        )
        same = int(np.argmax(np.where(other.valid, turns, -1)))
        moved_m.append(
            (other.T_vehicle_world.wxyz_xyz[same] - candidates.T_vehicle_world.wxyz_xyz[n])[4:]
        )
    return np.linalg.norm(np.reshape(moved_m, (-1, 3)), axis=0)


def _pose(
    candidates: Candidates, n: int, error_px: float, others: list[Candidates]
) -> dict[str, Any]:
    wxyz_xyz = candidates.T_vehicle_world.wxyz_xyz[n]
    T_camera_marker = jaxlie.SE3(jnp.asarray(wxyz_xyz))
    position_m = np.asarray(T_camera_marker.translation())
    R_camera_marker = np.asarray(T_camera_marker.rotation().as_matrix())
    distance_m = np.linalg.norm(position_m)
    cosine = -R_camera_marker[:, 2] @ position_m / max(distance_m, 1e-12)
    # The covariance is of xi in T_marker_camera * exp(xi); the marker moves by -v + position x w.
    x, y, z = position_m
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    to_position = np.hstack([-np.eye(3), cross])
    covariance = np.asarray(candidates.covariance[n])
    corners_sigma_m = np.sqrt(np.diag(to_position @ covariance @ to_position.T))
    lens_sigma_m = _lens_sigma_m(candidates, n, others)
    rotation_sigma_deg = np.rad2deg(np.sqrt(np.diag(covariance)[3:]))
    return {
        "T_camera_marker": np.asarray(T_camera_marker.as_matrix()).tolist(),
        "distance_m": float(distance_m),
        "view_angle_deg": float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))),
        "reprojection_error_px": float(error_px),
        "converged": bool(candidates.converged[n]),
        "position_sigma_m": np.hypot(corners_sigma_m, lens_sigma_m).tolist(),
        "lens_sigma_m": lens_sigma_m.tolist() if others else None,
        "rotation_sigma_deg": rotation_sigma_deg.tolist(),
    }


def table(report: dict[str, Any]) -> str:
    """The report as text, a line for each pose."""
    said = [f"note: {sentence}" for sentence in report["notes"]]
    if not report["markers"]:
        none = f"{report['image']}: no marker of {report['family']} in view"
        return "\n".join([none, *said])
    head = (
        f"{'id':>5} {'pose':>4} {'x (m)':>8} {'y (m)':>8} {'z (m)':>8} {'view (deg)':>10} "
        f"{'error (px)':>10} {'ratio':>6} {'P(flip)':>8} {'sigma (m)':>9} {'sigma (deg)':>11}"
    )
    lines = [head]
    for marker in report["markers"]:
        for number, pose in enumerate(marker["poses"], 1):
            x, y, z = (row[3] for row in pose["T_camera_marker"][:3])
            ratio = (
                ""
                if number > 1 or marker["error_ratio"] is None
                else (f"{marker['error_ratio']:.2f}")
            )
            doubt = f"{marker['flip_probability']:.3f}" if number == 1 else ""
            lines.append(
                f"{marker['id'] if number == 1 else '':>5} {number:>4} {x:>8.3f} {y:>8.3f} "
                f"{z:>8.3f} {pose['view_angle_deg']:>10.1f} "
                f"{pose['reprojection_error_px']:>10.3f} {ratio:>6} {doubt:>8} "
                f"{np.linalg.norm(pose['position_sigma_m']):>9.4f} "
                f"{np.linalg.norm(pose['rotation_sigma_deg']):>11.2f}"
            )
    return "\n".join([*lines, *said])


def _view(
    image: np.ndarray,
    camera: Camera,
    size_m: float,
    detections: Detections,
    located: list[tuple[dict[str, Any], Candidates]],
) -> AnnotatedFrame:
    sticks: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for _, candidates in located:
        for rank, n in enumerate(np.flatnonzero(candidates.valid)[:2]):
            wxyz_xyz = candidates.T_vehicle_world.wxyz_xyz[n]
            Ts_camera_marker = jaxlie.SE3(jnp.asarray(wxyz_xyz)[None])
            sticks[rank].append(normals_px(camera, Ts_camera_marker, np.array([size_m]))[0])
    names = tuple(
        f"{marker['id']}: {marker['poses'][0]['distance_m']:.2f} m" if marker["poses"] else ""
        for marker, _ in located
    )
    order = np.argsort(detections.ids, kind="stable")
    return AnnotatedFrame(
        title="",
        image=image[:, :, ::-1],
        detected_px=detections.corners_px[order],
        selected_px=np.asarray(sticks[0]).reshape(-1, 2, 2),
        other_px=np.asarray(sticks[1]).reshape(-1, 2, 2),
        names=names,
    )
