"""Log a drive to Rerun: the static scene, outcomes of the pilot, camera frames.

    world                     markers, waypoints, track, ellipse, hypotheses, candidates
    world/vehicle             moves; below it its cameras with their images and detections
    plots/...                 numbers over time; the cameras' errors in units of their prior's sigma
    health                    a line where health, faults or rejects change

Rerun stores positions in float32, so they count from the origin of the map; `health` names the
origin if it is not the world's zero.

Images of a wide lens are shown as a pinhole's: they are curved where Rerun draws straight lines.
"""

import math
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import ZERO, inverses_in_world, opposite, planar_in_world
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import SENSOR_ERRORS, TWIST_ERRORS
from jaxnav.drive.flags import Fault, Health, Reject, names
from jaxnav.files import poses
from jaxnav.pictures.localisation import BLUE, GREEN, ORANGE, SKY, VERMILION
from jaxnav.recordings.learnt import as_filed
from jaxnav.recordings.records import Outcomes

# A JPEG, or grey or BGR pixels.
Picture = bytes | UInt8[np.ndarray, "rows columns"] | UInt8[np.ndarray, "rows columns 3"]

TIMELINE = "drive"  # seconds since the first event
_CHI2_2DOF_95 = 5.991
_ARROW_M = 0.15
_IMAGE_PLANE_M = 0.12  # distance of a drawn image from its camera
_CAR_COMMAND = ("throttle", "steering_rad")
_BASE_COMMAND = ("forward_mps", "left_mps", "turn_radps")
_SINGLE_PLOTS = ("flip_probability", "hypotheses", "nis", "position_sigma_m", "repeated_share")


