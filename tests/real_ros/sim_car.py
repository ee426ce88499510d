"""A simulated car behind ROS topics, as a process: python -m tests.real_ros.sim_car.

It publishes /odom (with a pose that drifts), /NAME/detections of each camera of the QCar, and the
true pose on /truth; it obeys /drive, and stops by itself 0.5 s after the last command.

    --clock    sends /clock, and its stamps are of that: seconds since it began, and 100. SIGUSR1
               pauses it and its world, and lets them go on.
    --tf       sends /twist too, and the pose of /odom on /tf: odom -> base_footprint, with a fixed
               base_footprint -> base_link on /tf_static
    --images   sends rendered pictures on /NAME/image_raw instead of detections
    --vehicle=FILE   is a base that is no car: it obeys /cmd_vel, and tells its gyro on /imu, which
               is mounted upside down. --rig=FILE, --markers=FILE, --route=FILE are likewise in
               place of the QCar's
    --ros-args WORDS   last: other names of topics, say
"""

import math
import signal
import sys
import threading
import time
from array import array

import numpy as np

from jaxnav.core.models.vehicle import TwistBase
from jaxnav.drive.chassis import car_motion
from jaxnav.drive.interfaces import Odometry, Setup
from jaxnav.files import calib_dir, load_markers, load_rig, load_route, load_vehicle
from jaxnav.recordings.ros import message_type
from jaxnav.recordings.ros.camera_messages import APRILTAG_ROS, IMAGE, detections_message
from jaxnav.recordings.ros.odometry_messages import (
    ACKERMANN,
    IMU,
    NAV_ODOMETRY,
    TWIST_WITH_COVARIANCE,
)
from jaxnav.vehicles import sim
from jaxnav.vehicles.ros.connection import Connection
from jaxnav.vehicles.ros.lenses import CAMERA_INFO

TF, POSE = "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/Pose"
TOPICS = {APRILTAG_ROS: "detections", IMAGE: "image_raw"}
COLORED = ("front", "rear")
WHEELBASE_M = 0.256
ODOMETRY_S = 0.02
SILENT_S = 0.5


class SimTime:
    """The time of the simulated world, in place of the module `time`: it can be paused."""

    def __init__(self):
        self._now = 0, time.monotonic_ns(), False  # what it showed, when, and whether it stands

    @property
    def stands(self) -> bool:
        """Whether it is paused."""
        return self._now[2]

    def pause(self) -> None:
        """Stand still, or go on."""
        self._now = self.monotonic_ns(), time.monotonic_ns(), not self.stands

    def monotonic_ns(self) -> int:
        """Since it began, without its pauses."""
        shown_ns, at_ns, stands = self._now
        return shown_ns + (0 if stands else time.monotonic_ns() - at_ns)

    def sleep(self, wait_s: float) -> None:
        """Sleep for so long of this time."""
        until_ns = self.monotonic_ns() + int(wait_s * 1e9)
        while (left_ns := until_ns - self.monotonic_ns()) > 0:
            time.sleep(0.005 if self.stands else left_ns / 1e9)


class OwnClock:
    """The clock of a world that other processes look at: it waits for nobody."""

    def now_ns(self):
        """The time of the world."""
        return sim.time.monotonic_ns()

    def wait_for(self, since_ns, ahead_s):
        """See the class."""


def topic_of(camera, what):
    """The topic of a camera, whose name may hold what that of a topic may not."""
    return f"/{camera.replace('-', '_')}/{what}"


def tell_lenses(ros, rig, over):
    """Publish the camera_info of each camera, five times a second."""
    kind = message_type(CAMERA_INFO)
    topics = [ros.publisher(CAMERA_INFO, topic_of(name, "camera_info")) for name in rig.names]
    while not over.wait(0.2):
        for c, topic in enumerate(topics):
            camera = rig.camera(c)
            (fx, fy), (cx, cy) = camera.focal_px.tolist(), camera.center_px.tolist()
            width, height = rig.image_sizes_px[c]
            info = kind(width=width, height=height, distortion_model="equidistant")
            info.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
            info.d = camera.distortion.tolist()[:4]
            ros.publish(topic, info)


