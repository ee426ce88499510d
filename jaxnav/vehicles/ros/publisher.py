"""Publish outcomes to ROS: tf, pose, odometry, the bank, diagnostics, pictures for RViz.

What other nodes control by (tf, pose, odometry) is sent at once. All else is sent by a thread that
takes the latest outcome when it has time.
"""

import importlib.util
import math
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxnav.core.models.markers import MarkerMap
from jaxnav.drive.flags import names
from jaxnav.drive.loop import Statistics
from jaxnav.drive.pilot import Outcome
from jaxnav.files.poses import compose, inverse
from jaxnav.recordings.ros import message_type
from jaxnav.recordings.ros.estimates import (
    base_hypotheses,
    base_pose,
    base_pose_covariance,
    base_twist,
)
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY
from jaxnav.vehicles.ros.connection import Connection
from jaxnav.vehicles.ros.odom_frame import OdomFrame

_GHOSTS = 24  # arrows of hypotheses at most
_PERIOD_S = 0.1  # of the bank and of the pictures
_DIAGNOSTICS_S = 1.0
_DELAY = "camera to tf"
_WELL = ("", "OK", "DEAD_RECKONING")  # states of health that are no warning
_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_TF = "tf2_msgs/msg/TFMessage"
_POSES = "geometry_msgs/msg/PoseArray"
_SHAPES = "visualization_msgs/msg/MarkerArray"
_DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
_BANK = "jaxnav_msgs/msg/Bank"


@dataclass(frozen=True)
class FrameNames:
    """Names of frames, as REP-105 has them; without `odom` the base stands under the map."""

    map: str = "map"
    odom: str = "odom"
    base: str = "base_link"


