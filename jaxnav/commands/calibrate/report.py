"""Reports of `jaxnav calibrate rig`, `markers` and `check`: numbers, files, advice."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

import jaxnav
from jaxnav.calibrate.rig.calibrate import RigCalibration
from jaxnav.calibrate.rig.views import inverted, turn_rad
from jaxnav.commands.calibrate.data import RigData
from jaxnav.core.models.camera import LENS_COEFFICIENTS
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import poses_in_world
from jaxnav.core.models.rig import CameraRig
from jaxnav.files import save_markers, save_rig, write_tum
from jaxnav.files.markers import MarkerSigma, marker_map
from jaxnav.files.poses import pose_from_matrix
from jaxnav.files.provenance import Calibrated, calibrated_now
from jaxnav.files.rigs import CameraSigma

# Good enough for driving: half a degree moves the car 3 cm sideways at 3 m from a marker.
_WELL_M, _WELL_DEG = 0.005, 0.2
_MANY_OUTLIERS = 0.2
_FEW_SIGHTINGS = 30
_CELLS = 8
_LITTLE_SEEN = 0.25  # of a camera's image


def provenance(data: RigData, command: str) -> Calibrated:
    """The provenance that the written files state: date, tool, digest of the sightings."""
    views = data.views
    arrays = [views.corners_px, views.frame, views.camera, views.marker, views.size_m]
    return calibrated_now(f"jaxnav {jaxnav.__version__} calibrate {command}", arrays)


def calibrated_rig(data: RigData, calibration: RigCalibration) -> CameraRig:
    """The rig with the calibrated places and lenses of its cameras."""
    poses = [pose_from_matrix(T) for T in inverted(calibration.Ts_vehicle_camera)]
    return CameraRig(
        calibration.cameras,
        jaxlie.SE3(jnp.asarray(np.stack(poses), float)),
        data.rig.names,
        data.rig.image_sizes_px,
        data.rig.extrinsics_sigma,
        data.rig.timings,
    )


def found_markers(data: RigData, calibration: RigCalibration) -> tuple[MarkerMap, list[int]]:
    """The map of all markers that could be linked, and their indices in `data.keys`."""
    mapped = [int(index) for index in np.flatnonzero(calibration.mapped)]
    return marker_map(
        np.stack([pose_from_matrix(calibration.Ts_world_marker[index]) for index in mapped]),
        [float(data.views.size_m[index]) for index in mapped],
        [data.keys[index][1] for index in mapped],
        [data.keys[index][0] for index in mapped],
    ), mapped


def with_unseen(data: RigData, markers: MarkerMap) -> tuple[MarkerMap, int]:
    """The found map with the given map's unseen markers added where they are, and how many these
    are."""
    if data.markers is None:
        return markers, 0
    given = data.markers
    keys = zip(given.families, given.ids, strict=True)
    unseen = [index for index, key in enumerate(keys) if key not in data.keys]
    poses = [
        np.asarray(poses_in_world(of.Ts_world_marker.wxyz_xyz, of.origin_m))
        for of in (markers, given)
    ]
    sizes_m = [np.asarray(of.size_m) for of in (markers, given)]
    return marker_map(
        np.concatenate([poses[0], poses[1][unseen]]),
        np.concatenate([sizes_m[0], sizes_m[1][unseen]]).tolist(),
        [*markers.ids, *(given.ids[index] for index in unseen)],
        [*markers.families, *(given.families[index] for index in unseen)],
    ), len(unseen)


def axes_sigmas(calibration: RigCalibration) -> Float[np.ndarray, "bodies 6"]:
    """Sigmas (C + M, 6) of cameras and markers, m and deg, along and about the axes of the vehicle
    for cameras and of the world for markers."""
    Ts = np.concatenate([calibration.Ts_vehicle_camera, calibration.Ts_world_marker])
    sigmas = np.zeros((len(Ts), 6))
    for index, T in enumerate(Ts):
        P = calibration.covariance[6 * index : 6 * index + 6, 6 * index : 6 * index + 6]
        for part in (slice(0, 3), slice(3, 6)):
            turned = T[:3, :3] @ P[part, part] @ T[:3, :3].T
            sigmas[index, part] = np.sqrt(np.maximum(np.diag(turned), 0))
    sigmas[:, 3:] = np.rad2deg(sigmas[:, 3:])
    return sigmas


def write_files(
    out: Path,
    data: RigData,
    calibration: RigCalibration,
    calibrated: Calibrated,
    with_rig: bool,
    all_found: bool = False,
) -> None:
    """Write markers.yaml, trajectory.tum and, `with_rig`, rig.yaml.

    Args:
        all_found: whether all markers' places were found, none of them taken as given.

    Raises:
        BadInput: a file can't be written.
    """
    sigmas, C = axes_sigmas(calibration), len(data.rig)
    if with_rig:
        cameras = [
            CameraSigma(
                position_m=sigmas[c, :3].tolist(),
                rotation_deg=sigmas[c, 3:].tolist(),
                **_lens_sigma(data, calibration, c),
            )
            if calibration.calibrated[c]
            else CameraSigma()
            for c in range(C)
        ]
        save_rig(out / "rig.yaml", calibrated_rig(data, calibration), calibrated, cameras)
    mapped = np.flatnonzero(calibration.mapped)
    given = data.known if data.anchored and not all_found else {}
    of_markers: list[MarkerSigma | None] = [
        None
        if index in given
        else MarkerSigma(
            position_m=sigmas[C + index, :3].tolist(), rotation_deg=sigmas[C + index, 3:].tolist()
        )
        for index in mapped
    ]
    markers, unseen = with_unseen(data, found_markers(data, calibration)[0])
    of_markers += [None] * unseen
    save_markers(out / "markers.yaml", markers, calibrated, of_markers)
    poses = np.stack([pose_from_matrix(T) for T in calibration.Ts_world_vehicle])
    write_tum(out / "trajectory.tum", calibration.views.stamps_ns / 1e9, poses)


def _lens_sigma(data: RigData, calibration: RigCalibration, camera: int) -> dict[str, list[float]]:
    """Sigmas of a camera's lens by the fields of `CameraSigma`; empty if it was not refined."""
    sigma = calibration.lens_sigmas()[camera]
    if not sigma.any():
        return {}
    lens = data.rig.cameras.lenses[int(data.rig.cameras.lens_index[camera])]
    return {
        "focal_px": sigma[:2].tolist(),
        "center_px": sigma[2:4].tolist(),
        "distortion": sigma[4 : 4 + LENS_COEFFICIENTS[lens]].tolist(),
    }