def main(words):
    """Simulate until a signal comes."""
    clocked, sim_time = "--clock" in words, SimTime()
    if clocked:
        sim.time = sim_time
        signal.signal(signal.SIGUSR1, lambda *_: sim_time.pause())
    over = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: over.set())
    qcar = calib_dir() / "qcar"
    files = {kind: qcar / f"{kind}.yaml" for kind in ("rig", "markers", "vehicle", "route")}
    files |= dict(word[2:].split("=", 1) for word in words if word[2:].split("=")[0] in files)
    rig, route = load_rig(files["rig"]), load_route(files["route"])
    vehicle_model, markers = load_vehicle(files["vehicle"]), load_markers(files["markers"])
    twisted = isinstance(vehicle_model, TwistBase)
    kind = IMAGE if "--images" in words else APRILTAG_ROS
    # A busy machine has no time for 30 frames a second beside the gyro's messages.
    shown = {"rate_hz": "10"} if twisted else {}
    if kind == IMAGE:
        shown = {"images": "true", "rate_hz": "8"}
    setup = Setup(rig, markers, vehicle_model, route.start_pose, options=shown)
    vehicle = sim.open_vehicle(setup)
    vehicle.waiting_clock = OwnClock()
    cameras = sim.open_cameras(setup, vehicle)
    ros_words = words.index("--ros-args") if "--ros-args" in words else len(words)
    ros = Connection("sim_car", args=words[ros_words:])
    heard_s = [time.monotonic()]
    time_of = message_type("builtin_interfaces/msg/Time")

    def stamp_of(now_ns):
        if not clocked:
            return ros.stamp(now_ns)
        seconds, ns = divmod(now_ns, 10**9)
        return time_of(sec=100 + seconds, nanosec=ns)

    def tick():
        clock = message_type("rosgraph_msgs/msg/Clock")
        publisher = ros.publisher("rosgraph_msgs/msg/Clock", "/clock")
        while not over.wait(0.005):
            ros.publish(publisher, clock(clock=stamp_of(sim.time.monotonic_ns())))

    def obey(message):
        heard_s[0] = time.monotonic()
        if twisted:
            vehicle.write(message.linear.x, message.linear.y, message.angular.z)
            return
        per_throttle_mps = float(vehicle_model.speed_per_throttle_mps)
        vehicle.write(message.drive.steering_angle, message.drive.speed / per_throttle_mps)

    def look(camera, publisher):
        while not over.is_set():
            frame = camera.read(0.1)
            if frame is not None:
                stamp = stamp_of(frame.stamp_ns)
                ros.publish(publisher, message_of(kind, camera.name, frame, stamp))

    told = ("geometry_msgs/msg/Twist", "/cmd_vel") if twisted else (ACKERMANN, "/drive")
    ros.listen(*told, obey)
    imu = ros.publisher(IMU, "/imu")
    odom = ros.publisher(NAV_ODOMETRY, "/odom")
    truth = ros.publisher("geometry_msgs/msg/PoseStamped", "/truth")
    ros.run()
    if clocked:
        threading.Thread(target=tick, daemon=True).start()
    if set(rig.cameras.lenses) == {"equidistant"}:
        threading.Thread(target=tell_lenses, args=(ros, rig, over), daemon=True).start()
    for camera in cameras:
        publisher = ros.publisher(kind, topic_of(camera.name, TOPICS[kind]))
        threading.Thread(target=look, args=(camera, publisher), daemon=True).start()
    if "--tf" in words:
        twist, tf = ros.publisher(TWIST_WITH_COVARIANCE, "/twist"), ros.publisher(TF, "/tf")
        fixed, nowhere = ros.publisher(TF, "/tf_static", True), message_type(POSE)()
        place(nowhere, 0.0, 0.0, 0.0)
        told = transform("base_footprint", "base_link", nowhere, stamp_of(sim.time.monotonic_ns()))
        ros.publish(fixed, message_type(TF)(transforms=[told]))
    x_m = y_m = psi_rad = 0.0
    while not over.wait(ODOMETRY_S):
        if time.monotonic() - heard_s[0] > SILENT_S:
            vehicle.stop()
        if sim_time.stands:
            continue
        reading = vehicle.read()
        forward_mps, left_mps, rate_radps = motion_of(reading)
        psi_rad += rate_radps * ODOMETRY_S
        c, s = math.cos(psi_rad), math.sin(psi_rad)
        x_m += (c * forward_mps - s * left_mps) * ODOMETRY_S
        y_m += (s * forward_mps + c * left_mps) * ODOMETRY_S
        for turn in vehicle.read_gyro():
            told = message_type(IMU)()
            told.header.stamp = stamp_of(turn.stamp_ns)
            told.angular_velocity.z = -turn.turn_radps
            ros.publish(imu, told)
        message = message_type(NAV_ODOMETRY)()
        message.header.stamp = stamp_of(reading.stamp_ns)
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        place(message.pose.pose, x_m, y_m, psi_rad)
        message.twist.twist.linear.x, message.twist.twist.angular.z = forward_mps, rate_radps
        if twisted:  # of a car the velocity at the rear axle
            message.twist.twist.linear.y = left_mps
        ros.publish(odom, message)
        if "--tf" in words:
            twist_of_odom = message_type(TWIST_WITH_COVARIANCE)(header=message.header)
            twist_of_odom.twist = message.twist
            ros.publish(twist, twist_of_odom)
            told = transform("odom", "base_footprint", message.pose.pose, message.header.stamp)
            ros.publish(tf, message_type(TF)(transforms=[told]))
        true = message_type("geometry_msgs/msg/PoseStamped")()
        now_ns = sim.time.monotonic_ns()
        true.header.stamp = stamp_of(now_ns)
        place(true.pose, *map(float, vehicle.world.state(now_ns)[:3]))
        ros.publish(truth, true)
    for camera in cameras:
        camera.close()
    vehicle.close()
    ros.close()


