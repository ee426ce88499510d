"""`jaxnav locate`: find the markers in a photograph, with both poses of each."""

import json
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.belief.ambiguity import LowestReprojection
from jaxnav.belief.constant_velocity import ConstantVelocity
from jaxnav.commands.drive.arguments import Locate
from jaxnav.commands.pictures import normals_px, save_figure
from jaxnav.commands.process import configure_jax
from jaxnav.detection import Detections, make_detector
from jaxnav.errors import BadInput
from jaxnav.files import load_camera
from jaxnav.files.images import read_image
from jaxnav.models.camera import Camera
from jaxnav.models.markers import MarkerMap
from jaxnav.models.rig import CameraRig
from jaxnav.plots.localisation import AnnotatedFrame, photo_with_poses
from jaxnav.pose.candidates import Candidates, find_candidates
from jaxnav.pose.observation import Observation, Snapshot


def run(args: Locate) -> int:
    """Detect markers, solve for their poses, print them and, with --out, draw them."""
    configure_jax(float64=True)
    detector = make_detector(args.corner_backend, args.family)
    camera, image_size_px = load_camera(args.camera, args.camera_name)
    image = read_image(args.image)
    height, width = image.shape[:2]
    if (width, height) != tuple(image_size_px):
        raise BadInput(
            args.image,
            f"is {width} x {height} pixels, but --camera {args.camera} was calibrated at "
            f"{image_size_px[0]} x {image_size_px[1]}",
        )
    detections = detector.detect(image, camera)
    rig = CameraRig.create([camera], [jaxlie.SE3.identity()], ["camera"], [image_size_px])
    located = [
        _locate(rig, args.marker_size_m, detections, index)
        for index in np.argsort(detections.ids, kind="stable")
    ]
    report = {
        "image": str(args.image),
        "camera": str(args.camera),
        "family": args.family,
        "marker_size_m": args.marker_size_m,
        "markers": [marker for marker, _ in located],
    }
    if args.out is not None:
        view = _view(args.image.name, image, camera, args.marker_size_m, detections, located)
        save_figure(photo_with_poses(view), args.out)
    print(json.dumps(report, indent=2) if args.json else table(report))
    return 0


@jax.jit
def _solve(rig: CameraRig, markers: MarkerMap, obs: Observation) -> tuple[Candidates, jax.Array]:
    """Both poses of one marker, and the probability that the better one is the mirror image."""
    snapshot = Snapshot.create(rig, markers, obs)
    candidates = find_candidates(snapshot, max_steps=32)
    prior = ConstantVelocity().poses(ConstantVelocity().init())
    selection = LowestReprojection()(prior, candidates, snapshot)
    return candidates, selection.flip_probability


def _locate(
    rig: CameraRig, size_m: float, detections: Detections, index: int
) -> tuple[dict[str, Any], Candidates]:
    # The marker is the world and the camera the vehicle: T_vehicle_world is T_camera_marker.
    world = jaxlie.SE3(jaxlie.SE3.identity().wxyz_xyz[None])
    markers = MarkerMap(world, jnp.asarray([size_m]), (0,), (detections.families[index],))
    obs = Observation(
        corners_px=jnp.asarray(detections.corners_px[index])[None, None],
        visible=jnp.ones((1, 1), bool),
        corner_sigma_px=jnp.asarray(detections.sigma_px[index])[None, None],
    )
    candidates, flip_probability = jax.device_get(_solve(rig, markers, obs))
    kept = np.flatnonzero(candidates.valid)
    errors_px = np.sqrt(candidates.e1_px2[kept] / 4)
    marker = {
        "id": int(detections.ids[index]),
        "corners_px": detections.corners_px[index].tolist(),
        "corner_sigma_px": detections.sigma_px[index].tolist(),
        "flip_probability": float(flip_probability),
        "error_ratio": float(errors_px[0] / errors_px[1]) if len(kept) > 1 else None,
        "poses": [
            _pose(candidates, int(n), error) for n, error in zip(kept, errors_px, strict=True)
        ],
    }
    return marker, candidates


def _pose(candidates: Candidates, n: int, error_px: float) -> dict[str, Any]:
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
    position_sigma_m = np.sqrt(np.diag(to_position @ covariance @ to_position.T))
    rotation_sigma_deg = np.rad2deg(np.sqrt(np.diag(covariance)[3:]))
    return {
        "T_camera_marker": np.asarray(T_camera_marker.as_matrix()).tolist(),
        "distance_m": float(distance_m),
        "view_angle_deg": float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))),
        "reprojection_error_px": float(error_px),
        "converged": bool(candidates.converged[n]),
        "position_sigma_m": position_sigma_m.tolist(),
        "rotation_sigma_deg": rotation_sigma_deg.tolist(),
    }


def table(report: dict[str, Any]) -> str:
    """The report as text, a line for each pose."""
    if not report["markers"]:
        return f"{report['image']}: no marker of {report['family']} in view"
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
    return "\n".join(lines)


def _view(
    title: str,
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
    return AnnotatedFrame(
        title=f"{title}: detected marker green, normal of the better pose blue, other pose orange",
        image=image[:, :, ::-1],
        detected_px=detections.corners_px,
        selected_px=np.asarray(sticks[0]).reshape(-1, 2, 2),
        other_px=np.asarray(sticks[1]).reshape(-1, 2, 2),
    )