class RerunScene:
    """A stream of Rerun and the last values sent to it. For one thread."""

    def __init__(
        self,
        rerun: ModuleType,
        stream: Any,
        rig: CameraRig | None,
        markers: MarkerMap | None,
        waypoints_m: Float[np.ndarray, "W 2"],
    ):
        """Args:
        rerun: the module.
        stream: its `RecordingStream`.
        """
        self._rerun, self._stream, self._rig = rerun, stream, rig
        self._from_world = opposite(ZERO if markers is None else markers.origin_m)
        self._begin_ns: int | None = None
        self._is_base = False  # until an outcome commands a twist
        self._shown_flags = ""
        self._last_m: np.ndarray | None = None
        self._log_still("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._log_still("plots/sensor_errors", rerun.SeriesLines(names=list(SENSOR_ERRORS)))
        if rig is not None:
            self._lay_out_cameras(rig)
        if markers is not None:
            strips = _closed(np.asarray(markers.corners_world_m, float))
            labels = [str(marker_id) for marker_id in markers.ids]
            drawn = rerun.LineStrips3D(strips, colors=_rgb(VERMILION), labels=labels)
            self._log_still("world/markers", drawn)
            if markers.origin_m != ZERO:
                from_m = ", ".join(f"{value:.0f}" for value in markers.origin_m)
                self._log_still("health", rerun.TextLog(f"places are relative to ({from_m}) m"))
        if len(waypoints_m):
            labels = [f"waypoint {number}" for number in range(1, len(waypoints_m) + 1)]
            points = rerun.Points3D(
                _on_floor(waypoints_m), colors=_rgb(GREEN), labels=labels, radii=0.03
            )
            self._log_still("world/waypoints", points)
        stream.send_blueprint(_blueprint(rerun.blueprint, () if rig is None else rig.names))

    def show(self, outcomes: Outcomes, index: int = 0) -> None:
        """Log one of the pilot's outcomes."""
        self._set_time(int(outcomes.now_ns[index]))
        pose = planar_in_world(outcomes.pose[index], self._from_world)
        if outcomes.located[index] and np.isfinite(pose).all():
            self._show_vehicle(pose, outcomes.covariance[index])
        hypotheses = planar_in_world(outcomes.hypotheses[index], self._from_world)
        self._show_hypotheses(hypotheses, outcomes.log_weight[index])
        if len(Ts_vehicle_world := outcomes.Ts_vehicle_world[index]):
            Ts_vehicle_map = inverses_in_world(Ts_vehicle_world, self._from_world)
            self._show_candidates(Ts_vehicle_map, int(outcomes.selected[index]))
        self._show_numbers(outcomes, index)
        health = Health(outcomes.health[index])
        faults, rejects = Fault(int(outcomes.faults[index])), Reject(int(outcomes.rejects[index]))
        if (text := " ".join([health.name, *names(faults), *names(rejects)])) != self._shown_flags:
            self._shown_flags = text
            level = "INFO" if health <= Health.OK else "WARN"
            self._stream.log("health", self._rerun.TextLog(text, level=level))

    def image(
        self,
        camera: str,
        stamp_ns: int,
        image: Picture | None,
        corners_px: Float[np.ndarray, "N 4 2"] | None,
    ) -> None:
        """Log a camera's frame: JPEG or BGR or grey pixels, and detected corners (N, 4, 2). None
        leaves either unchanged."""
        rerun, entity = self._rerun, f"world/vehicle/{camera}"
        self._set_time(stamp_ns)
        if isinstance(image, bytes):
            encoded = rerun.EncodedImage(contents=image, media_type="image/jpeg")
            self._stream.log(f"{entity}/image", encoded)
        elif image is not None:
            model = "L" if image.ndim == 2 else "BGR"
            self._stream.log(f"{entity}/image", rerun.Image(image, model).compress())
        if corners_px is not None:
            strips = _closed(corners_px[np.isfinite(corners_px).all(axis=(1, 2))])
            drawn = rerun.LineStrips2D(strips, colors=_rgb(GREEN), radii=1)
            self._stream.log(f"{entity}/markers", drawn)

    def _lay_out_cameras(self, rig: CameraRig) -> None:
        rerun = self._rerun
        axes = rerun.Arrows3D(
            vectors=0.5 * _ARROW_M * np.eye(3), colors=[_rgb(c) for c in (VERMILION, GREEN, BLUE)]
        )
        self._log_still("world/vehicle/axes", axes)
        for index, name in enumerate(rig.names):
            T_camera_vehicle = np.asarray(rig.Ts_camera_vehicle.wxyz_xyz[index], float)
            camera, entity = rig.camera(index), f"world/vehicle/{name}"
            self._log_still(entity, self._transform(poses.inverse(T_camera_vehicle)))
            pinhole = rerun.Pinhole(
                focal_length=np.asarray(camera.axis_px),
                principal_point=np.asarray(camera.center_px),
                resolution=rig.image_sizes_px[index],
                camera_xyz=rerun.ViewCoordinates.RDF,
                image_plane_distance=_IMAGE_PLANE_M,
            )
            self._log_still(entity, pinhole)
        turns = [f"{name} about {axis}" for name in rig.names for axis in "xyz"]
        self._log_still("plots/camera_errors", rerun.SeriesLines(names=turns))

    def _show_vehicle(self, pose: np.ndarray, covariance: np.ndarray) -> None:
        rerun = self._rerun
        place_m, half_rad = np.array([pose[0], pose[1], 0.0]), pose[2] / 2
        T_world_vehicle = np.array([math.cos(half_rad), 0, 0, math.sin(half_rad), *place_m])
        self._stream.log("world/vehicle", self._transform(T_world_vehicle))
        if self._last_m is not None:
            piece = rerun.LineStrips3D([[self._last_m, place_m]], colors=_rgb(BLUE))
            self._stream.log("world/track", piece)
        self._last_m = place_m
        if np.isfinite(covariance[:2, :2]).all() and covariance.shape[0] >= 2:
            values, vectors = np.linalg.eigh(covariance[:2, :2])
            scales_m = np.sqrt(_CHI2_2DOF_95 * np.maximum(values, 0))
            angles_rad = np.linspace(0, 2 * np.pi, 49)
            circle = np.stack([np.cos(angles_rad), np.sin(angles_rad)])
            strip = _on_floor(place_m[:2] + (vectors @ (scales_m[:, None] * circle)).T)
            self._stream.log("world/ellipse", rerun.LineStrips3D([strip], colors=_rgb(SKY)))

    def _show_hypotheses(self, rows: np.ndarray, log_weight: np.ndarray) -> None:
        usable = np.isfinite(rows).all(axis=1) & np.isfinite(log_weight)
        rows, log_weight = rows[usable], log_weight[usable]
        shares = np.maximum(np.exp(log_weight - np.max(log_weight, initial=-np.inf)), 0.1)
        ahead = np.column_stack([np.cos(rows[:, 2]), np.sin(rows[:, 2])])
        arrows = self._rerun.Arrows3D(
            origins=_on_floor(rows[:, :2]),
            vectors=_ARROW_M * _on_floor(ahead),
            colors=[(*_rgb(SKY), alpha) for alpha in np.round(255 * shares).astype(int)],
            radii=0.012 * np.sqrt(shares),
        )
        self._stream.log("world/hypotheses", arrows)

    def _show_candidates(self, Ts_vehicle_map: np.ndarray, selected: int) -> None:
        Ts = [poses.inverse(T) for T in Ts_vehicle_map if np.isfinite(T).all()]
        arrows = self._rerun.Arrows3D(
            origins=[T[4:] for T in Ts],
            vectors=[poses.rotated(T[:4].tolist(), [_ARROW_M, 0.0, 0.0]) for T in Ts],
            colors=[_rgb(BLUE if index == selected else ORANGE) for index in range(len(Ts))],
            radii=0.006,
        )
        self._stream.log("world/candidates", arrows)

    def _show_numbers(self, outcomes: Outcomes, index: int) -> None:
        rerun, located, twist = self._rerun, outcomes.located[index], outcomes.twist[index]
        sigma_m = math.sqrt(max(float(np.trace(outcomes.covariance[index][:2, :2])), 0.0))
        nis = outcomes.nis[index]
        if turns_by_twist := not np.isnan(twist).all():
            command = dict(zip(_BASE_COMMAND, twist, strict=True))
        else:
            command = {name: getattr(outcomes, name)[index] for name in _CAR_COMMAND}
        numbers = {
            "flip_probability": outcomes.flip_probability[index],
            "hypotheses": len(outcomes.hypotheses[index]),
            "nis": nis if nis > 0 else math.nan,
            **command,
            "position_sigma_m": sigma_m if located else math.nan,
            "repeated_share": outcomes.repeated_share[index],
        }
        for name, value in numbers.items():
            if math.isfinite(value):
                self._stream.log(f"plots/{name}", rerun.Scalars(float(value)))
        if turns_by_twist and not self._is_base:
            self._is_base = True
            self._log_still("plots/sensor_errors", rerun.SeriesLines(names=list(TWIST_ERRORS)))
        errors = as_filed(outcomes.errors[index], self._rig)
        for name, values in zip(("sensor_errors", "camera_errors"), errors, strict=True):
            if values.size and np.isfinite(values).all():
                self._stream.log(f"plots/{name}", rerun.Scalars(values))

    def _transform(self, wxyz_xyz: np.ndarray) -> Any:
        w, x, y, z, *place_m = wxyz_xyz.tolist()
        rotation = self._rerun.Quaternion(xyzw=[x, y, z, w])
        return self._rerun.Transform3D(translation=place_m, quaternion=rotation)

    def _set_time(self, stamp_ns: int) -> None:
        self._begin_ns = stamp_ns if self._begin_ns is None else self._begin_ns
        self._stream.set_time(TIMELINE, duration=(stamp_ns - self._begin_ns) / 1e9)

    def _log_still(self, entity: str, what: Any) -> None:
        self._stream.log(entity, what, static=True)


def _blueprint(blueprint: Any, cameras: tuple[str, ...]) -> Any:
    """Map and cameras on the left; health and plots on the right."""
    whole_past = blueprint.VisibleTimeRanges(
        timeline=TIMELINE,
        start=blueprint.TimeRangeBoundary.infinite(),
        end=blueprint.TimeRangeBoundary.cursor_relative(),
    )
    space = blueprint.Spatial3DView(
        origin="world", name="map", overrides={"world/track": whole_past}
    )
    images = [
        blueprint.Spatial2DView(origin=f"world/vehicle/{name}", name=name) for name in cameras
    ]
    no_legend = {"plot_legend": blueprint.PlotLegend(visible=False)}
    plots = [
        blueprint.TimeSeriesView(origin=f"plots/{name}", name=name, **options)
        for names, options in ((_SINGLE_PLOTS, no_legend), (("sensor_errors", "camera_errors"), {}))
        for name in names
    ]
    commands = [f"plots/{name}" for name in (*_CAR_COMMAND, *_BASE_COMMAND)]
    return blueprint.Blueprint(
        blueprint.Horizontal(
            blueprint.Vertical(space, *([blueprint.Grid(*images)] if images else [])),
            blueprint.Vertical(
                blueprint.TextLogView(origin="health", name="health"),
                *plots,
                blueprint.TimeSeriesView(origin="plots", contents=commands, name="commands"),
                row_shares=[2, *(1 for _ in plots), 1],
            ),
            column_shares=[3, 2],
        ),
        collapse_panels=True,
    )


def _rgb(color: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(color[1:]))


def _closed(corners: np.ndarray) -> list[np.ndarray]:
    """Quads (N, 4, d) as closed strips (5, d)."""
    return list(np.concatenate([corners, corners[:, :1]], axis=1))


def _on_floor(places: np.ndarray) -> np.ndarray:
    """Points (N, 2) with a third coordinate of 0."""
    return np.column_stack([places, np.zeros(len(places))])