def motion_of(reading):
    """Velocity ahead and to the left, and turn rate."""
    if isinstance(reading, Odometry):
        return car_motion(*reading.values, WHEELBASE_M)
    return reading.values


def transform(parent, child, pose, stamp):
    """The geometry_msgs/TransformStamped of a pose."""
    one = message_type("geometry_msgs/msg/TransformStamped")()
    one.header.stamp, one.header.frame_id, one.child_frame_id = stamp, parent, child
    p, moved = pose.position, one.transform.translation
    moved.x, moved.y, moved.z = p.x, p.y, p.z
    one.transform.rotation = pose.orientation
    return one


def message_of(kind, name, frame, stamp):
    """The message of a camera's frame: its detections, or its picture."""
    if kind == APRILTAG_ROS:
        return detections_message(frame.detections, stamp)
    message = message_type(kind)()
    message.header.stamp = stamp
    colored = name in COLORED
    pixels = np.repeat(frame.image[..., None], 3, axis=2) if colored else frame.image
    message.height, message.width = pixels.shape[:2]
    message.step = pixels.shape[1] * (3 if colored else 1)
    message.encoding = "bgr8" if colored else "mono8"
    message.data = array("B", pixels.tobytes())
    return message


def place(pose, x_m, y_m, psi_rad):
    """Write a planar pose into a message."""
    pose.position.x, pose.position.y = x_m, y_m
    pose.orientation.w, pose.orientation.z = math.cos(psi_rad / 2), math.sin(psi_rad / 2)


if __name__ == "__main__":
    main(sys.argv[1:])
