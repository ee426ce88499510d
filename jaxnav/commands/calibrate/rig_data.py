"""What `jaxnav calibrate rig`, `markers` and `check` read and write: sightings and known markers;
files, numbers and advice."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.rig.calibrate import RigCalibration
from jaxnav.calibrate.rig.views import RigViews, Ts_vehicle_camera, inverted, turn_rad
from jaxnav.commands.calibrate.arguments import CalibrateCheck, CalibrateMarkers, CalibrateRig
from jaxnav.commands.reading import given_files
from jaxnav.commands.report import provenance
from jaxnav.core.models.camera import LENS_COEFFICIENTS
from jaxnav.core.models.markers import FAMILY_SIZES, MarkerMap
from jaxnav.core.models.origin import poses_in_world
from jaxnav.core.models.rig import CameraRig
from jaxnav.detection.observe import marker_keys
from jaxnav.errors import BadInput
from jaxnav.files import save_markers, save_rig, write_tum
from jaxnav.files.markers import MarkerSigma, marker_map
from jaxnav.files.poses import pose_from_matrix
from jaxnav.files.provenance import Calibrated
from jaxnav.files.rigs import CameraSigma
from jaxnav.recordings.other.recordings import RecordedSightings, read_sightings

_LEAST_SIGHTINGS = 3  # of a marker that is in no map
_APART_NS = 10**12  # between recordings
_MOST_LISTED = 12
# Good enough for driving: half a degree moves the car 3 cm sideways at 3 m from a marker.
_WELL_M, _WELL_DEG = 0.005, 0.2
_MANY_OUTLIERS = 0.2
_FEW_SIGHTINGS = 30
_CELLS = 8
_LITTLE_SEEN = 0.25  # of a camera's image

MarkerKey = tuple[str, int]  # family, id


@dataclass(frozen=True)
class RigData:
    """Sightings of several recordings, with their rig and the known markers.

    Attributes:
        markers: the map, given or recorded, with markers that no camera saw; None without one.
        keys: (M,) family and id of each marker, in the order of `views`.
        known: T_world_marker (4, 4) of the known markers, by their index.
        parts: the sightings of each recording.
        anchored: whether a file or a recording knew a marker; if none did, one is the world.
    """

    rig: CameraRig
    views: RigViews
    markers: MarkerMap | None
    keys: tuple[MarkerKey, ...]
    known: dict[int, Float[np.ndarray, "4 4"]]
    parts: tuple[RecordedSightings, ...]
    anchored: bool


def read_rig_data(
    args: CalibrateRig | CalibrateMarkers | CalibrateCheck,
    marker_size_m: float | None = None,
    only_known: bool = False,
) -> RigData:
    """Read all recordings and join their sightings, one recording after the other.

    Args:
        marker_size_m: side of the markers that are in no map.
        only_known: whether to leave these out.

    Raises:
        BadInput: names the file or the flag.
    """
    recordings, family = args.recordings, args.family
    if family is not None and family not in FAMILY_SIZES:
        raise BadInput("--family", f"unknown {family!r}: expected one of {', '.join(FAMILY_SIZES)}")
    given = given_files(args, ("rig", "markers"))
    markers = given.get("markers")
    parts = [read_sightings(path, given.get("rig")) for path in recordings]
    for part, path in zip(parts[1:], recordings[1:], strict=True):
        if part.rig.names != parts[0].rig.names:
            problem = f"its cameras are not those of {recordings[0]}: give one --rig for all"
            raise BadInput(path, problem)
    if markers is None:
        markers = next((part.markers for part in parts if part.markers is not None), None)
    if family is None:
        of_map = set() if markers is None else set(markers.families)
        family = of_map.pop() if len(of_map) == 1 else "tag36h11"
    seen_keys = [key for part in parts for key in _keys(part, family)]
    seen, mapped = Counter(seen_keys), () if markers is None else marker_keys(markers)
    # An id that is seen more rarely is another pattern, taken for a marker.
    often = {key for key, count in seen.items() if count >= _LEAST_SIGHTINGS and not only_known}
    keys = tuple(sorted(key for key in seen if key in mapped or key in often))
    if not keys:
        what = "a marker of the map" if only_known else "a marker often enough"
        raise BadInput(", ".join(map(str, recordings)), f"no camera saw {what}")
    index_of = {key: index for index, key in enumerate(keys)}
    known, sizes_m = _known(markers, keys, marker_size_m)
    anchored = bool(known)
    if not known:
        if markers is not None:
            ids = [marker_id for _, marker_id in keys]
            more = ", ..." if len(ids) > _MOST_LISTED else ""
            problem = (
                f"none of its markers ({', '.join(map(str, markers.ids))}) was seen; seen were "
                f"{', '.join(map(str, ids[:_MOST_LISTED]))}{more}"
            )
            raise BadInput(args.markers or "--markers", problem)
        known = {index_of[seen.most_common(1)[0][0]]: np.eye(4)}
    marker = np.array([index_of.get(key, -1) for key in seen_keys], int)
    used = marker >= 0
    firsts = np.cumsum([0, *(len(part.stamps_ns) for part in parts)])
    frame = np.concatenate([part.frame + n for part, n in zip(parts, firsts, strict=False)])
    views = RigViews(
        frame=frame[used],
        camera=np.concatenate([part.camera for part in parts])[used],
        marker=marker[used],
        corners_px=np.concatenate([part.corners_px for part in parts])[used],
        size_m=np.array(sizes_m),
        marker_ids=tuple(marker_id for _, marker_id in keys),
        stamps_ns=_one_after_the_other([part.stamps_ns for part in parts]),
    )
    return RigData(parts[0].rig, views, markers, keys, known, tuple(parts), anchored)


def _one_after_the_other(stamps_ns: Sequence[np.ndarray]) -> np.ndarray:
    """Stamps of all recordings, ns, increasing; those of the first recording do not change."""
    together = list(stamps_ns[:1])
    for stamps in stamps_ns[1:]:
        before = together[-1]
        together.append(stamps - stamps[:1] + before[-1:] + _APART_NS)
    return np.concatenate(together)


def _keys(part: RecordedSightings, family: str) -> list[MarkerKey]:
    families = part.families or (family,) * len(part.ids)
    return [(name, int(marker_id)) for name, marker_id in zip(families, part.ids, strict=True)]


def _known(
    markers: MarkerMap | None, keys: Sequence[MarkerKey], marker_size_m: float | None
) -> tuple[dict[int, np.ndarray], list[float]]:
    """T_world_marker (4, 4) of the known markers by index, and the sizes of all, m."""
    given, given_m, known, sizes_m = {}, list[float](), {}, []
    if markers is not None:
        Ts_world_marker = np.array(markers.Ts_world_marker.as_matrix(), float)
        Ts_world_marker[:, :3, 3] += markers.origin_m
        given_m = np.asarray(markers.size_m, float).tolist()
        placed = zip(Ts_world_marker, given_m, strict=True)
        given = dict(zip(marker_keys(markers), placed, strict=True))
    for index, (family, marker_id) in enumerate(keys):
        if (family, marker_id) in given:
            known[index], size_m = given[family, marker_id]
        elif marker_size_m is not None or len(set(given_m)) == 1:
            size_m = given_m[0] if marker_size_m is None else marker_size_m
        else:
            problem = f"missing: how large is marker {marker_id} ({family}), which is in no map?"
            raise BadInput("--marker-size-m", problem)
        sizes_m.append(size_m)
    return known, sizes_m


# --- results -------------------------------------------------------------------------------


@dataclass(frozen=True)
class RigResults:
    """A calibration of cameras and markers, and the data that it is of.

    Attributes:
        command: "rig", "markers" or "check".
    """

    command: str
    data: RigData
    calibration: RigCalibration

    @cached_property
    def calibrated(self) -> Calibrated:
        """What the files state of where they come from."""
        views = self.data.views
        arrays = [views.corners_px, views.frame, views.camera, views.marker, views.size_m]
        return provenance(self.command, arrays)

    @cached_property
    def sigmas(self) -> Float[np.ndarray, "C+M 6"]:
        """Of cameras and markers, m and deg, along and about the axes of the vehicle for cameras
        and of the world for markers."""
        of = self.calibration
        R = np.concatenate([of.Ts_vehicle_camera, of.Ts_world_marker])[:, :3, :3]
        body = np.arange(len(R))
        P = of.covariance[: 6 * len(R), : 6 * len(R)].reshape(len(R), 6, len(R), 6)[body, :, body]
        variances = [
            np.einsum("bij,bjk,bik->bi", R, P[:, part, part], R)
            for part in (slice(0, 3), slice(3, 6))
        ]
        return np.sqrt(np.maximum(np.concatenate(variances, axis=1), 0)) * np.repeat(
            [1, np.rad2deg(1)], 3
        )

    @cached_property
    def mapped(self) -> list[int]:
        """The markers that could be linked, by their place in `data.keys`."""
        return np.flatnonzero(self.calibration.mapped).tolist()

    @property
    def markers(self) -> MarkerMap:
        """The map of these."""
        T = self.calibration.Ts_world_marker
        return marker_map(
            np.stack([pose_from_matrix(T[index]) for index in self.mapped]),
            self.data.views.size_m[self.mapped].tolist(),
            [self.data.keys[index][1] for index in self.mapped],
            [self.data.keys[index][0] for index in self.mapped],
        )

    def save(self, out: Path) -> list[str]:
        """Write markers.yaml, trajectory.tum and, of `calibrate rig`, rig.yaml; their names.

        Raises:
            BadInput: a file can't be written.
        """
        data, calibration, C = self.data, self.calibration, len(self.data.rig)
        names = ["markers.yaml", "trajectory.tum"]
        if self.command == "rig":
            names.insert(0, "rig.yaml")
            poses = [pose_from_matrix(T) for T in inverted(calibration.Ts_vehicle_camera)]
            rig = replace(
                data.rig,
                cameras=calibration.cameras,
                Ts_camera_vehicle=jaxlie.SE3(jnp.asarray(np.stack(poses), float)),
            )
            cameras = [
                CameraSigma(**_placed_sigma(self.sigmas[c]), **self._lens_sigma(c))
                if calibration.calibrated[c]
                else CameraSigma()
                for c in range(C)
            ]
            save_rig(out / "rig.yaml", rig, self.calibrated, cameras)
        # The check takes no place as given.
        given = data.known if data.anchored and self.command != "check" else {}
        sigmas: list[MarkerSigma | None] = [
            None if index in given else MarkerSigma(**_placed_sigma(self.sigmas[C + index]))
            for index in self.mapped
        ]
        markers, unseen = self._with_unseen()
        save_markers(out / "markers.yaml", markers, self.calibrated, sigmas + [None] * unseen)
        poses = [pose_from_matrix(T) for T in calibration.Ts_world_vehicle]
        write_tum(out / "trajectory.tum", calibration.views.stamps_ns / 1e9, np.stack(poses))
        return names

    def _with_unseen(self) -> tuple[MarkerMap, int]:
        """The found map with the given map's unseen markers added where they are, and how many
        these are."""
        found, given = self.markers, self.data.markers
        if given is None:
            return found, 0
        keys = zip(given.families, given.ids, strict=True)
        unseen = [index for index, key in enumerate(keys) if key not in self.data.keys]
        poses, others = (
            np.asarray(poses_in_world(of.Ts_world_marker.wxyz_xyz, of.origin_m))
            for of in (found, given)
        )
        sizes_m = [np.asarray(found.size_m), np.asarray(given.size_m)[unseen]]
        return marker_map(
            np.concatenate([poses, others[unseen]]),
            np.concatenate(sizes_m).tolist(),
            [*found.ids, *(given.ids[index] for index in unseen)],
            [*found.families, *(given.families[index] for index in unseen)],
        ), len(unseen)

    def _lens_sigma(self, camera: int) -> dict[str, list[float]]:
        """Sigmas of a camera's lens by the fields of `CameraSigma`; empty if it was not refined."""
        sigma, cameras = self.calibration.lens_sigmas()[camera], self.data.rig.cameras
        if not sigma.any():
            return {}
        count = LENS_COEFFICIENTS[cameras.lenses[int(cameras.lens_index[camera])]]
        parts = {"focal_px": sigma[:2], "center_px": sigma[2:4], "distortion": sigma[4 : 4 + count]}
        return {name: part.tolist() for name, part in parts.items()}

    def report(self) -> dict[str, Any]:
        """The content of report.json."""
        data, calibration, C = self.data, self.calibration, len(self.data.rig)
        views, given = calibration.views, Ts_vehicle_camera(data.rig)

        def seen(rows: np.ndarray) -> dict[str, Any]:
            residuals = calibration.residuals_px[rows]
            return {
                "sightings": int(rows.sum()),
                "outliers": int(np.sum(calibration.weight[rows] < 1)),
                "reprojection_rms_px": float(np.sqrt(np.mean(residuals**2)))
                if rows.any()
                else None,
            }

        def placed(T: np.ndarray, sigma: np.ndarray) -> dict[str, Any]:
            turn = Rotation.from_matrix(T[:3, :3]).as_rotvec(degrees=True)
            return {
                "position_m": {"value": T[:3, 3], "sigma": sigma[:3]},
                "rotation_vector_deg": {"value": turn, "sigma": sigma[3:]},
            }

        def lens(camera: int) -> dict[str, Any]:
            def of(cameras: Any, name: str, sigma: list[float]) -> np.ndarray:
                return np.asarray(getattr(cameras, name))[camera][: len(sigma)]

            return {
                name: {
                    "value": of(calibration.cameras, name, sigma),
                    "sigma": sigma,
                    "given": of(data.rig.cameras, name, sigma),
                }
                for name, sigma in self._lens_sigma(camera).items()
            }

        cameras = {
            name: {
                "calibrated": bool(calibration.calibrated[c]),
                **seen(views.camera == c),
                "coverage": self._coverage(c),
                **placed(T, self.sigmas[c]),
                **lens(c),
                "from_given": {
                    "position_m": float(np.linalg.norm((T - given[c])[:3, 3])),
                    "rotation_deg": float(np.rad2deg(turn_rad(T, given[c]))),
                },
            }
            for c, (name, T) in enumerate(
                zip(data.rig.names, calibration.Ts_vehicle_camera, strict=True)
            )
        }
        markers = {
            f"{family} {marker_id}": {
                "mapped": bool(calibration.mapped[m]),
                "given": data.anchored and m in data.known,
                "size_m": float(views.size_m[m]),
                **seen(views.marker == m),
            }
            | (
                placed(calibration.Ts_world_marker[m], self.sigmas[C + m])
                if calibration.mapped[m]
                else {}
            )
            for m, (family, marker_id) in enumerate(data.keys)
        }
        return self.calibrated.model_dump() | {
            "frames": views.frames,
            "sightings": len(views),
            "outliers": int(np.sum(calibration.weight < 1)),
            "reprojection_rms_px": calibration.rms_px(),
            "corner_sigma_px": calibration.sigma_px,
            "variance_inflation": calibration.inflation,
            "branches_changed": calibration.turned,
            "cameras": cameras,
            "markers": markers,
            "advice": list(self._advice()),
        }

    def _coverage(self, camera: int) -> float:
        views = self.calibration.views
        seen = views.corners_px[views.camera == camera]
        return coverage(seen, self.data.rig.image_sizes_px[camera])

    def _advice(self) -> Iterator[str]:
        """What to record next, and what to check."""
        data, calibration = self.data, self.calibration
        for c, name in enumerate(data.rig.names):
            sigma_m, sigma_deg = self.sigmas[c, :3].max(), self.sigmas[c, 3:].max()
            if not calibration.calibrated[c]:
                count = int(np.sum(data.views.camera == c))
                yield f"{name}: place as given, no link in {count} sightings: turn on the spot"
                continue
            if sigma_m > _WELL_M or sigma_deg > _WELL_DEG:
                yield f"{name}: {1e3 * sigma_m:.0f} mm, {sigma_deg:.2f} deg: show it nearer markers"
            if (part := self._coverage(c)) < _LITTLE_SEEN:
                yield f"{name}: markers in {part:.0%} of its image: move them through all of it"
        for m, (_, marker_id) in enumerate(data.keys):
            count = int(np.sum(data.views.marker == m))
            if not calibration.mapped[m]:
                yield (
                    f"marker {marker_id}: in no file, no link in {count} sightings: pass it with "
                    "another marker in view"
                )
            elif count < _FEW_SIGHTINGS:
                yield f"marker {marker_id}: {count} sightings: pass it once more"
        share = float(np.mean(calibration.weight < 1))
        if share > _MANY_OUTLIERS:
            yield f"{share:.0%} outliers: a marker that moved, lenses, cameras out of step?"
        if calibration.inflation > 1:
            yield (
                f"parts disagree {np.sqrt(calibration.inflation):.1f} times beyond noise, sigmas "
                "are that much larger: calibrate the lenses, or --refine-lenses"
            )


