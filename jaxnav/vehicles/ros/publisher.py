"""Publish estimates to ROS: tf, pose, odometry, the bank, diagnostics, pictures for RViz.

What others steer by (tf, pose, odometry) is sent at once. All else is sent by a thread that takes
the latest report when it has time.
"""

import importlib.util
import math
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxnav.core.models.markers import MarkerMap
from jaxnav.drive.loop import Statistics
from jaxnav.files.poses import compose, inverse
from jaxnav.recordings.ros import message_type
from jaxnav.recordings.ros.estimates import Report
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY
from jaxnav.vehicles.ros.connection import Connection
from jaxnav.vehicles.ros.odom_frame import OdomFrame

_GHOSTS = 24  # arrows of hypotheses at most
_PERIOD_S = 0.1  # of the bank and of the pictures
_DIAGNOSTICS_S = 1.0
_DELAY = "camera to tf"
_WELL = ("", "OK", "DEAD_RECKONING")  # states of health that are no warning


@dataclass(frozen=True)
class FrameNames:
    """Names of frames, as REP-105 has them; without `odom` the base stands under the map."""

    map: str = "map"
    odom: str = "odom"
    base: str = "base_link"


class Publisher:
    """The publisher of one node's estimates. `close` ends its thread.

    Attributes:
        send_transform, publish, show_map: see `_send_transform` and so on; they raise nothing.
    """

    def __init__(
        self,
        connection: Connection,
        frames: FrameNames,
        markers: MarkerMap,
        odom: OdomFrame | None,
        tolerance_s: float = 0.0,
    ):
        """Args:
        odom: what map -> odom completes; None: map -> base is sent.
        tolerance_s: tf is stamped so far in the future, for who asks about the present.
        """
        self._connection, self._frames, self._odom = connection, frames, odom
        self._tolerance_ns = int(tolerance_s * 1e9)
        self._tf = connection.publisher("tf2_msgs/msg/TFMessage", "/tf")
        self._pose = connection.publisher("geometry_msgs/msg/PoseWithCovarianceStamped", "~/pose")
        self._odometry = connection.publisher(NAV_ODOMETRY, "~/odometry")
        self._poses = connection.publisher("geometry_msgs/msg/PoseArray", "~/hypotheses")
        self._ghosts = connection.publisher("visualization_msgs/msg/MarkerArray", "~/ghosts")
        self._told = connection.publisher("diagnostic_msgs/msg/DiagnosticArray", "/diagnostics")
        has_bank = importlib.util.find_spec("jaxnav_msgs") is not None
        self._bank = connection.publisher("jaxnav_msgs/msg/Bank", "~/bank") if has_bank else None
        self._map = connection.publisher("visualization_msgs/msg/MarkerArray", "~/map", True)
        self._publishers = [
            self._tf, self._pose, self._odometry, self._poses, self._ghosts, self._told, self._map,
        ]  # fmt: skip
        if self._bank is not None:
            self._publishers.append(self._bank)
        self._latest: Report | None = None
        self._closing, self._due = threading.Event(), threading.Event()
        self._told_s = 0.0
        self._delays = Statistics()
        contained = connection.contained  # ROS refuses what it can't send
        self.send_transform = contained.of("publishing tf", self._send_transform)
        self.publish = contained.of("publishing the pose", self._publish)
        self.show_map = contained.of("publishing the map", self._show_map)
        self._tell_others = contained.of("publishing the bank", self._publish_others)
        self.show_map(markers)
        self._thread = threading.Thread(target=self._tell, name="ros publisher", daemon=True)
        self._thread.start()

    def _send_transform(
        self, now_ns: int, T_map_base: np.ndarray, seen_ns: int | None = None
    ) -> None:
        """Send tf of a decided pose (7,), which others wait for before all else.

        Args:
            seen_ns: stamp of the corners that it is due to; None without any.
        """
        child, pose = self._frames.base, T_map_base
        if self._odom is not None:
            T_odom_base = self._odom.at(now_ns)
            if T_odom_base is None:
                return
            child, pose = self._frames.odom, compose(pose, inverse(T_odom_base))
        if not all(map(math.isfinite, pose.tolist())):
            return
        message = message_type("tf2_msgs/msg/TFMessage")()
        one = message_type("geometry_msgs/msg/TransformStamped")()
        one.header.stamp = self._connection.stamp(now_ns + self._tolerance_ns)
        one.header.frame_id, one.child_frame_id = self._frames.map, child
        _place(one.transform.translation, one.transform.rotation, pose)
        message.transforms = [one]
        self._connection.publish(self._tf, message)
        if seen_ns is not None:
            late_ms = (self._connection.now_ns() - seen_ns) / 1e6
            self._delays.add(_DELAY, max(late_ms, 0.0))

    def _publish(self, report: Report) -> None:
        """Send an estimate but for its transform; a pose that is not decided is not sent."""
        before, self._latest = self._latest, report
        # A start lasts for some frames only: what is new about it is told at once.
        if before is None or (before.located, before.decided) != (report.located, report.decided):
            self._due.set()
        if report.decided and report.is_finite:
            self._publish_pose(report)

    def _show_map(self, markers: MarkerMap) -> None:
        """Send a picture of the map to whoever listens, now or later."""
        message = message_type("visualization_msgs/msg/MarkerArray")()
        poses = np.asarray(markers.Ts_world_marker.wxyz_xyz, float)
        poses = poses + np.array([0, 0, 0, 0, *markers.origin_m])
        for pose, size_m, number in zip(
            poses, np.asarray(markers.size_m, float), markers.ids, strict=True
        ):
            one = self._shape(number, "map", pose, "cube", (float(size_m), float(size_m), 0.005))
            one.color.r = one.color.g = one.color.b = 0.1
            one.color.a = 1.0
            message.markers.append(one)
        self._connection.publish(self._map, message)

    def close(self) -> None:
        """End the thread and leave the topics. May be called any number of times."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._due.set()
        self._thread.join(1.0)
        self._connection.forget(*self._publishers)

    def _publish_pose(self, report: Report) -> None:
        stamped = message_type("geometry_msgs/msg/PoseWithCovarianceStamped")()
        stamped.header.stamp = self._connection.stamp(report.now_ns)
        stamped.header.frame_id = self._frames.map
        _place(stamped.pose.pose.position, stamped.pose.pose.orientation, report.T_map_base)
        stamped.pose.covariance = report.covariance.ravel()
        self._connection.publish(self._pose, stamped)
        odometry = message_type(NAV_ODOMETRY)()
        odometry.header, odometry.child_frame_id = stamped.header, self._frames.base
        odometry.pose = stamped.pose
        linear, angular = odometry.twist.twist.linear, odometry.twist.twist.angular
        linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = report.twist.tolist()
        odometry.twist.covariance = report.twist_covariance.ravel()
        self._connection.publish(self._odometry, odometry)

    def _tell(self) -> None:
        told: Report | None = None
        while not self._closing.is_set():
            self._due.wait(_PERIOD_S)
            self._due.clear()
            report = self._latest
            if report is None or report is told:
                continue
            told = report
            self._tell_others(report)

    def _publish_others(self, report: Report) -> None:
        if time.monotonic() - self._told_s > _DIAGNOSTICS_S:
            self._told_s = time.monotonic()
            self._publish_diagnostics(report)
        self._publish_bank(report)

    def _publish_bank(self, report: Report) -> None:
        held = report.hypotheses()
        stamp = self._connection.stamp(report.now_ns)
        array = message_type("geometry_msgs/msg/PoseArray")()
        array.header.stamp, array.header.frame_id = stamp, self._frames.map
        ghosts = message_type("visualization_msgs/msg/MarkerArray")()
        kind = message_type("geometry_msgs/msg/PoseWithCovariance")
        placed = []
        for number, (pose, covariance) in enumerate(
            zip(held.T_map_base, held.covariance, strict=True)
        ):
            one = kind()
            _place(one.pose.position, one.pose.orientation, pose)
            one.covariance = covariance.ravel()
            placed.append(one)
            ghost = self._shape(number, "ghosts", pose, "arrow", (0.3, 0.05, 0.05))
            ghost.color.g, ghost.color.r = (0.8, 0.1) if number == 0 else (0.2, 0.9)
            ghost.color.a = 0.15 + 0.85 * float(held.weight[number])
            ghosts.markers.append(ghost)
        array.poses = [one.pose for one in placed]
        for number in range(len(placed), _GHOSTS):
            gone = self._shape(number, "ghosts", None, "arrow", (0.0, 0.0, 0.0))
            gone.action = gone.DELETE
            ghosts.markers.append(gone)
        self._connection.publish(self._poses, array)
        self._connection.publish(self._ghosts, ghosts)
        if self._bank is None:
            return
        bank = message_type("jaxnav_msgs/msg/Bank")()
        bank.header, bank.child_frame_id = array.header, self._frames.base
        hypothesis = message_type("jaxnav_msgs/msg/Hypothesis")
        bank.hypotheses = [
            hypothesis(pose=one, weight=float(weight))
            for one, weight in zip(placed, held.weight, strict=True)
        ]
        bank.located, bank.decided, bank.accepted = report.located, report.decided, report.accepted
        bank.flip_probability, bank.nis = report.flip_probability, report.nis
        bank.restarts, bank.health = report.restarts, report.health
        bank.faults, bank.rejects = report.faults, report.rejects
        self._connection.publish(self._bank, bank)

    def _publish_diagnostics(self, report: Report) -> None:
        message = message_type("diagnostic_msgs/msg/DiagnosticArray")()
        message.header.stamp = self._connection.stamp(report.now_ns)
        status = message_type("diagnostic_msgs/msg/DiagnosticStatus")()
        status.name, status.hardware_id = "jaxnav: localisation", "jaxnav"
        well = report.decided and report.health in _WELL
        status.level = (
            status.ERROR if report.health == "STOP" else status.OK if well else status.WARN
        )
        status.message = report.health or ("decided" if report.decided else "undecided")
        pair = message_type("diagnostic_msgs/msg/KeyValue")
        sigma_m = float(np.sqrt(np.trace(report.covariance[:2, :2])))
        told = {
            "located": report.located,
            "decided": report.decided,
            "flip_probability": f"{report.flip_probability:.3g}",
            "position_sigma_m": f"{sigma_m:.3g}",
            "nis": f"{report.nis:.3g}",
            "restarts": report.restarts,
            "faults": ", ".join(report.faults),
            "rejects": ", ".join(report.rejects),
            "raised": self._connection.contained.summary() or "",
            "camera_to_tf_ms": f"{self._delays.quantile_ms(_DELAY, 0.5):.2f}",
            "camera_to_tf_99_ms": f"{self._delays.quantile_ms(_DELAY, 0.99):.2f}",
        }
        status.values = [pair(key=key, value=str(value)) for key, value in told.items()]
        message.status = [status]
        self._connection.publish(self._told, message)

    def _shape(
        self, number: int, group: str, pose: np.ndarray | None, form: str, size_m: tuple[float, ...]
    ) -> Any:
        one = message_type("visualization_msgs/msg/Marker")()
        one.header.frame_id, one.ns, one.id = self._frames.map, group, int(number)
        one.type = one.ARROW if form == "arrow" else one.CUBE
        one.scale.x, one.scale.y, one.scale.z = size_m
        if pose is not None:
            _place(one.pose.position, one.pose.orientation, pose)
        return one


def _place(position: Any, orientation: Any, pose: np.ndarray) -> None:
    """Write a pose (7,) wxyz_xyz into a message's two parts."""
    w, x, y, z, x_m, y_m, z_m = pose.tolist()
    orientation.w, orientation.x, orientation.y, orientation.z = w, x, y, z
    position.x, position.y, position.z = x_m, y_m, z_m