def _lens(data: RigData, calibration: RigCalibration, camera: int) -> dict[str, Any]:
    """The report's lens figures, with sigma and given value each; empty if it was not refined."""
    sigma = _lens_sigma(data, calibration, camera)
    return {
        name: {
            "value": np.asarray(getattr(calibration.cameras, name))[camera][: len(of)],
            "sigma": of,
            "given": np.asarray(getattr(data.rig.cameras, name))[camera][: len(of)],
        }
        for name, of in sigma.items()
    }


def summary(
    data: RigData,
    calibration: RigCalibration,
    given: Float[np.ndarray, "C 4 4"],
    calibrated: Calibrated,
) -> dict[str, Any]:
    """The content of report.json.

    Args:
        given: (C, 4, 4) T_vehicle_camera before calibration.
    """
    sigmas, C = axes_sigmas(calibration), len(data.rig)
    views = calibration.views

    def seen(rows: np.ndarray) -> dict[str, Any]:
        residuals = calibration.residuals_px[rows]
        return {
            "sightings": int(rows.sum()),
            "outliers": int(np.sum(calibration.weight[rows] < 1)),
            "reprojection_rms_px": float(np.sqrt(np.mean(residuals**2))) if rows.any() else None,
        }

    def placed(T: np.ndarray, sigma: np.ndarray) -> dict[str, Any]:
        turn = Rotation.from_matrix(T[:3, :3]).as_rotvec(degrees=True)
        return {
            "position_m": {"value": T[:3, 3], "sigma": sigma[:3]},
            "rotation_vector_deg": {"value": turn, "sigma": sigma[3:]},
        }

    cameras = {
        name: {
            "calibrated": bool(calibration.calibrated[c]),
            **seen(views.camera == c),
            "coverage": coverage(views.corners_px[views.camera == c], data.rig.image_sizes_px[c]),
            **placed(calibration.Ts_vehicle_camera[c], sigmas[c]),
            **_lens(data, calibration, c),
            "from_given": {
                "position_m": float(
                    np.linalg.norm((calibration.Ts_vehicle_camera[c] - given[c])[:3, 3])
                ),
                "rotation_deg": float(
                    np.rad2deg(turn_rad(calibration.Ts_vehicle_camera[c], given[c]))
                ),
            },
        }
        for c, name in enumerate(data.rig.names)
    }
    markers = {
        f"{family} {marker_id}": {
            "mapped": bool(calibration.mapped[m]),
            "given": data.anchored and m in data.known,
            "size_m": float(views.size_m[m]),
            **seen(views.marker == m),
            **(
                placed(calibration.Ts_world_marker[m], sigmas[C + m])
                if calibration.mapped[m]
                else {}
            ),
        }
        for m, (family, marker_id) in enumerate(data.keys)
    }
    return {
        **calibrated.model_dump(),
        "frames": views.frames,
        "sightings": len(views),
        "outliers": int(np.sum(calibration.weight < 1)),
        "reprojection_rms_px": calibration.rms_px(),
        "corner_sigma_px": calibration.sigma_px,
        "variance_inflation": calibration.inflation,
        "branches_changed": calibration.turned,
        "cameras": cameras,
        "markers": markers,
        "advice": advice(data, calibration, sigmas),
    }