def _placed_sigma(sigma: np.ndarray) -> dict[str, list[float]]:
    return {"position_m": sigma[:3].tolist(), "rotation_deg": sigma[3:].tolist()}


def coverage(corners_px: Float[np.ndarray, "N 4 2"], image_size_px: tuple[int, int]) -> float:
    """The share of an image's cells, 8 of them across, in which corners were seen."""
    width, height = image_size_px
    across, down = _CELLS, max(1, round(_CELLS * height / width))
    cell = (corners_px.reshape(-1, 2) + 0.5) / [width, height] * [across, down]
    inside = np.clip(cell.astype(int), 0, [across - 1, down - 1])
    return len(np.unique(inside, axis=0)) / (across * down)


def lines(report: dict[str, Any]) -> Iterator[str]:
    """The report in a few lines: counts, errors, places of cameras, and advice."""
    yield (
        f"{report['frames']} frames, {report['sightings']} sightings "
        f"({report['outliers']} outliers), reprojection RMS "
        f"{report['reprojection_rms_px']:.3f} px, corners to {report['corner_sigma_px']:.3f} px"
    )
    for name, of in report["cameras"].items():
        position, sigma_deg = of["position_m"], max(of["rotation_vector_deg"]["sigma"])
        if not of["calibrated"] or not max(position["sigma"]):
            yield f"  {name}: {'as given' if of['calibrated'] else 'not calibrated'}"
            continue
        where = " ".join(f"{round(value, 4) + 0.0:.4f}" for value in position["value"])
        off = of["from_given"]
        yield (
            f"  {name}: {where} m to {1e3 * max(position['sigma']):.2f} mm, {sigma_deg:.3f} deg; "
            f"{1e3 * off['position_m']:.1f} mm and {off['rotation_deg']:.2f} deg from the given "
            "place"
        )
    mapped = sum(of["mapped"] for of in report["markers"].values())
    yield f"  {mapped} of {len(report['markers'])} markers mapped"
    yield from (f"note: {sentence}" for sentence in report["advice"])