class Publisher:
    """The publisher of one node's outcomes. `close` ends its thread."""

    def __init__(
        self,
        connection: Connection,
        frames: FrameNames,
        markers: MarkerMap,
        odom: OdomFrame | None,
        tolerance_s: float = 0.0,
        base_x_m: float = 0.0,
    ):
        """Args:
        odom: what map -> odom completes; None: map -> base is sent.
        tolerance_s: tf is stamped so far in the future, for nodes that ask about the present.
        base_x_m: where the base is on the vehicle, forward of the middle between its axles.
        """
        self._connection, self._frames, self._odom = connection, frames, odom
        self._tolerance_ns, self._base_x_m = int(tolerance_s * 1e9), base_x_m
        topics = {
            _TF: "/tf", _POSE: "~/pose", NAV_ODOMETRY: "~/odometry", _POSES: "~/hypotheses",
            _SHAPES: "~/ghosts", _DIAGNOSTICS: "/diagnostics",
        }  # fmt: skip
        if importlib.util.find_spec("jaxnav_msgs") is not None:
            topics[_BANK] = "~/bank"
        self._publishers = {kind: connection.publisher(kind, name) for kind, name in topics.items()}
        self._map = connection.publisher(_SHAPES, "~/map", True)
        self._latest: Outcome | None = None
        self._closing, self._due = threading.Event(), threading.Event()
        self._diagnosed_s = 0.0
        self._delays = Statistics()
        contained = connection.contained  # ROS refuses what it can't send
        self._send_tf = contained.wrap("publishing tf", self._publish_tf)
        self._send_pose = contained.wrap("publishing the pose", self._publish_pose)
        self._send_others = contained.wrap("publishing the bank", self._publish_others)
        self._send_map = contained.wrap("publishing the map", self._publish_map)
        self.show_map(markers)
        self._thread = threading.Thread(target=self._run, name="ros publisher", daemon=True)
        self._thread.start()

    def publish(self, outcome: Outcome, seen_ns: int | None = None) -> None:
        """Send an outcome; a pose that is not decided is not sent. Raises nothing.

        Args:
            seen_ns: stamp of the corners that it is due to; None without any.
        """
        if outcome.output.decided:
            self._send_tf(outcome, seen_ns)  # others wait for it before all else
        before, self._latest = self._latest, outcome
        # A start lasts for some frames only: what is new about it is sent at once.
        if before is None or any(
            bool(getattr(before.output, name)) != bool(getattr(outcome.output, name))
            for name in ("located", "decided")
        ):
            self._due.set()
        if outcome.output.decided:
            self._send_pose(outcome)

    def show_map(self, markers: MarkerMap) -> None:
        """Send a picture of the map to all subscribers, later ones too. Raises nothing."""
        self._send_map(markers)

    def close(self) -> None:
        """End the thread and leave the topics. May be called any number of times."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._due.set()
        self._thread.join(1.0)
        self._connection.forget(*self._publishers.values(), self._map)

    def _publish_tf(self, outcome: Outcome, seen_ns: int | None) -> None:
        child, pose = self._frames.base, base_pose(outcome, self._base_x_m)
        if self._odom is not None:
            T_odom_base = self._odom.at(outcome.now_ns)
            if T_odom_base is None:
                return
            child, pose = self._frames.odom, compose(pose, inverse(T_odom_base))
        if not all(map(math.isfinite, pose.tolist())):
            return
        message = message_type(_TF)()
        one = message_type("geometry_msgs/msg/TransformStamped")()
        one.header.stamp = self._connection.stamp(outcome.now_ns + self._tolerance_ns)
        one.header.frame_id, one.child_frame_id = self._frames.map, child
        _place(one.transform.translation, one.transform.rotation, pose)
        message.transforms = [one]
        self._publish(message, _TF)
        if seen_ns is not None:
            late_ms = (self._connection.now_ns() - seen_ns) / 1e6
            self._delays.add(_DELAY, max(late_ms, 0.0))

    def _publish_pose(self, outcome: Outcome) -> None:
        pose, covariance = base_pose_covariance(outcome, self._base_x_m)
        twist, twist_covariance = base_twist(outcome, self._base_x_m)
        if not all(np.isfinite(part).all() for part in (pose, covariance, twist, twist_covariance)):
            return
        stamped, odometry = message_type(_POSE)(), message_type(NAV_ODOMETRY)()
        self._head(stamped, outcome)
        _place(stamped.pose.pose.position, stamped.pose.pose.orientation, pose)
        stamped.pose.covariance = covariance.ravel()
        self._publish(stamped, _POSE)
        odometry.header, odometry.child_frame_id = stamped.header, self._frames.base
        odometry.pose = stamped.pose
        linear, angular = odometry.twist.twist.linear, odometry.twist.twist.angular
        linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = twist.tolist()
        odometry.twist.covariance = twist_covariance.ravel()
        self._publish(odometry, NAV_ODOMETRY)

    def _publish_map(self, markers: MarkerMap) -> None:
        message = message_type(_SHAPES)()
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

    def _run(self) -> None:
        sent: Outcome | None = None
        while not self._closing.is_set():
            self._due.wait(_PERIOD_S)
            self._due.clear()
            outcome = self._latest
            if outcome is not None and outcome is not sent:
                sent = outcome
                self._send_others(outcome)

    def _publish_others(self, outcome: Outcome) -> None:
        if time.monotonic() - self._diagnosed_s > _DIAGNOSTICS_S:
            self._diagnosed_s = time.monotonic()
            self._publish_diagnostics(outcome)
        poses, covariances, weights = base_hypotheses(outcome, self._base_x_m)
        array, ghosts = message_type(_POSES)(), message_type(_SHAPES)()
        self._head(array, outcome)
        kind = message_type("geometry_msgs/msg/PoseWithCovariance")
        placed = []
        for number, (pose, covariance) in enumerate(zip(poses, covariances, strict=True)):
            one = kind()
            _place(one.pose.position, one.pose.orientation, pose)
            one.covariance = covariance.ravel()
            placed.append(one)
            ghost = self._shape(number, "ghosts", pose, "arrow", (0.3, 0.05, 0.05))
            ghost.color.g, ghost.color.r = (0.8, 0.1) if number == 0 else (0.2, 0.9)
            ghost.color.a = 0.15 + 0.85 * float(weights[number])
            ghosts.markers.append(ghost)
        array.poses = [one.pose for one in placed]
        for number in range(len(placed), _GHOSTS):
            gone = self._shape(number, "ghosts", None, "arrow", (0.0, 0.0, 0.0))
            gone.action = gone.DELETE
            ghosts.markers.append(gone)
        self._publish(array, _POSES)
        self._publish(ghosts, _SHAPES)
        if _BANK not in self._publishers:
            return
        bank = message_type(_BANK)()
        bank.header, bank.child_frame_id = array.header, self._frames.base
        hypothesis = message_type("jaxnav_msgs/msg/Hypothesis")
        bank.hypotheses = [
            hypothesis(pose=one, weight=float(weight))
            for one, weight in zip(placed, weights, strict=True)
        ]
        output = outcome.output
        bank.located, bank.decided = bool(output.located), bool(output.decided)
        bank.accepted = bool(output.accepted)
        bank.flip_probability, bank.nis = float(output.flip_probability), float(output.nis)
        bank.restarts, bank.health = outcome.restarts, _health(outcome)
        bank.faults, bank.rejects = names(outcome.faults), names(outcome.rejects)
        self._publish(bank, _BANK)

    def _publish_diagnostics(self, outcome: Outcome) -> None:
        message = message_type(_DIAGNOSTICS)()
        message.header.stamp = self._connection.stamp(outcome.now_ns)
        status = message_type("diagnostic_msgs/msg/DiagnosticStatus")()
        status.name, status.hardware_id = "jaxnav: localisation", "jaxnav"
        output, health = outcome.output, _health(outcome)
        well = bool(output.decided) and health in _WELL
        status.level = status.ERROR if health == "STOP" else status.OK if well else status.WARN
        status.message = health or ("decided" if output.decided else "undecided")
        pair = message_type("diagnostic_msgs/msg/KeyValue")
        _, covariance = base_pose_covariance(outcome, self._base_x_m)
        values = {
            "located": bool(output.located),
            "decided": bool(output.decided),
            "flip_probability": f"{float(output.flip_probability):.3g}",
            "position_sigma_m": f"{float(np.sqrt(np.trace(covariance[:2, :2]))):.3g}",
            "nis": f"{float(output.nis):.3g}",
            "restarts": outcome.restarts,
            "faults": ", ".join(names(outcome.faults)),
            "rejects": ", ".join(names(outcome.rejects)),
            "raised": self._connection.contained.summary() or "",
            "camera_to_tf_ms": f"{self._delays.quantile_ms(_DELAY, 0.5):.2f}",
            "camera_to_tf_99_ms": f"{self._delays.quantile_ms(_DELAY, 0.99):.2f}",
        }
        status.values = [pair(key=key, value=str(value)) for key, value in values.items()]
        message.status = [status]
        self._publish(message, _DIAGNOSTICS)

    def _publish(self, message: Any, kind: str) -> None:
        self._connection.publish(self._publishers[kind], message)

    def _head(self, message: Any, outcome: Outcome) -> None:
        message.header.stamp = self._connection.stamp(outcome.now_ns)
        message.header.frame_id = self._frames.map

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


def _health(outcome: Outcome) -> str:
    """The health in a word; empty where nobody drives or odometry is not used."""
    return "" if outcome.output.command is None else outcome.health.name


def _place(position: Any, orientation: Any, pose: np.ndarray) -> None:
    """Write a pose (7,) wxyz_xyz into a message's two parts."""
    w, x, y, z, x_m, y_m, z_m = pose.tolist()
    orientation.w, orientation.x, orientation.y, orientation.z = w, x, y, z
    position.x, position.y, position.z = x_m, y_m, z_m