def coverage(corners_px: Float[np.ndarray, "N 4 2"], image_size_px: tuple[int, int]) -> float:
    """The share of an image's cells, 8 of them across, in which corners were seen."""
    width, height = image_size_px
    across, down = _CELLS, max(1, round(_CELLS * height / width))
    cell = (corners_px.reshape(-1, 2) + 0.5) / [width, height] * [across, down]
    inside = np.clip(cell.astype(int), 0, [across - 1, down - 1])
    return len(np.unique(inside, axis=0)) / (across * down)


def advice(
    data: RigData, calibration: RigCalibration, sigmas: Float[np.ndarray, "bodies 6"]
) -> list[str]:
    """Advice in sentences: what to record next, and what to check."""
    findings = []
    rows = data.views
    for c, name in enumerate(data.rig.names):
        count = int(np.sum(rows.camera == c))
        if not calibration.calibrated[c]:
            findings.append(
                f"{name} saw {count} markers and nothing links it to the others: its place is as "
                "given; turn on the spot between markers, so that it sees what others see"
            )
        elif sigmas[c, :3].max() > _WELL_M or sigmas[c, 3:].max() > _WELL_DEG:
            findings.append(
                f"{name} is known to {1e3 * sigmas[c, :3].max():.0f} mm and "
                f"{sigmas[c, 3:].max():.2f} deg: let it see markers from nearer, while others do"
            )
        seen = calibration.views.corners_px[calibration.views.camera == c]
        part = coverage(seen, data.rig.image_sizes_px[c])
        if calibration.calibrated[c] and part < _LITTLE_SEEN:
            findings.append(
                f"{name} saw markers in {part:.0%} of its image: move them through all of it, for "
                "a lens that is off shows elsewhere"
            )
    for m, (_, marker_id) in enumerate(data.keys):
        count = int(np.sum(rows.marker == m))
        if not calibration.mapped[m]:
            findings.append(
                f"marker {marker_id} was seen {count} times and nothing links it to the known "
                "ones: it is in no file; pass it with another marker in view of any camera"
            )
        elif count < _FEW_SIGHTINGS:
            findings.append(f"marker {marker_id} was seen {count} times only: pass it once more")
    share = float(np.mean(calibration.weight < 1))
    if share > _MANY_OUTLIERS:
        findings.append(
            f"{share:.0%} of the sightings are outliers: did a marker move, are the lenses "
            "calibrated, are the cameras triggered together?"
        )
    if calibration.inflation > 1:
        findings.append(
            f"parts of the recording disagree {np.sqrt(calibration.inflation):.1f} times as far as "
            "their noise explains, and the sigmas are that much larger: the lenses, or markers "
            "that are not flat, are the likely cause: calibrate the lenses, or let them move with "
            "--refine-lenses"
        )
    return findings


def text(report: dict[str, Any]) -> str:
    """The report in a few lines: counts, errors, places of cameras, and advice."""
    lines = [
        f"{report['frames']} frames, {report['sightings']} sightings "
        f"({report['outliers']} outliers), reprojection RMS "
        f"{report['reprojection_rms_px']:.3f} px, corners to {report['corner_sigma_px']:.3f} px"
    ]
    for name, of in report["cameras"].items():
        if not of["calibrated"]:
            lines.append(f"  {name}: not calibrated")
            continue
        position, turn = of["position_m"], of["rotation_vector_deg"]
        if not max(position["sigma"]):
            lines.append(f"  {name}: as given")
            continue
        where = " ".join(f"{round(value, 4) + 0.0:.4f}" for value in position["value"])
        lines.append(
            f"  {name}: {where} m to {1e3 * max(position['sigma']):.2f} mm, "
            f"{max(turn['sigma']):.3f} deg; {1e3 * of['from_given']['position_m']:.1f} mm and "
            f"{of['from_given']['rotation_deg']:.2f} deg from the given place"
        )
    mapped = sum(of["mapped"] for of in report["markers"].values())
    lines.append(f"  {mapped} of {len(report['markers'])} markers mapped")
    lines += [f"note: {sentence}" for sentence in report["advice"]]
    return "\n".join(lines)
