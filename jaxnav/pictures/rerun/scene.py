"""Log a drive to Rerun: the static scene, outcomes of the pilot, camera frames.

    world                     markers, waypoints, track, ellipse, hypotheses, candidates
    world/vehicle             moves; below it its cameras with their images and detections
    plots/...                 numbers over time; the cameras' errors in units of their prior's sigma
    health                    a line where health, faults or rejects change

Rerun stores positions in float32, so they count from the origin of the map; `health` tells the
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
_OF_CAR = ("throttle", "steering_rad")
_OF_BASE = ("forward_mps", "left_mps", "turn_radps")


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
        self._rerun, self._stream = rerun, stream
        self._rig, self._names = rig, () if rig is None else rig.names
        self._from_world = opposite(ZERO if markers is None else markers.origin_m)
        self._begin_ns: int | None = None
        self._is_base = False  # until an outcome commands a twist
        self._shown_flags = ""
        self._last_m: np.ndarray | None = None
        self._still("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._still("plots/sensor_errors", rerun.SeriesLines(names=list(SENSOR_ERRORS)))
        if rig is not None:
            self._lay_out_cameras(rig)
            turns = [f"{name} about {axis}" for name in rig.names for axis in "xyz"]
            self._still("plots/camera_errors", rerun.SeriesLines(names=turns))
        if markers is not None:
            corners_m = np.asarray(markers.corners_world_m, float)
            strips = [np.vstack([corners, corners[:1]]) for corners in corners_m]
            labels = [str(marker_id) for marker_id in markers.ids]
            self._still(
                "world/markers", rerun.LineStrips3D(strips, colors=_rgb(VERMILION), labels=labels)
            )
        if len(waypoints_m):
            places_m = np.column_stack([waypoints_m, np.zeros(len(waypoints_m))])
            labels = [f"waypoint {number}" for number in range(1, len(places_m) + 1)]
            self._still(
                "world/waypoints",
                rerun.Points3D(places_m, colors=_rgb(GREEN), labels=labels, radii=0.03),
            )
        if markers is not None and markers.origin_m != ZERO:
            from_m = ", ".join(f"{value:.0f}" for value in markers.origin_m)
            self._still("health", rerun.TextLog(f"places are relative to ({from_m}) m"))
        stream.send_blueprint(self._blueprint())

    def show(self, outcomes: Outcomes, index: int = 0) -> None:
        """Log one of the pilot's outcomes."""
        self._at(int(outcomes.now_ns[index]))
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
            self._say("health", self._rerun.TextLog(text, level=level))

    def image(
        self,
        camera: str,
        stamp_ns: int,
        image: Picture | None,
        corners_px: Float[np.ndarray, "N 4 2"] | None,
    ) -> None:
        """Log a camera's frame: JPEG or BGR or grey pixels, and detected corners (N, 4, 2). None
        leaves either unchanged."""
        rerun = self._rerun
        self._at(stamp_ns)
        entity = f"world/vehicle/{camera}"
        if isinstance(image, bytes):
            self._say(
                f"{entity}/image", rerun.EncodedImage(contents=image, media_type="image/jpeg")
            )
        elif image is not None:
            model = "L" if image.ndim == 2 else "BGR"
            self._say(f"{entity}/image", rerun.Image(image, model).compress())
        if corners_px is not None:
            strips = [np.vstack([corners, corners[:1]]) for corners in corners_px]
            finite = [strip for strip in strips if np.isfinite(strip).all()]
            self._say(f"{entity}/markers", rerun.LineStrips2D(finite, colors=_rgb(GREEN), radii=1))

    def _lay_out_cameras(self, rig: CameraRig) -> None:
        rerun = self._rerun
        axes_m = 0.5 * _ARROW_M * np.eye(3)
        self._still(
            "world/vehicle/axes",
            rerun.Arrows3D(vectors=axes_m, colors=[_rgb(c) for c in (VERMILION, GREEN, BLUE)]),
        )
        for index, name in enumerate(rig.names):
            T_vehicle_camera = poses.inverse(
                np.asarray(rig.Ts_camera_vehicle.wxyz_xyz[index], float)
            )
            camera, entity = rig.camera(index), f"world/vehicle/{name}"
            self._still(entity, self._transform(T_vehicle_camera))
            self._still(
                entity,
                rerun.Pinhole(
                    focal_length=np.asarray(camera.axis_px),
                    principal_point=np.asarray(camera.center_px),
                    resolution=rig.image_sizes_px[index],
                    camera_xyz=rerun.ViewCoordinates.RDF,
                    image_plane_distance=_IMAGE_PLANE_M,
                ),
            )

    def _show_vehicle(self, pose: np.ndarray, covariance: np.ndarray) -> None:
        rerun = self._rerun
        place_m = np.array([pose[0], pose[1], 0.0])
        half_rad = pose[2] / 2
        self._say(
            "world/vehicle",
            self._transform(np.array([math.cos(half_rad), 0, 0, math.sin(half_rad), *place_m])),
        )
        if self._last_m is not None:
            piece = rerun.LineStrips3D([[self._last_m, place_m]], colors=_rgb(BLUE))
            self._say("world/track", piece)
        self._last_m = place_m
        if np.isfinite(covariance[:2, :2]).all() and covariance.shape[0] >= 2:
            values, vectors = np.linalg.eigh(covariance[:2, :2])
            scales_m = np.sqrt(_CHI2_2DOF_95 * np.maximum(values, 0))
            angles_rad = np.linspace(0, 2 * np.pi, 49)
            circle = np.stack([np.cos(angles_rad), np.sin(angles_rad)])
            ellipse_m = place_m[:2] + (vectors @ (scales_m[:, None] * circle)).T
            strip = np.column_stack([ellipse_m, np.zeros(len(ellipse_m))])
            self._say("world/ellipse", rerun.LineStrips3D([strip], colors=_rgb(SKY)))

    def _show_hypotheses(self, rows: np.ndarray, log_weight: np.ndarray) -> None:
        usable = np.isfinite(rows).all(axis=1) & np.isfinite(log_weight)
        rows, log_weight = rows[usable], log_weight[usable]
        shares = np.exp(log_weight - np.max(log_weight, initial=-np.inf))
        alphas = np.round(255 * np.maximum(shares, 0.1)).astype(int)
        self._say(
            "world/hypotheses",
            self._rerun.Arrows3D(
                origins=np.column_stack([rows[:, :2], np.zeros(len(rows))]),
                vectors=_ahead(rows[:, 2]),
                colors=[(*_rgb(SKY), alpha) for alpha in alphas],
                radii=0.012 * np.sqrt(np.maximum(shares, 0.1)),
            ),
        )

    def _show_candidates(self, Ts_vehicle_map: np.ndarray, selected: int) -> None:
        Ts = [poses.inverse(T) for T in Ts_vehicle_map if np.isfinite(T).all()]
        selection = [index == selected for index in range(len(Ts))]
        self._say(
            "world/candidates",
            self._rerun.Arrows3D(
                origins=[T[4:] for T in Ts],
                vectors=[_ARROW_M * _x_axis(T[:4]) for T in Ts],
                colors=[_rgb(BLUE if is_selected else ORANGE) for is_selected in selection],
                radii=0.006,
            ),
        )

    def _show_numbers(self, outcomes: Outcomes, index: int) -> None:
        sigma_m = math.sqrt(max(float(np.trace(outcomes.covariance[index][:2, :2])), 0.0))
        nis = outcomes.nis[index]
        for entity, value in (
            ("flip_probability", outcomes.flip_probability[index]),
            ("hypotheses", len(outcomes.hypotheses[index])),
            ("nis", nis if nis > 0 else math.nan),
            *_command(outcomes, index),
            ("position_sigma_m", sigma_m if outcomes.located[index] else math.nan),
            ("repeated_share", outcomes.repeated_share[index]),
        ):
            if math.isfinite(value):
                self._say(f"plots/{entity}", self._rerun.Scalars(float(value)))
        if not self._is_base and not np.isnan(outcomes.twist[index]).all():
            self._is_base = True
            self._still("plots/sensor_errors", self._rerun.SeriesLines(names=list(TWIST_ERRORS)))
        errors = as_filed(outcomes.errors[index], self._rig)
        for entity, values in zip(("sensor_errors", "camera_errors"), errors, strict=True):
            if values.size and np.isfinite(values).all():
                self._say(f"plots/{entity}", self._rerun.Scalars(values))

    def _blueprint(self) -> Any:
        blueprint = self._rerun.blueprint
        whole_past = blueprint.VisibleTimeRanges(
            timeline=TIMELINE,
            start=blueprint.TimeRangeBoundary.infinite(),
            end=blueprint.TimeRangeBoundary.cursor_relative(),
        )
        plots = [
            blueprint.TimeSeriesView(
                origin=f"plots/{name}", name=name, plot_legend=blueprint.PlotLegend(visible=False)
            )
            for name in (
                "flip_probability",
                "hypotheses",
                "nis",
                "position_sigma_m",
                "repeated_share",
            )
        ] + [
            blueprint.TimeSeriesView(origin=f"plots/{name}", name=name)
            for name in ("sensor_errors", "camera_errors")
        ]
        commands = [f"plots/{name}" for name in (*_OF_CAR, *_OF_BASE)]
        cameras = [
            blueprint.Spatial2DView(origin=f"world/vehicle/{name}", name=name)
            for name in self._names
        ]
        space = blueprint.Spatial3DView(
            origin="world", name="map", overrides={"world/track": whole_past}
        )
        return blueprint.Blueprint(
            blueprint.Horizontal(
                blueprint.Vertical(space, *([blueprint.Grid(*cameras)] if cameras else [])),
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

    def _transform(self, wxyz_xyz: np.ndarray) -> Any:
        w, x, y, z, *place_m = wxyz_xyz.tolist()
        rotation = self._rerun.Quaternion(xyzw=[x, y, z, w])
        return self._rerun.Transform3D(translation=place_m, quaternion=rotation)

    def _at(self, stamp_ns: int) -> None:
        self._begin_ns = stamp_ns if self._begin_ns is None else self._begin_ns
        self._stream.set_time(TIMELINE, duration=(stamp_ns - self._begin_ns) / 1e9)

    def _say(self, entity: str, what: Any) -> None:
        self._stream.log(entity, what)

    def _still(self, entity: str, what: Any) -> None:
        self._stream.log(entity, what, static=True)


def _rgb(color: str) -> tuple[int, int, int]:
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def _ahead(psi_rad: np.ndarray) -> np.ndarray:
    return _ARROW_M * np.column_stack([np.cos(psi_rad), np.sin(psi_rad), np.zeros(len(psi_rad))])


def _x_axis(wxyz: np.ndarray) -> np.ndarray:
    """The x axis of a rotated frame."""
    w, x, y, z = wxyz
    return np.array([1 - 2 * (y**2 + z**2), 2 * (x * y + w * z), 2 * (x * z - w * y)])


def _command(outcomes: Outcomes, index: int) -> list[tuple[str, float]]:
    """The numbers of a command with their names: of a car, or of another base."""
    twist = outcomes.twist[index]
    if np.isnan(twist).all():
        return [(name, float(getattr(outcomes, name)[index])) for name in _OF_CAR]
    return list(zip(_OF_BASE, twist.tolist(), strict=True))
